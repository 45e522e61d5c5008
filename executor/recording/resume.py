"""End of a run and its remaining task, from its folder."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from executor.recording.run_folder import PLAN, RunFolder
from executor.recording.tables import CycleTable
from executor.recording.verdict import NOT_ENDED
from model.clearance import ClearanceModel
from model.errors import BadInput, Refused
from model.files.documents import PoseDocument
from model.files.scene_file import Payload, StopDocument, payloads
from model.kinematics import cable_lengths, forward_kinematics
from model.plan import require_same_rig
from model.pose import Pose
from model.rig import Rig
from model.scene import Scene
from model.winches import WinchMap
from planner.settings import CLEARANCE_RESERVE


@dataclass(frozen=True, slots=True, eq=False)
class RunEnd:
    """The end of a run.

    Attributes:
        rig: The rig that was run.
        pose: Of the platform, ``world_from_platform``: position from the encoders, commanded
            orientation.
        payload: Planned payload.
        done: Stops visited by this run and by those it continued.
        waiting_at: Name of the stop whose dwell was interrupted; else empty.
        finished: Whether the goal was reached.
    """

    rig: Rig
    pose: Pose
    payload: Payload
    done: tuple[StopDocument, ...]
    waiting_at: str
    finished: bool

    def facts(self, folder: Path, done: int, left: int) -> list[tuple[str, str]]:
        """Human-readable start of a plan that continues the run.

        Args:
            done: Number of the scene's visited stops.
            left: Number of remaining stops.
        """
        x, y, z = self.pose.position * 1000.0
        text = (
            f"pose where {folder} {'finished' if self.finished else 'stopped'}:"
            f" {x:z.3f}, {y:z.3f}, {z:z.3f} mm, with {self.payload.mass_kg:g} kg;"
            f" {done} stops done, {left} left"
        )
        if self.waiting_at:
            text += f"; the dwell at {self.waiting_at!r} was interrupted and is repeated"
        return [("from", text)]


def run_end(folder: RunFolder) -> RunEnd:
    """The end of the run in a folder.

    Raises:
        BadInput: A file of the folder is missing or was changed.
        Refused: The platform pose is unknown.
    """
    rig, plan, cycles = folder.rig(), folder.plan(), folder.cycles()
    where = str(folder.path)
    final_state = folder.summary()["final_state"]
    if final_state == NOT_ENDED:
        raise _unknown("the run did not finish, so its last cycles are not on record", where)
    if not len(cycles):
        raise BadInput("the run has no cycle", where=where, next_step="plan with `start=`")
    stops, leg = plan.scene.document.stops, int(cycles.leg[-1])
    if not 1 <= leg <= len(stops) + 1:
        what = f"the run ended on leg {leg}, its plan has {len(stops) + 1}"
        raise BadInput(what, where=where, why="a file was changed after the run")
    waits = leg <= len(stops) and cycles.stop[-1] == stops[leg - 1].name
    return RunEnd(
        rig=rig,
        pose=_pose(rig, cycles, where),
        payload=payloads(plan.scene.document.load.payload(), stops)[leg - 1],
        done=(*plan.document.done, *stops[: leg - 1]),
        waiting_at=cycles.stop[-1] if waits else "",
        finished=final_state == "finished",
    )


def remaining_scene(scene: Scene, end: RunEnd) -> tuple[Scene, tuple[StopDocument, ...]]:
    """A scene from the end of a run, with its payload and the stops not yet visited.

    Returns:
        The scene, and its visited stops.

    Raises:
        BadInput: A stop of the scene was visited as another one, or out of order.
    """
    visited = {stop.name: stop for stop in end.done}
    done = [stop for stop in scene.document.stops if stop.name in visited]
    changed = [stop.name for stop in done if stop != visited[stop.name]]
    if changed or done != scene.document.stops[: len(done)]:
        names = changed or [stop.name for stop in done]
        how = "as stops that differ from the scene's" if changed else "in another order"
        raise BadInput(
            f"the run visited {', '.join(map(repr, names))} {how}",
            where=f"scene {scene.name}",
            why="the scene's stops have changed since, or it is another task",
            next_step="restore them, or give the stops of another task other names",
        )
    rest = scene.document.stops[len(done) :]
    return scene.changed(start=end.pose, stops=rest, payload=end.payload), tuple(done)


def _pose(rig: Rig, cycles: CycleTable, where: str) -> Pose:
    """The encoder pose in the last cycle, if it agrees with the plan."""
    if cycles.missing[-1]:
        raise _unknown(f"{cycles.missing[-1]} drives did not answer in the last cycle", where)
    winches = WinchMap(rig)
    measured, planned = cycles.tensions[-1], cycles.planned_tensions[-1]
    tensions = np.where(np.isfinite(measured), measured, planned)
    counts = cycles.actual_counts[-1].astype(np.float64)
    lengths = winches.strained(winches.unstrained_from_counts(counts), tensions)
    found = forward_kinematics(rig, lengths).pose
    commanded = Pose.from_quaternion(cycles.planned[-1], cycles.planned_rotation[-1])
    away, allowed = found.distance_to(commanded), rig.motion.following_error
    if not away <= allowed:
        raise _unknown(
            f"the encoder pose is {away * 1e3:.2f} mm from the commanded pose,"
            f" the limit is {allowed * 1e3:g} mm",
            where,
        )
    pose = rig.clipped(Pose(found.position, commanded.rotation))  # counts are rounded
    off = np.abs(cable_lengths(rig, pose) - lengths)
    worst, allowed = int(np.argmax(off)), rig.motion.start_tolerance
    if not off[worst] <= allowed:
        raise _unknown(
            f"cable {worst + 1} is {off[worst] * 1e3:.2f} mm longer or shorter than at the"
            f" best-fit encoder pose, the limit is {allowed * 1e3:g} mm",
            where,
        )
    return pose


def _unknown(what: str, where: str) -> Refused:
    return Refused(
        f"the platform pose is unknown: {what}",
        where=where,
        why="a drive slipped, stalled or was lost, or the run was killed",
        next_step="check the rig, home the drives, and plan from the platform's pose with `start=`",
    )


# Scene from the end of a run.


AT_GOAL_M, AT_GOAL_RAD = 1e-3, 1e-3
"""Distance and angle to the goal below which nothing remains to be done."""


def scene_after(
    scene: Scene, rig: Rig, folder: Path
) -> tuple[Scene, tuple[StopDocument, ...], RunEnd]:
    """The scene from the end of a run, its visited stops, and that end.

    Raises:
        BadInput: The folder is incomplete, or of another rig or task; nothing remains to do; or the
            clearance is too small for a plan from there.
        Refused: The platform pose is unknown.
    """
    opened = RunFolder.open(folder)
    require_same_rig(opened.plan(), rig, folder / PLAN)
    end = run_end(opened)
    after, done = remaining_scene(scene, end)
    if end.finished and not after.stops and _is_there(after):
        raise BadInput(
            "the run ended at the scene's goal: nothing remains to be done",
            where=str(folder),
            next_step="give another scene, or another goal with `goal=`",
        )
    _require_room(after, rig)
    return after, done, end


def _is_there(scene: Scene) -> bool:
    start, goal = scene.start, scene.goal
    return start.distance_to(goal) <= AT_GOAL_M and start.angle_to(goal) <= AT_GOAL_RAD


def _require_room(scene: Scene, rig: Rig) -> None:
    """Requires enough clearance at the start for a plan."""
    model = ClearanceModel(rig, scene)
    near, own = model.smallest(scene.start), model.self_clearance(scene.start)
    pairs = [(own, scene.self_clearance, "set clearance.self_mm in the scene to {0:g}")]
    if near is not None:
        ask = "pass `clearance={1:g}`"  # in metres, as all arguments
        pairs.insert(0, (near, scene.obstacle_clearance, ask))
    for nearest, asked, ask in pairs:
        if nearest.distance >= asked + CLEARANCE_RESERVE:
            continue
        possible = math.floor((nearest.distance - CLEARANCE_RESERVE) * 1e5) / 100.0
        step = "move the platform away by hand and plan from its new pose with `start=`"
        if possible > 0.0:
            ask = ask.format(possible, possible / 1000.0)
            step = f"{ask}, which then holds for the whole new plan; or {step}"
        raise BadInput(
            f"the platform stopped with {nearest.first} {nearest.distance * 1e3:.3f} mm from"
            f" {nearest.second}; a plan with a clearance of {asked * 1e3:g} mm and"
            f" {CLEARANCE_RESERVE * 1e3:g} mm in reserve cannot start there",
            where="start of the new plan",
            next_step=step,
        )


def passing(scene: Scene, via: Sequence[Pose]) -> Scene:
    """The scene with poses to pass before its own stops."""
    points = []
    for number, pose in enumerate(via, start=1):
        given = PoseDocument.of(pose).model_dump(exclude_defaults=True)
        points.append(StopDocument(name=f"via {number}", **given))
    return scene.changed(stops=[*points, *scene.document.stops]) if points else scene
