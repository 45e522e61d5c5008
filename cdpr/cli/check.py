"""`cdpr check`: proves a plan by an independent route."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def check(
    plan: Annotated[Path, typer.Argument(help="plan file (JSON)", metavar="PLAN")],
    rig: Annotated[
        Path | None, typer.Option(help="also demand that the plan is for this rig file")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print the result as JSON")] = False,
) -> None:
    """Prove a plan by an independent route: distances on dense poses, with a stated bound.

    Exits with 3 when anything is below what the scene asks.

    [dim]Examples:[/dim]

      cdpr check plan.json

      cdpr check plan.json --rig configs/gachon_8_6.yaml --json
    """
    from cdpr.cli.output import out, show_facts, show_json, spinner
    from cdpr.cli.plan_for_rig import require_same_rig
    from cdpr.plan import load_plan
    from cdpr.rig import load_rig
    from planner.check import check_path

    the_plan = load_plan(plan)
    if rig is not None:
        require_same_rig(the_plan, load_rig(rig), plan)
    with spinner("checking", not as_json):
        report = check_path(the_plan.rig, the_plan.scene, the_plan.waypoints)
    if as_json:
        show_json({"plan": str(plan), "hash": the_plan.document.hash, **report.as_dict()})
    else:
        show_facts(f"check of {plan}", report.sentences())
        for violation in report.violations:
            out.print(f"[red]violated[/red] {violation}")
        out.print("[green]passed[/green]" if report.passed else "[red]not passed[/red]")
    if not report.passed:
        raise typer.Exit(3)
