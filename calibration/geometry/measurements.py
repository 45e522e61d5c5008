"""Stationary samples for a rig's calibration: drive positions, tensions, poses if known."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import radians
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.results import data_hash
from model.files.csv_table import CsvTable
from model.pose import (
    Array,
    matrix_from_quaternion,
    read_only,
    rotation_vector_from_matrix,
    skew,
)
from model.rig import Rig
from model.statics.gravity import STANDARD_GRAVITY

SHORTEST_REST = 0.4
"""Minimum time without commanded motion that counts as rest, [s]."""
SETTLING = 0.2
"""Settling time after a stop, left out of the sample, [s]."""

_ARRAYS = ("counts", "tensions", "positions", "rotations", "covariances")
_SENSORS = ("swivels", "verticals")
_PER_SAMPLE = (*_ARRAYS, *_SENSORS, "reflectors")


def _nothing() -> Array:
    return np.empty((0, 0))


@dataclass(frozen=True, slots=True, eq=False)
class RigMeasurements:
    """n stationary samples of a rig with m cables.

    Attributes:
        names: Of the n samples.
        counts: Drive positions, shape (n, m), [counts].
        tensions: Shape (n, m), [N]; NaN where not measured.
        positions: World frame, shape (n, 3), [m]; NaN where not measured.
        rotations: ``world_from_platform``, shape (n, 3, 3); NaN where not measured, such as with a
            tracker of one reflector.
        covariances: Of position and rotation vector about world axes, shape (n, 6, 6).
        unused: Why other samples were left out, by name.
        reflectors: Measured point of each sample, platform frame, shape (n, 3) or one for all, [m].
        swivels: Swivel angles of the pulleys about their feed directions, right-handed, 0 with the
            rig file's platform at home, shape (n, m), [rad]; NaN where not measured.
        verticals: Upward unit vectors in the frame of an IMU on the platform, from its
            accelerometers at rest, shape (n, 3); NaN where not measured.
        swivel_deviation: Of each swivel angle, [rad].
        imu_deviation: Of a vertical's direction about any axis, [rad].
        common_deviations: Of errors that all measured poses may share, in position along any axis,
            [m], and in rotation about any axis, [rad].
    """

    names: tuple[str, ...]
    counts: Array
    tensions: Array
    positions: Array
    rotations: Array
    covariances: Array
    unused: Mapping[str, str] = field(default_factory=dict)
    reflectors: Array = field(default_factory=lambda: np.zeros(3))
    swivels: Array = field(default_factory=_nothing)
    verticals: Array = field(default_factory=_nothing)
    swivel_deviation: float = radians(0.1)
    imu_deviation: float = radians(0.1)
    common_deviations: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        """Fills sensors that were left out with NaN, and repeats one reflector for all."""
        each = np.broadcast_to(self.reflectors, (len(self), 3))
        object.__setattr__(self, "reflectors", each)
        for key, shape in (("swivels", self.counts.shape), ("verticals", (len(self), 3))):
            if not getattr(self, key).size:
                object.__setattr__(self, key, read_only(np.full(shape, np.nan)))

    def __len__(self) -> int:
        return len(self.names)

    @property
    def has_position(self) -> NDArray[np.bool_]:
        """Samples with a measured position, shape (n,)."""
        return np.asarray(np.isfinite(self.positions).all(axis=1))

    @property
    def has_rotation(self) -> NDArray[np.bool_]:
        """Samples with a measured rotation, shape (n,)."""
        return np.asarray(np.isfinite(self.rotations).all(axis=(1, 2)))

    @property
    def unmeasured(self) -> NDArray[np.int_]:
        """Number of unmeasured degrees of freedom of each pose, shape (n,)."""
        return np.asarray(6 - 3 * self.has_position.astype(int) - 3 * self.has_rotation.astype(int))

    def measured_points(self, positions: Array, rotations: Array) -> Array:
        """Positions of the measured points for given poses, shape (n, 3), [m].

        Args:
            positions: World frame, shape (n, 3), [m].
            rotations: ``world_from_platform``, shape (n, 3, 3).
        """
        return np.asarray(positions + self._arms(rotations))

    def _arms(self, rotations: Array) -> Array:
        """From the platform's origin to the measured points, world frame, shape (n, 3), [m]."""
        return np.asarray((rotations @ self.reflectors[..., None])[..., 0])

    def origins(self, rotations: Array) -> Array:
        """Measured positions of the platform's origin with given rotations, shape (n, 3), [m]."""
        return self.positions - self._arms(rotations)

    def pose_errors(self, positions: Array, rotations: Array) -> Array:
        """Twists from measured to given poses, shape (n, 6), [m, rad]; 0 where not measured.

        Args:
            positions: World frame, shape (n, 3), [m].
            rotations: ``world_from_platform``, shape (n, 3, 3).
        """
        errors = np.zeros((len(self), 6))
        errors[:, :3] = self.measured_points(positions, rotations) - self.positions
        turns = rotations @ np.swapaxes(self.rotations, 1, 2)
        for k in np.flatnonzero(self.has_position & self.has_rotation):
            errors[k, 3:] = rotation_vector_from_matrix(turns[k])
        errors[:, :3] += np.cross(self._arms(rotations), errors[:, 3:])  # of the origin
        errors[~self.has_position] = 0.0
        return errors

    def pose_information(self, rotations: Array) -> Array:
        """Information of the measured poses on twists, shape (n, 6, 6); 0 where not measured.

        Args:
            rotations: ``world_from_platform`` to linearise about, shape (n, 3, 3).
        """
        information = np.zeros((len(self), 6, 6))
        whole = self.has_position & self.has_rotation
        information[whole] = np.linalg.inv(self.covariances[whole])
        point = self.has_position & ~self.has_rotation
        information[point, :3, :3] = np.linalg.inv(self.covariances[point, :3, :3])
        by_twist = np.tile(np.eye(6), (len(self), 1, 1))
        by_twist[:, :3, 3:] = -skew(self._arms(rotations))
        return np.asarray(np.swapaxes(by_twist, 1, 2) @ information @ by_twist)

    def first_rotations(self, rig: Rig) -> Array:
        """Rotations; that of home where not measured, shape (n, 3, 3)."""
        known = self.has_rotation[:, None, None]
        return np.where(known, self.rotations, rig.home.rotation)

    @property
    def data_hash(self) -> str:
        """Hash of all measurements."""
        sensors = (a for a in (self.swivels, self.verticals) if np.isfinite(a).any())
        numbers = (self.counts, self.tensions, self.positions, self.rotations, *sensors)
        return data_hash(np.round(values, 12).tobytes() for values in numbers)

    def part(self, chosen: NDArray[np.bool_]) -> RigMeasurements:
        """The selected samples."""
        arrays: dict[str, Any] = {key: read_only(getattr(self, key)[chosen]) for key in _PER_SAMPLE}
        names = tuple(n for n, yes in zip(self.names, chosen.tolist(), strict=True) if yes)
        return replace(self, names=names, **arrays)

    def with_added_deviation(self, length: float, turn: float) -> RigMeasurements:
        """The same with larger pose covariances, for errors common to all images of a sample.

        All samples may share these errors as well, which no number of samples averages out.

        Args:
            length: Standard deviation of positions along any axis, [m].
            turn: Standard deviation of rotations about any axis, [rad].
        """
        more = self.covariances + np.diag(np.square([length] * 3 + [turn] * 3))
        return replace(self, covariances=read_only(more), common_deviations=(length, turn))

    def with_scaled_deviations(self, scales: Array) -> RigMeasurements:
        """The same with the deviations of measured positions and rotations times two factors."""
        each = np.repeat(scales, 3)
        return replace(self, covariances=read_only(self.covariances * np.outer(each, each)))

    @property
    def common_errors(self) -> Array:
        """Twists of the measured poses by one deviation of each common error, shape (n, 6, 9).

        Displacements of the world, rotations of the world about the middle of the poses, and
        rotations of the platform's axes alone, as by tags or a target mounted askew, about the
        measured point. Where no rotation was measured, only displacements; where no pose was, 0.
        """
        length, turn = self.common_deviations
        errors, whole = np.zeros((len(self), 6, 9)), self.has_position & self.has_rotation
        errors[self.has_position, :3, :3] = length * np.eye(3)
        errors[whole, 3:, 3:] = turn * np.hstack([np.eye(3), np.eye(3)])
        origins = self.origins(self.rotations)
        middle = origins[whole].mean(axis=0) if whole.any() else np.zeros(3)
        for k in np.flatnonzero(whole):
            errors[k, :3, 3:6] = -turn * skew(origins[k] - middle)
            errors[k, :3, 6:] = turn * skew(self.positions[k] - origins[k])
        return errors

    def without_poses(self) -> RigMeasurements:
        """The same without measured poses."""
        positions, rotations = (np.full_like(a, np.nan) for a in (self.positions, self.rotations))
        return replace(self, positions=positions, rotations=rotations)


