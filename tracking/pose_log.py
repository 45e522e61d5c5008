"""Measured poses as rows of a table, and the file ``poses.csv`` of ``cdpr track``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np

from model.files.csv_table import quoted
from model.files.documents import write_atomic
from tracking.clearance import MeasuredClearance
from tracking.measurement import NoPose, Observation

_AXES = ("x", "y", "z", "rx", "ry", "rz")
_UNITS = ("mm", "mm", "mm", "deg", "deg", "deg")
SCALES = np.array([1e3, 1e3, 1e3, *([float(np.degrees(1.0))] * 3)])
_PAIRS = tuple(combinations_with_replacement(range(6), 2))


def _covariance_name(i: int, j: int) -> str:
    units = f"{_UNITS[i]}2" if _UNITS[i] == _UNITS[j] else f"{_UNITS[i]}_{_UNITS[j]}"
    return f"cov_{_AXES[i]}_{_AXES[j]}_{units}"


#: Names of the columns, units in the names. Rotations are about the world's axes.
POSITION = tuple(f"{axis}_mm" for axis in "xyz")
ROTATION = tuple(f"q{axis}" for axis in "wxyz")
STD = tuple(f"std_{axis}_{unit}" for axis, unit in zip(_AXES, _UNITS, strict=True))
COVARIANCE = tuple(_covariance_name(i, j) for i, j in _PAIRS)
POSE_COLUMNS = (
    *("frame", "time_s", "status", *POSITION, *ROTATION, *STD, *COVARIANCE),
    *("tags", "reprojection_px", "picture"),
)


#: Further columns if the scene has obstacles.
CLEARANCE_COLUMNS = (
    "clearance_mm",
    "clearance_uncertainty_mm",
    "clearance_at_most_mm",
    "body",
    "obstacle",
)


@dataclass(frozen=True, slots=True, eq=False)
class LoggedImage:
    """Name and measurement of one image.

    Attributes:
        name: Of the image.
        observation: The pose, or the reason why there is none.
        clearance: At the pose, if the scene has obstacles.
        frame: Number of the image in its source; with several cameras, of the frame set.
    """

    name: str
    observation: Observation
    clearance: MeasuredClearance | None = None
    frame: int = 0


def pose_row(logged: LoggedImage) -> tuple[str, ...]:
    """Values of one row, in the order of `POSE_COLUMNS`; empty without a pose."""
    found = logged.observation
    head = (str(logged.frame), f"{found.time:.6f}")
    if isinstance(found, NoPose):
        nothing = ("",) * (len(POSE_COLUMNS) - 4)
        return (*head, found.reason, *nothing, logged.name)
    covariance = found.covariance * np.outer(SCALES, SCALES)
    return (
        *head,
        "ok",
        *(f"{1e3 * x:.6f}" for x in found.pose.position),
        *(f"{q:.9f}" for q in found.pose.quaternion),
        *(f"{d:.6f}" for d in np.sqrt(np.diag(covariance))),
        *(f"{covariance[i, j]:.6e}" for i, j in _PAIRS),
        " ".join(map(str, found.tags)),
        f"{found.reprojection:.4f}",
        logged.name,
    )


def write_pose_log(
    path: Path, pictures: Sequence[LoggedImage], with_clearance: bool = False
) -> None:
    """Writes ``poses.csv`` atomically.

    Args:
        path: The file.
        pictures: Its rows.
        with_clearance: Whether to write the `CLEARANCE_COLUMNS`.

    Raises:
        BadInput: The folder cannot be written to.
    """
    head = POSE_COLUMNS + (CLEARANCE_COLUMNS if with_clearance else ())
    rows = [
        pose_row(logged) + (_clearance_values(logged.clearance) if with_clearance else ())
        for logged in pictures
    ]
    lines = [",".join(quoted(value) for value in row) for row in (head, *rows)]
    write_atomic(path, "\n".join(lines) + "\n")


def _clearance_values(clearance: MeasuredClearance | None) -> tuple[str, ...]:
    """Values of the `CLEARANCE_COLUMNS`; empty without a pose."""
    if clearance is None:
        return ("",) * len(CLEARANCE_COLUMNS)
    nearest = min(clearance.nearest, key=lambda n: n.distance)
    values = (clearance.distance, clearance.uncertainty, clearance.at_most)
    return (*(f"{value * 1e3:.6f}" for value in values), nearest.first, nearest.second)
