"""Distances of cables and platform from the obstacles during a run."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import compress
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from executor.recording.table_files import (
    Column,
    Columns,
    Table,
    TableFile,
    Texts,
    numbers,
    texts,
)
from executor.recording.tables import CycleTable
from model.cameras import Z_95
from model.clearance import ClearanceModel, Nearest
from model.kinematics import cable_lengths, structure_matrix
from model.pose import Array, Pose
from model.rig import Rig
from model.winches import WinchMap
from tracking.clearance import MeasuredClearance, clearance_at

_MM = 1e3
_UNIT = re.compile(r"_mm( \(obstacle \d+\))?\Z")
"""End of the name of an obstacle's column, with its number if the name alone is not unique."""


def source_of(camera: str) -> str:
    """Source name of the measurements of one of several cameras."""
    return f"tag:{camera}"


def camera_of(source: str) -> str:
    """The single camera of a source; empty for all cameras and for the encoders."""
    return source.partition(":")[2]


@dataclass(frozen=True, slots=True, eq=False)
class ClearanceTable(Table):
    """Distances at n poses to each of k obstacles; no rows for a scene without obstacles.

    Attributes:
        time: Since the start of the run, shape (n,), [s].
        source: Of each pose, n texts: ``tag`` (all cameras), ``encoder``, or one of several cameras
            alone (`source_of`).
        distance: Smallest distance, shape (n,), [m].
        uncertainty: Distance minus the lower bound of the smallest true one, shape (n,), [m].
        at_most: Upper bound of the smallest true one, shape (n,), [m].
        body: Nearest part of the robot, n texts.
        obstacle: Nearest obstacle, n texts.
        planned_distance: Smallest distance of the planned pose at that time, shape (n,), [m].
        obstacles: Names of the scene's obstacles, k texts.
        distances: To each obstacle, shape (n, k), [m].
        planned_distances: Of the planned pose to each obstacle, shape (n, k), [m].
    """

    time: Annotated[Array, numbers("time_s")]
    source: Annotated[Texts, texts("source")]
    distance: Annotated[Array, numbers("distance_mm", scale=_MM)]
    uncertainty: Annotated[Array, numbers("uncertainty_mm", scale=_MM)]
    at_most: Annotated[Array, numbers("at_most_mm", scale=_MM)]
    body: Annotated[Texts, texts("body")]
    obstacle: Annotated[Texts, texts("obstacle")]
    planned_distance: Annotated[Array, numbers("planned_distance_mm", scale=_MM)]
    obstacles: Texts
    distances: Array
    planned_distances: Array

    def __post_init__(self) -> None:
        """Refuses arrays of different sizes.

        Raises:
            ValueError: Naming the attribute.
        """
        Table.__post_init__(self)
        rows, count = len(self.time), len(self.obstacles)
        for name in ("distances", "planned_distances"):
            if getattr(self, name).shape != (rows, count):
                raise ValueError(f"{name} must have shape ({rows}, {count})")

    def of(self, source: str) -> ClearanceTable:
        """The rows of one source."""
        return self._chosen(np.array([name == source for name in self.source], dtype=bool))

    def since(self, time: float) -> ClearanceTable:
        """The rows from a time on, [s]."""
        return self._chosen(self.time >= time)

    def _chosen(self, rows: NDArray[np.bool_]) -> ClearanceTable:
        chosen: dict[str, Any] = {"obstacles": self.obstacles}
        for name in {field.name for field in fields(self)} - chosen.keys():
            values = getattr(self, name)
            is_array = isinstance(values, np.ndarray)
            chosen[name] = values[rows] if is_array else tuple(compress(values, rows))
        return ClearanceTable(**chosen)

    def columns(self) -> list[Column]:
        """All columns of the file; those of each obstacle are last, side by side."""
        columns = Table.columns(self)
        taken = {column.name for column in columns}
        for i, name in enumerate(self.obstacles):
            pair = f"{name}_mm", f"planned_{name}_mm"
            # An obstacle may be named ``distance``, or ``planned_x`` beside ``x``.
            end = "" if taken.isdisjoint(pair) else f" (obstacle {i + 1})"
            taken |= {*pair}
            columns += numbers(pair[0] + end, scale=_MM).of(self.distances[:, i])
            columns += numbers(pair[1] + end, scale=_MM).of(self.planned_distances[:, i])
        return columns

    @classmethod
    def of_file(cls, file: TableFile) -> ClearanceTable:
        """The table in a file; the columns of obstacles are read by index.

        Raises:
            BadInput: A column is missing or has invalid values.
        """
        facts = cls.attributes_in(file)
        pairs = file.pairs_from(len(facts))
        near, planned = (Columns(names, "%.6f", _MM, (len(names),)) for names in pairs)
        return cls(
            **facts,
            obstacles=tuple(_UNIT.sub("", name) for name in near.names),
            distances=near.read(file),
            planned_distances=planned.read(file),
        )


