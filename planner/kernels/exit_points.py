"""Where a cable leaves its pulley, and a bound on the travel of that point."""

from __future__ import annotations

import math

import numpy as np

from planner.kernels.jit import kernel
from planner.kernels.primitives import Vector, along, dot, minus, norm
from planner.kernels.scene_arrays import World, feed, outlet


@kernel
def exit_point(world: World, cable: int, anchor: Vector) -> Vector:
    """The exit point of a cable to an anchor, world frame, [m]; NaN where there is none."""
    origin = outlet(world, cable)
    radius = world.pulley
    if radius == 0.0:
        return origin
    axis = feed(world, cable)
    offset = minus(anchor, origin)
    rise = dot(offset, axis)
    radial = along(offset, axis, -rise)
    reach = norm(radial)
    outward = reach - radius
    distance = math.sqrt(outward * outward + rise * rise)
    if reach == 0.0 or distance <= radius:
        return (np.nan, np.nan, np.nan)
    angle = math.atan2(rise, outward) + math.acos(radius / distance)
    out = radius * (1.0 + math.cos(angle)) / reach
    return along(along(origin, radial, out), axis, radius * math.sin(angle))


@kernel
def exit_travel(world: World, cable: int, start: Vector, end: Vector, travel: float) -> float:
    """A bound on the travel of an exit point, [m]; infinite where there is none.

    An anchor that moves by dB swivels the pulley by at most dB / ρ, which moves the exit by at most
    2 r dB / ρ, and rolls the cable by at most dB / l, which moves it by r dB / l; ρ is the distance
    from the swivel axis, l the free length.

    Args:
        world: The rig.
        cable: Its index.
        start: The anchor before, world frame, [m].
        end: The anchor after, [m].
        travel: Most the anchor travels between them, [m].
    """
    radius = world.pulley
    if radius == 0.0:
        return 0.0
    origin, axis = outlet(world, cable), feed(world, cable)
    first, last = minus(start, origin), minus(end, origin)
    reach = min(_radial(first, axis), _radial(last, axis)) - travel / 2.0
    from_centre = min(norm(first), norm(last)) - radius - travel / 2.0
    if not (reach > 0.0 and from_centre > radius):
        return np.inf
    free = math.sqrt(from_centre * from_centre - radius * radius)
    return radius * max(2.0 / reach, 1.0 / free) * travel


@kernel
def _radial(offset: Vector, axis: Vector) -> float:
    return norm(along(offset, axis, -dot(offset, axis)))
