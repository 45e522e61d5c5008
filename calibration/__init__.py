"""Calibration of cameras, tags and rig: dated result files beside the rig file."""

from __future__ import annotations

from typing import TYPE_CHECKING

from model.lazy import lazy_names

if TYPE_CHECKING:
    from calibration.extrinsics.camera_pairs import locate_camera_by_another
    from calibration.extrinsics.result import ExtrinsicsResult
    from calibration.extrinsics.surveyed_tags import Survey
    from calibration.geometry.pose_selection import measurement_poses
    from calibration.geometry.result import RigResult
    from calibration.intrinsics.readout import ReadoutResult
    from calibration.intrinsics.result import CameraResult
    from calibration.procedures import calibrate_camera_from_corners, measure_readout
    from calibration.result_files import Comparison, compare, load_result
    from calibration.results import Calibration, ResultDocument
    from calibration.tag_map.result import TagsResult
    from calibration.targets.boards import Charuco, Chessboard
    from calibration.targets.grids import CircleGrid, TagGrid

__all__ = [
    "Calibration",
    "CameraResult",
    "Charuco",
    "Chessboard",
    "CircleGrid",
    "Comparison",
    "ExtrinsicsResult",
    "ReadoutResult",
    "ResultDocument",
    "RigResult",
    "Survey",
    "TagGrid",
    "TagsResult",
    "calibrate_camera_from_corners",
    "compare",
    "load_result",
    "locate_camera_by_another",
    "measure_readout",
    "measurement_poses",
]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "calibration.extrinsics.camera_pairs": "locate_camera_by_another",
            "calibration.extrinsics.result": "ExtrinsicsResult",
            "calibration.extrinsics.surveyed_tags": "Survey",
            "calibration.geometry.pose_selection": "measurement_poses",
            "calibration.geometry.result": "RigResult",
            "calibration.intrinsics.readout": "ReadoutResult",
            "calibration.intrinsics.result": "CameraResult",
            "calibration.procedures": "calibrate_camera_from_corners measure_readout",
            "calibration.result_files": "Comparison compare load_result",
            "calibration.results": "Calibration ResultDocument",
            "calibration.tag_map.result": "TagsResult",
            "calibration.targets.boards": "Charuco Chessboard",
            "calibration.targets.grids": "CircleGrid TagGrid",
        },
    )
