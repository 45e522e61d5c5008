"""What is black on boards and tags: rectangles in exact size, and the white they need around."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.board import Board
from calibration.charuco import Charuco
from calibration.chessboard import Chessboard
from calibration.tag_grid import TagGrid
from cdpr.errors import BadInput
from cdpr.poses import Array
from tracking.marks import modules_across, official_modules


@dataclass(frozen=True, slots=True, eq=False)
class Print:
    """Something to be printed.

    Attributes:
        black: Left, top, width and height of black rectangles, from the top left of what is
            printed, shape (n, 4), [m].
        size: Width and height of what is printed, shape (2,), [m].
        quiet: Width of the white that must surround it, [m].
        caption: What it is, printable ASCII.
    """

    black: Array
    size: Array
    quiet: float
    caption: str


def board_print(board: Board) -> Print:
    """The print of a calibration board.

    Raises:
        BadInput: Its tags would touch.
    """
    match board:
        case Chessboard():
            return _chessboard(board)
        case Charuco():
            return _charuco(board)
        case TagGrid():
            return _tag_grid(board)
        case _:
            raise TypeError(f"no print of {board}")


def tag_print(family: str, number: int, size: float) -> Print:
    """The print of a single tag whose black square has side ``size`` [m]."""
    module = size / modules_across(family)
    black = _modules(~official_modules(family, number), np.zeros(2), module)
    caption = f"{family} {number}, black square {size * 1e3:g} mm"
    return Print(black, np.full(2, size), module, caption)


def _chessboard(board: Chessboard) -> Print:
    """One square more than inner corners each way, the one at the top left black."""
    rows, columns = np.indices((board.rows + 1, board.columns + 1))
    black = _modules((rows + columns) % 2 == 0, np.zeros(2), board.square)
    size = np.array([board.columns + 1, board.rows + 1]) * board.square
    caption = f"{board}, squares {board.square * 1e3:g} mm"
    return Print(black, size, _quiet(board.square), caption)


def _charuco(board: Charuco) -> Print:
    """Squares that hold a marker are white, the others black."""
    markers = board.markers()
    black = np.ones((board.rows, board.columns), dtype=np.bool_)
    parts = []
    for corner, modules in markers:
        column, row = np.floor((corner + board.marker / 2.0) / board.square).astype(int)
        black[row, column] = False
        parts.append(_modules(~modules, corner, board.marker / len(modules)))
    squares = _modules(black, np.zeros(2), board.square)
    caption = (
        f"{board}, squares {board.square * 1e3:g} mm, markers {board.marker * 1e3:g} mm"
        f"{', legacy' if board.legacy else ''}"
    )
    size = np.array([board.columns, board.rows]) * board.square
    return Print(np.concatenate([squares, *parts]), size, _quiet(board.square), caption)


def _tag_grid(board: TagGrid) -> Print:
    module = board.tag / modules_across(board.family)
    if board.gap < module:
        raise BadInput(
            f"the gap between tags is {board.gap * 1e3:g} mm, less than a module of them"
            f" ({module * 1e3:.3g} mm)",
            where="--gap-mm",
            why="a tag is found by the white around it",
            next_step=f"use {2.0 * module * 1e3:.3g} mm or more",
        )
    step = board.tag + board.gap
    parts = []
    for place in range(board.columns * board.rows):
        row, column = divmod(place, board.columns)
        modules = ~official_modules(board.family, board.first + place)
        parts.append(_modules(modules, np.array([column, row]) * step, module))
    size = np.array([board.columns, board.rows]) * step - board.gap
    caption = f"{board}, black squares {board.tag * 1e3:g} mm, gaps {board.gap * 1e3:g} mm"
    return Print(np.concatenate(parts), size, max(module, board.gap / 2.0), caption)


def _quiet(square: float) -> float:
    """White around a chessboard, [m]: enough to tell its outermost squares from the table."""
    return min(square / 3.0, 0.008)


def _modules(black: NDArray[np.bool_], corner: Array, side: float) -> Array:
    """Rectangles of the black modules of a grid, runs along a row joined, shape (n, 4), [m]."""
    found = []
    for row, line in enumerate(black):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(np.int8), [0]])))
        for first, after in edges.reshape(-1, 2).tolist():
            left, top = corner + np.array([first, row]) * side
            found.append([left, top, (after - first) * side, side])
    return np.array(found).reshape(-1, 4)
