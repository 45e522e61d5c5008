"""`cdpr plan`: a path from start to goal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from shlex import quote
from typing import Any

from cdpr.cli.arguments import flag, option
from cdpr.cli.options import (
    CALIBRATION,
    JSON,
    PLAN_FILE,
    REPLACE_PLAN,
    RIG,
    SCENE,
    Triple,
    calibrated_rig,
    run_command,
)
from cdpr.cli.output import Terminal, present
from executor.recording.resume import passing, scene_after
from model.errors import BadInput
from model.files.documents import millimetres
from model.files.output import require_new_file
from model.files.plan_file import OptimalPlannerDocument, PlanDocument
from model.files.scene_file import StopDocument
from model.plan import plan_as_dict, plan_facts, save_plan
from model.pose import Pose
from model.rig import load_rig
from model.scene import load_scene
from planner.planning import plan_path
from planner.settings import (
    OBJECTIVES,
    Mode,
    Objective,
    PlannerName,
    PlanningOptions,
    least_rounds,
    settings_from_options,
)


@dataclass(frozen=True, slots=True)
class SearchOptions:
    """Planner and its settings; every field is an option of `cdpr plan`."""

    planner: PlannerName = option(
        "optimal (recommended), or the paper's: adaptive, goal-bias", default="optimal"
    )
    cost: Objective | None = option("objective (default: length; the paper's planners: kinematic)")
    weight: list[str] | None = option(
        "NAME=NUMBER, repeatable for a weighted sum: length, kinematic, …"
    )
    longest_mm: float | None = option("optimal: upper limit of the path length", min=0.001)
    budget_ms: float | None = option(
        "optimal: time for improvement (default: 50 ms; 500 with --free-rotation)", min=0.001
    )
    rounds: list[int] | None = option(
        "optimal: fixed number of improvement rounds (reproducible)", min=1
    )
    free_rotation: bool = flag("optimal: also rotate the platform, within the scene's limits")
    mode: Mode | None = option(
        "the paper's planners: RRT* (rewire), or stop at the first path (paper)"
    )
    max_iterations: int | None = option(
        "the paper's planners: largest number of samples", min=1, max=1_000_000
    )

    def with_seed(self, seed: int) -> PlanningOptions:
        """As options of the planner's library, in SI."""
        given: dict[str, Any] = {one.name: getattr(self, one.name) for one in fields(self)}
        weights, budget, longest = map(given.pop, ("weight", "budget_ms", "longest_mm"))
        given["weights"] = _weights(weights or [])
        given["budget"], given["longest"] = budget and budget / 1e3, longest and longest / 1e3
        return PlanningOptions(seed=seed, **{k: v for k, v in given.items() if v is not None})


def plan(
    *,
    rig: Path = RIG,
    scene: Path = SCENE,
    output: Path = PLAN_FILE,
    seed: int = option("random seed; with --rounds the plan is reproducible", default=0, min=0),
    calibration: list[Path] | None = CALIBRATION,
    clearance_mm: float | None = option("obstacle clearance, overriding the scene's", min=0.0),
    search: SearchOptions,
    start_mm: Triple | None = option("start position x y z, in the scene's start orientation"),
    goal_mm: Triple | None = option("goal position x y z, in the scene's goal orientation"),
    via_mm: list[str] | None = option(
        "position x y z to pass, in the start's orientation, before the scene's stops; repeatable",
        metavar="X Y Z",
    ),
    from_run: Path | None = option(
        "start where this run ended, with the remaining stops", metavar="RUNDIR"
    ),
    force: bool = REPLACE_PLAN,
    as_json: bool = JSON,
) -> None:
    """Plan a collision-free path and write it to a file.

    Examples:
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
    the_scene = load_scene(scene)
    the_scene = the_scene.changed(
        start=None if start_mm is None else _at(start_mm, the_scene.start),
        goal=None if goal_mm is None else _at(goal_mm, the_scene.goal),
        clearance=None if clearance_mm is None else clearance_mm / 1000.0,
    )
    done: Sequence[StopDocument] = ()
    begun: list[tuple[str, str]] = []
    if from_run is not None:
        the_scene, done, end = scene_after(the_scene, the_rig, from_run)
        begun = end.facts(from_run, len(done), len(the_scene.stops))
    the_scene = passing(the_scene, [_via_pose(text, the_scene.start) for text in via_mm or []])
    require_new_file(output, force)
    settings = settings_from_options(search.with_seed(seed))
    of_legs = search.rounds if search.rounds and len(search.rounds) > 1 else []
    listener = Terminal(quiet=as_json)
    listener.remarks(the_scene.remarks(the_rig))
    document = plan_path(the_rig, the_scene, settings, listener, rounds=of_legs, done=done)
    save_plan(document, output)
    run_it = run_command(output, rig, the_rig, calibration)
    next_step = f"cdpr check {quote(str(output))}, then {run_it}"
    facts = [*begun, *plan_facts(document), *_least_rounds(document), ("next", next_step)]
    present(as_json, {"plan": str(output), **plan_as_dict(document)}, f"plan {output}", facts)


def _least_rounds(document: PlanDocument) -> list[tuple[str, str]]:
    """One line where the budget of a leg was spent before the least number of rounds was done."""
    planner, spent = document.planner, (document.statistics.search_time_s or 0.0) * 1e3
    if not isinstance(planner, OptimalPlannerDocument) or planner.budget_ms is None:
        return []
    least = least_rounds(
        has_limit=planner.longest_mm is not None,
        has_clearance=planner.name == "optimal" and planner.weights.clearance > 0.0,
    )
    # Fewer rounds are a straight line, found at once, unless every edge needs a proof.
    legs = [rounds for rounds in planner.rounds if rounds >= least] or planner.rounds
    scarce = sum(rounds <= least for rounds in legs)
    in_them = spent - planner.budget_ms * (len(legs) - scarce)
    if scarce == 0 or in_them < planner.budget_ms * scarce:
        return []
    wanted = math.ceil(in_them / scarce / 10.0) * 100
    return [("rounds", f"only the minimum; --budget-ms {wanted} allows about ten times as many")]


def _weights(texts: Sequence[str]) -> dict[str, float]:
    """Weights of a sum of objectives, by name, from texts ``NAME=NUMBER``."""
    read: dict[str, float] = {}
    for text in texts:
        name, _, number = text.partition("=")
        if name in read:
            raise BadInput(f"--weight {text}: {name!r} appears twice", next_step="give it once")
        if name not in OBJECTIVES:
            raise BadInput(
                f"--weight {text}: {name!r} is not an objective",
                next_step=f"use {', '.join(OBJECTIVES)}",
            )
        try:
            read[name] = float(number)
        except ValueError:
            what = f"--weight {text}: {number!r} is not a number"
            raise BadInput(what, next_step="write --weight length=1") from None
    return read


def _at(position_mm: Triple, other: Pose) -> Pose:
    """The pose at an option's position x y z, with the orientation of another."""
    return Pose(millimetres(list(position_mm)), other.rotation)


def _via_pose(text: str, start: Pose) -> Pose:
    """The pose at ``x y z``, with the start's orientation."""
    hint = "write --via-mm 0 40 430"
    try:
        x, y, z = map(float, text.split())
    except ValueError:
        what = f"--via-mm {text}: three numbers are required"
        raise BadInput(what, next_step=hint) from None
    if not all(map(math.isfinite, (x, y, z))):
        raise BadInput(f"--via-mm {text}: finite numbers are required", next_step=hint)
    return _at((x, y, z), start)
