"""The simulated plant: a platform in equilibrium on its cables.

The platform is always in static equilibrium, as inertial forces at 20 mm/s are millinewtons.
Deterministic: the same lengths from the same start give the same pose.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model.errors import Fault
from model.kinematics import Cables, cables_at
from model.pose import Array, Pose, moved, read_only, skew
from model.rig import Rig
from model.scene import Load
from model.statics.gravity import STANDARD_GRAVITY, working_tensions
from model.winches import WinchMap
from simulation.equilibrium.newton import Hanging, hang_still

# A platform on elastic cables that only pull, under gravity: energy and its derivatives.
#
# Pure. Twists are translation, then rotation, in the world frame about the platform's origin.


@dataclass(frozen=True, slots=True, eq=False)
class Suspension:
    """Cables and weight of the platform.

    A cable of axial stiffness EA and unstrained length L0 has the tension
    EA · max(0, (l + d) / L0 − 1), with l from outlet to anchor and d from drum to outlet.

    Attributes:
        rig: The robot.
        axial: EA of each cable, shape (m,), [N].
        behind: d of each cable, shape (m,), [m].
        unstrained: L0 of each cable, shape (m,), [m].
        weight: Of platform and payload, [N].
        centre: Their centre of mass, platform frame, shape (3,), [m].
        hanging: The same for compiled code, except for the lengths.
    """

    rig: Rig
    axial: Array
    behind: Array
    unstrained: Array
    weight: float
    centre: Array
    hanging: Hanging

    @classmethod
    def wound(
        cls, rig: Rig, winch_map: WinchMap, unstrained: Array, load: Load | None
    ) -> Suspension:
        """The rig with cables of given unstrained lengths, shape (m,), [m]."""
        axial = np.broadcast_to(winch_map.stiffness, rig.cable_count)
        behind, (weight, centre) = winch_map.behind_outlet, _weight(rig, load)
        hanging = _for_kernels(rig, axial, behind, weight, centre)
        return cls(rig, axial, behind, unstrained, weight, centre, hanging)

    def with_load(self, load: Load) -> Suspension:
        """A copy with another load."""
        weight, centre = _weight(self.rig, load)
        hanging = _for_kernels(self.rig, self.axial, self.behind, weight, centre)
        return replace(self, weight=weight, centre=centre, hanging=hanging)

    def with_lengths(self, unstrained: Array) -> Suspension:
        """A copy with other unstrained lengths, shape (m,), [m]."""
        return replace(self, unstrained=unstrained)

    def strained(self, pose: Pose) -> tuple[Cables, Array]:
        """The cables at a pose and their strains, negative if slack.

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
        """Derivative of the energy by a twist: minus the wrench, shape (6,), [N, N·m]."""
        gradient: Array = -(tensions @ _columns(pose, cables))
        arm_x, arm_y = (pose.rotation @ self.centre)[:2].tolist()
        gradient[2] += self.weight
        gradient[3] += arm_y * self.weight
        gradient[4] -= arm_x * self.weight
        return gradient

    def rates(self, pulling: NDArray[np.bool_]) -> Array:
        """Stiffness of each taut cable, 0 for the others, shape (m,), [N/m]."""
        return np.where(pulling, self.axial / self.unstrained, 0.0)

    def stiffness(self, pose: Pose, cables: Cables, rates: Array, tensions: Array) -> Array:
        """Second derivative of the energy by the twist, shape (6, 6).

        The motion of a pulley's exit point is neglected, which costs steps but no accuracy, since
        the gradient determines the equilibrium.

        Args:
            pose: ``world_from_platform``.
            rates: Stiffness of each cable, 0 if slack, shape (m,), [N/m].
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
        # Rotation also changes the lever arms of the forces.
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


def _for_kernels(rig: Rig, axial: Array, behind: Array, weight: float, centre: Array) -> Hanging:
    """Writable, contiguous arrays: others would trigger another compilation."""
    return Hanging(
        outlets=np.array(rig.outlets, order="C"),
        feeds=np.array(rig.feed_directions, order="C"),
        radius=float(rig.pulley_radius),
        anchors=np.array(rig.anchors, order="C"),
        axial=np.array(axial),
        behind=np.array(behind),
        weight=float(weight),
        centre=np.array(centre),
    )


def _columns(pose: Pose, cables: Cables) -> Array:
    """Columns of the structure matrix, one per row, shape (m, 6)."""
    arms = cables.anchors - pose.position
    return np.concatenate([cables.directions, _cross(arms, cables.directions)], axis=1)


def _cross(a: Array, b: Array) -> Array:
    """Cross products of rows, shape (m, 3); for few rows faster than `numpy.cross`."""
    x, y, z = a[:, 0], a[:, 1], a[:, 2]
    u, v, w = b[:, 0], b[:, 1], b[:, 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)


FORCE_TOLERANCE = 1e-7
"""Largest residual force [N] and moment over the platform's reach [N] at an equilibrium."""

