"""The parts that rig, scene and plan files share: strict models, vectors, poses."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from cdpr.poses import Pose

Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Vector = Annotated[list[Number], Field(min_length=3, max_length=3)]
PositiveVector = Annotated[list[Positive], Field(min_length=3, max_length=3)]
NonNegativeVector = Annotated[list[NonNegative], Field(min_length=3, max_length=3)]


def _is_unit(quaternion: list[float]) -> list[float]:
    norm = math.sqrt(sum(q * q for q in quaternion))
    if abs(norm - 1.0) > 1e-6:
        raise ValueError(
            f"must be a unit quaternion [w, x, y, z]; its length is {norm:.6g}"
        )
    return quaternion


Quaternion = Annotated[
    list[Number], Field(min_length=4, max_length=4), AfterValidator(_is_unit)
]


class Document(BaseModel):
    """A strict part of a file: unknown keys, wrong types, NaN and infinity are refused."""

    model_config = ConfigDict(
        extra="forbid", strict=True, frozen=True, allow_inf_nan=False
    )

    def findings(self) -> list[tuple[tuple[str | int, ...], str]]:
        """What is wrong between the parts of a document: path of the key, and a sentence."""
        return []


class PoseDocument(Document):
    """Where something is: position in mm and a unit quaternion (level when left out)."""

    position_mm: Vector
    rotation_wxyz: Quaternion = [1.0, 0.0, 0.0, 0.0]

    def pose(self) -> Pose:
        """The same pose in metres."""
        quaternion = np.asarray(self.rotation_wxyz)
        unit = quaternion / np.linalg.norm(quaternion)
        return Pose.from_quaternion(np.asarray(self.position_mm) / 1000.0, unit)

    @classmethod
    def of(cls, pose: Pose) -> PoseDocument:
        """The document of a pose; positions to a nanometre, so that text round-trips."""
        return cls(
            position_mm=[round(float(x) * 1000.0, 6) for x in pose.position],
            rotation_wxyz=[float(q) for q in pose.quaternion],
        )


def millimetres(
    values: list[float],
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """A list in mm as an array in m."""
    return np.asarray(values, dtype=np.float64) / 1000.0
