"""Calibration boards: what a calibration needs of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from model.errors import BadInput
from model.pose import Array, Pose
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