def no_clearance(obstacles: tuple[str, ...] = ()) -> ClearanceTable:
    """A table without rows."""
    nothing, nowhere = np.empty(0), np.empty((0, len(obstacles)))
    return ClearanceTable(
        nothing, (), nothing, nothing, nothing, (), (), nothing, obstacles, nowhere, nowhere
    )


# Accuracy of the encoder pose: resolution of the counts, stretch from noisy torques, and geometry.


#: Ratio of the standard deviation of a normal distribution to the median of its absolute values.
_BY_MEDIAN = 1.4826


def tension_noise(rig: Rig, tensions: Array) -> Array:
    """Standard deviation of tensions from torques, from changes between cycles.

    Changes by the platform's motion in a cycle count as noise as well: a torque may be a cycle old.

    Args:
        tensions: Of every cycle, shape (n, m), [N]; NaN where unknown.

    Returns:
        Shape (m,), [N].
    """
    # Drives report torques in whole per mille of the rated torque.
    rounding: Array = np.abs(rig.tensions_by(np.ones(rig.cable_count))) / np.sqrt(12.0)
    steps = np.abs(np.diff(tensions, axis=0))
    known = np.isfinite(steps).all(axis=1)
    if not known.any():
        return rounding
    measured = _BY_MEDIAN * np.median(steps[known], axis=0) / np.sqrt(2.0)
    noise: Array = np.hypot(measured, rounding)
    return noise


def encoder_covariance(winches: WinchMap, rig: Rig, pose: Pose, noise: Array) -> Array:
    """Covariance of a pose that fits the cable lengths from the encoders.

    The rig's `platform_error` is part of that of the position.

    Args:
        pose: ``world_from_platform``.
        noise: See `tension_noise`, shape (m,), [N].

    Returns:
        Of position and rotation vector about world axes, shape (6, 6), [m, rad].
    """
    counts = 1.0 / np.abs(winches.counts_per_metre) / np.sqrt(12.0)
    whole = cable_lengths(rig, pose) + winches.behind_outlet
    lengths = np.hypot(counts, whole / winches.stiffness * noise)
    spread = np.linalg.pinv(structure_matrix(rig, pose).T) * lengths
    covariance: Array = spread @ spread.T
    covariance[:3, :3] += ((rig.platform_error or 0.0) / Z_95) ** 2 * np.eye(3)
    return covariance


# Clearance along a run: from the encoders and, with a camera, from the tags.


#: Errors that the covariance of an encoder pose does not include, [m]: forward kinematics assumes
#: straight, massless cables and the calibrated rig.
ALLOWANCE = 1e-4
#: Clearances from the encoders are computed at least this often along a run, [Hz], and
RATE = 10.0
#: after at most this motion of the platform, [m], wherever a smaller one may lie in between.
STEP = 0.005


@dataclass(frozen=True, slots=True, eq=False)
class ClearanceRow:
    """Distances at one measured pose, one entry per obstacle.

    Attributes:
        time: [s].
        source: See `ClearanceTable`.
        measured: At the measured pose.
        uncertainty: Smallest distance minus the lower bound of the smallest true one, [m].
        at_most: Upper bound of the smallest true one, [m].
        planned: At the planned pose of the same time.
    """

    time: float
    source: str
    measured: tuple[Nearest, ...]
    uncertainty: float
    at_most: float
    planned: tuple[Nearest, ...]

    @classmethod
    def at(
        cls, time: float, source: str, clearance: MeasuredClearance, planned: tuple[Nearest, ...]
    ) -> ClearanceRow:
        """The row of a measured pose."""
        measured, spread = clearance.nearest, clearance.uncertainty
        return cls(time, source, measured, spread, clearance.at_most, planned)


