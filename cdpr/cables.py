"""Cables between outlets and anchors: exit points, lengths and directions.

Two kinds of outlet. A point exit is the outlet point itself (paper, Eq. 1). A swivelling pulley of
radius r turns about its feed direction k through the outlet A, where the cable enters it; the cable
wraps the pulley, leaves it tangentially at T and runs straight to the anchor B (A. Pott,
"Cable-Driven Parallel Robots", 2018, section 3.5). The length is then the wrapped arc and the
straight part; its derivative with respect to B is the unit vector from T to B, as for a point exit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cdpr.errors import BadInput
from cdpr.poses import Array, Pose
from cdpr.rig import Rig


class NoCable(BadInput, ValueError):
    """A pose at which a cable cannot run: its anchor lies at its outlet or inside its pulley."""

    code = "no_cable"


@dataclass(frozen=True, slots=True, eq=False)
class Cables:
    """The m cables of a rig at one pose or a batch of poses.

    Attributes:
        exits: Where the straight part begins, world frame, shape (..., m, 3), [m].
        anchors: Where it ends on the platform, world frame, shape (..., m, 3), [m].
        directions: Unit vectors from anchor to exit, shape (..., m, 3).
        lengths: From outlet to anchor, wrapped part included, shape (..., m), [m].
    """

    exits: Array
    anchors: Array
    directions: Array
    lengths: Array


def cables_at(rig: Rig, pose: Pose) -> Cables:
    """The cables with the platform at ``pose`` (``world_from_platform``).

    Raises:
        NoCable: An anchor lies at its outlet, inside its pulley or on its swivel axis.
    """
    return cables_to(rig, pose.apply(rig.anchors))


def cables_to(rig: Rig, anchors_in_world: Array) -> Cables:
    """The cables that end at given anchors, world frame, shape (..., m, 3), [m].

    Raises:
        NoCable: An anchor lies at its outlet, inside its pulley or on its swivel axis.
    """
    if rig.pulley_radius == 0.0:
        straight = rig.outlets - anchors_in_world
        lengths = np.linalg.norm(straight, axis=-1)
        _demand(lengths > 0.0, "its anchor lies at its outlet")
        exits = np.broadcast_to(rig.outlets, anchors_in_world.shape)
        return Cables(exits, anchors_in_world, straight / lengths[..., None], lengths)
    return _over_pulleys(rig, anchors_in_world)


def _over_pulleys(rig: Rig, anchors_in_world: Array) -> Cables:
    radius, feed = rig.pulley_radius, rig.feed_directions
    offset = anchors_in_world - rig.outlets
    along = np.sum(offset * feed, axis=-1)
    radial = offset - along[..., None] * feed
    reach = np.linalg.norm(radial, axis=-1)
    outward = reach - radius  # from the pulley's centre, in the pulley's plane
    centre_distance = np.hypot(outward, along)
    _demand(reach > 0.0, "its anchor lies on the swivel axis of its pulley")
    _demand(centre_distance > radius, "its anchor lies inside its pulley")
    swivel = radial / reach[..., None]
    straight = np.sqrt(centre_distance**2 - radius**2)
    # The tangent point, as an angle about the pulley's centre from the swivel direction to k.
    angle = np.arctan2(along, outward) + np.arccos(radius / centre_distance)
    wrap = np.mod(np.pi - angle, 2.0 * np.pi)
    centre = rig.outlets + radius * swivel
    exits = centre + radius * (np.cos(angle)[..., None] * swivel + np.sin(angle)[..., None] * feed)
    directions = (exits - anchors_in_world) / straight[..., None]
    return Cables(exits, anchors_in_world, directions, radius * wrap + straight)


def _demand(sound: NDArray[np.bool_], what: str) -> None:
    """Raises `NoCable` for the first cable, along the last axis, that is not sound."""
    if sound.all():
        return
    number = int(np.argwhere(~sound)[0][-1]) + 1
    raise NoCable(
        f"cable {number} cannot run: {what}",
        why="the pose is out of the rig's reach, or holds a value that is not a number",
        next_step="choose a pose inside the workspace",
        values={"cable": number},
    )
