"""`cdpr examples` lists and copies example files; `cdpr new` asks and writes a rig file."""

from __future__ import annotations

import shlex
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

from cdpr.cli.arguments import argument, flag, option
from cdpr.cli.options import Triple
from cdpr.cli.output import Terminal, out, show_json, show_line
from executor.doctor import home_remarks
from model.errors import BadInput
from model.files.documents import write_atomic
from model.files.examples import (
    copy_examples,
    find_examples,
    rig_text,
    select_examples,
)
from model.files.new_rig import RigQuestion, collect_answers, read_coordinates, size_remarks
from model.files.output import require_new_file
from model.files.reading import ready_folder
from model.rig import load_rig


def examples(
    *,
    names: list[str] | None = argument("examples to copy; without a name, list all", default=None),
    output: Path | None = option(
        "folder to copy to (default: the current one)", "-o", "--output", metavar="DIR"
    ),
    everything: bool = flag("copy all, into configs/ and examples/ as in the repository", "--all"),
    force: bool = flag("replace files that exist"),
    as_json: bool = flag("print the list as JSON", "--json"),
) -> None:
    """List the example rigs, scenes and recorded sessions, or copy some of them.

    Examples:
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


@dataclass(frozen=True, slots=True)
class RigOptions:
    """Answers to the questions of `cdpr new`, by their keys; every field is an option."""

    platform_mm: Triple | None = option("platform size", metavar="X Y Z")
    mass_kg: float | None = option("mass of the platform")
    home_mm: Triple | None = option("home position", metavar="X Y Z")
    lower_mm: Triple | None = option("lower corner of the workspace", metavar="X Y Z")
    upper_mm: Triple | None = option("upper corner of the workspace", metavar="X Y Z")
    radius_mm: float | None = option("radius of the cables")
    stiffness_n: float | None = option("axial stiffness of a cable")
    min_tension_n: float | None = option("smallest allowed tension of a cable")
    max_tension_n: float | None = option("largest tension of a cable")
    drum_radius_mm: float | None = option("radius of the bare drums; the cable's radius is added")
    gear_ratio: float | None = option("motor turns per drum turn")
    counts_per_rev: int | None = option("encoder counts per motor turn")
    encoder: str | None = option("absolute or incremental")
    max_speed_mm_s: float | None = option("largest cable speed")
    torque_constant_n: float | None = option("cable tension at rated motor torque")
    interface: str | None = option("python-can interface of the bus")
    channel: str | None = option("channel of the bus")
    bitrate: int | None = option("bit rate of the bus, bit/s")


def new(
    *,
    output: Path = argument("rig file to write", "RIG"),
    coordinates: Path | None = option(
        "CSV with one line per cable; no questions, defaults for the rest", "--from"
    ),
    values: RigOptions,
    force: bool = flag("replace an existing file"),
) -> None:
    """Ask for the essentials of a rig and write a commented rig file.

    Each question shows a unit and a default, which Enter accepts; values given as options are not
    asked for.

    Examples:
      cdpr new my_rig.yaml
      cdpr new my_rig.yaml --from cables.csv --mass-kg 2.5 --interface socketcan --channel can0
    """
    require_new_file(output, force)
    given = {key: value for key, value in asdict(values).items() if value is not None}
    if coordinates is None:
        answers = collect_answers(output.stem, given, _ask, _refuse)
    else:
        given |= read_coordinates(coordinates)
        answers = collect_answers(output.stem, given)
    write_atomic(output, rig_text(answers))
    name = shlex.quote(str(output))
    show_line(f"wrote {output}: {answers['cables']} cables")
    rig = load_rig(output)
    Terminal().remarks(size_remarks(given), rig.document.remarks(), home_remarks(rig))
    plan = f"cdpr plan {name} SCENE -o plan.json"
    show_line(f"next: review it, then cdpr doctor {name}, and with a scene {plan}")


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
