"""The example scene with a tilted goal: planned, checked, run with a camera and judged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from executor.recording.run_folder import RunFolder
from model.plan import load_plan
from tests.cli.plans import CONFIGS, rig_for_long_runs
from tests.cli.program import Answer, call


def done(*words: str | Path) -> Answer:
    answer = call(*words)
    assert answer.code == 0, answer
    return answer


@pytest.mark.slow
def test_the_platform_is_put_down_on_the_ramp(tmp_path: Path) -> None:
    plan, folder = tmp_path / "plan.json", tmp_path / "run"
    rig_file = rig_for_long_runs(tmp_path)
    done("plan", rig_file, CONFIGS / "turn.yaml", "-o", plan, "--free-rotation", "--rounds", "60")
    waypoints = load_plan(plan).waypoints
    assert np.degrees(waypoints[0].angle_to(waypoints[-1])) == pytest.approx(6.0)
    assert "passed" in done("check", plan).out
    assert "PASSED" in done("run", plan, "--rig", rig_file, "--fast", "-o", folder).out
    run = RunFolder.open(folder)
    assert run.summary()["verdict"] == "PASSED"
    assert run.poses().rotation[-1] == pytest.approx(waypoints[-1].quaternion, abs=0.002)
    assert (folder / "report.html").exists()
