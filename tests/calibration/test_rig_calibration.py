"""A rig's parameters from stationary samples, against the simulation's ground truth."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calibration.geometry.calibrate import (
    RigCalibration,
    _require_within,
    _sent_to,
    fit_rig,
    workspace_poses,
)
from calibration.geometry.fit import RigFitter
from calibration.geometry.identifiability import (
    Observability,
    identified,
    sentences,
    uncertainty_of_rig,
)
from calibration.geometry.measurements import (
    Recording,
    RigMeasurements,
    at_rest,
    joined,
)
from calibration.geometry.model import (
    CountedLengths,
    RigModel,
    nominal_tensions,
    tension_sigma,
)
from calibration.geometry.parameters import DEFAULT_DEVIATIONS, Parameters, rig_with
from calibration.geometry.quality import (
    estimate_cable_compliances,
    estimate_compliance,
    judge_rig,
)
from calibration.geometry.report import number_rows, rig_page
from calibration.geometry.result import RigResult, require_same_nominal, rig_result
from calibration.result_files import load_result
from model.errors import BadInput, InvalidFile
from model.files.rig_file import RigDocument
from model.kinematics import settled_poses_near
from model.pose import Array, Pose, matrix_from_rotation_vector, moved, rotation_vector_from_matrix
from model.rig import Rig, load_rig, rig_from_document
from model.statics.gravity import working_tensions
from model.winches import WinchMap
from tests.calibration.rig_places import (
    Truth,
    rig_with_errors,
    samples,
    share_inside,
    true_numbers,
    with_nominal_stiffness,
)
from tests.model.test_forward_kinematics import nearest_step

ROOT = Path(__file__).resolve().parents[2]
LENGTH_DEVIATION = 0.1e-3
TODAY = date(2026, 3, 14)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(ROOT / "configs/gachon_8_6_rehearsal.yaml")


@pytest.fixture(scope="module")
def tilted(rig: Rig) -> Truth:
    return samples(rig, 60, tilt=np.radians(8.0), seed=1)


@pytest.fixture(scope="module")
def level(rig: Rig) -> Truth:
    return samples(rig, 60, tilt=0.0, seed=2)


@pytest.fixture(scope="module")
def found(rig: Rig, tilted: Truth) -> RigCalibration:
    return fit_rig(rig, tilted.measured, DEFAULT_DEVIATIONS, LENGTH_DEVIATION)


@pytest.fixture(scope="module")
def found_level(rig: Rig, level: Truth) -> RigCalibration:
    return fit_rig(rig, level.measured, DEFAULT_DEVIATIONS, LENGTH_DEVIATION)


def positions_by(rig: Rig, truth: Truth) -> Array:
    """Platform positions by forward kinematics of a rig with its own winches, (n, 3), [m]."""
    winches, data = WinchMap(rig), truth.measured
    lengths = winches.strained(winches.unstrained_from_counts(data.counts), data.tensions)
    return settled_poses_near(rig, lengths, truth.positions, truth.rotations)[0]


def errors_of(rig: Rig, truth: Truth) -> Array:
    """Errors of these positions, shape (n,), [m]."""
    return np.asarray(np.linalg.norm(positions_by(rig, truth) - truth.positions, axis=1))


def errors_of_shape(rig: Rig, truth: Truth) -> Array:
    """The same after the best-fitting rigid motion of all positions, (n,), [m]."""
    commanded = positions_by(rig, truth)
    centres = commanded.mean(axis=0), truth.positions.mean(axis=0)
    turn, _ = Rotation.align_vectors(truth.positions - centres[1], commanded - centres[0])
    moved = turn.apply(commanded - centres[0]) + centres[1]
    return np.asarray(np.linalg.norm(moved - truth.positions, axis=1))


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


@given(seed=st.integers(0, 10**6))
@settings(max_examples=6)
@pytest.mark.parametrize("name", ["gachon_8_6_rehearsal", "hall_10_6"])
def test_derivatives_are_those_of_finite_differences(name: str, seed: int) -> None:
    """All groups, point exits and pulleys, stretched cables."""
    rig = load_rig(ROOT / f"configs/{name}.yaml")
    random = np.random.default_rng(seed)
    parameters = Parameters.of(rig, DEFAULT_DEVIATIONS)
    m, span = rig.cable_count, rig.workspace_upper - rig.workspace_lower
    data = RigMeasurements(
        names=("a", "b"),
        counts=random.uniform(-1e5, 1e5, (2, m)),
        tensions=random.uniform(5.0, 100.0, (2, m)),
        positions=rig.workspace_lower + random.uniform(0.2, 0.8, (2, 3)) * span,
        rotations=np.array([matrix_from_rotation_vector(random.normal(0, 0.1, 3))] * 2),
        covariances=np.tile(np.eye(6), (2, 1, 1)),
    )
    model = RigModel(parameters, data)
    values = parameters.deviations * random.normal(0.0, 1.0, len(parameters))
    at = (data.positions, data.rotations)
    line, step = model.linearised(values, *at), 1e-6
    for k in range(len(parameters)):
        nudge = np.zeros(len(parameters))
        nudge[k] = step
        change = model.residuals(values + nudge, *at) - model.residuals(values - nudge, *at)
        assert line.by_values[:, :, k] == pytest.approx(change / (2.0 * step), abs=2e-6)
    for k in range(3):
        shift, turn = np.zeros(3), np.zeros(3)
        shift[k] = turn[k] = step
        forth, back = matrix_from_rotation_vector(turn), matrix_from_rotation_vector(-turn)
        moved = model.residuals(values, at[0] + shift, at[1])
        change = moved - model.residuals(values, at[0] - shift, at[1])
        assert line.by_pose[:, :, k] == pytest.approx(change / (2.0 * step), abs=2e-6)
        moved = model.residuals(values, at[0], forth @ at[1])
        change = moved - model.residuals(values, at[0], back @ at[1])
        assert line.by_pose[:, :, 3 + k] == pytest.approx(change / (2.0 * step), abs=2e-6)


def test_the_fit_is_the_one_that_scipy_finds(rig: Rig, tilted: Truth) -> None:
    """One dense problem in another solver; without outliers, so plain least squares."""
    data = tilted.measured.part(np.arange(60) < 12)
    parameters = Parameters.of(rig, DEFAULT_DEVIATIONS)
    fit = RigFitter(parameters, data, LENGTH_DEVIATION).fit()
    model, n, p = RigModel(parameters, data), len(data), len(parameters)
    scale = np.sqrt(np.diagonal(data.covariances, axis1=1, axis2=2))

    def residuals(x: Array) -> Array:
        twists = x[p:].reshape(n, 6) * scale
        turns = np.array([matrix_from_rotation_vector(t) for t in twists[:, 3:]])
        at = (data.positions + twists[:, :3], turns @ data.rotations)
        cables = model.residuals(parameters.deviations * x[:p], *at) / LENGTH_DEVIATION
        return np.concatenate([x, cables.ravel()])

    other = least_squares(residuals, np.zeros(p + 6 * n), x_scale="jac", xtol=1e-14, ftol=1e-14)
    assert np.abs(fit.residuals / LENGTH_DEVIATION).max() < 3.0
    assert fit.values / parameters.deviations == pytest.approx(other.x[:p], abs=2e-3)


def test_the_error_at_unmeasured_poses_falls_by_a_factor_of_ten(
    rig: Rig, found: RigCalibration
) -> None:
    quality = judge_rig(found, 1e-3, np.radians(5.0))
    result = rig_result(found, quality, "rig", TODAY)
    others = samples(rig, 40, tilt=np.radians(8.0), seed=9)
    corrected = rig.with_calibration(result)
    before, after = rms(errors_of(rig, others)), rms(errors_of(corrected, others))
    assert before > 1e-3
    assert after < 0.3e-3
    assert after < before / 10.0
    assert quality.held_out == pytest.approx(np.sqrt(3) * 0.2e-3, rel=0.4)  # the poses' own noise
    assert quality.before > 1e-3
    assert quality.verdict.good


@pytest.mark.parametrize("stiffness", [4000.0, 6000.0, 10000.0])
def test_intervals_hold_the_truth_about_as_often_as_they_say(rig: Rig, stiffness: float) -> None:
    """The cables have 6000 N, whatever the rig file states."""
    built = rig_with_errors(rig, seed=11)
    data = samples(built, 60, tilt=np.radians(8.0), seed=12).measured
    drawn = with_nominal_stiffness(built, stiffness)
    result = fit_rig(drawn, data, DEFAULT_DEVIATIONS, LENGTH_DEVIATION)
    true = true_numbers(built)
    assert len(true) == 57
    assert share_inside(result.intervals, true) >= 0.9
    assert result.rig.cable_stiffness == pytest.approx(stiffness)
    assert abs(result.intervals["stiffness_n"].value - 6000.0) < 600.0


def test_a_stiffness_that_is_found_is_applied(rig: Rig, tilted: Truth) -> None:
    """The rig file states 1.5 times the stiffness of the cables."""
    drawn = with_nominal_stiffness(rig, 9000.0)
    result = fit_rig(drawn, tilted.measured, DEFAULT_DEVIATIONS, LENGTH_DEVIATION)
    document = rig_result(result, judge_rig(result, 1e-3, 0.0), "rig", TODAY)
    corrected = drawn.with_calibration(document)
    assert corrected.cable_stiffness == pytest.approx(result.geometry.stiffness)
    assert document.stiffness_n == pytest.approx(result.geometry.stiffness)
    low, high = document.intervals["stiffness_n"]
    assert low * high == pytest.approx(document.stiffness_n**2)
    estimate = document.stated["stiffness_n"]
    assert estimate.value == document.stiffness_n
    assert estimate.bounds == pytest.approx([low, high])
    assert dict(document.in_words())["stiffness_n"] == str(result.intervals["stiffness_n"])
    scaled = {name: [1.5 * end for end in ends] for name, ends in document.intervals.items()}
    stiffer = document.model_copy(update={"stiffness_n": 1.5 * estimate.value, "intervals": scaled})
    assert document.changes_to(stiffer)["stiffness_n"] == pytest.approx(0.5 * estimate.value)
    others = samples(rig, 20, tilt=0.1, seed=4)
    assert rms(errors_of(corrected, others)) < 0.3e-3


def test_without_tensions_the_stiffness_stays_as_drawn_and_is_named(
    rig: Rig, tilted: Truth
) -> None:
    blind = replace(tilted.measured, tensions=np.full_like(tilted.measured.tensions, np.nan))
    result = fit_rig(rig, blind, DEFAULT_DEVIATIONS, LENGTH_DEVIATION)
    assert result.geometry.stiffness == pytest.approx(rig.cable_stiffness, rel=1e-12)
    assert "the stiffness of the cables" in result.not_identified
    ends = result.intervals["stiffness_n"].bounds
    width = 0.2 * 2.0  # Student's factor of 59
    assert ends == pytest.approx([6000.0 * np.exp(-width), 6000.0 * np.exp(width)], rel=0.01)
    assert result.intervals["stiffness_n"].value == pytest.approx(6000.0)
    (row,) = (row for row in number_rows(result) if row[0] == "stiffness_n")
    assert (row[1:4], row[5]) == (("6000", "6000", "+0"), "no")
    assert share_inside(result.intervals, true_numbers(rig)) >= 0.9
    verdict = judge_rig(result, 10e-3, 0.0).verdict
    assert not verdict.good
    assert verdict.reasons[0].startswith("tensions were not measured at 60 poses")
    assert "; with measured tensions it is 0.1 mm" in verdict.reasons[0]
    assert any("tension_1_n" in step for step in verdict.next_steps)


def test_without_tensions_cables_that_hardly_stretch_are_as_certain(
    rig: Rig, tilted: Truth
) -> None:
    stiff = with_nominal_stiffness(rig, 1e6)
    blind = replace(tilted.measured, tensions=np.full_like(tilted.measured.tensions, np.nan))
    model = RigModel(Parameters.of(stiff, DEFAULT_DEVIATIONS), blind)
    deviations = model.length_deviations(LENGTH_DEVIATION)
    assert deviations == pytest.approx(LENGTH_DEVIATION, rel=0.01)
    assert deviations.min() > LENGTH_DEVIATION
    soft = RigModel(Parameters.of(rig, DEFAULT_DEVIATIONS), blind)
    assert soft.length_deviations(LENGTH_DEVIATION).min() > 5.0 * LENGTH_DEVIATION
    measured = RigModel(Parameters.of(rig, DEFAULT_DEVIATIONS), tilted.measured)
    assert np.all(measured.length_deviations(LENGTH_DEVIATION) == LENGTH_DEVIATION)


def test_missing_tensions_are_the_working_ones_of_their_pose(rig: Rig, tilted: Truth) -> None:
    tensions = tilted.measured.tensions.copy()
    tensions[0, 2], tensions[1], tensions[2] = np.nan, np.nan, np.nan
    positions = tilted.measured.positions.copy()
    positions[2] = np.nan
    data = replace(tilted.measured, tensions=tensions, positions=positions)
    likely = nominal_tensions(rig, data)
    pose = Pose(positions[1], data.rotations[1])
    assert np.array_equal(likely[1], working_tensions(rig, pose).tensions)
    assert np.array_equal(likely[2], working_tensions(rig, rig.home).tensions)
    assert np.isfinite(likely[0, 2])
    assert np.array_equal(np.delete(likely[0], 2), np.delete(tensions[0], 2))
    assert np.array_equal(likely[3:], tensions[3:])
    assert np.abs(likely - tilted.measured.tensions).max() < 3.0 * tension_sigma(rig)


def test_missing_tensions_are_those_of_the_platform_not_of_its_reflector(
    rig: Rig, tilted: Truth
) -> None:
    level = replace(
        tilted.measured,
        tensions=np.full_like(tilted.measured.tensions, np.nan),
        rotations=np.full_like(tilted.measured.rotations, np.nan),
    )
    reflector = np.array([0.02, -0.03, 0.09])
    points = level.positions + rig.home.rotation @ reflector
    followed = replace(level, positions=points, reflectors=reflector)
    np.testing.assert_allclose(nominal_tensions(rig, followed), nominal_tensions(rig, level))


def test_the_change_without_a_sample_is_that_of_a_fit_without_it(rig: Rig, tilted: Truth) -> None:
    """The first-order jackknife against twenty fits."""
    data = tilted.measured.part(np.arange(60) < 20)
    parameters = Parameters.of(rig, DEFAULT_DEVIATIONS)
    fit, observability = identified(parameters, data, LENGTH_DEVIATION)
    known = observability.known
    found = uncertainty_of_rig(parameters, data, fit, observability)
    rests = [data.part(np.arange(20) != k) for k in range(20)]
    changes = np.array(
        [RigFitter(parameters, rest, LENGTH_DEVIATION).fit(known).values for rest in rests]
    )
    apart = (changes - changes.mean(axis=0)) / parameters.deviations @ known
    by_drawing = np.linalg.inv(known.T @ fit.information @ known + np.eye(known.shape[1]))
    expected = 19.0 / 20.0 * apart.T @ apart + by_drawing @ by_drawing
    stated = found.by_jackknife / np.outer(parameters.deviations, parameters.deviations)
    stated = known.T @ stated @ known
    assert np.diag(stated) == pytest.approx(np.diag(expected), rel=0.05)


def test_correlated_errors_within_samples_widen_the_intervals(rig: Rig, tilted: Truth) -> None:
    """Pose errors ten times as stated: cables of a sample agree about a wrong pose."""
    random = np.random.default_rng(8)
    shaken = tilted.measured.positions + 2e-3 * random.standard_normal((60, 3))
    data = replace(tilted.measured, positions=shaken)
    result = fit_rig(rig, data, DEFAULT_DEVIATIONS, LENGTH_DEVIATION)
    assert result.pose_scales == pytest.approx([10.0, 1.0], rel=0.2)
    assert share_inside(result.intervals, true_numbers(rig)) >= 0.9


def test_without_rotation_it_names_what_is_unidentified_and_keeps_it_nominal(
    rig: Rig, found_level: RigCalibration
) -> None:
    """Without rotation, a cable determines only the sum of outlet and anchor errors."""
    assert found_level.observability.unknown.shape[1] == 24
    assert found_level.not_identified == [
        "outlet and anchor of one cable moved together: every cable along x, y and z"
    ]
    spread = found_level.parameters.deviations
    moved = found_level.fit.values / spread
    assert np.abs(found_level.observability.unknown.T @ moved).max() < 1e-9
    rotated_quality = judge_rig(found_level, 0.5e-3, np.radians(15.0))
    assert rotated_quality.rotated > 2.0 * rotated_quality.level
    assert not rotated_quality.verdict.good
    assert any("rotated" in step for step in rotated_quality.verdict.next_steps)


def test_one_badly_measured_cable_does_not_spoil_the_rest(rig: Rig, tilted: Truth) -> None:
    """Two of sixty samples with a cable 5 mm and a pose 20 mm off: listed and left out."""
    data = tilted.measured
    counts, positions = data.counts.copy(), data.positions.copy()
    counts[7, 3] += 0.005 * rig.winches[3].counts_per_metre
    positions[20] += [0.02, 0.0, 0.0]
    spoiled = replace(data, counts=counts, positions=positions)
    result = fit_rig(rig, spoiled, DEFAULT_DEVIATIONS, LENGTH_DEVIATION)
    quality = judge_rig(result, 1e-3, 0.0)
    assert quality.verdict.good
    document = rig_result(result, quality, "rig", TODAY)
    assert set(document.unused) == {"sample 7", "sample 20"}
    assert "cable 4 is" in document.unused["sample 7"]
    assert "pose is" in document.unused["sample 20"]
    assert document.places == 58
    corrected = rig.with_calibration(document)
    assert rms(errors_of(corrected, samples(rig, 20, tilt=0.1, seed=4))) < 0.3e-3
    untouched = fit_rig(
        rig, data.part(~np.isin(np.arange(60), [7, 20])), DEFAULT_DEVIATIONS, LENGTH_DEVIATION
    )
    assert result.uncertainty.half_widths == pytest.approx(untouched.uncertainty.half_widths)


def test_lengths_alone_make_cables_agree_and_report_the_world_as_unknown(
    rig: Rig, tilted: Truth
) -> None:
    """Without a camera: eight lengths of a pose with six degrees of freedom must agree."""
    alone = tilted.measured.without_poses()
    result = fit_rig(rig, alone, DEFAULT_DEVIATIONS, LENGTH_DEVIATION)
    quality = judge_rig(result, 1e-3, 0.0)
    assert not result.held_out.poses
    assert quality.held_out < quality.before / 10.0
    assert any("all outlets" in line for line in result.not_identified)
    assert not quality.verdict.good
    assert any("with a camera" in step for step in quality.verdict.next_steps)
    corrected = rig.with_calibration(rig_result(result, quality, "rig", TODAY))
    assert rms(errors_of_shape(corrected, tilted)) < 0.9 * rms(errors_of_shape(rig, tilted))


def test_groups_that_are_known_stay_as_drawn(rig: Rig, tilted: Truth) -> None:
    only = {"drum_scale": 0.005, "offsets": 2e-3}
    result = fit_rig(rig, tilted.measured, only, LENGTH_DEVIATION)
    assert np.array_equal(result.geometry.outlets, rig.outlets)
    assert result.parameters.groups == ("drum_scale", "offsets")
    assert set(result.intervals) == {
        *(f"drum_{i}_mm_per_rev" for i in range(1, 9)),
        *(f"offset_{i}_mm" for i in range(1, 9)),
    }


def test_pulleys_are_estimated_only_if_the_rig_has_them(rig: Rig) -> None:
    hall = load_rig(ROOT / "configs/hall_10_6.yaml")
    assert "pulley_radius" in Parameters.of(hall, DEFAULT_DEVIATIONS).names
    assert "pulley_radius" not in Parameters.of(rig, DEFAULT_DEVIATIONS).names


def test_a_rig_with_pulleys_is_more_accurate_than_by_its_file() -> None:
    """Another rig: ten cables, with a pulley radius that differs from the file."""
    drawn = load_rig(ROOT / "configs/hall_10_6.yaml")
    document, random = drawn.document.model_dump(mode="json"), np.random.default_rng(3)
    m = drawn.cable_count
    shifted = np.array(document["outlets_mm"]) + 2.0 * random.standard_normal((m, 3))
    document["cables"]["stiffness_n"] = 40000
    document["simulation"] = {
        "as_built": {
            "outlets_mm": shifted.tolist(),
            "anchors_mm": document["anchors_mm"],
            "drums_mm_per_rev": [w["drum_mm_per_rev"] * 1.003 for w in document["winches"]],
            "home_counts": [0.0] * m,
            "pulley_radius_mm": document["pulleys"]["radius_mm"] + 0.8,
        }
    }
    hall = rig_from_document(RigDocument.model_validate(document))
    data = samples(hall, 40, tilt=0.12, seed=1).measured
    result = fit_rig(hall, data, DEFAULT_DEVIATIONS, LENGTH_DEVIATION)
    corrected = hall.with_calibration(
        rig_result(result, judge_rig(result, 1e-3, 0.0), "hall", TODAY)
    )
    others = samples(hall, 20, tilt=0.12, seed=2, noise=0.0)
    assert rms(errors_of(corrected, others)) < 0.3 * rms(errors_of(hall, others))
    radius = result.intervals["pulley_radius_mm"]
    assert abs(radius.value - 40.8) < radius.half_width


def test_unknown_directions_without_a_name_are_listed_by_their_largest_parts(rig: Rig) -> None:
    parameters = Parameters.of(rig, {"outlets": 1e-3, "offsets": 1e-3})
    direction = np.zeros(len(parameters))
    direction[[0, 30]] = np.sqrt(0.5)
    information = 100.0 * (np.eye(len(parameters)) - np.outer(direction, direction))
    (sentence,) = sentences(Observability.of(information), parameters)
    assert sentence.startswith("1 combinations of parameters")
    assert "outlet_1_x" in sentence
    assert "offset_7" in sentence


def test_a_result_file_is_applied_to_its_own_rig_only(
    rig: Rig, found: RigCalibration, tmp_path: Path
) -> None:
    quality = judge_rig(found, 1e-3, 0.0)
    result = rig_result(found, quality, "rig", TODAY)
    corrected = rig.with_calibration(RigResult.model_validate(result.model_dump()))
    assert corrected.outlets == pytest.approx(found.geometry.outlets, abs=1e-9)
    assert corrected.anchors == pytest.approx(found.geometry.anchors, abs=1e-9)
    assert corrected.document.simulation == rig.document.simulation
    with pytest.raises(BadInput, match="made with outlets"):
        load_rig(ROOT / "configs/gachon_8_6.yaml").with_calibration(result)


def test_the_report_sets_every_number_beside_the_rig_files(rig: Rig, found: RigCalibration) -> None:
    rows = {row[0]: row[1:] for row in number_rows(found)}
    assert rows.keys() == found.intervals.keys()
    before, new, change, width, changed = rows["outlet_7_y_mm"]
    assert float(before) == pytest.approx(1e3 * rig.outlets[6, 1], abs=0.006)
    assert float(new) == pytest.approx(1e3 * found.geometry.outlets[6, 1], abs=0.006)
    assert float(change) == pytest.approx(float(new) - float(before), abs=0.011)
    assert (changed == "yes") == (abs(float(change)) > float(width))
    quality = judge_rig(found, 1e-3, 0.0)
    for name, (before, new, change, *_) in rows.items():
        if not name.endswith("_n"):  # of any size: with its hundredths
            assert all("." in text for text in (before, new, change)), name
    page = rig_page(found, quality, "<b>rig</b>", "2026-03-14")
    assert f"{quality.before * 1e3:.2f} → {quality.held_out * 1e3:.2f}\u00a0<small>mm" in page
    assert "good enough" in page
    assert "<b>rig</b>" not in page
    for head in ("rig file", "new", "change", "± 95 %"):
        assert f'<th scope="col">{head}</th>' in page
    charts = page.split('<figure class="plot">')[1:]
    assert len(charts) == 1 + rig.cable_count
    assert all('aria-label="Line chart of the ' in chart for chart in charts)
    assert page.count('class="viewer"') == 1


@pytest.mark.parametrize("key", ["anchors_mm", "drums_mm_per_rev", "home_counts"])
def test_a_result_file_with_a_cable_too_few_is_refused_by_name(
    rig: Rig, found: RigCalibration, tmp_path: Path, key: str
) -> None:
    document = rig_result(found, judge_rig(found, 1e-3, 0.0), "rig", TODAY).model_dump(mode="json")
    document[key] = document[key][:-1]
    path = tmp_path / "edited.yaml"
    path.write_text(yaml.safe_dump(document), encoding="utf-8")
    with pytest.raises(InvalidFile, match=f"{key}.*has 7 entries, outlets_mm has 8") as caught:
        load_result(path)
    assert "edited.yaml" in str(caught.value)


def test_a_result_with_fewer_cables_throughout_is_refused_by_name(
    rig: Rig, found: RigCalibration
) -> None:
    result = rig_result(found, judge_rig(found, 1e-3, 0.0), "rig", TODAY)
    keys = ("outlets_mm", "anchors_mm", "drums_mm_per_rev", "home_counts", "cable_residuals_mm")
    fewer = result.model_copy(update={key: getattr(result, key)[:-1] for key in keys})
    with pytest.raises(BadInput, match="has 7 cables, the rig has 8") as caught:
        rig.with_calibration(fewer)
    assert caught.value.where == "calibration rig rig, 2026-03-14"


def test_two_results_are_compared_by_where_the_platform_goes(
    rig: Rig, found: RigCalibration, found_level: RigCalibration
) -> None:
    """Without rotation, outlets are less certain than the platform: not a disagreement."""
    one, other = (
        rig_result(r, judge_rig(r, 1e-3, 0.0), "rig", TODAY) for r in (found, found_level)
    )
    apart = one.apart_mm(other)
    outlets = np.linalg.norm(np.array(one.outlets_mm) - np.array(other.outlets_mm), axis=1)
    assert 0.0 < apart < 0.3
    assert rms(outlets) > 3.0 * apart
    assert one.apart_mm(one) == 0.0
    sent = workspace_poses(rig, 0.0)[0]
    assert np.linalg.norm(found.reached(*workspace_poses(rig, 0.0)) - sent, axis=1).max() > 1e-3
    with pytest.raises(BadInput, match="depend on different rig files"):
        one.apart_mm(one.model_copy(update={"rests_on": "another"}))


def test_reached_positions_are_those_of_the_least_squares(rig: Rig, found: RigCalibration) -> None:
    """By the rig file, the lengths contradict each other by millimetres."""
    positions, rotations = workspace_poses(rig, 0.0)
    counts = _sent_to(rig, positions, rotations)
    lengths = RigModel(found.parameters, counts).counted.lengths(found.geometry)
    rebuilt = rig_with(rig, found.geometry)
    for k, reached in enumerate(found.reached(positions, rotations)):
        start = Pose(positions[k], rotations[k])
        step, _ = nearest_step(rebuilt, start, lengths[k])
        np.testing.assert_allclose(reached, moved(start, step).position, atol=1e-6)


def test_counts_of_home_lead_the_corrected_rig_to_the_lengths_that_were_fitted(
    rig: Rig, found: RigCalibration
) -> None:
    """Its winches pay out the fitted length, to one count."""
    result = rig_result(found, judge_rig(found, 1e-3, 0.0), "rig", TODAY)
    corrected, data = rig.with_calibration(result), found.measured
    winches = WinchMap(corrected)
    lengths = winches.strained(winches.unstrained_from_counts(data.counts), data.tensions)
    by_fit = RigModel(found.parameters, data).counted.lengths(found.geometry)
    assert lengths == pytest.approx(by_fit, abs=3e-6)


def test_runs_of_another_rig_or_of_two_references_are_refused(rig: Rig) -> None:
    other = load_rig(ROOT / "configs/gachon_8_6.yaml")
    with pytest.raises(BadInput, match="this run was made with outlets"):
        require_same_nominal(rig, [("runs/a", other)])
    winches = [w.model_copy(update={"home_counts": 5}) for w in rig.document.winches]
    again = rig_from_document(rig.document.model_copy(update={"winches": winches}))
    with pytest.raises(BadInput, match="homed again"):
        require_same_nominal(rig, [("runs/a", rig), ("runs/b", again)])
    assert require_same_nominal(rig, [("runs/b", again)]) is again
    assert require_same_nominal(rig, []) is rig


def test_too_few_samples_and_no_parameters_are_refused(rig: Rig, tilted: Truth) -> None:
    few = tilted.measured.part(np.arange(60) < 9)
    with pytest.raises(BadInput, match="only 9 stationary samples"):
        fit_rig(rig, few, DEFAULT_DEVIATIONS, LENGTH_DEVIATION)
    with pytest.raises(BadInput, match="nothing to calibrate"):
        fit_rig(rig, tilted.measured, {}, LENGTH_DEVIATION)


def test_rests_of_a_run_are_found_and_their_pictures_averaged() -> None:
    """At rest for 1 s, moving for 1 s, at rest for 1 s; an image every 0.1 s."""
    time = np.arange(0.0, 3.0, 0.01)
    travel = np.clip(time - 1.0, 0.0, 1.0)
    counts = np.rint(1000.0 * np.stack([travel, -travel], axis=1))
    seen = np.arange(0.0, 2.5, 0.1)  # none after 2.5 s
    turns = [matrix_from_rotation_vector((0.0, 0.0, 1e-3 * (-1) ** k)) for k in range(len(seen))]
    run = Recording(
        time=time,
        setpoints=counts,
        counts=counts,
        tensions=np.full((len(time), 2), 20.0),
        pose_times=seen,
        positions=np.stack([np.clip(seen - 1.0, 0.0, 1.0), 0 * seen, 0 * seen], axis=1),
        rotations=np.array(turns),
        covariances=np.tile(np.eye(6) * 1e-8, (len(seen), 1, 1)),
    )
    found = at_rest("run", run)
    assert found.names == ("run, rest 1", "run, rest 2")
    assert found.counts == pytest.approx(np.array([[0.0, 0.0], [1000.0, -1000.0]]), abs=10.1)
    assert found.positions[:, 0] == pytest.approx([0.0, 1.0], abs=1e-9)
    for rotation in found.rotations:
        assert np.linalg.norm(rotation_vector_from_matrix(rotation)) < 5e-4
        assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-12)
    blind = at_rest(
        "blind",
        replace(
            run,
            pose_times=seen[:8],
            positions=run.positions[:8],
            rotations=run.rotations[:8],
            covariances=run.covariances[:8],
        ),
    )
    assert blind.unused == {"blind, rest 2": "no image taken there gave a pose"}
    assert len(joined([found, blind])) == 3


def test_a_rest_lasts_while_tensions_are_measured() -> None:
    """Drives off for 0.3 s; a dwell; a goal with the drives off after 0.1 s."""
    time = np.arange(0.0, 4.0, 0.01)
    counts = np.rint(1e3 * np.clip(np.stack([time - 1.5, 1.5 - time], axis=1), -0.5, 0.5))
    following = (time > 0.305) & (time < 2.095)
    torques = np.where(following, 20.0 + time, np.nan)
    tensions = np.stack([torques, torques + 1.0], axis=1)
    none = np.empty(0)
    seen = (none, none.reshape(0, 3), none.reshape(0, 3, 3), none.reshape(0, 6, 6))
    run = Recording(time, counts, counts, tensions, *seen)
    found = at_rest("run", run)
    assert found.names == ("run, rest 1",)
    assert found.counts == pytest.approx(np.array([[-500.0, 500.0]]))
    assert found.tensions == pytest.approx(np.array([[20.755, 21.755]]), abs=0.01)
    unknown = at_rest("run", replace(run, tensions=np.full_like(tensions, np.nan)))
    assert unknown.names == ("run, rest 1", "run, rest 2")
    assert np.isnan(unknown.tensions).all()


def test_a_lost_reply_does_not_lose_the_tensions_of_a_rest() -> None:
    time = np.arange(0.0, 1.0, 0.01)
    counts, tensions = np.zeros((len(time), 2)), np.full((len(time), 2), 20.0)
    tensions[60, 1] = np.nan
    none = np.empty(0)
    seen = (none, none.reshape(0, 3), none.reshape(0, 3, 3), none.reshape(0, 6, 6))
    found = at_rest("run", Recording(time, counts, counts, tensions, *seen))
    assert found.names == ("run, rest 1",)
    assert found.tensions.tolist() == [[20.0, 20.0]]


def test_numbers_far_from_the_rig_file_are_not_good_enough(rig: Rig, tilted: Truth) -> None:
    """Winches 1 and 2 swapped, or a stated drum deviation far below the true error."""
    half = tilted.measured.part(np.arange(60) < 30)
    counts = half.counts.copy()
    counts[:, [0, 1]] = counts[:, [1, 0]]
    swapped = replace(half, counts=counts)
    verdicts = [
        judge_rig(fit_rig(rig, data, deviations, LENGTH_DEVIATION), 1e-3, 0.0).verdict
        for data, deviations in (
            (swapped, DEFAULT_DEVIATIONS),
            (tilted.measured, {**DEFAULT_DEVIATIONS, "drum_scale": 2e-4}),
        )
    ]
    assert not any(verdict.good for verdict in verdicts)
    assert "from the rig file" in verdicts[0].reasons[0]
    assert "order of the cables" in verdicts[0].next_steps[0]
    assert "% from the rig file" in verdicts[1].reasons[0]
    assert "--drum-scale-percent" in verdicts[1].next_steps[0]


def test_a_pose_outside_the_rig_is_refused_by_name(rig: Rig, tilted: Truth) -> None:
    metres = replace(tilted.measured, positions=tilted.measured.positions / 1e3)
    with pytest.raises(BadInput, match="outside the rig") as caught:
        fit_rig(rig, metres, DEFAULT_DEVIATIONS, LENGTH_DEVIATION)
    assert caught.value.where == "sample 0"


def test_poses_at_the_edge_of_a_suspended_rig_may_be_a_little_outside(
    rig: Rig, tilted: Truth
) -> None:
    """All outlets are above the workspace, and the reflector is below the platform."""
    high = rig.document.model_copy(
        update={"outlets_mm": [[x, y, 900.0] for x, y, _ in rig.document.outlets_mm]}
    )
    suspended = rig_from_document(high)
    positions = tilted.measured.positions.copy()
    positions[7, 2] = rig.workspace_lower[2] - 4e-3
    _require_within(suspended, replace(tilted.measured, positions=positions))
    below = replace(
        tilted.measured,
        positions=positions - [0.0, 0.0, 0.2],
        rotations=np.full_like(tilted.measured.rotations, np.nan),
        reflectors=np.array([0.0, 0.0, -0.2]),
    )
    _require_within(suspended, below)
    for scale in (1e3, 25.4, 10.0, 1.0 / 25.4, 1e-3):
        for data in (tilted.measured, below):
            with pytest.raises(BadInput, match="outside the rig"):
                _require_within(suspended, replace(data, positions=data.positions / scale))


@pytest.mark.parametrize("poses", [True, False])
def test_a_wrong_stiffness_is_reported_with_the_true_one(tilted: Truth, poses: bool) -> None:
    """The cables have 6000 N, the paper's rig file states 848230 N."""
    drawn = load_rig(ROOT / "configs/gachon_8_6.yaml")
    data = tilted.measured if poses else tilted.measured.without_poses()
    result = fit_rig(drawn, data, DEFAULT_DEVIATIONS, LENGTH_DEVIATION)
    compliance = estimate_compliance(result)
    assert compliance is not None
    assert 1.0 / compliance.estimated == pytest.approx(6000.0, rel=0.05 if poses else 0.35)
    verdict = judge_rig(result, 1e-3, 0.0).verdict
    assert not verdict.good
    assert any("848230 N" in reason for reason in verdict.reasons)
    assert any("stiffness_n" in step for step in verdict.next_steps)


