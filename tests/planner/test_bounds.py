"""Proved minima along a path: for functions whose slope is known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from planner.bounds import MOST_SAMPLES, smallest_along
from planner.check import CLEARANCE_TOLERANCE, SELF_CLEARANCE_SHARE, SPACING
from planner.settings import CLEARANCE_RESERVE


def by_position(positions):
    """A change of at most 1 per unit of path."""
    return positions


def broken_line(seed: int, slope: float):
    """A function on 0..1 that changes by no more than the slope; and its smallest value."""
    rng = np.random.default_rng(seed)
    knots = np.linspace(0.0, 1.0, 30)
    steps = rng.uniform(-slope, slope, 29) / 29.0
    values = np.concatenate([[0.0], np.cumsum(steps)])
    return (lambda x: np.interp(x, knots, values)), float(values.min())


@given(st.integers(0, 2**32 - 1), st.floats(1e-4, 1e-2))
def test_the_proved_value_is_below_the_truth_and_within_the_tolerance(seed, tolerance) -> None:
    function, truth = broken_line(seed, 1.0)
    found = smallest_along(np.linspace(0, 1, 5), function, by_position, -np.inf, tolerance)
    assert found.proved <= truth + 1e-12
    assert truth <= found.value + 1e-12
    assert found.value - found.proved <= tolerance + 1e-12
    assert function(np.array([found.at]))[0] == pytest.approx(found.value)


@given(st.integers(0, 2**32 - 1), st.floats(1e-5, 1e-2))
def test_a_limit_just_kept_is_proved_however_coarse_the_tolerance(seed, room) -> None:
    function, truth = broken_line(seed, 1.0)
    found = smallest_along(np.linspace(0, 1, 5), function, by_position, truth - room, 1.0)
    assert found.proved >= truth - room - 1e-12


@given(st.integers(0, 2**32 - 1))
def test_a_limit_just_missed_is_never_proved(seed) -> None:
    function, truth = broken_line(seed, 1.0)
    found = smallest_along(np.linspace(0, 1, 5), function, by_position, truth + 1e-5, 1e-3)
    assert found.proved < truth + 1e-5


def test_a_single_sample_is_its_own_proof() -> None:
    found = smallest_along(np.zeros(1), lambda x: x + 3.0, by_position, 0.0, 1e-3)
    assert (found.value, found.proved, found.samples) == (3.0, 3.0, 1)


@given(st.integers(0, 2**32 - 1), st.floats(1e-4, 1e-2), st.floats(-0.5, 0.5), st.floats(0.0, 0.2))
def test_a_value_far_above_its_limit_is_proved_to_a_share_of_the_excess(
    seed, tolerance, room, share
) -> None:
    function, truth = broken_line(seed, 1.0)
    required = truth - room
    found = smallest_along(np.linspace(0, 1, 5), function, by_position, required, tolerance, share)
    allowed = max(tolerance, share * (found.value - required))
    assert found.proved <= truth + 1e-12
    assert found.value - found.proved <= allowed + 1e-12
    if room > 1e-9:
        assert found.proved >= required - 1e-12


def test_a_plateau_far_above_its_limit_takes_few_samples() -> None:
    """A straight move of 4 m took 26 000: the clearance beyond the stub of a cable is the same."""
    positions = np.linspace(0.0, 4.0, 801)
    found = smallest_along(
        positions,
        lambda x: np.full(len(x), 0.147),
        by_position,
        0.005,
        0.1e-3,
        SELF_CLEARANCE_SHARE,
    )
    assert found.samples <= 2 * len(positions)
    assert found.value - found.proved <= 0.00142


def test_a_plateau_too_long_for_its_tolerance_still_has_its_limit_proved() -> None:
    """It was cut where all samples were spent, with a bound below the limit: a refused plan."""
    positions = np.linspace(0.0, 1000.0, 1001)
    found = smallest_along(positions, lambda x: np.full(len(x), 0.147), by_position, 0.140, 1e-6)
    assert found.proved >= 0.140
    assert found.samples <= 4 * MOST_SAMPLES  # every interval is bisected in the last round


@pytest.mark.parametrize("rate", [1.0, 2.0])
@pytest.mark.parametrize("length", [5.0, 12.6, 30.0])
def test_a_long_path_at_the_planners_reserve_is_proved(length: float, rate: float) -> None:
    """Along an obstacle for 12.5 m, with pulleys or rotation, a plan failed its own check."""
    positions = np.linspace(0.0, length, int(np.ceil(length / SPACING)) + 1)
    found = smallest_along(
        positions,
        lambda x: np.full(len(x), 0.010 + CLEARANCE_RESERVE),
        lambda x: rate * x,
        0.010,
        CLEARANCE_TOLERANCE,
    )
    assert found.proved >= 0.010


@given(st.integers(0, 2**32 - 1))
def test_the_largest_change_may_differ_along_the_path(seed) -> None:
    rng = np.random.default_rng(seed)
    knots = np.linspace(0.0, 1.0, 9)
    slopes = rng.uniform(0.0, 100.0, 8)
    changes = np.append(0.0, np.cumsum(slopes / 8.0))
    values = np.append(0.0, np.cumsum(rng.uniform(-slopes, slopes) / 8.0))

    def function(x):
        return np.interp(x, knots, values)

    found = smallest_along(
        np.linspace(0.0, 1.0, 4), function, lambda x: np.interp(x, knots, changes), -np.inf, 1e-3
    )
    assert found.proved <= values.min() + 1e-12
    assert found.value - found.proved <= 1e-3 + 1e-12
