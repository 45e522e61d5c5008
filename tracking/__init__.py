"""From camera images to the platform's pose with covariance, and to measured clearance."""

from __future__ import annotations

from typing import TYPE_CHECKING

from model.lazy import lazy_names

if TYPE_CHECKING:
    from tracking.clearance import MeasuredClearance, clearance_of
    from tracking.fusion import MultiCameraFusion
    from tracking.measurement import NoPose, PoseMeasurement, TrackerSettings
    from tracking.pose_log import write_pose_log
    from tracking.shared_errors import CameraMoved
    from tracking.tracker import Tracker

__all__ = [
    "CameraMoved",
    "MeasuredClearance",
    "MultiCameraFusion",
    "NoPose",
    "PoseMeasurement",
    "Tracker",
    "TrackerSettings",
    "clearance_of",
    "write_pose_log",
]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "tracking.clearance": "MeasuredClearance clearance_of",
            "tracking.fusion": "MultiCameraFusion",
            "tracking.measurement": "NoPose PoseMeasurement TrackerSettings",
            "tracking.pose_log": "write_pose_log",
            "tracking.shared_errors": "CameraMoved",
            "tracking.tracker": "Tracker",
        },
    )
