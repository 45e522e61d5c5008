"""The example scene with a pick and a put-down, from the file to the verdict; and its halves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from executor.recording.run_folder import RunFolder
from model.plan import load_plan
from model.rig import load_rig
from tests.cli.plans import CONFIGS, rig_for_long_runs
from tests.cli.program import call

SCENE = CONFIGS / "pick_and_place.yaml"
#: Payload of each leg, [kg].
CARRIED = [0.0, 1.2, 1.2, 0.0, 0.5, 0.5, 0.0]


@pytest.mark.slow
def test_the_ready_scene_is_planned_checked_and_run_with_the_camera(tmp_path: Path) -> None:
    plan, run = tmp_path / "plan.json", tmp_path / "run"
    rig_file = rig_for_long_runs(tmp_path)
    planned = call("plan", rig_file, SCENE, "-o", plan, "--rounds", "20")
    assert planned.code == 0, planned
    assert "tray (pick 2 s, then 1.2 kg), over the wall (pass), shelf" in planned.said
    checked = call("check", plan)
    assert checked.code == 0, checked
    ran = call("run", plan, "--rig", rig_file, "-o", run, "--fast")
    assert ran.code == 0, ran.out
    assert "at stop 'tray', resting for 2 s while 1.2 kg is picked up" in ran.err

    folder = RunFolder.open(run)
    cycles, summary, rig = folder.cycles(), folder.summary(), load_rig(rig_file)
    assert summary["verdict"] == "PASSED"
    assert list(dict.fromkeys(cycles.leg.tolist())) == [1, 2, 3, 4, 5, 6, 7]
    scene = load_plan(plan).scene
    for stop, times in zip(scene.stops, summary["stops"], strict=True):
        assert times["name"] == stop.name
        stood = times["left_s"] - times["reached_s"]
        assert stood == pytest.approx(stop.dwell, abs=rig.cycle + 0.001)
        there = np.array(cycles.stop) == stop.name
        assert np.linalg.norm(cycles.encoder[there] - stop.pose.position, axis=1).max() < 1e-4
    # The drives' torques hold platform and payload: compare the vertical force.
    outlets = rig.outlets
    for leg, mass in enumerate(CARRIED, start=1):
        rows = np.flatnonzero((cycles.leg == leg) & (np.array(cycles.stop) == ""))
        row = int(rows[len(rows) // 2])
        anchors = cycles.encoder[row] + rig.anchors
        up = (outlets - anchors)[:, 2] / np.linalg.norm(outlets - anchors, axis=1)
        assert up @ cycles.tensions[row] == pytest.approx((0.4 + mass) * 9.80665, abs=0.5)
