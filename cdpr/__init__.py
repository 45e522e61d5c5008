"""Plan, prove, run and measure paths of cable-driven parallel robots.

Functions as the verbs of the command line, with the same defaults; lengths in metres, forces in
newtons, angles in radians. Every name is loaded at first use; `__version__` is that of the package.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

try:
    from model.lazy import lazy_names
except ModuleNotFoundError as error:  # `lazy_names` reports those that hide other packages
    if (found := getattr(sys.modules.get("model"), "__file__", None)) is None:
        raise
    raise ImportError(f"{found} hides the package `model` of cdpr: rename it") from error

if TYPE_CHECKING:
    from calibration.geometry.pose_selection import measurement_poses
    from calibration.procedures import (
        calibrate_camera,
        calibrate_rig,
        locate_camera,
        locate_tags,
    )
    from calibration.targets.boards import Chessboard
    from cdpr.measurement import load_calibration, open_camera, track
    from cdpr.operation import check, plan, report, stop, workspace_map
    from executor.homing import home
    from executor.jogging import jog
    from executor.run_result import RunResult, load_run
    from executor.runner import run
    from executor.service import release, reset, status
    from model.errors import (
        BadInput,
        CdprError,
        Fault,
        HardwareMissing,
        NoSolution,
        Refused,
        StoppedByOperator,
    )
    from model.plan import Plan, load_plan
    from model.pose import Pose
    from model.rig import Rig, load_rig
    from model.scene import Scene, load_scene
    from planner.check_report import CheckReport, PlanRejected
    from planner.planning import plan_from_waypoints
    from tracking.tracker import Tracker

    __version__: str

__all__ = [
    "BadInput",
    "CdprError",
    "CheckReport",
    "Chessboard",
    "Fault",
    "HardwareMissing",
    "NoSolution",
    "Plan",
    "PlanRejected",
    "Pose",
    "Refused",
    "Rig",
    "RunResult",
    "Scene",
    "StoppedByOperator",
    "Tracker",
    "calibrate_camera",
    "calibrate_rig",
    "check",
    "home",
    "jog",
    "load_calibration",
    "load_plan",
    "load_rig",
    "load_run",
    "load_scene",
    "locate_camera",
    "locate_tags",
    "measurement_poses",
    "open_camera",
    "plan",
    "plan_from_waypoints",
    "release",
    "report",
    "reset",
    "run",
    "status",
    "stop",
    "track",
    "workspace_map",
]

if not TYPE_CHECKING:
    _load, __dir__ = lazy_names(
        __name__,
        {
            "calibration.geometry.pose_selection": "measurement_poses",
            "calibration.procedures": "calibrate_camera calibrate_rig locate_camera locate_tags",
            "calibration.targets.boards": "Chessboard",
            "cdpr.measurement": "load_calibration open_camera track",
            "cdpr.operation": "check plan report stop workspace_map",
            "executor.homing": "home",
            "executor.jogging": "jog",
            "executor.run_result": "RunResult load_run",
            "executor.runner": "run",
            "executor.service": "release reset status",
            "model.errors": (
                "BadInput CdprError Fault HardwareMissing NoSolution Refused StoppedByOperator"
            ),
            "model.plan": "Plan load_plan",
            "model.pose": "Pose",
            "model.rig": "Rig load_rig",
            "model.scene": "Scene load_scene",
            "planner.check_report": "CheckReport PlanRejected",
            "planner.planning": "plan_from_waypoints",
            "tracking.tracker": "Tracker",
        },
    )

    def __getattr__(name: str) -> object:
        """A public name or the version, loaded when first used."""
        if name != "__version__":
            return _load(name)
        # Takes longer to import than all else here.
        from importlib.metadata import version

        return version("cdpr")
