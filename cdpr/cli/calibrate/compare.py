"""`cdpr calibrate diff`: two results side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calibration.compare import compare
from calibration.load import load_result
from cdpr.cli.options import JsonOption
from cdpr.cli.output import show_facts, show_json


def diff(
    first: Annotated[Path, typer.Argument(help="result file (YAML)", metavar="A")],
    second: Annotated[Path, typer.Argument(help="result file (YAML)", metavar="B")],
    as_json: JsonOption = False,
) -> None:
    """Compare two calibration results: every number against its interval, and the effect in mm.

    Exit code 3 where they are further apart than they state.

    [dim]Example:[/dim]

      cdpr calibrate diff calibration_camera_front_2026-03-01.yaml
      calibration_camera_front_2026-06-01.yaml
    """
    one, other = load_result(first), load_result(second)
    found = compare(one, other)
    if as_json:
        show_json(found.as_dict())
    else:
        title = f"{one.kind} {one.name}: from {one.date} to {other.date}"
        facts = [("verdict", str(found)), ("next", found.next_step)]
        facts += [
            (
                change.name,
                f"{change.by:+.3g}, within {change.allowed:.2g} by chance"
                f"{': CHANGED' if change.beyond else ''}",
            )
            for change in found.changes
        ]
        facts += [(name, "in one result only") for name in found.only_in_one]
        show_facts(title, facts)
    if not found.agree:
        raise typer.Exit(3)
