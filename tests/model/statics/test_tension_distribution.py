"""Tension distribution: exact, within limits, continuous, and honest about infeasibility."""

from __future__ import annotations

from dataclasses import replace

import daqp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from model.errors import BadInput, CdprError
from model.statics.feasibility import WrenchBox, capacity_margin
from model.statics.tension_distribution import TensionInfeasible, solve_tensions
from tests.model.statics.robots import (
    PAPER_LENGTH,
    PAPER_WEIGHT,
    flat_matrix,
    paper_matrix,
    random_matrix,
)

seeds = st.integers(0, 2**32 - 1)
cable_counts = st.sampled_from([6, 7, 8, 10])


def feasible_problem(seed, cables):
    """Return matrix, limits and a wrench that some tensions within the limits balance."""
    random = np.random.default_rng(seed)
    matrix = random_matrix(seed, cables)
    low = random.uniform(0.0, 10.0, cables)
    high = low + random.uniform(10.0, 90.0, cables)
    return matrix, low, high, -matrix @ random.uniform(low, high)


def any_problem(seed, cables):
    matrix, low, high, wrench = feasible_problem(seed, cables)
    return matrix, low, high, wrench * np.random.default_rng(seed + 1).uniform(0.5, 2.5)


def smallest_relaxation(matrix, low, high, wrench):
    """Return by how much all limits must be relaxed for tensions to exist, by a linear program."""
    cables = len(low)
    answer = linprog(
        np.append(np.zeros(cables), 1.0),
        A_eq=np.column_stack([matrix, np.zeros(6)]),
        b_eq=-wrench,
        A_ub=np.block(
            [[-np.eye(cables), -np.ones((cables, 1))], [np.eye(cables), -np.ones((cables, 1))]]
        ),
        b_ub=np.concatenate([-low, high]),
        bounds=[(None, None)] * (cables + 1),
    )
    assert answer.status == 0
    return answer.fun


@settings(max_examples=100)
@given(seed=seeds, cables=cable_counts)
def test_a_solution_balances_the_wrench_within_the_limits(seed, cables):
    matrix, low, high, wrench = feasible_problem(seed, cables)
    solution = solve_tensions(matrix, wrench, low, high)
    assert np.abs(solution.wrench_residual).max() < 1e-8
    assert solution.bound_violation == 0.0


@settings(max_examples=80)
@given(seed=seeds, cables=cable_counts)
def test_tensions_exist_exactly_where_a_linear_program_finds_them_and_the_shortfall_is_exact(
    seed, cables
):
    matrix, low, high, wrench = any_problem(seed, cables)
    needed = smallest_relaxation(matrix, low, high, wrench)
    if needed < -1e-6:
        solve_tensions(matrix, wrench, low, high)
    elif needed > 1e-6:
        with pytest.raises(TensionInfeasible) as refusal:
            solve_tensions(matrix, wrench, low, high)
        assert refusal.value.shortfall == pytest.approx(needed, rel=1e-6, abs=1e-7)


@settings(max_examples=40)
@given(seed=seeds, cables=cable_counts)
def test_limits_relaxed_by_the_shortfall_just_suffice(seed, cables):
    matrix, low, high, wrench = any_problem(seed, cables)
    try:
        solve_tensions(matrix, wrench, low, high)
    except TensionInfeasible as refusal:
        enough = 1.0001 * refusal.shortfall + 1e-6
        solve_tensions(matrix, wrench, low - enough, high + enough)
        too_little = 0.999 * refusal.shortfall - 1e-6
        with pytest.raises(TensionInfeasible):
            solve_tensions(matrix, wrench, low - too_little, high + too_little)


@settings(max_examples=60)
@given(seed=seeds, cables=cable_counts)
def test_least_norm_is_the_optimum_of_the_quadratic_program_over_tensions(seed, cables):
    """Oracle: the same problem in the tensions themselves, the balance as equalities."""
    matrix, low, high, wrench = feasible_problem(seed, cables)
    wanted = np.random.default_rng(seed + 2).uniform(-20.0, 120.0, cables)
    solution = solve_tensions(matrix, wrench, low, high, reference=wanted)
    if cables == 6:
        np.testing.assert_allclose(solution.tensions, np.linalg.solve(matrix, -wrench), atol=1e-6)
        return
    answer, _, exit_flag, _ = daqp.solve(
        np.eye(cables),
        -wanted,
        matrix.copy(),
        np.concatenate([high, -wrench]),
        np.concatenate([low, -wrench]),
        np.concatenate([np.zeros(cables), np.full(6, 5)]).astype(np.intc),
        primal_tol=1e-9,
    )
    assert exit_flag > 0
    np.testing.assert_allclose(solution.tensions, answer, atol=1e-4)


