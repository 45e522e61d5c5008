"""Where in the set-point table the platform stands at the scene's stops, and proof that it may.

Between two stops a table is for one load. While the platform stands at a pick or place, the planned
tensions go evenly from those that hold the one load to those that hold the other; whatever part of
the change has happened, tensions within the limits hold it, as the wrenches they can give are a
convex set.
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

#: How far planned tensions may be from holding the load, [N] and [N·m].
HOLDING_ACCURACY = 1e-4
#: How far a stand may be from its stop, [m] and [rad].
STANDING_ACCURACY = 1e-6


@dataclass(frozen=True, slots=True)
class Dwell:
    """Rows of a table at one stop; a single row where nothing is waited for.

    Attributes:
        first: Row at which the stop is reached.
        last: Row from which the way goes on.
    """

    first: int
    last: int


def rows_of(dwell: float, cycle: float) -> int:
    """Cycles that a dwell [s] takes, never less than asked for."""
    return int(np.ceil(dwell / cycle - 1e-9))


def legs_at(
    stands: Sequence[Dwell], places: Array
) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """Legs, counted from 1, at places in the table; a dwell belongs to the leg that led there."""
    lasts = np.array([stand.last for stand in stands], dtype=np.float64)
    return 1 + np.searchsorted(lasts, places, side="right").astype(np.int64)


def order_violations(scene: Scene, stands: Sequence[Dwell], rows: int) -> list[str]:
    """Stands that are not one for each stop, in order, within the table."""
    bounds = [row for stand in stands for row in (stand.first, stand.last)]
    if len(stands) != len(scene.stops):
        return [f"the table rests at {len(stands)} stops, the scene has {len(scene.stops)}"]
    if any(a > b for a, b in pairwise([0, *bounds, rows - 1])):
        return [f"the table rests at the rows {bounds} of {rows}, which are out of order"]
    return []


def stand_violations(
    scene: Scene, stands: Sequence[Dwell], poses: Sequence[Pose], cycle: float
) -> list[str]:
    """Stands that are elsewhere than their stop, or shorter than its dwell."""
    found = []
    for stop, stand in zip(scene.stops, stands, strict=True):
        there = poses[stand.first : stand.last + 1]
        off = max(pose.distance_to(stop.pose) for pose in there)
        turned = max(pose.angle_to(stop.pose) for pose in there)
        if not max(off, turned) <= STANDING_ACCURACY:
            found.append(
                f"at stop {stop.name!r} the table is {off * 1000:.4f} mm and"
                f" {np.degrees(turned):.4f}° off"
            )
        stands_for = (stand.last - stand.first) * cycle
        if not stands_for >= stop.dwell - 1e-9:
            found.append(
                f"at stop {stop.name!r} the table rests for {stands_for:g} s,"
                f" required {stop.dwell:g} s"
            )
    return found


def load_violations(
    rig: Rig, scene: Scene, stands: Sequence[Dwell], poses: Sequence[Pose], tensions: Array
) -> list[str]:
    """Rows whose planned tensions do not hold what hangs there; the worst of each leg and stand.

    Args:
        rig: The robot.
        scene: Its loads.
        stands: In order.
        poses: One a row.
        tensions: Planned, shape (n, m), [N].
    """
    positions = np.array([pose.position for pose in poses])
    rotations = np.array([pose.rotation for pose in poses])
    anchors = positions[:, None, :] + np.einsum("nij,mj->nmi", rotations, rig.anchors)
    matrices = structure_matrix_of(cables_to(rig, anchors), positions)
    given = np.einsum("nij,nj->ni", matrices, tensions)
    legs = legs_of(scene)
    bounds = [0, *(row for stand in stands for row in (stand.first, stand.last)), len(poses) - 1]
    found = []
    for number, leg in enumerate(legs):
        rows = slice(bounds[2 * number], bounds[2 * number + 1] + 1)
        missing = given[rows] + _weights(rig, leg.scene.load, rotations[rows])
        found += _missing(missing, rows.start, f"from {leg.begin} to {leg.end}")
    for stand, before, after in zip(stands, legs[:-1], legs[1:], strict=True):
        rows = slice(stand.first, stand.last + 1)
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
    """What is missing where the best part of a change has happened, shape (n, 6)."""
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


# What is due at places of the table: announcements of stops, and changes of what is carried.


Thing = TypeVar("Thing")

_HAPPENS = {"pick": "is picked up", "place": "is put down"}


class Schedule(Generic[Thing]):
    """Hands out each thing once, when a run comes to its place in the table."""

    def __init__(self, things: Sequence[tuple[float, Thing]]) -> None:
        """Places, rows or between two of them, and what is due there; in order."""
        self._things = list(things)

    def due(self, place: float) -> list[Thing]:
        """What is due up to a place and was not handed out before."""
        count = sum(1 for at, _ in self._things if at <= place)
        due, self._things = self._things[:count], self._things[count:]
        return [thing for _, thing in due]


def stop_events(scene: Scene, stands: Sequence[Dwell]) -> Schedule[tuple[str, str]]:
    """A stable short name and a sentence when a stop is reached, and when a dwell is over."""
    due: list[tuple[float, tuple[str, str]]] = []
    carried = [leg.scene.load.payload_mass for leg in legs_of(scene)]
    for number, (stop, stand) in enumerate(zip(scene.stops, stands, strict=True)):
        text = f"at stop {stop.name!r}"
        if stop.dwell > 0.0:
            text += f", resting for {stop.dwell:g} s"
        if stop.kind in _HAPPENS:
            changed = abs(carried[number + 1] - carried[number])
            text += f" while {changed:g} kg {_HAPPENS[stop.kind]}"
        due.append((stand.first, (stop.kind, text)))
        if stop.dwell > 0.0:
            text = f"continuing from stop {stop.name!r}, carrying {carried[number + 1]:g} kg"
            due.append((stand.last, ("leaving", text)))
    return Schedule(due)


def load_changes(scene: Scene, stands: Sequence[Dwell]) -> Schedule[Load]:
    """What is carried on from each pick and place.

    When in its dwell that happens is not given; in the middle, the planned tensions are there, too.
    """
    loads = [leg.scene.load for leg in legs_of(scene)][1:]
    return Schedule(
        [
            ((stand.first + stand.last) / 2.0, load)
            for stop, stand, load in zip(scene.stops, stands, loads, strict=True)
            if stop.kind in _HAPPENS
        ]
    )
