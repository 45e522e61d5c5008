"""How the stops of a scene are shown."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from model.scene import Scene


def stop_facts(scene: Scene) -> list[tuple[str, str]]:
    """Stops with what happens there and what is carried on; nothing for a scene without."""
    from model.scene import legs_of

    carried = [leg.scene.load.payload_mass for leg in legs_of(scene)]
    told = []
    for stop, before, after in zip(scene.stops, carried[:-1], carried[1:], strict=True):
        load = f", then {after:g} kg" if after != before else ""
        dwell = f" {stop.dwell:g} s" if stop.dwell > 0.0 else ""
        told.append(f"{stop.name} ({stop.kind}{dwell}{load})")
    return [("via", ", ".join(told))] if told else []


def by_way_of(scene: Scene, via_mm: Sequence[str]) -> Scene:
    """The scene with level way-poses before its own stops, given as ``x y z`` (`joined_points`).

    Raises:
        BadInput: A way-pose cannot be read.
    """
    from model.errors import BadInput
    from model.files.scene_file import StopDocument

    ways = []
    for number, text in enumerate(via_mm, start=1):
        try:
            x, y, z = map(float, text.split())
        except ValueError:
            raise BadInput(
                f"--via-mm {text}: three numbers are required", next_step="write --via-mm 0 40 430"
            ) from None
        if not all(map(math.isfinite, (x, y, z))):
            raise BadInput(
                f"--via-mm {text}: finite numbers are required", next_step="write --via-mm 0 40 430"
            )
        ways.append(StopDocument(name=f"via {number}", position_mm=[x, y, z]))
    return scene.changed(stops=[*ways, *scene.document.stops]) if ways else scene
