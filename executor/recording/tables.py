"""Tables of a run: one row per cycle of the loop, one row per image of the cameras."""

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
    header,
    integers,
    numbers,
    require_equal_lengths,
    rows,
    texts,
    write_table,
)
from executor.state_machine import ON_PATH
from model.pose import Array, Pose, quaternion_from_matrix
from tracking.fusion import Measured, fuse_with_encoders
from tracking.pose_log import POSE_COLUMNS

_MM, _MS = 1e3, 1e3
_ON_PATH = [state.value for state in ON_PATH]
_PER_CABLE = (
    "set_{}_counts",
    "actual_{}_counts",
    "length_{}_mm",
    "planned_tension_{}_n",
    "tension_{}_n",
)


@dataclass(frozen=True, slots=True, eq=False)
class CycleTable:
    """The cycles of a run with m cables; n rows. Unknown numbers are NaN.

    Attributes:
        time: Since the start of the run, shape (n,), [s].
        state: State of the executor, n texts.
        path_index: Row of the set-point table whose set-points the drives followed when they
            reported ``actual_counts``, shape (n,). CiA 402 drives took them over at the cycle's
            SYNC, and those of the row after it are sent in it; ODrives got them in this cycle.
        leg: Number of the leg between stops, from 1, shape (n,); it ends when its stop is left.
        stop: Name of the stop at which the platform dwells, n texts; empty between stops.
        travelled: Length along the path, shape (n,), [m].
        lateness: Of the cycle after its deadline, shape (n,), [s]; 0 in simulated time.
        missing: Drives that did not answer, shape (n,).
        rejected: Implausible frames rejected so far, shape (n,).
        error_frames: Error frames of the bus so far, shape (n,).
        planned: Commanded position of the platform, world frame, shape (n, 3), [m].
        planned_rotation: Commanded ``world_from_platform``, quaternions (w, x, y, z), shape (n, 4).
        encoder: Position from the encoders, world frame, shape (n, 3), [m]; NaN if the actual
            positions fit no pose within start tolerance and following error.
        encoder_rotation: As ``planned_rotation``, from the encoders, shape (n, 4).
        following_error: Largest of all cables, shape (n,), [m].
        set_counts: Set-points sent, shape (n, m), [counts].
        actual_counts: Reported positions, shape (n, m), [counts].
        lengths: Cable lengths from the actual positions, shape (n, m), [m].
        planned_tensions: Tensions of the plan, shape (n, m), [N].
        tensions: Tensions from the drives' torques, shape (n, m), [N].
    """

    time: Array
    state: tuple[str, ...]
    path_index: Integers
    leg: Integers
    stop: tuple[str, ...]
    travelled: Array
    lateness: Array
    missing: Integers
    rejected: Integers
    error_frames: Integers
    planned: Array
    planned_rotation: Array
    encoder: Array
    encoder_rotation: Array
    following_error: Array
    set_counts: Integers
    actual_counts: Integers
    lengths: Array
    planned_tensions: Array
    tensions: Array

    def __post_init__(self) -> None:
        """See `require_equal_lengths`."""
        require_equal_lengths(self)

    def __len__(self) -> int:
        return len(self.time)

    @property
    def cable_count(self) -> int:
        """Number of cables m."""
        return int(self.set_counts.shape[1])

    @property
    def path_began(self) -> float:
        """Time of the first cycle along the path, [s]; infinite if there is none.

        Before it the platform may be beside the start, by the tolerance.
        """
        return float(self.time[self.on_path].min(initial=np.inf))

    @property
    def on_path(self) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Whether the platform was on its path, moving, on hold or stopping, shape (n,)."""
        return np.isin(self.state, _ON_PATH)

    @property
    def has_encoder_pose(self) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Whether the encoders give a pose, shape (n,)."""
        return np.asarray(np.isfinite(np.hstack([self.encoder, self.encoder_rotation])).all(axis=1))

    @property
    def encoder_error(self) -> Array:
        """Distance of the encoders' position from the planned one, shape (n,), [m]."""
        error: Array = np.linalg.norm(self.encoder - self.planned, axis=1)
        return error

    def write_csv(self, path: Path) -> None:
        """Writes ``cycles.csv``.

        Raises:
            BadInput: The folder cannot be written to.
        """
        write_table(path, self._columns(0))

    def csv_header(self) -> str:
        """The first line of ``cycles.csv``."""
        return header(self._columns(0))

    def csv_rows(self, first: int) -> str:
        """The lines of ``cycles.csv`` for cycles numbered from ``first``."""
        return rows(self._columns(first))

    def _columns(self, first: int) -> list[Column]:
        columns = [
            integers("cycle", np.arange(first, first + len(self))),
            numbers("time_s", self.time),
            texts("state", self.state),
            integers("path_index", self.path_index),
            integers("leg", self.leg),
            texts("stop", self.stop),
            numbers("path_mm", self.travelled, _MM),
            numbers("lateness_ms", self.lateness, _MS, 4),
            integers("missing", self.missing),
            integers("rejected_frames", self.rejected),
            integers("error_frames", self.error_frames),
            *_pose(self.planned, self.planned_rotation, "planned_"),
            *_pose(self.encoder, self.encoder_rotation, "encoder_"),
            numbers("following_error_mm", self.following_error, _MM),
        ]
        for i in range(self.cable_count):
            columns += self._cable(i)
        return columns

    def _cable(self, i: int) -> list[Column]:
        names = [name.format(i + 1) for name in _PER_CABLE]
        return [
            integers(names[0], self.set_counts[:, i]),
            integers(names[1], self.actual_counts[:, i]),
            numbers(names[2], self.lengths[:, i], _MM),
            numbers(names[3], self.planned_tensions[:, i], decimals=4),
            numbers(names[4], self.tensions[:, i], decimals=4),
        ]

    @classmethod
    def read_csv(cls, path: Path) -> CycleTable:
        """Reads ``cycles.csv``.

        Raises:
            BadInput: The file is missing, cut short or has other columns.
        """
        return cls._of(TableFile(path))

    @classmethod
    def of_lines(cls, path: Path, lines: Sequence[str]) -> CycleTable:
        """As `read_csv`, from lines of the file, including its header.

        Raises:
            BadInput: A line has other columns or invalid numbers.
        """
        return cls._of(TableFile(path, "\n".join(lines)))

    @classmethod
    def _of(cls, table: TableFile) -> CycleTable:
        count = table.count(r"set_\d+_counts")
        names = [[name.format(i + 1) for i in range(count)] for name in _PER_CABLE]
        return cls(
            time=table.floats("time_s"),
            state=table.texts("state"),
            path_index=table.ints("path_index"),
            leg=table.ints("leg"),
            stop=table.texts("stop"),
            travelled=table.floats("path_mm", _MM),
            lateness=table.floats("lateness_ms", _MS),
            missing=table.ints("missing"),
            rejected=table.ints("rejected_frames"),
            error_frames=table.ints("error_frames"),
            planned=table.matrix([f"planned_{axis}_mm" for axis in "xyz"], _MM),
            planned_rotation=table.matrix([f"planned_q{axis}" for axis in "wxyz"]),
            encoder=table.matrix([f"encoder_{axis}_mm" for axis in "xyz"], _MM),
            encoder_rotation=table.matrix([f"encoder_q{axis}" for axis in "wxyz"]),
            following_error=table.floats("following_error_mm", _MM),
            set_counts=table.int_matrix(names[0]),
            actual_counts=table.int_matrix(names[1]),
            lengths=table.matrix(names[2], _MM),
            planned_tensions=table.matrix(names[3]),
            tensions=table.matrix(names[4]),
        )


