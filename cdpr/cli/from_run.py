"""`cdpr plan --from-run`: a scene that begins where a run ended."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cdpr.rig import Rig
    from cdpr.scene import Scene
    from cdpr.scene_stops import StopDocument
    from executor.run_end import RunEnd


SAME_PLACE_M, SAME_WAY_RAD = 1e-3, 1e-3
"""Nearer to the goal than this, and turned from it by less, there is nothing left to do."""


def scene_after(
    scene: Scene, rig: Rig, folder: Path
) -> tuple[Scene, tuple[StopDocument, ...], list[tuple[str, str]]]:
    """The scene from where a run ended, its stops that are done, and what to tell of it.

    Raises:
        BadInput: The folder is no whole run, or of another rig or task; or nothing is left to do.
        Refused: Where the platform is cannot be told.
    """
    from cdpr.cli.plan_for_rig import require_same_rig
    from cdpr.errors import BadInput
    from executor.run_end import continued, run_end
    from executor.run_folder import PLAN, RunFolder

    opened = RunFolder.open(folder)
    require_same_rig(opened.plan(), rig, folder / PLAN)
    end = run_end(opened)
    after, done = continued(scene, end)
    left = len(after.stops)
    if end.finished and not left and _is_there(after):
        raise BadInput(
            "the run ended at the scene's goal: nothing is left to do",
            where=str(folder),
            next_step="give another scene, or another goal with --goal-mm",
        )
    return after, done, _facts(end, folder, len(done), left)


def _is_there(scene: Scene) -> bool:
    start, goal = scene.start, scene.goal
    return start.distance_to(goal) <= SAME_PLACE_M and start.angle_to(goal) <= SAME_WAY_RAD


def require_room(scene: Scene, rig: Rig) -> None:
    """Says what to do where the platform stopped nearer to something than a plan may begin.

    Raises:
        BadInput: With the clearance to ask for.
    """
    from cdpr.clearance import ClearanceModel
    from cdpr.errors import BadInput
    from planner.settings import CLEARANCE_RESERVE

    model = ClearanceModel(rig, scene)
    near, own = model.smallest(scene.start), model.self_clearance(scene.start)
    pairs = [(own, scene.self_clearance, "set clearance.self_mm in the scene to")]
    if near is not None:
        pairs.insert(0, (near, scene.obstacle_clearance, "pass --clearance-mm"))
    for nearest, asked, ask in pairs:
        if nearest.distance >= asked + CLEARANCE_RESERVE:
            continue
        possible = math.floor((nearest.distance - CLEARANCE_RESERVE) * 1e5) / 100.0
        step = "move the platform away by hand and plan from where it is with --start-mm"
        if possible > 0.0:
            step = f"{ask} {possible:g}, which the whole new plan then keeps; or {step}"
        raise BadInput(
            f"the platform stopped with {nearest.first} {nearest.distance * 1e3:.3f} mm from"
            f" {nearest.second}; a plan that keeps {asked * 1e3:g} mm and"
            f" {CLEARANCE_RESERVE * 1e3:g} mm in reserve cannot begin there",
            where="start of the new plan",
            next_step=step,
        )


def _facts(end: RunEnd, folder: Path, done: int, left: int) -> list[tuple[str, str]]:
    x, y, z = (float(c) * 1e3 for c in end.pose.position)
    how = "finished" if end.finished else "stopped"
    told = (
        f"where {folder} {how}, {x:.3f}, {y:.3f}, {z:.3f} mm, carrying {end.payload.mass_kg:g} kg"
    )
    told += f"; {done} stops done, {left} left"
    if end.waiting_at:
        told += f"; the dwell at {end.waiting_at!r} was cut short and is done again"
    return [("from", told)]
