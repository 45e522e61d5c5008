"""A press of a jog control that ended never moves anything again, whatever arrives later."""

from __future__ import annotations

import math
from time import CLOCK_BOOTTIME

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from executor.hold_to_run.presses import (
    TIMEOUT,
    CableMove,
    PlatformMove,
    PressBoard,
    PressReader,
    PressRule,
    PressState,
    press_clock,
)

UP = np.array([0.0, 0.0, 1.0])
ALONG_Z = PlatformMove(UP, in_platform=False)
NUMBERS = st.integers(1, 6)
TIMES = st.floats(0.0, 2.0)


class Time:
    """A clock set by the test."""

    def __init__(self) -> None:
        self.now = 10.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def time() -> Time:
    return Time()


def test_press_numbers_are_milliseconds_since_the_boot(monkeypatch: pytest.MonkeyPatch) -> None:
    clocks = {CLOCK_BOOTTIME: 7_000_123_456_789}
    monkeypatch.setattr("time.clock_gettime_ns", clocks.__getitem__)
    assert press_clock() == 7_000_123


@pytest.fixture
def board(time: Time) -> PressBoard:
    return PressBoard(time)


def hold(board: PressBoard, number: int, percent: int = 100) -> bool:
    return board.hold(number, ALONG_Z, step=None, percent=percent)


def test_a_press_lasts_150_ms_without_a_word() -> None:
    """The value of the safety page, not of the code."""
    assert PressRule().held(1, heard=10.0, now=10.150 - 1e-9)
    assert not PressRule().held(1, heard=10.0, now=10.151)
    assert PressRule().held(1, heard=0.0, now=TIMEOUT), "up to the end of its time"


def test_there_is_no_press_zero() -> None:
    assert not PressRule().held(0, heard=10.0, now=10.0)


def test_a_new_board_holds_nothing_and_ends_nothing(board: PressBoard, time: Time) -> None:
    said = PressReader(board.memory, time).read()
    assert said == PressState(0, 1.0, ends=False, cable=0, pays_out=False, step=None)
    assert board.last_heard == -math.inf
    assert board.held() is None


def test_a_press_that_comes_after_its_time_is_over_for_every_reader(
    board: PressBoard, time: Time
) -> None:
    """Also for a reader whose clock lags: the entry states that nothing is held."""
    hold(board, 1)
    time.now += 2.0 * TIMEOUT
    assert not hold(board, 1)
    assert PressReader(board.memory, lambda: time.now - 2.0 * TIMEOUT).read().press == 0


def test_a_report_that_was_passed_on_late_counts_from_when_it_was_made(
    board: PressBoard, time: Time
) -> None:
    def old(number: int, age: float) -> bool:
        return board.hold(
            number, PlatformMove(UP, in_platform=False), step=None, percent=100, age=age
        )

    reader = PressReader(board.memory, time)
    assert not old(1, TIMEOUT + 0.001), "it is over before it begins"
    assert old(2, 0.1)
    assert reader.read().press == 2
    time.now += TIMEOUT - 0.1 - 0.001
    assert reader.read().press == 2
    hold(board, 2)
    assert old(2, 0.1), "an older report takes nothing from a newer one"
    time.now += TIMEOUT - 0.001
    assert reader.read().press == 2
    time.now += 0.002
    assert reader.read().press == 0


def test_letting_go_of_an_earlier_press_leaves_the_newest_held(board: PressBoard) -> None:
    hold(board, 1)
    hold(board, 2)
    board.let_go(1)
    assert PressReader(board.memory, lambda: 10.0).read().press == 2
    board.let_go(3)
    assert PressReader(board.memory, lambda: 10.0).read().press == 0


@pytest.mark.parametrize("cable", [0, 1, 8, 9])
def test_cables_are_numbered_from_one(time: Time, cable: int) -> None:
    board = PressBoard(time, cables=8)
    if 1 <= cable <= 8:
        assert board.hold(1, CableMove(cable, pays_out=True), step=None, percent=100)
        assert PressReader(board.memory, time).read().cable == cable
    else:
        with pytest.raises(ValueError, match=f"no cable {cable}"):
            board.hold(1, CableMove(cable, pays_out=True), step=None, percent=100)
    board.close()


@given(st.lists(st.tuples(NUMBERS, TIMES, TIMES), max_size=30))
def test_a_press_that_was_over_is_never_held_again(looks: list[tuple[int, float, float]]) -> None:
    rule, over = PressRule(), set[int]()
    for number, heard, now in looks:
        held = rule.held(number, heard, now)
        assert not (held and number in over)
        assert not held or 0.0 <= now - heard <= TIMEOUT
        over |= set(range(1, number)) if held else {number, *range(1, number)}


@given(
    st.lists(st.tuples(st.sampled_from(["hold", "let go", "wait"]), NUMBERS, TIMES), max_size=40)
)
def test_loop_and_board_never_hold_what_is_not_held(said: list[tuple[str, int, float]]) -> None:
    """The oracle keeps the last report of each press, and whether it ended."""
    time = Time()
    board = PressBoard(time)
    reader = PressReader(board.memory, time)
    heard: dict[int, float] = {}
    newest, ended = 0, 0
    for what, number, wait in said:
        if what == "wait":
            time.now += wait
        elif what == "let go":
            board.let_go(number)
            ended = max(ended, number)
        else:
            hold(board, number)
            late = number in heard and time.now - heard[number] > TIMEOUT
            if late:
                ended = max(ended, number)
            if number > ended and number >= newest:
                newest, heard[number] = number, time.now
        state, press = reader.read(), board.held()
        for seen in (state.press, 0 if press is None else press.number):
            assert seen in (0, newest)
            assert seen == 0 or (seen > ended and time.now - heard[seen] <= TIMEOUT)
        if newest > ended and time.now - heard[newest] > TIMEOUT:
            ended = newest
    board.close()


