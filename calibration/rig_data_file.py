"""Reads drive positions at rest from a CSV file; its columns are in docs/data-formats.md."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from calibration.rig_measurements import RigMeasurements
from cdpr.documents import read_text
from cdpr.errors import BadInput
from cdpr.poses import Array, matrix_from_quaternion, read_only

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
        raise table.bad(f"the rig has {cables} cables, the file more", "name the rig's own data")
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
            raise table.bad("a standard deviation is not positive", "leave out what is not known")
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
        rows = list(csv.reader(io.StringIO(read_text(path))))
        self.names = tuple(name.strip() for name in rows[0]) if rows else ()
        self._rows = rows[1:]
        if not self._rows:
            raise self.bad("the file holds no measurement", "write a line of names, then the lines")
        twice = {name for name in self.names if self.names.count(name) > 1}
        if twice:
            raise self.bad(f"the column {min(twice)!r} stands twice", "name each column once")
        for number, row in enumerate(self._rows, start=2):
            if len(row) != len(self.names):
                what = f"line {number} has {len(row)} values for {len(self.names)} columns"
                raise self.bad(what, "give every line as many values as there are names")

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
        raise table.bad(what, "sort the lines by time, or leave the column out")


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
