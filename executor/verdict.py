"""Whether a run was good: single checks, each a sentence with its numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cdpr.rig import Rig
from cdpr.scene import Scene
from executor.camera_eye import CameraRecord
from executor.clearance_table import ClearanceTable
from executor.cycle_table import CycleTable
from executor.pose_table import PoseTable
from executor.safety.limits import tension_limits

PASSED, FAILED, STOPPED = "PASSED", "FAILED", "STOPPED"
#: What the rounding of the tables may cost, [m].
ROUNDING = 2e-9


@dataclass(frozen=True, slots=True)
class Check:
    """One question about a run and its answer.

    Attributes:
        name: Short stable name.
        passed: The answer.
        text: One sentence with the numbers behind it.
    """

    name: str
    passed: bool
    text: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """The answer for the whole run.

    Attributes:
        word: ``PASSED``, ``FAILED`` or ``STOPPED``.
        sentence: What happened, in one sentence.
        checks: Every single check.
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
        """The sentences of the checks that failed; of all checks when none did."""
        failed = [check.text for check in self.checks if not check.passed]
        return failed or [check.text for check in self.checks]


def judge(
    final_state: str,
    cause: str,
    simulated: bool,
    rig: Rig,
    scene: Scene,
    cycles: CycleTable,
    poses: PoseTable,
    clearance: ClearanceTable,
    cameras: Sequence[CameraRecord] = (),
    *,
    too_near: bool = False,
) -> Verdict:
    """The verdict over a run.

    Args:
        final_state: ``finished``, ``stopped`` or any other for a fault.
        cause: Why it did not finish, if it did not.
        simulated: The drives were simulated, so that no reply may be lost.
        rig: The rig that was run.
        scene: Its scene.
        cycles: What the drives did.
        poses: What the cameras saw together.
        clearance: How near it came.
        cameras: What became of each camera's pictures.
        too_near: It was stopped for what the cameras measured, and not by the operator.
    """
    measured = [
        following(cycles, rig.motion.following_error),
        replies(cycles, simulated),
        *tensions(cycles, rig),
        *distances(clearance, scene.obstacle_clearance, cameras),
        *camera(poses, cameras),
    ]
    failures = [check for check in measured if not check.passed]
    at = f"after {_time(cycles):.1f} s and {_travelled(cycles):.0f} mm"
    if final_state == "finished":
        end = Check("finished", True, f"The platform reached the goal {at}.")
        if failures:
            many = f"{len(failures)} checks" if len(failures) > 1 else "one check"
            sentence = f"The run reached the goal, but {many} failed."
            return Verdict(FAILED, sentence, (end, *measured))
        sentence = "The run reached the goal within every limit that was measured."
        return Verdict(PASSED, sentence, (end, *measured))
    told = cause.rstrip(".") or f"the final state is {final_state!r}"
    end = Check("finished", False, f"The run ended {at}, before the goal: {told}.")
    if final_state == "stopped" and not failures and not too_near:
        return Verdict(STOPPED, "The run was stopped before the goal.", (end, *measured))
    word = "was stopped" if final_state == "stopped" else "ended with a fault"
    return Verdict(FAILED, f"The run {word} before the goal.", (end, *measured))


def _time(cycles: CycleTable) -> float:
    return float(cycles.time[-1]) if len(cycles) else 0.0


def _travelled(cycles: CycleTable) -> float:
    return float(cycles.travelled[-1]) * 1e3 if len(cycles) else 0.0


def following(cycles: CycleTable, limit: float) -> Check:
    """Every cable within ``limit`` [m] of its set-point, in every cycle."""
    known = np.flatnonzero(np.isfinite(cycles.following_error))
    if not known.size:
        return Check("following_error", False, "No drive position was ever received.")
    worst = known[np.argmax(cycles.following_error[known])]
    value = float(cycles.following_error[worst])
    passed = value <= limit
    text = (
        f"No cable was more than {_rounded_up(value):.3f} mm off its set-point"
        f" (limit {limit * 1e3:g} mm)."
        if passed
        else f"A cable was {value * 1e3:.3f} mm off its set-point at {cycles.time[worst]:.2f} s;"
        f" the limit is {limit * 1e3:g} mm."
    )
    return Check("following_error", passed, text)


def _rounded_up(length: float) -> float:
    """A length [m] in mm, rounded up to a micrometre and never nothing at all."""
    return max(math.ceil(round(length * 1e6, 3)), 1) / 1e3


def replies(cycles: CycleTable, simulated: bool) -> Check:
    """No reply lost on simulated drives; on a real bus the loop itself stops for too many."""
    lost = int(cycles.missing.sum())
    asked = len(cycles) * cycles.cable_count
    if not lost:
        return Check("lost_replies", True, f"All {asked} replies of the drives arrived.")
    text = f"{lost} of {asked} replies of the drives were lost"
    if simulated:
        return Check("lost_replies", False, f"{text}; simulated drives lose none.")
    return Check("lost_replies", True, f"{text}, never so many that the run had to stop.")


