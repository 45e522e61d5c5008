"""The detector of tags that a rig file names."""

from __future__ import annotations

import numpy as np

from model.errors import BadInput
from model.files.camera_file import DETECTORS
from model.pose import Array
from tracking.camera_model import Image
from tracking.detection.detector import Detection, TagDetector


def make_detector(name: str, family: str) -> TagDetector:
    """A detector by its name in rig files.

    Args:
        name: One of `model.files.rig_file.DETECTORS`.
        family: Such as ``tag36h11``.

    Raises:
        BadInput: It is not known, not installed, or does not find the family.
    """
    if name not in DETECTORS:
        raise BadInput(
            f"unknown tag detector {name!r}", next_step=f"use one of {', '.join(DETECTORS)}"
        )
    if name == "apriltag":
        return AprilTagLibrary(family)
    return TagDetector(family)


# Finding tags with pyapriltags, the AprilTag project's own detector (extra ``apriltag``).


#: Its families among those of rig files.
FAMILIES = ("tag16h5", "tag25h9", "tag36h11")


class AprilTagLibrary(TagDetector):
    """As `TagDetector`, by pyapriltags: better at small and faint tags, some times slower.

    Plainly it looks at an image of half the size, thoroughly at the whole one.

    Args:
        family: Such as ``tag36h11``.

    Raises:
        BadInput: It does not know the family, or is not installed.
    """

    def __init__(self, family: str) -> None:
        if family not in FAMILIES:
            raise BadInput(
                f"pyapriltags does not find tags of the family {family!r}",
                where="tags: detector",
                next_step=f"use the detector 'opencv', or one of {', '.join(FAMILIES)}",
            )
        try:
            from pyapriltags import Detector
        except ImportError as error:
            raise BadInput(
                "the tag detector 'apriltag' is not installed",
                where="tags: detector",
                why=str(error),
                next_step="install it with `pip install 'cdpr[apriltag]'`, or use 'opencv'",
            ) from None
        super().__init__(family)
        self._halved = Detector(families=family, nthreads=1, quad_decimate=2.0)
        self._full = Detector(families=family, nthreads=1, quad_decimate=1.0)

    def _detect(self, image: Image, thorough: bool) -> list[Detection]:
        detector = self._full if thorough else self._halved
        found = detector.detect(np.ascontiguousarray(image))
        return [Detection(int(tag.tag_id), _our_corners(tag.corners)) for tag in found]


def _our_corners(corners: Array) -> Array:
    """Its corners run from the bottom left against the clock, and pixels' centres lie at 0.5."""
    return np.asarray(corners, dtype=np.float64)[::-1] - 0.5