def test_a_press_is_held_as_long_as_it_is_reported(board: PressBoard, time: Time) -> None:
    reader = PressReader(board.memory, time)
    for _ in range(50):
        assert hold(board, 1)
        time.now += 0.9 * TIMEOUT
        assert reader.read().press == 1
    time.now += 0.2 * TIMEOUT
    assert reader.read().press == 0
    assert not hold(board, 1), "a gap ends it for good"
    assert hold(board, 2)
    assert reader.read().press == 2


def test_what_a_press_requested_first_stays(board: PressBoard) -> None:
    hold(board, 1)
    board.hold(1, PlatformMove(-UP, in_platform=True), step=0.001, percent=50)
    press = board.held()
    assert press is not None
    assert isinstance(press.move, PlatformMove)
    assert (press.move.direction == UP).all()
    assert (press.move.in_platform, press.step) == (False, None)
    assert PressReader(board.memory, lambda: 10.0).read().share == 0.5, "but its speed may change"


def test_the_end_of_a_session_ends_what_is_held(board: PressBoard, time: Time) -> None:
    hold(board, 1)
    board.end()
    state = PressReader(board.memory, time).read()
    assert state.ends
    assert state.press == 0
    assert board.held() is None


def test_a_clock_that_jumps_back_holds_nothing(board: PressBoard, time: Time) -> None:
    hold(board, 1)
    time.now -= 5.0
    assert PressReader(board.memory, time).read().press == 0


def test_a_report_that_arrives_while_the_loop_reads_ends_nothing(
    board: PressBoard, time: Time
) -> None:
    """A report later than the loop's time counted as a clock that had jumped back."""

    def clock() -> float:
        now = time.now
        time.now += 3e-6
        assert hold(board, 1)
        return now

    hold(board, 1)
    reader = PressReader(board.memory, clock)
    for _ in range(100):
        assert reader.read().press == 1
        time.now += 0.01


@pytest.mark.parametrize("index", range(32))
def test_an_entry_that_is_half_written_does_not_count(
    board: PressBoard, time: Time, index: int
) -> None:
    hold(board, 1, percent=40)
    reader = PressReader(board.memory, time)
    assert reader.read().press == 1
    before = board.memory.view[index]
    board.memory.view[index] = before ^ 0xFF
    assert reader.read().press == 1, "the previous entry counts until the new one is complete"
    time.now += 2.0 * TIMEOUT
    assert reader.read().press == 0, "and is not held forever"


def test_nothing_is_held_at_first(board: PressBoard) -> None:
    assert PressReader(board.memory, lambda: 10.0).read().press == 0
    assert board.held() is None
    board.let_go(3)
    assert not hold(board, 3), "a press released before it was held is over"
    assert math.isnan(board._heard)


def test_a_press_knows_since_when_no_earlier_one_was_held(board: PressBoard, time: Time) -> None:
    def free_since(number: int) -> float:
        hold(board, number)
        press = board.held()
        assert press is not None
        return press.free_since

    assert free_since(1) == -math.inf
    time.now += 0.1
    assert free_since(2) == time.now, "the first was held until now"
    board.let_go(2)
    ended = time.now
    time.now += 3.0
    assert free_since(3) == ended
    heard = time.now
    time.now += 3.0
    assert free_since(4) == pytest.approx(heard + TIMEOUT), "it fell silent"


@pytest.fixture
def cables(time: Time) -> PressBoard:
    return PressBoard(time, cables=8)


@pytest.mark.parametrize("step", [None, 0.001])
@pytest.mark.parametrize("out", [True, False])
def test_the_loop_reads_cable_sense_and_step(
    cables: PressBoard, time: Time, out: bool, step: float | None
) -> None:
    assert cables.hold(4, CableMove(8, pays_out=out), step=step, percent=30)
    state = PressReader(cables.memory, time).read()
    assert (state.press, state.cable, state.pays_out, state.step) == (4, 8, out, step)
    assert state.share == 0.3


def test_a_press_keeps_its_cable(cables: PressBoard, time: Time) -> None:
    """Later reports under the same number change neither cable nor sense nor length."""
    cables.hold(4, CableMove(3, pays_out=False), step=None, percent=100)
    assert cables.hold(4, CableMove(5, pays_out=True), step=0.001, percent=50)
    state = PressReader(cables.memory, time).read()
    assert (state.cable, state.pays_out, state.step, state.share) == (3, False, None, 0.5)
    press = cables.held()
    assert press is not None
    assert press.move == CableMove(3, pays_out=False)


@pytest.mark.parametrize("cable", [0, 9, -1])
def test_a_cable_that_is_not_there_is_not_held(cables: PressBoard, cable: int) -> None:
    with pytest.raises(ValueError, match=f"no cable {cable}"):
        cables.hold(1, CableMove(cable, pays_out=False), step=None, percent=100)
    assert cables.held() is None


def test_a_session_moves_either_cables_or_the_platform(
    board: PressBoard, cables: PressBoard
) -> None:
    with pytest.raises(ValueError, match="moves the platform"):
        board.hold(1, CableMove(1, pays_out=False), step=None, percent=100)
    with pytest.raises(ValueError, match="one cable at a time"):
        hold(cables, 1)
    assert board.held() is None
    assert cables.held() is None
