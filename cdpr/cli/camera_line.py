"""How cameras do, in a line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


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