ROUND_OFF = 1e-14
"""The same as a share of the largest E·A, where that is more: the round-off of lengths."""

QUICK_STEPS = 12
"""Steps of Newton's method; it usually takes three, with pulleys more."""

MAX_STEPS = 200


class Plant:
    """Platform on elastic cables; `settle` moves it to the equilibrium of given lengths."""

    def __init__(
        self, rig: Rig, pose: Pose, load: Load | None = None, stiffness: Array | None = None
    ) -> None:
        """Sets the platform at a pose under its working tensions.

        Args:
            rig: The robot.
            pose: ``world_from_platform``.
            load: Payload of the platform.
            stiffness: E·A of each cable if different from the rig file, shape (m,), [N].

        Raises:
            TensionInfeasible: The cables cannot hold the platform there.
        """
        self._rig = rig
        self.winch_map = WinchMap(rig, stiffness)
        self._tolerance = max(FORCE_TOLERANCE, ROUND_OFF * float(np.max(self.winch_map.stiffness)))
        self._reach = float(np.max(np.linalg.norm(rig.anchors, axis=1)))
        self._is_supported = False
        self.miscounted: Array = np.zeros(rig.cable_count)
        """Offset of the drives' counts from correctly referenced ones, [counts]."""
        self.pose = pose
        tensions = working_tensions(rig, pose, load).tensions
        unstrained = self.winch_map.unstrained(cables_at(rig, pose).lengths, tensions)
        self._suspension = Suspension.wound(rig, self.winch_map, unstrained, load)
        self.tensions: Array = read_only(tensions)
        self.settle(unstrained)

    def carry(self, load: Load) -> None:
        """Moves the platform to its equilibrium with another load.

        Raises:
            Fault: There is no equilibrium.
        """
        self._suspension = self._suspension.with_load(load)
        self.settle(self._suspension.unstrained)

    def support(self) -> None:
        """Supports the platform at its present pose until every cable is taut.

        Then the support is removed, and the platform hangs on its cables.
        """
        self._is_supported = True

    @property
    def stretch(self) -> Array:
        """By how much each whole cable is longer than unstrained, shape (m,), [m]; 0 if slack."""
        return self.tensions * self._suspension.unstrained / self.winch_map.stiffness

    def settle_counts(self, counts: Array) -> None:
        """`settle` at drive positions, shape (m,), [counts]."""
        for _ in self.settling_counts(counts):
            pass

    def settling_counts(self, counts: Array) -> Iterator[None]:
        """`settling` at drive positions, shape (m,), [counts]."""
        return self.settling(self.winch_map.unstrained_from_counts(counts - self.miscounted))

    def settle(self, unstrained: Array) -> None:
        """Moves the platform to its equilibrium; the search starts at the present pose.

        Args:
            unstrained: Unstrained lengths of the whole cables, shape (m,), [m].

        Raises:
            Fault: No equilibrium is found: the cables do not hold the platform, or a length is
                absurd.
        """
        for _ in self.settling(unstrained):
            pass

    def settling(self, unstrained: Array) -> Iterator[None]:
        """`settle` step by step, to allow other work in between; argument as there.

        Pose and tensions change only at the last step.

        Raises:
            Fault: See `settle`.
        """
        if not (np.isfinite(unstrained).all() and (unstrained > 0.0).all()):
            raise self._lost("an unstrained length is not a positive number", unstrained)
        self._suspension = self._suspension.with_lengths(np.array(unstrained))
        if self._is_supported:
            self.tensions = read_only(self._pulled(self.pose)[1])
            self._is_supported = bool(self.tensions.min() < self._rig.min_tension)
        yield
        if not (self._is_supported or self._settles_quickly()):
            yield from self._settling_robustly()

    def _settles_quickly(self) -> bool:
        """Newton's method from the present pose; False if it fails. See `newton.hang_still`."""
        hung = self._suspension
        position, rotation = np.array(self.pose.position), np.array(self.pose.rotation, order="C")
        tensions = np.array(self.tensions)
        found = hang_still(
            hung.hanging,
            hung.unstrained,
            position,
            rotation,
            tensions,
            self._reach,
            self._tolerance,
            QUICK_STEPS,
        )
        if found:
            self.pose, self.tensions = Pose(position, rotation), read_only(tensions)
        return bool(found)

    def _settling_robustly(self) -> Iterator[None]:
        """Damped descent of the energy, with cables that only pull."""
        pose = self.pose
        cables, tensions = self._pulled(pose)
        for _ in range(MAX_STEPS):
            yield
            gradient = self._suspension.gradient(pose, cables, tensions)
            if self._small(gradient):
                self.pose, self.tensions = pose, read_only(tensions)
                return
            step = self._newton_step(pose, cables, tensions, gradient)
            pose, cables, tensions = self._descend(pose, gradient, step, tensions)
        raise self._lost(f"no equilibrium after {MAX_STEPS} steps", self._suspension.unstrained)

    def energy(self, pose: Pose) -> float:
        """Elastic and potential energy with the platform at a pose, [J]."""
        _, tensions = self._pulled(pose)
        return self._suspension.energy(pose, tensions)

    def residual(self, pose: Pose) -> Array:
        """Residual wrench at a pose, about the platform's origin, shape (6,), [N, N·m]."""
        cables, tensions = self._pulled(pose)
        return -self._suspension.gradient(pose, cables, tensions)

    def _pulled(self, pose: Pose) -> tuple[Cables, Array]:
        """The cables at a pose and their tensions, [N]."""
        try:
            return self._suspension.pulled(pose)
        except ValueError as error:  # an anchor inside its pulley
            raise self._lost(str(error), self._suspension.unstrained) from error

    def _small(self, gradient: Array) -> bool:
        largest = max(np.abs(gradient[:3]).max(), np.abs(gradient[3:]).max() / self._reach)
        return bool(largest < self._tolerance)

    def _newton_step(self, pose: Pose, cables: Cables, tensions: Array, gradient: Array) -> Array:
        """A descent direction; damped until the stiffness is positive definite."""
        rates = self._suspension.rates(tensions > 0.0)
        stiffness = self._suspension.stiffness(pose, cables, rates, tensions)
        scale = np.array([1.0, 1.0, 1.0, self._reach, self._reach, self._reach])
        damping = 0.0
        while True:
            damped = stiffness + np.diag(damping * scale * scale)
            try:
                np.linalg.cholesky(damped)
            except np.linalg.LinAlgError:
                damping = max(10.0 * damping, 1e-3 * self._suspension.weight / self._reach)
                continue
            step = np.asarray(np.linalg.solve(damped, -gradient))
            longest = max(np.abs(step[:3]).max(), np.abs(step[3:]).max() * self._reach)
            shortened: Array = step * min(1.0, self._reach / longest)
            return shortened

    def _descend(
        self, pose: Pose, gradient: Array, step: Array, tensions: Array
    ) -> tuple[Pose, Cables, Array]:
        """The pose after the step, shortened until the energy decreases."""
        before = self._suspension.energy(pose, tensions)
        slack = 1e-12 * (abs(before) + self._suspension.weight * self._reach)
        slope = float(gradient @ step)
        share = 1.0
        for _ in range(40):
            trial = moved(pose, share * step)
            cables, tensions = self._pulled(trial)
            if self._suspension.energy(trial, tensions) <= before + 1e-4 * share * slope + slack:
                return trial, cables, tensions
            share /= 2.0
        raise self._lost(
            "the search for the equilibrium does not converge", self._suspension.unstrained
        )

    def _lost(self, what: str, unstrained: Array) -> Fault:
        return Fault(
            f"the simulation failed: {what}",
            where=f"plant of rig {self._rig.name}",
            why="no platform pose fits the commanded cable lengths: "
            + ", ".join(f"{length:.3f}" for length in unstrained)
            + " m",
            next_step="check the commands sent to the drives",
        )


def load_kernels() -> None:
    """Loads or compiles the machine code of the search, so that no drive waits for it."""
    point, one = np.zeros((1, 3)), np.ones(1)
    hanging = Hanging(point, point, 0.0, point, one, one, 1.0, np.zeros(3))
    hang_still(hanging, one, np.zeros(3), np.eye(3), np.ones(1), 1.0, FORCE_TOLERANCE, 0)
