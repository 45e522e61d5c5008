"""The feed: one row a cycle, and from anywhere a smooth stop along the table."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from executor.control.cycle import Feed, targets_at
from executor.trajectory.time_scaling import speed_change
from model.rig import Motion
from tests.executor.routes import GACHON, HALL

CYCLE = 0.01
motions = st.sampled_from([GACHON, HALL])


def _to_rest(feed: Feed, most: int = 5000) -> list[float]:
    """All indices until it is at rest."""
    indices = [feed.index]
    for _ in range(most):
        if feed.at_rest:
            return indices
        indices.append(feed.advance())
    raise AssertionError("it never came to rest")


def _stopped(rows: int, before: int, motion: Motion, cycle: float = CYCLE) -> list[float]:
    feed = Feed(rows, cycle, motion)
    for _ in range(before):
        feed.advance()
    feed.stop()
    return _to_rest(feed)


def test_it_goes_one_row_a_cycle_to_the_last_and_rests_there():
    feed = Feed(40, CYCLE, GACHON)
    assert not feed.at_rest
    assert _to_rest(feed) == list(range(40))
    assert feed.advance() == 39


def test_a_table_of_one_row_is_at_rest_from_the_start():
    feed = Feed(1, CYCLE, GACHON)
    assert feed.at_rest
    assert feed.advance() == 0.0


@given(rows=st.integers(1, 400), before=st.integers(0, 400), motion=motions)
@settings(max_examples=60)
def test_a_stop_anywhere_comes_to_rest_ahead_and_never_beyond_the_end(rows, before, motion):
    indices = _stopped(rows, before, motion)
    assert indices[0] == min(before, rows - 1)
    steps = np.diff(indices)
    assert (steps >= 0.0).all()
    assert (steps <= 1.0 + 1e-9).all()
    assert max(indices) <= rows - 1
    assert (np.diff(steps) <= 1e-9).all(), "it slows down only"


@given(before=st.integers(1, 50), motion=motions, cycle=st.sampled_from([0.004, 0.01, 0.02]))
@settings(max_examples=40)
def test_at_full_speed_a_stop_keeps_the_paths_acceleration_and_jerk(before, motion, cycle):
    indices = _stopped(5000, before, motion, cycle)
    metres = (
        np.array([before - 2.0, before - 1.0, *indices, *[indices[-1]] * 3]) * motion.speed * cycle
    )
    acceleration = np.abs(np.diff(metres, 2)) / cycle**2
    jerk = np.abs(np.diff(metres, 3)) / cycle**3
    assert acceleration.max() <= motion.acceleration * (1 + 1e-6)
    assert jerk.max() <= motion.jerk * (1 + 1e-6)


@given(before=st.integers(1, 50), motion=motions)
@settings(max_examples=20)
def test_a_stop_takes_the_textbook_distance(before, motion):
    """From v to rest, acceleration a, jerk j: v/2 (v/a + a/j), or v √(v/j) if a is not reached."""
    v, a, j = motion.speed, motion.acceleration, motion.jerk
    time = v / a + a / j if v >= a**2 / j else 2.0 * np.sqrt(v / j)
    indices = _stopped(5000, before, motion)
    assert (indices[-1] - before) * CYCLE == pytest.approx(time / 2.0, rel=1e-6)
    assert len(indices) - 1 == pytest.approx(np.ceil(time / CYCLE), abs=1)


def test_a_stop_before_the_first_step_is_at_rest_at_once_and_can_be_ended_by_a_ramp():
    feed = Feed(500, CYCLE, GACHON)
    feed.stop()
    assert feed.at_rest
    assert (feed.advance(), feed.rate, feed.wanted, feed.rows_to_rest) == (0.0, 0.0, 0.0, 0.0)
    feed.go_to(1.0)
    assert 0.0 < feed.advance() < 0.1


def test_a_second_stop_changes_nothing():
    once, twice = (Feed(500, CYCLE, GACHON) for _ in range(2))
    for feed in (once, twice):
        for _ in range(10):
            feed.advance()
        feed.stop()
    for _ in range(5):
        once.advance()
        twice.advance()
        twice.stop()
    assert _to_rest(twice) == _to_rest(once)


def test_at_rest_it_stays_at_rest():
    feed = Feed(500, CYCLE, GACHON)
    feed.advance()
    feed.stop()
    indices = _to_rest(feed)
    assert [feed.advance() for _ in range(5)] == [indices[-1]] * 5


def test_a_stop_that_reaches_the_last_row_ends_there():
    indices = _stopped(30, 27, GACHON)
    assert indices[-1] == 29


def test_a_stop_harder_than_one_cycle_can_show_is_at_rest_at_once():
    fierce = Motion(0.02, 1e6, 1e12, 0.001, 0.002, 0.001, 0.00007, 0.002)
    indices = _stopped(100, 10, fierce)
    assert len(indices) <= 3
    assert indices[-1] <= 11.0


def _walked(motion: Motion, requests: list[tuple[int, float]], rows: int = 5000) -> list[float]:
    """Indices of a feed with requests (cycles, rate) in sequence."""
    feed = Feed(rows, CYCLE, motion)
    indices = [feed.index]
    for cycles, rate in requests:
        feed.go_to(rate)
        indices += [feed.advance() for _ in range(cycles)]
    return indices


@given(
    requests=st.lists(st.tuples(st.integers(0, 60), st.floats(0.0, 1.0)), min_size=1, max_size=8),
    motion=motions,
)
@settings(max_examples=80)
def test_whatever_is_requested_it_keeps_between_rest_and_full_rate_and_changes_smoothly(
    requests, motion
):
    """Also if a change is interrupted by the next."""
    indices = np.array(_walked(motion, requests))
    rates = np.diff(indices)
    assert (rates >= 0.0).all()
    assert (rates <= 1.0 + 1e-9).all()
    metres = indices * motion.speed * CYCLE
    limit = motion.acceleration * (1 + 1e-6)
    assert np.abs(np.diff(metres, 2)).max(initial=0.0) / CYCLE**2 <= limit
    limit = motion.jerk * (1 + 1e-6)
    assert np.abs(np.diff(metres, 3)).max(initial=0.0) / CYCLE**3 <= limit


@given(rate=st.floats(0.01, 1.0), motion=motions)
@settings(max_examples=30)
def test_it_reaches_the_rate_that_was_requested_and_keeps_it(rate, motion):
    indices = _walked(motion, [(5, 1.0), (1000, rate)])
    assert np.diff(indices[-50:]) == pytest.approx(rate, abs=1e-9)


@given(motion=motions, before=st.integers(0, 60), held=st.integers(0, 300))
@settings(max_examples=30)
def test_after_a_hold_it_continues_to_the_end_without_leaving_a_row_out(motion, before, held):
    feed = Feed(600, CYCLE, motion)
    for _ in range(before):
        feed.advance()
    feed.stop()
    for _ in range(held):
        feed.advance()
    feed.go_to(1.0)
    indices = _to_rest(feed)
    assert indices[-1] == 599
    assert feed.at_end
    assert (np.diff(indices) <= 1.0 + 1e-9).all()


def test_asking_again_for_the_same_rate_changes_nothing():
    once, often = (Feed(500, CYCLE, GACHON) for _ in range(2))
    for feed in (once, often):
        feed.go_to(0.3)
    for _ in range(60):
        often.go_to(0.3)
        assert often.advance() == once.advance()


@pytest.mark.parametrize("rate", [-0.01, 1.01, float("nan")])
def test_a_rate_the_table_was_not_checked_for_is_refused(rate):
    with pytest.raises(ValueError, match="not from 0 to 1"):
        Feed(10, CYCLE, GACHON).go_to(rate)


def test_targets_at_a_row_are_the_row_and_plain_integers():
    table = np.array([[1, -5], [7, 100], [2**31 - 1, -(2**31)]], dtype=np.int32)
    for row, values in enumerate(table.tolist()):
        targets = targets_at(table, float(row))
        assert targets == tuple(values)
        assert {type(target) for target in targets} == {int}
    assert targets_at(table, 9.5) == tuple(table[-1].tolist())
    assert {type(target) for target in targets_at(table, 0.3)} == {int}


def test_between_rows_of_opposite_ends_nothing_overflows():
    table = np.array([[-(2**31)], [2**31 - 1]], dtype=np.int32)
    assert targets_at(table, 0.25) == (-(2**30),)


@given(
    steps=st.lists(st.integers(-400, 400), min_size=1, max_size=30),
    share=st.floats(0.0, 1.0),
    rate=st.floats(0.0, 1.0),
)
@settings(max_examples=300)
def test_no_step_between_indices_is_longer_than_the_longest_row(steps, share, rate):
    """The gate allows a row's step and not a count more, also while slowing down."""
    table = np.cumsum([[0], *[[s] for s in steps]], axis=0).astype(np.int32)
    here = share * len(steps)
    there = min(here + rate, float(len(steps)))
    before, after = (targets_at(table, index)[0] for index in (here, there))
    assert abs(after - before) <= max(abs(s) for s in steps)


