"""The checks together: which reason is given, and that nothing is compiled before it is called."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np

from model.scene import load_scene
from planner.edge_checks import FREE, OBSTACLE, SELF, WORKSPACE, WRENCH, ExactChecks
from tests.configs import GACHON

ROOT = Path(__file__).parents[2]
SCENE = load_scene(ROOT / "configs" / "environment_1.yaml")
HOME = GACHON.home.position


def checks(**changes: float) -> ExactChecks:
    limits = {"obstacle_clearance": 0.01, "self_clearance": 0.005, "margin_reserve": 0.2}
    return ExactChecks(GACHON, SCENE, np.eye(3), **(limits | changes))


def test_every_reason_is_reported() -> None:
    aside = HOME + np.array([0.1, 0.0, 0.0])
    assert checks().problem(HOME, aside) == FREE
    assert checks().problem(HOME, HOME + np.array([0.0, 0.0, 1.0])) == WORKSPACE
    assert checks().problem(SCENE.start.position, SCENE.goal.position) == OBSTACLE
    assert checks(self_clearance=0.05).problem(HOME, aside) == SELF
    assert checks(margin_reserve=50.0).problem(HOME, aside) == WRENCH


def test_clearance_is_that_of_the_nearest_body_and_obstacle() -> None:
    distance, body, obstacle = checks().clearance(SCENE.start.position, SCENE.start.position)
    assert (round(distance, 4), body, obstacle) == (0.0322, 6, 0)


def test_importing_the_checks_compiles_nothing() -> None:
    script = (
        "import sys; import planner.collision; assert 'numba' not in sys.modules\n"
        "from planner import edge_checks\n"
        "from planner.collision import edges, rotating_edges, world\n"
        "from planner.wrench import translation\n"
        "kernels = [v for m in (edge_checks, edges, world, translation, rotating_edges)"
        " for v in vars(m).values() if hasattr(v, 'signatures')]\n"
        "assert len(kernels) > 20\n"
        "assert not any(k.signatures for k in kernels)"
    )
    subprocess.run([sys.executable, "-c", script], check=True, cwd=ROOT, timeout=120)