def joined(parts: Sequence[RigMeasurements]) -> RigMeasurements:
    """Several sources as one; duplicate samples are listed as unused."""
    arrays: dict[str, Any] = {
        key: read_only(np.concatenate([getattr(part, key) for part in parts]))
        for key in _PER_SAMPLE
    }
    names = tuple(name for part in parts for name in part.names)
    unused = {name: why for part in parts for name, why in part.unused.items()}
    first: dict[bytes, str] = {}
    new = np.ones(len(names), dtype=bool)
    for k, name in enumerate(names):
        numbers = b"".join(arrays[key][k].tobytes() for key in _ARRAYS[:-1] + _SENSORS)
        earlier = first.setdefault(numbers, name)
        if earlier is not name:
            new[k] = False
            unused[name] = f"has the same numbers as {earlier}"
    return RigMeasurements(names=names, unused=unused, **arrays).part(new)


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Recording of one run.

    Attributes:
        time: Of the cycles, shape (n,), [s].
        setpoints: Shape (n, m), [counts].
        counts: Drive positions, shape (n, m), [counts].
        tensions: Shape (n, m), [N].
        pose_times: Times of the images with a pose, shape (k,), [s].
        positions: Measured positions, world frame, shape (k, 3), [m].
        rotations: ``world_from_platform``, shape (k, 3, 3).
        covariances: Shape (k, 6, 6), [m, rad].
    """

    time: Array
    setpoints: Array
    counts: Array
    tensions: Array
    pose_times: Array
    positions: Array
    rotations: Array
    covariances: Array


def at_rest(name: str, run: Recording) -> RigMeasurements:
    """Samples of a run with the platform at rest, each with the means of its measurements.

    Images of one sample share their errors: the mean is no more certain than a single one. Drives
    that are off at the end of a run measure no tensions: if there are rests with tensions, only
    their time with tensions counts.

    Args:
        name: Of the run, for the names of the samples.
    """
    names, rows, unused = [], [], {}
    still = np.all(np.diff(run.setpoints, axis=0) == 0.0, axis=1)
    taut = np.asarray(np.isfinite(run.tensions).any(axis=1))
    rests = _rests(run.time, still & taut[:-1] & taut[1:]) or _rests(run.time, still)
    for number, (begin, end) in enumerate(rests, start=1):
        sample = f"{name}, rest {number}"
        cycles = (run.time >= begin) & (run.time <= end)
        pictures = (run.pose_times >= begin) & (run.pose_times <= end)
        if len(run.pose_times) and not pictures.any():
            unused[sample] = "no image taken there gave a pose"
            continue
        names.append(sample)
        means = (run.counts[cycles].mean(axis=0), _mean_tensions(run.tensions[cycles]))
        rows.append((*means, *_mean_pose(run, pictures)))
    m = run.counts.shape[1]
    shapes = ((-1, m), (-1, m), (-1, 3), (-1, 3, 3), (-1, 6, 6))
    arrays: dict[str, Any] = {
        key: read_only(np.array([row[i] for row in rows]).reshape(shape))
        for i, (key, shape) in enumerate(zip(_ARRAYS, shapes, strict=True))
    }
    return RigMeasurements(names=tuple(names), unused=unused, **arrays)


def _rests(time: Array, still: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """Intervals of rest without the settling time; ``still``, shape (n - 1,), is from n cycles."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(np.int8)))
    found = [(time[a], time[b]) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return [(a + SETTLING, b) for a, b in found if b - a >= SHORTEST_REST]


def _mean_tensions(tensions: Array) -> Array:
    """Means of the cycles in which all drives answered; NaN without one."""
    known = tensions[np.isfinite(tensions).all(axis=1)]
    means: Array = known.mean(axis=0) if len(known) else np.full(tensions.shape[1], np.nan)
    return means


def _mean_pose(run: Recording, pictures: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
    if not pictures.any():
        return np.full(3, np.nan), np.full((3, 3), np.nan), np.eye(6)
    mean = run.rotations[pictures].mean(axis=0)
    left, _, right = np.linalg.svd(mean)  # rotation nearest to the mean matrix
    rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    covariance = run.covariances[pictures].mean(axis=0)
    return run.positions[pictures].mean(axis=0), rotation, covariance


# CSV files of stationary samples; their columns are in docs/data-formats.md.


_POSITION = ("x_mm", "y_mm", "z_mm")
_ROTATION = ("qw", "qx", "qy", "qz")
_DEVIATIONS = ("std_x_mm", "std_y_mm", "std_z_mm", "std_rx_deg", "std_ry_deg", "std_rz_deg")
_ANGLES = r"(std[\W_]*)?(r(ot)?[\W_]*[xyz]|roll|pitch|yaw)([\W_]*(deg|rad)\w*\W*)?"
"""Names of columns of rotations about axes, which are not read, and of their deviations."""
_TO_SI = np.array([1e-3, 1e-3, 1e-3, *([float(np.radians(1.0))] * 3)])


def read_rig_data(path: Path, cables: int, reflector: Array | None = None) -> RigMeasurements:
    """Reads the samples of a CSV file; poses without a stated deviation are exact.

    Args:
        cables: Number of cables of the rig.
        reflector: Point whose positions it contains, such as the target of a tracker, platform
            frame, shape (3,), [m]; the origin when left out.

    Raises:
        BadInput: It cannot be read, a column is missing, superfluous or not of finite numbers,
            times do not increase, or a quaternion is not of unit length.
    """
    table = CsvTable(path)
    counts = table.of([f"actual_{i}_counts" for i in range(1, cables + 1)])
    if f"actual_{cables + 1}_counts" in table.names:
        raise table.bad(f"the rig has {cables} cables, the file has more", "pass data of this rig")
    n = len(counts)
    if "time_s" in table.names:
        _require_increasing(table)
    tensions = np.full((n, cables), np.nan)
    if _has(table, r"tension_\d+", "n|kn|dan|kgf?|lbf?"):
        tensions = table.of([f"tension_{i}_n" for i in range(1, cables + 1)])
    positions, rotations = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan)
    deviations = np.zeros((n, 6))
    rotated = _has(table, "q_?[wxyz]")
    if rotated or _has(table, "[xyz]", "mm|cm|m|um|in|inch|ft"):
        positions = table.of(_POSITION) / 1e3
    if rotated:
        rotations = _rotations(table)
    else:
        _require_no_angles(table)
    if _has(table, "std_.*"):
        stated = _DEVIATIONS if np.isfinite(rotations).all() else _DEVIATIONS[:3]
        deviations[:, : len(stated)] = table.of(stated) * _TO_SI[: len(stated)]
        if (deviations[:, : len(stated)] <= 0.0).any():
            raise table.bad("a standard deviation is not positive", "leave out what is unknown")
    swivels = _nothing()
    if _has(table, r"swivel_\d+", "deg|rad"):
        swivels = np.radians(table.of([f"swivel_{i}_deg" for i in range(1, cables + 1)]))
    return RigMeasurements(
        names=tuple(f"{path}, line {table.line(k)}" for k in range(n)),
        counts=read_only(counts),
        tensions=read_only(tensions),
        positions=read_only(positions),
        rotations=read_only(rotations),
        covariances=read_only(np.einsum("ni,ij->nij", deviations**2, np.eye(6))),
        swivels=read_only(swivels),
        verticals=read_only(_verticals(table)),
        reflectors=np.zeros(3) if reflector is None else reflector,
    )


def _has(table: CsvTable, names: str, units: str = "") -> bool:
    """Whether any column belongs to a group, all of which is then required; in any case.

    In any of the units, or without: a measurement in another unit is not ignored but refused.
    """
    pattern = rf"({names})([\W_]*({units})\W*)?"
    return any(re.fullmatch(pattern, name, re.IGNORECASE) for name in table.names)


def _require_no_angles(table: CsvTable) -> None:
    """Refuses rotations in other columns than a quaternion's, or their deviations alone."""
    names = [n for n in table.names if re.fullmatch(_ANGLES, n, re.IGNORECASE)]
    if names:
        raise table.bad(
            f"column {names[0]!r} is of a rotation, but there are no columns qw, qx, qy, qz",
            "give rotations as unit quaternions qw, qx, qy, qz of world_from_platform, or leave out"
            f" {', '.join(names)} to calibrate by positions alone",
        )


def _require_increasing(table: CsvTable) -> None:
    times = table.of(["time_s"])[:, 0]
    falls = np.flatnonzero(np.diff(times) <= 0.0)
    if len(falls):
        what = f"line {table.line(int(falls[0]) + 1)}: time_s does not increase"
        raise table.bad(what, "sort the lines by time, or leave out the column")


def _rotations(table: CsvTable) -> Array:
    quaternions = table.of(_ROTATION)
    sizes = np.linalg.norm(quaternions, axis=1)
    wrong = np.flatnonzero(np.abs(sizes - 1.0) > 1e-3)
    if len(wrong):
        k = int(wrong[0])
        what = f"line {table.line(k)}: the quaternion's length is {sizes[k]:.6g}"
        raise table.bad(what, "give unit quaternions qw, qx, qy, qz of world_from_platform")
    return np.array(
        [matrix_from_quaternion(q / s) for q, s in zip(quaternions, sizes, strict=True)]
    )


_AT_REST = {"m_s2": STANDARD_GRAVITY, "g": 1.0}
"""Magnitude of the acceleration read at rest, by the unit in the column names."""
_NOT_AT_REST = 0.05
"""Largest relative deviation from that magnitude at rest."""


def _verticals(table: CsvTable) -> Array:
    """Upward directions from accelerometers, shape (n, 3); empty without them."""
    if not _has(table, "accel_[xyz]", r"m[\W_]*s[\W_]*[2²]|mps2|m?g"):
        return _nothing()
    unit = next((one for one in _AT_REST if _has(table, f"accel_[xyz]_{one}")), "m_s2")
    at_rest = _AT_REST[unit]
    accelerations = table.of([f"accel_{axis}_{unit}" for axis in "xyz"])
    sizes = np.linalg.norm(accelerations, axis=1)
    wrong = np.flatnonzero(np.abs(sizes / at_rest - 1.0) > _NOT_AT_REST)
    if len(wrong):
        k = int(wrong[0])
        what = f"line {table.line(k)}: accel_x_{unit}, accel_y_{unit}, accel_z_{unit} are"
        what += f" {sizes[k]:.3g} in magnitude; at rest it is {at_rest:.3g}"
        raise table.bad(what, "check the unit in the names of the columns, and leave out motion")
    return np.asarray(accelerations / sizes[:, None])
