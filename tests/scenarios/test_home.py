"""Homing: slack cables are wound in, drives referenced; a run then agrees with the tags."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from drivers.can_bus import BusSettings, open_bus
from drivers.can_errors import BusDown
from drivers.cia402.pdo import TPDO1_BASE
from drivers.cia402.state_machine import DriveState
from drivers.drive_group import DriveGroup, GroupState
from drivers.factory import make_drive_group, read_drives
from executor.cameras.client import static_pose
from executor.control.preconditions import require_below, with_counts_at, with_reduced_limits
from executor.control.winch_laws import CableStep, PretensionLaw, WinchLaw, wind_in_speed
from executor.control.winch_loop import LawMotion
from executor.control.winch_motion import WinchResult, move_winches, recording, require_held
from executor.drives import current_pose
from executor.homing import home, reference_at
from executor.interlock.fault_latch import FaultLatch
from executor.interlock.interlock import MotionInterlock
from executor.interlock.reference import HomingReference, referenced
from executor.jogging import plan_straight_move
from executor.realtime.child import ReadyDrives
from executor.realtime.process import MotionHere
from executor.realtime.scheduling import SimulatedClock
from executor.recording.run_folder import RunFolder
from executor.state_machine import CycleRecord, LoopEvent, State
from executor.supervision import LocalRequests
from executor.trajectory.setpoints import PreparedRun, prepare
from model.errors import CdprError, Fault, Refused, StoppedByOperator
from model.kinematics import cable_lengths
from model.plan import plan_from_document
from model.pose import Array, Pose, moved
from model.rig import Rig, load_rig, rig_from_document
from model.scene import empty_scene
from model.statics.gravity import working_tensions
from planner.check import verify
from simulation.camera.camera import SyntheticCamera
from simulation.drives.cia402_rig import SimulatedCia402Rig
from simulation.ground_truth import PowerLoss
from tests.cli.plans import HALL, RIG, straight_plan
from tests.scenarios.stage import Stage, at, staged
from tracking.measurement import PoseMeasurement
from tracking.tracker import Tracker

_CHANNELS = itertools.count()
HOLDING = DriveState.QUICK_STOP_ACTIVE
TARGET, LIMIT = 10.0, 60.0
FINDINGS = {"over_tension", "went_slack"}


@dataclass
class Records:
    """Forwards cycles and events."""

    on_cycle: Callable[[CycleRecord], None]
    take_event: Callable[[LoopEvent], None]

    def take_cycle(self, record: CycleRecord, _true_pose: Pose | None) -> None:
        self.on_cycle(record)


def mover(
    counted: Rig, as_set_up: Rig, law: WinchLaw, group: DriveGroup, board: LocalRequests
) -> MotionHere:
    """A law in simulated time, on configured drives."""
    drives = ReadyDrives(counted, group, None, lambda _load: None, ())
    limit, speed = as_set_up.max_tension, max(w.max_speed for w in as_set_up.winches)
    motion = LawMotion(as_set_up.cable_count, 0.01, lambda _rig, _counts: law, limit, speed)
    return MotionHere(motion, drives, SimulatedClock(0.01), board)


@dataclass
class Bench:
    """A rig after a power loss, and the motions on it."""

    rig: Rig
    rehearsal: SimulatedCia402Rig
    group: DriveGroup
    counted: Rig
    as_set_up: Rig
    counts: list[int]
    script: Callable[[Bench, int], None] = lambda _bench, _cycle: None
    at_rest: Callable[[WinchResult], HomingReference | None] = lambda _result: None
    interlock: MotionInterlock | None = None
    rehome: bool = True
    board: LocalRequests = field(default_factory=LocalRequests)
    records: list[CycleRecord] = field(default_factory=list)
    events: list[LoopEvent] = field(default_factory=list)
    take_event: Callable[[LoopEvent], None] = lambda _event: None
    folder: Path = Path("nowhere")
    tensions: list[Array] = field(default_factory=list)

    def take_up(self, reach: float = 0.02) -> WinchResult:
        law = PretensionLaw(
            self.as_set_up,
            self.counts,
            targets=np.full(self.as_set_up.cable_count, TARGET),
            limit=LIMIT,
            reach=reach,
            speed=0.002,
        )
        return self.move(law)

    def move(self, law: WinchLaw) -> WinchResult:
        def on_cycle(record: CycleRecord) -> None:
            self.records.append(record)
            self.tensions.append(self.rehearsal.tensions)
            self.script(self, record.cycle)

        def on_event(event: LoopEvent) -> None:
            self.events.append(event)
            self.take_event(event)

        return move_winches(
            mover(self.counted, self.as_set_up, law, self.group, self.board),
            self.rig,
            self.interlock or MotionInterlock(self.rig),
            Records(on_cycle, on_event),
            record=self.folder,
            rehome=self.rehome,
            at_rest=lambda result, _true_pose: self.at_rest(result),
        )

    @property
    def states(self) -> set[DriveState]:
        return {drive.state for drive in self.rehearsal.drives}

    def steps(self) -> Array:
        """Steps of the set-points, in cable wound in, shape (n, m), [m]."""
        per_metre = np.array([winch.counts_per_metre for winch in self.rig.winches])
        sent = np.array([r.targets for r in self.records if np.isfinite(r.following_error)])
        return -np.diff(sent, axis=0) / per_metre


@contextmanager
def after_power_loss(
    loss: PowerLoss | None, rig: Rig | None = None, limit: float = LIMIT, speed: float = 0.005
) -> Iterator[Bench]:
    rig = rig or load_rig(RIG)
    settings = BusSettings("virtual", f"home-{next(_CHANNELS)}")
    with open_bus(settings) as near, open_bus(settings) as far:
        rehearsal = SimulatedCia402Rig(rig, far, rig.home)
        if loss is not None:
            loss.apply_to(rig, rehearsal.plant, [drive.motor for drive in rehearsal.drives])
        group = make_drive_group(rig, near, rehearsal.pump)
        group.configure()
        counts = group.read_positions().positions.tolist()
        counted = with_counts_at(rig, counts, rig.home)
        as_set_up = with_reduced_limits(counted, limit=limit, speed=speed)
        group = make_drive_group(counted, near, rehearsal.pump, max_tension=limit)
        group.configure()
        yield Bench(rig, rehearsal, group, counted, as_set_up, counts)


def lost(seed: int, slack_mm: float = 3.0, *, on_a_stand: bool) -> PowerLoss:
    return PowerLoss.drawn(load_rig(RIG), seed, slack_mm / 1000.0, on_a_stand=on_a_stand)


def test_no_other_program_may_move_the_drives_before_the_reference_is_kept() -> None:
    rig = load_rig(RIG)
    bus = rig.document.bus.model_copy(update={"interface": "socketcan", "channel": "can0"})
    kept = rig_from_document(rig.document.model_copy(update={"bus": bus}))
    interlock = MotionInterlock(kept)

    def at_rest(result: WinchResult) -> HomingReference:
        with pytest.raises(Refused, match="in progress"):
            MotionInterlock(kept).require_free()
        return reference_at(kept, kept.home, result.counts, result.tensions, "stated pose", 0.0)

    with after_power_loss(lost(1, on_a_stand=True)) as bench:
        bench.interlock, bench.at_rest = interlock, at_rest
        assert bench.take_up().state is State.FINISHED
    MotionInterlock(kept).require_free()
    reference = MotionInterlock(kept).reference()
    assert reference is not None
    assert not reference.lost


@pytest.mark.parametrize("on_a_stand", [True, False])
@pytest.mark.parametrize("seed", [1, 2])
def test_slack_cables_are_wound_in_together_and_none_is_paid_out(
    seed: int, on_a_stand: bool
) -> None:
    with after_power_loss(lost(seed, on_a_stand=on_a_stand)) as bench:
        assert bench.rehearsal.tensions.min() < 0.1, "some hang slack"
        torque_limits = {drive.objects[0x6072, 0] for drive in bench.rehearsal.drives}
        assert torque_limits == {1.2 * LIMIT / 100.0 * 1000.0}, "of the drives themselves, in ‰"
        result = bench.take_up()
        assert (result.state, result.cause) == (State.FINISHED, "")
        assert bench.states == {HOLDING}
        assert bench.rehearsal.tensions.min() >= 0.75 * TARGET
        assert np.max(bench.tensions) <= LIMIT
        assert np.abs(result.tensions - bench.rehearsal.tensions).max() < 0.1
        steps = bench.steps()
        assert steps.min() >= 0.0
        assert steps.max() <= 0.00002 + 2e-6
        moving = {tuple(np.flatnonzero(row)) for row in steps}
        assert any(len(cables) == bench.rig.cable_count for cables in moving)


def test_home_then_run_then_the_tags_agree(tmp_path: Path) -> None:
    with after_power_loss(lost(5, on_a_stand=True)) as bench:
        result = bench.take_up()
        rig = referenced(
            bench.rig,
            reference_at(bench.rig, bench.rig.home, result.counts, result.tensions, "stated", 0.0),
        )
        bench.group.close()
        home = bench.rig.home.position
        scene = empty_scene(rig).changed(goal=Pose.level(home + np.array([0.012, -0.006, 0.015])))
        document = straight_plan(rig, scene, [tuple(home * 1e3), tuple(scene.goal.position * 1e3)])
        prepared = prepare(verify(plan_from_document(document), rig), rig)
        bus = bench.group._bus  # type: ignore[attr-defined]
        unhomed = make_drive_group(bench.rig, bus, bench.rehearsal.pump)
        with pytest.raises(Refused, match="outside its position limits"):
            unhomed.configure()
        unhomed.close()
        group = make_drive_group(rig, bus, bench.rehearsal.pump)
        group.configure()
        folder = RunFolder.create(tmp_path / "run")
        outcome = Stage(prepared, bench.rehearsal, group, folder, lambda _stage: None).run()
        assert outcome.state is State.FINISHED, outcome.cause
        seen = static_pose(rig, looks(rig, bench.rehearsal.pose))
        assert seen.pose.distance_to(scene.goal) < 0.5e-3
        assert bench.rehearsal.pose.distance_to(scene.goal) < 0.05e-3
        group.close()


def looks(rig: Rig, *poses: Pose) -> list[object]:
    camera, tracker = (
        SyntheticCamera(rig, empty_scene(rig), rig.cameras[0]),
        Tracker(rig, rig.cameras[0]),
    )
    poses = poses * 6 if len(poses) == 1 else poses
    return [tracker.observe(camera.render(p, k), k / 10.0) for k, p in enumerate(poses)]


def test_a_platform_that_hangs_free_is_referenced_by_its_tags_and_goes_home(
    tmp_path: Path,
) -> None:
    with after_power_loss(lost(7, on_a_stand=False)) as bench:
        result = bench.take_up()
        true = bench.rehearsal.pose
        assert true.angle_to(bench.rig.home) > 0.005, "it came to rest elsewhere"
        seen = static_pose(bench.rig, looks(bench.rig, true))
        assert seen.pose.distance_to(true) < 4.0 * seen.uncertainty
        reference = reference_at(
            bench.rig, seen.pose, result.counts, result.tensions, "tags", seen.uncertainty
        )
        rig, load = referenced(bench.rig, reference), empty_scene(bench.rig).load
        found = current_pose(rig, result.counts, load)
        assert found.distance_to(true) < 4.0 * seen.uncertainty
        home = plan_straight_move(rig, empty_scene(rig), found, rig.home)
        prepared = prepare(verify(plan_from_document(home), rig), rig)
        bus = bench.group._bus  # type: ignore[attr-defined]
        bench.group.close()
        group = make_drive_group(rig, bus, bench.rehearsal.pump)
        group.configure()
        folder = RunFolder.create(tmp_path / "run")
        outcome = Stage(prepared, bench.rehearsal, group, folder, lambda _stage: None).run()
        assert outcome.state is State.FINISHED, outcome.cause
        reached = bench.rehearsal.pose
        assert reached.distance_to(rig.home) < 4.0 * seen.uncertainty
        assert reached.angle_to(rig.home) < 0.01
        group.close()


def test_a_drum_that_moved_before_it_was_enabled_returns_no_faster_than_the_winches_may() -> None:
    """Enabling may let a drum sag; winches are then slower than the platform on a path."""
    speed, sagged = 0.002, 0.0006
    with after_power_loss(lost(1, on_a_stand=True), speed=speed) as bench:
        winch, drive = bench.rig.winches[2], bench.rehearsal.drives[2]
        drive.motor.position += sagged * winch.counts_per_metre
        result = bench.take_up()
        assert (result.state, result.cause) == (State.FINISHED, "")
        approach = [r.targets[2] for r in bench.records if r.state is State.APPROACHING]
        travelled = (approach[0] - approach[-1]) / winch.counts_per_metre
        assert travelled == pytest.approx(sagged, rel=0.05), "the first of them hardly moves"
        assert np.abs(bench.steps()[: len(approach)]).max() <= speed * bench.rig.cycle


@pytest.mark.parametrize("phase", [3, 60, 200])
def test_stop_ends_it_in_every_phase_and_a_hold_waits(phase: int) -> None:
    with after_power_loss(lost(1, on_a_stand=False)) as bench:

        def script(bench: Bench, cycle: int) -> None:
            if cycle == phase:
                bench.board.ask_stop()

        bench.script = script
        result = bench.take_up()
        assert result.state is State.STOPPED
        assert DriveState.OPERATION_ENABLED not in bench.states
    with after_power_loss(lost(1, on_a_stand=False)) as bench:

        def hold(bench: Bench, cycle: int) -> None:
            if cycle in (phase, phase + 100):
                bench.board.ask_hold(cycle == phase)

        bench.script = hold
        assert bench.take_up().state is State.FINISHED
        still = [r.targets for r in bench.records if r.cycle in (phase + 50, phase + 99)]
        assert still[0] == still[1]


def falls_silent(bench: Bench) -> None:
    bench.rehearsal.drives[2].silent = True


def loses_all_torque(bench: Bench) -> None:
    for drive in bench.rehearsal.drives:
        drive.state = DriveState.SWITCH_ON_DISABLED


def starts_again(bench: Bench) -> None:
    bench.rehearsal.drives[4].power_on()


def fails(bench: Bench) -> None:
    bench.rehearsal.drives[6].fail(0x2310)


def test_a_drive_that_loses_every_other_reply_ends_the_motion() -> None:
    with after_power_loss(lost(1, on_a_stand=True)) as bench:
        take, cycles = bench.group._watch.take, bench.records  # type: ignore[attr-defined]

        def takes(can_id: int, *args: Any, **more: Any) -> None:
            if can_id != TPDO1_BASE + 3 or len(cycles) < 80 or len(cycles) % 2:
                take(can_id, *args, **more)

        bench.group._watch.take = takes  # type: ignore[attr-defined]
        result = bench.take_up()
        assert result.state is State.LATCHED
        said = "cable 3 (drive 3) did not answer in 10 of the last 50 cycles; stopped together"
        assert result.cause == said
        assert bench.states == {DriveState.QUICK_STOP_ACTIVE}


@pytest.mark.parametrize("happens", [falls_silent, loses_all_torque, starts_again, fails])
def test_every_fault_stops_all_drives_together(happens: Callable[[Bench], None]) -> None:
    with after_power_loss(lost(1, on_a_stand=True)) as bench:
        bench.script = lambda bench, cycle: happens(bench) if cycle == 80 else None
        result = bench.take_up()
        assert result.state is State.LATCHED
        assert result.cause
        assert DriveState.OPERATION_ENABLED not in bench.states
        after = np.array([r.targets for r in bench.records if r.cycle > 83])
        assert len(np.unique(after, axis=0)) == 1, "nothing is sent on after the fault"


def test_a_bus_that_dies_at_once_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    with after_power_loss(lost(1, on_a_stand=True)) as bench:

        def broken(*_: object) -> None:
            raise BusDown("the interface is down", "can0")

        there = SimpleNamespace(
            positions=np.array(bench.counts),
            holding=False,
            state=GroupState.CONFIGURED,
            status_words=np.zeros(8, dtype=np.int64),
        )
        monkeypatch.setattr(bench.group, "read_positions", lambda _pace: there)
        monkeypatch.setattr(bench.group, "send_cycle", broken)
        result = bench.take_up()
        assert result.state is State.LATCHED
        assert "interface is down" in result.cause
        assert np.isnan(result.counts).all()


def test_a_cable_that_stays_slack_after_its_reach_stops_all() -> None:
    slack = np.zeros(8)
    slack[4] = 0.02
    with after_power_loss(PowerLoss(np.zeros(8), slack, on_a_stand=True)) as bench:
        result = bench.take_up(reach=0.004)
        assert result.state is State.LATCHED
        assert "cable 5 carries" in result.cause
        assert "off its drum" in result.cause
        assert np.abs(np.sum(bench.steps(), axis=0)).max() <= 0.004 + 1e-5
        found = next(e.cycle for e in bench.events if e.code == "not_taut")
        assert len({r.targets for r in bench.records if r.cycle >= found - 1}) == 1, "none goes on"
        assert bench.states == {HOLDING}


def test_a_reach_beyond_the_position_limits_is_refused_before_anything_moves() -> None:
    """At a corner of the workspace a cable may be 49 mm shorter than there; 607Dh ends there."""
    rig = load_rig(RIG)
    corner = Pose.level(rig.workspace_lower)
    asked: list[object] = []

    def confirm(_proposal: object) -> bool:
        asked.append(_proposal)
        return True

    with pytest.raises(Refused, match=r"cable 7.* beyond its position limits") as refused:
        home(rig, pose=corner, tension=20.0, reach=0.050, realtime=False, confirm=confirm)
    assert "nothing was enabled" in refused.value.next_step
    assert asked


def test_winding_in_that_would_take_hours_is_refused() -> None:
    document = load_rig(RIG).document
    stiff = document.cables.model_copy(update={"stiffness_n": 9e8})
    rig = rig_from_document(document.model_copy(update={"cables": stiff}))
    with pytest.raises(Refused, match="hours") as refused:
        home(rig, at_home=True, realtime=False)
    assert "not E in Pa" in refused.value.next_step


def test_one_cable_alone_moves_freely_only_while_it_hangs_slack() -> None:
    with after_power_loss(lost(3, 6.0, on_a_stand=True)) as bench:
        law = CableStep(
            bench.as_set_up, bench.counts, cable=2, length=-0.001, limit=LIMIT, speed=0.005
        )
        result = bench.move(law)
        assert result.state is State.FINISHED
        moved = (result.counts - bench.counts) / [w.counts_per_metre for w in bench.rig.winches]
        assert moved == pytest.approx([0, 0, -0.001, 0, 0, 0, 0, 0], abs=3e-6)
        assert bench.steps().max() <= 0.005 * 0.01 + 2e-6


@pytest.mark.parametrize(("length", "cause"), [(-0.005, "more than"), (0.005, "went slack")])
def test_on_a_taut_platform_one_cable_alone_is_stopped(length: float, cause: str) -> None:
    with after_power_loss(None) as bench:
        law = CableStep(
            bench.as_set_up, bench.counts, cable=2, length=length, limit=LIMIT, speed=0.005
        )
        result = bench.move(law)
        assert result.state is State.LATCHED
        assert cause in result.cause
        assert bench.states == {HOLDING}
        assert np.max(bench.tensions) < 1.02 * LIMIT
        stopped = next(r.cycle for r in bench.records if r.state is State.SECURING)
        assert stopped <= next(e.cycle for e in bench.events if e.code in FINDINGS) + 1
        after = [r.targets for r in bench.records if r.cycle >= stopped - 1]
        assert len(set(after)) == 1, "it stops where it is"


def test_drives_that_hold_more_get_no_limit_that_lets_it_slip() -> None:
    with after_power_loss(lost(1, on_a_stand=True)) as bench:
        assert bench.take_up().state is State.FINISHED
        bus = bench.group._bus  # type: ignore[attr-defined]
        held = read_drives(bench.rig, bus, bench.rehearsal.pump)
        carried = bench.rehearsal.tensions
        require_below(bench.rig, held, float(carried.max()) + 1.0)
        worst = int(carried.argmax()) + 1
        with pytest.raises(Refused, match=rf"cable {worst} \(drive {worst}\) carries"):
            require_below(bench.rig, held, float(carried.max()) - 0.5)
        stood = [drive.motor.position for drive in bench.rehearsal.drives]
        # What would happen otherwise: so it is refused before anything is written.
        bench.group.close()
        weak = make_drive_group(
            bench.as_set_up, bus, bench.rehearsal.pump, max_tension=0.5 * float(carried.min())
        )
        weak.configure()
        for _ in range(50):
            weak.send_cycle([0] * 8)
            weak.receive(0.0)
        slipped = [d.motor.position for d in bench.rehearsal.drives] - np.array(stood)
        paid_out = slipped / [w.counts_per_metre for w in bench.rig.winches]
        assert paid_out.max() > 1e-5
        assert bench.rehearsal.tensions.max() < carried.max()
        weak.close()


def test_winches_without_a_platform_move_below_what_would_balance_it() -> None:
    """40 N hold no platform of this rig; light weights on the cables ask for no more."""
    rig = load_rig(HALL)
    loose = PowerLoss(np.zeros(rig.cable_count), np.full(rig.cable_count, 0.02), on_a_stand=True)
    with after_power_loss(loose, rig, limit=40.0, speed=0.005) as bench:
        law = CableStep(
            bench.as_set_up, bench.counts, cable=0, length=0.002, limit=40.0, speed=0.005
        )
        result = bench.move(law)
        assert result.state is State.FINISHED, result.cause
        assert {d.objects[0x6072, 0] for d in bench.rehearsal.drives} == {
            int(np.ceil(1000.0 * 1.2 * 40.0 / w.torque_constant)) for w in rig.winches
        }


@pytest.mark.parametrize("speed", [0.0001, 0.0002])
def test_the_slowest_motion_is_not_a_jump_of_a_coarse_encoder(speed: float) -> None:
    rig = load_rig(HALL)
    loose = PowerLoss(np.zeros(rig.cable_count), np.full(rig.cable_count, 0.02), on_a_stand=True)
    with after_power_loss(loose, rig, limit=400.0, speed=speed) as bench:
        law = CableStep(
            bench.as_set_up, bench.counts, cable=0, length=-0.00005, limit=400.0, speed=speed
        )
        result = bench.move(law)
        assert result.state is State.FINISHED, result.cause


def test_no_winch_is_faster_than_its_rig_file_says() -> None:
    rig = load_rig(RIG)
    begin = [0] * rig.cable_count
    fastest = np.array([winch.max_speed for winch in rig.winches])
    assert (wind_in_speed(rig, TARGET, LIMIT, 10.0) <= fastest).all()
    law = CableStep(rig, begin, cable=1, length=0.05, limit=LIMIT, speed=10.0)
    sent, per_metre = [begin], rig.winches[1].counts_per_metre
    while not law.done:
        sent.append(list(law.next(1.0, [0.0] * rig.cable_count)[0]))
    assert np.abs(np.diff(np.array(sent)[:, 1])).max() / per_metre <= fastest[1] * 0.01 + 2e-6


def test_an_end_that_cannot_be_kept_is_a_fault_that_is_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def full(*_args: object, **_more: object) -> None:
        raise Refused("the latch cannot be written", where="latched.json", why="disk full")

    with after_power_loss(lost(1, on_a_stand=True)) as bench:
        monkeypatch.setattr(MotionInterlock, "end", full)
        result = bench.take_up()
        assert result.state is State.LATCHED
        assert "disk full" in result.cause
        assert np.isfinite(result.counts).all()
        assert (bench.events[-1].code, bench.states) == ("recorder", {HOLDING})


def moved_by_hand(bench: Bench) -> None:
    bench.rehearsal.drives[3].motor.position += 0.0002 * bench.rig.winches[3].counts_per_metre
    bench.rehearsal.drives[3].motor.demand = bench.rehearsal.drives[3].motor.position


@pytest.mark.parametrize(
    ("happens", "expected"),
    [
        (lambda _bench: None, None),
        (moved_by_hand, r"cable 4 \(drive 4\) moved by 0.20 mm"),
        (loses_all_torque, "lost its torque: switch on disabled"),
        (fails, "drive 7"),
    ],
)
def test_what_happens_while_the_camera_measures_is_noticed(
    happens: Callable[[Bench], None], expected: str | None
) -> None:
    with after_power_loss(lost(1, on_a_stand=True)) as bench:
        result = bench.take_up()
        assert result.state is State.FINISHED
        happens(bench)
        if expected is None:
            require_held(bench.rig, result, bench.group.read_positions())
            return
        with pytest.raises(Fault, match=expected):
            require_held(bench.rig, result, bench.group.read_positions())


def no_more_heard(bench: Bench) -> None:
    bench.rehearsal.drives[5].silent = True


@pytest.mark.parametrize("rehome", [True, False])
@pytest.mark.parametrize(
    ("happens", "expected", "counts"),
    [
        (moved_by_hand, "moved by 0.20 mm", True),
        (loses_all_torque, "lost its torque: switch on disabled", False),
        (no_more_heard, "no answer after", False),
    ],
)
def test_what_is_found_wrong_after_the_motion_is_latched_and_reported(
    rehome: bool, happens: Callable[[Bench], None], expected: str, counts: bool
) -> None:
    """The previous reference stays valid only if every cable was held; no new one is made."""
    rig = load_rig(RIG)
    bus = rig.document.bus.model_copy(update={"interface": "socketcan", "channel": "can7"})
    kept = rig_from_document(rig.document.model_copy(update={"bus": bus}))
    interlock = MotionInterlock(kept)
    with after_power_loss(lost(1, on_a_stand=True)) as bench:
        tensions = np.full(rig.cable_count, TARGET)
        begin = np.array(bench.counts)
        interlock.take(reference_at(kept, kept.home, begin, tensions, "stated pose", 0.0))

        def at_rest(result: WinchResult) -> HomingReference:
            happens(bench)
            return reference_at(kept, kept.home, result.counts, tensions, "new", 0.0)

        bench.interlock, bench.at_rest, bench.rehome = interlock, at_rest, rehome
        with pytest.raises(CdprError, match=expected):
            bench.take_up()
        assert bench.events[-1].code == "not_held"
        assert expected in bench.events[-1].text
        moved = [drive.motor.position for drive in bench.rehearsal.drives]
    with pytest.raises(Refused, match=expected):
        interlock.require_free()
    reference = interlock.kept_reference()
    assert reference is not None
    assert reference.how == "stated pose"
    assert bool(reference.lost) is (rehome or not counts)
    if not reference.lost:
        assert reference.stands_at == pytest.approx(moved, abs=1.0)
        assert reference.stands_at != list(begin)


def test_a_record_that_is_full_by_then_leaves_the_cause_and_the_latch() -> None:
    """An event that cannot be recorded replaces neither the result nor the error."""
    full = Fault("events.jsonl cannot be written: No space left on device")

    class Full(list[LoopEvent]):
        def append(self, event: LoopEvent) -> None:
            super().append(event)
            if event.code == "not_held":
                raise full

    rig = load_rig(RIG)
    bus = rig.document.bus.model_copy(update={"interface": "socketcan", "channel": "can8"})
    interlock = MotionInterlock(rig_from_document(rig.document.model_copy(update={"bus": bus})))
    with after_power_loss(lost(1, on_a_stand=True)) as bench:

        def at_rest(_result: WinchResult) -> None:
            loses_all_torque(bench)

        bench.interlock, bench.at_rest, bench.events = interlock, at_rest, Full()
        with pytest.raises(CdprError, match="lost its torque: switch on disabled"):
            bench.take_up()
        assert bench.events[-1].code == "not_held"
    with pytest.raises(Refused, match="lost its torque: switch on disabled"):
        interlock.require_free()


@pytest.mark.parametrize("program_ends", [False, True])
def test_the_record_that_the_latch_names_stays_where_no_cycle_began(
    tmp_path: Path, program_ends: bool
) -> None:
    """The bus fails, or the program is terminated, between arming and the first cycle."""
    rig = load_rig(RIG)
    bus = rig.document.bus.model_copy(update={"interface": "socketcan", "channel": "can9"})
    kept_rig = rig_from_document(rig.document.model_copy(update={"bus": bus}))

    class Latching(MotionInterlock):
        def begin(self, *arguments: Any, **options: Any) -> None:
            super().begin(*arguments, **options)
            if program_ends:
                raise KeyboardInterrupt
            bench.group.send_cycle = fails_on_the_bus

    def fails_on_the_bus(*_: object) -> None:
        raise BusDown("the interface is down", "can9")

    expected = pytest.raises(KeyboardInterrupt) if program_ends else nullcontext()
    with after_power_loss(lost(1, on_a_stand=True)) as bench, expected:
        with recording(tmp_path / "home") as record:
            bench.interlock, bench.folder = Latching(kept_rig), record.folder
            bench.take_event = record.take_event
            assert bench.take_up().state is State.LATCHED
        assert not bench.records
        assert "the interface is down" in RunFolder(record.folder).events()[0].text
    latched = FaultLatch(BusSettings("socketcan", "can9")).read()
    assert latched is not None
    assert Path(latched.folder).is_dir()


def test_a_stop_before_anything_is_enabled_leaves_all_as_it_was() -> None:
    with after_power_loss(lost(1, on_a_stand=True)) as bench:
        bench.board.ask_stop()
        with pytest.raises(StoppedByOperator, match="before anything moved"):
            bench.take_up()
        assert bench.states.isdisjoint({DriveState.OPERATION_ENABLED, HOLDING})
        assert not bench.records


def test_a_pose_that_is_not_known_well_is_refused() -> None:
    rig = load_rig(RIG)
    home = rig.home
    away = Pose.level(home.position + np.array([0.004, 0.0, 0.0]))
    with pytest.raises(Refused, match="is not at rest"):
        static_pose(rig, looks(rig, home, away, home, away))
    far = Pose.level(home.position + np.array([5.0, 5.0, 0.0]))
    with pytest.raises(Refused, match="0 of 2 images"):
        static_pose(rig, looks(rig, far, far))


THE_RIG = load_rig(RIG)


def seen_at(steps: Array, deviation: float = 1e-5) -> list[PoseMeasurement]:
    """Measurements beside the home pose, [m] and [rad], shape (n, 6), without shared errors."""
    covariance = np.diag([deviation**2] * 6)
    return [
        PoseMeasurement(k / 10.0, moved(THE_RIG.home, step), covariance, (1, 2), 0.1, "found")
        for k, step in enumerate(steps)
    ]


def lengths_of(seen: Sequence[PoseMeasurement]) -> Array:
    return np.array([cable_lengths(THE_RIG, one.pose) for one in seen])


DIRECTIONS = st.tuples(*[st.floats(-1.0, 1.0)] * 6).filter(lambda d: max(map(abs, d)) > 0.3)
#: Of a step of 1 in these directions: 1 mm, and 1° about each axis.
UNITS = np.array([1e-3] * 3 + [np.radians(1.0)] * 3)


@given(direction=DIRECTIONS, size=st.floats(0.01, 3.0), pace=st.floats(0.02, 3.1))
@example(direction=(0.0, 0.0, 0.0, 1.0, 0.0, 0.0), size=3.0, pace=1.1)
@example(direction=(0.0, 0.0, 0.0, 0.0, 0.0, 1.0), size=1.0, pace=1.1)
@example(direction=(0.0, 0.0, 0.0, 1.0, 0.0, 0.0), size=0.5, pace=1.1)
def test_a_platform_that_swings_is_not_at_rest(
    direction: tuple[float, ...], size: float, pace: float
) -> None:
    """Also about its own centre, where no position changes."""
    swing = np.outer(np.sin(pace * np.arange(20)), size * UNITS * direction)
    seen = seen_at(swing)
    lengths = lengths_of(seen)
    half = THE_RIG.motion.start_tolerance / 2.0
    drift = np.abs(np.polyfit(np.linspace(0.0, 1.0, 20), lengths, 1)[0]).max()
    if max(2.0 * lengths.std(axis=0).max(), drift) > half:
        with pytest.raises(Refused, match="not at rest"):
            static_pose(THE_RIG, seen)
        return
    found = static_pose(THE_RIG, seen)
    assert np.abs(lengths - cable_lengths(THE_RIG, found.pose)).max() < 1.1 * half
    assert found.uncertainty >= swing[:, :3].std(axis=0).max()
    assert found.uncertainty > 0.98 * lengths.std(axis=0).max()


@given(direction=DIRECTIONS, change=st.floats(0.1, 3.0))
def test_a_platform_that_still_moves_is_not_at_rest(
    direction: tuple[float, ...], change: float
) -> None:
    """A steady motion that changes a cable's length by more than half the start tolerance."""
    toward = UNITS * direction
    effect = np.ptp(lengths_of(seen_at(np.outer([-0.5, 0.5], toward))), axis=0).max()
    drift = change * THE_RIG.motion.start_tolerance / 2.0
    seen = seen_at(np.outer(np.linspace(-0.5, 0.5, 20) * drift / effect, toward))
    if change > 1.01:
        with pytest.raises(Refused, match=r"not at rest: the length of cable \d"):
            static_pose(THE_RIG, seen)
    elif change < 0.99:
        static_pose(THE_RIG, seen)


