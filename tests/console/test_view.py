"""Data for the page: the closest pair, and the measured pose with its ellipsoid."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.special import chdtr

from cdpr.console.state import StoredState, jog_state, none_found, stored_state
from cdpr.console.view import (
    ELLIPSOID_SCALE,
    RobotNow,
    RobotReport,
    RobotView,
    commanded_pose,
    measured_view,
    nearest_data,
)
from cdpr.console.watch import USED_FOR, RobotWatch
from drivers.can_errors import ForeignMaster
from drivers.factory import read_drives
from executor.drives import DriveStatus
from executor.interlock.reference import ReferenceStatus
from executor.recording.run_folder import RunFolder
from executor.remote import status
from executor.remote.status import MotionStatus, RunStatus, WinchStatus
from executor.service import StatusResult
from executor.supervision import LocalRequests
from model.clearance import ClearanceModel
from model.errors import HardwareMissing, Refused
from model.kinematics import cable_lengths
from model.plan import load_plan
from model.pose import Array, Pose
from model.rig import load_rig
from model.scene import load_scene
from model.statics.gravity import working_tensions
from model.winches import WinchMap
from tests.cli.plans import CONFIGS, HALL, RIG, write_short_plan
from tests.drivers.odrive_bench import ODRIVE_RIG
from tracking.clearance import clearance_at
from tracking.measurement import PoseMeasurement

SCENE = load_scene(CONFIGS / "environment_1.yaml")
THE_RIG = load_rig(RIG)


def status_at(pose: Pose) -> dict[str, Any]:
    """Status of a motion whose drives hold the platform at a pose."""
    winches, tensions = WinchMap(THE_RIG), working_tensions(THE_RIG, pose, SCENE.load).tensions
    counts = winches.counts(winches.unstrained(cable_lengths(THE_RIG, pose), tensions))
    drives = [
        {"position_counts": round(float(count)), "tension_n": round(float(tension), 3)}
        | {"torque": "enabled"}
        for count, tension in zip(counts, tensions, strict=True)
    ]
    return {"folder": "", "drives": drives}


def test_the_closest_pair_is_shown_where_it_is() -> None:
    view = RobotView(THE_RIG, SCENE)
    pose = Pose(THE_RIG.home.position + np.array([-0.03, 0.02, -0.05]), THE_RIG.home.rotation)
    seen = view.take(status_at(pose))
    assert seen is not None
    assert seen.pose.distance_to(pose) < 1e-4
    expected = ClearanceModel(THE_RIG, SCENE).smallest(pose)
    assert seen.nearest is not None
    assert expected is not None
    shown = nearest_data(seen.nearest, view.required_clearance)
    assert shown["pair"] == [expected.first, expected.second]
    assert shown["now"] == pytest.approx(1e3 * expected.distance, abs=0.2)
    first, second = np.array(shown["points_mm"])
    # The points are on the surfaces, but for the radius of a cable that is nearest.
    assert np.linalg.norm(first - second) == pytest.approx(shown["now"], abs=0.3)
    assert shown["required"] == pytest.approx(1e3 * SCENE.obstacle_clearance)
    exact = nearest_data(replace(seen.nearest, distance=0.00725), 0.00725)
    assert exact["now"] == exact["required"] == 7.25


def test_a_large_robot_is_shown_while_its_tensions_are_not_the_planned_ones() -> None:
    """12 m of rope stretch by millimetres in motion: the record has this pose."""
    rig = load_rig(HALL)
    motion = replace(rig.motion, start_tolerance=0.001, following_error=0.002)  # the defaults
    rig = replace(rig, motion=motion)
    winches, tensions = WinchMap(rig), working_tensions(rig, rig.home).tensions
    counts = winches.counts(winches.unstrained(cable_lengths(rig, rig.home), tensions))
    drives = [
        {"position_counts": round(float(count)), "tension_n": float(tension)}
        for count, tension in zip(counts, tensions, strict=True)
    ]

    def seen_with(more: float, paid_out: float) -> RobotNow | None:
        first = {
            "tension_n": drives[0]["tension_n"] + more,
            "position_counts": drives[0]["position_counts"]
            + round(paid_out * rig.winches[0].counts_per_metre),
        }
        return RobotView(rig, None).take({"folder": "", "drives": [first, *drives[1:]]})

    seen = seen_with(400.0, 0.0)
    assert seen is not None
    assert seen.pose.distance_to(rig.home) < 0.030
    assert seen_with(0.0, 0.050) is None, "slipped"


def test_a_run_that_is_under_way_is_seen_in_its_own_scene(tmp_path: Path) -> None:
    """Its clearance is to the obstacles of its plan, not to those of the console's scene."""
    write_short_plan(tmp_path / "short.json")
    plan = load_plan(tmp_path / "short.json")
    folder = RunFolder.create(tmp_path / "run")
    folder.write_plan(plan.document)
    folder.write_rig(THE_RIG.document)
    view = RobotView(THE_RIG, SCENE)
    with folder.held():
        assert folder.is_active()
        view.take({**status_at(THE_RIG.home), "folder": str(folder.path)})
    assert [one.name for one in view.scene.obstacles] == [o.name for o in plan.scene.obstacles]
    assert view.scene.obstacles != SCENE.obstacles


