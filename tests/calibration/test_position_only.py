"""Rig calibration from positions of one point, as of a tracker's reflector or target."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.geometry.calibrate import fit_rig
from calibration.geometry.fit import RigFitter
from calibration.geometry.measurements import RigMeasurements, read_rig_data
from calibration.geometry.parameters import DEFAULT_DEVIATIONS, Parameters
from calibration.geometry.quality import judge_rig
from calibration.geometry.result import rig_result
from calibration.procedures import calibrate_rig
from calibration.run_data import rig_measurements
from model.errors import BadInput
from model.pose import matrix_from_rotation_vector, read_only
from model.rig import Rig, load_rig, rig_from_document
from tests.calibration.rig_places import (
    Truth,
    rig_with_errors,
    samples,
    share_inside,
    true_numbers,
    write_samples,
)
from tests.calibration.test_rig_calibration import LENGTH_DEVIATION, TODAY, errors_of, rms
from tests.cli.program import call

RIG = Path(__file__).parents[2] / "configs" / "gachon_8_6_rehearsal.yaml"
REFLECTOR = np.array([0.02, -0.03, 0.09])


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(RIG)


@pytest.fixture(scope="module")
def truth(rig: Rig) -> Truth:
    return samples(rig, 60, tilt=np.radians(12.0), seed=5)


def followed(truth: Truth, reflector: np.ndarray) -> RigMeasurements:
    """Measurements of a tracker with one reflector."""
    data = truth.measured
    points = data.positions + data.rotations @ reflector
    return replace(
        data,
        positions=read_only(points),
        rotations=read_only(np.full_like(data.rotations, np.nan)),
        reflectors=read_only(reflector),
    )


def targeted(truth: Truth) -> RigMeasurements:
    """The same poses as by a tracker of a target, with correlated errors at the target."""
    data = truth.measured
    arms = data.rotations @ REFLECTOR
    to_target = np.tile(np.eye(6), (len(data), 1, 1))
    to_target[:, :3, 3:] = np.cross(arms[:, None], np.eye(3))
    return replace(
        data,
        positions=read_only(data.positions + arms),
        covariances=to_target @ data.covariances @ np.swapaxes(to_target, 1, 2),
        reflectors=read_only(REFLECTOR),
    )


def test_poses_of_a_target_calibrate_a_rig_as_those_of_the_origin(rig: Rig, truth: Truth) -> None:
    parameters = Parameters.of(rig, DEFAULT_DEVIATIONS)
    by_origin, by_target = (
        RigFitter(parameters, data, LENGTH_DEVIATION).fit()
        for data in (truth.measured, targeted(truth))
    )
    deviations = parameters.deviations
    np.testing.assert_allclose(
        by_target.values / deviations, by_origin.values / deviations, atol=0.01
    )
    np.testing.assert_allclose(by_target.information, by_origin.information, rtol=0.02, atol=10.0)


def test_errors_common_to_all_poses_of_a_target_move_the_origin_about_it(
    rig: Rig, truth: Truth
) -> None:
    """A target mounted askew displaces the origin by its distance; a rotated world does not."""
    by_origin = truth.measured.with_added_deviation(1e-4, 1e-3).common_errors
    by_target = targeted(truth).with_added_deviation(1e-4, 1e-3).common_errors
    np.testing.assert_allclose(by_target[..., :6], by_origin[..., :6], atol=1e-12)
    turned = np.array([matrix_from_rotation_vector(1e-3 * axis) for axis in np.eye(3)])
    for k, rotation in enumerate(truth.measured.rotations[:5]):
        there = -np.array([(turn - np.eye(3)) @ rotation @ REFLECTOR for turn in turned]).T
        np.testing.assert_allclose(by_target[k, :3, 6:], there, atol=1e-7)


def test_a_reflector_that_no_sample_uses_is_refused(rig: Rig, truth: Truth, tmp_path: Path) -> None:
    posed, lengths, points = (tmp_path / f"{name}.csv" for name in ("posed", "lengths", "points"))
    write_samples(posed, truth.measured)
    write_samples(lengths, truth.measured, poses=False)
    rows = [line.split(",") for line in posed.read_text().splitlines()]
    points.write_text("\n".join(",".join(row[:-4]) for row in rows))
    for data, without_poses in ((lengths, False), (posed, True)):
        with pytest.raises(BadInput, match="none are used"):
            calibrate_rig(rig, data, reflector=REFLECTOR, without_poses=without_poses)
    with pytest.raises(BadInput, match="only some of the CSV files have rotations"):
        calibrate_rig(rig, [posed, points], reflector=REFLECTOR)
    _, measured = rig_measurements(rig, [posed], REFLECTOR)
    origins = measured.origins(measured.rotations)
    arms = truth.measured.rotations @ REFLECTOR
    np.testing.assert_allclose(origins, truth.measured.positions - arms, atol=1e-8)


@pytest.mark.parametrize("reflector", [np.zeros(3), REFLECTOR])
def test_positions_of_a_reflector_calibrate_a_rig(
    rig: Rig, truth: Truth, reflector: np.ndarray
) -> None:
    result = fit_rig(rig, followed(truth, reflector), DEFAULT_DEVIATIONS, LENGTH_DEVIATION)
    quality = judge_rig(result, 1e-3, 0.0)
    assert result.held_out.poses
    assert quality.held_out < 0.5 * quality.before
    corrected = rig.with_calibration(rig_result(result, quality, "rig", TODAY))
    assert rms(errors_of(corrected, truth)) < 0.25 * rms(errors_of(rig, truth))


def test_a_wrong_reflector_fits_worse(rig: Rig, truth: Truth) -> None:
    right = followed(truth, REFLECTOR)
    wrong = replace(right, reflectors=read_only(np.zeros(3)))
    parameters = Parameters.of(rig, DEFAULT_DEVIATIONS)
    fits = [RigFitter(parameters, data, LENGTH_DEVIATION).fit() for data in (right, wrong)]
    squares = [float(np.sum(f.residuals**2) + np.sum(f.pose_misfits**2)) for f in fits]
    assert squares[1] > 2.0 * squares[0]


@pytest.mark.parametrize("rotated", [False, True])
def test_what_a_position_says_of_a_pose_is_by_finite_differences(
    rig: Rig, truth: Truth, rotated: bool
) -> None:
    """The gradient of the squared distances, at estimated poses."""
    data = targeted(truth) if rotated else followed(truth, REFLECTOR)
    positions, rotations = truth.positions + 1e-3, truth.rotations
    errors = data.pose_errors(positions, rotations)
    information = data.pose_information(rotations)
    slopes = 2.0 * np.einsum("nij,nj->ni", information, errors)
    step = 1e-6
    for axis, twist in enumerate(step * np.eye(6)):
        turned = matrix_from_rotation_vector(twist[3:]) @ rotations
        there = data.pose_errors(positions + twist[:3], turned)
        after = data.pose_information(turned)
        costs = [
            np.einsum("ni,nij,nj->n", e, own, e)
            for e, own in ((there, after), (errors, information))
        ]
        found, level = (costs[0] - costs[1]) / step, 1e-3 * np.abs(slopes[:, axis]).max()
        np.testing.assert_allclose(found, slopes[:, axis], rtol=1e-2, atol=level)


def test_a_file_of_positions_needs_no_rotation_and_half_of_one_is_refused(
    rig: Rig, truth: Truth, tmp_path: Path
) -> None:
    data = followed(truth, np.zeros(3))
    names = [f"actual_{i}_counts" for i in range(1, 9)] + ["x_mm", "y_mm", "z_mm"]
    names += ["std_x_mm", "std_y_mm", "std_z_mm"]
    rows = np.column_stack([data.counts, data.positions * 1e3, np.full((60, 3), 0.2)])
    file = tmp_path / "tracker.csv"
    lines = [",".join(names), *(",".join(f"{x:.6f}" for x in row) for row in rows)]
    file.write_text("\n".join(lines))
    back = read_rig_data(file, 8)
    assert back.has_position.all()
    assert not back.has_rotation.any()
    np.testing.assert_allclose(back.positions, data.positions, atol=1e-8)
    np.testing.assert_allclose(back.covariances[0, :3, :3], 4e-8 * np.eye(3))
    answer = call("calibrate", "rig", RIG, file, "--reflector-mm", "0", "0", "0", "--tilt-deg", "0")
    assert answer.code in (0, 3), answer
    assert "positions RMS error at held-out samples" in " ".join(answer.out.split())
    half = tmp_path / "half.csv"
    half.write_text("\n".join([lines[0] + ",qw", *(line + ",1" for line in lines[1:])]))
    with pytest.raises(BadInput, match="'qx', 'qy', 'qz' are missing"):
        read_rig_data(half, 8)
    for column in ("x_mm", "std_x_mm"):
        half.write_text(
            "\n".join([lines[0].replace(f",{column}", f",{column.upper()}"), *lines[1:]])
        )
        with pytest.raises(BadInput, match=f"'{column}' is missing"):
            read_rig_data(half, 8)


def test_rotated_poses_of_a_reflector_are_not_asked_to_be_rotated(rig: Rig, truth: Truth) -> None:
    """Its tracker does not measure the rotations."""
    found = fit_rig(rig, followed(truth, REFLECTOR), DEFAULT_DEVIATIONS, LENGTH_DEVIATION)
    quality = judge_rig(found, 1e-5, np.radians(5.0))
    steps = " ".join(quality.verdict.next_steps)
    assert "measure the platform's rotation as well" in steps
    assert "measure with the platform rotated" not in steps


def test_no_data_at_all_are_bad_input(rig: Rig) -> None:
    """As from a misspelt pattern of run folders."""
    with pytest.raises(BadInput, match="names no run folder and no CSV file"):
        calibrate_rig(rig, [])


def parallel_cables(rig: Rig) -> Rig:
    """A rig of 3.1 x 2.3 x 2.2 m with uncrossed cables, which hardly resist rotation about z."""
    document, corners = rig.document, [(x, y) for y in (1, -1) for x in (-1, 1)]
    upper, lower = (
        [[1550 * x, 1150 * y, 2200] for x, y in corners],
        [[1570 * x, 1110 * y, 60] for x, y in corners],
    )
    home = document.platform.home.model_copy(update={"position_mm": [0, 0, 1000]})
    workspace = {"lower_mm": [-700, -500, 600], "upper_mm": [700, 500, 1500]}
    changes = {
        "outlets_mm": upper + lower,
        "anchors_mm": [[150 * x, 120 * y, z] for z in (-100, 100) for x, y in corners],
        "platform": document.platform.model_copy(update={"home": home}),
        "workspace": document.workspace.model_copy(update=workspace),
    }
    return rig_from_document(document.model_copy(update=changes))


@pytest.fixture(scope="module")
def weak_yaw(rig: Rig) -> tuple[Rig, Truth]:
    """A rig with parallel cables that differs from its file, and its samples."""
    built = rig_with_errors(parallel_cables(rig), 3)
    return built, samples(built, 60, tilt=np.radians(10.0), seed=3)


@pytest.mark.parametrize("positions", [True, False])
def test_a_weakly_determined_yaw_needs_no_measured_rotation(
    weak_yaw: tuple[Rig, Truth], positions: bool
) -> None:
    """Lengths by the rig file alone rotate the platform far: a start, not a reason to refuse."""
    built, truth = weak_yaw
    data = followed(truth, REFLECTOR) if positions else truth.measured.without_poses()
    result = fit_rig(built, data, DEFAULT_DEVIATIONS, LENGTH_DEVIATION)
    assert len(result.measured) == 60
    assert share_inside(result.intervals, true_numbers(built)) >= 0.9
    quality = judge_rig(result, 2e-3, np.radians(5.0))
    assert quality.held_out < 0.2 * quality.before
    assert quality.verdict.good == positions
