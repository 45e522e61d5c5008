"""Poses of the platform by the names of pictures, from a CSV file with units in its columns."""

from __future__ import annotations

import csv
import math
from io import StringIO
from pathlib import Path

import numpy as np

from cdpr.documents import read_text
from cdpr.errors import InvalidFile, Problem
from cdpr.poses import Pose

COLUMNS = ("picture", "x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz")
"""As in the pose log of `cdpr track`; other columns are not looked at."""


def read_poses(path: Path) -> dict[str, Pose]:
    """Reads ``world_from_platform`` by picture; rows without a pose are left out.

    Raises:
        BadInput: The file cannot be read.
        InvalidFile: With every row that cannot be used.
    """
    rows = csv.DictReader(StringIO(read_text(path)))
    if missing := [name for name in COLUMNS if name not in (rows.fieldnames or ())]:
        raise InvalidFile(str(path), [Problem("", f"no column {', '.join(missing)}", 1, 1)])
    poses: dict[str, Pose] = {}
    problems = []
    for row in rows:
        picture = Path(row["picture"] or "").name
        values = [(row[name] or "").strip() for name in COLUMNS[1:]]
        if not any(values):  # as of a picture that gave no pose
            continue
        found = _pose(values)
        if isinstance(found, str):
            problems.append(Problem(picture, found, rows.line_num, 1))
        elif not picture or picture in poses:
            what = "this picture stands twice" if picture else "no picture is named"
            problems.append(Problem(picture, what, rows.line_num, 1))
        else:
            poses[picture] = found
    if problems:
        raise InvalidFile(str(path), problems)
    return poses


def _pose(values: list[str]) -> Pose | str:
    """The pose, or what is wrong with it."""
    try:
        numbers = np.array([float(value) for value in values])
    except ValueError:
        return f"{', '.join(values)} are not seven numbers"
    if not all(map(math.isfinite, numbers)):
        return "a number is not finite"
    length = float(np.linalg.norm(numbers[3:]))
    if abs(length - 1.0) > 1e-3:
        return f"qw, qx, qy, qz must have length 1, they have {length:.4g}"
    return Pose.from_quaternion(numbers[:3] / 1e3, numbers[3:] / length)