def run_status(folder: Path) -> MotionStatus:
    prepared: Any = SimpleNamespace(rig=THE_RIG, length=1.0, checked=SimpleNamespace(table=()))
    return RunStatus(prepared, folder, LocalRequests(), simulated_time=True)


def winch_status(folder: Path) -> MotionStatus:
    status = WinchStatus(THE_RIG, LocalRequests(), simulated_time=True)
    status.take_folder(folder)
    return status


@pytest.mark.parametrize("made", [run_status, winch_status])
def test_the_folder_of_a_motion_is_the_same_for_viewers_in_other_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, made: Callable[[Path], MotionStatus]
) -> None:
    """One relative to theirs may hold another run, with other obstacles."""
    for name in ("running", "viewing"):
        (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path / "running")
    status = made(Path("runs/first"))
    monkeypatch.chdir(tmp_path / "viewing")
    assert Path(status.as_dict()["folder"]).absolute() == tmp_path / "running/runs/first"


class AtOnce(ThreadPoolExecutor):
    """Works in the thread that asks."""

    def submit(self, work: Any, /, *arguments: Any) -> Any:  # type: ignore[override]
        answer: Future[Any] = Future()
        try:
            answer.set_result(work(*arguments))
        except Exception as error:
            answer.set_exception(error)
        return answer


class Drives:
    """A robot whose drives are read, by a pose; or its reading."""

    def __init__(self) -> None:
        self.reading: StatusResult | Exception = self.held_at(THE_RIG.home)
        self.readings = 0
        self.watch = RobotWatch(RobotView(THE_RIG, SCENE), self.read, AtOnce(1))

    @staticmethod
    def held_at(pose: Pose, tension: float = 20.0, has_torque: bool = True) -> StatusResult:
        flags = {"has_torque": has_torque, "set_up": True}
        drives = tuple(DriveStatus(k, "any", 0, tension, **flags) for k in range(1, 9))
        counts = ReferenceStatus(counts=True, why_not=None, made="", how="jig", file="")
        return StatusResult("rig", "bus", None, (), None, False, counts, drives, pose)

    def read(self) -> StatusResult:
        self.readings += 1
        if isinstance(self.reading, Exception):
            raise self.reading
        return self.reading

    def rest(self) -> None:
        for _ in range(3):
            self.watch.update(None, is_busy=False)

    def move(self, pose: Pose) -> None:
        self.watch.update(status_at(pose), is_busy=True)


def wound_in_at(pose: Pose) -> dict[str, Any]:
    status = status_at(pose)
    status["drives"][2]["position_counts"] -= 9000  # wound in by 14 mm
    return status


RELEASED = replace(
    Drives.held_at(THE_RIG.home, 0.0, has_torque=False),
    pose=None,
    reference=ReferenceStatus(counts=False, why_not="released", made=None, how=None, file=None),
)
SILENT = HardwareMissing("drive 3 does not answer", where="bus")


