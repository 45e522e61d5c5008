"""The scene file: obstacles, clearances, start, stops and goal (YAML, strict, version 1)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import ConfigDict, Field

from model.errors import first_few
from model.files.documents import (
    Document,
    Finding,
    Name,
    NonNegative,
    NonNegativeVector,
    Number,
    PoseDocument,
    Positive,
    Quaternion,
    Triple,
    Vector,
    in_schema,
    three,
)
from model.pose import Array, RotationLimits

# The payload of the platform, and its changes at picks and places, in units of the scene file.


NOTHING_KG = 1e-9
"""Masses below this count as none."""
SAME_POINT_MM = 1e-3
"""Centres nearer to each other than this count as equal."""

Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Payload:
    """A mass on the platform.

    Attributes:
        mass_kg: [kg].
        centre_mm: Its centre in the platform frame; the origin when there is no mass.
    """

    mass_kg: float
    centre_mm: Point

    def with_mass(self, mass_kg: float, centre_mm: Point) -> Payload:
        """The payload after picking up a mass with the given centre."""
        whole = self.mass_kg + mass_kg
        return Payload(whole, self._centre(mass_kg, centre_mm, whole))

    def without_mass(self, mass_kg: float, centre_mm: Point | None) -> Payload:
        """The payload after putting down a mass; its centre defaults to the payload's.

        Raises:
            ValueError: It is more than is carried, or all of it with another centre.
        """
        rest = self.mass_kg - mass_kg
        if rest < -NOTHING_KG:
            raise ValueError(f"puts down {mass_kg:g} kg, but only {self.mass_kg:g} kg are carried")
        if rest > NOTHING_KG:
            return Payload(rest, self._centre(-mass_kg, centre_mm or self.centre_mm, rest))
        away = [
            abs(a - b) for a, b in zip(centre_mm or self.centre_mm, self.centre_mm, strict=True)
        ]
        if max(away) > SAME_POINT_MM:
            x, y, z = self.centre_mm
            raise ValueError(
                f"puts down the whole payload, whose centre is at [{x:g}, {y:g}, {z:g}] mm"
            )
        return Payload(0.0, (0.0, 0.0, 0.0))

    def _centre(self, mass_kg: float, centre_mm: Point, whole_kg: float) -> Point:
        """The centre after adding or removing a mass, to a nanometre as in pose documents."""
        x, y, z = (
            round((self.mass_kg * own + mass_kg * other) / whole_kg, 6) + 0.0
            for own, other in zip(self.centre_mm, centre_mm, strict=True)
        )
        return x, y, z


# The stops of a scene file: poses that are met exactly, where a load may be picked or placed.


class StopDocument(PoseDocument):
    """A pose between start and goal, with dwell and change of load."""

    model_config = ConfigDict(
        json_schema_extra={
            "if": {"properties": {"kind": {"const": "pass"}}},
            "then": {
                "properties": {"mass_kg": {"type": "null"}, "mass_centre_mm": {"type": "null"}}
            },
            "else": {
                "properties": {"dwell_s": {"exclusiveMinimum": 0}, "mass_kg": {"type": "number"}},
                "required": ["dwell_s", "mass_kg"],
            },
        }
    )

    name: Name
    kind: Literal["pass", "pick", "place"] = "pass"
    dwell_s: Annotated[float, Field(ge=0, le=3600, allow_inf_nan=False)] = Field(
        default=0.0, description="time that the platform rests there"
    )
    mass_kg: Positive | None = Field(
        default=None, description="picked up at a pick, put down at a place"
    )
    mass_centre_mm: Vector | None = Field(
        default=None,
        description="its centre in the platform frame; left out, the origin for a pick and the"
        " centre of the whole payload for a place",
    )

    def changed(self, payload: Payload) -> Payload:
        """The payload from this stop on.

        Raises:
            ValueError: More is put down than is carried.
        """
        if self.kind == "pass" or self.mass_kg is None:
            return payload
        x, y, z = self.mass_centre_mm or (0.0, 0.0, 0.0)
        if self.kind == "pick":
            return payload.with_mass(self.mass_kg, (x, y, z))
        centre = None if self.mass_centre_mm is None else (x, y, z)
        return payload.without_mass(self.mass_kg, centre)


def payloads(first: Payload, stops: Sequence[StopDocument]) -> list[Payload]:
    """The payload to the first stop, from each stop to the next, and to the goal.

    Raises:
        ValueError: More is put down at a stop than is carried.
    """
    return list(accumulate(stops, lambda carried, stop: stop.changed(carried), initial=first))


def misfits(stops: Sequence[StopDocument]) -> list[Finding]:
    """Duplicate names, and keys that do not fit a stop's kind."""
    found: list[Finding] = []
    names = [stop.name for stop in stops]
    for i, stop in enumerate(stops):
        if stop.name in names[:i]:
            found.append((("stops", i, "name"), f"stop name {stop.name!r} appears twice"))
        if stop.kind == "pass":
            what = f"stop {stop.name!r} does not change the load; set kind: pick or place"
            keys = ("mass_kg", "mass_centre_mm")
            found += [(("stops", i, k), what) for k in keys if getattr(stop, k) is not None]
        if stop.kind in ("pick", "place"):
            needs = f"{stop.kind} {stop.name!r} needs"
            if stop.mass_kg is None:
                found.append((("stops", i), f"{needs} mass_kg, by which the load changes"))
            if stop.dwell_s == 0.0:
                found.append((("stops", i), f"{needs} a dwell_s above 0 for the change of load"))
    return found


