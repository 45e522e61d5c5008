"""A scene with stops as legs, each of which is a scene from one stop to the next."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

from cdpr.document_types import PoseDocument
from cdpr.scene import Scene, load_from_document
from cdpr.scene_stops import payloads


@dataclass(frozen=True, slots=True, eq=False)
class Leg:
    """A part of the way, run with one load.

    Attributes:
        scene: The whole scene but for its ends and its load, which are the leg's, without stops.
        begin: What it begins at, for people: ``start`` or ``stop 'shelf'``.
        end: What it ends at, likewise; ``goal`` for the last.
    """

    scene: Scene
    begin: str
    end: str


def legs_of(scene: Scene) -> tuple[Leg, ...]:
    """The legs of a scene in their order: one more than it has stops."""
    document = scene.document
    ends: list[tuple[str, PoseDocument]] = [
        ("start", document.start),
        *((f"stop {stop.name!r}", stop) for stop in document.stops),
        ("goal", document.goal),
    ]
    legs = []
    carried = payloads(document.load.payload(), document.stops)
    for (begin, end), payload in zip(pairwise(ends), carried, strict=True):
        load = document.load.carrying(payload)
        changes = {"start": begin[1].bare(), "goal": end[1].bare(), "load": load, "stops": []}
        part = replace(
            scene,
            document=document.model_copy(update=changes),
            start=begin[1].pose(),
            goal=end[1].pose(),
            load=load_from_document(load),
            stops=(),
        )
        legs.append(Leg(part, begin[0], end[0]))
    return tuple(legs)
