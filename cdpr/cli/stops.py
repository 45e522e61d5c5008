"""How the stops of a scene are told."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cdpr.scene import Scene


def stop_facts(scene: Scene) -> list[tuple[str, str]]:
    """Stops with what happens there and what is carried on; nothing for a scene without."""
    from cdpr.legs import legs_of

    carried = [leg.scene.load.payload_mass for leg in legs_of(scene)]
    told = []
    for stop, before, after in zip(scene.stops, carried[:-1], carried[1:], strict=True):
        load = f", then {after:g} kg" if after != before else ""
        dwell = f" {stop.dwell:g} s" if stop.dwell > 0.0 else ""
        told.append(f"{stop.name} ({stop.kind}{dwell}{load})")
    return [("by way of", ", ".join(told))] if told else []
