"""`cdpr doctor`: checks whether this machine has what a run needs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import typer
from rich.markup import escape
from rich.table import Table

from cdpr.cli.arguments import argument, flag, option
from cdpr.cli.options import JSON
from cdpr.cli.output import Terminal, err, out, show_json, show_line
from executor.doctor import (
    MachineCheck,
    check_machine,
    check_rig,
    examine,
    home_remarks,
    stopping_text,
)
from model.errors import BadInput
from model.rig import Rig, load_rig

if TYPE_CHECKING:  # needs canopen, which may be missing
    from drivers.cia402.inspection import Examined


def doctor(
    *,
    rig: Path | None = argument("also check this rig's bus and cameras", "[RIG]", default=None),
    camera: list[str] | None = option(
        "also capture an image with this camera: index, device or address; NAME=SOURCE for a camera"
        " other than the rig file's first; repeatable",
        metavar="SOURCE",
    ),
    drives: bool = flag("also read every object of every CANopen drive"),
    as_json: bool = JSON,
) -> None:
    """Check that this machine can run a rig; with a rig file, also its bus and cameras.

    Whatever is missing is listed with the command that fixes it. Nothing is sent on the bus; with
    --drives only read requests are sent, and no drive is changed.

    Examples:
      cdpr doctor
      cdpr doctor rig.yaml --camera 0
      cdpr doctor rig.yaml --drives
    """
    if camera and rig is None:
        raise BadInput(
            "checking a camera needs the rig file that describes it",
            where="--camera",
            next_step="pass the rig file as well: cdpr doctor RIG --camera INDEX",
        )
    if drives and rig is None:
        raise BadInput(
            "reading drives needs the rig file that lists them",
            where="--drives",
            next_step="pass the rig file as well: cdpr doctor RIG --drives",
        )
    checks = check_machine()
    complete = all(check.good for check in checks if check.name != "processors")
    the_rig = None if rig is None else load_rig(rig)
    if the_rig is not None:
        checks += check_rig(the_rig, camera)
    if not as_json:
        _show_checks(checks)
    if the_rig is not None:
        at_home = home_remarks(the_rig) if complete else []  # needs a library
        Terminal().remarks(the_rig.document.remarks(), at_home)
    objects = examine(the_rig) if the_rig is not None and drives else None
    if as_json:
        plain = [asdict(check) for check in checks]
        if objects is None:
            show_json(plain)
        else:
            why = objects.missing.as_dict() if objects.missing else {}
            show_json({"checks": plain, "drives": objects.as_dict(), **why})
    elif objects is not None and the_rig is not None:
        _show_table(objects, the_rig)
    if not all(check.good for check in checks) or (objects is not None and not objects.good):
        raise typer.Exit(4)


def _show_checks(checks: Iterable[MachineCheck]) -> None:
    """One line per check, with the next step where it failed."""
    for check in checks:
        mark = "[green]ok  [/]" if check.good else "[red]miss[/]"
        out.print(f"{mark} {escape(check.name)}: {escape(check.text)}", soft_wrap=True)
        if not check.good and check.fix:
            show_line(f"     next: {check.fix}")


def _show_table(found: Examined, rig: Rig) -> None:
    """Objects that need a change first, then the others, then the total."""
    table = Table("")
    for title in ("object", "needed", "found", "meaning", "change"):
        table.add_column(title, overflow="fold")  # the last one names keys that the user types
    marks = {"wrong": "[red]wrong[/]", "remark": "[yellow]remark[/]", "ok": "[green]ok[/]"}
    for row in sorted(found.rows, key=lambda row: [*marks].index(row.verdict)):
        cells = (row.object, row.needed, row.found_text(found.nodes), row.meaning, row.change)
        table.add_row(marks[row.verdict], *map(escape, cells))
    if found.rows:
        out.print(table)
    for nodes, step in found.silent_facts:
        out.print(f"[red]no answer[/] from drive {', '.join(map(str, nodes))}: {step}")
    wrong = sum(row.verdict == "wrong" for row in found.rows)
    out.print(
        f"{len(found.rows)} objects of {len(found.nodes)} drives read, nothing written;"
        f" {wrong} to change"
    )
    if found.missing is not None:
        show_line(f"error: {found.missing}", err)
    if found.watches_master:
        show_line(stopping_text(rig))
