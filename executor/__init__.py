"""From a verified plan to motion: trajectory, set-points, safety gate, real-time loop, report."""

from __future__ import annotations

from typing import TYPE_CHECKING

from model.lazy import lazy_names

if TYPE_CHECKING:
    from executor.doctor import check_rig
    from executor.homing import home, use_rig_file_counts
    from executor.jogging import jog, jog_cable
    from executor.recording.run_folder import RunFolder
    from executor.report import build_report
    from executor.run_result import RunResult
    from executor.runner import run
    from executor.service import release, reset, status
    from executor.supervision import Supervisor

__all__ = [
    "RunFolder",
    "RunResult",
    "Supervisor",
    "build_report",
    "check_rig",
    "home",
    "jog",
    "jog_cable",
    "release",
    "reset",
    "run",
    "status",
    "use_rig_file_counts",
]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "executor.doctor": "check_rig",
            "executor.homing": "home use_rig_file_counts",
            "executor.jogging": "jog jog_cable",
            "executor.recording.run_folder": "RunFolder",
            "executor.report": "build_report",
            "executor.run_result": "RunResult",
            "executor.runner": "run",
            "executor.service": "release reset status",
            "executor.supervision": "Supervisor",
        },
    )
