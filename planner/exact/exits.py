"""Where a cable leaves its pulley, and a bound of how far that point travels."""

from __future__ import annotations

import math

import numpy as np

from planner.exact.compiled import kernel
from planner.exact.vectors import Vector, along, dot, minus, norm, row
from planner.exact.world import World


@kernel
def exit_point(world: World, cable: int, anchor: Vector) -> Vector:
    """The exit of a cable to an anchor in the world, [m]; not numbers where it cannot run."""
    outlet = row(world.outlets, cable)
    radius = world.pulley
    if radius == 0.0:
        return outlet
    feed = row(world.feeds, cable)
    offset = minus(anchor, outlet)
    rise = dot(offset, feed)
    radial = along(offset, feed, -rise)
    reach = norm(radial)
    outward = reach - radius
    distance = math.sqrt(outward * outward + rise * rise)
    if reach == 0.0 or distance <= radius:
        return (np.nan, np.nan, np.nan)
    angle = math.atan2(rise, outward) + math.acos(radius / distance)
    out = radius * (1.0 + math.cos(angle)) / reach
    return along(along(outlet, radial, out), feed, radius * math.sin(angle))


@kernel
def exit_travel(world: World, cable: int, start: Vector, end: Vector, travel: float) -> float:
    """A bound of how far an exit travels while its anchor does; infinite where there is none.

    As in `planner.swept`: an anchor that moves by dB swivels the pulley by at most dB / ρ, which
    moves the exit by at most 2 r dB / ρ, and rolls the cable by at most dB / l, which moves it by
    r dB / l; ρ is the distance from the swivel axis, l the free length.

    Args:
        world: Where.
        cable: Its number.
        start: The anchor before, world frame, [m].
        end: The anchor after, [m].
        travel: How far the anchor travels at most between them, [m].
    """
    radius = world.pulley
    if radius == 0.0:
        return 0.0
    outlet, feed = row(world.outlets, cable), row(world.feeds, cable)
    first, last = minus(start, outlet), minus(end, outlet)
    reach = min(_radial(first, feed), _radial(last, feed)) - travel / 2.0
    from_centre = min(norm(first), norm(last)) - radius - travel / 2.0
    if not (reach > 0.0 and from_centre > radius):
        return np.inf
    free = math.sqrt(from_centre * from_centre - radius * radius)
    return radius * max(2.0 / reach, 1.0 / free) * travel


@kernel
def _radial(offset: Vector, feed: Vector) -> float:
    return norm(along(offset, feed, -dot(offset, feed)))
