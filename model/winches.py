"""From cable lengths to drive counts and back: elastic cables on drums.

A cable of axial stiffness EA, unwound to the unstrained length L0 and under the tension t, is
L0 (1 + t / EA) long; that length is the free cable from outlet to anchor plus the part between drum
and outlet. Counts are referenced at home: with the platform at the home pose under the working
tensions, each drive is at its ``home_counts``.
"""

from __future__ import annotations

import numpy as np

from model.kinematics import cable_lengths
from model.pose import Array, Pose, read_only
from model.rig import Rig
from model.scene import Load
from model.statics.gravity import working_tensions


class WinchMap:
    """Unstrained cable lengths, strained lengths and drive counts of one rig."""

    def __init__(self, rig: Rig, stiffness: Array | None = None) -> None:
        """Computes the reference at home.

        Args:
            rig: The robot.
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
