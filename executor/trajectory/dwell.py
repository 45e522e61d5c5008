"""Dwells of the set-point table at the scene's stops, and the check of its loads.

Between two stops a table is for one load. During a pick or put-down, the planned tensions change
linearly from those that hold the old load to those that hold the new one; at any stage of the
change tensions within the limits hold it, as the feasible wrenches are a convex set.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Generic, TypeVar

import numpy as np

from model.kinematics import cables_to, structure_matrix_of
from model.pose import Array, Pose
from model.rig import Rig
from model.scene import Load, Scene, legs_of
from model.statics.gravity import gravity_wrench

#: Largest residual wrench of planned tensions and load, [N] and [N·m].
HOLDING_ACCURACY = 1e-4
#: Largest distance of a dwell from its stop, [m] and [rad].
DWELL_ACCURACY = 1e-6


@dataclass(frozen=True, slots=True)
class Dwell:
    """Rows of a table at one stop; a single row without a dwell time.

    Attributes:
        first: Row at which the stop is reached.
        last: Row after which the platform moves on.
    """

    first: int
    last: int


def rows_of(dwell: float, cycle: float) -> int:
    """Cycles of a dwell [s], rounded up."""
    return int(np.ceil(dwell / cycle - 1e-9))


def legs_at(
    dwells: Sequence[Dwell], indices: Array
) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """Leg numbers, from 1, at table indices.

    A dwell belongs to the leg before it, except for its last row, which belongs to the next leg.
    """
    lasts = np.array([dwell.last for dwell in dwells], dtype=np.float64)
    return 1 + np.searchsorted(lasts, indices, side="right").astype(np.int64)


def order_violations(scene: Scene, dwells: Sequence[Dwell], rows: int) -> list[str]:
    """Violations of one dwell per stop, in order, within the table."""
    bounds = [row for dwell in dwells for row in (dwell.first, dwell.last)]
    if len(dwells) != len(scene.stops):
        return [f"the table rests at {len(dwells)} stops, the scene has {len(scene.stops)}"]
    if any(a > b for a, b in pairwise([0, *bounds, rows - 1])):
        return [f"the table rests at the rows {bounds} of {rows}, which are out of order"]
    return []


def dwell_violations(
    scene: Scene, dwells: Sequence[Dwell], poses: Sequence[Pose], cycle: float
) -> list[str]:
    """Dwells that are not at their stop, or too short."""
    found = []
    for stop, dwell in zip(scene.stops, dwells, strict=True):
        there = poses[dwell.first : dwell.last + 1]
        off = max(pose.distance_to(stop.pose) for pose in there)
        angle = max(pose.angle_to(stop.pose) for pose in there)
        if not max(off, angle) <= DWELL_ACCURACY:
            found.append(
                f"at stop {stop.name!r} the table is {off * 1000:.4f} mm and"
                f" {np.degrees(angle):.4f}° off"
            )
        duration = (dwell.last - dwell.first) * cycle
        if not duration >= stop.dwell - 1e-9:
            found.append(
                f"at stop {stop.name!r} the table rests for {duration:g} s,"
                f" required {stop.dwell:g} s"
            )
    return found


def load_violations(
    rig: Rig, scene: Scene, dwells: Sequence[Dwell], poses: Sequence[Pose], tensions: Array
) -> list[str]:
    """Rows whose planned tensions do not hold the load; the worst of each leg and dwell.

    Args:
        dwells: In order.
        poses: One per row.
        tensions: Planned, shape (n, m), [N].
    """
    positions = np.array([pose.position for pose in poses])
    rotations = np.array([pose.rotation for pose in poses])
    anchors = positions[:, None, :] + np.einsum("nij,mj->nmi", rotations, rig.anchors)
    matrices = structure_matrix_of(cables_to(rig, anchors), positions)
    given = np.einsum("nij,nj->ni", matrices, tensions)
    legs = legs_of(scene)
    bounds = [0, *(row for dwell in dwells for row in (dwell.first, dwell.last)), len(poses) - 1]
    found = []
    for number, leg in enumerate(legs):
        rows = slice(bounds[2 * number], bounds[2 * number + 1] + 1)
        missing = given[rows] + _weights(rig, leg.scene.load, rotations[rows])
        found += _missing(missing, rows.start, f"from {leg.begin} to {leg.end}")
    for dwell, before, after in zip(dwells, legs[:-1], legs[1:], strict=True):
        rows = slice(dwell.first, dwell.last + 1)
        weights = [_weights(rig, leg.scene.load, rotations[rows]) for leg in (before, after)]
        missing = _least(given[rows] + weights[0], weights[1] - weights[0])
        found += _missing(missing, rows.start, f"at {before.end}")
    return found


def _weights(rig: Rig, load: Load, rotations: Array) -> Array:
    """Wrenches of platform and payload, shape (n, 6), [N, N·m]."""
    return gravity_wrench(
        rig.mass,
        rotations @ rig.centre_of_mass,
        payload_mass=load.payload_mass,
        payload_offset=rotations @ load.payload_centre,
    )


def _least(missing: Array, change: Array) -> Array:
    """Smallest residual over all stages of a load change, shape (n, 6)."""
    size = np.sum(change * change, axis=1)
    share = -np.sum(missing * change, axis=1) / np.where(size > 0.0, size, 1.0)
    least: Array = missing + np.clip(share, 0.0, 1.0)[:, None] * change
    return least


def _missing(missing: Array, begin: int, where: str) -> list[str]:
    sizes = np.abs(missing).max(axis=1)
    worst = int(np.argmax(sizes))
    if sizes[worst] <= HOLDING_ACCURACY:
        return []
    size = f"{sizes[worst]:.4g} N or N·m"
    return [f"row {begin + worst}: planned tensions miss the load {where} by {size}"]


# Events due at table indices: announcements of stops, and changes of the load.


Thing = TypeVar("Thing")

_HAPPENS = {"pick": "is picked up", "place": "is put down"}


class Schedule(Generic[Thing]):
    """Returns each item once, when the run reaches its table index."""

    def __init__(self, things: Sequence[tuple[float, Thing]]) -> None:
        """Takes table indices, which may lie between rows, and their items; in order."""
        self._things = list(things)

    def due(self, index: float) -> list[Thing]:
        """Items due up to this index and not returned before."""
        count = sum(1 for at, _ in self._things if at <= index)
        due, self._things = self._things[:count], self._things[count:]
        return [thing for _, thing in due]


def stop_events(scene: Scene, dwells: Sequence[Dwell]) -> Schedule[tuple[str, str]]:
    """Code and text of events at the beginning and end of each dwell."""
    due: list[tuple[float, tuple[str, str]]] = []
    carried = [leg.scene.load.payload_mass for leg in legs_of(scene)]
    for number, (stop, dwell) in enumerate(zip(scene.stops, dwells, strict=True)):
        text = f"at stop {stop.name!r}"
        if stop.dwell > 0.0:
            text += f", resting for {stop.dwell:g} s"
        if stop.kind in _HAPPENS:
            changed = abs(carried[number + 1] - carried[number])
            text += f" while {changed:g} kg {_HAPPENS[stop.kind]}"
        due.append((dwell.first, (stop.kind, text)))
        if stop.dwell > 0.0:
            text = f"continuing from stop {stop.name!r}, carrying {carried[number + 1]:g} kg"
            due.append((dwell.last, ("leaving", text)))
    return Schedule(due)


def load_changes(scene: Scene, dwells: Sequence[Dwell]) -> Schedule[Load]:
    """Load after each pick and put-down, due at the middle of its dwell.

    The time within the dwell is not specified; in the middle the planned tensions change as well.
    """
    loads = [leg.scene.load for leg in legs_of(scene)][1:]
    return Schedule(
        [
            ((dwell.first + dwell.last) / 2.0, load)
            for stop, dwell, load in zip(scene.stops, dwells, loads, strict=True)
            if stop.kind in _HAPPENS
        ]
    )
