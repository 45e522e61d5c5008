"""Calibration results as dated YAML files, beside the rig file and never written into it."""

from __future__ import annotations

from datetime import date
from pathlib import Path

import numpy as np
import yaml

from calibration.camera import CameraCalibration
from calibration.extrinsics import ExtrinsicCalibration
from calibration.verdict import Verdict
from cdpr.documents import write_atomic


def camera_result(
    result: CameraCalibration, verdict: Verdict, name: str, on: date
) -> dict[str, object]:
    """The result in the keys of the rig file's ``cameras`` section, with its quality."""
    values, widths = result.values, result.uncertainty.half_widths
    intervals = {
        key: [value - float(width), value + float(width)]
        for (key, value), width in zip(values.items(), widths, strict=True)
    }
    return {
        "schema_version": 1,
        "kind": "camera",
        "date": on.isoformat(),
        "camera": name,
        "width_px": result.size[0],
        "height_px": result.size[1],
        **{key: values[key] for key in ("fx_px", "fy_px", "cx_px", "cy_px")},
        "distortion": [float(x) for x in result.distortion],
        "rms_px": result.error,
        "intervals": intervals,
        "verdict": str(verdict),
        "good_enough": verdict.good,
        "next_steps": list(verdict.next_steps),
        "distance_m": verdict.distance,
        "error_mm": verdict.error * 1e3,
        "halves_apart_mm": verdict.halves * 1e3,
        "wanted_mm": verdict.wanted * 1e3,
        "covered": verdict.covered,
        "pictures_used": len(result.views),
        "view_errors_px": {k: float(v) for k, v in result.view_errors.items()},
        "unused_pictures": dict(result.unused),
        "data_sha256": result.data_hash,
    }


def extrinsic_result(result: ExtrinsicCalibration, on: date) -> dict[str, object]:
    """The result in the keys of the rig file's ``cameras`` section, with its quality."""
    pose, deviations = result.world_from_camera, np.sqrt(np.diag(result.covariance))
    return {
        "schema_version": 1,
        "kind": "extrinsics",
        "date": on.isoformat(),
        "camera": result.camera.name,
        "world_from_camera": {
            "position_mm": [float(x) * 1e3 for x in pose.position],
            "rotation_wxyz": [float(q) for q in pose.quaternion],
        },
        "standard_deviations": {
            "position_mm": [float(x) * 1e3 for x in deviations[:3]],
            "rotation_deg": [float(np.degrees(x)) for x in deviations[3:]],
        },
        "tag_errors_px": {int(k): float(v) for k, v in result.tag_errors.items()},
        "pictures": result.pictures,
        "data_sha256": result.data_hash,
    }


def write_result(path: Path, result: dict[str, object]) -> None:
    """Writes a result whole or not at all.

    Raises:
        BadInput: The folder cannot be written to.
    """
    write_atomic(path, yaml.safe_dump(result, sort_keys=False, allow_unicode=True))
