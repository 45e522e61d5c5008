"""`cdpr examples` lists and copies example files; `cdpr new` asks and writes a rig file."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from cdpr.cli.output import out, show_json, show_line
from model.errors import AlreadyExists, BadInput
from model.files.documents import write_atomic
from model.files.examples import (
    copy_examples,
    find_examples,
    ready_folder,
    rig_text,
    select_examples,
)
from model.files.new_rig import OPTIONS, RigQuestion, collect_answers, read_coordinates


def examples(
    names: Annotated[
        list[str] | None, typer.Argument(help="examples to copy; without a name, list all")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", help="folder to copy to (default: the current one)", metavar="DIR"
        ),
    ] = None,
    everything: Annotated[
        bool,
        typer.Option("--all", help="copy all, into configs/ and examples/ as in the repository"),
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="replace files that exist")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="print the list as JSON")] = False,
) -> None:
    """List the example rigs, scenes and recorded sessions, or copy some of them.

    [dim]Examples:[/dim]

      cdpr examples

      cdpr examples gachon_8_6 environment_1 -o my_robot

      cdpr examples --all
    """
    if names and everything:
        raise BadInput("--all copies every example already", next_step="leave out the names")
    if output is not None and not (names or everything):
        raise BadInput("-o needs something to copy", next_step="name an example, or pass --all")
    known = find_examples(ready_folder(), ready_folder("examples"))
    if not names and not everything:
        if as_json:
            show_json([{"name": e.name, "kind": e.kind, "about": e.about} for e in known])
            return
        for example in known:
            line = f"  {example.kind:<8} {example.name:<22} {example.about}"
            show_line(line)
        out.print("next: copy one with `cdpr examples NAME`, or all with `cdpr examples --all`")
        return
    wanted = known if everything else select_examples(known, names or [])
    copies = copy_examples(wanted, output or Path(), grouped=everything, replace=force)
    if as_json:
        show_json([str(path) for path in copies])
        return
    for path in copies:
        show_line(f"copied {path}")


# `cdpr new`: asks for the essentials of a rig, and writes its file.


_Point = tuple[float, float, float]


def new(
    context: typer.Context,
    rig: Annotated[Path, typer.Argument(help="rig file to write")],
    coordinates: Annotated[
        Path | None,
        typer.Option(
            "--from", help="CSV with one line per cable; no questions, defaults for the rest"
        ),
    ] = None,
    platform_mm: Annotated[
        _Point | None, typer.Option(metavar="X Y Z", help="platform size")
    ] = None,
    mass_kg: Annotated[float | None, typer.Option(help="mass of the platform")] = None,
    home_mm: Annotated[_Point | None, typer.Option(metavar="X Y Z", help="home position")] = None,
    lower_mm: Annotated[
        _Point | None, typer.Option(metavar="X Y Z", help="lower corner of the workspace")
    ] = None,
    upper_mm: Annotated[
        _Point | None, typer.Option(metavar="X Y Z", help="upper corner of the workspace")
    ] = None,
    radius_mm: Annotated[float | None, typer.Option(help="radius of the cables")] = None,
    stiffness_n: Annotated[float | None, typer.Option(help="axial stiffness of a cable")] = None,
    min_tension_n: Annotated[
        float | None, typer.Option(help="smallest allowed tension of a cable")
    ] = None,
    max_tension_n: Annotated[float | None, typer.Option(help="largest tension of a cable")] = None,
    drum_radius_mm: Annotated[float | None, typer.Option(help="radius of the drums")] = None,
    gear_ratio: Annotated[float | None, typer.Option(help="motor turns per drum turn")] = None,
    counts_per_rev: Annotated[
        int | None, typer.Option(help="encoder counts per motor turn")
    ] = None,
    encoder: Annotated[str | None, typer.Option(help="absolute or incremental")] = None,
    max_speed_mm_s: Annotated[float | None, typer.Option(help="largest cable speed")] = None,
    torque_constant_n: Annotated[
        float | None, typer.Option(help="cable tension at rated motor torque")
    ] = None,
    interface: Annotated[str | None, typer.Option(help="python-can interface of the bus")] = None,
    channel: Annotated[str | None, typer.Option(help="channel of the bus")] = None,
    bitrate: Annotated[int | None, typer.Option(help="bit rate of the bus, bit/s")] = None,
    force: Annotated[bool, typer.Option("--force", help="replace an existing file")] = False,
) -> None:
    """Ask for the essentials of a rig and write a commented rig file.

    Each question shows a unit and a default, which Enter accepts; values given as options are not
    asked for.

    [dim]Examples:[/dim]

      cdpr new my_rig.yaml

      cdpr new my_rig.yaml --from cables.csv --mass-kg 2.5 --interface socketcan --channel can0
    """
    if rig.exists() and not force:
        raise AlreadyExists("the file exists already", str(rig))
    given = {key: context.params[key] for key in OPTIONS if context.params[key] is not None}
    if coordinates is None:
        answers = collect_answers(rig.stem, given, _ask, _refuse)
    else:
        answers = collect_answers(rig.stem, given | read_coordinates(coordinates))
    write_atomic(rig, rig_text(answers))
    name = shlex.quote(str(rig))
    show_line(f"wrote {rig}: {answers['cables']} cables")
    show_line(f"next: review it, then cdpr doctor {name}, and with a scene cdpr plan {name} SCENE")


def _ask(question: RigQuestion, default: str) -> str:
    """The typed answer; the question goes to standard error, so output can go to a file."""
    unit = f" {question.unit}" if question.unit else ""
    print(f"{question.text} [{default}]{unit}: ", end="", file=sys.stderr, flush=True)
    line = sys.stdin.readline()
    if not line.endswith("\n"):
        print(file=sys.stderr)
        raise BadInput(
            f"no answer to the question about {question.text!r}",
            where="cdpr new",
            why="standard input ended; nothing was written",
            next_step="answer every question, or give the cables with --from FILE.csv",
        )
    return line.strip()


def _refuse(reason: str) -> None:
    print(f"  {reason}; try again", file=sys.stderr)
