"""Jogging by hold-to-run in simulated time: it moves only while held, and only where it may."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from executor import winch_runs
from executor.hold_to_run import session as sessions
from executor.hold_to_run.line import FIRST_ROWS, MOST_ROWS, JogLine, JogProver, Piece, PieceRing
from executor.hold_to_run.presses import TIMEOUT, PlatformMove, PressBoard
from executor.hold_to_run.session import jog_session
from executor.jogging import with_speed
from executor.realtime.scheduling import SimulatedClock
from executor.realtime.shared_memory import SharedMemory
from executor.remote.protocol import STEPS_MM
from executor.state_machine import CycleRecord, State
from model.clearance import ClearanceModel
from model.errors import CdprError, Fault, StoppedByOperator
from model.kinematics import cable_lengths, forward_kinematics
from model.pose import Array, Pose
from model.progress import Listener
from model.rig import Rig, load_rig
from model.scene import Scene, load_scene
from model.statics.gravity import working_tensions
from model.winches import WinchMap
from tests.cli.plans import RIG
from tests.effort import cases

STEPS = tuple(step / 1000.0 for step in STEPS_MM)
AXES = [sign * axis for axis in np.eye(3) for sign in (1.0, -1.0)]


@cache
def rig() -> Rig:
    return load_rig(RIG)


@cache
def scene() -> Scene:
    return load_scene(RIG.parent / "environment_1.yaml")


@dataclass
class Script:
    """Holds controls in simulated time, and keeps the records of the loop."""

    holds: list[tuple[float, float, Callable[[PressBoard], object]]]
    end: float
    records: list[CycleRecord] = field(default_factory=list)

    def __call__(self, record: CycleRecord, board: PressBoard, _: JogProver) -> None:
        self.records.append(record)
        for begin, until, say in self.holds:
            if begin <= record.at < until:
                say(board)
        if record.at >= self.end:
            board.end()

    def run(self, around: Scene | None = None, speed: float = 0.020) -> list[CycleRecord]:
        jog_session(rig(), around, speed=speed, realtime=False, on_cycle=self)
        return self.records


def hold(
    number: int, direction: Array, step: float | None = None, percent: int = 100
) -> Callable[[PressBoard], object]:
    move = PlatformMove(direction, in_platform=False)
    return lambda board: board.hold(number, move, step=step, percent=percent)


def positions(records: list[CycleRecord]) -> Array:
    """Commanded positions, by an independent forward kinematics, shape (n, 3), [m]."""
    winches, pose, found = WinchMap(rig()), rig().home, []
    last: tuple[int, ...] = ()
    for record in records:
        if record.targets != last:
            last = record.targets
            stretched = winches.strained(
                winches.unstrained_from_counts(np.array(last, dtype=np.float64)),
                rig().tensions_by(record.torques),
            )
            pose = forward_kinematics(rig(), stretched, pose).pose
        found.append(pose.position)
    return np.array(found)


def moved(records: list[CycleRecord]) -> list[bool]:
    """Whether the targets of each cycle differ from those before it."""
    targets = [record.targets for record in records]
    return [False, *(a != b for a, b in pairwise(targets))]


def test_it_goes_straight_while_held_and_stops_when_released() -> None:
    x = np.array([1.0, 0.0, 0.0])
    records = Script([(0.5, 1.5, hold(1, x))], 3.0).run(scene())
    path = positions(records) - rig().home.position
    at = np.array([record.at for record in records])
    assert path[-1, 0] == pytest.approx(0.02, abs=0.005), "about a second at 20 mm/s"
    assert np.abs(path[:, 1:]).max() < 2e-4
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    cycle = rig().document.bus.cycle_ms / 1000.0
    assert steps.max() <= 0.020 * cycle * 1.2
    still = np.array(moved(records))
    assert not still[at < 0.5].any()
    assert not still[at > 1.5 + TIMEOUT + 0.5].any(), "at rest after the time-out and the ramp"
    assert still[(at > 0.6) & (at < 1.5)].mean() > 0.95
    assert records[-1].state is State.SECURING


def test_simulated_drives_begin_at_a_stated_pose() -> None:
    start = Pose(rig().home.position + np.array([0.02, -0.03, 0.01]), rig().home.rotation)
    script = Script([], 0.3)
    jog_session(rig(), scene(), start=start, realtime=False, on_cycle=script)
    assert positions(script.records)[-1] == pytest.approx(start.position, abs=1e-4)


@pytest.mark.parametrize("length", STEPS)
def test_a_step_ends_where_it_should(length: float) -> None:
    z = np.array([0.0, 0.0, 1.0])
    records = Script([(0.5, 3.0, hold(1, z, step=length))], 3.5).run(scene())
    path = positions(records)[-1] - positions(records[:5])[-1]
    assert path[2] == pytest.approx(length, abs=3e-5)
    assert np.abs(path[:2]).max() < 5e-5
    last = [record for record in records if record.state is State.MOVING][-1]
    assert last.rate == 0.0, "at rest, not at the speed of its last row"


@pytest.mark.parametrize("percent", [5, 25])
def test_a_step_keeps_to_the_selected_speed(percent: int) -> None:
    z = np.array([0.0, 0.0, 1.0])
    script = Script([(0.5, 3.5, hold(1, z, step=0.001, percent=percent))], 4.0)
    path = positions(script.run(scene()))
    cycle, fastest = rig().document.bus.cycle_ms / 1000.0, 0.020 * percent / 100.0
    over = 10  # cycles, so that whole counts do not matter
    speeds = np.linalg.norm(path[over:] - path[:-over], axis=1) / (over * cycle)
    assert 0.9 * fastest < speeds.max() <= 1.1 * fastest + 1e-4
    assert path[-1, 2] - path[0, 2] == pytest.approx(0.001, abs=3e-5)


def test_a_step_that_is_released_ends_early() -> None:
    z = np.array([0.0, 0.0, 1.0])
    records = Script([(0.5, 0.7, hold(1, z, step=0.010))], 3.0).run(scene())
    path = positions(records)[-1, 2] - rig().home.position[2]
    assert 0.0005 < path < 0.008


def test_the_speed_follows_the_share_that_is_held() -> None:
    x = np.array([1.0, 0.0, 0.0])
    slow = Script([(0.5, 1.5, hold(1, x, percent=25))], 3.0).run(scene())
    assert positions(slow)[-1, 0] == pytest.approx(0.005, abs=0.0015)


def test_it_comes_to_rest_before_an_obstacle_as_near_as_it_may() -> None:
    """Towards the nearest obstacle, to the end of the checked line; the limit is the scene's."""
    model, home = ClearanceModel(rig(), scene()), rig().home
    near = model.smallest(home)
    assert near is not None
    towards = near.second_point - near.first_point
    towards /= np.linalg.norm(towards)
    records = Script([(0.5, 12.0, hold(1, towards))], 13.0).run(scene(), speed=0.010)
    end = positions(records)[-1]
    last = model.smallest(Pose(end, home.rotation))
    assert last is not None
    assert last.distance >= scene().obstacle_clearance - 1e-4
    assert last.distance <= scene().obstacle_clearance + 0.004, "it is not stopped far before it"
    assert not any(moved(records)[-60:])
    rates = [record.rate for record in records if record.state is State.MOVING]
    assert max(b - a for a, b in pairwise(rates)) < 0.5


