"""Tables of a run: one row per cycle of the loop, one row per image of the cameras.

A new column of ``cycles.csv`` is a field of `CycleTable`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np

from executor.recording.table_files import (
    Column,
    Columns,
    Integers,
    Table,
    Texts,
    integers,
    numbers,
    texts,
)
from executor.state_machine import ON_PATH, State
from model.errors import BadInput
from model.files.reading import MEGABYTE, READING_NEEDS, TABLE_LIMIT
from model.pose import Array, Pose, quaternion_from_matrix
from tracking.fusion import Measured, fuse_with_encoders
from tracking.pose_log import COVARIANCE, POSITION, ROTATION, SCALES, STD

if TYPE_CHECKING:
    from executor.trajectory.setpoints import PreparedRun  # loads the planner's check

_MM, _MS = 1e3, 1e3
_ON_PATH = [state.value for state in ON_PATH]


def _position(prefix: str = "") -> Columns:
    return numbers(*(prefix + name for name in POSITION), scale=_MM)


def _rotation(prefix: str = "") -> Columns:
    return numbers(*(prefix + name for name in ROTATION), decimals=9)


#: Of position and rotation vector about world axes.
_STD = numbers(*STD, scale=SCALES)
_COVARIANCE = Columns(COVARIANCE, "%.6e", np.outer(SCALES, SCALES), (6, 6))


@dataclass(frozen=True, slots=True, eq=False)
class CycleTable(Table):
    """The cycles of a run with m cables; n rows. Unknown numbers are NaN.

    Attributes:
        cycle: Its number, from 0, shape (n,).
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
        tensions: Tensions from the torques of drives that answered and follow set-points or, after
            a fault, hold under torque, shape (n, m), [N].
    """

    cycle: Annotated[Integers, integers("cycle")]
    time: Annotated[Array, numbers("time_s")]
    state: Annotated[Texts, texts("state")]
    path_index: Annotated[Integers, integers("path_index")]
    leg: Annotated[Integers, integers("leg")]
    stop: Annotated[Texts, texts("stop")]
    travelled: Annotated[Array, numbers("path_mm", scale=_MM)]
    lateness: Annotated[Array, numbers("lateness_ms", scale=_MS, decimals=4)]
    missing: Annotated[Integers, integers("missing")]
    rejected: Annotated[Integers, integers("rejected_frames")]
    error_frames: Annotated[Integers, integers("error_frames")]
    planned: Annotated[Array, _position("planned_")]
    planned_rotation: Annotated[Array, _rotation("planned_")]
    encoder: Annotated[Array, _position("encoder_")]
    encoder_rotation: Annotated[Array, _rotation("encoder_")]
    following_error: Annotated[Array, numbers("following_error_mm", scale=_MM)]
    set_counts: Annotated[Integers, integers("set_{}_counts")]
    actual_counts: Annotated[Integers, integers("actual_{}_counts")]
    lengths: Annotated[Array, numbers("length_{}_mm", scale=_MM)]
    planned_tensions: Annotated[Array, numbers("planned_tension_{}_n", decimals=4)]
    tensions: Annotated[Array, numbers("tension_{}_n", decimals=4)]

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
    def following_tensions(self) -> Array:
        """Tensions while all drives follow set-points, shape (n, m), [N]; NaN after a stop."""
        return np.where(np.isfinite(self.following_error)[:, None], self.tensions, np.nan)

    @property
    def tensions_until(self) -> dict[int, float]:
        """Times until which tensions are known [s], by the number of their cable, from 1.

        Only of those unknown at the end after a fault, which is a record that ends along the path
        or with the fault latched.
        """
        known, end = np.isfinite(self.tensions), self.state[-1]
        if end not in (*_ON_PATH, State.LATCHED.value):
            return {}
        lost = known.any(axis=0) & (~known[-1] | (end != State.LATCHED.value))
        last = len(known) - 1 - np.argmax(known[::-1], axis=0)
        return {int(i) + 1: float(self.time[last[i]]) for i in np.flatnonzero(lost)}

    @property
    def encoder_error(self) -> Array:
        """Distance of the encoders' position from the planned one, shape (n,), [m]."""
        error: Array = np.linalg.norm(self.encoder - self.planned, axis=1)
        return error


