"""`cdpr plan`: a path from start to goal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from shlex import quote
from typing import Annotated

import typer

from cdpr.cli.facts import resumed_facts
from cdpr.cli.options import (
    CalibrationOption,
    JsonOption,
    PlanFileOption,
    ReplacePlanOption,
    RigArgument,
    SceneArgument,
    Triple,
    calibrated_rig,
    with_option_groups,
)
from cdpr.cli.output import Terminal, show_facts, show_json
from cdpr.cli.plan.facts import facts_of, sentences_of
from cdpr.cli.plan.options import DEFAULT_SEARCH, SearchOptions
from executor.recording.resume import require_room, scene_after
from model.errors import BadInput
from model.files.documents import millimetres
from model.files.output import require_new_file
from model.files.scene_file import StopDocument
from model.plan import save_plan
from model.pose import Pose
from model.rig import load_rig
from model.scene import Scene, load_scene
from planner.options import settings_from_options
from planner.planning import plan_path


@with_option_groups
def plan(
    rig: RigArgument,
    scene: SceneArgument,
    output: PlanFileOption,
    seed: Annotated[
        int,
        typer.Option(min=0, help="random seed; with --rounds the plan is reproducible"),
    ] = 0,
    calibration: CalibrationOption = None,
    clearance_mm: Annotated[
        float | None, typer.Option(min=0.0, help="obstacle clearance, overriding the scene's")
    ] = None,
    search: SearchOptions = DEFAULT_SEARCH,
    start_mm: Annotated[
        Triple | None, typer.Option(help="start position x y z, overriding the scene's")
    ] = None,
    goal_mm: Annotated[
        Triple | None, typer.Option(help="goal position x y z, overriding the scene's")
    ] = None,
    via_mm: Annotated[
        list[str] | None,
        typer.Option(
            help="position x y z to pass before the scene's stops; repeatable", metavar="X Y Z"
        ),
    ] = None,
    from_run: Annotated[
        Path | None,
        typer.Option(help="start where this run ended, with the remaining stops", metavar="RUNDIR"),
    ] = None,
    force: ReplacePlanOption = False,
    as_json: JsonOption = False,
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
    the_rig = calibrated_rig(load_rig(rig), calibration)
    if from_run is not None and start_mm is not None:
        raise BadInput(
            "--from-run and --start-mm contradict each other", next_step="leave out one of them"
        )
    the_scene = _changed(load_scene(scene), start_mm, goal_mm, clearance_mm)
    done: Sequence[StopDocument] = ()
    begun: list[tuple[str, str]] = []
    if from_run is not None:
        the_scene, done, end = scene_after(the_scene, the_rig, from_run)
        require_room(the_scene, the_rig)
        begun = resumed_facts(end, from_run, len(done), len(the_scene.stops))
    the_scene = _by_way_of(the_scene, via_mm or [])
    require_new_file(output, force)
    settings = settings_from_options(search.with_seed(seed))
    of_legs = search.rounds if search.rounds and len(search.rounds) > 1 else []
    listener = Terminal(quiet=as_json)
    document = plan_path(the_rig, the_scene, settings, listener, rounds=of_legs, done=done)
    save_plan(document, output)
    if as_json:
        show_json({"plan": str(output), **facts_of(document)})
        return
    more = "".join(f" --calibration {quote(str(file))}" for file in calibration or [])
    file = quote(str(output))
    run_it = f"cdpr run {file} --rig {quote(str(rig))}{more} -o RUNDIR"
    next_step = f"cdpr check {file}, then {run_it}"
    show_facts(f"plan {output}", [*begun, *sentences_of(document), ("next", next_step)])


def _changed(
    scene: Scene, start_mm: Triple | None, goal_mm: Triple | None, clearance_mm: float | None
) -> Scene:
    start = None if start_mm is None else Pose.level(millimetres(list(start_mm)))
    goal = None if goal_mm is None else Pose.level(millimetres(list(goal_mm)))
    clearance = None if clearance_mm is None else clearance_mm / 1000.0
    return scene.changed(start=start, goal=goal, clearance=clearance)


def _by_way_of(scene: Scene, via_mm: Sequence[str]) -> Scene:
    """The scene with level way-poses before its own stops, given as ``x y z`` (`joined_points`).

    Raises:
        BadInput: A way-pose cannot be read.
    """
    ways = []
    for number, text in enumerate(via_mm, start=1):
        try:
            x, y, z = map(float, text.split())
        except ValueError:
            raise BadInput(
                f"--via-mm {text}: three numbers are required", next_step="write --via-mm 0 40 430"
            ) from None
        if not all(map(math.isfinite, (x, y, z))):
            raise BadInput(
                f"--via-mm {text}: finite numbers are required", next_step="write --via-mm 0 40 430"
            )
        ways.append(StopDocument(name=f"via {number}", position_mm=[x, y, z]))
    return scene.changed(stops=[*ways, *scene.document.stops]) if ways else scene
