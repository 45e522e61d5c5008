"""The rig behind its drives: a platform that hangs where its drums and cables let it.

The platform is taken to be in static equilibrium at every moment: at 20 mm/s its inertia is a
matter of millinewtons. Deterministic: the same lengths from the same start give the same pose.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator

import numpy as np

from cdpr.cables import Cables, cables_at
from cdpr.errors import Fault
from cdpr.poses import Array, Pose, matrix_from_rotation_vector, read_only
from cdpr.rig import Rig
from cdpr.scene import Load
from cdpr.statics.working import working_tensions
from cdpr.winches import WinchMap
from simulation.suspension import Suspension

FORCE_TOLERANCE = 1e-7
"""Largest force [N] and moment over the platform's reach [N] left at an equilibrium."""

QUICK_STEPS = 12
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
            hung = self._suspension
            try:
                cables, strain = hung.strained(pose)
            except ValueError:  # an anchor inside its pulley
                return False
            tensions = np.where(pull, hung.axial * strain, 0.0)
            gradient = hung.gradient(pose, cables, tensions)
            if self._small(gradient):
                if np.array_equal(pull, strain > 0.0):
                    return self._comes_to_rest(pose, cables, tensions)
                pull = strain > 0.0
                continue
            without_push = np.maximum(tensions, 0.0)
            stiffness = hung.stiffness(pose, cables, hung.rates(pull), without_push)
            try:
                pose = _moved(pose, np.asarray(np.linalg.solve(stiffness, -gradient)))
            except np.linalg.LinAlgError:
                return False
        return False

    def _comes_to_rest(self, pose: Pose, cables: Cables, tensions: Array) -> bool:
        """Takes over an equilibrium, unless the platform would fall or tip from it."""
        rates = self._suspension.rates(tensions > 0.0)
        try:
            np.linalg.cholesky(self._suspension.stiffness(pose, cables, rates, tensions))
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
        raise self._lost("the search for the equilibrium is stuck", self._suspension.unstrained)

    def _lost(self, what: str, unstrained: Array) -> Fault:
        return Fault(
            f"the simulated platform is lost: {what}",
            where=f"plant of rig {self._rig.name}",
            why="cables were paid out or wound in far from any pose of the platform; lengths "
            + ", ".join(f"{length:.3f}" for length in unstrained)
            + " m",
            next_step="check what the drives were told",
        )


def _moved(pose: Pose, step: Array) -> Pose:
    rotation = matrix_from_rotation_vector(step[3:]) @ pose.rotation
    return Pose(pose.position + step[:3], rotation)
