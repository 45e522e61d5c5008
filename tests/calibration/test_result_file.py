"""Result files: read as written, refused for other rigs, values shown with half widths."""

from __future__ import annotations

from datetime import date
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.extrinsics.result import (
    ExtrinsicCalibration,
    extrinsics_result,
    judge_extrinsics,
    workspace_corners,
)
from calibration.result_files import load_result
from calibration.results import Calibration, CalibrationVerdict, Issue, write_result
from calibration.statistics import Interval
from model.errors import BadInput
from model.rig import Rig, load_rig, rig_from_document
from tests.calibration.results import camera_result_of, rig_result_for
from tests.calibration.test_camera_files_of_others import Remarks
from tracking.clearance import require_stated_errors

CONFIGS = Path(__file__).parents[2] / "configs"


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(CONFIGS / "gachon_8_6.yaml")


def test_a_result_is_read_as_it_was_written(tmp_path: Path) -> None:
    result = camera_result_of()
    path = write_result(tmp_path, result)
    assert path.name == "calibration_camera_front_2026-03-01.yaml"
    assert load_result(path) == result.sealed()


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("fx_px: 905.0", "fx_px: 906.0"),
        ("good_enough: true", "good_enough: false"),
        ("a.png: is bad", "a.png: is good"),
        ("hash: sha256:", "hash: sha256:0"),
        ("\nhash: ", "\n# "),
    ],
)
def test_a_result_that_was_edited_is_refused(tmp_path: Path, old: str, new: str) -> None:
    path = write_result(tmp_path, camera_result_of())
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(BadInput, match="hash does not match its content"):
        load_result(path)


@given(value=st.floats(1e-9, 1e12))
def test_a_seal_outlives_the_file_whatever_the_number(tmp_path_factory, value: float) -> None:
    path = write_result(tmp_path_factory.mktemp("result"), camera_result_of(fx=value))
    assert load_result(path).stated  # read, so the hash fits


def test_a_camera_result_replaces_the_parameters_of_the_rig_file(rig: Rig) -> None:
    better = rig.with_calibration(camera_result_of())
    assert better.cameras[0].matrix[0, 0] == 905.0
    assert better.cameras[0].distortion.tolist() == [-0.1, 0.04, 0.0, 0.0, 0.0]
    old, new = rig.cameras[0], better.cameras[0]
    assert new.world_from_camera.distance_to(old.world_from_camera) == 0.0
    assert rig.cameras[0].matrix[0, 0] == 900.0  # the rig itself is as it was
    assert better.plan_hash == rig.plan_hash


def test_a_pose_found_with_another_lens_states_no_error(rig: Rig) -> None:
    """It is off by what the lens was off, which its covariance did not know."""
    document = rig.document.cameras[0].model_copy(
        update={"pose_covariance": np.eye(6).tolist(), "pose_by_lens": np.zeros((6, 9)).tolist()}
    )
    known = rig_from_document(rig.document.model_copy(update={"cameras": [document]}))
    assert known.cameras[0].pose_covariance is not None
    remarks = Remarks([])
    camera = known.with_calibration(camera_result_of(), listener=remarks).cameras[0]
    assert (camera.pose_covariance, camera.pose_by_lens) == (None, None)
    (remark,) = (text for text in remarks.texts if "error_mm" not in text)
    assert remark.startswith("the pose of camera 'front' was found with another lens")
    assert "`cdpr calibrate extrinsics`" in remark


def test_the_lens_that_a_rig_has_already_leaves_its_pose_as_calibrated(rig: Rig) -> None:
    """As where a script passes `--calibration` of the lens that was applied to the file."""
    better = rig.with_calibration(camera_result_of())
    posed = better.document.cameras[0].model_copy(
        update={"pose_covariance": np.eye(6).tolist(), "pose_by_lens": np.zeros((6, 9)).tolist()}
    )
    known = rig_from_document(better.document.model_copy(update={"cameras": [posed]}))
    remarks = Remarks([])
    again = known.with_calibration(camera_result_of(), listener=remarks)
    assert again.document == known.document
    assert remarks.texts == []


