"""The rig behind its drives: a platform that hangs where its drums and cables let it.

The platform is taken to be in static equilibrium at every moment: at 20 mm/s its inertia is a
matter of millinewtons. Deterministic: the same lengths from the same start give the same pose.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model.errors import Fault
from model.kinematics import Cables, cables_at
from model.pose import Array, Pose, matrix_from_rotation_vector, read_only, skew
from model.rig import Rig
from model.scene import Load
from model.statics.gravity import STANDARD_GRAVITY, working_tensions
from model.winches import WinchMap
from simulation.equilibrium.hanging import Hanging
from simulation.equilibrium.newton import hang_still

# A platform on elastic cables that only pull, under gravity: its energy and what follows of it.
#
# Pure. Twists are a translation, then a rotation, both in the world and about the platform's
# origin.


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
        hanging: The same for compiled code, without the lengths.
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
        """The rig with its cables wound off to given lengths, shape (m,), [m]."""
        axial = np.broadcast_to(winch_map.stiffness, rig.cable_count)
        behind, (weight, centre) = winch_map.behind_outlet, _weight(rig, load)
        hanging = _for_kernels(rig, axial, behind, weight, centre)
        return cls(rig, axial, behind, unstrained, weight, centre, hanging)

    def with_load(self, load: Load) -> Suspension:
        """The same with another load on the platform."""
        weight, centre = _weight(self.rig, load)
        hanging = _for_kernels(self.rig, self.axial, self.behind, weight, centre)
        return replace(self, weight=weight, centre=centre, hanging=hanging)

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


def _for_kernels(rig: Rig, axial: Array, behind: Array, weight: float, centre: Array) -> Hanging:
    """Arrays that may be written to and lie in one piece: for others, code is compiled again."""
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
    """Columns of the structure matrix, one a row, shape (m, 6)."""
    arms = cables.anchors - pose.position
    return np.concatenate([cables.directions, _cross(arms, cables.directions)], axis=1)


def _cross(a: Array, b: Array) -> Array:
    """Rows' cross products, shape (m, 3); for a few rows faster than `numpy.cross`."""
    x, y, z = a[:, 0], a[:, 1], a[:, 2]
    u, v, w = b[:, 0], b[:, 1], b[:, 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)


FORCE_TOLERANCE = 1e-7
"""Largest force [N] and moment over the platform's reach [N] left at an equilibrium."""

QUICK_STEPS = 12
"""Of Newton's method, from where the platform is; it takes three as a rule, over pulleys more."""

MAX_STEPS = 200


