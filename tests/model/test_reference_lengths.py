"""Cable lengths given in the notes on the paper, to their printed digits."""

from __future__ import annotations

import numpy as np
import pytest

from model.kinematics import cable_lengths
from model.pose import Pose
from model.rig import load_rig
from model.scene import load_scene
from tests.model.rig_builds import CONFIGS, ipanema

PRINTED_MM = {
    "home": [764.4636, 764.2828, 746.0598, 761.2257, 753.3903, 742.9887, 761.4856, 737.3511],
    "start": [882.834, 713.136, 1036.015, 913.931, 743.760, 453.893, 924.222, 690.741],
    "goal": [852.212, 997.534, 605.820, 811.484, 755.751, 942.030, 539.956, 775.344],
}


@pytest.mark.parametrize(("name", "half_digit"), [("home", 5e-5), ("start", 5e-4), ("goal", 5e-4)])
def test_the_papers_rig_has_the_printed_lengths(name: str, half_digit: float) -> None:
    rig = load_rig(CONFIGS / "gachon_8_6.yaml")
    scene = load_scene(CONFIGS / "environment_1.yaml")
    pose = {"home": rig.home, "start": scene.start, "goal": scene.goal}[name]
    lengths_mm = 1000.0 * cable_lengths(rig, pose)
    np.testing.assert_allclose(lengths_mm, PRINTED_MM[name], rtol=0, atol=1.001 * half_digit)


def test_ipanema_1_has_eight_equal_lengths_at_the_centre() -> None:
    lengths = cable_lengths(ipanema(), Pose.level([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(lengths, 2.614804, rtol=0, atol=5e-7)


@pytest.mark.parametrize("number", [1, 2, 3])
def test_the_example_environments_have_the_papers_obstacles_and_ends(number: int) -> None:
    scene = load_scene(CONFIGS / f"environment_{number}.yaml")
    assert len(scene.obstacles) == number
    np.testing.assert_allclose(scene.start.position, [0.18, 0.18, 0.3])
    np.testing.assert_allclose(scene.goal.position, [-0.18, -0.18, 0.4])
    assert scene.obstacle_clearance == pytest.approx(0.01)
