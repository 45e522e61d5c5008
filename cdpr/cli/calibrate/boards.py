"""Options that describe a calibration board, and `cdpr calibrate print`, which prints it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from calibration.targets.boards import Board, Charuco, Chessboard
from calibration.targets.grids import CircleGrid, TagGrid, TagOrder
from calibration.targets.printing import PaperName, printout
from cdpr.cli.arguments import argument, flag, option
from cdpr.cli.options import JSON
from cdpr.cli.output import present
from model.errors import BadInput
from model.rig import load_rig

BoardName = Literal["chessboard", "charuco", "circles", "tags"]
_NEEDED: dict[BoardName, tuple[str, ...]] = {
    "chessboard": ("square_mm",),
    "charuco": ("square_mm", "marker_mm"),
    "circles": ("spacing_mm", "diameter_mm"),
    "tags": ("tag_mm", "gap_mm"),
}
_SIZES = ("square_mm", "marker_mm", "spacing_mm", "diameter_mm", "tag_mm", "gap_mm")


@dataclass(frozen=True, slots=True)
class BoardOptions:
    """Description of a board; every field is an option of the verbs that use boards."""

    board: BoardName = option("kind of target", default="chessboard")
    columns: int | None = option(
        "inner corners (chessboard), squares (charuco), circles or tags in a row", min=1
    )
    rows: int | None = option("number of rows", min=1)
    square_mm: float | None = option("side of a square (chessboard, charuco)")
    marker_mm: float | None = option("side of a marker (charuco)")
    dictionary: str = option("marker dictionary (charuco), such as 5X5_100", default="4X4_50")
    legacy: bool = flag("charuco layout of OpenCV before 4.6")
    spacing_mm: float | None = option("row spacing, centre to centre (circles)")
    diameter_mm: float | None = option("circle diameter (circles)")
    asymmetric: bool = flag("every other row is shifted (circles)")
    tag_mm: float | None = option("side of a tag's black square (tags)")
    gap_mm: float | None = option("gap between black squares (tags)")
    family: str = option("tag family (tags)", default="tag36h11")
    first: int = option("lowest tag number (tags)", default=0, min=0)
    order: TagOrder = option(
        "numbered from the top left, or as in Kalibr's AprilGrid (tags)", default="rows"
    )

    def made(self) -> Board:
        """The board.

        Raises:
            BadInput: A count or size is missing, does not apply to this board, or is invalid.
        """
        if self.columns is None or self.rows is None:
            raise BadInput(
                "a board needs --columns and --rows",
                next_step="count inner corners (chessboard), squares (charuco), circles or tags",
            )
        count, sides = (self.columns, self.rows), self._sides()
        match self.board:
            case "chessboard":
                return Chessboard(*count, sides[0])
            case "charuco":
                return Charuco(*count, sides[0], sides[1], self.dictionary, self.legacy)
            case "circles":
                return CircleGrid(*count, sides[0], sides[1], self.asymmetric)
            case "tags":
                return TagGrid(*count, sides[0], sides[1], self.family, self.first, self.order)

    def _sides(self) -> list[float]:
        """The sizes of this kind of board, [m]."""
        needed = _NEEDED[self.board]
        sizes: dict[str, float | None] = {name: getattr(self, name) for name in _SIZES}
        if missing := [name for name in needed if sizes[name] is None]:
            raise BadInput(
                f"--board {self.board} needs {_listed(missing)}",
                next_step="measure over many squares of the print with a ruler",
            )
        given = [name for name, size in sizes.items() if size is not None]
        if others := [name for name in given if name not in needed]:
            what = f"--board {self.board} does not take {_listed(others)}"
            raise BadInput(what, next_step="leave it out")
        return [(sizes[name] or 0.0) / 1e3 for name in needed]


def _listed(names: list[str]) -> str:
    return ", ".join(f"--{name.replace('_', '-')}" for name in names)


# `cdpr calibrate print`: boards and tags on paper.


def print_(
    *,
    output: Path = argument("file to write (PDF)", "PDF"),
    printed: BoardOptions,
    rig: Path | None = option("print this rig's tags instead of a board", metavar="RIG"),
    paper: PaperName = option("paper size", default="a4"),
    force: bool = flag("replace an existing file"),
    as_json: bool = JSON,
) -> None:
    """Make a calibration board, or the tags of a rig, as a PDF at exact scale.

    Examples:
      cdpr calibrate print board.pdf --columns 9 --rows 6 --square-mm 25
      cdpr calibrate print board.pdf --board charuco --columns 7 --rows 5 --square-mm 35
          --marker-mm 26 --paper a3
      cdpr calibrate print tags.pdf --rig configs/gachon_8_6.yaml
    """
    if rig is not None and printed != BoardOptions():
        raise BadInput(
            "--rig prints the rig's tags in the sizes of the rig file",
            where="--rig",
            next_step="leave out the board options, or leave out --rig",
        )
    if rig is None and printed == BoardOptions():
        raise BadInput(
            "a board needs --columns and --rows",
            next_step="pass them, or --rig RIG for the tags of a rig",
        )
    made = printout(printed.made() if rig is None else load_rig(rig), paper)
    made.save(output, replace=force)
    pages, what = made.pages, made.what
    step = "print at 100 %, measure the ruler and the squares, glue it to a flat, stiff plate"
    width, height = pages[0].width_mm, pages[0].height_mm
    document = {
        "file": str(output),
        "what": what,
        "paper": paper,
        "pages": len(pages),
        "width_mm": width,
        "height_mm": height,
        "next_steps": [step],
    }
    on = f"{len(pages)} of {paper}, {'portrait' if width < height else 'landscape'}"
    facts = [("what", what), ("pages", on), ("file", str(output)), ("next", step)]
    present(as_json, document, "print", facts)