class Plant:
    """Platform on elastic cables; `settle` moves it to the equilibrium of given lengths."""

    def __init__(
        self, rig: Rig, pose: Pose, load: Load | None = None, stiffness: Array | None = None
    ) -> None:
        """Puts the platform at a pose under its working tensions.

        Args:
            rig: The robot.
            pose: ``world_from_platform``.
            load: What the platform carries.
            stiffness: E·A of each cable where they differ, shape (m,), [N].

        Raises:
            TensionInfeasible: The cables cannot hold the platform there.
        """
        self._rig = rig
        self.winch_map = WinchMap(rig, stiffness)
        self._reach = float(np.max(np.linalg.norm(rig.anchors, axis=1)))
        self._on_a_stand = False
        self.miscounted: Array = np.zeros(rig.cable_count)
        """By how much the drives count more than they would had they been referenced, [counts]."""
        self.pose = pose
        tensions = working_tensions(rig, pose, load).tensions
        unstrained = self.winch_map.unstrained(cables_at(rig, pose).lengths, tensions)
        self._suspension = Suspension.wound(rig, self.winch_map, unstrained, load)
        self.tensions: Array = read_only(tensions)
        self.settle(unstrained)

    def carry(self, load: Load) -> None:
        """Moves the platform to its equilibrium with another load on it.

        Raises:
            Fault: There is none.
        """
        self._suspension = self._suspension.with_load(load)
        self.settle(self._suspension.unstrained)

    def put_on_a_stand(self) -> None:
        """A stand keeps the platform where it is, until somebody sees every cable taut.

        Then the stand is taken away, and the platform hangs on its cables again.
        """
        self._on_a_stand = True

    def counts_for(self, pose: Pose, tensions: Array) -> Array:
        """Drive positions that hold a pose with given tensions, not rounded, shape (m,).

        Args:
            pose: ``world_from_platform``.
            tensions: Shape (m,), [N]; in equilibrium there, or the platform will settle elsewhere.
        """
        lengths = cables_at(self._rig, pose).lengths
        return self.winch_map.counts(self.winch_map.unstrained(lengths, tensions))

    def settle_counts(self, counts: Array) -> None:
        """`settle` at drive positions, shape (m,), [counts]."""
        for _ in self.settling_counts(counts):
            pass

    def settling_counts(self, counts: Array) -> Iterator[None]:
        """`settling` at drive positions, shape (m,), [counts]."""
        return self.settling(self.winch_map.unstrained_from_counts(counts - self.miscounted))

    def settle(self, unstrained: Array) -> None:
        """Moves the platform to its equilibrium; the search starts where it is.

        Args:
            unstrained: Unstrained lengths of the whole cables, shape (m,), [m].

        Raises:
            Fault: No equilibrium is found: the platform hangs on nothing, or a length is absurd.
        """
        for _ in self.settling(unstrained):
            pass

    def settling(self, unstrained: Array) -> Iterator[None]:
        """`settle` step by step, for who has something else to do meanwhile; argument as there.

        Pose and tensions are as before until the last step.

        Raises:
            Fault: See `settle`.
        """
        if not (np.isfinite(unstrained).all() and (unstrained > 0.0).all()):
            raise self._lost("an unstrained length is not a positive number", unstrained)
        self._suspension = self._suspension.with_lengths(np.array(unstrained))
        if self._on_a_stand:
            self.tensions = read_only(self._pulled(self.pose)[1])
            self._on_a_stand = bool(self.tensions.min() < self._rig.min_tension)
        yield
        if not (self._on_a_stand or self._settles_quickly()):
            yield from self._settling_anyhow()

    def _settles_quickly(self) -> bool:
        """Newton's method from here; False when it finds nothing. See `newton.hang_still`."""
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
            FORCE_TOLERANCE,
            QUICK_STEPS,
        )
        if found:
            self.pose, self.tensions = Pose(position, rotation), read_only(tensions)
        return bool(found)

    def _settling_anyhow(self) -> Iterator[None]:
        """Down the energy, step by step, with cables that only pull."""
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
        """Wrench left over at a pose, about the platform's origin, shape (6,), [N, N·m]."""
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
        return bool(largest < FORCE_TOLERANCE)

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
        """The pose after the step, shortened until the energy does not grow."""
        before = self._suspension.energy(pose, tensions)
        slack = 1e-12 * (abs(before) + self._suspension.weight * self._reach)
        slope = float(gradient @ step)
        share = 1.0
        for _ in range(40):
            moved = _moved(pose, share * step)
            cables, tensions = self._pulled(moved)
            if self._suspension.energy(moved, tensions) <= before + 1e-4 * share * slope + slack:
                return moved, cables, tensions
            share /= 2.0
        raise self._lost(
            "the search for the equilibrium does not converge", self._suspension.unstrained
        )

    def _lost(self, what: str, unstrained: Array) -> Fault:
        return Fault(
            f"the simulation failed: {what}",
            where=f"plant of rig {self._rig.name}",
            why="cables were paid out or wound in far from any pose of the platform; lengths "
            + ", ".join(f"{length:.3f}" for length in unstrained)
            + " m",
            next_step="check the commands sent to the drives",
        )


def load_kernels() -> None:
    """Loads the machine code of the search, or compiles it, so that no drive waits for it."""
    point, one = np.zeros((1, 3)), np.ones(1)
    hanging = Hanging(point, point, 0.0, point, one, one, 1.0, np.zeros(3))
    hang_still(hanging, one, np.zeros(3), np.eye(3), np.ones(1), 1.0, FORCE_TOLERANCE, 0)


def _moved(pose: Pose, step: Array) -> Pose:
    rotation = matrix_from_rotation_vector(step[3:]) @ pose.rotation
    return Pose(pose.position + step[:3], rotation)
