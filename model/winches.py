"""From cable lengths to drive counts and back: elastic cables on drums.

A cable of axial stiffness EA, unwound to the unstrained length L0 and under the tension t, is
L0 (1 + t / EA) long; that length is the free cable from outlet to anchor plus the part between drum
and outlet. Counts are referenced at home: with the platform at the home pose under the working
tensions, each drive is at its ``home_counts``.
"""

from __future__ import annotations

import numpy as np

from model.errors import Fault
from model.kinematics import (
    NoCable,
    cable_lengths,
    cables_at,
    forward_kinematics,
    step_scale,
    structure_matrix_of,
)
from model.pose import Array, Pose, moved, read_only
from model.rig import Rig
from model.scene import Load
from model.statics.gravity import weight_wrench, working_tensions

#: Steps of the search for an equilibrium, largest last step [m], and step of its differences [m].
_STEPS, _SETTLED, _DIFFERENCE = 60, 1e-9, 1e-6


def whole_lengths(rig: Rig, lengths: Array) -> Array:
    """Lengths of cables from drum to anchor, shape (..., m), [m].

    Args:
        lengths: From outlet to anchor, shape (..., m), [m].
    """
    return np.asarray(lengths + [winch.drum_to_outlet for winch in rig.winches])


class WinchMap:
    """Unstrained cable lengths, strained lengths and drive counts of one rig."""

    def __init__(self, rig: Rig, stiffness: Array | None = None) -> None:
        """Computes the reference at home.

        Args:
            stiffness: E·A of each cable, shape (m,), [N]; the rig file's when left out.

        Raises:
            TensionInfeasible: The rig cannot hold its platform at home.
        """
        self._rig = rig
        self.stiffness: Array = rig.cable_stiffness if stiffness is None else stiffness
        self.behind_outlet = read_only([w.drum_to_outlet for w in rig.winches])
        self.counts_per_metre = read_only([w.counts_per_metre for w in rig.winches])
        self.home_counts = read_only([w.home_counts for w in rig.winches])
        tensions = working_tensions(rig, rig.home).tensions
        self.home_unstrained = read_only(self.unstrained(cable_lengths(rig, rig.home), tensions))

    def unstrained(self, lengths: Array, tensions: Array) -> Array:
        """Unstrained lengths of whole cables, shape (..., m), [m].

        Args:
            lengths: From outlet to anchor, shape (..., m), [m].
            tensions: Shape (..., m), [N].
        """
        whole: Array = (lengths + self.behind_outlet) / (1.0 + tensions / self.stiffness)
        return whole

    def strained(self, unstrained: Array, tensions: Array) -> Array:
        """Lengths from outlet to anchor, shape (..., m), [m]; the inverse of `unstrained`."""
        lengths: Array = unstrained * (1.0 + tensions / self.stiffness) - self.behind_outlet
        return lengths

    def counts(self, unstrained: Array) -> Array:
        """Drive positions, not yet rounded, shape (..., m), [counts]."""
        paid_out = unstrained - self.home_unstrained
        counts: Array = self.home_counts + self.counts_per_metre * paid_out
        return counts

    def counts_at(self, pose: Pose, load: Load | None = None) -> Array:
        """Rounded drive positions at a pose under the working tensions, shape (m,), [counts].

        Raises:
            TensionInfeasible: The cables cannot hold the weight at this pose.
        """
        tensions = working_tensions(self._rig, pose, load).tensions
        lengths = cable_lengths(self._rig, pose)
        return np.asarray(np.rint(self.counts(self.unstrained(lengths, tensions))))

    def unstrained_from_counts(self, counts: Array) -> Array:
        """Unstrained lengths of whole cables at drive positions, shape (..., m), [m]."""
        paid_out = (np.asarray(counts, dtype=np.float64) - self.home_counts) / self.counts_per_metre
        unstrained: Array = self.home_unstrained + paid_out
        return unstrained

    def tensions(self, unstrained: Array, lengths: Array) -> Array:
        """Tensions of cables stretched to these lengths, shape (m,), [N]; 0 for slack cables.

        Args:
            unstrained: Of whole cables, shape (m,), [m].
            lengths: From outlet to anchor, shape (m,), [m].
        """
        strain = (lengths + self.behind_outlet) / unstrained - 1.0
        pull: Array = np.maximum(0.0, self.stiffness * strain)
        return pull

    def equilibrium(self, unstrained: Array, load: Load | None = None) -> Pose:
        """The pose at which elastic cables of these lengths hold the platform at rest.

        Newton's method on the wrench balance, from the pose that the working tensions at home give;
        derivatives by differences.

        Args:
            unstrained: Of whole cables, shape (m,), [m].
            load: Payload; none when left out.

        Returns:
            ``world_from_platform``.

        Raises:
            Fault: No equilibrium was found.
        """
        tensions = working_tensions(self._rig, self._rig.home).tensions
        pose = forward_kinematics(self._rig, self.strained(unstrained, tensions)).pose
        scale = step_scale(self._rig)
        balance = self._balance(pose, unstrained, load)
        for _ in range(_STEPS):
            columns = [
                self._balance(moved(pose, scale * unit), unstrained, load) - balance
                for unit in _DIFFERENCE * np.eye(6)
            ]
            try:
                step = np.linalg.solve(np.array(columns).T / _DIFFERENCE, -balance)
            except np.linalg.LinAlgError:  # with slack cables
                break
            if not np.isfinite(step).all():  # an anchor has entered a pulley
                break
            while np.linalg.norm(step) >= _SETTLED:
                trial = moved(pose, scale * step)
                found = self._balance(trial, unstrained, load)
                if np.linalg.norm(found) < np.linalg.norm(balance):
                    pose, balance = trial, found
                    break
                step = step / 2.0
            else:
                return pose
        raise Fault(
            "the platform has no equilibrium at these cable lengths",
            where="drive positions",
            why="the homing reference is lost, a cable slipped, or the rig file is wrong",
            next_step="home the drives at a known pose; nothing was moved",
        )

    def _balance(self, pose: Pose, unstrained: Array, load: Load | None) -> Array:
        """Wrench on the platform, moments over the anchors' radius, shape (6,), [N]; or NaN."""
        try:
            cables = cables_at(self._rig, pose)
        except NoCable:
            return np.full(6, np.nan)
        pull = self.tensions(unstrained, cables.lengths)
        wrench = structure_matrix_of(cables, pose.position) @ pull
        balance: Array = step_scale(self._rig) * (wrench + weight_wrench(self._rig, pose, load))
        return balance
