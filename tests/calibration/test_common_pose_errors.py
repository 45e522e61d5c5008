"""Rig calibration with pose errors that all poses share, or that are larger than stated."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.random import default_rng

from calibration.geometry.calibrate import RigCalibration, fit_rig, workspace_poses
from calibration.geometry.fit import RigFit, RigFitter
from calibration.geometry.identifiability import (
    Observability,
    identified,
    uncertainty_of_rig,
)
from calibration.geometry.measurements import RigMeasurements
from calibration.geometry.parameters import DEFAULT_DEVIATIONS, Parameters
from calibration.geometry.quality import judge_rig
from model.pose import Array, matrix_from_rotation_vector, read_only
from model.rig import Rig, load_rig
from model.winches import WinchMap
from tests.calibration.synthetic_rig import (
    LENGTH_NOISE,
    POSITION_NOISE,
    TURN_NOISE,
    BuiltRig,
    built_rig,
    measured,
    only,
)

LENGTH, TURN = 1e-3, float(np.radians(0.05))
GEOMETRY = ("outlets", "anchors", "drum_scale", "offsets")
RIGS = range(5)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(Path(__file__).parents[2] / "configs" / "hall_10_6.yaml")


def moved(data: RigMeasurements, shift: Array, turn: Array, askew: Array) -> RigMeasurements:
    """Poses by a camera whose pose is off by a shift [m] and a turn [rad], and by tags askew."""
    middle = data.positions.mean(axis=0)
    turned = matrix_from_rotation_vector(turn)
    return replace(
        data,
        positions=read_only((data.positions - middle) @ turned.T + middle + shift),
        rotations=read_only(matrix_from_rotation_vector(askew) @ turned @ data.rotations),
    )


def by_chance(data: RigMeasurements, seed: int, length: float, turn: float) -> RigMeasurements:
    """The same with random common errors of these deviations."""
    random = np.random.default_rng(seed)
    shift, *turns = random.standard_normal((3, 3))
    return moved(data, length * shift, turn * turns[0], turn * turns[1])


def inside(found: RigCalibration, built: BuiltRig, groups: tuple[str, ...]) -> list[bool]:
    """Which of the numbers of some groups lie in their intervals."""
    slices, half_widths = found.parameters.slices(), found.uncertainty.half_widths
    off = {g: np.abs(found.fit.values[slices[g]] - built.off[g]) for g in groups}
    return [bool(hit) for g in groups for hit in off[g] < half_widths[slices[g]]]


@cache
def calibrated(rig: Rig, seed: int, kind: str) -> tuple[RigCalibration, BuiltRig]:
    """A rig with common errors, which are stated unless ``kind`` is ``hidden``."""
    built = built_rig(rig, seed, alike=True)
    data = measured(built, 60, 100 + seed)
    data = replace(data, swivels=np.empty((0, 0)), verticals=np.empty((0, 0)))
    errors = {"shift": (LENGTH, 0.0), "turn": (0.0, TURN)}.get(kind, (LENGTH, TURN))
    if kind != "none":
        data = by_chance(data, 200 + seed, *errors)
    stated = data if kind == "hidden" else data.with_added_deviation(*errors)
    return fit_rig(rig, stated, DEFAULT_DEVIATIONS, LENGTH_NOISE), built


@pytest.mark.parametrize("kind", ["none", "shift", "turn", "both"])
def test_intervals_hold_the_truth_with_stated_common_errors(rig: Rig, kind: str) -> None:
    found = [calibrated(rig, seed, kind) for seed in RIGS]
    hits = [hit for one, built in found for hit in inside(one, built, GEOMETRY)]
    assert np.mean(hits) >= 0.93
    offsets = [hit for one, built in found for hit in inside(one, built, ("offsets",))]
    assert np.mean(offsets) >= 0.8  # few errors move all of a rig's offsets


def test_a_common_error_that_is_not_stated_is_in_no_interval(rig: Rig) -> None:
    found = [calibrated(rig, seed, "hidden") for seed in RIGS]
    hits = [hit for one, built in found for hit in inside(one, built, ("offsets",))]
    assert np.mean(hits) < 0.8


def test_a_common_displacement_of_a_millimetre_is_not_good_for_one(rig: Rig) -> None:
    """The platform is where the measured poses say, displaced by all of it."""
    found, _ = calibrated(rig, 0, "shift")
    level, common, _ = found.position_errors(*workspace_poses(rig, 0.0))
    assert common == pytest.approx(2.8 * LENGTH, rel=0.05)  # 95 % of three equal axes
    assert np.all(level > common)
    verdict = judge_rig(found, LENGTH, np.radians(5.0)).verdict
    assert not verdict.good
    assert verdict.error > 2.7 * LENGTH
    assert any("--pose-mm" in step for step in verdict.next_steps)
    assert not any("more poses" in step for step in verdict.next_steps)


def test_more_samples_do_not_reduce_a_common_error(rig: Rig) -> None:
    built = built_rig(rig, 1, alike=True)
    parts = []
    for count in (40, 80):
        data = measured(built, count, 5).with_added_deviation(LENGTH, 0.0)
        parameters = Parameters.of(rig, DEFAULT_DEVIATIONS)
        fit, observability = identified(parameters, data, LENGTH_NOISE)
        found = uncertainty_of_rig(parameters, data, fit, observability)
        parts.append(float(np.linalg.norm(found.common)))
    assert parts[1] == pytest.approx(parts[0], rel=0.1)


@pytest.fixture(scope="module")
def thirty(rig: Rig) -> tuple[RigMeasurements, RigFit, Observability]:
    """Samples with stated common errors, and their fit."""
    data = measured(built_rig(rig, 2, alike=True), 30, 6).with_added_deviation(LENGTH, TURN)
    return data, *identified(Parameters.of(rig, DEFAULT_DEVIATIONS), data, LENGTH_NOISE)


@pytest.mark.parametrize("error", range(9))
def test_the_change_by_a_common_error_is_that_of_a_fit_with_it(
    rig: Rig, thirty: tuple[RigMeasurements, RigFit, Observability], error: int
) -> None:
    parameters, (data, fit, observability) = Parameters.of(rig, DEFAULT_DEVIATIONS), thirty
    stated = uncertainty_of_rig(parameters, data, fit, observability).common[:, error]
    unit = np.eye(9)[error]
    there = moved(data, LENGTH * unit[:3], TURN * unit[3:6], TURN * unit[6:])
    again = RigFitter(parameters, there, LENGTH_NOISE).fit(observability.known)
    changes = (again.values - fit.values) / parameters.deviations
    expected = stated / parameters.deviations
    settled = 0.08  # of fits that end at a relative gain of 1e-6
    assert np.linalg.norm(expected) > 3.0 * settled
    assert np.linalg.norm(changes - expected) < 0.03 * np.linalg.norm(expected) + settled


def test_poses_that_were_not_measured_share_no_error(rig: Rig) -> None:
    data = measured(built_rig(rig, 3), 12, 7).with_added_deviation(LENGTH, TURN)
    assert not data.without_poses().common_errors.any()
    points = replace(data, rotations=np.full_like(data.rotations, np.nan)).common_errors
    assert points[:, :, 3:] == pytest.approx(0.0)
    assert points[0, :3, :3] == pytest.approx(LENGTH * np.eye(3))
    assert data.part(np.arange(12) < 5).common_errors.shape == (5, 6, 9)


@cache
def scattered(rig: Rig, seed: int, position: float, turn: float, length: float) -> RigCalibration:
    """The calibration of a rig with noise that is larger than stated, by these factors.

    Args:
        rig: As in its file.
        seed: Of the rig and the noise.
        position: Of the measured positions.
        turn: Of the measured rotations.
        length: Of the cable lengths.
    """
    data, rng = only(measured(built_rig(rig, seed, alike=True), 40, 100 + seed)), default_rng(seed)
    added = np.sqrt(np.square([position, turn, length]) - 1.0)
    shifts, turns = rng.standard_normal((2, *data.positions.shape))
    paid_out = WinchMap(rig).counts_per_metre * rng.standard_normal(data.counts.shape)
    rotated = [matrix_from_rotation_vector(v) for v in added[1] * TURN_NOISE * turns]
    data = replace(
        data,
        positions=read_only(data.positions + added[0] * POSITION_NOISE * shifts),
        rotations=read_only(np.array(rotated) @ data.rotations),
        counts=read_only(data.counts + added[2] * LENGTH_NOISE * paid_out),
    )
    return fit_rig(rig, data, DEFAULT_DEVIATIONS, LENGTH_NOISE)


def test_poses_that_scatter_more_than_stated_are_weighted_and_reported(rig: Rig) -> None:
    """Ten cables follow the lengths: only the poses themselves show it."""
    there, shares = workspace_poses(rig, 0.0), []
    for seed in RIGS:
        found = scattered(rig, seed, 5.0, 1.0, 1.0)
        assert found.pose_scales == pytest.approx([5.0, 1.0], rel=0.25)
        truth = built_rig(rig, seed, alike=True).values(found.parameters.groups)
        as_built = replace(found, fit=replace(found.fit, values=truth))
        off = np.linalg.norm(found.reached(*there) - as_built.reached(*there), axis=1)
        shares.append(off / found.position_errors(*there)[0])
    # Errors of equal deviation along all three axes; less where they differ.
    assert np.sqrt(np.mean(np.square(shares))) <= np.sqrt(3.0) / 1.96
    quality = judge_rig(found, LENGTH, 0.0)
    assert any("measured positions scatter" in why for why in quality.verdict.reasons)
    assert not any("measured rotations" in why for why in quality.verdict.reasons)


def test_poses_are_weighted_as_stated_where_they_do_not_scatter_more(rig: Rig) -> None:
    """Neither by chance nor where the lengths scatter, which the residuals show."""
    for seed in RIGS:
        assert scattered(rig, seed, 1.0, 1.0, 1.0).pose_scales == pytest.approx(1.0)
    found = scattered(rig, 0, 1.0, 1.0, 5.0)
    reasons = judge_rig(found, LENGTH, 0.0).verdict.reasons
    assert not any("measured positions" in why for why in reasons)


def test_the_scatter_of_poses_widens_the_intervals(rig: Rig) -> None:
    """Residuals of ten cables do not show it."""
    found = scattered(rig, 0, 5.0, 1.0, 1.0)
    stated = found.measured.with_scaled_deviations(1.0 / found.pose_scales)
    fit, observability = identified(found.parameters, stated, LENGTH_NOISE)
    no_misfits = replace(fit, pose_misfits=np.zeros_like(fit.pose_misfits))
    scatters = [
        uncertainty_of_rig(found.parameters, stated, one, observability).scatter
        for one in (fit, no_misfits)
    ]
    assert scatters[0] > 2.0
    assert scatters[1] == 1.0
