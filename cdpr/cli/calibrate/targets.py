"""`cdpr calibrate print`: boards and tags on paper."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from calibration.targets.printing import printout
from cdpr.cli.calibrate.board_options import BoardOptions
from cdpr.cli.options import JsonOption, with_option_groups
from cdpr.cli.output import show_facts, show_json
from model.errors import BadInput
from model.files.documents import write_bytes_atomic
from model.files.output import require_new_file
from model.rig import load_rig


class PaperName(StrEnum):
    """Sizes of paper."""

    a4 = "a4"
    a3 = "a3"
    letter = "letter"


@with_option_groups
def print_(
    output: Annotated[Path, typer.Argument(help="file to write (PDF)", metavar="PDF")],
    printed: BoardOptions,
    rig: Annotated[
        Path | None,
        typer.Option("--rig", help="print this rig's tags instead of a board", metavar="RIG"),
    ] = None,
    paper: Annotated[PaperName, typer.Option(help="paper size")] = PaperName.a4,
    force: Annotated[bool, typer.Option("--force", help="replace an existing file")] = False,
    as_json: JsonOption = False,
) -> None:
    """Make a calibration board, or the tags of a rig, as a PDF in exact size.

    [dim]Examples:[/dim]

      cdpr calibrate print board.pdf --columns 9 --rows 6 --square-mm 25

      cdpr calibrate print board.pdf --board charuco --columns 7 --rows 5 --square-mm 35
      --marker-mm 26 --paper a3

      cdpr calibrate print tags.pdf --rig configs/gachon_8_6.yaml
    """
    if output.suffix.lower() != ".pdf":
        raise BadInput(
            "the output must be a PDF file",
            where=str(output),
            next_step=f"name it {output.with_suffix('.pdf').name}",
        )
    require_new_file(output, force)
    if rig is not None and printed != BoardOptions():
        raise BadInput(
            "--rig prints the rig's tags in the sizes given by its file",
            where="--rig",
            next_step="leave out the board's options, or leave out --rig",
        )
    if rig is None and printed == BoardOptions():
        raise BadInput(
            "a board needs --columns and --rows",
            next_step="pass them, or --rig RIG for the tags of a rig",
        )
    made = printout(printed.made() if rig is None else load_rig(rig), paper.value)
    pages, what = made.pages, made.what
    write_bytes_atomic(output, made.pdf())
    step = "print at 100 %, measure the ruler and the squares, glue it to a flat, stiff plate"
    if as_json:
        show_json(
            {
                "file": str(output),
                "what": what,
                "paper": paper.value,
                "pages": len(pages),
                "width_mm": pages[0].width_mm,
                "height_mm": pages[0].height_mm,
                "next_steps": [step],
            }
        )
    else:
        turned = "upright" if pages[0].width_mm < pages[0].height_mm else "across"
        on = f"{len(pages)} of {paper.value}, {turned}"
        show_facts("print", [("what", what), ("pages", on), ("file", str(output)), ("next", step)])