def overdrawn(first: Payload, stops: Sequence[StopDocument]) -> list[Finding]:
    """The first stop that puts down more than is carried."""
    carried = first
    for i, stop in enumerate(stops):
        try:
            carried = stop.changed(carried)
        except ValueError as error:
            return [(("stops", i, "mass_kg"), f"place {stop.name!r} {error}")]
    return []


FARTHEST_MM = 1e6
"""Largest number of an obstacle: distances are proved to 0.1 µm, for which floating-point numbers
suffice up to about ten kilometres."""

SMALL_OBSTACLE_MM, SMALL_CLEARANCE_MM = 10.0, 0.5
"""Obstacles and clearances below these are unlikely: 10 m and 0.5 m in metres."""

SHAPES = ("box", "sphere", "cylinder", "capsule", "convex", "mesh")

Coordinate = Annotated[Number, in_schema(minimum=-FARTHEST_MM, maximum=FARTHEST_MM)]
Corner = Annotated[list[Coordinate], *three]
Length = Annotated[Positive, in_schema(maximum=FARTHEST_MM)]


class BoxDocument(Document):
    """A box about its centre."""

    size_mm: Annotated[list[Length], *three]


class SphereDocument(Document):
    """A ball about its centre."""

    radius_mm: Length


class RoundDocument(Document):
    """A cylinder (length between its flat ends) or a capsule (length of its axis), along z."""

    radius_mm: Length
    length_mm: Length


class HullDocument(Document):
    """The convex hull of points."""

    points_mm: Annotated[list[Corner], Field(min_length=4)]


class MeshDocument(Document):
    """A surface of triangles; each triangle names three points, counted from 0."""

    points_mm: Annotated[list[Corner], Field(min_length=3)]
    triangles: Annotated[list[Triple], Field(min_length=1)]


ShapeDocument = BoxDocument | SphereDocument | RoundDocument | HullDocument | MeshDocument


class ObstacleDocument(Document):
    """One obstacle: a name, exactly one shape, and its pose."""

    model_config = ConfigDict(
        json_schema_extra={
            "oneOf": [{"properties": {k: {"type": "object"}}, "required": [k]} for k in SHAPES]
        }
    )

    name: Name
    position_mm: Corner = [0.0, 0.0, 0.0]
    rotation_wxyz: Quaternion = [1.0, 0.0, 0.0, 0.0]
    box: BoxDocument | None = None
    sphere: SphereDocument | None = None
    cylinder: RoundDocument | None = None
    capsule: RoundDocument | None = None
    convex: HullDocument | None = None
    mesh: MeshDocument | None = None

    def shapes(self) -> dict[str, ShapeDocument]:
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
    """What the cables must carry besides the platform's own weight."""

    payload_kg: NonNegative = 0.0
    payload_centre_mm: Vector = [0.0, 0.0, 0.0]
    force_n: NonNegativeVector = Field(
        default=[0.0, 0.0, 0.0], description="external force up to ± these, world axes"
    )
    moment_nm: NonNegativeVector = Field(
        default=[0.0, 0.0, 0.0], description="external moment up to ± these, world axes"
    )

    def payload(self) -> Payload:
        """The payload at the start."""
        x, y, z = self.payload_centre_mm
        return Payload(self.payload_kg, (x, y, z))

    def carrying(self, payload: Payload) -> LoadDocument:
        """The same force and moment with another payload."""
        given = {"payload_kg": payload.mass_kg, "payload_centre_mm": list(payload.centre_mm)}
        return self.model_copy(update=given)


class RotationLimitsDocument(Document):
    """Limits of the platform's tilt and turn, measured from the level, unrotated platform."""

    tilt_deg: Annotated[float, Field(ge=0, le=180, allow_inf_nan=False)] = Field(
        description="largest angle of the platform's z axis from the vertical; 180 for any"
    )
    turn_deg: Annotated[float, Field(ge=0, le=180, allow_inf_nan=False)] = Field(
        description="largest rotation about the vertical, either direction; 180 for any"
    )

    @classmethod
    def containing(cls, tilt_deg: float, turn_deg: float) -> Self:
        """Limits that contain rotations of up to these angles.

        The turn is free where the tilt exceeds 90°: towards 180° it changes by any amount between
        neighbouring orientations.
        """
        return cls(
            tilt_deg=min(180.0, tilt_deg),
            turn_deg=180.0 if tilt_deg > 90.0 else min(180.0, turn_deg),
        )


