"""Collision-free, feasible paths for a rig in a scene, and the independent check of a plan."""

from __future__ import annotations

from typing import TYPE_CHECKING

from model.lazy import lazy_names

if TYPE_CHECKING:
    from planner.check import check_path, verify
    from planner.check_report import CheckReport, PlanRejected, VerifiedPlan, Violation
    from planner.planning import plan_from_waypoints, plan_path
    from planner.settings import OptimalSettings, PlannerSettings, TurningSettings, Weights

__all__ = [
    "CheckReport",
    "OptimalSettings",
    "PlanRejected",
    "PlannerSettings",
    "TurningSettings",
    "VerifiedPlan",
    "Violation",
    "Weights",
    "check_path",
    "plan_from_waypoints",
    "plan_path",
    "verify",
]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "planner.check": "check_path verify",
            "planner.check_report": "CheckReport PlanRejected VerifiedPlan Violation",
            "planner.planning": "plan_from_waypoints plan_path",
            "planner.settings": "OptimalSettings PlannerSettings TurningSettings Weights",
        },
    )
