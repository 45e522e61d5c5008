"""Wrench closure: against a linear program, and each answer against its own proof."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from model.errors import BadInput
from model.statics.feasibility import closure_margin, wrench_closure
from tests.model.statics.robots import PAPER_LENGTH, flat_matrix, paper_matrix, random_matrix


def largest_smallest_tension(matrix):
    """Return the largest s with tensions of at most 1 and at least s that balance each other."""
    cables = matrix.shape[1]
    answer = linprog(
        np.append(np.zeros(cables), -1.0),
        A_eq=np.column_stack([matrix, np.zeros(6)]),
        b_eq=np.zeros(6),
        A_ub=np.column_stack([-np.eye(cables), np.ones(cables)]),
        b_ub=np.zeros(cables),
        bounds=[(0.0, 1.0)] * cables + [(None, None)],
    )
    return -answer.fun


@settings(max_examples=150)
@given(seed=st.integers(0, 2**32 - 1), cables=st.sampled_from([6, 7, 8, 10, 12]))
def test_closed_exactly_where_a_linear_program_finds_positive_tensions(seed, cables):
    matrix = random_matrix(seed, cables)
    expected = largest_smallest_tension(matrix)
    answer = wrench_closure(matrix)
    if not 1e-12 < expected < 1e-5:
        assert answer.closed == (expected > 1e-5)
    assert answer.residual < 1e-9
    if answer.closed:
        assert 0.0 < answer.smallest_tension <= expected + 1e-9
        assert answer.proof.max() == 1.0
    else:
        assert answer.smallest_tension == 0.0
        assert np.linalg.norm(answer.proof) == pytest.approx(1.0)


def test_random_robots_of_the_oracle_test_are_of_both_kinds():
    kinds = {wrench_closure(random_matrix(seed, 10)).closed for seed in range(40)}
    assert kinds == {True, False}


def test_the_workspace_box_of_the_paper_is_wrench_closure_workspace():
    side = np.linspace(-0.25, 0.25, 4)
    for x in side:
        for y in side:
            for z in np.linspace(0.15, 0.65, 4):
                assert wrench_closure(paper_matrix((x, y, z))).closed


@pytest.mark.parametrize("cables", [7, 8, 10])
def test_a_suspended_robot_cannot_push_down(cables):
    matrix = random_matrix(4, cables, suspended=True)
    answer = wrench_closure(matrix)
    assert not answer.closed
    assert (answer.proof @ matrix <= 1e-12).all()


def test_as_many_cables_as_freedoms_never_close():
    answer = wrench_closure(random_matrix(2, 6))
    assert not answer.closed
    assert answer.residual < 1e-12


@pytest.mark.parametrize("matrix", [flat_matrix(), paper_matrix()[:, :5], np.zeros((6, 8))])
def test_without_full_rank_the_proof_is_a_wrench_no_cable_gives(matrix):
    answer = wrench_closure(matrix)
    assert not answer.closed
    assert np.abs(answer.proof @ matrix).max() < 1e-12


def test_a_cable_that_must_be_slack_opens_the_closure():
    """Balancing tensions exist, but one of them is zero: closure needs all above zero."""
    closed = random_matrix(
        next(s for s in range(99) if wrench_closure(random_matrix(s, 7)).closed), 7
    )
    outward = np.array([0.3, -0.2, 0.9, 0.01, 0.02, 0.0])
    assert wrench_closure(np.column_stack([closed, outward])).closed
    flat = closed.copy()
    flat[5] = 0.0
    with_one_lifting = np.column_stack([flat, flat[:, 0] + [0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
    answer = wrench_closure(with_one_lifting)
    assert not answer.closed
    assert answer.residual < 1e-12


@settings(max_examples=150)
@given(seed=st.integers(0, 2**32 - 1), cables=st.sampled_from([6, 7, 8, 10, 12]))
def test_the_margin_is_positive_exactly_where_the_quadratic_program_closes(seed, cables):
    matrix = random_matrix(seed, cables)
    margin = float(closure_margin(matrix, 0.2))
    if abs(margin) > 1e-9:
        assert wrench_closure(matrix).closed == (margin > 0.0)


def test_margins_of_many_poses_are_those_of_each():
    matrices = np.array([random_matrix(seed, 8) for seed in range(300)]).reshape(20, 15, 6, 8)
    margins = closure_margin(matrices, 0.2)
    assert margins.shape == (20, 15)
    assert margins[7, 4] == pytest.approx(float(closure_margin(matrices[7, 4], 0.2)), abs=1e-12)
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


def test_without_full_rank_the_margin_is_minus_infinity():
    assert closure_margin(flat_matrix(), 0.2) == -np.inf
    assert closure_margin(paper_matrix()[:, :5], 0.2) == -np.inf


def test_several_poses_at_once_are_refused():
    with pytest.raises(BadInput, match="one pose"):
        wrench_closure(np.zeros((2, 6, 8)))


def test_a_result_is_read_only():
    answer = wrench_closure(paper_matrix())
    for array in (answer.proof, answer.structure_matrix):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0.0
