"""A platform on elastic cables that only pull, under gravity: its energy and what follows of it.

Pure. Twists are a translation, then a rotation, both in the world and about the platform's origin.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cdpr.cables import Cables, cables_at
from cdpr.poses import Array, Pose, read_only, skew
from cdpr.rig import Rig
from cdpr.scene import Load
from cdpr.statics.gravity import STANDARD_GRAVITY
from cdpr.winches import WinchMap


@dataclass(frozen=True, slots=True, eq=False)
class Suspension:
    """What the platform hangs on, and what it weighs.

    A cable of axial stiffness EA wound off to the unstrained length L0 pulls with
    EA · max(0, (l + d) / L0 − 1), l from outlet to anchor and d from drum to outlet.

    Attributes:
        rig: The robot.
        axial: EA of each cable, shape (m,), [N].
        behind: d of each cable, shape (m,), [m].
        unstrained: L0 of each cable, shape (m,), [m].
        weight: Of platform and payload, [N].
        centre: Their centre of mass, platform frame, shape (3,), [m].
    """

    rig: Rig
    axial: Array
    behind: Array
    unstrained: Array
    weight: float
    centre: Array

    @classmethod
    def wound(
        cls, rig: Rig, winch_map: WinchMap, unstrained: Array, load: Load | None
    ) -> Suspension:
        """The rig with its cables wound off to given lengths, shape (m,), [m]."""
        axial = np.broadcast_to(winch_map.stiffness, rig.cable_count)
        return cls(rig, axial, winch_map.behind_outlet, unstrained, *_weight(rig, load))

    def with_load(self, load: Load) -> Suspension:
        """The same with another load on the platform."""
        weight, centre = _weight(self.rig, load)
        return replace(self, weight=weight, centre=centre)

    def with_lengths(self, unstrained: Array) -> Suspension:
        """The same with cables of other unstrained lengths, shape (m,), [m]."""
        return replace(self, unstrained=unstrained)

    def strained(self, pose: Pose) -> tuple[Cables, Array]:
        """The cables at a pose and how far each is stretched, by its length; negative when slack.

        Raises:
            ValueError: An anchor is inside its pulley.
        """
        cables = cables_at(self.rig, pose)
        return cables, (cables.lengths + self.behind) / self.unstrained - 1.0

    def pulled(self, pose: Pose) -> tuple[Cables, Array]:
        """The cables at a pose and their tensions, shape (m,), [N]; errors as for `strained`."""
        cables, strain = self.strained(pose)
        tensions: Array = self.axial * np.maximum(strain, 0.0)
        return cables, tensions

    def energy(self, pose: Pose, tensions: Array) -> float:
        """Elastic and potential energy at a pose with the tensions there, [J]."""
        elastic = (tensions * tensions) @ (self.unstrained / (2.0 * self.axial))
        height = pose.position[2] + pose.rotation[2] @ self.centre
        return float(elastic + self.weight * height)

    def gradient(self, pose: Pose, cables: Cables, tensions: Array) -> Array:
        """Energy by a twist: minus the wrench, shape (6,), [N, N·m]."""
        gradient: Array = -(tensions @ _columns(pose, cables))
        arm_x, arm_y = (pose.rotation @ self.centre)[:2].tolist()
        gradient[2] += self.weight
        gradient[3] += arm_y * self.weight
        gradient[4] -= arm_x * self.weight
        return gradient

    def rates(self, pulling: NDArray[np.bool_]) -> Array:
        """Tension by length of each cable that pulls, 0 for the others, shape (m,), [N/m]."""
        return np.where(pulling, self.axial / self.unstrained, 0.0)

    def stiffness(self, pose: Pose, cables: Cables, rates: Array, tensions: Array) -> Array:
        """Second derivative of the energy by the twist, shape (6, 6).

        Over a pulley the exit moves with the anchor; that part is left out, which costs steps
        and no accuracy, since the equilibrium is decided by the gradient.

        Args:
            pose: ``world_from_platform``.
            cables: The cables there.
            rates: Tension by length of each cable, 0 for a slack one, shape (m,), [N/m].
            tensions: Shape (m,), [N].
        """
        arms = cables.anchors - pose.position
        directions = cables.directions
        columns = _columns(pose, cables)
        straight = np.linalg.norm(cables.exits - cables.anchors, axis=1)
        swing = tensions / straight
        stiffness: Array = (columns.T * (rates - swing)) @ columns
        # Sum of swing · Gᵀ G with G = [1, −[a]×], the motion of an anchor under the twist.
        weighted = swing @ arms
        coupling = skew(weighted)
        stiffness[:3, :3] += swing.sum() * np.eye(3)
        stiffness[:3, 3:] -= coupling
        stiffness[3:, :3] += coupling
        spread = (arms.T * swing) @ arms
        stiffness[3:, 3:] += np.trace(spread) * np.eye(3) - spread
        # Turning also bends the arms of the forces themselves.
        forces = directions * tensions[:, None]
        moment = forces.T @ arms
        moment[2] -= self.weight * (pose.rotation @ self.centre)
        stiffness[3:, 3:] += np.trace(moment) * np.eye(3) - (moment + moment.T) / 2.0
        return stiffness


def _weight(rig: Rig, load: Load | None) -> tuple[float, Array]:
    """Weight of platform and payload [N] and their centre, platform frame, shape (3,), [m]."""
    payload = load.payload_mass if load else 0.0
    mass = rig.mass + payload
    centre = rig.mass * rig.centre_of_mass
    if load:
        centre = centre + payload * np.asarray(load.payload_centre)
    return mass * STANDARD_GRAVITY, read_only(centre / mass)


def _columns(pose: Pose, cables: Cables) -> Array:
    """Columns of the structure matrix, one a row, shape (m, 6)."""
    arms = cables.anchors - pose.position
    return np.concatenate([cables.directions, _cross(arms, cables.directions)], axis=1)


def _cross(a: Array, b: Array) -> Array:
    """Rows' cross products, shape (m, 3); for a few rows faster than `numpy.cross`."""
    x, y, z = a[:, 0], a[:, 1], a[:, 2]
    u, v, w = b[:, 0], b[:, 1], b[:, 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)