@settings(max_examples=cases(30), deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(0, 5), st.integers(0, 4), st.integers(1, 12), st.booleans()),
        min_size=1,
        max_size=4,
    )
)
def test_nothing_moves_unless_it_is_held(presses: list[tuple[int, int, int, bool]]) -> None:
    """Random presses, steps, lengths and silences: a motion needs a hold that is 150 ms old."""
    holds, begin = [], 0.5
    spans = []
    for number, (axis, step, length, silent) in enumerate(presses, start=1):
        until = begin + 0.05 * length
        path = None if step > 2 else STEPS[step]
        say = hold(number, AXES[axis], step=path)
        holds.append((begin, until, say))
        if silent:  # reported again after too long a silence: it must stay over
            holds.append((until + 0.25, until + 0.5, say))
            spans.append((begin, until))
            begin = until + 0.6
        else:
            holds.append((until, until + 0.015, lambda board, n=number: board.let_go(n)))
            spans.append((begin, until))
            begin = until + 0.1
    records = Script(holds, begin + 1.0).run(scene())
    # Released at full acceleration: that is taken back first, then the speed is, each by the jerk.
    motion = rig().motion
    ramp = 0.020 / motion.acceleration + 2.0 * motion.acceleration / motion.jerk
    for record, moves in zip(records, moved(records), strict=True):
        if moves and record.state is State.MOVING:
            assert any(a <= record.at <= b + TIMEOUT + ramp for a, b in spans)
    assert not any(moved(records)[-20:])