@pytest.mark.parametrize("stiffness", [3500.0, 12000.0, 60000.0])
def test_the_estimated_stiffness_is_the_same_for_every_rig_file(
    rig: Rig, tilted: Truth, stiffness: float
) -> None:
    drawn = with_nominal_stiffness(rig, stiffness)
    result = fit_rig(drawn, tilted.measured, DEFAULT_DEVIATIONS, LENGTH_DEVIATION)
    compliance, differences = estimate_compliance(result), estimate_cable_compliances(result)
    assert compliance is not None
    assert differences is not None
    assert 1.0 / compliance.estimated == pytest.approx(6000.0, rel=0.05)
    assert 1.0 / differences.estimated == pytest.approx(6000.0, rel=0.3)


def test_a_stiffness_far_from_the_rig_file_is_reported_as_a_factor(rig: Rig, tilted: Truth) -> None:
    drawn = with_nominal_stiffness(rig, 60000.0)
    result = fit_rig(drawn, tilted.measured, DEFAULT_DEVIATIONS, LENGTH_DEVIATION)
    factor = float(result.geometry.stiffness[0]) / 60000.0
    assert factor < 0.3
    reason = judge_rig(result, 1e-3, 0.0).verdict.reasons[0]
    assert reason.startswith(f"stiffness is {factor:.3g} times that of the rig file")


