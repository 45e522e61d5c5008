"""The platform's pose from drives and camera together: a row a cycle, from the first image on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from executor.recording.csv_columns import numbers, write_table
from executor.recording.cycle_table import CycleTable
from executor.recording.pose_table import PoseTable
from model.pose import Array, Pose
from tracking.encoder_fusion import Measured, fused
from tracking.pose_log import POSE_COLUMNS

_MM, _DEG = 1e3, float(np.degrees(1.0))
_SCALES = (_MM, _MM, _MM, _DEG, _DEG, _DEG)
_STD = tuple(name for name in POSE_COLUMNS if name.startswith("std_"))


@dataclass(frozen=True, slots=True, eq=False)
class FusedTable:
    """Fused poses of n cycles.

    Attributes:
        time: Since the start of the run, shape (n,), [s].
        position: Of the platform in the world, shape (n, 3), [m].
        rotation: ``world_from_platform`` as unit quaternions (w, x, y, z), shape (n, 4).
        std: Standard deviations of position and rotation vector, shape (n, 6), [m] and [rad].
        age: Time since the last image that was used, shape (n,), [s].
    """

    time: Array
    position: Array
    rotation: Array
    std: Array
    age: Array

    def __len__(self) -> int:
        return len(self.time)

    def write_csv(self, path: Path) -> None:
        """Writes ``fused.csv``.

        Raises:
            BadInput: The folder cannot be written to.
        """
        write_table(
            path,
            [
                numbers("time_s", self.time),
                *(numbers(f"{a}_mm", self.position[:, i], _MM) for i, a in enumerate("xyz")),
                *(numbers(f"q{a}", self.rotation[:, i], decimals=9) for i, a in enumerate("wxyz")),
                *(numbers(name, self.std[:, i], _SCALES[i]) for i, name in enumerate(_STD)),
                numbers("age_s", self.age),
            ],
        )


def fused_table(cycles: CycleTable, poses: PoseTable) -> FusedTable:
    """The drives' poses of a run, moved to where its images show the platform."""
    known = np.isfinite(cycles.encoder).all(axis=1) & np.isfinite(cycles.encoder_rotation).all(
        axis=1
    )
    pairs = zip(cycles.encoder[known], cycles.encoder_rotation[known], strict=True)
    by_drives = [Pose.from_quaternion(position, rotation) for position, rotation in pairs]
    measured = [
        Measured(
            float(poses.time[i]),
            Pose.from_quaternion(poses.position[i], poses.rotation[i]),
            poses.covariance[i],
        )
        for i in np.flatnonzero(poses.ok)
    ]
    rows = list(fused(cycles.time[known].tolist(), by_drives, measured))
    covariances = np.array([row.covariance for row in rows]).reshape(-1, 6, 6)
    return FusedTable(
        time=np.array([row.time for row in rows]),
        position=np.array([row.pose.position for row in rows]).reshape(-1, 3),
        rotation=np.array([row.pose.quaternion for row in rows]).reshape(-1, 4),
        std=np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)),
        age=np.array([row.age for row in rows]),
    )
