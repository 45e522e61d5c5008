"""A run is stopped and fails if an obstacle is too near even at the upper bound of its clearance.

Here this is evaluated obstacle by obstacle; an uncertain one must not hide a certain one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from executor.recording.clearance import ClearanceRow, clearance_table
from executor.recording.verdict import distances
from model.clearance import Nearest
from tracking.clearance import NEAR_IMAGES, ClearanceMonitor, MeasuredClearance

#: Clearance required by the scene, [mm].
LIMIT_MM = 20.0

#: Distance and uncertainty of each obstacle, [mm].
OBSTACLES = st.lists(
    st.tuples(st.floats(-5.0, 60.0), st.floats(0.5, 40.0)), min_size=1, max_size=4
).filter(lambda each: all(abs(d + u - LIMIT_MM) > 1e-3 for d, u in each))


def nearest(distances_mm: list[float]) -> tuple[Nearest, ...]:
    nowhere = np.zeros(3)
    return tuple(
        Nearest("platform", f"post {i}", d / 1e3, nowhere, nowhere)
        for i, d in enumerate(distances_mm)
    )


def measured(obstacles_mm: list[tuple[float, float]]) -> MeasuredClearance:
    uncertainties = np.array([u / 1e3 for _, u in obstacles_mm])
    return MeasuredClearance(nearest([d for d, _ in obstacles_mm]), uncertainties)


def certainly_too_near(obstacles_mm: list[tuple[float, float]]) -> bool:
    return any(d + u < LIMIT_MM for d, u in obstacles_mm)


@given(obstacles_mm=OBSTACLES)
@example(obstacles_mm=[(10.0, 1.0), (30.0, 30.0)])
@example(obstacles_mm=[(10.0, 15.0), (12.0, 1.0)])
def test_the_run_stops_exactly_when_one_obstacle_is_certainly_too_near(
    obstacles_mm: list[tuple[float, float]],
) -> None:
    watch = ClearanceMonitor(LIMIT_MM / 1e3)
    told = [watch.take(measured(obstacles_mm)) for _ in range(NEAR_IMAGES)]
    assert not any(told[:-1])
    assert bool(told[-1]) is certainly_too_near(obstacles_mm)


def test_the_pair_that_is_certainly_too_near_is_named() -> None:
    """Here the platform is nearest, but its distance is less certain than that of a cable."""
    (platform,) = nearest([10.0])
    cable = replace(platform, first="cable 5", distance=0.012)
    clearance = MeasuredClearance((platform,), np.array([0.02]), ((cable, 0.001),))
    watch = ClearanceMonitor(LIMIT_MM / 1e3)
    told = [watch.take(clearance) for _ in range(NEAR_IMAGES)]
    assert told[-1].startswith("cable 5 to post 0: 12.0 ± 1.0 mm")


@given(obstacles_mm=OBSTACLES)
@example(obstacles_mm=[(10.0, 1.0), (30.0, 30.0)])
@example(obstacles_mm=[(10.0, 15.0), (12.0, 1.0)])
def test_the_verdict_is_that_of_the_obstacle_that_is_certainly_too_near(
    obstacles_mm: list[tuple[float, float]],
) -> None:
    row = ClearanceRow.at(1.0, "tag", measured(obstacles_mm), nearest([d for d, _ in obstacles_mm]))
    names = tuple(f"post {i}" for i in range(len(obstacles_mm)))
    required, against_plan = distances(clearance_table(names, [row]), LIMIT_MM / 1e3)
    assert required.passed is not certainly_too_near(obstacles_mm)
    assert against_plan.passed


def test_nearer_than_planned_counts_the_upper_side_too() -> None:
    found = measured([(30.0, 1.0), (50.0, 40.0)])  # planned at 35 mm, at most 31 mm truly
    row = ClearanceRow.at(1.0, "tag", found, nearest([35.0, 50.0]))
    _, against_plan = distances(clearance_table(("post 0", "post 1"), [row]), LIMIT_MM / 1e3)
    assert not against_plan.passed
    assert "its 95 % interval ends at 31.00 mm" in against_plan.text


def test_the_message_names_the_obstacle_that_is_certainly_too_near() -> None:
    watch = ClearanceMonitor(LIMIT_MM / 1e3)
    message = [watch.take(measured([(10.0, 15.0), (12.0, 1.0)])) for _ in range(2)][-1]
    assert message == "platform to post 1: 12.0 ± 1.0 mm (95 % interval); the scene requires 20 mm"


@given(obstacles_mm=OBSTACLES, shares=st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4))
def test_the_smallest_true_distance_is_within_both_sides(
    obstacles_mm: list[tuple[float, float]], shares: list[float]
) -> None:
    found = measured(obstacles_mm)
    truly = min(d + s * u for (d, u), s in zip(obstacles_mm, shares, strict=False)) / 1e3
    assert truly <= found.at_most + 1e-12
    assert truly >= found.distance - found.uncertainty - 1e-12
    assert found.at_most == pytest.approx(min(d + u for d, u in obstacles_mm) / 1e3)