class SceneDocument(Document):
    """The scene of a plan."""

    schema_version: Literal[1]
    name: Name
    description: str = ""
    clearance: ClearanceDocument = ClearanceDocument()
    load: LoadDocument = LoadDocument()
    start: PoseDocument
    stops: list[StopDocument] = []
    goal: PoseDocument
    rotation_limits: RotationLimitsDocument | None = None
    obstacles: list[ObstacleDocument] = []

    def rules(self) -> Sequence[Callable[[], list[Finding]]]:
        """Obstacles without exactly one shape or out of range, duplicate names, flat hulls.

        Also wrong triangles, stops that do not fit the load, and poses beyond the rotation limits.
        """
        return (
            self._one_shape_each,
            self._names_once,
            self._within_reach,
            self._shapes_whole,
            lambda: misfits(self.stops),
            self._ends_in_limits,
            lambda: overdrawn(self.load.payload(), self.stops),
        )

    def remarks(self) -> list[str]:
        """Values that are valid but unlikely, such as metres for millimetres, each with its key."""
        small = [
            f"obstacles[{i}]: {obstacle.name!r} is {size:g} mm large"
            for i, obstacle in enumerate(self.obstacles)
            if (size := _extent(obstacle)) < SMALL_OBSTACLE_MM
        ]
        tight = [
            f"clearance.{key}: {value:g} mm is very small"
            for key, value in self.clearance.model_dump().items()
            if 0.0 < value < SMALL_CLEARANCE_MM
        ]
        merged = [first_few(small)] if small else []
        return [f"{what}; check that it is in mm, not in m" for what in merged + tight]

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
            (("obstacles", i, "name"), f"obstacle name {name!r} appears twice")
            for i, name in enumerate(names)
            if name in names[:i]
        ]

    def _within_reach(self) -> list[Finding]:
        found: list[Finding] = []
        for i, obstacle in enumerate(self.obstacles):
            largest = np.abs(_numbers(obstacle)).max()
            if largest > FARTHEST_MM:
                what = (
                    f"obstacle {obstacle.name!r} reaches {largest:g} mm; distances are proved up"
                    f" to {FARTHEST_MM:g} mm (1 km): make it as large as the room"
                )
                found.append((("obstacles", i), what))
        return found

    def _shapes_whole(self) -> list[Finding]:
        found: list[Finding] = []
        for i, obstacle in enumerate(self.obstacles):
            if obstacle.convex is not None and _is_flat(obstacle.convex.points_mm):
                what = "the points lie in a plane; a convex body needs a volume"
                found.append((("obstacles", i, "convex", "points_mm"), what))
            if obstacle.mesh is not None:
                key = ("obstacles", i, "mesh", "triangles")
                found += [((*key, t), what) for t, what in _wrong_triangles(obstacle.mesh)]
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
        for name, key, end in ends:
            pose = end.pose()
            excess = allowed.excess(pose, pose)
            if excess is not None:
                found.append(((*key, "rotation_wxyz"), f"the {name} is {excess.sentence()}"))
        return found


def _numbers(obstacle: ObstacleDocument) -> Array:
    """All lengths and coordinates of an obstacle, [mm]."""
    lengths = [
        np.ravel([value for key, value in shape if key != "triangles"])
        for shape in obstacle.shapes().values()
    ]
    return np.hstack([obstacle.position_mm, *lengths])


def _extent(obstacle: ObstacleDocument) -> float:
    """The largest dimension of an obstacle along its own axes, [mm]."""
    match next(iter(obstacle.shapes().values())):
        case BoxDocument(size_mm=size):
            return max(size)
        case SphereDocument(radius_mm=radius):
            return 2.0 * radius
        case RoundDocument(radius_mm=radius, length_mm=length):
            return max(2.0 * radius, length)
        case HullDocument(points_mm=points) | MeshDocument(points_mm=points):
            return float(np.ptp(points, axis=0).max())


def _is_flat(points_mm: list[list[float]]) -> bool:
    points = np.asarray(points_mm, dtype=np.float64)
    centred = points - points.mean(axis=0)
    size = float(np.max(np.abs(centred)))
    return size == 0.0 or int(np.linalg.matrix_rank(centred / size, tol=1e-9)) < 3


def _wrong_triangles(mesh: MeshDocument) -> list[tuple[int, str]]:
    """Triangles with unknown or duplicate points: index and sentence."""
    count = len(mesh.points_mm)
    found: list[tuple[int, str]] = []
    for number, triangle in enumerate(mesh.triangles):
        if not all(0 <= i < count for i in triangle):
            found.append((number, f"{triangle} names a point outside 0..{count - 1}"))
        elif len(set(triangle)) < 3:
            found.append((number, f"{triangle} names a point twice"))
    return found