def test_an_error_stated_for_another_lens_is_left_out(rig: Rig) -> None:
    """Clearance is not measured with it, until the operator states it for the new lens."""
    stated = rig.document.cameras[0].model_copy(update={"error_mm": 0.5})
    known = rig_from_document(rig.document.model_copy(update={"cameras": [stated]}))
    remarks = Remarks([])
    better = known.with_calibration(camera_result_of(), listener=remarks)
    with pytest.raises(BadInput, match="measuring error of camera 'front' is unknown"):
        require_stated_errors(better, better.cameras)
    (remark,) = remarks.texts
    assert remark.startswith("error_mm of camera 'front', 0.5, was stated for another lens")
    remarks.texts.clear()
    (camera,) = better.document.cameras
    again = camera.model_copy(update={"error_mm": 0.25})  # stated for this lens
    restated = rig_from_document(better.document.model_copy(update={"cameras": [again]}))
    for known in (better, restated):
        same = known.with_calibration(camera_result_of(), listener=remarks)
        assert same.document.cameras[0].error_mm == known.document.cameras[0].error_mm
    assert remarks.texts == []


def test_a_result_that_is_not_good_enough_is_used_with_a_remark(rig: Rig) -> None:
    poor = {"good_enough": False, "verdict": "not good enough: few images"}
    result, remarks = camera_result_of().model_copy(update=poor), Remarks([])
    made = Calibration(result, page="", found=None, quality=None)
    for one in (result, made):
        assert rig.with_calibration(one, listener=remarks).cameras[0].matrix[0, 0] == 905.0
    rig.with_calibration(camera_result_of(), listener=remarks)
    text = f"calibration camera front, {result.date}: not good enough: few images"
    assert [one for one in remarks.texts if "error_mm" not in one] == [text, text]


@pytest.mark.parametrize(
    ("result", "named"),
    [
        (camera_result_of("side"), "unknown camera 'side'"),
        (camera_result_of(size=(640, 480)), "640 x 480 px, camera 'front' takes 1280 x 720 px"),
    ],
)
def test_a_result_for_another_camera_is_refused(rig: Rig, result, named: str) -> None:
    with pytest.raises(BadInput, match=named):
        rig.with_calibration(result)


def test_two_results_of_one_camera_are_refused(rig: Rig) -> None:
    with pytest.raises(BadInput, match="two results of kind camera: 'front' of"):
        rig.with_calibration(camera_result_of(), camera_result_of(fx=901.0))


def test_two_results_of_a_rig_are_refused_whatever_their_names(rig: Rig) -> None:
    one, other = rig_result_for(rig, "camera"), rig_result_for(rig, "tracker", by_mm=0.2)
    with pytest.raises(BadInput, match="two results of kind rig: 'camera' of") as caught:
        rig.with_calibration(one, other)
    assert caught.value.next_step == "pass only the current one"


def test_a_result_that_the_rig_file_has_already_is_refused_as_that(rig: Rig) -> None:
    result = rig_result_for(rig)
    better = rig.with_calibration(result)
    with pytest.raises(BadInput, match="this result is applied already") as caught:
        better.with_calibration(result)
    assert caught.value.next_step == "leave it out"
    with pytest.raises(BadInput, match="made with outlets"):
        better.with_calibration(rig_result_for(rig, by_mm=0.2))


