"""Options that say which board was printed, and the board that they make."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated

import typer

from cdpr.errors import BadInput

if TYPE_CHECKING:
    from calibration.board import Board


class BoardName(StrEnum):
    """What was printed."""

    chessboard = "chessboard"
    charuco = "charuco"
    tags = "tags"


BoardOption = Annotated[BoardName, typer.Option(help="what was printed")]
ColumnsOption = Annotated[
    int,
    typer.Option(min=1, help="inner corners (chessboard), squares (charuco) or tags in a row"),
]
RowsOption = Annotated[int, typer.Option(min=1, help="how many rows of them")]
SquareOption = Annotated[float | None, typer.Option(help="side of a square (chessboard, charuco)")]
MarkerOption = Annotated[float | None, typer.Option(help="side of a marker (charuco)")]
DictionaryOption = Annotated[str, typer.Option(help="of the markers (charuco), as 5X5_100")]
LegacyOption = Annotated[
    bool, typer.Option("--legacy", help="charuco as OpenCV before 4.6 drew it")
]
TagOption = Annotated[float | None, typer.Option(help="side of a tag's black square (tags)")]
GapOption = Annotated[float | None, typer.Option(help="between black squares (tags)")]
FamilyOption = Annotated[str, typer.Option(help="of the tags (tags)")]
FirstOption = Annotated[int, typer.Option(min=0, help="number of the top left tag (tags)")]

_NEEDED = {
    BoardName.chessboard: ("square",),
    BoardName.charuco: ("square", "marker"),
    BoardName.tags: ("tag", "gap"),
}


def board_of(
    kind: BoardName,
    columns: int,
    rows: int,
    sizes_mm: Mapping[str, float | None],
    dictionary: str,
    legacy: bool,
    family: str,
    first: int,
) -> Board:
    """The board.

    Args:
        kind: What was printed.
        columns: Of inner corners, squares or tags.
        rows: Likewise.
        sizes_mm: Of square, marker, tag and gap, as far as they were given.
        dictionary: Of markers.
        legacy: Whether the board is as OpenCV drew it before 4.6.
        family: Of tags.
        first: Number of the first tag.

    Raises:
        BadInput: A size is missing or one too many is given, or there can be no such board.
    """
    from calibration.charuco import Charuco
    from calibration.chessboard import Chessboard
    from calibration.tag_grid import TagGrid

    needed = _NEEDED[kind]
    given = [name for name, size in sizes_mm.items() if size is not None]
    if missing := [name for name in needed if name not in given]:
        raise BadInput(
            f"--board {kind.value} needs {_listed(missing)}",
            next_step="measure it on the print, with a ruler over many squares",
        )
    if others := [name for name in given if name not in needed]:
        raise BadInput(f"--board {kind.value} knows no {_listed(others)}", next_step="leave it out")
    size = [(sizes_mm[name] or 0.0) / 1000.0 for name in needed]
    match kind:
        case BoardName.chessboard:
            return Chessboard(columns, rows, size[0])
        case BoardName.charuco:
            return Charuco(columns, rows, size[0], size[1], dictionary, legacy)
        case BoardName.tags:
            return TagGrid(columns, rows, size[0], size[1], family, first)


def _listed(names: list[str]) -> str:
    return ", ".join(f"--{name}-mm" for name in names)
