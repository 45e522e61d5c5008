"""What a rig's calibration is made from: drive positions at rest, tensions, and poses if known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.results import data_hash
from model.errors import BadInput
from model.files.reading import CsvFile
from model.pose import Array, Pose, matrix_from_quaternion, read_only
from model.rig import Rig
from model.statics.gravity import PRETENSION_SHARE, working_tensions
from model.statics.tension_distribution import TensionInfeasible

SHORTEST_REST = 0.4
"""The drives are commanded to rest for longer before it counts as rest, [s]."""
SETTLING = 0.2
"""What comes sooner after they stopped does not count, [s]."""

_ARRAYS = ("counts", "tensions", "positions", "rotations", "covariances")


@dataclass(frozen=True, slots=True, eq=False)
class RigMeasurements:
    """The platform at rest in n places, with m cables.

    Attributes:
        names: Of the places, n texts.
        counts: Drive positions, shape (n, m), [counts].
        tensions: Shape (n, m), [N]; NaN where they were not measured.
        positions: World frame, shape (n, 3), [m]; NaN where the pose is not known.
        rotations: ``world_from_platform``, shape (n, 3, 3); NaN where the pose is not known.
        covariances: Of position and rotation vector about world axes, shape (n, 6, 6).
        unused: Why others were left out, by name.
    """

    names: tuple[str, ...]
    counts: Array
    tensions: Array
    positions: Array
    rotations: Array
    covariances: Array
    unused: Mapping[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def posed(self) -> NDArray[np.bool_]:
        """Where the pose was measured, shape (n,)."""
        return np.asarray(np.isfinite(self.positions).all(axis=1))

    @property
    def data_hash(self) -> str:
        """Hash of all numbers."""
        numbers = (self.counts, self.tensions, self.positions, self.rotations)
        return data_hash(np.round(values, 12).tobytes() for values in numbers)

    def part(self, chosen: NDArray[np.bool_]) -> RigMeasurements:
        """Some of the places."""
        return RigMeasurements(
            names=tuple(n for n, yes in zip(self.names, chosen.tolist(), strict=True) if yes),
            unused=self.unused,
            **{key: read_only(getattr(self, key)[chosen]) for key in _ARRAYS},
        )

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
    arrays = {
        key: read_only(np.concatenate([getattr(part, key) for part in parts])) for key in _ARRAYS
    }
    names = tuple(name for part in parts for name in part.names)
    unused = {name: why for part in parts for name, why in part.unused.items()}
    first: dict[bytes, str] = {}
    new = np.ones(len(names), dtype=bool)
    for k, name in enumerate(names):
        numbers = b"".join(arrays[key][k].tobytes() for key in _ARRAYS[:-1])
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
    arrays = {
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

    Args:
        path: The file.
        cables: How many the rig has.

    Raises:
        BadInput: It cannot be read, or a column is missing, too many, or not of finite numbers; the
            times do not rise; a quaternion is none.
    """
    table = _Table(path)
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
        rotations = _rotations(table)
    if _DEVIATIONS[0] in table.names:
        deviations = table.of(_DEVIATIONS) * _TO_SI
        if (deviations <= 0.0).any():
            raise table.bad("a standard deviation is not positive", "leave out what is unknown")
    return RigMeasurements(
        names=tuple(f"{path}, line {k + 2}" for k in range(n)),
        counts=read_only(counts),
        tensions=read_only(tensions),
        positions=read_only(positions),
        rotations=read_only(rotations),
        covariances=read_only(np.einsum("ni,ij->nij", deviations**2, np.eye(6))),
    )


class _Table:
    """Named columns of texts."""

    def __init__(self, path: Path) -> None:
        self._path = path
        rows = CsvFile(path).rows
        self.names = tuple(name.strip() for name in rows[0]) if rows else ()
        self._rows = rows[1:]
        if not self._rows:
            raise self.bad(
                "the file holds no measurement", "write a header line, then lines of values"
            )
        twice = {name for name in self.names if self.names.count(name) > 1}
        if twice:
            raise self.bad(f"the column {min(twice)!r} appears twice", "name each column once")
        for number, row in enumerate(self._rows, start=2):
            if len(row) != len(self.names):
                what = f"line {number} has {len(row)} values for {len(self.names)} columns"
                raise self.bad(what, "give every line one value per column")

    def of(self, names: list[str] | tuple[str, ...]) -> Array:
        """Columns side by side, shape (n, len(names)); all finite."""
        for name in names:
            if name not in self.names:
                raise self.bad(f"the column {name!r} is missing", "see docs/data-formats.md")
        return np.array(
            [[self._number(row, name, k) for name in names] for k, row in self._lines()]
        )

    def _lines(self) -> list[tuple[int, list[str]]]:
        return list(enumerate(self._rows, start=2))

    def _number(self, row: list[str], name: str, line: int) -> float:
        text = row[self.names.index(name)]
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not np.isfinite(value):
            what = f"line {line}, {name}: {text!r} is not a finite number"
            raise self.bad(what, "leave out lines that were not measured")
        return value

    def bad(self, what: str, next_step: str) -> BadInput:
        """The error about this file."""
        return BadInput(what, where=str(self._path), next_step=next_step)


def _require_rising(table: _Table) -> None:
    times = table.of(["time_s"])[:, 0]
    falls = np.flatnonzero(np.diff(times) <= 0.0)
    if len(falls):
        what = f"line {falls[0] + 3}: time_s does not rise"
        raise table.bad(what, "sort the lines by time, or leave out the column")


def _rotations(table: _Table) -> Array:
    quaternions = table.of(_ROTATION)
    sizes = np.linalg.norm(quaternions, axis=1)
    wrong = np.flatnonzero(np.abs(sizes - 1.0) > 1e-3)
    if len(wrong):
        k = int(wrong[0])
        what = f"line {k + 2}: the quaternion's length is {sizes[k]:.6g}"
        raise table.bad(what, "give unit quaternions qw, qx, qy, qz of world_from_platform")
    return np.array(
        [matrix_from_quaternion(q / s) for q, s in zip(quaternions, sizes, strict=True)]
    )


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
            pose = Pose(measured.positions[k], measured.rotations[k])
            likely[k] = working_tensions(rig, pose).tensions
    return np.where(told, measured.tensions, likely)
