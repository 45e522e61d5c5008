"""`--calibration` and `cdpr calibrate diff`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from calibration.result_files import load_result
from calibration.results import write_result
from model.rig import load_rig
from tests.calibration.results import camera_result_of, rig_result_for
from tests.cli.plans import CONFIGS, RIG
from tests.cli.program import call, nothing_written, one_message

SCENE = CONFIGS / "environment_1.yaml"


def test_a_plan_is_made_for_the_calibrated_rig(tmp_path: Path) -> None:
    result = write_result(tmp_path, camera_result_of())
    answer = call("plan", RIG, SCENE, "-o", tmp_path / "plan.json", "--calibration", result)
    assert answer.code == 0, answer
    rig = json.loads((tmp_path / "plan.json").read_text())["rig"]
    assert rig["cameras"][0]["fx_px"] == 905.0


def test_a_plan_for_a_calibrated_rig_is_checked_against_its_file_with_the_calibration(
    tmp_path: Path,
) -> None:
    """As the refusal without it asks."""
    result = write_result(tmp_path, rig_result_for(load_rig(Path(RIG))))
    plan = tmp_path / "plan.json"
    made = call("plan", RIG, SCENE, "-o", plan, "--calibration", result, "--rounds", "1")
    assert made.code == 0, made
    one_message(call("check", plan, "--rig", RIG), 2, "pass the same --calibration here")
    answer = call("check", plan, "--rig", RIG, "--calibration", result)
    assert answer.code == 0, answer
    one_message(call("check", plan, "--calibration", result), 2, "no effect here: --calibration")


def test_the_next_step_after_a_new_lens_is_the_pose_of_the_camera(tmp_path: Path) -> None:
    rig = load_rig(Path(RIG))
    posed = rig.document.cameras[0].model_copy(update={"pose_covariance": np.eye(6).tolist()})
    document = rig.document.model_copy(update={"cameras": [posed]})
    old, new = tmp_path / "old.yaml", tmp_path / "new.yaml"
    plain = document.model_dump(mode="json", exclude_unset=True)
    old.write_text(yaml.safe_dump(plain), encoding="utf-8")
    result = write_result(tmp_path, camera_result_of())
    answer = call("calibrate", "apply", old, result, "-o", new)
    assert answer.code == 0, answer
    step = f"next `cdpr calibrate extrinsics {new} SOURCE --camera front`"
    assert step in " ".join(answer.out.split())
    assert "# the pose of camera 'front' was found with another lens" in new.read_text("utf-8")


@pytest.mark.parametrize("verb", ["plan", "run", "home", "track"])
def test_results_about_another_camera_are_refused_by_name(tmp_path: Path, verb: str) -> None:
    result = write_result(tmp_path, camera_result_of("side"))
    options = {
        "plan": (RIG, SCENE, "-o", tmp_path / "plan.json"),
        "run": (tmp_path / "plan.json", "--rig", RIG, "-o", tmp_path / "run"),
        "home": (RIG, "--at-home", "--fast"),
        "track": (RIG, tmp_path, "-o", tmp_path / "poses.csv"),
    }[verb]
    if verb == "run":
        assert call("plan", RIG, SCENE, "-o", tmp_path / "plan.json").code == 0
    with nothing_written(tmp_path):
        answer = call(verb, *options, "--calibration", result)
    one_message(answer, 2, "unknown camera 'side'", "front")


@pytest.mark.parametrize("good", [True, False])
def test_a_result_that_is_not_good_enough_is_used_and_reported(tmp_path: Path, good: bool) -> None:
    why = "not good enough: few [images]"
    changes = {} if good else {"good_enough": False, "verdict": why}
    result = write_result(tmp_path, camera_result_of().model_copy(update=changes))
    answer = call("status", RIG, "--calibration", result)
    remark = f"remark calibration camera front, 2026-03-01: {why}"
    assert (remark in answer.err) != good


def test_a_file_that_is_no_result_is_refused(tmp_path: Path) -> None:
    answer = call("track", RIG, tmp_path, "-o", tmp_path / "a.csv", "--calibration", RIG)
    one_message(answer, 2, "not a calibration result", "gachon_8_6.yaml")


def test_results_are_compared(tmp_path: Path) -> None:
    one = write_result(tmp_path, camera_result_of())
    (tmp_path / "later").mkdir()
    same = write_result(tmp_path / "later", camera_result_of(fx=905.3))
    answer = call("calibrate", "diff", one, same)
    assert answer.code == 0, answer
    assert answer.out.splitlines()[1].split()[:3] == ["verdict", "they", "agree:"]
    other = write_result(tmp_path / "later", camera_result_of(fx=925.0))
    answer = call("calibrate", "diff", one, other, "--json")
    assert answer.code == 3
    found = json.loads(answer.out)
    assert found["changes"]["fx_px"]["beyond"]
    assert found["apart_mm"] > found["stated_mm"]


def test_a_result_is_applied_to_a_new_rig_file(tmp_path: Path) -> None:
    """Which is read back as the rig that `--calibration` makes."""
    result, new = write_result(tmp_path, camera_result_of()), tmp_path / "new.yaml"
    answer = call("calibrate", "apply", RIG, result, "-o", new)
    assert answer.code == 0, answer
    expected = load_rig(Path(RIG)).with_calibration(load_result(result))
    assert load_rig(new).document == expected.document
    assert load_rig(new).document.cameras[0].fx_px == 905.0
    remark = "error_mm of camera 'front', 0.5, was stated for another lens and is left out"
    assert f"remark {remark}" in " ".join(answer.err.split())
    assert new.read_text().splitlines()[1].startswith(f"# {remark}")
    answer = call("status", RIG, "--calibration", result)
    assert f"remark {remark}" in " ".join(answer.err.split())


def test_applying_a_result_never_replaces_a_file(tmp_path: Path) -> None:
    result, new = write_result(tmp_path, camera_result_of()), tmp_path / "new.yaml"
    new.write_text("mine", encoding="utf-8")
    with nothing_written(tmp_path):
        answer = call("calibrate", "apply", RIG, result, "-o", new)
    one_message(answer, 2, "exists already", "never replaces")
    assert new.read_text(encoding="utf-8") == "mine"


def test_a_result_about_another_camera_is_not_applied(tmp_path: Path) -> None:
    result = write_result(tmp_path, camera_result_of("side"))
    with nothing_written(tmp_path):
        answer = call("calibrate", "apply", RIG, result, "-o", tmp_path / "new.yaml")
    one_message(answer, 2, "unknown camera 'side'", "front")