@given(rows=st.integers(2, 40), share=st.floats(0.0, 1.0))
def test_targets_between_rows_lie_between_them(rows, share):
    rng = np.random.default_rng(rows)
    table = rng.integers(-(10**6), 10**6, (rows, 8)).astype(np.int32)
    row = rng.integers(0, rows - 1)
    targets = np.array(targets_at(table, row + share))
    low, high = table[row : row + 2].min(axis=0), table[row : row + 2].max(axis=0)
    assert (low <= targets).all()
    assert (targets <= high).all()
    exact = table[row] + share * (table[row + 1].astype(float) - table[row])
    assert targets == pytest.approx(exact, abs=0.5 + 1e-6)


@given(
    speed=st.floats(0.0, 1.0),
    share=st.floats(-1.0, 1.0),
    end=st.floats(0.0, 1.0),
    acceleration=st.floats(1e-3, 1.0),
    jerk=st.floats(1e-5, 1.0),
)
def test_a_change_of_speed_keeps_its_limits_and_ends_without_acceleration(
    speed: float, share: float, end: float, acceleration: float, jerk: float
) -> None:
    change = speed_change((speed, share * acceleration), end, acceleration, jerk)
    before = change.at(0.0)
    assert before[1:] == pytest.approx((speed, share * acceleration), abs=1e-12)
    step = max(change.duration, 1.0) / 200
    for k in range(1, 201):
        travelled, now, slope = change.at(k * step)
        assert abs(slope) <= acceleration * (1.0 + 1e-9)
        assert abs(slope - before[2]) <= jerk * step * (1.0 + 1e-9) + 1e-12
        assert now - before[1] == pytest.approx((slope + before[2]) / 2 * step, abs=jerk * step**2)
        mean = (now + before[1]) / 2 * step
        assert travelled - before[0] == pytest.approx(mean, abs=acceleration * step**2 + 1e-12)
        before = travelled, now, slope
    assert change.at(change.duration)[1:] == (end, 0.0)
    assert change.at(change.duration * (1.0 - 1e-12))[1] == pytest.approx(end, abs=1e-6)
