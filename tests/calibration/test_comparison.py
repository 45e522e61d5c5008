"""Comparison of two results: chance or change."""

from __future__ import annotations

from dataclasses import replace

import pytest

from calibration.result_files import compare
from model.errors import BadInput
from tests.calibration.results import camera_result_of


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


def test_results_of_different_things_are_refused() -> None:
    with pytest.raises(BadInput, match=r"for 'front' cannot be compared with .* 'side'"):
        compare(camera_result_of(), camera_result_of("side"))


def test_results_for_pictures_of_different_sizes_are_refused() -> None:
    with pytest.raises(BadInput, match="1280 x 720 px, the other's 640 x 480 px"):
        compare(camera_result_of(), camera_result_of(size=(640, 480)))
