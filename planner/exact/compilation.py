"""Compiling all kernels at once, and whether that was done before on this machine."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from cdpr.poses import Pose, matrix_from_rotation_vector
from cdpr.rig import Rig
from cdpr.scene import Scene
from planner.exact.checks import ExactChecks
from planner.exact.compiled import cache_folder

_KERNELS = Path(__file__).parent
_STAMP = "complete"


def is_compiled() -> bool:
    """Whether the machine code of these very kernels is in the cache.

    False too where no folder can be written: then every process compiles for itself.
    """
    folder = cache_folder(_KERNELS)
    return folder is not None and (folder / _STAMP).exists()


def compile_all(rig: Rig, scene: Scene, tell: Callable[[str], None] | None = None) -> None:
    """Compiles every kernel that `ExactChecks` uses, or loads it from the cache.

    Args:
        rig: Any robot.
        scene: Any scene.
        tell: Told what is compiled next, once for each of four steps.
    """
    say = tell or _say_nothing
    home = rig.home
    say("workspace proofs")
    checks = ExactChecks(
        rig,
        scene,
        home.rotation,
        obstacle_clearance=scene.obstacle_clearance,
        self_clearance=scene.self_clearance,
        margin_reserve=0.0,
    )
    say("edges")
    checks.problem(home.position, home.position)
    checks.problems([home.position], [home.position])
    say("clearances")
    checks.clearance(home.position, home.position)
    say("turning edges")
    turned = home.rotation @ matrix_from_rotation_vector([0.0, 0.0, 1e-3])
    checks.turning_problem(home, Pose(home.position, turned))
    folder = cache_folder(_KERNELS)
    if folder is not None:
        (folder / _STAMP).touch()


def _say_nothing(step: str) -> None:
    """Stands in where nobody listens."""
