"""What is due at places of the table: announcements of stops, and changes of what is carried."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Generic, TypeVar

from executor.trajectory.dwell import Dwell
from model.scene import Load, Scene, legs_of

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
