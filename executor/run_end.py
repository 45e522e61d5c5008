"""Where a run ended and what was left to do, from its folder alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cdpr.errors import BadInput, Refused
from cdpr.kinematics import cable_lengths, forward_kinematics
from cdpr.payload import Payload
from cdpr.poses import Pose
from cdpr.rig import Rig
from cdpr.scene import Scene
from cdpr.scene_stops import StopDocument, payloads
from cdpr.winches import WinchMap
from executor.cycle_table import CycleTable
from executor.run_folder import RunFolder


@dataclass(frozen=True, slots=True, eq=False)
class RunEnd:
    """The end of a run.

    Attributes:
        rig: The rig that was run.
        pose: Of the platform, ``world_from_platform``: the position by the drives, turned as
            commanded.
        payload: What was planned to hang on it.
        done: Stops that were visited, by this run and by those that it went on from.
        waiting_at: Name of the stop whose dwell was cut short; nothing otherwise.
        finished: Whether the goal was reached.
    """

    rig: Rig
    pose: Pose
    payload: Payload
    done: tuple[StopDocument, ...]
    waiting_at: str
    finished: bool


def run_end(folder: RunFolder) -> RunEnd:
    """The end of the run in a folder.

    Raises:
        BadInput: A file of the folder is missing or was changed.
        Refused: The drives' positions do not tell where the platform is.
    """
    rig, plan, cycles = folder.rig(), folder.plan(), folder.cycles()
    where = str(folder.path)
    if not len(cycles):
        raise BadInput("the run has no cycle", where=where, next_step="plan with --start-mm")
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
        finished=folder.summary()["final_state"] == "finished",
    )


def continued(scene: Scene, end: RunEnd) -> tuple[Scene, tuple[StopDocument, ...]]:
    """A scene from where a run ended, with what was carried and the stops not yet visited.

    Returns:
        The scene, and those of its stops that are behind it.

    Raises:
        BadInput: A stop of the scene was visited as another one, or out of order.
    """
    visited = {stop.name: stop for stop in end.done}
    done = [stop for stop in scene.document.stops if stop.name in visited]
    changed = [stop.name for stop in done if stop != visited[stop.name]]
    if changed or done != scene.document.stops[: len(done)]:
        names = changed or [stop.name for stop in done]
        how = "as other stops than the scene's" if changed else "in another order"
        raise BadInput(
            f"the run visited {', '.join(map(repr, names))} {how}",
            where=f"scene {scene.name}",
            why="the scene's stops were changed since, or it is another task",
            next_step="restore them; or give the stops of another task other names",
        )
    rest = scene.document.stops[len(done) :]
    return scene.changed(start=end.pose, stops=rest, payload=end.payload), tuple(done)


def _pose(rig: Rig, cycles: CycleTable, where: str) -> Pose:
    """By forward kinematics of the drives' last positions; believed where the plan agrees."""
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
            f"by its drives the platform is {away * 1e3:.2f} mm from where it was told to be,"
            f" allowed are {allowed * 1e3:g} mm",
            where,
        )
    pose = Pose(found.position, commanded.rotation)
    off = np.abs(cable_lengths(rig, pose) - lengths)
    worst, allowed = int(np.argmax(off)), rig.motion.start_tolerance
    if not off[worst] <= allowed:
        raise _unknown(
            f"cable {worst + 1} is {off[worst] * 1e3:.2f} mm longer or shorter than at the pose"
            f" that fits the drives' positions best, allowed are {allowed * 1e3:g} mm",
            where,
        )
    return pose


def _unknown(what: str, where: str) -> Refused:
    return Refused(
        f"where the platform is cannot be told: {what}",
        where=where,
        why="a drive slipped, stood still while others moved, or was lost",
        next_step="look at the rig, reference the drives, and plan from where the platform is with"
        " `cdpr plan --start-mm`",
    )
