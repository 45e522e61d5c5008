"""`cdpr plan`: a path from start to goal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cdpr.cli.calibrations import CalibrationOption
from cdpr.cli.plan_options import (
    BudgetOption,
    CostOption,
    FreeRotationOption,
    FromRunOption,
    IterationsOption,
    LongestOption,
    ModeOption,
    PlannerName,
    PlannerOption,
    RoundsOption,
    ViaOption,
    WeightOption,
)
from cdpr.cli.plan_settings import SettingsOptions, settings_of
from cdpr.cli.readings import (
    ConeDrawOption,
    FailureRateOption,
    FocusOption,
    GoalSightOption,
    SpacingOption,
    SteerOption,
)

if TYPE_CHECKING:
    from cdpr.cli.compiling import Work
    from cdpr.plan_file import PlanDocument
    from cdpr.rig import Rig
    from cdpr.scene import Scene
    from cdpr.scene_stops import StopDocument
    from planner.way import Settings

_LONG = 1000.0
"""Milliseconds or rounds from which a bar is shown."""


def plan(
    rig: Annotated[Path, typer.Argument(help="rig file (YAML)", metavar="RIG")],
    scene: Annotated[Path, typer.Argument(help="scene file (YAML)", metavar="SCENE")],
    output: Annotated[Path, typer.Option("-o", "--output", help="plan file to write (JSON)")],
    seed: Annotated[
        int,
        typer.Option(min=0, help="of the random numbers; with --rounds the same plan again"),
    ] = 0,
    calibration: CalibrationOption = None,
    clearance_mm: Annotated[
        float | None, typer.Option(min=0.0, help="obstacle clearance instead of the scene's")
    ] = None,
    planner: PlannerOption = PlannerName.optimal,
    cost: CostOption = None,
    weight: WeightOption = None,
    longest_mm: LongestOption = None,
    budget_ms: BudgetOption = None,
    rounds: RoundsOption = None,
    free_rotation: FreeRotationOption = False,
    mode: ModeOption = None,
    max_iterations: IterationsOption = None,
    start_mm: Annotated[
        tuple[float, float, float] | None, typer.Option(help="start instead of the scene's: x y z")
    ] = None,
    goal_mm: Annotated[
        tuple[float, float, float] | None, typer.Option(help="goal instead of the scene's: x y z")
    ] = None,
    via_mm: ViaOption = None,
    from_run: FromRunOption = None,
    failure_rate: FailureRateOption = None,
    focus: FocusOption = None,
    cone_draw: ConeDrawOption = None,
    steer: SteerOption = None,
    spacing_mm: SpacingOption = None,
    goal_sight: GoalSightOption = False,
    force: Annotated[bool, typer.Option("--force", help="replace an existing plan file")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="print the result as JSON")] = False,
) -> None:
    """Plan a collision-free path and write it to a file.

    [dim]Examples:[/dim]

      cdpr plan configs/gachon_8_6.yaml configs/environment_1.yaml -o plan.json

      cdpr plan configs/gachon_8_6.yaml configs/environment_3.yaml -o plan.json
      --clearance-mm 20 --cost kinematic --longest-mm 1000

      cdpr plan configs/gachon_8_6.yaml configs/environment_2.yaml -o plan.json
      --planner adaptive --mode paper --seed 7

      cdpr plan configs/gachon_8_6.yaml configs/pick_and_place.yaml -o rest.json
      --from-run runs/stopped
    """
    from cdpr.cli.calibrations import calibrated_rig
    from cdpr.cli.from_run import require_room, scene_after
    from cdpr.cli.output import show_facts, show_json
    from cdpr.cli.stop_facts import by_way_of
    from cdpr.errors import BadInput
    from cdpr.plan import save_plan
    from cdpr.rig import load_rig
    from cdpr.scene import load_scene

    the_rig = calibrated_rig(load_rig(rig), calibration)
    if from_run is not None and start_mm is not None:
        raise BadInput("--from-run and --start-mm both say where to begin", next_step="give one")
    the_scene = _changed(load_scene(scene), start_mm, goal_mm, clearance_mm)
    done: Sequence[StopDocument] = ()
    begun: list[tuple[str, str]] = []
    if from_run is not None:
        the_scene, done, begun = scene_after(the_scene, the_rig, from_run)
        require_room(the_scene, the_rig)
    the_scene = by_way_of(the_scene, via_mm or [])
    check_output(output, force)
    settings = settings_of(
        SettingsOptions(
            planner=planner,
            seed=seed,
            cost=cost,
            weight=weight or (),
            budget_ms=budget_ms,
            rounds=rounds or (),
            longest_mm=longest_mm,
            free_rotation=free_rotation,
            mode=mode,
            max_iterations=max_iterations,
            failure_rate=failure_rate,
            focus=focus,
            cone_draw=cone_draw,
            steer=steer,
            spacing_mm=spacing_mm,
            goal_sight=goal_sight,
        )
    )
    of_legs = rounds if rounds is not None and len(rounds) > 1 else []
    document = planned(the_rig, the_scene, settings, not as_json, of_legs, done)
    save_plan(document, output)
    if as_json:
        show_json({"plan": str(output), **facts_of(document)})
    else:
        next_step = f"cdpr check {output}, then cdpr run {output} --rig {rig} -o RUNDIR"
        show_facts(f"plan {output}", [*begun, *sentences_of(document), ("next", next_step)])


def planned(
    rig: Rig,
    scene: Scene,
    settings: Settings,
    shown: bool,
    rounds: Sequence[int] = (),
    visited: Sequence[StopDocument] = (),
) -> PlanDocument:
    """A plan, made with a bar where the search is long, and a word where it must be compiled."""
    from functools import partial

    from cdpr.cli.compiling import told_when_compiling
    from cdpr.cli.output import progress_bar, spinner
    from planner.plan import make_plan
    from planner.settings import PlannerSettings

    make = partial(make_plan, rig, scene, settings, rounds=rounds, done=visited)
    with told_when_compiling(_work(settings), shown) as compiled:
        if not compiled:
            return make()
        if isinstance(settings, PlannerSettings):
            with progress_bar("planning", settings.max_iterations, shown) as advance:
                return make(progress=lambda done, _most, _distance: advance(done))
        unit, scale = ("ms", 1e3) if settings.rounds is None else ("rounds", 1.0)
        total = scale * (settings.rounds or settings.budget)
        if total < _LONG:
            with spinner("planning", shown):
                return make()
        with progress_bar(f"planning, {unit}", total, shown) as advance:
            return make(progress=lambda done, _most, _cost: advance(scale * done))


def _work(settings: Settings) -> Work:
    from planner.settings import PlannerSettings
    from planner.turning.settings import TurningSettings

    if isinstance(settings, PlannerSettings):
        return "paper"
    return "turning" if isinstance(settings, TurningSettings) else "optimal"


def _changed(
    scene: Scene,
    start_mm: tuple[float, float, float] | None,
    goal_mm: tuple[float, float, float] | None,
    clearance_mm: float | None,
) -> Scene:
    from cdpr.document_types import millimetres
    from cdpr.poses import Pose

    start = None if start_mm is None else Pose.level(millimetres(list(start_mm)))
    goal = None if goal_mm is None else Pose.level(millimetres(list(goal_mm)))
    clearance = None if clearance_mm is None else clearance_mm / 1000.0
    return scene.changed(start=start, goal=goal, clearance=clearance)


def check_output(path: Path, force: bool) -> None:
    """Before the work: a result that cannot be written would be lost.

    Raises:
        BadInput: The file exists, or its folder does not or is read-only.
    """
    import os

    from cdpr.errors import BadInput

    if path.is_dir():
        raise BadInput("this is a folder", where=str(path), next_step="name a file")
    if path.exists() and not force:
        raise BadInput(
            "the file exists already",
            where=str(path),
            next_step="choose another name, or pass --force to replace it",
        )
    if not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
        raise BadInput(
            "the file cannot be written there",
            where=str(path),
            why="the folder does not exist or is read-only",
            next_step="choose a folder that you may write to",
        )


def facts_of(document: PlanDocument) -> dict[str, Any]:
    """What a plan is, for programs."""
    return {
        "hash": document.hash,
        "rig": document.rig.name,
        "scene": document.scene.name,
        "planner": document.planner.model_dump(mode="json"),
        "waypoints": len(document.waypoints),
        "stops": [mark.model_dump(mode="json") for mark in document.stops],
        "quality": document.quality.model_dump(mode="json"),
        "statistics": document.statistics.model_dump(mode="json"),
    }


def sentences_of(document: PlanDocument) -> list[tuple[str, str]]:
    """What a plan is, for people."""
    from cdpr.cli.rotation_facts import rotation_facts
    from cdpr.cli.stop_facts import stop_facts
    from cdpr.scene import scene_from_document

    quality = document.quality
    facts = [
        ("rig, scene", f"{document.rig.name}, {document.scene.name}"),
        *stop_facts(scene_from_document(document.scene)),
        (
            "length",
            f"{quality.length_mm:.1f} mm ({len(document.waypoints)} waypoints;"
            f" {quality.raw_length_mm:.1f} mm {_before(document)})",
        ),
    ]
    facts += rotation_facts(document)
    near = quality.obstacle_clearance
    if near is not None:
        facts.append(("clearance", f"{near.distance_mm:.2f} mm, {near.first} to {near.second}"))
    own = quality.self_clearance
    facts += [
        ("self clearance", f"{own.distance_mm:.2f} mm, {own.first} to {own.second}"),
        ("tension", f"{quality.min_tension_n:.1f} to {quality.max_tension_n:.1f} N"),
        ("kinematic cost", f"{quality.mean_kinematic_cost:.3f} on average"),
        ("search", _search_sentence(document)),
    ]
    return facts


def _before(document: PlanDocument) -> str:
    from cdpr.plan_file import PlannerDocument

    is_paper = isinstance(document.planner, PlannerDocument)
    return "before post-processing" if is_paper else "when first found"


def _search_sentence(document: PlanDocument) -> str:
    from cdpr.plan_file import PlannerDocument

    statistics, planner = document.statistics, document.planner
    rest = f"{statistics.edge_checks} edge checks, {statistics.planning_time_s:.2f} s"
    if not isinstance(planner, PlannerDocument):
        search = f", {(statistics.search_time_s or 0.0) * 1e3:.0f} ms of it searching"
        again = " ".join(f"--rounds {rounds}" for rounds in planner.rounds)
        return f"{sum(planner.rounds)} rounds (again: {again}), {rest}{search}"
    return f"{statistics.nodes} nodes, {statistics.iterations} samples, {rest}"
