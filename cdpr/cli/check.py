"""`cdpr check` verifies a plan by an independent method; `cdpr explain` explains a fault."""

from __future__ import annotations

from pathlib import Path

import typer
from rich.markup import escape

from cdpr.cli.arguments import argument, option
from cdpr.cli.options import CALIBRATION, JSON, calibrated_rig, require_unused
from cdpr.cli.output import Terminal, out, show_facts, show_json, show_line
from drivers.stopping_distance import stopping_remarks
from executor.safety.fault_messages import fault_titles, page_of_fault
from model.plan import load_plan, require_same_rig
from model.rig import load_rig
from model.scene import legs_of
from planner.check import check_path


def check(
    *,
    plan: Path = argument("plan file (JSON)", "PLAN"),
    rig: Path | None = option("also require that the plan fits this rig file"),
    calibration: list[Path] | None = CALIBRATION,
    as_json: bool = JSON,
) -> None:
    """Verify a plan independently: distances at dense poses, with bounds in between.

    Exit code 3 where a value violates the scene's requirements.

    Examples:
      cdpr check plan.json
      cdpr check plan.json --rig configs/gachon_8_6.yaml --json
    """
    the_plan = load_plan(plan)
    if rig is None:
        why = "without --rig, the rig in the plan is used, with the calibration it was made with"
        require_unused("cdpr check", {"--calibration": calibration}, why)
    the_rig = the_plan.rig if rig is None else calibrated_rig(load_rig(rig), calibration)
    require_same_rig(the_plan, the_rig, plan)
    terminal = Terminal(quiet=as_json)
    terminal.remarks(the_plan.scene.remarks(the_rig))
    with terminal.waiting("checking"):
        report = check_path(the_rig, the_plan.scene, the_plan.waypoints, the_plan.stops)
    if report.passed:
        loads = [leg.scene.load for leg in legs_of(the_plan.scene)]
        room = report.proved_obstacle_clearance, report.proved_capacity_margin
        terminal.remarks(stopping_remarks(the_rig, loads, the_plan.waypoints, *room))
    if as_json:
        show_json({"plan": str(plan), "hash": the_plan.document.hash, **report.as_dict()})
    else:
        facts = [*the_plan.scene.stop_facts(), *report.facts()]
        show_facts(f"check of {plan}", facts)
        for violation in report.violations:
            out.print(f"[red]violated[/red] {escape(violation.sentence())}", soft_wrap=True)
        out.print("[green]passed[/green]" if report.passed else "[red]not passed[/red]")
    if not report.passed:
        raise typer.Exit(3)


# `cdpr explain`: meaning, likely cause and next step of a fault.


def explain(
    *,
    code: str | None = argument("code of the fault, such as drive_silent", "CODE", default=None),
) -> None:
    """Explain a fault that a run reported: meaning, likely cause, state of the machine, next step.

    Without a code, lists all of them.

    Example:
      cdpr explain drive_silent
    """
    if code is None:
        for known, title in fault_titles().items():
            show_line(f"  {known:<22} {title}")
        return
    show_line(page_of_fault(code).rstrip())
