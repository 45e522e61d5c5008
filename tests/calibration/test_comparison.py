"""Comparison of two results: chance or change."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import date

import pytest

from calibration.intrinsics.calibrate import calibrate_from_views
from calibration.intrinsics.quality import judge_camera
from calibration.intrinsics.result import CameraResult, camera_result
from calibration.result_files import _apart, compare
from calibration.statistics import Interval
from model.errors import BadInput
from tests.calibration.results import camera_result_of, rig_result_of
from tests.calibration.test_lens_models import SIZE, views


def test_a_result_agrees_with_itself() -> None:
    same = compare(camera_result_of(), camera_result_of())
    assert same.agree
    assert same.apart_mm < 1e-9
    assert not any(change.beyond for change in same.changes)
    assert str(same).startswith("they agree")


def test_a_change_beyond_the_interval_is_reported() -> None:
    found = compare(camera_result_of(), camera_result_of(fx=915.0))
    by_name = {change.name: change for change in found.changes}
    assert by_name["fx_px"].by == pytest.approx(10.0)
    assert by_name["fx_px"].allowed == pytest.approx(0.5 * 2**0.5)
    assert by_name["fx_px"].beyond
    assert not by_name["cx_px"].beyond
    assert not found.agree  # 10 of 905 px at 1.5 m are millimetres
    assert "they differ" in str(found)
    assert not replace(by_name["fx_px"], by=-0.7).beyond


@pytest.mark.parametrize("factor", [1.2, 3.0])
def test_intervals_that_are_not_symmetric_count_in_the_direction_of_the_change(
    factor: float,
) -> None:
    low, high = Interval.by_factor(100.0, factor), Interval.by_factor(140.0, factor)
    above, below = 100.0 * (factor - 1.0), 140.0 * (1.0 - 1.0 / factor)
    assert _apart(low, high, 40.0) == pytest.approx(math.hypot(above, below))
    assert _apart(high, low, -40.0) == pytest.approx(math.hypot(above, below))


def test_the_estimate_of_an_interval_that_is_not_symmetric_is_shown() -> None:
    assert str(Interval.by_factor(6000.0, 2.0)) == "6000 +6000 -3000"
    assert str(Interval.by_factor(6000.0, 1.0)) == "6000 ± 0"


def test_consistent_calibrations_of_a_fisheye_agree_and_others_do_not() -> None:
    """The error and the distance of both are in the same unit, also 80° off the axis."""
    one, other = fisheye_result(0), fisheye_result(1)
    compared = compare(one, other)
    assert compared.agree
    assert compared.apart_mm > 0.1 * compared.stated_mm
    refocused = one.model_copy(update={"fx_px": 1.01 * one.fx_px})
    assert not compare(one, refocused).agree


def fisheye_result(seed: int) -> CameraResult:
    found = calibrate_from_views(views("fisheye", seed=seed), SIZE, lens="fisheye")
    return camera_result(found, judge_camera(found, 1e-3), "front", date(2026, 3, 1))


def test_results_of_different_things_are_refused() -> None:
    with pytest.raises(BadInput, match=r"for 'front' cannot be compared with .* 'side'"):
        compare(camera_result_of(), camera_result_of("side"))


def test_results_of_a_rig_are_compared_whatever_their_names() -> None:
    """Two of one day need two names in a folder."""
    first = rig_result_of()
    assert compare(first, first.model_copy(update={"name": "after"})).agree
    with pytest.raises(BadInput, match="different rig files"):
        compare(first, first.model_copy(update={"name": "after", "rests_on": "sha256:other"}))


def test_results_for_pictures_of_different_sizes_are_refused() -> None:
    with pytest.raises(BadInput, match="1280 x 720 px, the other's 640 x 480 px"):
        compare(camera_result_of(), camera_result_of(size=(640, 480)))