class Notes(Listener):
    """Keeps the events that are reported to a user."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    def note(self, text: str) -> None:
        self.texts.append(text)

    warning = remark = note


#: A press: its axis, its step, how long it is held and how long the page pauses then, both in
#: cycles of 10 ms, and how it ends: let go, silent, or replaced by the next one.
PRESSES = st.tuples(
    st.integers(0, 5),
    st.sampled_from([None, None, None, 0.0001, 0.001]),
    st.sampled_from([1, 1, 2, 3, 4, 6, 25, 80]),
    st.sampled_from([1, 2, 3, 5, 15, 40, 60]),
    st.sampled_from(["let_go", "silent", "replaced"]),
)


@settings(max_examples=cases(25), deadline=None)
@given(st.lists(PRESSES, min_size=1, max_size=7))
@example([(4, None, 80, 60, "let_go"), (4, None, 1, 60, "let_go"), (1, None, 80, 60, "let_go")])
@example([(4, None, 80, 2, "silent"), (5, None, 2, 60, "silent"), (4, None, 80, 60, "silent")])
@example([(4, 0.001, 80, 60, "replaced"), (0, None, 1, 1, "replaced"), (4, None, 2, 1, "let_go")])
def test_the_commanded_pose_is_the_drives_whatever_was_pressed(
    presses: list[tuple[int, float | None, int, int, str]],
) -> None:
    """Clicks shorter than the first check, frozen pages, presses replaced; each line begins there.

    A press that is over before its first piece arrives must not move the pose that the next line
    begins at: it would be refused, and all after it.
    """
    cycle = rig().cycle
    holds, begin = [], 0.5
    for number, (axis, step, held, pause, end) in enumerate(presses, start=1):
        until = begin + cycle * held
        holds.append((begin, until, hold(number, AXES[axis], step=step)))
        if end == "let_go":
            holds.append((until, until + cycle, lambda board, n=number: board.let_go(n)))
        begin = until + (0.0 if end == "replaced" else cycle * pause)
    last = begin + 1.0  # at rest
    z = np.array([0.0, 0.0, 1.0])
    holds.append((last, last + 0.5, hold(len(presses) + 1, z)))
    script, poses, notes = Script(holds, last + 1.5), [], Notes()

    def on_cycle(record: CycleRecord, board: PressBoard, prover: JogProver) -> None:
        poses.append(prover.pose)
        script(record, board, prover)

    jog_session(rig(), scene(), realtime=False, on_cycle=on_cycle, listener=notes)
    assert not [text for text in notes.texts if "does not begin" in text]
    winches = WinchMap(rig())
    for record, pose in zip(script.records, poses, strict=True):
        if record.state is State.MOVING:
            commanded = winches.counts(
                winches.unstrained(
                    cable_lengths(rig(), pose), working_tensions(rig(), pose, scene().load).tensions
                )
            )
            assert np.abs(commanded - record.targets).max() <= 3, "rounded, between two rows"
    at = np.array([record.at for record in script.records])
    assert np.array(moved(script.records))[at > last].any(), "the next press begins"


def test_a_stop_ends_the_session_along_the_line() -> None:
    x = np.array([1.0, 0.0, 0.0])
    script = Script([(0.5, 3.0, hold(1, x))], 9.0)

    class Stops(sessions.Supervisor):
        def during(self, board, motion):  # type: ignore[no-untyped-def]
            self.board = board
            return motion()

    stops = Stops()

    def on_cycle(record: CycleRecord, board: PressBoard, prover: JogProver) -> None:
        script(record, board, prover)
        if record.at > 1.2:
            stops.board.ask_stop()

    with pytest.raises(StoppedByOperator):
        jog_session(rig(), scene(), realtime=False, on_cycle=on_cycle, supervisor=stops)
    rates = [record.rate for record in script.records]
    steps = np.abs(np.diff(rates))
    assert script.records[-1].at < 2.5
    assert steps.max() < 0.5, "it slows down smoothly"


def test_rows_that_changed_in_transit_are_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    put = PieceRing.put

    def bend(ring: PieceRing, piece: Piece) -> None:
        rows = piece.rows.copy()
        rows[-1] += 1
        put(ring, replace(piece, rows=rows))

    monkeypatch.setattr(PieceRing, "put", bend)
    x = np.array([1.0, 0.0, 0.0])
    with pytest.raises(Fault, match="differ from those that were checked"):
        Script([(0.5, 1.5, hold(1, x))], 3.0).run(scene())


def test_a_session_ends_on_its_own_when_nothing_is_held(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sessions, "IDLE", 0.8)
    records = Script([], 99.0).run(scene())
    assert 0.8 < records[-1].at < 2.0


def test_the_set_up_of_the_drives_is_no_time_without_a_held_control(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Many drives with slow SDO answers take minutes: the session ended with its first cycle."""
    make_mover = winch_runs.MotionHere

    def after_a_minute(task: Any, drives: Any, clock: SimulatedClock, *others: Any) -> Any:
        for _ in range(round(60.0 / rig().cycle)):
            clock.next_cycle()
        return make_mover(task, drives, clock, *others)

    monkeypatch.setattr(winch_runs, "MotionHere", after_a_minute)
    monkeypatch.setattr(sessions, "IDLE", 5.0)
    records = Script([], 99.0).run(scene())
    assert 60.0 < records[0].at < 62.0
    assert 5.0 < records[-1].at - records[0].at < 7.0


