"""Volumes of the wrench set: reference values, the convex hull as oracle, scaling laws."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from model.errors import BadInput
from model.statics.wrench_sets import force_volume, wrench_volume, zonotope_volume
from tests.model.statics.robots import (
    PAPER_LENGTH,
    flat_matrix,
    paper_matrices_at_slice,
    paper_matrix,
    random_matrix,
)

seeds = st.integers(0, 2**32 - 1)


def hull_volume(generators):
    corners = np.array(list(product([0.0, 1.0], repeat=generators.shape[1]))) @ generators.T
    return ConvexHull(corners).volume


def test_home_of_the_paper_has_the_reference_force_volume():
    assert force_volume(paper_matrix(), 100.0) == pytest.approx(2.66481e7, abs=50)


def test_the_slice_of_the_paper_has_the_reference_range():
    volumes = force_volume(paper_matrices_at_slice(21), 100.0)
    assert volumes.min() == pytest.approx(2.6451e7, abs=5e2)
    assert volumes.max() == pytest.approx(2.9108e7, abs=5e2)


@settings(max_examples=30)
@given(seed=seeds, cables=st.sampled_from([6, 7, 8, 10]))
def test_force_volume_is_that_of_the_convex_hull(seed, cables):
    matrix = random_matrix(seed, cables)
    ranges = np.random.default_rng(seed).uniform(1.0, 100.0, cables)
    expected = hull_volume(matrix[:3] * ranges)
    assert force_volume(matrix, ranges) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("cables", [6, 7, 8])
def test_wrench_volume_is_that_of_the_convex_hull(cables):
    matrix = random_matrix(3, cables)
    scaled = matrix / np.repeat([1.0, 0.2], 3)[:, np.newaxis]
    assert wrench_volume(matrix, 1.0, 0.2) == pytest.approx(hull_volume(scaled), rel=1e-9)


@given(seed=seeds, cables=st.sampled_from([6, 7, 8, 10]), factor=st.floats(0.1, 10.0))
def test_volumes_grow_with_the_power_of_their_dimension(seed, cables, factor):
    matrix = random_matrix(seed, cables)
    ranges = np.random.default_rng(seed).uniform(1.0, 100.0, cables)
    assert force_volume(matrix, factor * ranges) == pytest.approx(
        factor**3 * force_volume(matrix, ranges)
    )
    assert wrench_volume(matrix, factor * ranges, 0.2) == pytest.approx(
        factor**6 * wrench_volume(matrix, ranges, 0.2)
    )
    assert wrench_volume(matrix, ranges, 0.2 * factor) == pytest.approx(
        wrench_volume(matrix, ranges, 0.2) / factor**3
    )


@given(seed=seeds)
def test_the_order_of_the_cables_does_not_matter(seed):
    order = np.random.default_rng(seed).permutation(8)
    matrix = paper_matrix()
    assert force_volume(matrix[:, order], 100.0) == pytest.approx(force_volume(matrix, 100.0))
    assert wrench_volume(matrix[:, order], 100.0, PAPER_LENGTH) == pytest.approx(
        wrench_volume(matrix, 100.0, PAPER_LENGTH)
    )


def test_a_unit_cube_has_unit_volume_in_any_dimension():
    for dimension in range(1, 8):
        assert zonotope_volume(np.eye(dimension)) == pytest.approx(1.0)


def test_a_batch_larger_than_a_block_equals_its_poses_one_by_one():
    matrices = paper_matrices_at_slice(12).reshape(12, 12, 6, 8)
    for volume in (
        lambda m: force_volume(m, 100.0),
        lambda m: wrench_volume(m, 100.0, PAPER_LENGTH),
    ):
        batched = volume(matrices)
        assert batched.shape == (12, 12)
        singly = [[float(volume(m)) for m in row] for row in matrices]
        np.testing.assert_allclose(batched, singly, rtol=1e-12)


def test_a_flat_set_has_no_volume():
    assert wrench_volume(flat_matrix(), 100.0, 0.1) == pytest.approx(0.0, abs=1e-6)
    assert wrench_volume(paper_matrix()[:, :5], 100.0, 0.1) == 0.0
    assert force_volume(paper_matrix()[:, :2], 100.0) == 0.0
    assert force_volume(np.zeros((6, 8)), 100.0) == 0.0


@pytest.mark.parametrize("ranges", [np.ones(7), -1.0, np.nan])
def test_unusable_tension_ranges_are_refused(ranges):
    with pytest.raises(BadInput, match="tension"):
        force_volume(paper_matrix(), ranges)
