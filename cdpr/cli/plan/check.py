"""`cdpr check`: proves a plan by an independent route."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from cdpr.cli.options import JsonOption
from cdpr.cli.output import Terminal, out, show_facts, show_json
from cdpr.cli.plan.facts import stop_facts
from model.plan import load_plan, require_same_rig
from model.rig import load_rig
from planner.check import check_path
from planner.check_report import CheckReport, Closest


def check(
    plan: Annotated[Path, typer.Argument(help="plan file (JSON)", metavar="PLAN")],
    rig: Annotated[
        Path | None,
        typer.Option(help="check against this rig file as it is now"),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Check a plan with an independent method: distances at dense poses, with bounds.

    Exits with 3 when anything is below what the scene asks.

    [dim]Examples:[/dim]

      cdpr check plan.json

      cdpr check plan.json --rig configs/gachon_8_6.yaml --json
    """
    the_plan = load_plan(plan)
    the_rig = the_plan.rig if rig is None else load_rig(rig)
    require_same_rig(the_plan, the_rig, plan)
    with Terminal(quiet=as_json).waiting("checking"):
        report = check_path(the_rig, the_plan.scene, the_plan.waypoints, the_plan.stops)
    if as_json:
        show_json({"plan": str(plan), "hash": the_plan.document.hash, **report.as_dict()})
    else:
        facts = [*stop_facts(the_plan.scene), *sentences_of(report)]
        show_facts(f"check of {plan}", facts)
        for violation in report.violations:
            out.print(f"[red]violated[/red] {violation.sentence()}", soft_wrap=True)
        out.print("[green]passed[/green]" if report.passed else "[red]not passed[/red]")
    if not report.passed:
        raise typer.Exit(3)


def sentences_of(report: CheckReport) -> list[tuple[str, str]]:
    """What the check found, for people."""
    own = report.self_clearance
    facts = [
        ("length", f"{report.length * 1000:.1f} mm, {report.samples} poses checked"),
        (
            "self clearance",
            _distance(own, report.proved_self_clearance, report.required_self_clearance),
        ),
        ("tension", _tensions(report)),
        (
            "capacity margin",
            f"{report.capacity_margin:.1f} N; proved {report.proved_capacity_margin:.1f} N",
        ),
        ("cable speed", f"up to {report.max_cable_speed * 1000:.1f} mm/s at these poses"),
    ]
    near = report.obstacle_clearance
    if near is not None:
        text = _distance(near, report.proved_obstacle_clearance, report.required_obstacle_clearance)
        facts.insert(1, ("clearance", text))
    return facts


def _tensions(report: CheckReport) -> str:
    if math.isnan(report.min_tension):
        return "no tensions within the limits hold the weight"
    return f"{report.min_tension:.1f} to {report.max_tension:.1f} N at these poses"


def _distance(closest: Closest, proved: float, required: float) -> str:
    near = closest.nearest
    x, y, z = closest.pose.position * 1000
    return (
        f"{near.distance * 1000:.2f} mm, {near.first} to {near.second}, with the platform at"
        f" {x:z.1f}, {y:z.1f}, {z:z.1f} mm; proved {proved * 1000:.2f} mm,"
        f" required {required * 1000:g} mm"
    )
