"""Wrench closure: against a linear program, and continuous at its boundary."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.statics.feasibility import closure_margin
from tests.model.statics.robots import (
    PAPER_LENGTH,
    flat_matrix,
    largest_smallest_tension,
    paper_matrix,
    random_matrix,
)

LENGTH = 0.2


@settings(max_examples=150)
@given(seed=st.integers(0, 2**32 - 1), cables=st.sampled_from([6, 7, 8, 10, 12]))
def test_the_margin_is_positive_exactly_where_a_linear_program_finds_positive_tensions(
    seed, cables
):
    matrix = random_matrix(seed, cables)
    expected = largest_smallest_tension(matrix)
    if not 1e-12 < expected < 1e-5:
        assert (closure_margin(matrix, LENGTH) > 0.0) == (expected > 1e-5)


def test_random_robots_of_the_oracle_test_are_of_both_kinds():
    kinds = {bool(closure_margin(random_matrix(seed, 10), LENGTH) > 0.0) for seed in range(40)}
    assert kinds == {True, False}


def test_the_workspace_box_of_the_paper_is_wrench_closure_workspace():
    side = np.linspace(-0.25, 0.25, 4)
    box = product(side, side, np.linspace(0.15, 0.65, 4))
    assert (closure_margin([paper_matrix(at) for at in box], PAPER_LENGTH) > 0.0).all()


@pytest.mark.parametrize("cables", [7, 8, 10])
def test_a_suspended_robot_cannot_push_down(cables):
    assert closure_margin(random_matrix(4, cables, suspended=True), LENGTH) <= 0.0


def test_as_many_cables_as_freedoms_never_close():
    assert closure_margin(random_matrix(2, 6), LENGTH) <= 0.0


def test_a_cable_that_must_be_slack_opens_the_closure():
    """Balancing tensions exist, but one of them is zero: closure needs all above zero."""
    some = (random_matrix(seed, 7) for seed in range(99))
    closed = next(matrix for matrix in some if closure_margin(matrix, LENGTH) > 0.0)
    outward = np.array([0.3, -0.2, 0.9, 0.01, 0.02, 0.0])
    assert closure_margin(np.column_stack([closed, outward]), LENGTH) > 0.0
    flat = closed.copy()
    flat[5] = 0.0
    with_one_lifting = np.column_stack([flat, flat[:, 0] + [0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
    assert closure_margin(with_one_lifting, LENGTH) == pytest.approx(0.0, abs=1e-12)


def test_margins_of_many_poses_are_those_of_each():
    matrices = np.array([random_matrix(seed, 8) for seed in range(300)]).reshape(20, 15, 6, 8)
    margins = closure_margin(matrices, LENGTH)
    assert margins.shape == (20, 15)
    assert margins[7, 4] == pytest.approx(float(closure_margin(matrices[7, 4], LENGTH)), abs=1e-12)
    assert (margins > 0.0).any()
    assert (margins < 0.0).any()


def test_the_margin_is_continuous_at_zero():
    """The zero surface is then the boundary of closure, not somewhere in a cell."""
    start, end = np.array([0.0, 0.0, 0.445]), np.array([0.9, 0.3, 0.445])
    closed, lost = 0.0, 1.0
    while lost - closed > 1e-12:
        share = (closed + lost) / 2.0
        at = start + share * (end - start)
        inside = closure_margin(paper_matrix(tuple(at)), PAPER_LENGTH) > 0.0
        closed, lost = (share, lost) if inside else (closed, share)
    sides = np.array([paper_matrix(tuple(start + s * (end - start))) for s in (closed, lost)])
    before, after = closure_margin(sides, PAPER_LENGTH)
    assert 0.0 < before < 1e-9
    assert -1e-9 < after <= 0.0


@pytest.mark.parametrize("matrix", [flat_matrix(), paper_matrix()[:, :5], np.zeros((6, 8))])
def test_without_full_rank_the_margin_is_minus_infinity(matrix):
    assert closure_margin(matrix, LENGTH) == -np.inf
