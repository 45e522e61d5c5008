"""The clock: late cycles delay the path and never bunch; small delays do not add up.

And how soon threads get their turn.
"""

from __future__ import annotations

import os
import sys
import threading
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from executor.realtime import scheduling
from executor.realtime.scheduling import (
    SWITCH_INTERVAL,
    RealClock,
    SimulatedClock,
    one_thread,
    prompt_threads,
    take_short_turns,
)

CYCLE = 0.01
CYCLE_NS = 10_000_000


class _Time:
    """A monotonic clock set by the test; sleeping overshoots by a given time."""

    def __init__(self) -> None:
        self.now = 5_000_000_000
        self.suspended = 7_000_000_000  # before the test
        self.between = 0  # passes between two readings
        self.overshoot = 0
        self.slept: list[int] = []

    CLOCK_BOOTTIME = 7

    def monotonic_ns(self) -> int:
        self.now += self.between
        return self.now

    def clock_gettime_ns(self, clock: int) -> int:
        assert clock == self.CLOCK_BOOTTIME
        self.now += self.between
        return self.now + self.suspended

    def sleep_until(self, deadline: int) -> None:
        assert deadline > self.now
        self.slept.append(deadline - self.now)
        self.now = deadline + self.overshoot

    def work(self, seconds: float) -> None:
        self.now += round(seconds * 1e9)


@pytest.fixture
def time(monkeypatch: pytest.MonkeyPatch) -> _Time:
    hand_moved = _Time()
    monkeypatch.setattr(scheduling, "time", hand_moved)
    monkeypatch.setattr(scheduling, "sleep_until", hand_moved.sleep_until)
    return hand_moved


def test_simulated_time_costs_nothing_and_is_never_late():
    simulated = SimulatedClock(CYCLE)
    assert simulated.time == 0.0
    for cycle in range(4):
        assert (simulated.next_cycle(), simulated.time_left()) == (0.0, 0.0)
        assert simulated.time == cycle * CYCLE


def test_cycles_begin_on_time_whatever_the_work_takes(time):
    real = RealClock(CYCLE)
    assert real.next_cycle() == 0.0
    begin = time.now
    for cycle in range(1, 6):
        time.work(0.001 * cycle)
        assert real.next_cycle() == 0.0
        assert time.now == begin + cycle * CYCLE_NS


def test_a_suspended_computer_is_late_by_that_time(time):
    """The monotonic clock stands still meanwhile, but the drives have stopped."""
    real = RealClock(CYCLE)
    real.next_cycle()
    time.work(0.002)
    before = real.now
    time.suspended += 60 * 10**9
    assert real.now - before == pytest.approx(60.0)
    assert real.next_cycle() == pytest.approx(6000.0)
    assert real.next_cycle() == 0.0
    time.between = 1_000_000  # less is seen of the suspension, for once
    assert real.next_cycle() < 0.5
    time.between = 0
    assert real.next_cycle() == pytest.approx(0.0, abs=0.01), "it is counted once"


@given(waits=st.lists(st.integers(0, 10**9), min_size=1, max_size=20))
def test_a_process_that_waits_between_two_readings_was_not_suspended(waits):
    time = _Time()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scheduling, "time", time)
        real = RealClock(CYCLE)
        for time.between in waits:
            earliest = time.now
            now = round(1e9 * real.now)
            assert earliest - 2 <= now <= time.now + 2


def test_small_delays_are_reported_and_do_not_add_up(time):
    real = RealClock(CYCLE)
    real.next_cycle()
    begin, time.overshoot = time.now, 80_000
    lateness = [real.next_cycle() for _ in range(100)]
    assert lateness == pytest.approx([0.008] * 100)
    assert time.now == begin + 100 * CYCLE_NS + 80_000


@pytest.mark.parametrize("late_cycles", [0.11, 0.5, 0.9, 1.0, 2.5, 10.0])
def test_after_a_late_cycle_the_next_is_a_whole_cycle_away(time, late_cycles):
    """Two set-points closer than a cycle would make the drives run faster than planned."""
    real = RealClock(CYCLE)
    real.next_cycle()
    time.work((1.0 + late_cycles) * CYCLE)
    assert real.next_cycle() == pytest.approx(late_cycles)
    late = time.now
    assert real.next_cycle() == 0.0
    assert time.now == late + CYCLE_NS