@pytest.mark.parametrize("count", [5, 20])
def test_images_that_scatter_as_they_state_are_of_a_platform_at_rest(count: int) -> None:
    """Scatter of 0.08 mm per axis, with rotations to match; the error is as stated."""
    rng, worst = np.random.default_rng(3), []
    deviation = 0.08e-3
    for _ in range(50):
        steps = rng.normal(size=(count, 6)) * deviation
        found = static_pose(THE_RIG, seen_at(steps, deviation))
        worst.append(found.pose.distance_to(THE_RIG.home) / found.uncertainty)
    assert max(worst) < 3.0


def wound_in(rig: Rig, targets: Array, *, on_a_stand: bool) -> WinchResult:
    """The end of winding in all cables of a robot that lost its power."""
    loss = PowerLoss.drawn(rig, 1, 0.005, on_a_stand=on_a_stand)
    settings = BusSettings("virtual", f"home-{next(_CHANNELS)}")
    with open_bus(settings) as near, open_bus(settings) as far:
        rehearsal = SimulatedCia402Rig(rig, far, rig.home)
        loss.apply_to(rig, rehearsal.plant, [drive.motor for drive in rehearsal.drives])
        group = make_drive_group(rig, near, rehearsal.pump)
        group.configure()
        counts: Sequence[int] = group.read_positions().positions.tolist()
        counted = with_counts_at(rig, counts, rig.home)
        limited = with_reduced_limits(counted, limit=400.0, speed=0.005)
        group = make_drive_group(counted, near, rehearsal.pump, max_tension=400.0)
        group.configure()
        law = PretensionLaw(limited, counts, targets=targets, limit=400.0, reach=0.05, speed=0.002)
        result = move_winches(
            mover(counted, limited, law, group, LocalRequests()), rig, MotionInterlock(rig),
            Records(lambda _record: None, lambda _event: None),
            record=Path("nowhere"), rehome=True, at_rest=lambda _result, _true_pose: None,
        )  # fmt: skip
        assert result.state is State.FINISHED, result.cause
        return result