def test_a_line_is_checked_as_a_whole_would_be() -> None:
    """Its pieces, end to end, are the set-points of the line, without gaps or repeats."""
    slow = with_speed(rig(), 0.020)
    line = JogLine(slow, scene(), rig().home, np.array([0.0, 1.0, 0.0]))
    parts = [line.extend(FIRST_ROWS), line.extend(MOST_ROWS), line.extend(3)]
    rows = np.concatenate([parts[0].table.setpoints, *(p.table.setpoints[1:] for p in parts[1:])])
    assert len(rows) == line.rows == FIRST_ROWS + MOST_ROWS + 3 + 1
    for before, after in pairwise(parts):
        assert np.abs(before.table.setpoints[-1] - after.table.setpoints[0]).max() <= 1
    spacing = 0.020 * slow.document.bus.cycle_ms / 1000.0
    end = line.pose(line.rows - 1).position - rig().home.position
    assert end[1] == pytest.approx(spacing * (line.rows - 1), abs=1e-9)
    assert np.abs(np.diff(rows.astype(np.int64), n=2, axis=0)).max() <= 4, "at constant speed"


def test_what_cannot_be_checked_is_not_added() -> None:
    slow = with_speed(rig(), 0.020)
    line = JogLine(slow, scene(), rig().home, np.array([0.0, 0.0, -1.0]))
    line.extend(FIRST_ROWS)
    with pytest.raises(CdprError):
        line.extend(6000)
    assert line.rows == FIRST_ROWS + 1


@given(st.integers(1, 2**40), st.integers(0, 2**31), st.booleans(), st.integers(1, 40))
def test_pieces_arrive_as_they_were_sent(press: int, first: int, whole: bool, count: int) -> None:
    memory = SharedMemory.create(PieceRing.size(8))
    sender, receiver = PieceRing(memory, 8), PieceRing(memory, 8)
    rows = np.arange(8 * count, dtype=np.int32).reshape(count, 8)
    sender.put(Piece(press, first, whole, 0.25, rows, "sha256:" + "a" * 64))
    (got,) = receiver.take()
    assert (got.press, got.first, got.from_rest, got.peak, got.hash) == (
        press,
        first,
        whole,
        0.25,
        "sha256:" + "a" * 64,
    )
    assert np.array_equal(got.rows, rows)
    assert list(receiver.take()) == []
    memory.close()


def test_a_step_that_takes_too_long_is_a_limit_and_no_fault() -> None:
    z = np.array([0.0, 0.0, 1.0])
    script = Script([(0.5, 1.5, hold(1, z, step=0.010))], 2.0)
    records = script.run(scene(), speed=0.0005)
    assert not any(moved(records))
    assert records[-1].state is State.SECURING
