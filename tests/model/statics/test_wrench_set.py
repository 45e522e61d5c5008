"""Volume of the set of forces: reference values, the convex hull as oracle, scaling laws."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from model.errors import BadInput
from model.statics.wrench_sets import force_volume
from tests.model.statics.robots import (
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


@given(seed=seeds, cables=st.sampled_from([6, 7, 8, 10]), factor=st.floats(0.1, 10.0))
def test_the_volume_grows_with_the_third_power_of_the_ranges(seed, cables, factor):
    matrix = random_matrix(seed, cables)
    ranges = np.random.default_rng(seed).uniform(1.0, 100.0, cables)
    assert force_volume(matrix, factor * ranges) == pytest.approx(
        factor**3 * force_volume(matrix, ranges)
    )


@given(seed=seeds)
def test_the_order_of_the_cables_does_not_matter(seed):
    order = np.random.default_rng(seed).permutation(8)
    matrix = paper_matrix()
    assert force_volume(matrix[:, order], 100.0) == pytest.approx(force_volume(matrix, 100.0))


def test_a_batch_larger_than_a_block_equals_its_poses_one_by_one():
    matrices = paper_matrices_at_slice(12).reshape(12, 12, 6, 8)
    batched = force_volume(matrices, 100.0)
    assert batched.shape == (12, 12)
    singly = [[float(force_volume(m, 100.0)) for m in row] for row in matrices]
    np.testing.assert_allclose(batched, singly, rtol=1e-12)


def test_a_flat_set_has_no_volume():
    assert force_volume(paper_matrix()[:, :2], 100.0) == 0.0
    assert force_volume(np.zeros((6, 8)), 100.0) == 0.0


@pytest.mark.parametrize("ranges", [np.ones(7), -1.0, np.nan])
def test_unusable_tension_ranges_are_refused(ranges):
    with pytest.raises(BadInput, match="tension"):
        force_volume(paper_matrix(), ranges)
