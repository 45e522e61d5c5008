"""Faults during a run: latched, reported, drives held, everything recorded, FAILED."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn

import can
import numpy as np
import pytest

from drivers.can_bus import SentFrame
from drivers.cia402.pdo import RPDO1_BASE, TPDO1_BASE
from drivers.cia402.state_machine import DriveState
from executor import evaluation as run_module
from executor.control.cycle import SETTLING
from executor.realtime.scheduling import SimulatedClock
from executor.recording.run_folder import NEEDED, RunEvent, RunFolder
from executor.safety.fault_messages import NOTE_EVENTS
from executor.state_machine import State
from executor.supervision import OperatorRequests, StopReason
from executor.trajectory.setpoints import PreparedRun, prepare
from model.errors import Fault, Refused
from model.files.drive_profile_file import ProfileDocument
from model.files.rig_file import RigDocument
from model.pose import Array
from model.rig import rig_from_document
from simulation.plant import Plant
from tests.cli.plans import RIG
from tests.cli.program import call
from tests.drivers.test_drive_warnings import answers_after_its_set_points
from tests.scenarios.stage import CRUISING, Stage, at, concluded, staged


@dataclass(frozen=True)
class Case:
    """A fault: its script, its cycle, and the required report.

    Attributes:
        happens: Called at the beginning of the cycle.
        code: Of the event.
        words: In the cause.
        cycle: In which it happens.
        within: Cycles from there until the drives are commanded to stop.
        lost: Drives that cannot hold by quick stop: they are gone or in fault themselves.
    """

    happens: Callable[[Stage], object]
    code: str
    words: tuple[str, ...]
    cycle: int = CRUISING
    within: int = 4
    lost: tuple[int, ...] = ()


def silence(drive: int) -> Callable[[Stage], object]:
    return lambda stage: setattr(stage.drives[drive], "silent", True)


def slip(stage: Stage) -> None:
    """3 mm of cable run off the drum, which then sticks."""
    per_metre = stage.prepared.rig.winches[1].counts_per_metre
    stage.drives[1].motor.position += 0.003 * per_metre
    stage.drives[1].motor.jammed = True


def late(stage: Stage) -> None:
    stage.lateness = 1.4


def jump_in_table(stage: Stage) -> None:
    """As if the loop's memory had changed after arming, although it is sealed."""
    mover: Any = stage.mover
    loop = mover._loop
    setpoints = loop._checked.setpoints.copy()
    setpoints[CRUISING + 5 :, 3] -= 4000
    loop._checked = replace(loop._checked, setpoints=setpoints)


def unplug(stage: Stage) -> None:
    """The executor's adapter takes no frame any more."""

    def send(*_: object, **__: object) -> None:
        raise can.CanOperationError("no buffer space available")

    stage.group._bus.send = send  # type: ignore[attr-defined]


def limit_switch(stage: Stage) -> None:
    drive = stage.drives[2]
    answers_after_its_set_points(drive)
    drive._emergency(0x8612)
    drive._quick_stop()


def fails_silently(stage: Stage) -> None:
    stage.drives[2].fail(0x3210)
    stage.drives[2].silent = True


def no_heartbeat(stage: Stage) -> None:
    stage.drives[2]._heartbeat_period = 0.0


def lose_replies(stage: Stage, lost: Callable[[int], Collection[int]]) -> None:
    """Replies of the drives that a function returns for a cycle do not arrive."""
    watch = stage.group._watch  # type: ignore[attr-defined]
    take = watch.take

    def takes(can_id: int, *args: Any, **more: Any) -> None:
        if can_id - TPDO1_BASE - 1 not in lost(stage.cycle):
            take(can_id, *args, **more)

    watch.take = takes


def every_other_reply(*drives: int) -> Callable[[Stage], object]:
    return lambda stage: lose_replies(stage, lambda cycle: drives if cycle % 2 else ())