def test_an_undetermined_stiffness_is_positive_however_uncertain(rig: Rig, tilted: Truth) -> None:
    blind = replace(tilted.measured, tensions=np.full_like(tilted.measured.tensions, np.nan))
    loose = {"outlets": 4e-3, "stiffness": 2.0}
    stiffness = fit_rig(rig, blind, loose, LENGTH_DEVIATION).intervals["stiffness_n"]
    assert 0.0 < stiffness.bounds[0] < 6000.0 / 20.0
    assert stiffness.bounds[1] > 6000.0 * 20.0


def test_a_stiffness_that_is_hardly_known_is_found_from_afar(tilted: Truth) -> None:
    """As advised for a contradiction: 140 times too stiff."""
    drawn = load_rig(ROOT / "configs/gachon_8_6.yaml")
    loose = {**DEFAULT_DEVIATIONS, "stiffness": 5.0}
    result = fit_rig(drawn, tilted.measured, loose, LENGTH_DEVIATION)
    stiffness = result.intervals["stiffness_n"]
    assert abs(stiffness.value - 6000.0) < stiffness.half_width < 1200.0
    assert judge_rig(result, 1e-3, 0.0).verdict.good


def test_cables_that_differ_are_reported_and_others_are_not(rig: Rig) -> None:
    """Cable 3 has half the stiffness; all tensions were measured."""
    for weak in (6000.0, 3000.0):
        built = rig_with_errors(rig, 5, [6000.0] * 2 + [weak] + [6000.0] * 5)
        data = samples(built, 60, tilt=np.radians(8.0), seed=6).measured
        result = fit_rig(built, data, DEFAULT_DEVIATIONS, LENGTH_DEVIATION)
        differences = estimate_cable_compliances(result)
        assert differences is not None
        reasons = judge_rig(result, 1e-3, 0.0).verdict.reasons
        assert any("the cables differ" in reason for reason in reasons) == (weak < 6000.0)
    assert np.argmax(differences.estimated) == 2
    assert 1.0 / differences.estimated[2] == pytest.approx(3000.0, rel=0.25)
    blind = replace(data, tensions=np.full_like(data.tensions, np.nan))
    result = fit_rig(built, blind, {"offsets": 2e-3}, LENGTH_DEVIATION)
    assert estimate_cable_compliances(result) is None


