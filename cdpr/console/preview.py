"""A plan before it is run: its path, its proof, and how clearance and tensions go along it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cdpr.console.view import scene_figure
from executor.report.scene import plan_labels
from executor.runner import prepare_plan
from executor.trajectory.prepare import PreparedRun
from model.clearance import ClearanceModel
from model.errors import CdprError
from model.kinematics import cables_at
from model.pages.scene import Moment, Stroke, scene_data
from model.plan import Plan, load_plan, require_same_rig
from model.pose import Pose
from model.rig import Rig

#: Poses that are drawn, and at which clearance is computed.
POSES = 200


def preview(path: Path, rig: Rig) -> dict[str, Any]:
    """What the page shows of a plan; one that does not pass says why.

    Raises:
        BadInput: It cannot be read, or is for another rig.
    """
    plan = load_plan(path)
    require_same_rig(plan, rig, path)
    try:
        prepared = prepare_plan(plan, rig)
    except CdprError as error:
        return {
            "name": str(path),
            "passed": False,
            "verdict": error.what,
            "checks": [],
            "duration_s": None,
            "length_mm": None,
            "least_clearance_mm": None,
            "largest_tension_n": None,
            **_drawn(rig, plan, []),
            "curves": None,
        }
    report = prepared.checked.report
    rows = _rows(prepared)
    table = prepared.checked.table
    poses = [Pose(table.positions[row], table.rotations[row]) for row in rows]
    times = [round(row * table.cycle, 3) for row in rows]
    return {
        "name": str(path),
        "passed": True,
        "verdict": "passed every check",
        "checks": _checks(prepared),
        "duration_s": round(prepared.duration, 1),
        "length_mm": round(prepared.length * 1e3, 1),
        "least_clearance_mm": _in_mm(report.proved_obstacle_clearance),
        "largest_tension_n": round(report.max_tension, 1),
        **_drawn(rig, plan, list(zip(times, poses, strict=True))),
        "curves": {
            "time_s": times,
            "clearance_mm": _clearances(rig, plan, poses),
            "required_mm": round(report.required_obstacle_clearance * 1e3, 2),
            "tensions_n": np.round(table.tensions[rows].T, 2).tolist(),
        },
    }


def _in_mm(distance: float) -> float | None:
    """A distance [m] as the page takes it; None where nothing is near."""
    return round(distance * 1e3, 1) if np.isfinite(distance) else None


def _rows(prepared: PreparedRun) -> list[int]:
    count = len(prepared.checked.table)
    even = np.linspace(0, count - 1, min(count, POSES))
    return sorted({round(float(row)) for row in even})


def _checks(prepared: PreparedRun) -> list[str]:
    report = prepared.checked.report
    told = []
    if np.isfinite(report.proved_obstacle_clearance):
        told.append(
            f"clearance to obstacles at least {report.proved_obstacle_clearance * 1e3:.1f} mm,"
            f" required {report.required_obstacle_clearance * 1e3:.1f} mm"
        )
    told.append(
        f"clearance of cables to each other and to the platform at least"
        f" {report.proved_self_clearance * 1e3:.1f} mm,"
        f" required {report.required_self_clearance * 1e3:.1f} mm"
    )
    told.append(f"tensions {report.min_tension:.1f} to {report.max_tension:.1f} N")
    return told


def _clearances(rig: Rig, plan: Plan, poses: list[Pose]) -> list[float | None] | None:
    if not plan.scene.obstacles:
        return None
    model = ClearanceModel(rig, plan.scene)
    near = [model.smallest(pose) for pose in poses]
    return [None if one is None else round(one.distance * 1e3, 2) for one in near]


def _drawn(rig: Rig, plan: Plan, moments: list[tuple[float, Pose]]) -> dict[str, Any]:
    points = np.array([pose.position for pose in plan.waypoints])
    figure = scene_figure(rig, plan.scene, Stroke.along("path", "ink", points, 4.5))
    drawn = tuple(
        Moment(time, pose.position, pose.rotation, cables_at(rig, pose).exits)
        for time, pose in moments
    )
    return scene_data(replace(figure, labels=plan_labels(plan), moments=drawn))