@given(works=st.lists(st.floats(0.0, 0.05), max_size=30))
def test_no_two_cycles_are_closer_than_nine_tenths(works):
    time, real = _Time(), RealClock(CYCLE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scheduling, "time", time)
        patch.setattr(scheduling, "sleep_until", time.sleep_until)
        begins = []
        for work in works:
            assert real.next_cycle() >= 0.0
            begins.append(time.now)
            time.work(work)
    for before, after in pairwise(begins):
        assert after - before >= 0.9 * CYCLE_NS - 1


def test_the_time_of_a_cycle_is_when_it_truly_began(time):
    real = RealClock(CYCLE)
    assert real.time == time.now / 1e9
    real.next_cycle()
    first = real.time
    time.work(0.004)
    assert real.time == first, "work in a cycle does not change when it began"
    time.overshoot = 80_000
    real.next_cycle()
    assert real.time - first == pytest.approx(CYCLE + 80e-6)


def test_a_frame_that_is_over_is_not_slept_for():
    scheduling.sleep_until(1)


def test_time_left_ends_before_the_cycle_does(time):
    real = RealClock(CYCLE)
    assert real.time_left() == 0.0
    real.next_cycle()
    assert real.time_left() == pytest.approx(CYCLE - RealClock.RESERVE)
    time.work(0.004)
    assert real.time_left() == pytest.approx(0.006 - RealClock.RESERVE)
    time.work(0.02)
    assert real.time_left() == 0.0


@given(works=st.lists(st.floats(0.0, 0.02), min_size=1, max_size=20))
def test_what_the_operator_requests_counts_until_a_fifth_of_the_cycle_is_left(works):
    time, real = _Time(), RealClock(CYCLE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scheduling, "time", time)
        patch.setattr(scheduling, "sleep_until", time.sleep_until)
        real.wait_to_decide()
        assert time.slept == [], "before the first cycle there is nothing to wait for"
        for work in works:
            real.next_cycle()
            begun = time.now
            time.work(work)
            after = time.now
            real.wait_to_decide()
            decided = round((1.0 - RealClock.DECIDING) * CYCLE_NS)
            assert time.now >= after
            if time.now > after:
                assert 0.7 * CYCLE_NS <= time.now - begun <= decided
            else:
                assert time.now - begun >= 0.7 * CYCLE_NS


def test_threads_take_turns_sooner_only_while_a_run_is_served() -> None:
    before = sys.getswitchinterval()
    with prompt_threads():
        assert sys.getswitchinterval() == pytest.approx(SWITCH_INTERVAL)
    assert sys.getswitchinterval() == before


def test_runs_side_by_side_leave_the_process_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second had restored what the first one had set."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setenv("MKL_NUM_THREADS", "3")
    before = sys.getswitchinterval()
    first, second = ExitStack(), ExitStack()
    for stack in (first, second):
        stack.enter_context(prompt_threads())
        stack.enter_context(one_thread())
    first.close()
    assert sys.getswitchinterval() == pytest.approx(SWITCH_INTERVAL)
    assert (os.environ["OMP_NUM_THREADS"], os.environ["MKL_NUM_THREADS"]) == ("1", "1")
    second.close()
    assert sys.getswitchinterval() == before
    assert "OMP_NUM_THREADS" not in os.environ
    assert os.environ["MKL_NUM_THREADS"] == "3"


def test_short_turns_change_nothing_but_the_slice() -> None:
    """Policy and priority stay; the slice of threads that begin later is short, too."""

    def slices() -> list[int]:
        try:
            lines = Path(f"/proc/self/task/{threading.get_native_id()}/sched").read_text()
        except OSError:  # a kernel that does not show it
            return []
        return [int(line.split(":")[1]) for line in lines.splitlines() if "slice" in line]

    def turns(found: list[object]) -> None:
        found += [os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0)]
        take_short_turns()
        found += [os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0), slices()]
        later = threading.Thread(target=lambda: found.append(slices()))
        later.start()
        later.join()

    found: list[object] = []
    thread = threading.Thread(target=turns, args=(found,))
    thread.start()
    thread.join()
    assert found[:2] == found[2:4]
    assert found[4] == found[5]
    if found[4] and _release() >= (6, 12):
        assert found[4] == [100_000]


def _release() -> tuple[int, ...]:
    return tuple(int(part) for part in os.uname().release.split("-")[0].split(".")[:2])