def test_the_true_stiffness_is_not_doubted(
    found: RigCalibration, found_level: RigCalibration
) -> None:
    for result in (found, found_level):
        compliance = estimate_compliance(result)
        assert compliance is not None
        assert not compliance.contradicts
        stiffness = result.intervals["stiffness_n"]
        assert abs(stiffness.value - 6000.0) < stiffness.half_width < 0.1 * 6000.0


def test_the_derivative_by_compliance_is_that_of_finite_differences(
    rig: Rig, tilted: Truth, found: RigCalibration
) -> None:
    step, data = 1e-9, tilted.measured
    counted, geometry = CountedLengths(rig, data.counts, data.tensions), found.geometry
    compliance = 1.0 / geometry.stiffness
    ends = [
        counted.lengths(replace(geometry, stiffness=1.0 / (compliance + sign * step)))
        for sign in (1.0, -1.0)
    ]
    slope = counted.by_compliance(geometry)
    assert slope == pytest.approx((ends[0] - ends[1]) / (2.0 * step), rel=1e-4, abs=1e-4)


def test_the_hash_of_the_data_is_of_every_number(tilted: Truth) -> None:
    data = tilted.measured
    assert re.fullmatch("sha256:[0-9a-f]{64}", data.data_hash)
    assert replace(data, counts=data.counts.copy()).data_hash == data.data_hash
    for key in ("counts", "tensions", "positions", "rotations"):
        values = getattr(data, key).copy()
        values.flat[-1] += 1e-6
        assert replace(data, **{key: values}).data_hash != data.data_hash


def test_a_sample_with_the_numbers_of_an_earlier_one_counts_once(tilted: Truth) -> None:
    data = tilted.measured
    copy = replace(data, names=tuple(f"copy of {name}" for name in data.names))
    both = joined([data, copy])
    assert both.names == data.names
    assert both.unused["copy of sample 3"] == "has the same numbers as sample 3"
    assert len(both.unused) == len(data)
    again = replace(copy, positions=copy.positions + 1e-6)  # measured again at the same pose
    assert len(joined([data, again])) == 2 * len(data)
    assert len(joined([data.without_poses(), again.without_poses()])) == len(data)
