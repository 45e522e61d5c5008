"""Calibration of cameras, tags and rig: dated result files beside the rig file."""

from __future__ import annotations

from typing import TYPE_CHECKING

from model.lazy import lazy_names

if TYPE_CHECKING:
    from calibration.extrinsics.result import ExtrinsicsResult
    from calibration.geometry.pose_selection import measurement_poses
    from calibration.geometry.result import RigResult
    from calibration.intrinsics.result import CameraResult
    from calibration.result_files import load_result
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
    "ExtrinsicsResult",
    "ResultDocument",
    "RigResult",
    "TagGrid",
    "TagsResult",
    "load_result",
    "measurement_poses",
]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "calibration.extrinsics.result": "ExtrinsicsResult",
            "calibration.geometry.pose_selection": "measurement_poses",
            "calibration.geometry.result": "RigResult",
            "calibration.intrinsics.result": "CameraResult",
            "calibration.result_files": "load_result",
            "calibration.results": "Calibration ResultDocument",
            "calibration.tag_map.result": "TagsResult",
            "calibration.targets.boards": "Charuco Chessboard",
            "calibration.targets.grids": "CircleGrid TagGrid",
        },
    )
