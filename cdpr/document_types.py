"""The parts that rig, scene and plan files share: strict models, vectors, poses."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from cdpr.poses import Pose

Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


def _exactly(count: int) -> BeforeValidator:
    """Says how many entries a list needs; pydantic alone would say "at least"."""

    def check(value: object) -> object:
        if isinstance(value, list) and len(value) != count:
            raise ValueError(f"needs {count} entries, it has {len(value)}")
        return value

    return BeforeValidator(check)


_three = (Field(min_length=3, max_length=3), _exactly(3))
Vector = Annotated[list[Number], *_three]
PositiveVector = Annotated[list[Positive], *_three]
NonNegativeVector = Annotated[list[NonNegative], *_three]
Triple = Annotated[list[int], *_three]


def _is_unit(quaternion: list[float]) -> list[float]:
    norm = math.sqrt(sum(q * q for q in quaternion))
    if abs(norm - 1.0) > 1e-6:
        raise ValueError(f"must be a unit quaternion [w, x, y, z]; its length is {norm:.8g}")
    return quaternion


Quaternion = Annotated[
    list[Number], Field(min_length=4, max_length=4), _exactly(4), AfterValidator(_is_unit)
]


def _has_length_one(vector: list[float]) -> list[float]:
    length = math.sqrt(sum(x * x for x in vector))
    if abs(length - 1.0) > 1e-6:
        raise ValueError(f"must be a direction of length 1; its length is {length:.8g}")
    return vector


UnitVector = Annotated[Vector, AfterValidator(_has_length_one)]

Finding = tuple[tuple[str | int, ...], str]
"""Path of a key, and a sentence about what is wrong with it."""


class Document(BaseModel):
    """A strict part of a file: unknown keys, wrong types, NaN and infinity are refused."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    def rules(self) -> Sequence[Callable[[], list[Finding]]]:
        """Checks between the document's parts; each reads as few of them as it can.

        Of a file with other problems only the rules are asked whose parts are sound, so that one
        reading tells everything.
        """
        return ()

    def findings(self) -> list[Finding]:
        """What is wrong between the parts of the document."""
        return [finding for rule in self.rules() for finding in rule()]


class PoseDocument(Document):
    """Where something is: position in mm and a unit quaternion (level when left out)."""

    position_mm: Vector
    rotation_wxyz: Quaternion = [1.0, 0.0, 0.0, 0.0]

    def pose(self) -> Pose:
        """The same pose in metres."""
        quaternion = np.asarray(self.rotation_wxyz)
        unit = quaternion / np.linalg.norm(quaternion)
        return Pose.from_quaternion(np.asarray(self.position_mm) / 1000.0, unit)

    def bare(self) -> PoseDocument:
        """The pose alone, without what else the document tells."""
        return PoseDocument(position_mm=self.position_mm, rotation_wxyz=self.rotation_wxyz)

    @staticmethod
    def of(pose: Pose) -> PoseDocument:
        """The document of a pose; positions to a nanometre, and no negative zero among them."""
        return PoseDocument(
            position_mm=[round(float(x) * 1000.0, 6) + 0.0 for x in pose.position],
            rotation_wxyz=[float(q) for q in pose.quaternion],
        )


def millimetres(
    values: list[float],
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """A list in mm as an array in m."""
    return np.asarray(values, dtype=np.float64) / 1000.0