#: Those that the fault table lacks (`tests.scenarios.faults`), and one that it has.
CASES = {
    "a drive loses every other reply": Case(
        every_other_reply(3),
        "drive_silent",
        ("(drive 4) did not answer in 10 of the last 50 cycles; stopped along the path",),
        within=20,
    ),
    "all drives lose every other reply": Case(
        every_other_reply(*range(8)),
        "drive_silent",
        ("all 8 drives did not answer in 10 of the last 50 cycles: bus or supply; stopped along",),
        within=20,
    ),
    "a drive reports an emergency and goes on": Case(
        lambda stage: stage.drives[2]._emergency(0x4310),
        "drive_fault",
        ("(drive 3)", "temperature", "quick stop of all"),
    ),
    "a drive stops itself, and shows the state after its set-points": Case(
        limit_switch, "drive_fault", ("(drive 3)", "8612h", "quick stop of all")
    ),
    "a drive fails and leaves the bus": Case(
        fails_silently, "drive_fault", ("(drive 3)", "3210h", "quick stop of all"), lost=(2,)
    ),
    "the heartbeat of a drive ceases": Case(
        no_heartbeat, "drive_fault", ("(drive 3) sends no heartbeat",), within=12
    ),
    "a winch slips": Case(slip, "following_error", ("cable 2", "limit 2.00 mm"), lost=(1,)),
    "the loop is late": Case(late, "late", ("1.4 cycles late; stopped along",), within=40),
    "the table was changed": Case(jump_in_table, "gate_denied", ("cable 4", "step"), within=30),
    "a drive is silent while enabling": Case(
        silence(6), "drive_silent", ("(drive 7) did not answer",), cycle=1, lost=(6,)
    ),
    "a drive fails while enabling": Case(
        lambda stage: stage.drives[6].fail(0x3210), "drive_fault", ("drive 7",), cycle=2, lost=(6,)
    ),
    "a drive is never enabled": Case(
        lambda stage: setattr(stage.drives[4], "_command_enable", lambda: None),
        "drive_fault",
        ("(drive 5) is in switched on instead of operation enabled",),
        cycle=0,
        within=110,
    ),
    "a drive does not go over to hold": Case(
        lambda stage: setattr(stage.drives[4], "_command_quick_stop", lambda: None),
        "hold_timeout",
        ("did not hold within 3 s; cable 5 (drive 5) is in operation enabled; quick stop",),
        within=600,
        lost=(4,),
    ),
    "a drive falls silent at the goal": Case(
        silence(0), "drive_silent", ("(drive 1) did not answer",), cycle=320, lost=(0,)
    ),
}


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """The report is made in one of these scenarios only: it takes longer than the run."""
    monkeypatch.setattr(run_module, "build_report", lambda folder: folder.report)


@pytest.fixture
def table_restored(prepared: PreparedRun) -> Iterator[None]:
    setpoints = prepared.checked.table.setpoints
    kept = setpoints.copy()
    yield
    if setpoints.flags.writeable:
        setpoints[:] = kept
        setpoints.setflags(write=False)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.usefixtures("no_pictures", "table_restored")
def test_a_fault_is_latched_reported_held_and_recorded(
    prepared: PreparedRun, tmp_path: Path, name: str
) -> None:
    case = CASES[name]
    with staged(prepared, tmp_path / "run", at(case.cycle, case.happens)) as stage:
        outcome = stage.run()
        assert outcome.state is State.LATCHED
        assert all(word in outcome.cause for word in case.words), outcome.cause
        events = stage.events()
        reported = [event for event in events if event.code == case.code]
        assert reported, events
        since = reported[-1].time_s / prepared.checked.table.cycle - case.cycle
        assert 0 <= since <= case.within
        held = [d.state for i, d in enumerate(stage.drives) if i not in case.lost]
        if case.cycle < 10:  # nothing was enabled: the brakes hold
            assert DriveState.OPERATION_ENABLED not in held
        else:
            assert set(held) == {DriveState.QUICK_STOP_ACTIVE}
        summary = concluded(stage, outcome)
    assert summary["verdict"] == "FAILED"
    assert not summary["passed"]
    assert summary["final_state"] == "latched"
    assert any(all(word in reason for word in case.words) for reason in summary["reasons"])
    assert [event["code"] for event in summary["events"]] == [event.code for event in events]
    folder = RunFolder.open(stage.folder.path)
    assert all((folder.path / file).is_file() for file in NEEDED)
    assert folder.mcap.is_file()
    assert len(folder.cycles()) == summary["cycles"] == len(outcome.log)


