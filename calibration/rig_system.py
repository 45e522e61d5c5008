"""The normal equations of a rig's fit, place by place, with the places' poses eliminated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cdpr.poses import Array


@dataclass(frozen=True, slots=True, eq=False)
class System:
    """The equations of n places for r unknowns.

    Attributes:
        own: Of the unknowns, shape (n, r, r).
        prior: How far the unknowns are from the rig file, shape (r,): of all places together.
        mixed: Of unknowns and pose, shape (n, r, 6).
        poses: Of the pose, shape (n, 6, 6).
        pull: Half the slope of the squares by the unknowns, shape (n, r).
        pose_pull: Half the slope by the pose, shape (n, 6).
    """

    own: Array
    prior: Array
    mixed: Array
    poses: Array
    pull: Array
    pose_pull: Array

    def by_place(self, damping: float = 0.0) -> tuple[Array, Array]:
        """What each place says of the unknowns with its pose eliminated.

        Returns:
            Information, shape (n, r, r), and half the slope of the squares, shape (n, r).
        """
        poses = self._poses(damping)
        gained = np.linalg.solve(poses, np.swapaxes(self.mixed, 1, 2))
        alone = np.asarray(np.linalg.solve(poses, self.pose_pull[..., None]))
        reduced = self.own - self.mixed @ gained
        symmetric: Array = (reduced + np.swapaxes(reduced, 1, 2)) / 2.0
        slopes: Array = self.pull - (self.mixed @ alone)[..., 0]
        return symmetric, slopes

    def solved(self, damping: float) -> tuple[Array, Array]:
        """Steps of the unknowns, shape (r,), and twists of the poses, shape (n, 6)."""
        informations, slopes = self.by_place(damping)
        right = self.prior + slopes.sum(axis=0)
        left = informations.sum(axis=0) + (1.0 + damping) * np.eye(len(right))
        step: Array = -np.linalg.solve(left, right)
        moved = self.pose_pull + np.swapaxes(self.mixed, 1, 2) @ step
        twists = -np.asarray(np.linalg.solve(self._poses(damping), moved[..., None]))[..., 0]
        return step, twists

    def _poses(self, damping: float) -> Array:
        diagonal = np.einsum("nii->ni", self.poses)
        damped: Array = self.poses + damping * diagonal[:, None, :] * np.eye(6)
        return damped
