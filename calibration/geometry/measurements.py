"""What a rig's calibration is made from: drive positions at rest, tensions, and poses if known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from math import radians
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.results import data_hash
from model.files.csv_table import CsvTable
from model.pose import Array, Pose, matrix_from_quaternion, read_only, skew
from model.rig import Rig
from model.statics.gravity import PRETENSION_SHARE, STANDARD_GRAVITY, working_tensions
from model.statics.tension_distribution import TensionInfeasible

SHORTEST_REST = 0.4
"""The drives are commanded to rest for longer before it counts as rest, [s]."""
SETTLING = 0.2
"""What comes sooner after they stopped does not count, [s]."""

_ARRAYS = ("counts", "tensions", "positions", "rotations", "covariances")
_SENSORS = ("swivels", "verticals")


def _nothing() -> Array:
    return np.empty((0, 0))


@dataclass(frozen=True, slots=True, eq=False)
class RigMeasurements:
    """The platform at rest in n places, with m cables.

    Attributes:
        names: Of the places, n texts.
        counts: Drive positions, shape (n, m), [counts].
        tensions: Shape (n, m), [N]; NaN where they were not measured.
        positions: World frame, shape (n, 3), [m]; NaN where they are not known.
        rotations: ``world_from_platform``, shape (n, 3, 3); NaN where they are not known, as of a
            tracker that follows one reflector.
        covariances: Of position and rotation vector about world axes, shape (n, 6, 6).
        unused: Why others were left out, by name.
        reflector: The point of the platform whose positions were measured where rotations are not
            known, platform frame, shape (3,), [m]; else it is the origin.
        swivels: Swivel angles of the pulleys about their feed directions, right-handed, 0 with the
            rig file's platform at home, shape (n, m), [rad]; NaN where they were not measured.
        verticals: Upward unit vectors in the axes of an IMU on the platform, by what its
            accelerometers read at rest, shape (n, 3); NaN where they were not measured.
        swivel_deviation: Of each swivel angle, [rad].
        imu_deviation: Of a vertical's direction about any axis, [rad].
    """

    names: tuple[str, ...]
    counts: Array
    tensions: Array
    positions: Array
    rotations: Array
    covariances: Array
    unused: Mapping[str, str] = field(default_factory=dict)
    reflector: Array = field(default_factory=lambda: np.zeros(3))
    swivels: Array = field(default_factory=_nothing)
    verticals: Array = field(default_factory=_nothing)
    swivel_deviation: float = radians(0.1)
    imu_deviation: float = radians(0.1)

    def __post_init__(self) -> None:
        """Sensors that were left out measured nothing."""
        for key, shape in (("swivels", self.counts.shape), ("verticals", (len(self), 3))):
            if not getattr(self, key).size:
                object.__setattr__(self, key, read_only(np.full(shape, np.nan)))

    def __len__(self) -> int:
        return len(self.names)

    @property
    def posed(self) -> NDArray[np.bool_]:
        """Where the position was measured, shape (n,)."""
        return np.asarray(np.isfinite(self.positions).all(axis=1))

    @property
    def turned(self) -> NDArray[np.bool_]:
        """Where the rotation was measured, shape (n,)."""
        return np.asarray(np.isfinite(self.rotations).all(axis=(1, 2)))

    @property
    def unmeasured(self) -> NDArray[np.int_]:
        """How many of the six numbers of each pose were not measured, shape (n,)."""
        return np.asarray(6 - 3 * self.posed.astype(int) - 3 * self.turned.astype(int))

    def measured_points(self, positions: Array, rotations: Array) -> Array:
        """Points whose positions were measured, of platforms at poses, shape (n, 3), [m].

        Args:
            positions: World frame, shape (n, 3), [m].
            rotations: ``world_from_platform``, shape (n, 3, 3).
        """
        arms = np.where(self.turned[:, None], 0.0, rotations @ self.reflector)
        return np.asarray(positions + arms)

    def pose_information(self, rotations: Array) -> Array:
        """What the measurements say of twists of the poses, shape (n, 6, 6); 0 where nothing.

        Args:
            rotations: ``world_from_platform`` about which, shape (n, 3, 3).
        """
        information = np.zeros((len(self), 6, 6))
        whole = self.posed & self.turned
        information[whole] = np.linalg.inv(self.covariances[whole])
        for k in np.flatnonzero(self.posed & ~self.turned):
            by_twist = np.hstack([np.eye(3), -skew(rotations[k] @ self.reflector)])
            own = np.linalg.inv(self.covariances[k, :3, :3])
            information[k] = by_twist.T @ own @ by_twist
        return information

    def first_rotations(self, rig: Rig) -> Array:
        """Rotations, those of home where they were not measured, shape (n, 3, 3)."""
        known = self.turned[:, None, None]
        return np.where(known, self.rotations, rig.home.rotation)

    @property
    def data_hash(self) -> str:
        """Hash of all numbers."""
        sensors = (a for a in (self.swivels, self.verticals) if np.isfinite(a).any())
        numbers = (self.counts, self.tensions, self.positions, self.rotations, *sensors)
        return data_hash(np.round(values, 12).tobytes() for values in numbers)

    def part(self, chosen: NDArray[np.bool_]) -> RigMeasurements:
        """Some of the places."""
        arrays: dict[str, Any] = {
            key: read_only(getattr(self, key)[chosen]) for key in _ARRAYS + _SENSORS
        }
        names = tuple(n for n, yes in zip(self.names, chosen.tolist(), strict=True) if yes)
        return replace(self, names=names, **arrays)

    def with_doubt(self, deviations: Array) -> RigMeasurements:
        """The same, poses less certain: errors that all images of a place have in common.

        Args:
            deviations: Of camera and tags, shape (6,), [m, rad].
        """
        more = self.covariances + np.diag(np.square(deviations))
        return replace(self, covariances=read_only(more))

    def without_poses(self) -> RigMeasurements:
        """The same drive positions, as if without a camera."""
        positions, rotations = (np.full_like(a, np.nan) for a in (self.positions, self.rotations))
        return replace(self, positions=positions, rotations=rotations)


def joined(parts: Sequence[RigMeasurements]) -> RigMeasurements:
    """Several sources as one; a sample that repeats an earlier one is listed as unused."""
    arrays: dict[str, Any] = {
        key: read_only(np.concatenate([getattr(part, key) for part in parts]))
        for key in _ARRAYS + _SENSORS
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
    """What was recorded of one run.

    Attributes:
        time: Of the cycles, shape (n,), [s].
        asked: Set-points, shape (n, m), [counts].
        counts: Drive positions, shape (n, m), [counts].
        tensions: Shape (n, m), [N].
        seen: Times of the images that gave a pose, shape (k,), [s].
        positions: Measured there, world frame, shape (k, 3), [m].
        rotations: ``world_from_platform``, shape (k, 3, 3).
        covariances: Shape (k, 6, 6), [m, rad].
    """

    time: Array
    asked: Array
    counts: Array
    tensions: Array
    seen: Array
    positions: Array
    rotations: Array
    covariances: Array


def at_rest(name: str, run: Recording) -> RigMeasurements:
    """The places at which the platform stood still, each with the means of what was measured.

    Images of one place have their errors in common: their mean is no more certain than each.

    Args:
        name: Of the run, for the places' names.
        run: What was recorded.
    """
    names, rows, unused = [], [], {}
    for number, (begin, end) in enumerate(_rests(run), start=1):
        place = f"{name}, rest {number}"
        cycles = (run.time >= begin) & (run.time <= end)
        pictures = (run.seen >= begin) & (run.seen <= end)
        if len(run.seen) and not pictures.any():
            unused[place] = "no image taken there gave a pose"
            continue
        names.append(place)
        means = (run.counts[cycles].mean(axis=0), run.tensions[cycles].mean(axis=0))
        rows.append((*means, *_mean_pose(run, pictures)))
    m = run.counts.shape[1]
    shapes = ((-1, m), (-1, m), (-1, 3), (-1, 3, 3), (-1, 6, 6))
    arrays: dict[str, Any] = {
        key: read_only(np.array([row[i] for row in rows]).reshape(shape))
        for i, (key, shape) in enumerate(zip(_ARRAYS, shapes, strict=True))
    }
    return RigMeasurements(names=tuple(names), unused=unused, **arrays)


def _rests(run: Recording) -> list[tuple[float, float]]:
    """From when to when the drives were commanded to rest, without the time of settling."""
    still = np.all(np.diff(run.asked, axis=0) == 0.0, axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(np.int8)))
    found = [(run.time[a], run.time[b]) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return [(a + SETTLING, b) for a, b in found if b - a >= SHORTEST_REST]


def _mean_pose(run: Recording, pictures: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
    if not pictures.any():
        return np.full(3, np.nan), np.full((3, 3), np.nan), np.eye(6)
    mean = run.rotations[pictures].mean(axis=0)
    left, _, right = np.linalg.svd(mean)  # the rotation nearest to the mean of some near ones
    turned = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    covariance = run.covariances[pictures].mean(axis=0)
    return run.positions[pictures].mean(axis=0), turned, covariance


# Reads drive positions at rest from a CSV file; its columns are in docs/data-formats.md.


_POSITION = ("x_mm", "y_mm", "z_mm")
_ROTATION = ("qw", "qx", "qy", "qz")
_DEVIATIONS = ("std_x_mm", "std_y_mm", "std_z_mm", "std_rx_deg", "std_ry_deg", "std_rz_deg")
_TO_SI = np.array([1e-3, 1e-3, 1e-3, *([float(np.radians(1.0))] * 3)])


def read_rig_data(path: Path, cables: int) -> RigMeasurements:
    """The places of a file; poses without a stated deviation are exact.

    Positions without rotations are those of one point, as trackers with one reflector give them.

    Args:
        path: The file.
        cables: How many the rig has.

    Raises:
        BadInput: It cannot be read, or a column is missing, too many, or not of finite numbers; the
            times do not rise; a quaternion is none.
    """
    table = CsvTable(path)
    counts = table.of([f"actual_{i}_counts" for i in range(1, cables + 1)])
    if f"actual_{cables + 1}_counts" in table.names:
        raise table.bad(f"the rig has {cables} cables, the file more", "pass data of this rig")
    n = len(counts)
    if "time_s" in table.names:
        _require_rising(table)
    tensions = np.full((n, cables), np.nan)
    if "tension_1_n" in table.names:
        tensions = table.of([f"tension_{i}_n" for i in range(1, cables + 1)])
    positions, rotations = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan)
    deviations = np.zeros((n, 6))
    if _POSITION[0] in table.names:
        positions = table.of(_POSITION) / 1e3
        if any(name in table.names for name in _ROTATION):
            rotations = _rotations(table)
    if _DEVIATIONS[0] in table.names:
        stated = _DEVIATIONS if np.isfinite(rotations).all() else _DEVIATIONS[:3]
        deviations[:, : len(stated)] = table.of(stated) * _TO_SI[: len(stated)]
        if (deviations[:, : len(stated)] <= 0.0).any():
            raise table.bad("a standard deviation is not positive", "leave out what is unknown")
    swivels = _nothing()
    if "swivel_1_deg" in table.names:
        swivels = np.radians(table.of([f"swivel_{i}_deg" for i in range(1, cables + 1)]))
    return RigMeasurements(
        names=tuple(f"{path}, line {k + 2}" for k in range(n)),
        counts=read_only(counts),
        tensions=read_only(tensions),
        positions=read_only(positions),
        rotations=read_only(rotations),
        covariances=read_only(np.einsum("ni,ij->nij", deviations**2, np.eye(6))),
        swivels=read_only(swivels),
        verticals=read_only(_verticals(table)),
    )


def _require_rising(table: CsvTable) -> None:
    times = table.of(["time_s"])[:, 0]
    falls = np.flatnonzero(np.diff(times) <= 0.0)
    if len(falls):
        what = f"line {table.line(int(falls[0]) + 1)}: time_s does not rise"
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
"""What accelerometers read at rest together, by the unit in the names of their columns."""
_NOT_AT_REST = 0.05
"""A platform at rest has no acceleration that differs from it by more, as a share."""


def _verticals(table: CsvTable) -> Array:
    """Upward directions by accelerometers, shape (n, 3); empty where there are none."""
    units = [unit for unit in _AT_REST if f"accel_x_{unit}" in table.names]
    if not units:
        return _nothing()
    unit, at_rest = units[0], _AT_REST[units[0]]
    accelerations = table.of([f"accel_{axis}_{unit}" for axis in "xyz"])
    sizes = np.linalg.norm(accelerations, axis=1)
    wrong = np.flatnonzero(np.abs(sizes / at_rest - 1.0) > _NOT_AT_REST)
    if len(wrong):
        k = int(wrong[0])
        what = f"line {table.line(k)}: accel_x_{unit}, accel_y_{unit}, accel_z_{unit} are"
        what += f" {sizes[k]:.3g} together; at rest it is {at_rest:.3g}"
        raise table.bad(what, "check the unit in the names of the columns, and leave out motion")
    return np.asarray(accelerations / sizes[:, None])


# Tensions of samples without a measurement of them, and their uncertainty.


def tension_sigma(rig: Rig) -> float:
    """How far off tensions may be that were not measured, one standard deviation, [N].

    Cables of a rig that is not built as its file says pull against each other. They were not slack,
    so the least allowed tension is taken to be two standard deviations below the pretension.
    """
    return PRETENSION_SHARE * (rig.max_tension - rig.min_tension) / 2.0


def nominal_tensions(rig: Rig, measured: RigMeasurements) -> Array:
    """Tensions as measured; else the working ones of the place, shape (n, m), [N].

    Where the pose is not known, or such that the rig file's cables cannot hold the platform there,
    they are those of home: `tension_sigma` holds for both.

    Args:
        rig: As in its file.
        measured: Places at rest.

    Raises:
        TensionInfeasible: The rig cannot hold its platform at home.
    """
    told = np.isfinite(measured.tensions)
    likely = np.tile(working_tensions(rig, rig.home).tensions, (len(measured), 1))
    for k in np.flatnonzero(measured.posed & ~told.all(axis=1)):
        with suppress(TensionInfeasible):
            pose = Pose(measured.positions[k], measured.first_rotations(rig)[k])
            likely[k] = working_tensions(rig, pose).tensions
    return np.where(told, measured.tensions, likely)