@pytest.mark.parametrize(
    ("reading", "tensions", "why_not"),
    [
        (RELEASED, [None] * 8, "released"),
        (replace(RELEASED, why_no_pose="no pose fits"), [None] * 8, "no pose fits"),
        (replace(RELEASED, drives=None, missing=SILENT), None, "drive 3 does not answer"),
        (OSError("unplugged"), None, "OSError: unplugged"),
        (SILENT, None, "drive 3 does not answer"),
    ],
)
def test_what_is_not_read_at_rest_is_not_shown_as_known(
    reading: StatusResult | Exception, tensions: list[None] | None, why_not: str
) -> None:
    """After a release, a loss of power or of the reference: neither pose nor old tensions."""
    drives = Drives()
    drives.rest()
    seen = drives.watch.now
    assert seen.robot is not None
    assert (seen.tensions, seen.why_not) == ([20.0] * 8, None)
    assert seen.at is not None, "nothing watches the drives at rest"
    assert datetime.fromisoformat(seen.at).tzinfo is not None, "the page may be elsewhere"
    drives.move(THE_RIG.home)
    assert drives.watch.now.as_dict() is None, "live"
    drives.reading = reading
    drives.rest()
    seen = drives.watch.now
    assert (seen.robot, seen.tensions, seen.why_not) == (None, tensions, why_not)
    assert seen.at is not None
    with pytest.raises(Refused, match="pose is not known"):
        drives.watch.pose(None)
    assert drives.watch.pose_at_rest() is None


def test_a_reference_that_the_drives_lost_is_not_valid_whatever_its_file_states() -> None:
    """Encoders lost whole turns: the page showed homed drives, and its buttons refused."""
    drives, valid = Drives(), StoredState(None, True, None)
    drives.rest()
    assert drives.watch.now.why_lost is None
    homed = {"counts": True, "known": True, "why_not": None}
    assert stored_state(valid, drives.watch.now)["reference"] == homed
    drives.reading = RELEASED
    drives.watch.ask()
    drives.rest()
    lost = {"counts": False, "known": True, "why_not": "released"}
    assert stored_state(valid, drives.watch.now)["reference"] == lost
    noted = StoredState(None, False, "noted")
    assert stored_state(noted, drives.watch.now)["reference"] == {**lost, "why_not": "noted"}
    unread = ReferenceStatus(counts=True, why_not=None, made="", how="jig", file="")
    for reference in (
        replace(RELEASED.reference, valid_after_reset=True),
        unread.if_unread("drive 3 does not answer"),
    ):
        drives.reading = replace(RELEASED, reference=reference)
        drives.watch.ask()
        drives.rest()
        assert drives.watch.now.why_lost is None, "homing is not the next step"


@pytest.mark.parametrize("unread", [replace(RELEASED, drives=None, missing=SILENT), SILENT])
def test_whether_drives_that_do_not_answer_are_homed_is_unknown(
    unread: StatusResult | Exception,
) -> None:
    """The page showed a green "Homed" beside drives that do not answer."""
    drives, valid = Drives(), StoredState(None, True, None)
    drives.rest()
    drives.reading = unread
    drives.watch.ask()
    drives.rest()
    why = "drive 3 does not answer"
    unknown = {"counts": False, "known": False, "why_not": why}
    assert stored_state(valid, drives.watch.now)["reference"] == unknown
    noted = {"counts": False, "known": True, "why_not": "noted"}
    assert stored_state(StoredState(None, False, "noted"), drives.watch.now)["reference"] == noted
    drives.reading = Drives.held_at(THE_RIG.home)
    drives.watch.ask()
    drives.rest()
    assert stored_state(valid, drives.watch.now)["reference"]["counts"]


def test_a_reading_that_fails_does_not_undo_the_loss_of_a_reference() -> None:
    drives = Drives()
    for reading in (RELEASED, SILENT, SILENT):
        drives.reading = reading
        drives.watch.ask()
        drives.rest()
    lost = {"counts": False, "known": True, "why_not": "released"}
    assert stored_state(StoredState(None, True, None), drives.watch.now)["reference"] == lost


class CommandedBus:
    """No drive answers; a set-point of another program comes."""

    channel_info = "commanded"

    def __init__(self, identifier: int) -> None:
        point = can.Message(arbitration_id=identifier, data=bytes(8), is_extended_id=False)
        self.coming = [None, point]  # what came before is discarded

    def fileno(self) -> int:
        raise NotImplementedError

    def send(self, message: can.Message, timeout: float | None = None) -> None: ...

    def recv(self, timeout: float | None = None) -> can.Message | None:
        return self.coming.pop(0) if self.coming else None