def encoder_rows(model: ClearanceModel, cycles: CycleTable, required: float) -> list[ClearanceRow]:
    """Rows for encoder poses of a run, in order of time; none without an obstacle.

    There are `RATE` per second, and one at either end of a record in motion. Between two poses the
    clearance changes by at most the motion of the platform: where it may be below that of all rows,
    or below the required one, rows in the middle are added until that motion is at most `STEP`.

    Args:
        required: Clearance to the obstacles, [m].
    """
    known = np.flatnonzero(cycles.has_encoder_pose)
    every = max(1, round(1.0 / (RATE * model.rig.cycle)))
    regular = np.flatnonzero(known % every == 0)
    if not (model.obstacle_names and regular.size):
        return []
    motion = _motion(model.rig, cycles, known)
    noise = tension_noise(model.rig, cycles.following_tensions)
    ends = np.array([0, known.size - 1])  # counted where the record begins or ends in motion
    in_motion = np.abs(motion[ends] - motion[regular[[0, -1]]]) > STEP
    more = np.union1d(regular, ends[in_motion])
    rows: dict[int, ClearanceRow] = {}
    while more.size:
        rows |= zip(more.tolist(), _rows_at(model, cycles, known[more], noise), strict=True)
        at = np.array(sorted(rows))
        near = np.array([_smallest(rows[k]) for k in at.tolist()])
        apart = np.diff(motion[at])
        at_least = (near[:-1] + near[1:] - apart[:, None]) / 2.0
        is_unsure = (at_least < np.maximum(near.min(axis=0), required)).any(axis=1)
        gaps = np.flatnonzero(is_unsure & (apart > STEP) & (np.diff(at) > 1))
        more = (at[gaps] + at[gaps + 1]) // 2
    return [rows[k] for k in sorted(rows)]


def _rows_at(
    model: ClearanceModel, cycles: CycleTable, chosen: NDArray[np.int64], noise: Array
) -> list[ClearanceRow]:
    """Rows for the encoder poses of some cycles; ``noise`` as from `tension_noise`."""
    winches, rows = WinchMap(model.rig), []
    for k in chosen.tolist():
        at = Pose.from_quaternion(cycles.encoder[k], cycles.encoder_rotation[k])
        due = Pose.from_quaternion(cycles.planned[k], cycles.planned_rotation[k])
        covariance = encoder_covariance(winches, model.rig, at, noise)
        clearance = clearance_at(model, at, covariance, ALLOWANCE)
        if clearance is not None:
            time = float(cycles.time[k])
            rows.append(ClearanceRow.at(time, "encoder", clearance, model.obstacles(due)))
    return rows


def _smallest(row: ClearanceRow) -> tuple[float, float]:
    """The smallest distances of the measured and of the planned pose, [m]."""
    return min(n.distance for n in row.measured), min(n.distance for n in row.planned)


def _motion(rig: Rig, cycles: CycleTable, known: NDArray[np.int64]) -> Array:
    """Upper bound of the path length of every point of the platform up to each encoder pose.

    Args:
        known: Cycles with an encoder pose, shape (n,).

    Returns:
        Shape (n,), [m].
    """
    points = np.vstack([rig.anchors, rig.platform_corners])
    reach = float(np.linalg.norm(points, axis=1).max())
    moved = np.linalg.norm(np.diff(cycles.encoder[known], axis=0), axis=1)
    ends = cycles.encoder_rotation[known]
    # Both signs of a quaternion are the same rotation.
    chords = [np.linalg.norm(ends[1:] + sign * ends[:-1], axis=1) for sign in (-1.0, 1.0)]
    rotated = 4.0 * np.arcsin(np.minimum(np.min(chords, axis=0) / 2.0, 1.0))
    return np.concatenate([[0.0], np.cumsum(moved + reach * rotated)])


def clearance_table(names: tuple[str, ...], rows: Sequence[ClearanceRow]) -> ClearanceTable:
    """Rows as a table; a scene without obstacles has none."""
    if not rows or not names:
        return no_clearance(names)
    nearest = [min(row.measured, key=lambda n: n.distance) for row in rows]
    measured = np.array([[n.distance for n in row.measured] for row in rows])
    planned = np.array([[n.distance for n in row.planned] for row in rows])
    return ClearanceTable(
        time=np.array([row.time for row in rows]),
        source=tuple(row.source for row in rows),
        distance=measured.min(axis=1),
        uncertainty=np.array([row.uncertainty for row in rows]),
        at_most=np.array([row.at_most for row in rows]),
        body=tuple(n.first for n in nearest),
        obstacle=tuple(n.second for n in nearest),
        planned_distance=planned.min(axis=1),
        obstacles=names,
        distances=measured,
        planned_distances=planned,
    )
