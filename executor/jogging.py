"""Jogs: short, slow motions of the platform along a straight path, or of one winch alone."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from executor.control.preconditions import require_still_referenced
from executor.control.winch_laws import CableStep
from executor.drives import current_pose, is_simulated, read_snapshot, require_drives
from executor.interlock.interlock import MotionInterlock
from executor.proposals import Facts, Proposal, cable_proposal, require_confirmed
from executor.recording.run_folder import RunEvent
from executor.remote.command_server import commands_from_start
from executor.run_result import folder_maker
from executor.runner import RunOptions, RunResult, run_prepared
from executor.supervision import Supervisor
from executor.trajectory.setpoints import prepare_plan
from executor.winch_runs import limit_of, move_by_law, record_folder
from model.errors import (
    BadInput,
    Refused,
    real_number,
    require_functions,
    require_types,
    truth_value,
)
from model.files.plan_file import PlanDocument
from model.files.scene_file import RotationLimitsDocument
from model.pages.page import FactsDisplay
from model.plan import plan_from_document
from model.pose import Array, Pose, largest_rotations, point_of
from model.progress import SILENT, Listener
from model.rig import Rig, rig_from_document
from model.scene import Scene, empty_scene, require_unaltered, scene_from_document
from planner.kernels.jit import planner_compilation
from planner.planning import make_plan
from planner.settings import OptimalSettings, TurningSettings, whole_number

#: Largest length, [mm], and rotation, [deg], of a jog.
LONGEST_MM, MOST_DEG = 50.0, 10.0
_ROUNDED = 1.0 + 1e-12
"""Tolerance for the rounding of a length converted from mm to m and back."""
#: Largest and default speed of a jog, [m/s].
FASTEST, SPEED = 0.020, 0.005
_PLAN_FROM_HERE = "plan a path from here: `cdpr plan --start-mm`, in Python cdpr.plan(start=)"


def jog(
    rig: Rig,
    scene: Scene | None,
    *,
    by: ArrayLike | None = None,
    to_home: bool = False,
    speed: float = SPEED,
    folder: Path | str | None = None,
    realtime: bool = True,
    need_real_time_rights: bool = True,
    listener: Listener = SILENT,
    confirm: Callable[[Proposal], bool] | None = None,
    on_event: Callable[[RunEvent], None] | None = None,
    supervisor: Supervisor | None = None,
) -> RunResult:
    """Moves the platform slowly by a few millimetres in a straight line.

    A jog is a run: planned, checked and gated like any other. On the interface ``virtual`` the
    simulated platform is at home.

    Args:
        rig: The robot and its bus.
        scene: Obstacles and load; its stops are ignored. None states that there are no obstacles;
            cables then keep 5 mm from each other and from the platform.
        by: Displacement, shape (3,), in the world frame, [m].
        to_home: Move to the rig's home pose instead, with its orientation.
        speed: At most the rig's own, [m/s].
        folder: Run folder to create; None for ``runs/jog``, ``runs/jog-2`` …
        realtime: As for `executor.runner.run`, like all that follow.
        need_real_time_rights: Refuse to move drives on a bus without real-time scheduling.
        listener: Receives progress.
        confirm: Called once, before anything moves; False cancels it.
        on_event: Receives each event of the run.
        supervisor: Turns interrupts into stops; None for what signal handlers raise.

    Raises:
        CdprError: As for `executor.runner.run`; or the straight path is too long or not free.
    """
    require_types((rig, Rig), (listener, Listener), optional=[(scene, Scene)])
    require_unaltered(rig, scene)
    require_functions(confirm=confirm, on_event=on_event)
    to_home = truth_value("to_home", to_home)
    realtime = truth_value("realtime", realtime)
    need_real_time_rights = truth_value("need_real_time_rights", need_real_time_rights)
    with commands_from_start("jog", rig, supervisor, realtime=realtime) as commands:
        slow = with_speed(rig, speed)
        by = None if by is None else point_of("by", by)
        require_drives(slow, realtime)
        require_distance(by, to_home=to_home)
        around = empty_scene(slow) if scene is None else scene.changed(stops=())
        make_folder = folder_maker(folder, "jog")
        interlock = MotionInterlock(slow)
        interlock.require_free()
        ready = interlock.referenced_rig()
        start = ready.home if is_simulated(ready) else measured_pose(ready, around)
        goal = ready.home if by is None else Pose(start.position + by, start.rotation)
        plan = plan_from_document(plan_straight_move(ready, around, start, goal, listener))
        commands.require_no_stop()
        options = RunOptions(
            realtime=realtime,
            start=start,
            need_real_time_rights=need_real_time_rights,
            listener=listener,
            confirm=confirm,
            on_event=on_event,
        )
        prepared = prepare_plan(plan, ready, listener)
        return run_prepared(prepared, make_folder, {}, options, commands)


def with_speed(rig: Rig, speed: float) -> Rig:
    """The rig with a lower speed [m/s], which plans do not depend on.

    Raises:
        BadInput: The speed is outside the range of a jog.
    """
    speed = real_number("speed", speed, "m/s")
    if not 0.0 < speed <= FASTEST:
        raise BadInput(
            f"the speed of {speed:g} m/s must be above 0 and at most {FASTEST:g} m/s",
            where="jog",
            next_step="give one in this range",
        )
    document = rig.document
    slower = min(speed * 1000.0, document.motion.speed_mm_s)
    motion = document.motion.model_copy(update={"speed_mm_s": slower})
    return rig_from_document(document.model_copy(update={"motion": motion}))


def measured_pose(rig: Rig, scene: Scene) -> Pose:
    """The encoder pose of the platform; reads the drives without changing them.

    Raises:
        Refused: The reference is lost, or the positions fit no pose.
    """
    reference = MotionInterlock(rig).require_ready()
    seen = read_snapshot(rig, rig.home, scene.load)
    require_still_referenced(rig, reference, seen.restarted, seen)
    return current_pose(rig, seen.positions.astype(np.float64), scene.load)


def plan_straight_move(
    rig: Rig, scene: Scene, start: Pose, goal: Pose, listener: Listener = SILENT
) -> PlanDocument:
    """A plan of the straight move, with rotation where the orientations differ.

    Raises:
        CdprError: Start or goal cannot be used.
        Refused: The move is too long, or the straight path is not free.
    """
    straight, turn = 1000.0 * start.distance_to(goal), float(np.degrees(start.angle_to(goal)))
    _require_jog(straight, turn)
    moving_scene, turns = scene.changed(start=start, goal=goal), turn > 1e-6
    settings = TurningSettings if turns else OptimalSettings
    if turns:
        moving_scene = _free_to_turn(moving_scene, (start, goal))
    with (
        planner_compilation("turning" if turns else "optimal", listener) as compiled,
        listener.waiting("planning") if compiled else nullcontext(),
    ):
        document = make_plan(rig, moving_scene, settings(seed=0, rounds=1))
    if document.quality.length_mm > straight + 0.01:
        raise Refused(
            f"the straight path of {straight:.1f} mm is not free; the detour is"
            f" {document.quality.length_mm:.1f} mm",
            where="cdpr jog",
            why="cables or platform would be too close to an obstacle on the straight path",
            next_step=f"jog in another direction, or {_PLAN_FROM_HERE}",
        )
    return document


def require_distance(by: Array | None, *, to_home: bool) -> None:
    """Requires exactly one of both, neither zero nor too long; as for `jog`.

    Raises:
        BadInput: None or both are given, or the distance is zero.
        Refused: The distance is too long.
    """
    if by is not None and to_home:
        raise BadInput(
            "`by=` and `to_home=` contradict each other",
            where="cdpr jog",
            next_step="leave out one of them",
        )
    if by is None and not to_home:
        raise BadInput(
            "no motion given: use `by=` or `to_home=`, or jog a single cable",
            where="cdpr jog",
            next_step="see `cdpr jog --help`; in Python pass by= or to_home=True, or use"
            " executor.jog_cable()",
        )
    if by is None:
        return
    length_mm = math.hypot(*by) * 1000.0
    if not 0.0 < length_mm < math.inf:
        raise BadInput("the jog distance is zero", where="`by=`", next_step="give X Y Z, not all 0")
    _require_jog(length_mm, 0.0)


def _require_jog(length_mm: float, turn_deg: float) -> None:
    if length_mm > LONGEST_MM * _ROUNDED or turn_deg > MOST_DEG:
        raise Refused(
            f"a jog of {length_mm:.1f} mm and {turn_deg:.1f}° exceeds {LONGEST_MM:g} mm or"
            f" {MOST_DEG:g}°",
            where="cdpr jog",
            why="longer motions need a plan that avoids obstacles",
            next_step=f"jog a shorter distance, or {_PLAN_FROM_HERE}",
        )


def _free_to_turn(scene: Scene, poses: tuple[Pose, ...]) -> Scene:
    """The scene with rotation limits that include these orientations."""
    first, last = poses[0].quaternion, poses[-1].quaternion
    tilt, turn = np.degrees(largest_rotations(first, last))
    limits = RotationLimitsDocument.containing(float(tilt) + 0.1, float(turn) + 0.1)
    return scene_from_document(scene.document.model_copy(update={"rotation_limits": limits}))


def _require_cable(rig: Rig, cable: int, length: float) -> None:
    """Requires an existing cable and an allowed length."""
    if not 1 <= cable <= rig.cable_count:
        raise BadInput(
            f"there is no cable {cable}",
            where="`cable=`",
            next_step=f"name one from 1 to {rig.cable_count}, in the order of the rig file",
        )
    if length == 0.0 or not math.isfinite(length):
        raise BadInput(
            "the jog distance is zero", where="`length=`", next_step="give a length other than 0"
        )
    length_mm = abs(length) * 1000.0
    if length_mm > LONGEST_MM * _ROUNDED:
        raise Refused(
            f"{length_mm:g} mm exceeds the limit of {LONGEST_MM:g} mm",
            where="`length=`",
            why="a single cable is moved in short steps, under observation",
            next_step="use several steps",
        )


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class CableJog(FactsDisplay):
    """Result of a cable jog.

    Attributes:
        cable: Its number, from 1.
        moved: Length paid out from the encoder, [m]; negative for wound in.
        tensions: Of all cables afterwards, shape (m,), [N].
        folder: Record of the motion, as an absolute path; None without one.
    """

    cable: int
    moved: float
    tensions: Array
    folder: Path | None = None

    def facts(self) -> Facts:
        """Human-readable travel, tensions and record."""
        way = "paid out" if self.moved > 0.0 else "wound in"
        return [
            ("cable", f"{self.cable}, {way} by {abs(self.moved) * 1000.0:.3f} mm"),
            ("tensions", f"{self.tensions.min():.1f} to {self.tensions.max():.1f} N"),
            *([("record", str(self.folder))] if self.folder else []),
        ]


def jog_cable(
    rig: Rig,
    cable: int,
    length: float,
    *,
    limit: float | None = None,
    speed: float = SPEED,
    folder: Path | str | None = None,
    realtime: bool = True,
    need_real_time_rights: bool = True,
    listener: Listener = SILENT,
    confirm: Callable[[Proposal], bool] | None = None,
    supervisor: Supervisor | None = None,
) -> CableJog:
    """Moves one winch alone slowly by a short length, for commissioning.

    On a taut platform a single cable moves by little more than its elastic stretch before a tension
    exceeds the limit or another cable goes slack: either stops it.

    Args:
        rig: The robot and its bus.
        cable: Its number, from 1, in the order of the rig file.
        length: To pay out, [m]; negative winds in.
        limit: Largest tension of any cable, [N]; None for 60 % of the rig's range.
        speed: At most the rig's own, [m/s].
        folder: Record folder to create; None for ``runs/jog-cable``, ``runs/jog-cable-2`` …, and
            for none with simulated drives.
        realtime: As for `executor.runner.run`, like all that follow.
        need_real_time_rights: Refuse to move drives on a bus without real-time scheduling.
        listener: Receives progress.
        confirm: Called once, before anything moves; False cancels it.
        supervisor: Turns interrupts into stops; None for what signal handlers raise.

    Raises:
        BadInput: There is no such cable, the length is zero, or an argument is of another type.
        Refused: The length is too long, or the bus is latched.
        Fault: A tension left its limits, which is latched; all drives stopped together. Or a
            function of the listener raised an exception, which stops the motion without a latch.
        StoppedByOperator: Cancelled, or stopped; the drives hold.
    """
    require_types((rig, Rig), (listener, Listener))
    require_unaltered(rig)
    require_functions(confirm=confirm)
    realtime = truth_value("realtime", realtime)
    need_real_time_rights = truth_value("need_real_time_rights", need_real_time_rights)
    cable, length = whole_number("cable", cable), real_number("length", length, "m")
    slow = with_speed(rig, speed)
    require_drives(slow, realtime)
    _require_cable(slow, cable, length)
    winch = slow.winches[cable - 1]
    limit = limit_of(slow, limit)
    fastest = slow.motion.speed
    make_folder = record_folder(slow, folder, "jog-cable")
    with commands_from_start("jog", slow, supervisor, realtime=realtime) as commands:
        MotionInterlock(slow).require_free()
        require_confirmed(confirm, cable_proposal(slow, cable, length, limit, fastest))
        result = move_by_law(
            slow,
            commands,
            partial(CableStep, cable=cable - 1, length=length, limit=limit, speed=fastest),
            make_folder,
            pose=slow.home,
            limit=limit,
            speed=fastest,
            realtime=realtime,
            need_real_time_rights=need_real_time_rights,
            listener=listener,
        )
    moved = (result.counts - result.began)[cable - 1] / winch.counts_per_metre
    return CableJog(cable, float(moved), result.tensions, result.folder)
