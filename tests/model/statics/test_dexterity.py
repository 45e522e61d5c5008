"""The condition number: reference values, invariances, and infinity instead of NaN."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.errors import BadInput
from model.statics.wrench_sets import condition_number, rms_anchor_radius
from tests.model.statics.robots import (
    PAPER_ANCHORS,
    PAPER_LENGTH,
    flat_matrix,
    paper_matrices_at_slice,
    paper_matrix,
    random_matrix,
)

seeds = st.integers(0, 2**32 - 1)


@pytest.mark.parametrize(
    ("length", "expected"), [(1e-3, 136.549), (1.0, 85.213), (PAPER_LENGTH, 10.955)]
)
def test_home_of_the_paper_has_the_reference_condition_number(length, expected):
    assert condition_number(paper_matrix(), length) == pytest.approx(expected, abs=5e-4)


def test_the_slice_of_the_paper_has_the_reference_range():
    inverse = 1.0 / condition_number(paper_matrices_at_slice(21), 1e-3)
    assert inverse.min() == pytest.approx(0.00188, abs=5e-6)
    assert inverse.max() == pytest.approx(0.00732, abs=5e-6)


def test_rms_radius_of_cube_corners_is_half_the_diagonal():
    assert rms_anchor_radius(PAPER_ANCHORS) == pytest.approx(PAPER_LENGTH, rel=1e-15)


@given(seed=seeds, cables=st.sampled_from([6, 7, 8, 10]), scale=st.floats(0.1, 10.0))
def test_scaling_robot_and_length_together_changes_nothing(seed, cables, scale):
    matrix = random_matrix(seed, cables)
    larger = matrix * np.repeat([1.0, scale], 3)[:, np.newaxis]
    assert condition_number(larger, 0.2 * scale) == pytest.approx(
        condition_number(matrix, 0.2), rel=1e-6
    )


@given(seed=seeds, cables=st.sampled_from([6, 7, 8, 10]))
def test_it_is_the_ratio_of_largest_to_smallest_gain(seed, cables):
    matrix = random_matrix(seed, cables)
    gains = np.sqrt(np.linalg.eigvalsh(matrix @ matrix.T))
    assert condition_number(matrix, 1.0) == pytest.approx(gains[-1] / gains[0], rel=1e-4)


def test_a_batch_equals_its_poses_one_by_one():
    matrices = paper_matrices_at_slice(3).reshape(3, 3, 6, 8)
    batched = condition_number(matrices, 0.1)
    assert batched.shape == (3, 3)
    assert batched[1, 2] == pytest.approx(float(condition_number(matrices[1, 2], 0.1)))


@pytest.mark.parametrize("matrix", [flat_matrix(), paper_matrix()[:, :5], np.zeros((6, 8))])
def test_without_full_rank_it_is_infinite(matrix):
    assert condition_number(matrix, 1.0) == np.inf


@pytest.mark.parametrize("length", [0.0, -1.0, np.nan, np.inf])
def test_a_length_that_is_no_length_is_refused(length):
    with pytest.raises(BadInput, match="characteristic length"):
        condition_number(paper_matrix(), length)


@pytest.mark.parametrize("matrix", [np.zeros(6), np.zeros((3, 8)), np.full((6, 8), np.nan)])
def test_an_unusable_matrix_is_refused(matrix):
    with pytest.raises(BadInput, match="structure matrix"):
        condition_number(matrix, 1.0)


@pytest.mark.parametrize("anchors", [np.zeros((0, 3)), np.zeros(3), np.full((8, 3), np.inf)])
def test_unusable_anchors_are_refused(anchors):
    with pytest.raises(BadInput, match="anchors"):
        rms_anchor_radius(anchors)
