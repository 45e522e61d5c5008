"""The detector of tags that a rig file names."""

from __future__ import annotations

from cdpr.errors import BadInput
from cdpr.tag_families import DETECTORS
from tracking.detector import TagDetector


def make_detector(name: str, family: str) -> TagDetector:
    """A detector by its name in rig files.

    Args:
        name: One of `cdpr.tag_families.DETECTORS`.
        family: Such as ``tag36h11``.

    Raises:
        BadInput: It is not known, not installed, or does not find the family.
    """
    if name not in DETECTORS:
        raise BadInput(
            f"unknown tag detector {name!r}", next_step=f"use one of {', '.join(DETECTORS)}"
        )
    if name == "apriltag":
        from tracking.apriltag_library import AprilTagLibrary

        return AprilTagLibrary(family)
    return TagDetector(family)
