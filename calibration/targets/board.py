"""Calibration boards: what a calibration needs of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from model.errors import BadInput
from model.files.csv_table import CsvTable
from model.pose import Array, Pose, read_only
from model.rig import Camera
from tracking.camera_model import Image

LEAST_POINTS = 8
"""Of a board in an image: fewer say too little about its pose."""


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """A board in an image.

    Attributes:
        points: In the board's plane, shape (n, 3), [m].
        corners: Where they are in the image, shape (n, 2), [px].
        twice: Numbers of markers or tags that were detected more than once and are left out: it is
            unknown which of them is the board's.
    """

    points: Array
    corners: Array
    twice: tuple[int, ...] = ()


class Board(Protocol):
    """What `calibration.intrinsics.calibrate` needs of a board."""

    def find(self, image: Image) -> Seen | None:
        """The board in a grey image; None where too little of it is to be seen."""
        ...

    def instead(self, image: Image) -> str:
        """What an image without the board shows, for messages; empty where that is unknown."""
        ...

    def __str__(self) -> str:
        """What was looked for, for messages."""
        ...


def mirrored(board: Board, image: Image) -> bool:
    """Whether an image shows the board only when it is flipped over."""
    return board.find(np.ascontiguousarray(image[:, ::-1])) is not None


def require_board(
    holds: bool, what: str, next_step: str = "check the dimensions of the board"
) -> None:
    """Refuses boards that cannot be.

    Raises:
        BadInput: ``holds`` is false.
    """
    if not holds:
        raise BadInput(what, next_step=next_step)


# A camera of which nothing is known but the size of its images.


def plain_camera(size: tuple[int, int], name: str = "camera") -> Camera:
    """A camera as most are: no distortion, and a view of about 53° across.

    Args:
        size: Width and height of its images, [px].
        name: For messages.
    """
    width, height = size
    matrix = np.array([[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]])
    return Camera(name, width, height, matrix, np.zeros(5), Pose.level([0.0, 0.0, 0.0]), 10.0)


# Corners that another program detected, from a CSV file (docs/data-formats.md).

_COLUMNS = ("picture", "x_px", "y_px", "board_x_mm", "board_y_mm")


def read_corners(path: Path) -> dict[str, Seen]:
    """Corners of a flat board by picture, as another program detected them.

    Raises:
        BadInput: The file cannot be read, a column is missing, a number is none, or pictures show
            fewer than `LEAST_POINTS`.
    """
    table = CsvTable(path)
    pictures, numbers = table.texts(_COLUMNS[0]), table.of(_COLUMNS[1:])
    found: dict[str, list[Array]] = {}
    for picture, values in zip(pictures, numbers, strict=True):
        found.setdefault(picture, []).append(values)
    seen = {}
    for picture, corners in found.items():
        if len(corners) < LEAST_POINTS:
            continue
        corners_of = np.array(corners)
        flat = np.column_stack([corners_of[:, 2:] / 1e3, np.zeros(len(corners_of))])
        seen[picture] = Seen(read_only(flat), read_only(corners_of[:, :2]))
    if not seen:
        raise BadInput(
            f"no picture has {LEAST_POINTS} corners",
            where=str(path),
            next_step="write a line for every corner: its picture, pixels and place on the board",
        )
    return seen