@given(seed=seeds)
def test_the_order_of_the_cables_only_reorders_the_tensions(seed):
    matrix, low, high, wrench = feasible_problem(seed, 8)
    order = np.random.default_rng(seed).permutation(8)
    one = solve_tensions(matrix, wrench, low, high).tensions
    other = solve_tensions(matrix[:, order], wrench, low[order], high[order]).tensions
    np.testing.assert_allclose(other, one[order], atol=1e-5)


@given(seed=seeds)
def test_rotated_world_axes_leave_the_tensions_alone(seed):
    matrix, low, high, wrench = feasible_problem(seed, 8)
    turn = np.kron(np.eye(2), np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0])
    one = solve_tensions(matrix, wrench, low, high).tensions
    other = solve_tensions(turn @ matrix, turn @ wrench, low, high).tensions
    np.testing.assert_allclose(other, one, atol=1e-5)


def test_tensions_are_continuous_along_a_path_through_the_workspace():
    """Halving the step halves the largest change of a tension; a jump would stay."""

    def largest_change(steps):
        s = np.linspace(0.0, 2.0 * np.pi, steps + 1)
        path = np.stack([0.2 * np.sin(s), 0.2 * np.cos(2 * s), 0.4 + 0.2 * np.sin(3 * s)], axis=-1)
        tensions = [
            solve_tensions(paper_matrix(p), PAPER_WEIGHT, 5.0, 100.0).tensions for p in path
        ]
        return np.abs(np.diff(tensions, axis=0)).max()

    coarse, fine = largest_change(400), largest_change(800)
    assert coarse < 5.0
    assert fine < 0.6 * coarse


def test_tensions_of_ten_cables_are_continuous_in_the_wrench():
    matrix, low, high, wrench = feasible_problem(5, 10)
    other = feasible_problem(5, 10)[0] @ -np.random.default_rng(8).uniform(low, high)

    def largest_change(steps):
        tensions = [
            solve_tensions(matrix, wrench + part * (other - wrench), low, high)
            for part in np.linspace(0.0, 1.0, steps + 1)
        ]
        return np.abs(np.diff([t.tensions for t in tensions], axis=0)).max()

    assert largest_change(200) < 0.6 * largest_change(100)


@settings(max_examples=40)
@given(seed=seeds, cables=cable_counts)
def test_the_last_wrench_that_can_be_held_is_held(seed, cables):
    """On the boundary of the wrench set one tension vector remains; round-off must not lose it."""
    matrix, low, high, _ = feasible_problem(seed, cables)
    away = np.random.default_rng(seed).normal(size=6)
    only = np.where(away @ matrix > 0.0, high, low)
    solution = solve_tensions(matrix, -matrix @ only, low, high)
    assert solution.bound_violation == 0.0
    assert np.abs(solution.wrench_residual).max() < 1e-5


def test_feasibility_and_capacity_margin_agree_along_a_path_out_of_the_workspace():
    for z in np.linspace(0.2, 1.2, 60):
        matrix = paper_matrix((0.3, 0.2, z))
        box = WrenchBox.of_one(PAPER_WEIGHT)
        margin = float(capacity_margin(matrix, 5.0, 100.0, box, PAPER_LENGTH))
        try:
            solve_tensions(matrix, PAPER_WEIGHT, 5.0, 100.0)
        except TensionInfeasible:
            assert margin < 1e-6
        else:
            assert margin > -1e-6


def test_an_overload_names_the_cables_and_the_missing_newtons():
    with pytest.raises(TensionInfeasible, match=r"relaxed by [\d.]+ N") as refusal:
        solve_tensions(paper_matrix(), 100.0 * PAPER_WEIGHT, 1.0, 100.0)
    upper, lower = set(range(4)), set(range(4, 8))
    assert refusal.value.at_largest
    assert set(refusal.value.at_largest) <= upper
    assert set(refusal.value.at_smallest) <= lower
    first = refusal.value.at_largest[0] + 1
    assert str(first) in refusal.value.why
    assert refusal.value.values["shortfall_n"] == refusal.value.shortfall
    assert refusal.value.exit_code == 3
    assert isinstance(refusal.value, CdprError)


@pytest.mark.parametrize(
    ("share", "advice"),
    [(0.01, "lower the smallest tensions, add weight"), (100.0, "lower the load, raise the large")],
)
def test_the_advice_is_to_change_the_limits_that_bind(share, advice):
    """Below a ceiling less load makes a light platform's case worse."""
    matrix = random_matrix(4, 8, suspended=True)
    with pytest.raises(TensionInfeasible) as refusal:
        solve_tensions(matrix, share * -matrix @ np.full(8, 30.0), 5.0, 100.0)
    assert refusal.value.next_step.startswith(advice)


@pytest.mark.parametrize("matrix", [flat_matrix(), paper_matrix()[:, :5], np.zeros((6, 8))])
def test_a_singular_pose_is_infeasible_even_without_load(matrix):
    with pytest.raises(TensionInfeasible, match="singular") as refusal:
        solve_tensions(matrix, np.zeros(6), 1.0, 100.0)
    assert refusal.value.shortfall == np.inf


