"""`cdpr calibrate diff`: two results side by side."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cdpr.cli.calibration_output import JsonOption

if TYPE_CHECKING:
    from calibration.comparison import Comparison


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
    from calibration.comparison import compare
    from calibration.kinds import load_result
    from cdpr.cli.output import show_facts, show_json

    one, other = load_result(first), load_result(second)
    found = compare(one, other)
    if as_json:
        show_json(_plain(found))
    else:
        title = f"{one.kind} {one.name}: from {one.date} to {other.date}"
        facts = [("verdict", str(found)), ("next", _next_step(found))]
        facts += [
            (
                change.name,
                f"{change.by:+.3g}, within {change.allowed:.2g} by chance"
                f"{': CHANGED' if change.beyond else ''}",
            )
            for change in found.changes
        ]
        facts += [(name, "in one of them only") for name in found.only_in_one]
        show_facts(title, facts)
    if not found.agree:
        raise typer.Exit(3)


def _next_step(found: Comparison) -> str:
    if found.agree:
        return "use the newer one, or the one with the smaller intervals"
    return "find out what was changed, moved or refocused between them; calibrate once more"


def _plain(found: Comparison) -> dict[str, object]:
    return {
        "verdict": str(found),
        "agree": found.agree,
        "next_steps": [_next_step(found)],
        "apart_mm": found.apart_mm,
        "stated_mm": found.stated_mm,
        "changes": {
            change.name: {
                "by": change.by,
                "allowed": change.allowed,
                "beyond": change.beyond,
                "first": change.first.bounds,
                "second": change.second.bounds,
            }
            for change in found.changes
        },
        "only_in_one": list(found.only_in_one),
    }