@pytest.mark.usefixtures("no_pictures")
def test_a_mere_warning_of_a_drive_ends_no_run(
    prepared: PreparedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One sent in several cycles in a row is one event, and in the verdict each is stated once."""
    monkeypatch.setattr(ProfileDocument, "is_warning", lambda _profile, code: code == 0x3280)

    def warn(stage: Stage) -> None:
        if stage.cycle in (CRUISING + 1, *range(CRUISING, CRUISING + 28, 2)):
            stage.drives[2]._emergency(0x3280)

    with staged(prepared, tmp_path / "run", warn) as stage:
        outcome = stage.run()
        assert outcome.state is State.FINISHED
        reported = [event.text for event in stage.events() if event.code == "drive_warning"]
        checks = concluded(stage, outcome)["checks"]
    assert len(reported) == NOTE_EVENTS
    assert "3280h" in reported[0]
    assert [check["name"] for check in checks].count("drive_warning") == 1


@pytest.mark.usefixtures("no_pictures")
def test_the_drive_that_lost_the_most_replies_is_named_with_its_share(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    lost = dict.fromkeys(range(CRUISING, CRUISING + 18, 2), (3,)) | {CRUISING + 30: (3, 5)}
    lost.pop(CRUISING)  # nine, all others

    def begin(stage: Stage) -> None:
        lose_replies(stage, lambda cycle: lost.get(cycle, ()))

    with staged(prepared, tmp_path / "run", at(0, begin)) as stage:
        outcome = stage.run()
        summary = concluded(stage, outcome)
    assert outcome.state is State.FINISHED, outcome.cause
    (check,) = (c for c in summary["checks"] if c["name"] == "lost_replies")
    share = f"cable 4 (drive 4), 9 of {summary['cycles']}"
    assert check["text"].endswith(f"; largest share of lost replies: {share}.")
    last = stage.events()[-1]
    assert (last.code, last.text) == ("reply_lost", f"largest share of lost replies: {share}")


@pytest.mark.usefixtures("no_pictures")
def test_drives_that_said_they_hold_need_not_answer_in_the_same_cycle(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    """Two drives lost replies in turn: the run waited 3 s and latched a fault, but all held."""

    took = []
    for longest in (0, 16):
        securing: list[int] = []

        def lost(stage: Stage, longest: int = longest, cycles: list[int] = securing) -> list[int]:
            if stage.recorder is None or stage.recorder.state is not State.SECURING:
                return []
            cycles.append(stage.cycle)
            return (
                [2 + stage.cycle % 2] if 0 <= stage.cycle - cycles[0] - SETTLING < longest else []
            )

        begin = at(0, lambda stage, lost=lost: lose_replies(stage, lambda _: lost(stage)))
        with staged(prepared, tmp_path / f"run-{longest}", begin) as stage:
            outcome = stage.run()
        assert outcome.state is State.FINISHED, outcome.cause
        took.append(len(set(securing)))
    assert took[1] < took[0] + 8


@pytest.mark.usefixtures("no_pictures")
def test_each_missed_set_point_is_recorded(prepared: PreparedRun, tmp_path: Path) -> None:
    """A loose connector must not look like one disturbed frame."""
    cycles = (120, 160, 200, 240)

    def begin(stage: Stage) -> None:
        cyclic = stage.group._cyclic  # type: ignore[attr-defined]
        send = cyclic.send

        def loses_one(frames: Iterable[SentFrame]) -> None:
            lost = RPDO1_BASE + 2 if stage.cycle in cycles else None
            send([frame for frame in frames if frame.arbitration_id != lost])

        cyclic.send = loses_one

    with staged(prepared, tmp_path / "run", at(0, begin)) as stage:
        outcome = stage.run()
        events = stage.events()
    assert outcome.state is State.FINISHED
    missed = [event.time_s for event in events if event.code == "set_point_missed"]
    assert len(missed) == len(cycles)
    assert np.diff(missed) == pytest.approx(0.4)


def test_less_clearance_than_the_platform_needs_to_stop_is_refused(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    """Drives that hardly slow down travel 319 mm; the path has 284 mm of clearance."""
    profile = tmp_path / "lab.yaml"
    gentle = 'ranges: {"6085h:00": {low: 1, high: 2000}}'
    profile.write_text(f"name: Gentle\nsources: [this test]\n{gentle}\n")
    document = prepared.rig.document.model_dump()
    document["drives"]["profile"] = str(profile)
    with pytest.raises(Refused, match="without its master the platform travels up to 31"):
        prepare(prepared.plan, rig_from_document(RigDocument.model_validate(document)))


@pytest.mark.usefixtures("no_pictures")
def test_a_bus_that_fails_leaves_the_drives_stopping_on_their_own(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    with staged(prepared, tmp_path / "run", at(CRUISING, unplug)) as stage:
        outcome = stage.run()
        assert outcome.state is State.LATCHED
        assert "no buffer space" in outcome.cause
        assert "stop_not_sent" in [event.code for event in stage.events()]
        stage.rehearsal.advance(0.1)
        assert {drive.state for drive in stage.drives} == {DriveState.QUICK_STOP_ACTIVE}
        summary = concluded(stage, outcome)
    assert summary["verdict"] == "FAILED"
    assert any("no buffer space" in reason for reason in summary["reasons"])


def test_a_simulation_that_fails_is_the_cause_of_the_end(
    prepared: PreparedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The true pose after the motion, which then fails as well, is not needed."""

    def fail(plant: Plant, unstrained: Array) -> NoReturn:
        raise plant._lost("no equilibrium after 200 steps", unstrained)

    def script(stage: Stage) -> None:
        if stage.cycle == CRUISING:
            monkeypatch.setattr(Plant, "settling", fail)

    with staged(prepared, tmp_path / "run", script) as stage:
        outcome = stage.run()
        with pytest.raises(Fault, match="no equilibrium"):
            assert stage.rehearsal.pose
        (event,) = [event for event in stage.events() if event.code == "fault"]
    assert outcome.state is State.LATCHED
    cause = "the simulation failed: no equilibrium after 200 steps; quick stop of all drives"
    assert outcome.cause == event.text == cause


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.parametrize("callback", ["progress", "trigger"])
def test_an_error_in_a_callback_stops_the_drives_and_is_on_record(
    prepared: PreparedRun, tmp_path: Path, callback: str
) -> None:
    def broken(*_: object) -> None:
        if stage.cycle >= CRUISING:
            raise ZeroDivisionError("a defect in a callback")

    with staged(prepared, tmp_path / "run", lambda _stage: None) as stage:
        outcome = stage.run(**{callback: broken})  # type: ignore[arg-type]
        assert outcome.state is State.LATCHED
        assert "recorder" in [event.code for event in stage.events()]
        stage.rehearsal.pump()
        assert {drive.state for drive in stage.drives} == {DriveState.QUICK_STOP_ACTIVE}
        summary = concluded(stage, outcome)
    assert summary["verdict"] == "FAILED"
    assert any("a defect in a callback" in reason for reason in summary["reasons"])


def test_a_full_disk_stops_the_drives(
    prepared: PreparedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An event that cannot be written is a fault; the drives are stopped before it is reported."""

    def full(_folder: RunFolder, _event: RunEvent) -> None:
        raise Fault("the run folder cannot be written", why="No space left on device")

    with staged(prepared, tmp_path / "run", lambda _stage: None) as stage:
        monkeypatch.setattr(RunFolder, "append_event", full)
        outcome = stage.run()
        assert outcome.state is State.LATCHED
        stage.rehearsal.pump()
        assert DriveState.OPERATION_ENABLED not in {drive.state for drive in stage.drives}


@pytest.mark.usefixtures("no_pictures")
def test_a_fault_during_a_path_stop_is_named_after_the_first_cause(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    """The stop along the path was begun, but a quick stop overtook it."""

    def both(stage: Stage) -> None:
        if stage.cycle == CRUISING:
            late(stage)
        elif stage.cycle == CRUISING + 5:
            stage.drives[5].fail(0x2310)

    with staged(prepared, tmp_path / "run", both) as stage:
        outcome = stage.run()
        codes = [event.code for event in stage.events()]
    assert outcome.state is State.LATCHED
    first, _, second = outcome.cause.partition("; then ")
    assert first == "a cycle began 1.4 cycles late"
    assert second.startswith("cable 6 (drive 6)")
    assert second.endswith("; quick stop of all drives")
    assert codes.index("late") < codes.index("drive_fault")


@pytest.mark.parametrize("then_fails", [False, True])
@pytest.mark.usefixtures("no_pictures")
def test_a_path_fault_at_the_goal_is_not_said_to_stop_the_path(
    prepared: PreparedRun, tmp_path: Path, then_fails: bool
) -> None:
    goal = prepared.checked.table.setpoints[-1].tolist()
    lost: list[int] = []

    def at_goal(stage: Stage) -> None:
        if not lost and stage.group.targets.tolist() == goal:
            lost.append(stage.cycle)
        elif then_fails and lost == [stage.cycle - 2]:
            stage.drives[5].fail(0x2310)

    def requests() -> OperatorRequests:
        return OperatorRequests(lost="the supervisor is silent" if lost else "")

    with staged(prepared, tmp_path / "run", at_goal) as stage:
        stage.board.read = requests  # type: ignore[method-assign]
        outcome = stage.run()
    assert outcome.state is State.LATCHED
    first, _, second = outcome.cause.partition("; then ")
    assert first == "the supervisor is silent; at rest"
    assert second.startswith("cable 6 (drive 6)") is then_fails


@pytest.mark.parametrize("lateness", [1.5, 2.0, 3.0, 1371.9])
@pytest.mark.usefixtures("no_pictures")
def test_after_the_drives_stopped_on_their_own_no_set_point_follows(
    prepared: PreparedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lateness: float
) -> None:
    """Targets stay those of the cycle before the silence; the first one of the stop is late."""
    with staged(
        prepared, tmp_path / "run", at(CRUISING, lambda s: setattr(s, "lateness", lateness))
    ) as stage:
        sent: list[tuple[int, tuple[int, ...]]] = []
        send = stage.group.send_cycle

        def noted(targets: tuple[int, ...], *may_send: Callable[[bool], bool]) -> None:
            sent.append((stage.cycle, tuple(targets)))
            send(targets, *may_send)

        monkeypatch.setattr(stage.group, "send_cycle", noted)
        outcome = stage.run()
        assert outcome.state is State.LATCHED
        concluded(stage, outcome)
    before = [targets for cycle, targets in sent if cycle in (CRUISING - 2, CRUISING - 1)]
    after = {targets for cycle, targets in sent if cycle >= CRUISING}
    assert before[0] != before[1], "it moved"
    assert after == {before[1]}
    assert CRUISING not in {cycle for cycle, _ in sent}
    assert stage.folder.cycles().lateness.max() == pytest.approx(lateness * 0.01)


@pytest.mark.parametrize(
    "reason", [None, StopReason("clearance_low", "9.1 mm"), StopReason("camera", "all failed")]
)
@pytest.mark.usefixtures("no_pictures")
def test_a_stop_request_does_not_hide_a_fault(
    prepared: PreparedRun, tmp_path: Path, reason: StopReason | None
) -> None:
    def both(stage: Stage) -> None:
        if stage.cycle == CRUISING:
            stage.board.ask_stop(reason)
        elif stage.cycle == CRUISING + 5:
            stage.drives[3].silent = True

    with staged(prepared, tmp_path / "run", both) as stage:
        outcome = stage.run()
        summary = concluded(stage, outcome)
    assert outcome.state is State.LATCHED
    assert summary["verdict"] == "FAILED"
    assert any("(drive 4) did not answer" in event["text"] for event in summary["events"])
    assert "(drive 4) did not answer" in outcome.cause, "what is latched is not the requested stop"
    assert (reason.code if reason else "stop") in [event["code"] for event in summary["events"]]


@pytest.mark.usefixtures("no_pictures")
def test_after_a_fault_no_target_moves_a_drive(prepared: PreparedRun, tmp_path: Path) -> None:
    with staged(prepared, tmp_path / "run", at(CRUISING, silence(3))) as stage:
        outcome = stage.run()
        table = outcome.log.table()
        stopped = int(np.flatnonzero(np.array(table.state) == State.LATCHED.value)[0])
        positions = table.actual_counts[stopped:]
        per_metre = np.abs([w.counts_per_metre for w in prepared.rig.winches])
        moved = np.abs(positions - positions[0]) / per_metre
        assert moved.max() < 0.002, "no more than the ramp of the quick stop"
        assert np.abs(np.diff(positions[-3:], axis=0)).max() == 0, "at rest at the end"


def kill_camera() -> None:
    (child,) = multiprocessing.active_children()
    child.kill()


@pytest.mark.parametrize(
    "cycle",
    [
        pytest.param(CRUISING, id="while moving"),
        pytest.param(100_000, id="after the motion", marks=pytest.mark.slow),
    ],
)
def test_a_camera_process_that_dies_is_named_and_the_run_is_on_record(
    short_plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cycle: int
) -> None:
    """Through the real program with its real camera process, killed as the system would."""
    from executor.cameras.multi_camera import ROUND
    from executor.cameras.process import CameraProcess

    cycles, real = 0, SimulatedClock.next_cycle
    answer_within = CameraProcess.answer_within

    def next_cycle(clock: SimulatedClock) -> float:
        nonlocal cycles
        cycles += 1
        if cycles == cycle:
            kill_camera()
        return real(clock)

    def die_or_answer(process: CameraProcess, patience: float) -> Any:
        if cycles < cycle and patience == ROUND:
            kill_camera()
            with suppress(EOFError, ConnectionResetError):
                while True:  # a fast camera has answered already
                    process._link.recv()
        return answer_within(process, patience)

    monkeypatch.setattr(SimulatedClock, "next_cycle", next_cycle)
    monkeypatch.setattr(CameraProcess, "answer_within", die_or_answer)
    run = tmp_path / "run"
    answer = call("run", short_plan, "--rig", RIG, "-o", run, "--fast")
    assert answer.code == 1, answer
    assert "FAILED" in answer.out
    assert "the process of camera front ended" in answer.said
    folder = RunFolder.open(run)
    summary = folder.summary()
    assert summary["verdict"] == "FAILED"
    assert any("camera front ended" in reason for reason in summary["reasons"])
    assert summary["final_state"] == ("stopped" if cycle == CRUISING else "finished")
    codes = [event["code"] for event in summary["events"]]
    assert codes.count("camera") == (2 if cycle == CRUISING else 1), (
        "reported, then the cause of a stop"
    )
    assert not {"recorder", "supervisor_lost"} & set(codes)
    if cycle == CRUISING:
        assert any("all cameras failed: front: the process" in r for r in summary["reasons"])
    assert folder.report.is_file()


def test_a_camera_that_faces_elsewhere_fails_the_run_and_states_why(
    short_plan: Path, tmp_path: Path
) -> None:
    """The motion is good; that it was measured is not true, and is not claimed."""
    text = RIG.read_text()
    looks = "[0.2052217375521776, -0.4121263851345742, -0.7946433272763131, 0.3956992083985057]"
    assert looks in text
    rig = tmp_path / "rig.yaml"
    assert "rate_hz: 10" in text  # an image without the platform is searched all over
    rig.write_text(text.replace(looks, "[1, 0, 0, 0]").replace("rate_hz: 10", "rate_hz: 5"))
    run = tmp_path / "run"
    answer = call("run", short_plan, "--rig", rig, "-o", run, "--fast")
    assert answer.code == 1, answer
    assert "FAILED" in answer.out
    assert "images gave a pose: " in answer.said
    summary = RunFolder.open(run).summary()
    codes = [event["code"] for event in summary["events"]]
    assert codes.count("camera_sees_nothing") == 1
    assert codes.index("camera_sees_nothing") < codes.index("held"), "reported during motion"
    assert summary["final_state"] == "finished"
    assert summary["clearance_mm"]["source"] == "encoder"
    assert summary["tag_error_mm"]["frames_without_pose"] == summary["tag_error_mm"]["frames"] > 15


def test_a_drive_that_goes_into_fault_during_the_set_up_is_refused_by_name(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    """It was armed, and only 0Fh was refused, without the drive and after a latch."""
    with staged(prepared, tmp_path / "run", lambda _stage: None) as stage:
        stage.drives[4].fail(0x3210)
        with pytest.raises(Refused, match=r"cable 5 \(drive 5\).*over-voltage") as caught:
            stage.run()
        assert not stage.armed, "no motion was noted, and no reference"
        assert DriveState.OPERATION_ENABLED not in {drive.state for drive in stage.drives}
    assert "nothing was enabled" in caught.value.next_step


def test_a_drive_that_goes_into_fault_while_the_operator_is_asked_is_the_cause(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    with staged(prepared, tmp_path / "run", lambda _stage: None) as stage:

        def asked() -> None:
            stage.drives[4].fail(0x3210)
            stage.now += 1.5 * prepared.checked.table.cycle  # the next SYNC shows it

        outcome = stage.run(before_motion=asked)
    assert outcome.state is State.LATCHED
    assert "cable 5 (drive 5)" in outcome.cause
    assert "cannot enable" not in outcome.cause
    assert not any(DriveState.OPERATION_ENABLED in states for states in stage.drive_states)
