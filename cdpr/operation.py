"""For scripts: what `cdpr plan`, `check`, `workspace`, `stop`, `hold` … `report` do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from executor.evaluation import rewrite_report
from executor.recording.resume import passing, scene_after
from executor.recording.run_folder import RunFolder
from executor.remote.client import no_answer, no_run, request_run, stop_runs
from executor.supervision import FASTEST, SLOWEST
from model.errors import (
    BadInput,
    path_of,
    real_number,
    require_types,
    sequence_of,
    truth_value,
)
from model.files.scene_file import StopDocument
from model.plan import Plan, plan_from_document, require_same_rig
from model.pose import Array, Pose, point_of
from model.progress import SILENT, Listener
from model.rig import Rig
from model.scene import Scene, require_unaltered
from planner.check import verify
from planner.check_report import CheckReport
from planner.planning import plan_path
from planner.settings import (
    Mode,
    Objective,
    PlannerName,
    PlanningOptions,
    settings_from_options,
    whole_number,
)
from planner.workspace.compute import Maps, map_workspace, workspace_grids
from planner.workspace.maps import Question

__all__ = ["check", "hold", "plan", "report", "resume", "set_speed", "stop", "workspace_map"]

#: Largest number of processes that share a map.
MOST_WORKERS = 1024


def plan(
    rig: Rig,
    scene: Scene,
    *,
    planner: PlannerName = "optimal",
    cost: Objective | None = None,
    weights: Mapping[str, float] | None = None,
    budget: float | None = None,
    rounds: int | Sequence[int] | None = None,
    seed: int = 0,
    longest: float | None = None,
    free_rotation: bool = False,
    start: Pose | None = None,
    goal: Pose | None = None,
    via: Sequence[Pose] = (),
    from_run: Path | str | None = None,
    clearance: float | None = None,
    mode: Mode | None = None,
    max_iterations: int | None = None,
    listener: Listener = SILENT,
) -> Plan:
    """Plans a path from the scene's start through its stops to its goal.

    Args:
        rig: The robot.
        scene: Obstacles, clearances, load, start, stops and goal.
        planner: ``optimal``, or the paper's ``adaptive`` and ``goal-bias``.
        cost: Objective: ``length``, ``kinematic``, ``clearance``, ``capacity`` (default:
            ``length``; the paper's planners, which take only the first two: ``kinematic``).
        weights: Instead of a cost: weights of a weighted sum, by objective.
        budget: Time for search and improvement, [s] (default: 0.05; 0.5 with `free_rotation`).
            The result depends on the computer's speed.
        rounds: Instead of a budget: number of rounds, for all legs together or for each.
            The same rounds and seed give the same path.
        seed: Random seed.
        longest: Upper limit of the path length, [m].
        free_rotation: The platform may rotate, within the scene's limits.
        start: Overrides the scene's start, ``world_from_platform``.
        goal: Overrides the scene's goal, ``world_from_platform``.
        via: Poses to pass before the scene's stops; the platform comes to rest at each.
        from_run: Folder of a run that ended early: the plan starts there and visits the remaining
            stops.
        clearance: Overrides the scene's obstacle clearance, [m].
        mode: The paper's planners: ``rewire`` (RRT*), or ``paper`` to stop at the first path.
        max_iterations: The paper's planners: largest number of samples.
        listener: Receives the progress of a long search.

    Returns:
        The plan, which has passed `cdpr.check`.

    Raises:
        BadInput: Start, goal or a stop cannot be used, or arguments contradict each other.
        Refused: The pose at the end of the run is unknown.
        NoSolution: There is no path, or the search ended at its limit.
    """
    via = sequence_of("via", via)
    require_types((rig, Rig), (scene, Scene), (listener, Listener))
    require_unaltered(rig, scene)
    require_types(*((pose, Pose) for pose in via), optional=((start, Pose), (goal, Pose)))
    if from_run is not None and start is not None:
        raise BadInput(
            "from_run and start contradict each other", next_step="leave out one of them"
        )
    of_legs: list[Any] = []
    if rounds is not None:
        several = np.iterable(rounds) and not isinstance(rounds, str)
        of_legs = list(rounds) if several else [rounds]  # type: ignore[arg-type]
    settings = settings_from_options(
        PlanningOptions(
            planner=planner,
            seed=seed,
            cost=cost,
            weights={} if weights is None else weights,
            budget=None if budget is None else real_number("budget", budget, "s"),
            rounds=of_legs,
            longest=None if longest is None else real_number("longest", longest, "m"),
            free_rotation=truth_value("free_rotation", free_rotation),
            mode=mode,
            max_iterations=max_iterations,
        )
    )
    scene = scene.changed(start=start, goal=goal, clearance=clearance)
    done: Sequence[StopDocument] = ()
    if from_run is not None:
        scene, done, _ = scene_after(scene, rig, path_of(from_run))
    scene = passing(scene, via)
    each = of_legs if len(of_legs) > 1 else ()
    return plan_from_document(plan_path(rig, scene, settings, listener, rounds=each, done=done))


def check(plan: Plan, rig: Rig | None = None) -> CheckReport:
    """Verifies a plan by an independent method: distances at dense poses, with bounds between.

    Args:
        plan: The plan, with its scene.
        rig: The robot as it is now (default: the plan's).

    Returns:
        The figures of the path; those named `proved_` hold everywhere on it.

    Raises:
        BadInput: An argument is of another type, or the plan was made for another rig.
        PlanRejected: With every violation: what, by how much, and where.
    """
    require_types((plan, Plan))
    the_rig = plan.rig if rig is None else rig
    require_types((the_rig, Rig))
    require_same_rig(plan, the_rig, f"plan for {plan.rig.name} in {plan.scene.name}")
    return verify(plan, the_rig).report


def workspace_map(
    rig: Rig,
    scene: Scene | None = None,
    *,
    slices: Sequence[tuple[Literal["x", "y", "z"], float]] = (),
    volume: bool | None = None,
    step: float | None = None,
    lower: ArrayLike | None = None,
    upper: ArrayLike | None = None,
    rotation: Array | None = None,
    characteristic_length: float | None = None,
    workers: int | None = None,
    listener: Listener = SILENT,
) -> list[Maps]:
    """Maps where the robot can hold its load, and how well, over planes and volumes.

    Args:
        rig: The robot.
        scene: Obstacles and load (default: none).
        slices: Axis and position [m] of planes (default: the horizontal one through home).
        volume: Map the whole workspace too (default: only without slices).
        step: Grid spacing, [m] (default: a fiftieth of the longest side).
        lower: Corner of the mapped region, shape (3,), [m] (default: that of the workspace).
        upper: The opposite corner.
        rotation: Of the platform, shape (3, 3) (default: the scene's start, else home).
        characteristic_length: Divides moments in the condition number, [m] (default: the anchors'
            root mean square radius, with which alone the costs are the planner's).
        workers: Number of processes, at least 1 (default: one per core; one in a child process).
        listener: Receives the progress.

    Returns:
        The grid of each plane or volume, with arrays of values by name.

    Raises:
        BadInput: An argument is of another type, a plane is outside the region, or there are too
            many points.
    """
    require_types((rig, Rig), (listener, Listener), optional=[(scene, Scene)])
    require_unaltered(rig, scene)
    planes = [_plane(one) for one in sequence_of("slices", slices)]
    step = None if step is None else real_number("step", step, "m")
    volume = None if volume is None else truth_value("volume", volume)
    if workers is not None:
        workers = whole_number("workers", workers, least=1, most=MOST_WORKERS)
    corners = {
        name: None if corner is None else point_of(name, corner)
        for name, corner in (("lower", lower), ("upper", upper))
    }
    length = characteristic_length
    length = None if length is None else real_number("characteristic_length", length, "m")
    grids = workspace_grids(rig, planes, volume=volume, step=step, **corners)
    question = Question.about(rig, scene, rotation, length)
    return map_workspace(question, grids, workers=workers, listener=listener)


def _plane(given: object) -> tuple[int, float]:
    """Index of the axis and position [m] of a slice such as ``("z", 0.4)``."""
    if isinstance(given, str) or not isinstance(given, Sequence) or len(given) != 2:
        axis = None
    else:
        axis, position = given
    if not (isinstance(axis, str) and axis in ("x", "y", "z")):
        raise BadInput(
            f"{given!r} is not a slice",
            where="workspace_map(slices=…)",
            next_step="pass a list of axes and positions in metres, such as [('z', 0.4)]",
        )
    return "xyz".index(axis), real_number(f"the position of the slice {axis}", position, "m")


def stop() -> list[int]:
    """Stops every run of this user: all drives slow down together along the path, then hold.

    This is a software stop. It does not replace the emergency-stop button.

    Returns:
        Numbers of the processes that stop.

    Raises:
        Fault: No run is in progress, or one does not answer.
    """
    result = stop_runs()
    if not (result.stopped or result.silent):
        raise no_run("stop")
    if result.silent:
        raise no_answer("stop", result.silent)
    return list(result.stopped)


def hold(process: int | None = None) -> dict[str, Any]:
    """Feed hold: the platform slows down along the path and waits there under tension.

    Args:
        process: Number of the run; None for the only one.

    Returns:
        The status of the run.

    Raises:
        Fault: No run is in progress, or it does not answer.
        BadInput: Several runs are in progress, and `process` is None.
    """
    return request_run("hold", process)


def resume(process: int | None = None) -> dict[str, Any]:
    """Continues after `hold`, at the last requested speed; arguments as for `hold`."""
    return request_run("resume", process)


def set_speed(percent: int, process: int | None = None) -> dict[str, Any]:
    """Sets the speed along the path, [% of the planned speed]; else as `hold`.

    Raises:
        BadInput: It is not a whole number from 1 to 100, or as for `hold`.
    """
    if isinstance(percent, np.integer):
        percent = int(percent)
    if type(percent) is not int or not SLOWEST <= percent <= FASTEST:
        raise BadInput(
            f"the speed must be a whole number of percent from {SLOWEST} to {FASTEST}, it is"
            f" {percent!r}",
            where="set_speed",
        )
    return request_run("speed", process, percent)


def report(folder: str | Path) -> Path:
    """Rewrites the report of a run from its files; returns the path of the page.

    For a run that was killed, or whose disk was full, missing results are recovered too.

    Raises:
        BadInput: There is no such folder, or a file of the run differs from its checksum.
    """
    opened = RunFolder.open_cut_short(path_of(folder))
    rewrite_report(opened)
    return opened.report