@pytest.mark.parametrize(
    ("file", "identifier", "words"),
    [
        (RIG, 0x201, "another program sends set-points to drive 1"),
        (ODRIVE_RIG, 0x2C, "another program commands drive 1 (Set_Input_Pos)"),
    ],
)
def test_drives_that_another_program_commands_are_reported_as_in_use(
    file: Path, identifier: int, words: str
) -> None:
    """The page said "At rest" while it showed the other program's set-points."""
    rig, drives = load_rig(file).with_bus("socketcan", "can0"), Drives()
    with pytest.raises((Refused, ForeignMaster)) as caught:
        read_drives(rig, CommandedBus(identifier), partial=True)  # type: ignore[arg-type]
    drives.reading = replace(RELEASED, drives=None, missing=caught.value)
    drives.rest()
    read = drives.watch.now.as_dict()
    assert read is not None
    assert (read["why_not"], read["in_use"]) == (words, True)
    assert words in none_found(rig, drives.watch.now)
    assert none_found(THE_RIG, RobotReport(None, None)) == "nothing moves"
    drives.reading = SILENT
    drives.watch.ask()
    drives.rest()
    assert not drives.watch.now.in_use


def test_whether_drives_are_homed_is_unknown_before_their_first_reading() -> None:
    """The page showed a green "Homed" until then, as long as another program used them."""
    drives, valid = Drives(), StoredState(None, True, None)
    unread = stored_state(valid, drives.watch.now)["reference"]
    why = "the drives have not been read yet"
    assert unread == {"counts": False, "known": False, "why_not": why}
    drives.reading = replace(RELEASED, drives=None, being_set_up=True)
    drives.rest()
    assert drives.watch.now.in_use
    assert not stored_state(valid, drives.watch.now)["reference"]["known"]
    assert drives.watch.now.at is not None, "of this reading, as there are no values"
    drives.watch.simulate_at(THE_RIG.home)
    assert stored_state(valid, drives.watch.now)["reference"]["counts"]


def test_a_run_whose_cables_fit_no_pose_keeps_no_old_one() -> None:
    drives = Drives()
    drives.move(THE_RIG.home)
    assert drives.watch.now.robot is not None
    status = wound_in_at(THE_RIG.home)
    status["drives"][2]["torque"] = "none"
    drives.watch.update(status, is_busy=True)
    seen = drives.watch.now
    assert seen.robot is None
    assert [tension is None for tension in seen.tensions or []] == [k == 2 for k in range(8)]
    assert "fit no pose" in (seen.why_not or "")
    drives.watch.update({"folder": "", "drives": []}, is_busy=True)
    assert drives.watch.now.tensions == seen.tensions, "before its first cycle nothing is known"


def test_the_drives_are_read_after_a_motion_and_when_asked_and_not_otherwise() -> None:
    drives = Drives()
    drives.rest()
    drives.rest()
    assert drives.readings == 1, "at the start"
    drives.watch.ask()
    drives.rest()
    assert drives.readings == 2
    drives.move(THE_RIG.home)
    drives.watch.ask()
    drives.watch.update(None, is_busy=True)  # its report is being written
    assert drives.readings == 2
    assert drives.watch.now.at is not None, "nothing reports any more"
    drives.rest()
    assert drives.readings == 3


