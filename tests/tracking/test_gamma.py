"""Images that encode light by a gamma, as webcams send them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from model.files.camera_file import Gamma
from model.pose import Pose
from model.rig import Camera, Rig
from model.scene import Scene
from simulation.camera.camera import Optics, SyntheticCamera
from tracking.camera_model import encoded, linear
from tracking.measurement import PoseMeasurement
from tracking.tracker import Tracker

GAMMAS: tuple[Gamma, ...] = ("srgb", 1.5, 2.2)


def errors(rig: Rig, scene: Scene, true: Gamma, stated: Gamma) -> list[tuple[float, float]]:
    """Errors of the position and their stated deviations along the worst direction, [m]."""
    camera = replace(rig.cameras[0], gamma=true)
    synthetic = SyntheticCamera(rig, scene, camera, seed=3, optics=Optics(blur=0.6))
    draw, found = np.random.default_rng(4), []
    for number in range(4):
        pose = Pose.level(rig.home.position + draw.uniform(-0.1, 0.1, 3))
        tracker = Tracker(rig, replace(camera, gamma=stated))
        measured = tracker.observe(synthetic.render(pose, number), 0.0)
        if isinstance(measured, PoseMeasurement):
            deviation = float(np.sqrt(np.linalg.eigvalsh(measured.covariance[:3, :3])[-1]))
            found.append((measured.pose.distance_to(pose), deviation))
    return found


@pytest.mark.parametrize("gamma", GAMMAS)
def test_a_stated_gamma_costs_no_accuracy(rig: Rig, scene: Scene, gamma: Gamma) -> None:
    found = errors(rig, scene, gamma, gamma)
    assert len(found) == 4
    for error, deviation in found:
        assert error < 4.0 * deviation < 0.5e-3


def test_a_gamma_that_is_not_stated_moves_all_edges(rig: Rig, scene: Scene) -> None:
    """Bright regions look larger, so the tags contradict each other, as those of a wrong size."""
    assert not errors(rig, scene, "srgb", 1.0)


@pytest.mark.parametrize("gamma", [*GAMMAS, 1.0])
def test_grey_levels_are_coded_and_decoded(camera: Camera, gamma: Gamma) -> None:
    of = replace(camera, gamma=gamma)
    levels = np.arange(256, dtype=np.uint8)[None]
    coded = encoded(of, levels).astype(int)
    assert (coded[0, 0], coded[0, 255]) == (0, 255)
    assert np.all(np.diff(coded) >= 0)
    assert np.all(coded >= levels), "brighter than light"
    back = linear(of, encoded(of, levels)).astype(int)
    assert np.abs(back - levels).max() <= 1
    if gamma == "srgb":  # IEC 61966-2-1: a fifth of the light is grey level 124 of 255
        assert coded[0, 51] == 124