@pytest.mark.parametrize(("level", "turned"), [(1.4, 1.2), (0.3, 1.4)])
def test_the_stated_error_of_the_platform_goes_into_the_rig(
    rig: Rig, level: float, turned: float
) -> None:
    """Which keeps its plans: their proof does not depend on it."""
    assert rig.platform_error is None
    stated = {"level_mm": level, "turned_mm": turned}
    better = rig.with_calibration(rig_result_for(rig).model_copy(update=stated))
    assert better.platform_error == pytest.approx(1.4e-3)
    without = better.document.model_copy(update={"platform_error_mm": None})
    assert rig_from_document(without).plan_hash == better.plan_hash


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("kind: rigg\n", "not a calibration result"),
        ("- 1\n", "not a calibration result"),
        ("kind: camera\n", "fx_px"),
        ("kind: [\n", "yaml"),
    ],
)
def test_files_that_are_not_results_are_refused_by_name(
    tmp_path: Path, text: str, named: str
) -> None:
    path = tmp_path / "wrong.yaml"
    path.write_text(text)
    with pytest.raises(BadInput) as caught:
        load_result(path)
    assert named in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_result_states_its_distance_from_another() -> None:
    one, two = camera_result_of(), camera_result_of(fx=908.0)
    assert one.changes_to(two)["fx_px"] == pytest.approx(3.0)
    assert one.apart_mm(one) < 1e-9
    # Points are up to 0.7 of the distance off the axis; 3 of 905 px is 0.33 %.
    assert 0.5 < one.apart_mm(two) < 3.5


@given(value=st.floats(-1e4, 1e4), width=st.floats(1e-6, 1e3))
def test_a_number_is_shown_to_two_digits_of_its_width(value: float, width: float) -> None:
    shown, half = (float(part) for part in str(Interval(value, width)).split(" ± "))
    assert abs(shown - value) <= 0.051 * width + 0.5 * (width > 10.0)
    assert half == pytest.approx(width, rel=0.06)


def test_a_number_is_never_a_negative_zero() -> None:
    assert str(Interval(-0.00001, 0.002)) == "0.0000 ± 0.0020"


def test_a_verdict_says_each_next_step_once() -> None:
    issues = [Issue("few", "take more"), Issue("wide", "take more"), Issue("flat", "tilt")]
    verdict = CalibrationVerdict.of(2e-3, 1e-3, "at 1 m", issues)
    assert not verdict.good
    assert verdict.next_steps == ("take more", "tilt")
    assert str(verdict) == "not good enough: few; wide; flat"
    assert str(CalibrationVerdict.of(5e-4, 1e-3, "at 1 m", [])) == "good enough for 0.5 mm at 1 m"


def test_a_key_with_its_default_may_be_left_out_and_another_value_may_not(tmp_path: Path) -> None:
    """A default is no part of the hash."""
    path = write_result(tmp_path, camera_result_of())
    text = path.read_text()
    assert "lens: pinhole\n" in text
    path.write_text(text.replace("lens: pinhole\n", ""))
    assert load_result(path) == camera_result_of().sealed()
    path.write_text(text.replace("lens: pinhole\n", "lens: fisheye\n"))
    with pytest.raises(BadInput, match="hash"):
        load_result(path)


def test_the_covariance_of_a_camera_pose_goes_into_the_rig(rig: Rig) -> None:
    deviations = np.array([2e-3, 1e-3, 3e-3, 1e-3, 2e-3, 5e-4])
    by_lens = np.arange(48.0).reshape(6, 8) * 1e-4
    found = ExtrinsicCalibration(
        camera=rig.cameras[0],
        by="frame tags",
        covariance=np.diag(deviations**2),
        half_widths=2.0 * 1.96 * deviations,  # twice as wide by the jackknife
        by_lens=by_lens,
        points=workspace_corners(rig),
        tag_errors={},
        pictures=3,
        unused={},
        issues=(),
        data_hash="sha256:0",
    )
    verdict = judge_extrinsics(found, 1e-3)
    result = extrinsics_result(found, verdict, rig.document, date(2026, 3, 1))
    better = rig.with_calibration(result).cameras[0]
    np.testing.assert_allclose(better.pose_covariance, np.diag((2.0 * deviations) ** 2), rtol=1e-9)
    np.testing.assert_allclose(better.pose_by_lens, by_lens, rtol=1e-9)