def test_drives_that_another_program_uses_keep_their_values_and_are_read_later(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = [1000.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    drives = Drives()
    drives.rest()
    known = drives.watch.now
    drives.reading = replace(RELEASED, drives=None, being_set_up=True)
    drives.watch.ask()
    drives.rest()
    seen = drives.watch.now
    assert (seen.robot, seen.at) == (known.robot, known.at)
    assert "another program" in (seen.why_not or "")
    with pytest.raises(Refused):
        drives.watch.pose(None)
    drives.reading, before = RELEASED, drives.readings
    drives.rest()
    assert drives.readings == before
    now[0] += USED_FOR
    drives.rest()
    assert drives.watch.now.why_not == "released"


def test_a_pose_at_rest_is_that_of_the_drives_now() -> None:
    """The platform may have been moved since the drives were read."""
    drives = Drives()
    drives.rest()
    moved = Pose(THE_RIG.home.position + np.array([0.0, 0.0, 0.0254]), THE_RIG.home.rotation)
    drives.reading = Drives.held_at(moved)
    for pose in (drives.watch.pose_at_rest(), drives.watch.pose(None)):
        assert pose is not None
        assert pose.distance_to(moved) == 0.0


@settings(deadline=None)
@given(st.tuples(*[st.floats(-5e-3, 5e-3)] * 3))
@example((0.0, 0.0, 0.0))
@example((0.0, 0.0, 2.0e-3))
def test_a_commanded_pose_is_taught_only_where_the_drives_are(off: tuple[float, ...]) -> None:
    home = THE_RIG.home
    jog = {"position_mm": (1e3 * home.position).tolist(), "quaternion": [*home.quaternion]}
    there = Pose(home.position + np.array(off), home.rotation)
    robot = RobotView(THE_RIG, None).simulated_at(there)
    lengths = cable_lengths(THE_RIG, there) - cable_lengths(THE_RIG, home)
    if np.abs(lengths).max() <= THE_RIG.motion.start_tolerance:
        assert commanded_pose(THE_RIG, jog, robot).distance_to(home) < 1e-9
        return
    with pytest.raises(Refused, match="not where the jog commanded"):
        commanded_pose(THE_RIG, jog, robot)


def measurement_with(covariance: Array) -> dict[str, Any]:
    flat = covariance.reshape(-1).tolist()
    return {
        "position_mm": [1.0, 2.0, 3.0],
        "covariance_mm2": flat,
        "stated": True,
        "clearance": None,
    }


@given(arrays(np.float64, (3, 3), elements=st.floats(-2.0, 2.0)))
def test_the_ellipsoid_is_that_of_the_covariance(root: Array) -> None:
    """Its half axes are at right angles, and their squares add up to the covariance."""
    covariance = root @ root.T
    shown = measured_view(measurement_with(covariance), 0.1)
    axes = np.array(shown["half_axes_mm"])
    assert axes.T @ axes / ELLIPSOID_SCALE**2 == pytest.approx(covariance, abs=2e-3)
    apart = axes @ axes.T
    assert apart - np.diag(np.diag(apart)) == pytest.approx(np.zeros((3, 3)), abs=2e-2)
    assert shown["within_mm"] == pytest.approx(np.linalg.norm(axes, axis=1).max(), abs=2e-3)


def test_the_ellipsoid_holds_95_percent() -> None:
    assert chdtr(3, ELLIPSOID_SCALE**2) == pytest.approx(0.95, abs=1e-5)


def test_a_run_states_all_errors_of_a_measured_position() -> None:
    """Errors common to all images count as much as the scatter; rotations are left out."""
    own, shared = np.diag([1e-8] * 3 + [1.0] * 3), np.diag([3e-8] * 3 + [1.0] * 3)
    pose = Pose(np.array([0.1, -0.2, 0.3]), np.eye(3))
    found = PoseMeasurement(1.25, pose, own, (1,), 0.1, "tracked", shared, unstated=False)
    clearance = clearance_at(ClearanceModel(THE_RIG, SCENE), pose, own + shared, 0.0)
    assert clearance is not None
    said = status.measured_data(found, clearance)
    assert said["time_s"] == 1.25
    assert said["stated"] is True
    assert said["position_mm"] == [100.0, -200.0, 300.0]
    assert said["covariance_mm2"] == pytest.approx((0.04 * np.eye(3)).reshape(-1).tolist())
    near = said["clearance"]
    assert near["low_mm"] < near["distance_mm"] <= near["high_mm"]
    assert near["distance_mm"] == pytest.approx(1e3 * clearance.distance, abs=1e-3)


def test_a_session_of_jogs_that_a_fault_ended_says_that_a_fault_is_latched() -> None:
    status = {"state": "latched", "feed_percent": 0, "elapsed_s": 9.0, "events": []}
    status |= {"jog": {"limit": None, "room_mm": None, "speed_mm_s": 20.0}}
    assert jog_state(status)["why_not"] == "a fault is latched"
    assert jog_state(status | {"state": "securing"})["why_not"] == "the drives are securing"