def tensions(cycles: CycleTable, rig: Rig) -> list[Check]:
    """No slack and no overloaded cable; nothing when the drives report no torque."""
    if not np.isfinite(cycles.tensions).any():
        return []
    low, high = float(np.nanmin(cycles.tensions)), float(np.nanmax(cycles.tensions))
    limits = f"limits {rig.min_tension:g} and {rig.max_tension:g} N"
    slack, overload = tension_limits(rig)
    if low < slack:
        at, cable = _where(cycles.tensions, low)
        text = f"Cable {cable} went slack: {low:.2f} N at {cycles.time[at]:.2f} s ({limits})."
        return [Check("tension", False, text)]
    if high > overload:
        at, cable = _where(cycles.tensions, high)
        text = f"Cable {cable} pulled {high:.2f} N at {cycles.time[at]:.2f} s ({limits})."
        return [Check("tension", False, text)]
    return [Check("tension", True, f"Tensions stayed in {low:.1f} to {high:.1f} N ({limits}).")]


def _where(
    values: np.ndarray[tuple[int, ...], np.dtype[np.float64]], value: float
) -> tuple[int, int]:
    row, column = np.argwhere(values == value)[0]
    return int(row), int(column) + 1


def distances(
    clearance: ClearanceTable, required: float, cameras: Sequence[CameraRecord] = ()
) -> list[Check]:
    """Nowhere nearer than the scene allows, and nowhere nearer than planned by the camera.

    A distance is too small only when it is so by more than its own uncertainty.
    """
    checks = []
    for source, teller in (("tag", _who(cameras)), ("encoder", "the drives")):
        rows = clearance.of(source)
        if len(rows) and np.isfinite(rows.distance).any():
            checks.append(_against_required(rows, required, teller))
            if source == "tag":
                checks.append(_against_plan(rows))
    return checks


def _against_required(rows: ClearanceTable, required: float, teller: str) -> Check:
    passed = not bool(np.any(rows.at_most < required - ROUNDING))
    worst = int(np.nanargmin(rows.distance if passed else rows.at_most))
    distance, high = rows.distance[worst] * 1e3, rows.at_most[worst] * 1e3
    low = distance - rows.uncertainty[worst] * 1e3
    surely = f"{low:.1f} to {high:.1f} mm" if passed else f"at most {high:.1f} mm"
    text = (
        f"The smallest clearance seen by {teller} was {distance:.1f} mm, surely {surely}"
        f" ({rows.body[worst]} to {rows.obstacle[worst]}, at {rows.time[worst]:.1f} s);"
        f" the scene asks for {required * 1e3:g} mm."
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
        f" within its uncertainty of {at_most - rows.distance[worst] * 1e3:.2f} mm there."
        if passed
        else f"Measured clearance was {short:.2f} mm below the planned one at"
        f" {rows.time[worst]:.1f} s: surely at most {at_most:.2f} mm,"
        f" planned {rows.planned_distance[worst] * 1e3:.2f} mm."
    )
    return Check("clearance_plan", passed, text)


def camera(poses: PoseTable, cameras: Sequence[CameraRecord]) -> list[Check]:
    """A camera saw the platform, and not all failed; nothing for a run without a camera."""
    failed = [one for one in cameras if one.failed]
    if failed and len(failed) == len(cameras):
        text = " ".join(f"Camera {one.name} failed: {one.failed}." for one in failed)
        return [Check("camera", False, text)]
    if not len(poses):
        return []
    seen = int(poses.ok.sum())
    if not seen:
        text = f"None of {len(poses)} pictures gave a pose: {poses.status[0]}."
        return [Check("camera", False, text)]
    error = poses.error[poses.ok] * 1e3
    rms = float(np.sqrt(np.mean(error**2)))
    text = (
        f"{_who(cameras).capitalize()} measured {seen} of {len(poses)} pictures,"
        f" {rms:.2f} mm RMS from the plan (largest {error.max():.2f} mm)."
    )
    if len(cameras) > 1:
        text += f" Alone: {', '.join(map(_of_one, cameras))}."
    return [Check("camera", True, text)]


def _who(cameras: Sequence[CameraRecord]) -> str:
    return f"{len(cameras)} cameras together" if len(cameras) > 1 else "the camera"


def _of_one(record: CameraRecord) -> str:
    """How often one of several cameras saw the platform, and why it saw it no more."""
    failed = f" ({record.failed})" if record.failed else ""
    return f"{record.name} {record.poses} of {record.pictures}{failed}"
