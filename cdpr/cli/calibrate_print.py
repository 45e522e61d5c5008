"""`cdpr calibrate print`: boards and tags on paper."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cdpr.cli.board_options import BoardOptions, with_board_options
from cdpr.cli.calibration_output import JsonOption

if TYPE_CHECKING:
    from calibration.prints import Print


class PaperName(StrEnum):
    """Sizes of paper."""

    a4 = "a4"
    a3 = "a3"
    letter = "letter"


@with_board_options
def print_(
    output: Annotated[Path, typer.Argument(help="file to write (PDF)", metavar="PDF")],
    printed: BoardOptions,
    rig: Annotated[
        Path | None, typer.Option("--rig", help="print this rig's tags, not a board", metavar="RIG")
    ] = None,
    paper: Annotated[PaperName, typer.Option(help="to print on")] = PaperName.a4,
    force: Annotated[bool, typer.Option("--force", help="replace an existing file")] = False,
    as_json: JsonOption = False,
) -> None:
    """Make a board, or the tags of a rig, as PDF in exact size, with the white that they need.

    [dim]Examples:[/dim]

      cdpr calibrate print board.pdf --columns 9 --rows 6 --square-mm 25

      cdpr calibrate print board.pdf --board charuco --columns 7 --rows 5 --square-mm 35
      --marker-mm 26 --paper a3

      cdpr calibrate print tags.pdf --rig configs/gachon_8_6.yaml
    """
    from calibration.pdf import pdf_of
    from calibration.prints import board_print
    from calibration.sheets import sheet_of, sheets_of
    from cdpr.cli.output import show_facts, show_json
    from cdpr.cli.plan import check_output
    from cdpr.documents import write_bytes_atomic
    from cdpr.errors import BadInput

    if output.suffix.lower() != ".pdf":
        raise BadInput(
            "prints are PDF files",
            where=str(output),
            next_step=f"name it {output.with_suffix('.pdf').name}",
        )
    check_output(output, force)
    if rig is not None:
        if printed != BoardOptions():
            raise BadInput(
                "--rig prints the rig's tags in the sizes of its file",
                where="--rig",
                next_step="leave the board's options out, or leave --rig out",
            )
        prints = _tags_of(rig)
        pages, what = sheets_of(prints, paper.value), f"{len(prints)} tags"
    elif printed == BoardOptions():
        raise BadInput(
            "a board needs --columns and --rows",
            next_step="pass them, or --rig RIG for the tags of a rig",
        )
    else:
        made = printed.made()
        pages, what = [sheet_of(board_print(made), paper.value)], str(made)
    write_bytes_atomic(output, pdf_of(pages, f"cdpr: {what}"))
    step = (
        "print it at 100 %, measure the ruler and the squares, glue it on something flat and stiff"
    )
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


def _tags_of(path: Path) -> list[Print]:
    """The tags of a rig file.

    Raises:
        BadInput: It has none.
    """
    from dataclasses import replace

    from calibration.prints import tag_print
    from cdpr.errors import BadInput
    from cdpr.rig import load_rig

    rig = load_rig(path)
    groups = {"platform": rig.platform_tags, "frame": rig.frame_tags}
    if not any(groups.values()):
        raise BadInput("the rig has no tags", where=str(path), next_step="add a `tags` section")
    prints = []
    for group, tags in groups.items():
        for tag in tags:
            made = tag_print(rig.tag_family, tag.id, tag.size)
            prints.append(replace(made, caption=f"{made.caption}, {group}"))
    return prints