def no_cycles(cable_count: int) -> CycleTable:
    """The table of a run without cycles."""
    none, whole = np.empty(0), np.empty(0, dtype=np.int64)
    each, each_whole = np.empty((0, cable_count)), np.empty((0, cable_count), dtype=np.int64)
    return CycleTable(
        time=none, state=(), path_index=whole, leg=whole, stop=(), travelled=none, lateness=none,
        missing=whole, rejected=whole, error_frames=whole,
        planned=np.empty((0, 3)), planned_rotation=np.empty((0, 4)),
        encoder=np.empty((0, 3)), encoder_rotation=np.empty((0, 4)), following_error=none,
        set_counts=each_whole, actual_counts=each_whole, lengths=each, planned_tensions=each,
        tensions=each,
    )  # fmt: skip


def _pose(positions: Array, rotations: Array, prefix: str = "") -> list[Column]:
    return [
        *_side_by_side([f"{prefix}{axis}_mm" for axis in "xyz"], positions * _MM),
        *_side_by_side([f"{prefix}q{axis}" for axis in "wxyz"], rotations, decimals=9),
    ]


def _side_by_side(names: Sequence[str], values: Array, decimals: int = 6) -> list[Column]:
    return [numbers(n, values[:, i], decimals=decimals) for i, n in enumerate(names)]


