"""How cameras do, in a line."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tracking.measurement import Observation

#: Live figures are those of so many of the newest pictures.
NEWEST = 10


def camera_line(camera: Mapping[str, Any]) -> str:
    """What is told of one camera while pictures are measured.

    Args:
        camera: As `executor.status` has it.
    """
    parts = [
        f"{camera['name']} ({camera['source']})",
        rates(camera["pictures_per_second"], camera["measuring_ms"], len(camera["tags"])),
        f"{camera['poses']} of {camera['pictures']} with a pose",
    ]
    if camera["dropped"]:
        parts.append(f"{camera['dropped']} dropped")
    if camera["trouble"]:
        parts.append(camera["trouble"])
    return ", ".join(parts)


def rates(pictures_per_second: float | None, measuring_ms: float | None, tags: int) -> str:
    """Live figures: how fast, how long a picture takes, how many tags are seen."""
    fast = "–" if pictures_per_second is None else f"{pictures_per_second:.1f}"
    long = "–" if measuring_ms is None else f"{measuring_ms:.1f}"
    return f"{fast} pictures/s, {long} ms, {tags} tag{'' if tags == 1 else 's'}"


class Pace:
    """How fast pictures are measured now."""

    def __init__(self) -> None:
        """None was yet."""
        self._ends: deque[float] = deque(maxlen=NEWEST + 1)

    def after(self, now: float, seconds: Sequence[float], found: Observation) -> str:
        """The live figures after one more picture.

        Args:
            now: On a clock that only goes forward, [s].
            seconds: How long each picture took to measure, [s].
            found: What was measured in it.
        """
        from statistics import median

        from tracking.measurement import PoseMeasurement

        self._ends.append(now)
        took = now - self._ends[0]
        fast = (len(self._ends) - 1) / took if took > 0.0 else None
        tags = len(found.tags) if isinstance(found, PoseMeasurement) else 0
        return rates(fast, median(seconds[-NEWEST:]) * 1e3, tags)
