"""Verdict of a run: single checks, each a sentence with its values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from executor.recording.clearance import ClearanceTable, camera_of, source_of
from executor.recording.record_files import CameraRecord, RunCourse
from executor.recording.run_folder import RunEvent
from executor.recording.tables import CycleTable, PoseTable
from executor.safety.fault_messages import LARGEST_SHARE, NO_MORE
from executor.safety.limits import tension_limits
from executor.state_machine import SIMULATED, State
from model.plan import Plan
from model.pose import Pose
from model.rig import Rig
from model.scene import Scene
from tracking.clearance import INTERVAL

PASSED, FAILED, STOPPED = "PASSED", "FAILED", "STOPPED"
#: Final state of a run without a recorded end: its program was killed, or the disk was full.
NOT_ENDED = "not_ended"
_AFTER_MOTION = [state.value for state in (State.SECURING, State.LATCHED)]
#: Tolerance for the rounding of the tables, [m].
ROUNDING = 2e-9
#: Distance [m] and angle [rad] of set-points from the goal at which the platform counts as there.
AT_GOAL, AT_GOAL_ANGLE = 1e-4, 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class RunContext:
    """A run, besides its tables.

    Attributes:
        plan: Its plan.
        rig: Its rig.
        course: Its start and end.
        events: All events, in order.
    """

    plan: Plan
    rig: Rig
    course: RunCourse
    events: tuple[RunEvent, ...]

    @property
    def simulated(self) -> bool:
        """Whether the drives were simulated, here or by a program at the other end of the bus."""
        return self.course.simulated or bool(self.texts_of(SIMULATED))

    def texts_of(self, code: str) -> list[str]:
        """Texts of the events with a code."""
        return [event.text for event in self.events if event.code == code]


@dataclass(frozen=True, slots=True)
class Check:
    """One check of a run.

    Attributes:
        name: Short stable name.
        passed: The result.
        text: One sentence with its values.
    """

    name: str
    passed: bool
    text: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """The verdict on the whole run.

    Attributes:
        word: ``PASSED``, ``FAILED`` or ``STOPPED``.
        sentence: The outcome in one sentence.
        checks: All checks.
    """

    word: str
    sentence: str
    checks: tuple[Check, ...]

    @property
    def passed(self) -> bool:
        """True only for a run that reached the goal and met every check."""
        return self.word == PASSED

    @property
    def reasons(self) -> list[str]:
        """Sentences of the failed checks; of all checks if none failed."""
        return [c.text for c in self.checks if not c.passed] or [c.text for c in self.checks]


def judge(
    context: RunContext, cycles: CycleTable, poses: PoseTable, clearance: ClearanceTable
) -> Verdict:
    """The verdict on a run.

    Args:
        poses: Fused poses of the cameras.
    """
    course, rig, scene = context.course, context.rig, context.plan.scene
    final_state, began = course.final_state, cycles.path_began
    warnings = dict.fromkeys(t.removesuffix(NO_MORE) for t in context.texts_of("drive_warning"))
    cause, unheld = _cause(context)
    measured = [
        following(cycles, rig.motion.following_error),
        replies(cycles, context),
        *tensions(cycles, rig),
        *distances(clearance, scene.obstacle_clearance, course.cameras, began, rig.platform_error),
        *encoder_pose(cycles),
        *camera(poses, course.cameras, began),
        *(Check("camera_pose", False, as_sentence(t)) for t in context.texts_of("pose_differs")),
        *(Check("drive_warning", True, f"Warning: {warning}.") for warning in warnings),
        *unheld,
        *(Check("record", False, f"{trouble}.") for trouble in course.troubles),
    ]
    failures = [check for check in measured if not check.passed]
    at = f"after {_motion_time(cycles):.1f} s and {_travelled(cycles)} mm"
    if final_state == "finished":
        end = Check("finished", True, f"The platform reached the goal {at}.")
        if failures:
            many = f"{len(failures)} checks" if len(failures) > 1 else "one check"
            sentence = f"The run reached the goal, but {many} failed."
            return Verdict(FAILED, sentence, (end, *measured))
        sentence = "The run reached the goal and met every check."
        return Verdict(PASSED, sentence, (end, *measured))
    if final_state == NOT_ENDED:
        end = Check("finished", False, f"Its record ends {at}. {_KILLED}")
        return Verdict(FAILED, "The run did not finish.", (end, *measured))
    cause = cause.rstrip(".") or f"the final state is {final_state!r}"
    where = "at the goal" if _is_at_goal(cycles, scene) else "before the goal"
    end = Check("finished", False, f"The run ended {at}, {where}: {cause}.")
    by_operator = final_state == "stopped" and not context.texts_of("clearance_low")
    if by_operator and not failures:
        return Verdict(STOPPED, f"The run was stopped {where}.", (end, *measured))
    word = "was stopped" if final_state == "stopped" else "ended with a fault"
    return Verdict(FAILED, f"The run {word} {where}.", (end, *measured))


def _cause(context: RunContext) -> tuple[str, list[Check]]:
    """Why a run did not finish, and a failed check if besides that drives may not hold."""
    cause = context.course.cause or next((event.text for event in reversed(context.events)), "")
    texts = [*dict.fromkeys(context.texts_of("not_held"))]
    for text in reversed(texts):  # the latch keeps all, see `Loop`
        cause = cause.removesuffix(f"; {text}")
    later = "; ".join(text for text in texts if text not in cause)
    what = f"Some drives may not hold: {later}. Support the platform and press the emergency stop."
    return cause, [Check("held", False, what)] if later else []


def _is_at_goal(cycles: CycleTable, scene: Scene) -> bool:
    """Whether the last set-points were those of the goal, at the end of the last leg."""
    if not len(cycles) or cycles.leg[-1] <= len(scene.stops):  # the goal may be the start
        return False
    last = Pose.from_quaternion(cycles.planned[-1], cycles.planned_rotation[-1])
    near, aligned = last.distance_to(scene.goal), last.angle_to(scene.goal)
    return near < AT_GOAL and aligned < AT_GOAL_ANGLE


_KILLED = (
    "Its program was killed, the computer stopped, or its end could not be recorded;"
    " what happened after that is unknown."
)


def _motion_time(cycles: CycleTable) -> float:
    """Time of the last cycle before the drives were stopped or held on their own, [s]."""
    in_motion = np.flatnonzero(~np.isin(cycles.state, _AFTER_MOTION))
    return float(cycles.time[in_motion[-1]]) if in_motion.size else 0.0


def _travelled(cycles: CycleTable) -> str:
    """Length of the path covered, in mm: two decimals of a short jog, else none."""
    distance = float(cycles.travelled[-1]) * 1e3 if len(cycles) else 0.0
    return f"{distance:.0f}" if distance >= 10.0 else f"{round(distance, 2):g}"


def following(cycles: CycleTable, limit: float) -> Check:
    """Check that every cable was within ``limit`` [m] of its set-point in every cycle."""
    known = np.flatnonzero(np.isfinite(cycles.following_error))
    if not known.size and not cycles.on_path.any():
        text = "The platform did not move along the path, so no following error was measured."
        return Check("following_error", True, text)
    if not known.size:
        return Check("following_error", False, _never_followed(cycles))
    worst = known[np.argmax(cycles.following_error[known])]
    value = float(cycles.following_error[worst])
    passed = value <= limit
    text = (
        f"No cable was more than {_rounded_up(value):.3f} mm off its set-point"
        f" (limit {limit * 1e3:g} mm)."
        if passed
        else f"A cable was {_rounded_up(value):.3f} mm off its set-point at"
        f" {cycles.time[worst]:.2f} s; the limit is {limit * 1e3:g} mm."
    )
    return Check("following_error", passed, text)


def _never_followed(cycles: CycleTable) -> str:
    """Why there is no following error: no replies, or no drive followed set-points."""
    asked = len(cycles) * cycles.cable_count
    received = asked - int(cycles.missing.sum())
    if not received:
        return "No drive position was ever received."
    return (
        f"The drives never followed set-points: {received} of {asked} replies with a position"
        " arrived, and no following error was measured."
    )


def _rounded_up(length: float) -> float:
    """A length [m] in mm, rounded up to a micrometre, at least 0.001."""
    return max(math.ceil(round(length * 1e6, 3)), 1) / 1e3


def replies(cycles: CycleTable, context: RunContext) -> Check:
    """Check for lost replies: none from simulated drives; on a bus none that caused a stop."""
    lost = int(cycles.missing.sum())
    asked = len(cycles) * cycles.cable_count
    if not lost:
        return Check("lost_replies", True, f"All {asked} replies of the drives arrived.")
    text = f"{lost} of {asked} replies of the drives were lost"
    shares = (t for t in context.texts_of("reply_lost") if t.startswith(LARGEST_SHARE))
    share = "".join(f"; {text}" for text in shares)
    if context.texts_of("drive_silent"):
        return Check("lost_replies", False, f"{text}, and the run was stopped for it{share}.")
    if context.course.simulated:
        return Check("lost_replies", False, f"{text}; simulated drives lose none{share}.")
    if context.course.final_state in ("finished", "stopped"):  # else a drive may be gone
        text += ", too few to stop the run"
    return Check("lost_replies", True, f"{text}{share}.")


def tensions(cycles: CycleTable, rig: Rig) -> list[Check]:
    """Check for slack or overloaded cables; empty without torques."""
    if not np.isfinite(cycles.tensions).any():
        return []
    low, high = float(np.nanmin(cycles.tensions)), float(np.nanmax(cycles.tensions))
    slack, overload = tension_limits(rig)
    limits = f"limits {rig.min_tension:g} and {rig.max_tension:g} N"
    limits += f"; a run fails below {slack:g} or above {overload:g} N"
    found = [_first_at(cycles, low, "went slack:")] if low < slack else []
    found += [_first_at(cycles, high, "pulled")] if high > overload else []
    text = "; cable ".join(found)
    text = f"Cable {text}" if found else f"Tensions stayed in {low:.1f} to {high:.1f} N"
    return [Check("tension", not found, f"{text} ({limits}){_known_until(cycles)}.")]


def _first_at(cycles: CycleTable, value: float, what: str) -> str:
    row, column = np.argwhere(cycles.tensions == value)[0]
    return f"{column + 1} {what} {value:.2f} N at {cycles.time[row]:.2f} s"


def _known_until(cycles: CycleTable) -> str:
    """Until when tensions are known, where a fault left them unknown; else empty."""
    until = cycles.tensions_until
    latest = max(until.values()) if len(until) == cycles.cable_count else None
    text = "" if latest is None else f"; tensions are known only until {latest:.2f} s"
    alone = ((cable, time) for cable, time in until.items() if time != latest)
    return text + "".join(f"; that of cable {n} only until {time:.2f} s" for n, time in alone)


def distances(
    clearance: ClearanceTable,
    required: float,
    cameras: Sequence[CameraRecord] = (),
    path_began: float = 0.0,
    platform_error: float | None = None,
) -> list[Check]:
    """Checks of the clearance against the scene's and, for cameras, the planned one.

    A distance fails only if it is too small by more than its uncertainty. Each of several cameras
    counts alone as well, so that none hides what another one measures. Distances before the time
    ``path_began`` [s] have no planned ones: the platform is beside the start, by the tolerance.
    Intervals of the encoders leave out the rig's geometry if its ``platform_error`` is None.
    """
    checks = []
    alone = sorted(filter(None, map(camera_of, {*clearance.source})))
    exact = ", taking the rig's geometry as exact" if platform_error is None else ""
    names = {"tag": _camera_phrase(cameras), "encoder": f"the encoders{exact}"}
    names |= {source_of(camera): f"camera {camera} alone" for camera in alone}
    for source, source_name in names.items():
        rows = clearance.of(source)
        if len(rows) and np.isfinite(rows.distance).any():
            checks.append(_against_required(rows, required, source_name))
            on_path = rows.since(path_began)
            if source == "tag" and np.isfinite(on_path.distance).any():
                checks.append(_against_plan(on_path))
    return checks


def _against_required(rows: ClearanceTable, required: float, source_name: str) -> Check:
    passed = not bool(np.any(rows.at_most < required - ROUNDING))
    worst = int(np.nanargmin(rows.distance if passed else rows.at_most))
    distance, high = rows.distance[worst] * 1e3, rows.at_most[worst] * 1e3
    low = distance - rows.uncertainty[worst] * 1e3
    if not passed:  # rounded down, so that they do not look like the required one
        low, distance, high = (math.floor(round(x * 10.0, 6)) / 10.0 for x in (low, distance, high))
    bounds = f"{INTERVAL} {low:.1f} to {high:.1f} mm"
    time = round(float(rows.time[worst]), 1) + 0.0  # not -0.0
    subject = "Smallest clearance" if passed else "Clearance"  # a less certain one may be smaller
    text = (
        f"{subject} measured by {source_name}: {distance:.1f} mm, {bounds}"
        f" ({rows.body[worst]} to {rows.obstacle[worst]}, at {time:.1f} s);"
        f" required {required * 1e3:g} mm."
    )
    return Check(f"clearance_{rows.source[worst]}", passed, text)


def _against_plan(rows: ClearanceTable) -> Check:
    shortfall = rows.planned_distance - rows.distance
    beyond = rows.planned_distance - rows.at_most
    passed = not bool(np.any(beyond > ROUNDING))
    worst = int(np.nanargmax(shortfall if passed else beyond))
    short, at_most = shortfall[worst] * 1e3, rows.at_most[worst] * 1e3
    text = (
        f"Measured clearance was at most {max(short, 0.0):.2f} mm below the planned one,"
        f" where its {INTERVAL} extends {at_most - rows.distance[worst] * 1e3:.2f} mm upwards."
        if passed
        else f"Measured clearance was {short:.2f} mm below the planned one at"
        f" {rows.time[worst]:.1f} s: its {INTERVAL} ends at {at_most:.2f} mm,"
        f" planned {rows.planned_distance[worst] * 1e3:.2f} mm."
    )
    return Check("clearance_plan", passed, text)


def encoder_pose(cycles: CycleTable) -> list[Check]:
    """A failed check where no pose of the platform fits the drives on the path; else none.

    Clearances from the encoders are unknown there. After a lost reply a position is an older one.
    """
    lost = cycles.on_path & ~cycles.has_encoder_pose & (cycles.missing == 0)
    if not lost.any():
        return []
    text = (
        f"No pose of the platform fits the positions of the drives in {int(lost.sum())} cycles on"
        f" the path, first at {cycles.time[np.argmax(lost)]:.2f} s: a cable is slack or slipped."
    )
    return [Check("encoder_pose", False, text)]


def camera(
    poses: PoseTable, cameras: Sequence[CameraRecord], path_began: float = 0.0
) -> list[Check]:
    """Check that a camera gave poses and not all failed; empty without a camera.

    Its distance from the plan counts from the time ``path_began`` [s] on.
    """
    failed = [one for one in cameras if one.failed]
    if failed and len(failed) == len(cameras):
        text = " ".join(f"Camera {one.name} failed: {one.failed}." for one in failed)
        return [Check("camera", False, text)]
    if not len(poses):
        return []
    seen = int(poses.ok.sum())
    if not seen:
        text = f"None of {len(poses)} images gave a pose: {poses.status[0]}."
        return [Check("camera", False, text)]
    error = poses.error[poses.ok & (poses.time >= path_began)] * 1e3
    text = f"Measured by {_camera_phrase(cameras)}: {seen} of {len(poses)} images"
    if len(error):
        rms, largest = float(np.sqrt(np.mean(error**2))), float(error.max())
        text += f", {rms:.2f} mm RMS from the plan (largest {largest:.2f} mm)"
    text += "."
    if len(cameras) > 1:
        text += f" Alone: {', '.join(map(_single_camera_phrase, cameras))}."
    return [Check("camera", True, text)]


def as_sentence(text: str) -> str:
    """A clause as a sentence."""
    return f"{text[:1].upper()}{text[1:]}."


def _camera_phrase(cameras: Sequence[CameraRecord]) -> str:
    if len(cameras) < 2:
        return "the camera"
    seeing = [camera.name for camera in cameras if camera.poses]
    return f"camera {seeing[0]} only" if len(seeing) == 1 else f"{len(seeing)} cameras together"


def _single_camera_phrase(record: CameraRecord) -> str:
    """Poses and images of one of several cameras, and why it failed."""
    failed = f" ({record.failed})" if record.failed else ""
    return f"{record.name} {record.poses} of {record.pictures}{failed}"
