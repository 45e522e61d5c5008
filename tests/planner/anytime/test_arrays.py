"""The small compiled parts: heap, interpolation, random numbers."""

from __future__ import annotations

import heapq

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator

from planner.anytime.lattice_path import pop, push
from planner.anytime.problem import interpolated
from planner.kernels.primitives import below, direction, seeded, uniform
from planner.space import Lattice, corners_and_weights

KEYS = st.lists(st.one_of(st.none(), st.integers(-20, 20)), max_size=80)


@given(KEYS)
def test_the_heap_gives_the_same_keys_as_heapq(steps) -> None:
    """Numbers are pushed, None takes one out; a small room makes it grow."""
    keys, entries, count = np.empty((2, 2)), np.empty((2, 2), dtype=np.int64), 0
    oracle: list[float] = []
    for number, step in enumerate(steps):
        if step is not None:
            value = 0.5 * number
            keys, entries, count = push(
                keys, entries, count, float(step), value, number, number + 1
            )
            heapq.heappush(oracle, float(step))
        elif oracle:
            key, first = keys[0, 0], entries[0, 0]
            assert key == heapq.heappop(oracle) == steps[first]
            assert keys[0, 1] == 0.5 * first
            assert entries[0, 1] == first + 1
            count = pop(keys, entries, count)
        assert count == len(oracle)
        assert count == 0 or keys[0, 0] == oracle[0]


@pytest.fixture(scope="module")
def lattice() -> tuple[Lattice, np.ndarray]:
    made = Lattice.over(np.array([-0.25, -0.2, 0.15]), np.array([0.25, 0.1, 0.65]))
    return made, np.random.default_rng(3).normal(size=made.shape)


def test_interpolation_agrees_with_its_definition_and_with_scipy(lattice) -> None:
    made, values = lattice
    rng = np.random.default_rng(4)
    upper = made.lower + made.spacing * (np.array(made.shape) - 1)
    points = rng.uniform(made.lower, upper, (500, 3))
    grid = np.stack([made.lower, made.spacing])
    got = [interpolated(grid, values, tuple(point)) for point in points]
    corners, weights = corners_and_weights(made, points)
    assert got == pytest.approx((values.ravel()[corners] * weights).sum(axis=1), abs=1e-12)
    axes = [made.lower[a] + made.spacing[a] * np.arange(made.shape[a]) for a in range(3)]
    assert got == pytest.approx(RegularGridInterpolator(axes, values)(points), abs=1e-12)


@pytest.mark.parametrize("far", [(9.0, 9.0, 9.0), (-9.0, -9.0, -9.0)])
def test_outside_the_lattice_the_value_on_its_border_counts(lattice, far) -> None:
    made, values = lattice
    corner = values[-1, -1, -1] if far[0] > 0 else values[0, 0, 0]
    assert interpolated(np.stack([made.lower, made.spacing]), values, far) == corner


def test_random_numbers_are_those_of_splitmix64() -> None:
    """Source: first outputs for the seed 1234567, as published with the reference code."""
    state = seeded(1234567)
    words = (6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431)
    assert [uniform(state) for _ in words] == [(word >> 11) * 2.0**-53 for word in words]


@given(st.integers(0, 2**70), st.integers(1, 1000))
def test_random_draws_stay_in_their_ranges(seed, count) -> None:
    state = seeded(seed)
    for _ in range(5):
        assert 0.0 <= uniform(state) < 1.0
        assert 0 <= below(state, count) < count
        assert np.linalg.norm(direction(state)) == pytest.approx(1.0, abs=1e-12)


def test_directions_prefer_none() -> None:
    state = seeded(8)
    drawn = np.array([direction(state) for _ in range(20_000)])
    assert np.abs(drawn.mean(axis=0)).max() < 0.02
    assert drawn.T @ drawn / len(drawn) == pytest.approx(np.eye(3) / 3.0, abs=0.01)
