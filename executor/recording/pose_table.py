"""What the cameras measured during a run: a row an image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np

from executor.recording.csv_columns import (
    Column,
    Integers,
    TableFile,
    integers,
    numbers,
    require_equal_lengths,
    texts,
    write_table,
)
from executor.recording.cycle_table import CycleTable
from model.pose import Array, Pose
from tracking.fusion import Measured, fused
from tracking.pose_log import POSE_COLUMNS

_POSE_MM, _DEG = 1e3, float(np.degrees(1.0))
_SCALES = np.array([_POSE_MM, _POSE_MM, _POSE_MM, _DEG, _DEG, _DEG])
_PAIRS = tuple(combinations_with_replacement(range(6), 2))
#: As `cdpr track` names them: ``std_x_mm`` …, ``cov_x_rz_mm_deg`` … in the order of the pairs.
_STD = tuple(name for name in POSE_COLUMNS if name.startswith("std_"))
_COVARIANCE = dict(
    zip(_PAIRS, (name for name in POSE_COLUMNS if name.startswith("cov_")), strict=True)
)
OK = "ok"


@dataclass(frozen=True, slots=True, eq=False)
class PoseTable:
    """Measured poses of n images; NaN where an image gave no pose.

    Attributes:
        frame: Number of the image, shape (n,).
        time: Since the start of the run, shape (n,), [s].
        status: ``ok``, or why there is no pose, n texts.
        position: Of the platform in the world, shape (n, 3), [m].
        rotation: ``world_from_platform`` as unit quaternions (w, x, y, z), shape (n, 4).
        covariance: Of position and rotation vector about world axes, shape (n, 6, 6), [m, rad].
        tags: Numbers of the tags that were used, n texts such as ``301 303``.
        reprojection: RMS of the corners, shape (n,), [px].
        planned: Commanded position at that time, shape (n, 3), [m].
        picture: Name of the kept image inside the run folder, or nothing, n texts.
    """

    frame: Integers
    time: Array
    status: tuple[str, ...]
    position: Array
    rotation: Array
    covariance: Array
    tags: tuple[str, ...]
    reprojection: Array
    planned: Array
    picture: tuple[str, ...]

    def __post_init__(self) -> None:
        """See `_require_equal_lengths`."""
        require_equal_lengths(self)

    def __len__(self) -> int:
        return len(self.time)

    @property
    def ok(self) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Which images gave a pose, shape (n,)."""
        return np.array([status == OK for status in self.status], dtype=bool)

    @property
    def error(self) -> Array:
        """Distance of the measured from the planned position, shape (n,), [m]; NaN without pose."""
        error: Array = np.linalg.norm(self.position - self.planned, axis=1)
        return error

    @property
    def std(self) -> Array:
        """Standard deviations of position and rotation, shape (n, 6), [m] and [rad]."""
        deviations: Array = np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))
        return deviations

    def write_csv(self, path: Path) -> None:
        """Writes ``poses.csv``.

        Raises:
            BadInput: The folder cannot be written to.
        """
        std = self.std * _SCALES
        columns = [
            integers("frame", self.frame),
            numbers("time_s", self.time),
            texts("status", self.status),
            *_side_by_side([f"{axis}_mm" for axis in "xyz"], self.position * _POSE_MM),
            *_side_by_side([f"q{axis}" for axis in "wxyz"], self.rotation, decimals=9),
            *_side_by_side(_STD, std),
            *(_covariance(self.covariance, pair) for pair in _PAIRS),
            texts("tags", self.tags),
            numbers("reprojection_px", self.reprojection, decimals=4),
            *_side_by_side([f"planned_{axis}_mm" for axis in "xyz"], self.planned * _POSE_MM),
            texts("picture", self.picture),
        ]
        write_table(path, columns)

    @classmethod
    def read_csv(cls, path: Path) -> PoseTable:
        """Reads ``poses.csv``.

        Raises:
            BadInput: The file is missing, cut short or has other columns.
        """
        table = TableFile(path)
        time = table.floats("time_s")
        covariance = np.empty((len(time), 6, 6))
        for i, j in _PAIRS:
            entry = table.floats(_COVARIANCE[i, j], float(_SCALES[i] * _SCALES[j]))
            covariance[:, i, j] = covariance[:, j, i] = entry
        return cls(
            frame=table.ints("frame"),
            time=time,
            status=table.texts("status"),
            position=table.matrix([f"{axis}_mm" for axis in "xyz"], _POSE_MM),
            rotation=table.matrix([f"q{axis}" for axis in "wxyz"]),
            covariance=covariance,
            tags=table.texts("tags"),
            reprojection=table.floats("reprojection_px"),
            planned=table.matrix([f"planned_{axis}_mm" for axis in "xyz"], _POSE_MM),
            picture=table.texts("picture"),
        )


def _side_by_side(names: Sequence[str], values: Array, decimals: int = 6) -> list[Column]:
    return [numbers(n, values[:, i], decimals=decimals) for i, n in enumerate(names)]


def _covariance(covariance: Array, pair: tuple[int, int]) -> Column:
    i, j = pair
    scale = float(_SCALES[i] * _SCALES[j])
    return Column(_COVARIANCE[i, j], covariance[:, i, j] * scale, "%.6e")


def no_poses() -> PoseTable:
    """A table without rows, of a run without a camera."""
    return PoseTable(
        frame=np.empty(0, dtype=np.int64),
        time=np.empty(0),
        status=(),
        position=np.empty((0, 3)),
        rotation=np.empty((0, 4)),
        covariance=np.empty((0, 6, 6)),
        tags=(),
        reprojection=np.empty(0),
        planned=np.empty((0, 3)),
        picture=(),
    )


# The platform's pose from drives and camera together: a row a cycle, from the first image on.


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
                *(numbers(f"{a}_mm", self.position[:, i], _POSE_MM) for i, a in enumerate("xyz")),
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
