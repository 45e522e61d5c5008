"""Detections by the AprilTag library in its own test images."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from model.pose import Array


def tags_found_by_apriltag(listing: Path) -> list[Array]:
    """Corners of every tag of a listing, in the library's order, each of shape (4, 2), [px].

    Its pixel centres are at 0.5, ours at integers.
    """
    rows = [re.findall(r"-?\d+\.\d+", line) for line in listing.read_text().splitlines()]
    return [np.array(row, dtype=np.float64).reshape(4, 2) - 0.5 for row in rows]


def nearest_gap(corners: Array, others: Sequence[Array]) -> float:
    """RMS distance of the corners of a square to those of the nearest of others, [px].

    Each corner is compared with the nearest one, whatever the order of the other square.
    """
    gaps = [np.linalg.norm(corners[:, None] - other[None], axis=2).min(axis=1) for other in others]
    return float(min(np.sqrt(np.mean(gap**2)) for gap in gaps))