#: Size of a row of ``cycles.csv`` in a run of hours: of all cables together, and of each, [bytes].
ROW, ROW_PER_CABLE = 230, 45


def require_readable_record(prepared: PreparedRun) -> None:
    """Refuses a run whose ``cycles.csv`` would be too large for this computer to read.

    A run that is paused or slowed down takes longer, and may still exceed the limit.

    Raises:
        BadInput: With its size, and the longest run.
    """
    row = ROW + ROW_PER_CABLE * prepared.rig.cable_count
    size = row * len(prepared.checked.table)
    if size <= TABLE_LIMIT:
        return
    longest = TABLE_LIMIT / row * prepared.checked.table.cycle
    raise BadInput(
        f"the record of a run of {prepared.duration / 60.0:.0f} minutes would have"
        f" {size / MEGABYTE:.0f} MB; at most {TABLE_LIMIT / MEGABYTE:.0f} MB are read",
        where="cycles.csv of the run",
        why=f"reading it takes {READING_NEEDS} times its size in memory",
        next_step=f"split the plan into runs of at most {longest / 60.0:.0f} minutes",
    )


def quaternions_of(rotations: Array) -> Array:
    """Rotation matrices, shape (n, 3, 3), as quaternions (w, x, y, z), shape (n, 4)."""
    if len(rotations) and (rotations == rotations[0]).all():  # constant orientation
        return np.tile(quaternion_from_matrix(rotations[0]), (len(rotations), 1))
    return np.array([quaternion_from_matrix(r) for r in rotations]).reshape(-1, 4)


# Camera measurements of a run: one row per image.


OK = "ok"


@dataclass(frozen=True, slots=True, eq=False)
class PoseTable(Table):
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

    frame: Annotated[Integers, integers("frame")]
    time: Annotated[Array, numbers("time_s")]
    status: Annotated[Texts, texts("status")]
    position: Annotated[Array, _position()]
    rotation: Annotated[Array, _rotation()]
    covariance: Annotated[Array, _COVARIANCE]
    tags: Annotated[Texts, texts("tags")]
    reprojection: Annotated[Array, numbers("reprojection_px", decimals=4)]
    planned: Annotated[Array, _position("planned_")]
    picture: Annotated[Texts, texts("picture")]

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

    def columns(self) -> list[Column]:
        """All columns of the file: the standard deviations are before the covariance."""
        columns = Table.columns(self)
        first = [column.name for column in columns].index(COVARIANCE[0])
        return [*columns[:first], *_STD.of(self.std), *columns[first:]]


# Fused poses: one row per cycle with an encoder pose, from the first image on.


@dataclass(frozen=True, slots=True, eq=False)
class FusedTable(Table):
    """Fused poses of n cycles.

    Attributes:
        time: Since the start of the run, shape (n,), [s].
        position: Of the platform in the world, shape (n, 3), [m].
        rotation: ``world_from_platform`` as unit quaternions (w, x, y, z), shape (n, 4).
        std: Standard deviations of position and rotation vector, shape (n, 6), [m] and [rad].
        age: Time since the last image used, shape (n,), [s].
    """

    time: Annotated[Array, numbers("time_s")]
    position: Annotated[Array, _position()]
    rotation: Annotated[Array, _rotation()]
    std: Annotated[Array, _STD]
    age: Annotated[Array, numbers("age_s")]


def fused_table(cycles: CycleTable, poses: PoseTable) -> FusedTable:
    """The encoder poses of a run, corrected by its images between two of them.

    Both tables as read from their files: a new report makes the same ``fused.csv``.
    """
    cycles = cycles.as_read("time", "encoder", "encoder_rotation")
    poses = poses.as_read("time", "position", "rotation", "covariance")
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
