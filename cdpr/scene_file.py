"""The scene file: obstacles, clearances, start, stops and goal (YAML, strict, version 1)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from cdpr.document_types import (
    Document,
    Finding,
    NonNegative,
    NonNegativeVector,
    PoseDocument,
    Positive,
    PositiveVector,
    Quaternion,
    Triple,
    Vector,
)
from cdpr.payload import Payload
from cdpr.rotation_limits import RotationLimits
from cdpr.scene_stops import StopDocument, misfits, overdrawn

SHAPES = ("box", "sphere", "cylinder", "capsule", "convex", "mesh")


class BoxDocument(Document):
    """A box about its centre."""

    size_mm: PositiveVector


class SphereDocument(Document):
    """A ball about its centre."""

    radius_mm: Positive


class RoundDocument(Document):
    """A cylinder (length between its flat ends) or a capsule (length of its axis), along z."""

    radius_mm: Positive
    length_mm: Positive


class HullDocument(Document):
    """The convex hull of points."""

    points_mm: Annotated[list[Vector], Field(min_length=4)]


class MeshDocument(Document):
    """A surface of triangles; each triangle names three points, counted from 0."""

    points_mm: Annotated[list[Vector], Field(min_length=3)]
    triangles: Annotated[list[Triple], Field(min_length=1)]


class ObstacleDocument(Document):
    """One obstacle: a name, exactly one shape, and where its centre is."""

    name: Annotated[str, Field(min_length=1)]
    position_mm: Vector = [0.0, 0.0, 0.0]
    rotation_wxyz: Quaternion = [1.0, 0.0, 0.0, 0.0]
    box: BoxDocument | None = None
    sphere: SphereDocument | None = None
    cylinder: RoundDocument | None = None
    capsule: RoundDocument | None = None
    convex: HullDocument | None = None
    mesh: MeshDocument | None = None

    def shapes(self) -> dict[str, Document]:
        """The shapes that were given, by key."""
        given = {key: getattr(self, key) for key in SHAPES}
        return {key: shape for key, shape in given.items() if shape is not None}


class ClearanceDocument(Document):
    """The distances that every pose of a plan keeps."""

    obstacle_mm: NonNegative = Field(
        default=10.0, description="cables and platform to every obstacle"
    )
    self_mm: NonNegative = Field(default=5.0, description="cable to cable and cable to platform")


class LoadDocument(Document):
    """What the cables must carry beside the platform's own weight."""

    payload_kg: NonNegative = 0.0
    payload_centre_mm: Vector = [0.0, 0.0, 0.0]
    force_n: NonNegativeVector = Field(
        default=[0.0, 0.0, 0.0], description="external force up to ± this, world axes"
    )
    moment_nm: NonNegativeVector = Field(
        default=[0.0, 0.0, 0.0], description="external moment up to ± this, world axes"
    )

    def payload(self) -> Payload:
        """What is carried at the start."""
        x, y, z = self.payload_centre_mm
        return Payload(self.payload_kg, (x, y, z))

    def carrying(self, payload: Payload) -> LoadDocument:
        """The same force and moment with another payload."""
        given = {"payload_kg": payload.mass_kg, "payload_centre_mm": list(payload.centre_mm)}
        return self.model_copy(update=given)


class RotationLimitsDocument(Document):
    """How far the platform may be tilted and turned, measured from level and not turned."""

    tilt_deg: Annotated[float, Field(ge=0, le=90, allow_inf_nan=False)] = Field(
        description="largest angle of the platform's z axis from the vertical"
    )
    turn_deg: Annotated[float, Field(ge=0, le=180, allow_inf_nan=False)] = Field(
        description="largest turn about the vertical, either way; 180 for any"
    )


class SceneDocument(Document):
    """What a plan is made for."""

    schema_version: Literal[1]
    name: Annotated[str, Field(min_length=1)]
    description: str = ""
    clearance: ClearanceDocument = ClearanceDocument()
    load: LoadDocument = LoadDocument()
    start: PoseDocument
    stops: list[StopDocument] = []
    goal: PoseDocument
    rotation_limits: RotationLimitsDocument | None = None
    obstacles: list[ObstacleDocument] = []

    def rules(self) -> Sequence[Callable[[], list[Finding]]]:
        """Obstacles without exactly one shape, names given twice, wrong triangles, flat hulls.

        And stops whose load changes by too little or too much; and poses turned too far.
        """
        return (
            self._one_shape_each,
            self._names_once,
            self._shapes_whole,
            lambda: misfits(self.stops),
            self._ends_in_limits,
            lambda: overdrawn(self.load.payload(), self.stops),
        )

    def _one_shape_each(self) -> list[Finding]:
        found: list[Finding] = []
        for i, obstacle in enumerate(self.obstacles):
            given = list(obstacle.shapes())
            if len(given) != 1:
                has = f"it has {', '.join(given)}" if given else f"one of {', '.join(SHAPES)}"
                what = f"obstacle {obstacle.name!r} needs exactly one shape: {has}"
                found.append((("obstacles", i), what))
        return found

    def _names_once(self) -> list[Finding]:
        names = [obstacle.name for obstacle in self.obstacles]
        return [
            (("obstacles", i, "name"), f"obstacle name {name!r} stands twice")
            for i, name in enumerate(names)
            if name in names[:i]
        ]

    def _shapes_whole(self) -> list[Finding]:
        found: list[Finding] = []
        for i, obstacle in enumerate(self.obstacles):
            if obstacle.convex is not None and _is_flat(obstacle.convex.points_mm):
                what = "the points lie in a plane; a convex body needs a volume"
                found.append((("obstacles", i, "convex", "points_mm"), what))
            if obstacle.mesh is not None:
                place = ("obstacles", i, "mesh", "triangles")
                found += [((*place, t), what) for t, what in _wrong_triangles(obstacle.mesh)]
        return found

    def _ends_in_limits(self) -> list[Finding]:
        limits = self.rotation_limits
        if limits is None:
            return []
        allowed = RotationLimits(math.radians(limits.tilt_deg), math.radians(limits.turn_deg))
        ends: list[tuple[str, tuple[str | int, ...], PoseDocument]] = [
            ("start", ("start",), self.start),
            ("goal", ("goal",), self.goal),
            *((f"stop {stop.name!r}", ("stops", i), stop) for i, stop in enumerate(self.stops)),
        ]
        found: list[Finding] = []
        for name, place, end in ends:
            pose = end.pose()
            excess = allowed.excess(pose, pose)
            if excess is not None:
                found.append(((*place, "rotation_wxyz"), f"the {name} is {excess.sentence()}"))
        return found


def _is_flat(points_mm: list[list[float]]) -> bool:
    points = np.asarray(points_mm, dtype=np.float64)
    centred = points - points.mean(axis=0)
    size = float(np.max(np.abs(centred)))
    return size == 0.0 or int(np.linalg.matrix_rank(centred / size, tol=1e-9)) < 3


def _wrong_triangles(mesh: MeshDocument) -> list[tuple[int, str]]:
    """Triangles that name points which do not exist, or one point twice: number and sentence."""
    count = len(mesh.points_mm)
    found: list[tuple[int, str]] = []
    for number, triangle in enumerate(mesh.triangles):
        if not all(0 <= i < count for i in triangle):
            found.append((number, f"{triangle} names a point outside 0..{count - 1}"))
        elif len(set(triangle)) < 3:
            found.append((number, f"{triangle} names one point twice"))
    return found
