"""The rig behind its drives: drums, elastic cables that only pull, a platform under gravity.

The platform is taken to be in static equilibrium at every moment: at 20 mm/s its inertia is a
matter of millinewtons. Deterministic: the same lengths from the same start give the same pose.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator

import numpy as np

from cdpr.cables import Cables, cables_at
from cdpr.errors import Fault
from cdpr.poses import Array, Pose, matrix_from_rotation_vector, read_only, skew
from cdpr.rig import Rig
from cdpr.scene import Load
from cdpr.statics.gravity import STANDARD_GRAVITY
from cdpr.statics.working import working_tensions
from cdpr.winches import WinchMap

FORCE_TOLERANCE = 1e-7
"""Largest force [N] and moment over the platform's reach [N] left at an equilibrium."""

QUICK_STEPS = 12
MAX_STEPS = 200


class Plant:
    """Platform on elastic cables; `settle` moves it to the equilibrium of given lengths.

    A cable of axial stiffness EA wound off to the unstrained length L0 pulls with
    EA · max(0, (l + d) / L0 − 1), l from outlet to anchor and d from drum to outlet.
    """

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
        self._axial = np.broadcast_to(self.winch_map.stiffness, rig.cable_count)
        self._behind = self.winch_map.behind_outlet
        self._weight, self._centre = _weight(rig, load)
        self._reach = float(np.max(np.linalg.norm(rig.anchors, axis=1)))
        self._on_a_stand = False
        self.miscounted: Array = np.zeros(rig.cable_count)
        """By how much the drives count more than they would had they been referenced, [counts]."""
        self.pose = pose
        tensions = working_tensions(rig, pose, load).tensions
        self._unstrained = self.winch_map.unstrained(cables_at(rig, pose).lengths, tensions)
        self.tensions: Array = read_only(tensions)
        self.settle(self._unstrained)

    def carry(self, load: Load) -> None:
        """Moves the platform to its equilibrium with another load on it.

        Raises:
            Fault: There is none.
        """
        self._weight, self._centre = _weight(self._rig, load)
        self.settle(self._unstrained)

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
        self._unstrained = np.array(unstrained)
        if self._on_a_stand:
            self.tensions = read_only(self._pulled(self.pose)[1])
            self._on_a_stand = bool(self.tensions.min() < self._rig.min_tension)
        if not (self._on_a_stand or (yield from self._settling_quickly())):
            yield from self._settling_anyhow()

    def _settling_quickly(self) -> Generator[None, None, bool]:
        """The quick way: from the cables that pulled before to those that pull in the end.

        Newton's method in which the cables that pull may push as well, and the others do neither:
        on the way a step of the drums may press some of them together. Where it comes to rest with
        one that pushes, or with a slack one that is stretched, it goes on with those that pull
        there. False when it does not come to an end, or ends where the platform is not stable.
        """
        pose, pull = self.pose, self.tensions > 0.0
        for _ in range(QUICK_STEPS):
            yield
            try:
                cables = cables_at(self._rig, pose)
            except ValueError:  # an anchor inside its pulley
                return False
            strain = (cables.lengths + self._behind) / self._unstrained - 1.0
            tensions = np.where(pull, self._axial * strain, 0.0)
            columns = _columns(pose, cables)
            gradient = self._gradient(pose, columns, tensions)
            if self._small(gradient):
                if np.array_equal(pull, strain > 0.0):
                    return self._comes_to_rest(pose, cables, tensions)
                pull = strain > 0.0
                continue
            axial = np.where(pull, self._axial / self._unstrained, 0.0)
            stiffness = self._stiffness(pose, cables, axial, np.maximum(tensions, 0.0))
            try:
                pose = _moved(pose, np.asarray(np.linalg.solve(stiffness, -gradient)))
            except np.linalg.LinAlgError:
                return False
        return False

    def _comes_to_rest(self, pose: Pose, cables: Cables, tensions: Array) -> bool:
        """Takes over an equilibrium, unless the platform would fall or tip from it."""
        taut = np.where(tensions > 0.0, self._axial / self._unstrained, 0.0)
        try:
            np.linalg.cholesky(self._stiffness(pose, cables, taut, tensions))
        except np.linalg.LinAlgError:
            return False
        self.pose, self.tensions = pose, read_only(tensions)
        return True

    def _settling_anyhow(self) -> Iterator[None]:
        """Down the energy, step by step, with cables that only pull."""
        pose = self.pose
        cables, tensions = self._pulled(pose)
        for _ in range(MAX_STEPS):
            yield
            gradient = self._gradient(pose, _columns(pose, cables), tensions)
            if self._small(gradient):
                self.pose, self.tensions = pose, read_only(tensions)
                return
            step = self._newton_step(pose, cables, tensions, gradient)
            pose, cables, tensions = self._descend(pose, gradient, step, tensions)
        raise self._lost(f"no equilibrium after {MAX_STEPS} steps", self._unstrained)

    def energy(self, pose: Pose) -> float:
        """Elastic and potential energy with the platform at a pose, [J]."""
        _, tensions = self._pulled(pose)
        return self._energy(pose, tensions)

    def residual(self, pose: Pose) -> Array:
        """Wrench left over at a pose, about the platform's origin, shape (6,), [N, N·m]."""
        cables, tensions = self._pulled(pose)
        return -self._gradient(pose, _columns(pose, cables), tensions)

    def _pulled(self, pose: Pose) -> tuple[Cables, Array]:
        """The cables at a pose and their tensions, [N]."""
        try:
            cables = cables_at(self._rig, pose)
        except ValueError as error:  # an anchor inside its pulley
            raise self._lost(str(error), self._unstrained) from error
        strain = (cables.lengths + self._behind) / self._unstrained - 1.0
        tensions: Array = self._axial * np.maximum(strain, 0.0)
        return cables, tensions

    def _energy(self, pose: Pose, tensions: Array) -> float:
        elastic = (tensions * tensions) @ (self._unstrained / (2.0 * self._axial))
        height = pose.position[2] + pose.rotation[2] @ self._centre
        return float(elastic + self._weight * height)

    def _gradient(self, pose: Pose, columns: Array, tensions: Array) -> Array:
        """Energy by a twist (translation, rotation in the world): minus the wrench, shape (6,)."""
        gradient: Array = -(tensions @ columns)
        arm_x, arm_y = (pose.rotation @ self._centre)[:2].tolist()
        gradient[2] += self._weight
        gradient[3] += arm_y * self._weight
        gradient[4] -= arm_x * self._weight
        return gradient

    def _small(self, gradient: Array) -> bool:
        largest = max(np.abs(gradient[:3]).max(), np.abs(gradient[3:]).max() / self._reach)
        return bool(largest < FORCE_TOLERANCE)

    def _newton_step(self, pose: Pose, cables: Cables, tensions: Array, gradient: Array) -> Array:
        """A descent direction; damped until the stiffness is positive definite."""
        taut = np.where(tensions > 0.0, self._axial / self._unstrained, 0.0)
        stiffness = self._stiffness(pose, cables, taut, tensions)
        scale = np.array([1.0, 1.0, 1.0, self._reach, self._reach, self._reach])
        damping = 0.0
        while True:
            damped = stiffness + np.diag(damping * scale * scale)
            try:
                np.linalg.cholesky(damped)
            except np.linalg.LinAlgError:
                damping = max(10.0 * damping, 1e-3 * self._weight / self._reach)
                continue
            step = np.asarray(np.linalg.solve(damped, -gradient))
            longest = max(np.abs(step[:3]).max(), np.abs(step[3:]).max() * self._reach)
            shortened: Array = step * min(1.0, self._reach / longest)
            return shortened

    def _stiffness(self, pose: Pose, cables: Cables, axial: Array, tensions: Array) -> Array:
        """Second derivative of the energy by the twist, shape (6, 6).

        Over a pulley the exit moves with the anchor; that part is left out, which costs steps
        and no accuracy, since the equilibrium is decided by the gradient.

        Args:
            pose: ``world_from_platform``.
            cables: The cables there.
            axial: Tension by length of each cable, 0 for a slack one, shape (m,), [N/m].
            tensions: Shape (m,), [N].
        """
        arms = cables.anchors - pose.position
        directions = cables.directions
        columns = _columns(pose, cables)
        straight = np.linalg.norm(cables.exits - cables.anchors, axis=1)
        swing = tensions / straight
        stiffness: Array = (columns.T * (axial - swing)) @ columns
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
        moment[2] -= self._weight * (pose.rotation @ self._centre)
        stiffness[3:, 3:] += np.trace(moment) * np.eye(3) - (moment + moment.T) / 2.0
        return stiffness

    def _descend(
        self, pose: Pose, gradient: Array, step: Array, tensions: Array
    ) -> tuple[Pose, Cables, Array]:
        """The pose after the step, shortened until the energy does not grow."""
        before = self._energy(pose, tensions)
        slack = 1e-12 * (abs(before) + self._weight * self._reach)
        slope = float(gradient @ step)
        share = 1.0
        for _ in range(40):
            moved = _moved(pose, share * step)
            cables, tensions = self._pulled(moved)
            if self._energy(moved, tensions) <= before + 1e-4 * share * slope + slack:
                return moved, cables, tensions
            share /= 2.0
        raise self._lost("the search for the equilibrium is stuck", self._unstrained)

    def _lost(self, what: str, unstrained: Array) -> Fault:
        return Fault(
            f"the simulated platform is lost: {what}",
            where=f"plant of rig {self._rig.name}",
            why="cables were paid out or wound in far from any pose of the platform; lengths "
            + ", ".join(f"{length:.3f}" for length in unstrained)
            + " m",
            next_step="check what the drives were told",
        )


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


def _moved(pose: Pose, step: Array) -> Pose:
    rotation = matrix_from_rotation_vector(step[3:]) @ pose.rotation
    return Pose(pose.position + step[:3], rotation)