def quaternions_of(rotations: Array) -> Array:
    """Rotation matrices, shape (n, 3, 3), as quaternions (w, x, y, z), shape (n, 4)."""
    if len(rotations) and (rotations == rotations[0]).all():  # constant orientation
        return np.tile(quaternion_from_matrix(rotations[0]), (len(rotations), 1))
    return np.array([quaternion_from_matrix(r) for r in rotations]).reshape(-1, 4)


# Camera measurements of a run: one row per image.


_DEG = float(np.degrees(1.0))
_SCALES = np.array([_MM, _MM, _MM, _DEG, _DEG, _DEG])
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
        tags: Numbers of the tags used, n texts such as ``301 303``.
        reprojection: RMS of the corners, shape (n,), [px].
        planned: Commanded position at that time, shape (n, 3), [m].
        picture: Name of the image kept in the run folder, or empty, n texts.
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
        """See `require_equal_lengths`."""
        require_equal_lengths(self)

    def __len__(self) -> int:
        return len(self.time)

    @property
    def ok(self) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Whether each image gave a pose, shape (n,)."""
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
        columns = [
            integers("frame", self.frame),
            numbers("time_s", self.time),
            texts("status", self.status),
            *_pose(self.position, self.rotation),
            *_side_by_side(_STD, self.std * _SCALES),
            *(_covariance(self.covariance, pair) for pair in _PAIRS),
            texts("tags", self.tags),
            numbers("reprojection_px", self.reprojection, decimals=4),
            *_side_by_side([f"planned_{axis}_mm" for axis in "xyz"], self.planned * _MM),
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
            position=table.matrix([f"{axis}_mm" for axis in "xyz"], _MM),
            rotation=table.matrix([f"q{axis}" for axis in "wxyz"]),
            covariance=covariance,
            tags=table.texts("tags"),
            reprojection=table.floats("reprojection_px"),
            planned=table.matrix([f"planned_{axis}_mm" for axis in "xyz"], _MM),
            picture=table.texts("picture"),
        )


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


# Fused poses: one row per cycle with an encoder pose, from the first image on.


@dataclass(frozen=True, slots=True, eq=False)
class FusedTable:
    """Fused poses of n cycles.

    Attributes:
        time: Since the start of the run, shape (n,), [s].
        position: Of the platform in the world, shape (n, 3), [m].
        rotation: ``world_from_platform`` as unit quaternions (w, x, y, z), shape (n, 4).
        std: Standard deviations of position and rotation vector, shape (n, 6), [m] and [rad].
        age: Time since the last image used, shape (n,), [s].
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
                *_pose(self.position, self.rotation),
                *_side_by_side(_STD, self.std * _SCALES),
                numbers("age_s", self.age),
            ],
        )


def fused_table(cycles: CycleTable, poses: PoseTable) -> FusedTable:
    """The encoder poses of a run, corrected by its images between two of them."""
    known, after = cycles.has_encoder_pose, np.searchsorted(cycles.time, poses.time)
    padded = np.pad(known, 1, mode="edge") if len(known) else np.zeros(2, dtype=bool)
    between = padded[after] & padded[after + 1]
    driven = list(map(Pose.from_quaternion, cycles.encoder[known], cycles.encoder_rotation[known]))
    measured = [
        Measured(
            float(poses.time[i]),
            Pose.from_quaternion(poses.position[i], poses.rotation[i]),
            poses.covariance[i],
        )
        for i in np.flatnonzero(poses.ok & between)
    ]
    rows = list(fuse_with_encoders(cycles.time[known].tolist(), driven, measured))
    covariances = np.array([row.covariance for row in rows]).reshape(-1, 6, 6)
    return FusedTable(
        time=np.array([row.time for row in rows]),
        position=np.array([row.pose.position for row in rows]).reshape(-1, 3),
        rotation=np.array([row.pose.quaternion for row in rows]).reshape(-1, 4),
        std=np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)),
        age=np.array([row.age for row in rows]),
    )