def test_the_hall_robot_is_taken_up_too() -> None:
    rig = load_rig(HALL)
    result = wound_in(rig, np.full(rig.cable_count, 60.0), on_a_stand=False)
    assert min(result.tensions) >= 0.7 * 60.0


def test_after_homing_on_a_jig_under_the_planned_tensions_a_motion_may_begin() -> None:
    """Long, soft cables stretch by far more than the start tolerance between two tensions."""
    rig = soft(load_rig(HALL))
    planned = working_tensions(rig, rig.home).tensions
    result = wound_in(rig, planned, on_a_stand=True)
    made = reference_at(rig, rig.home, result.counts, result.tensions, "stated pose", 0.0)
    found = current_pose(referenced(rig, made), result.counts, empty_scene(rig).load)
    assert found.distance_to(rig.home) <= 1e-3
    result = wound_in(rig, np.full(rig.cable_count, 60.0), on_a_stand=True)
    made = reference_at(rig, rig.home, result.counts, result.tensions, "stated pose", 0.0)
    with pytest.raises(Refused, match="fit no pose") as caught:
        current_pose(referenced(rig, made), result.counts, empty_scene(rig).load)
    assert "pretension" in caught.value.next_step


def soft(rig: Rig) -> Rig:
    """A rig whose cables stretch more: 30 kN."""
    cables = rig.document.cables.model_copy(update={"stiffness_n": 30000.0})
    return rig_from_document(rig.document.model_copy(update={"cables": cables}))


def stops(stage: Stage) -> None:
    stage.board.ask_stop()


def emergency_stop(stage: Stage) -> None:
    """The torque of all drives is gone, as when their supply is cut."""
    for drive in stage.drives:
        drive.state = DriveState.SWITCH_ON_DISABLED


def one_fails(stage: Stage) -> None:
    stage.drives[3].fail(0x2310)


def hangs(stage: Stage) -> None:
    stage.lateness = 5.0


@pytest.mark.parametrize(
    ("happens", "holding"),
    [(stops, True), (hangs, True), (emergency_stop, False), (one_fails, False)],
)
def test_a_run_tells_whether_a_cable_was_released(
    prepared: PreparedRun, tmp_path: Path, happens: Callable[[Stage], None], holding: bool
) -> None:
    """It decides whether the reference stays valid: see `executor.interlock.interlock`."""
    with staged(prepared, tmp_path / "run", at(120, happens)) as stage:
        outcome = stage.run()
    assert outcome.state is (State.STOPPED if happens is stops else State.LATCHED)
    assert outcome.holding is holding