def test_equal_limits_leave_that_tension_or_nothing():
    """A cable held at one tension by force control."""
    matrix = paper_matrix()
    free = solve_tensions(matrix, PAPER_WEIGHT, 5.0, 100.0, reference=50.0).tensions
    low, high = np.full(8, 5.0), np.full(8, 100.0)
    low[2] = high[2] = free[2] - 3.0
    solution = solve_tensions(matrix, PAPER_WEIGHT, low, high)
    assert solution.tensions[2] == free[2] - 3.0
    assert np.abs(solution.wrench_residual).max() < 1e-7


@pytest.mark.parametrize("others", [6, 7])
def test_a_cable_that_alone_acts_in_a_direction_has_its_tension_fixed(others):
    """No null-space motion changes it: within its limits it is taken, outside it is refused."""
    matrix = random_matrix(9, others + 1)
    alone = matrix[:, -1] / np.linalg.norm(matrix[:, -1])
    matrix[:, :-1] -= np.outer(alone, alone @ matrix[:, :-1])
    wrench = -matrix @ np.append(np.full(others, 40.0), 60.0)
    tensions = solve_tensions(matrix, wrench, 0.0, 100.0).tensions
    assert tensions[-1] == pytest.approx(60.0)
    too_much = -matrix @ np.append(np.full(others, 40.0), 103.0)
    with pytest.raises(TensionInfeasible) as refusal:
        solve_tensions(matrix, too_much, 0.0, 100.0)
    assert refusal.value.shortfall == pytest.approx(3.0)
    assert refusal.value.at_largest == (others,)
    assert refusal.value.at_smallest == ()


def test_a_reference_within_reach_is_met_exactly():
    balanced = solve_tensions(paper_matrix(), PAPER_WEIGHT, 5.0, 100.0, reference=50.0).tensions
    again = solve_tensions(paper_matrix(), PAPER_WEIGHT, 5.0, 100.0, reference=balanced)
    np.testing.assert_allclose(again.tensions, balanced, atol=1e-10)


def test_unusable_arguments_are_refused():
    matrix = paper_matrix()
    with pytest.raises(BadInput, match="one pose"):
        solve_tensions(np.array([matrix]), PAPER_WEIGHT, 1.0, 9.0)
    with pytest.raises(BadInput, match="t_min is above"):
        solve_tensions(matrix, PAPER_WEIGHT, 9.0, 1.0)
    with pytest.raises(BadInput, match="t_max holds"):
        solve_tensions(matrix, PAPER_WEIGHT, 9.0, np.inf)
    with pytest.raises(BadInput, match="reference has 3"):
        solve_tensions(matrix, PAPER_WEIGHT, 1.0, 9.0, reference=np.ones(3))
    with pytest.raises(BadInput, match="external wrench"):
        solve_tensions(matrix, np.full(6, np.nan), 1.0, 9.0)


def test_a_solution_cannot_be_changed_and_leaves_the_arguments_writeable():
    matrix, wrench, low, high = paper_matrix(), PAPER_WEIGHT.copy(), np.ones(8), np.full(8, 90.0)
    solution = solve_tensions(matrix, wrench, low, high)
    for array in (matrix, wrench, low, high):
        array[0] = 1.0
    for array in (solution.tensions, solution.t_min, solution.structure_matrix):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0.0
    assert np.abs(solution.wrench_residual).max() < 1e-10


@pytest.mark.parametrize(("change", "violation_limit"), [(200.0, 100.0), (-200.0, 5.0)])
def test_a_wrong_solution_shows_its_residual_and_violation(change, violation_limit):
    """The proof is computed from the tensions, not remembered."""
    solution = solve_tensions(paper_matrix(), PAPER_WEIGHT, 5.0, 100.0)
    wrong = replace(solution, tensions=solution.tensions + change * np.eye(8)[0])
    assert np.linalg.norm(wrong.wrench_residual[:3]) == pytest.approx(200.0)
    assert wrong.bound_violation == pytest.approx(abs(wrong.tensions[0] - violation_limit))


def test_two_equal_cables_share_the_load_and_are_blamed_together():
    """Dependent columns span no facet; neither a solution nor a refusal may suffer from it."""
    matrix = random_matrix(21, 7)
    doubled = np.column_stack([matrix, matrix[:, 0]])
    wrench = -matrix @ np.full(7, 40.0)
    tensions = solve_tensions(doubled, wrench, 0.0, 100.0).tensions
    assert tensions[0] == pytest.approx(tensions[7])
    low, high = np.zeros(8), np.full(8, 100.0)
    with pytest.raises(TensionInfeasible) as refusal:
        solve_tensions(doubled, 10.0 * wrench, low, high)
    expected = smallest_relaxation(doubled, low, high, 10.0 * wrench)
    assert refusal.value.shortfall == pytest.approx(expected, rel=1e-6)
    assert {0, 7} <= set(refusal.value.at_largest) or not {0, 7} & set(refusal.value.at_largest)
