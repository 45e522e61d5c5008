"""Data for the page: the closest pair, and the measured pose with its ellipsoid."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.special import chdtr

from cdpr.console.view import ELLIPSOID_SCALE, RobotView, measured_data, nearest_data
from executor.recording.run_folder import RunFolder
from executor.remote import status
from model.clearance import ClearanceModel
from model.kinematics import cable_lengths
from model.plan import load_plan
from model.pose import Array, Pose
from model.rig import load_rig
from model.scene import load_scene
from model.statics.gravity import working_tensions
from model.winches import WinchMap
from tests.cli.plans import CONFIGS, RIG, write_short_plan
from tracking.clearance import clearance_at
from tracking.measurement import PoseMeasurement

SCENE = load_scene(CONFIGS / "environment_1.yaml")
THE_RIG = load_rig(RIG)


def status_at(pose: Pose) -> dict[str, Any]:
    """Status of a motion whose drives hold the platform at a pose."""
    winches, tensions = WinchMap(THE_RIG), working_tensions(THE_RIG, pose, SCENE.load).tensions
    counts = winches.counts(winches.unstrained(cable_lengths(THE_RIG, pose), tensions))
    drives = [
        {"position_counts": round(float(count)), "tension_n": round(float(tension), 3)}
        for count, tension in zip(counts, tensions, strict=True)
    ]
    return {"folder": "", "drives": drives}


def test_the_closest_pair_is_shown_where_it_is() -> None:
    view = RobotView(THE_RIG, SCENE)
    pose = Pose(THE_RIG.home.position + np.array([-0.03, 0.02, -0.05]), THE_RIG.home.rotation)
    seen = view.take(status_at(pose))
    assert seen is not None
    assert seen.pose.distance_to(pose) < 1e-4
    expected = ClearanceModel(THE_RIG, SCENE).smallest(pose)
    assert seen.nearest is not None
    assert expected is not None
    shown = nearest_data(seen.nearest, view.required_clearance)
    assert shown["pair"] == [expected.first, expected.second]
    assert shown["now"] == pytest.approx(1e3 * expected.distance, abs=0.2)
    first, second = np.array(shown["points_mm"])
    # The points are on the surfaces, but for the radius of a cable that is nearest.
    assert np.linalg.norm(first - second) == pytest.approx(shown["now"], abs=0.3)
    assert shown["required"] == pytest.approx(1e3 * SCENE.obstacle_clearance)


def test_a_run_that_is_under_way_is_seen_in_its_own_scene(tmp_path: Path) -> None:
    """Its clearance is to the obstacles of its plan, not to those of the console's scene."""
    write_short_plan(tmp_path / "short.json")
    plan = load_plan(tmp_path / "short.json")
    folder = RunFolder.create(tmp_path / "run")
    folder.write_plan(plan.document)
    folder.write_rig(THE_RIG.document)
    view = RobotView(THE_RIG, SCENE)
    with folder.held():
        assert folder.is_active()
        view.take({**status_at(THE_RIG.home), "folder": str(folder.path)})
    assert [one.name for one in view.scene.obstacles] == [o.name for o in plan.scene.obstacles]
    assert view.scene.obstacles != SCENE.obstacles


def measurement_with(covariance: Array) -> dict[str, Any]:
    flat = covariance.reshape(-1).tolist()
    return {
        "position_mm": [1.0, 2.0, 3.0],
        "covariance_mm2": flat,
        "stated": True,
        "clearance": None,
    }


@given(arrays(np.float64, (3, 3), elements=st.floats(-2.0, 2.0)))
def test_the_ellipsoid_is_that_of_the_covariance(root: Array) -> None:
    """Its half axes are at right angles, and their squares add up to the covariance."""
    covariance = root @ root.T
    shown = measured_data(measurement_with(covariance), 0.1)
    axes = np.array(shown["half_axes_mm"])
    assert axes.T @ axes / ELLIPSOID_SCALE**2 == pytest.approx(covariance, abs=2e-3)
    apart = axes @ axes.T
    assert apart - np.diag(np.diag(apart)) == pytest.approx(np.zeros((3, 3)), abs=2e-2)
    assert shown["within_mm"] == pytest.approx(np.linalg.norm(axes, axis=1).max(), abs=2e-3)


def test_the_ellipsoid_holds_95_percent() -> None:
    assert chdtr(3, ELLIPSOID_SCALE**2) == pytest.approx(0.95, abs=1e-5)


def test_a_run_states_all_errors_of_a_measured_position() -> None:
    """Errors common to all images count as much as the scatter; rotations are left out."""
    own, shared = np.diag([1e-8] * 3 + [1.0] * 3), np.diag([3e-8] * 3 + [1.0] * 3)
    pose = Pose(np.array([0.1, -0.2, 0.3]), np.eye(3))
    found = PoseMeasurement(1.25, pose, own, (1,), 0.1, "tracked", shared, unstated=False)
    clearance = clearance_at(ClearanceModel(THE_RIG, SCENE), pose, own + shared, 0.0)
    assert clearance is not None
    said = status.measured_data(found, clearance)
    assert said["time_s"] == 1.25
    assert said["stated"] is True
    assert said["position_mm"] == [100.0, -200.0, 300.0]
    assert said["covariance_mm2"] == pytest.approx((0.04 * np.eye(3)).reshape(-1).tolist())
    near = said["clearance"]
    assert near["low_mm"] < near["distance_mm"] <= near["high_mm"]
    assert near["distance_mm"] == pytest.approx(1e3 * clearance.distance, abs=1e-3)
