"""``summary.json``: verdict and key figures of a run, computed from its tables.

`executor.recording.record_files.SummaryDocument` names the keys, docs/run-folder.md explains them.
An unknown number is null.

``path_length_mm`` of the plan, with its corners, and ``travelled_mm`` of the run are lengths along
the path: rotation counts as `executor.trajectory.path` says. A plan's own ``length_mm`` is the
distance travelled by the platform's origin.
"""

from __future__ import annotations

import platform
from dataclasses import asdict
from datetime import UTC
from importlib.metadata import PackageNotFoundError, version
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from executor.recording.clearance import ClearanceTable
from executor.recording.tables import CycleTable, PoseTable
from executor.recording.verdict import RunContext, judge
from executor.trajectory.path import line
from model.plan import Plan
from model.pose import Array
from model.rig import Rig
from model.statics.wrench_sets import rms_anchor_radius

OPENCV = "opencv-python-headless"
LIBRARIES = (
    "cdpr",
    "numpy",
    "python-can",
    "canopen",
    OPENCV,
    "python-fcl",
)


def versions() -> dict[str, str]:
    """Versions of Python and of the main libraries, by name."""
    found = {"python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    if not found[OPENCV].startswith(cv2.__version__):
        # Another distribution of OpenCV, as other packages require, replaced the files of this one.
        found[OPENCV] = cv2.__version__
    return found


def summarize(
    context: RunContext, cycles: CycleTable, poses: PoseTable, clearance: ClearanceTable
) -> dict[str, Any]:
    """The content of ``summary.json``."""
    plan, rig, course = context.plan, context.rig, context.course
    verdict = judge(context, cycles, poses, clearance)
    return {
        "schema_version": 1,
        "verdict": verdict.word,
        "passed": verdict.passed,
        "sentence": verdict.sentence,
        "reasons": verdict.reasons,
        "checks": [asdict(check) for check in verdict.checks],
        "rig": rig.name,
        "scene": plan.scene.name,
        "plan_hash": plan.document.hash,
        "rig_hash": rig.hash,
        "interface": course.interface,
        "simulated": context.simulated,
        "fast": course.fast,
        "started": course.started.astimezone(UTC).isoformat(timespec="milliseconds"),
        "duration_s": round(_duration(cycles, rig), 6),
        "cycles": len(cycles),
        "cycle_ms": rig.document.bus.cycle_ms,
        "lost_replies": int(cycles.missing.sum()),
        "rejected_frames": int(cycles.rejected.max(initial=0)),
        "error_frames": int(cycles.error_frames.max(initial=0)),
        "path_length_mm": _path_length(plan, rig) * 1e3,
        "travelled_mm": _last(cycles.travelled * 1e3),
        "stops": [
            {"name": stop.name, "kind": stop.kind, **_times_at(cycles, number, stop.name)}
            for number, stop in enumerate(plan.scene.stops, start=1)
        ],
        "following_error_mm": {
            **_size(cycles.following_error * 1e3),
            "limit": rig.motion.following_error * 1e3,
        },
        "encoder_error_mm": _size(cycles.encoder_error[cycles.time >= cycles.path_began] * 1e3),
        "tag_error_mm": _tag_error(poses, cycles.path_began),
        "cameras": [asdict(camera) for camera in course.cameras],
        "clearance_mm": _clearance(clearance, plan.scene.obstacle_clearance),
        "tension_n": _tension(cycles, rig),
        "lateness_ms": None if course.fast else _lateness(cycles.lateness * 1e3),
        "final_state": course.final_state,
        "events": [asdict(event) for event in context.events],
        "versions": dict(course.versions),
    }


def _duration(cycles: CycleTable, rig: Rig) -> float:
    """From the beginning of the first cycle to the end of the last, [s]."""
    return float(cycles.time[-1]) + rig.cycle if len(cycles) else 0.0


def _path_length(plan: Plan, rig: Rig) -> float:
    """Length of a plan, rotation counted as along the path, [m]."""
    weight = rms_anchor_radius(rig.anchors)
    return sum(line(start, end, weight).length for start, end in pairwise(plan.waypoints))


def _times_at(cycles: CycleTable, number: int, name: str) -> dict[str, float | None]:
    """Times at which the stop that ends a leg was reached and left; None for never."""
    left = cycles.leg > number
    reached = left | (np.array(cycles.stop, dtype=str) == name)
    return {"reached_s": _first(cycles, reached), "left_s": _first(cycles, left)}


def _first(cycles: CycleTable, chosen: NDArray[np.bool_]) -> float | None:
    return _number(cycles.time[int(np.argmax(chosen))]) if chosen.any() else None


def _number(value: float, digits: int = 6) -> float | None:
    return round(float(value), digits) if np.isfinite(value) else None


def _last(values: Array) -> float | None:
    return _number(values[-1]) if len(values) else None


def _size(values: Array) -> dict[str, float | None]:
    known = values[np.isfinite(values)]
    if not known.size:
        return {"max": None, "rms": None}
    return {"max": _number(known.max()), "rms": _number(np.sqrt(np.mean(known**2)))}


def _tag_error(poses: PoseTable, path_began: float) -> dict[str, float | int | None] | None:
    """Distances from the plan since the motion along it began; numbers of all images."""
    if not len(poses):
        return None
    return {
        **_size(poses.error[poses.ok & (poses.time >= path_began)] * 1e3),
        "frames": len(poses),
        "frames_without_pose": int(len(poses) - poses.ok.sum()),
    }


def _clearance(clearance: ClearanceTable, required: float) -> dict[str, Any] | None:
    """The smallest clearance: the camera's unless it missed it, then that of the encoders."""
    for source in _measuring(clearance):
        rows = clearance.of(source)
        if len(rows) and np.isfinite(rows.distance).any():
            at = int(np.nanargmin(rows.distance))
            return {
                "required": _number(required * 1e3),
                "planned_min": _number(np.nanmin(clearance.planned_distance) * 1e3),
                "measured_min": _number(rows.distance[at] * 1e3),
                "measured_uncertainty": _number(rows.uncertainty[at] * 1e3),
                "measured_at_most": _number(rows.at_most[at] * 1e3),
                "pair": [rows.body[at], rows.obstacle[at]],
                "at_s": _number(rows.time[at]),
                "source": source,
            }
    return None


def _measuring(clearance: ClearanceTable) -> tuple[str, ...]:
    """Sources of the smallest clearance, the best first.

    The encoders come first if the camera missed the smallest: theirs is below the camera's, and
    below their own at the times of all camera poses by more than the uncertainties of both.
    """
    seen, counted = clearance.of("tag"), clearance.of("encoder")
    measured, known = np.isfinite(seen.distance), np.isfinite(counted.distance)
    if not (measured.any() and known.any()):
        return ("tag", "encoder")
    nearest = int(np.nanargmin(counted.distance))
    least = counted.distance[nearest]
    there = np.interp(seen.time[measured], counted.time[known], counted.distance[known])
    missed = least + counted.uncertainty[nearest] < (there - seen.uncertainty[measured]).min()
    below = least < seen.distance[measured].min()
    return ("encoder", "tag") if missed and below else ("tag", "encoder")


def _tension(cycles: CycleTable, rig: Rig) -> dict[str, float | None]:
    low, high = _range(cycles.tensions)
    planned_low, planned_high = _range(cycles.planned_tensions)
    return {
        "min": low,
        "max": high,
        "planned_min": planned_low,
        "planned_max": planned_high,
        "lower_limit": rig.min_tension,
        "upper_limit": rig.max_tension,
    }


def _range(values: Array) -> tuple[float | None, float | None]:
    known = values[np.isfinite(values)]
    if not known.size:
        return None, None
    return _number(known.min(), 4), _number(known.max(), 4)


def _lateness(values: Array) -> dict[str, float | None]:
    if not len(values):
        return {"p50": None, "p99": None, "max": None}
    middle, high = np.percentile(values, [50.0, 99.0])
    return {"p50": _number(middle, 4), "p99": _number(high, 4), "max": _number(values.max(), 4)}
