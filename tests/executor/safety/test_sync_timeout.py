"""No drive is commanded to follow when it may have stopped on its own."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from executor.safety.sync_timeout import LATE_AGE, MARGIN, SyncAge

TIMEOUTS = st.floats(1.1, 100.0)
NAN = float("nan")


def test_the_usual_drive_gets_no_set_point_from_two_and_a_half_periods_on() -> None:
    usual = SyncAge()
    assert (usual.timeout, usual.margin, usual.limit) == (3.0, 0.5, 2.5)
    assert usual.may_enable(0.0)
    assert usual.may_enable(math.nextafter(2.5, 0.0))
    assert not usual.may_enable(2.5)
    assert not usual.may_enable(math.inf)
    assert not usual.may_enable(NAN)


def test_the_motion_stops_along_its_path_when_a_whole_period_was_missed() -> None:
    """Before the usual drive stops on its own, and before 0Fh is withheld from it."""
    assert LATE_AGE == 2.0
    assert SyncAge().may_enable(LATE_AGE)


def test_a_drive_that_tolerates_one_and_a_half_periods_keeps_half_of_the_rest() -> None:
    assert SyncAge(1.5).limit == 1.25


@given(TIMEOUTS, st.floats(0.0, 200.0))
def test_nothing_is_sent_within_the_margin_of_the_time_out(timeout: float, age: float) -> None:
    rule = SyncAge(timeout)
    assert 0.0 < rule.margin <= MARGIN
    if age >= timeout - rule.margin:
        assert not rule.may_enable(age)
    else:
        assert rule.may_enable(age)


@given(TIMEOUTS)
def test_a_cycle_in_time_may_always_be_sent(timeout: float) -> None:
    assert SyncAge(timeout).may_enable(1.0)


@pytest.mark.parametrize("timeout", [1.099, 1.0, 0.5, 0.0, -1.0, NAN])
def test_a_time_out_that_no_cycle_could_keep_is_an_error(timeout: float) -> None:
    with pytest.raises(ValueError, match="cannot be kept enabled"):
        SyncAge(timeout)
