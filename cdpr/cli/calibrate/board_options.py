"""Options that say which board was printed, defined once, and the board that they make."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

import typer

from calibration.targets.board import Board
from calibration.targets.charuco import Charuco
from calibration.targets.chessboard import Chessboard
from calibration.targets.circle_grid import CircleGrid
from calibration.targets.tag_grid import TagGrid
from model.errors import BadInput


class BoardName(StrEnum):
    """What was printed."""

    chessboard = "chessboard"
    charuco = "charuco"
    circles = "circles"
    tags = "tags"


class TagOrder(StrEnum):
    """How the tags of a grid are numbered."""

    rows = "rows"
    kalibr = "kalibr"


_NEEDED = {
    BoardName.chessboard: ("square_mm",),
    BoardName.charuco: ("square_mm", "marker_mm"),
    BoardName.circles: ("spacing_mm", "diameter_mm"),
    BoardName.tags: ("tag_mm", "gap_mm"),
}
_SIZES = ("square_mm", "marker_mm", "spacing_mm", "diameter_mm", "tag_mm", "gap_mm")


@dataclass(frozen=True, slots=True)
class BoardOptions:
    """What was said about a board; every field is an option of the verbs that know boards."""

    board: Annotated[BoardName, typer.Option(help="kind of target")] = BoardName.chessboard
    columns: Annotated[
        int | None,
        typer.Option(
            min=1, help="inner corners (chessboard), squares (charuco), circles or tags in a row"
        ),
    ] = None
    rows: Annotated[int | None, typer.Option(min=1, help="number of rows")] = None
    square_mm: Annotated[
        float | None, typer.Option(help="side of a square (chessboard, charuco)")
    ] = None
    marker_mm: Annotated[float | None, typer.Option(help="side of a marker (charuco)")] = None
    dictionary: Annotated[
        str, typer.Option(help="marker dictionary (charuco), such as 5X5_100")
    ] = "4X4_50"
    legacy: Annotated[
        bool, typer.Option("--legacy", help="charuco layout of OpenCV before 4.6")
    ] = False
    spacing_mm: Annotated[
        float | None, typer.Option(help="of neighbouring rows (circles), from centre to centre")
    ] = None
    diameter_mm: Annotated[float | None, typer.Option(help="of a circle (circles)")] = None
    asymmetric: Annotated[
        bool, typer.Option("--asymmetric", help="every other row is shifted (circles)")
    ] = False
    tag_mm: Annotated[float | None, typer.Option(help="side of a tag's black square (tags)")] = None
    gap_mm: Annotated[float | None, typer.Option(help="between black squares (tags)")] = None
    family: Annotated[str, typer.Option(help="of the tags (tags)")] = "tag36h11"
    first: Annotated[int, typer.Option(min=0, help="the smallest number (tags)")] = 0
    order: Annotated[
        TagOrder,
        typer.Option(help="numbered from the top left down, or as Kalibr's AprilGrid (tags)"),
    ] = TagOrder.rows

    def made(self) -> Board:
        """The board.

        Raises:
            BadInput: A number or size is missing or one too many is given, or there can be no such
                board.
        """
        if self.columns is None or self.rows is None:
            raise BadInput(
                "a board needs --columns and --rows",
                next_step="count inner corners (chessboard), squares (charuco), circles or tags",
            )
        count, sides = (self.columns, self.rows), self._sides()
        match self.board:
            case BoardName.chessboard:
                return Chessboard(*count, sides[0])
            case BoardName.charuco:
                return Charuco(*count, sides[0], sides[1], self.dictionary, self.legacy)
            case BoardName.circles:
                return CircleGrid(*count, sides[0], sides[1], self.asymmetric)
            case BoardName.tags:
                order = self.order.value
                return TagGrid(*count, sides[0], sides[1], self.family, self.first, order)

    def _sides(self) -> list[float]:
        """The sizes of this kind of board, [m]."""
        needed = _NEEDED[self.board]
        sizes: dict[str, float | None] = {name: getattr(self, name) for name in _SIZES}
        if missing := [name for name in needed if sizes[name] is None]:
            raise BadInput(
                f"--board {self.board.value} needs {_listed(missing)}",
                next_step="measure over many squares of the print with a ruler",
            )
        given = [name for name, size in sizes.items() if size is not None]
        if others := [name for name in given if name not in needed]:
            what = f"--board {self.board.value} does not take {_listed(others)}"
            raise BadInput(what, next_step="leave it out")
        return [(sizes[name] or 0.0) / 1e3 for name in needed]


def _listed(names: list[str]) -> str:
    return ", ".join(f"--{name.replace('_', '-')}" for name in names)
