"""The scatter of poses from whole counts and noisy torques agrees with their covariance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from executor.recording.clearance import encoder_covariance, tension_noise
from model.clearance import ClearanceModel
from model.kinematics import cable_lengths, forward_kinematics
from model.pose import Array, Pose, rotation_vector_from_matrix
from model.rig import Rig, load_rig, rig_from_document
from model.scene import load_scene
from model.statics.gravity import working_tensions
from model.winches import WinchMap
from tests.cli.plans import CONFIGS, RIG
from tracking.clearance import clearance_at


def soft(stiffness_n: float) -> Rig:
    rig = load_rig(Path(RIG))
    cables = rig.document.cables.model_copy(update={"stiffness_n": stiffness_n})
    return rig_from_document(rig.document.model_copy(update={"cables": cables}))


def found(rig: Rig, winches: WinchMap, pose: Pose, noise: float, count: int) -> Array:
    """Twists from the true pose to encoder poses with rounded counts and noisy torques."""
    random = np.random.default_rng(5)
    tensions = working_tensions(rig, pose).tensions
    counts = winches.counts(winches.unstrained(cable_lengths(rig, pose), tensions))
    twists = []
    for _ in range(count):
        rounded = counts + random.uniform(-0.5, 0.5, rig.cable_count)
        measured = tensions + noise * random.standard_normal(rig.cable_count)
        lengths = winches.strained(winches.unstrained_from_counts(rounded), measured)
        at = forward_kinematics(rig, lengths, pose).pose
        rotated = rotation_vector_from_matrix(at.rotation @ pose.rotation.T)
        twists.append(np.concatenate([at.position - pose.position, rotated]))
    return np.array(twists)


@pytest.mark.parametrize("stiffness_n", [848e3, 7e3])
def test_it_is_what_many_measurements_show(stiffness_n: float) -> None:
    rig = soft(stiffness_n)
    winches = WinchMap(rig)
    pose = Pose.level(rig.home.position + np.array([0.08, -0.05, 0.06]))
    stated = encoder_covariance(winches, rig, pose, np.full(rig.cable_count, 0.5))
    seen = found(rig, winches, pose, 0.5, 400)
    assert np.sqrt(np.diag(stated)) == pytest.approx(seen.std(axis=0), rel=0.15)


def test_soft_cables_and_noisy_torques_make_it_worse() -> None:
    stiff, weak = soft(848e3), soft(1.4e3)

    def worst(rig: Rig, noise: float) -> float:
        measured = np.full(rig.cable_count, noise)
        covariance = encoder_covariance(WinchMap(rig), rig, rig.home, measured)
        return float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))

    assert worst(stiff, 0.5) < 0.1e-3
    assert worst(weak, 0.5) > 5.0 * worst(stiff, 0.5)
    assert worst(weak, 5.0) > 5.0 * worst(weak, 0.5)


def test_the_error_of_a_calibrated_rig_is_in_the_interval_of_the_platform() -> None:
    """At every point of the platform, in every direction."""
    rig = load_rig(Path(RIG))
    stated = rig_from_document(rig.document.model_copy(update={"platform_error_mm": 1.4}))
    noise = np.full(rig.cable_count, 0.5)
    known, exact = (
        encoder_covariance(WinchMap(one), one, rig.home, noise) for one in (stated, rig)
    )
    own = 1.96**2 * np.diag(exact)[:3]
    assert 1.96**2 * np.diag(known)[:3] == pytest.approx(own + 1.4e-3**2, rel=1e-6)
    assert known[3:] == pytest.approx(exact[3:])
    model = ClearanceModel(stated, load_scene(CONFIGS / "environment_1.yaml"))
    clearance = clearance_at(model, rig.home, known, 0.0)
    assert clearance is not None
    assert clearance.uncertainty >= 1.4e-3


def test_noise_is_taken_from_what_changes_between_cycles() -> None:
    rig = load_rig(Path(RIG))
    random = np.random.default_rng(2)
    slow = 20.0 + 5.0 * np.sin(np.linspace(0.0, 3.0, 4000))[:, None] * np.ones(rig.cable_count)
    true = np.linspace(0.2, 3.0, rig.cable_count)
    measured = slow + true * random.standard_normal(slow.shape)
    assert tension_noise(rig, measured) == pytest.approx(true, rel=0.1)
    rounding = tension_noise(rig, np.full((5, rig.cable_count), np.nan))
    assert (rounding > 0.0).all()
    assert tension_noise(rig, np.ones((5, rig.cable_count))) == pytest.approx(rounding)
