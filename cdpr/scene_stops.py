"""The stops of a scene file: poses that are passed exactly, and where a load is taken or left."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import Annotated, Literal

from pydantic import Field

from cdpr.document_types import Finding, NonNegative, PoseDocument, Positive, Vector
from cdpr.payload import Payload


class StopDocument(PoseDocument):
    """A pose between start and goal, and what happens there."""

    name: Annotated[str, Field(min_length=1)]
    kind: Literal["pass", "pick", "place"] = "pass"
    dwell_s: NonNegative = Field(default=0.0, description="the platform stands still for so long")
    mass_kg: Positive | None = Field(
        default=None, description="taken up at a pick, put down at a place"
    )
    mass_centre_mm: Vector | None = Field(
        default=None,
        description="its centre in the platform frame; left out, the origin for a pick and the"
        " centre of the whole payload for a place",
    )

    def changed(self, payload: Payload) -> Payload:
        """What is carried on from here.

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
    """What is carried to the first stop, from each stop to the next, and to the goal.

    Raises:
        ValueError: More is put down somewhere than is carried.
    """
    return list(accumulate(stops, lambda carried, stop: stop.changed(carried), initial=first))


def misfits(stops: Sequence[StopDocument]) -> list[Finding]:
    """Names given twice, and keys that do not fit a stop's kind."""
    found: list[Finding] = []
    names = [stop.name for stop in stops]
    for i, stop in enumerate(stops):
        if stop.name in names[:i]:
            found.append((("stops", i, "name"), f"stop name {stop.name!r} stands twice"))
        if stop.kind == "pass":
            what = f"stop {stop.name!r} changes no load; say kind: pick or place"
            keys = ("mass_kg", "mass_centre_mm")
            found += [(("stops", i, k), what) for k in keys if getattr(stop, k) is not None]
        if stop.kind in ("pick", "place"):
            needs = f"{stop.kind} {stop.name!r} needs"
            if stop.mass_kg is None:
                found.append((("stops", i), f"{needs} mass_kg, by which the load changes"))
            if stop.dwell_s == 0.0:
                found.append((("stops", i), f"{needs} a dwell_s above 0, while it changes"))
    return found


def overdrawn(first: Payload, stops: Sequence[StopDocument]) -> list[Finding]:
    """The first stop that puts down what is not carried."""
    carried = first
    for i, stop in enumerate(stops):
        try:
            carried = stop.changed(carried)
        except ValueError as error:
            return [(("stops", i, "mass_kg"), f"place {stop.name!r} {error}")]
    return []
