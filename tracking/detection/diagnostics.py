"""What an image shows besides the expected tags, and how soft it is, for helpful messages."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from model.files.camera_file import APRILTAG_FAMILIES
from tracking.camera_model import Image
from tracking.detection.detector import TagDetector

#: Families that identify a wrong one: of ArUco dictionaries of a size the largest holds the
#: others. Those with 16 modules are left out: they are found by chance.
TOLD = (*(f for f in APRILTAG_FAMILIES if f != "tag16h5"), "5X5_1000", "6X6_1000", "7X7_1000")


def diagnose_tags(image: Image, family: str, expected: Sequence[int]) -> str:
    """Says which tags an image shows that are not the expected ones, for an error message.

    Also whether the expected ones are there once it is flipped over.
    """
    seen = []
    for other in (family, *(name for name in TOLD if not _same(name, family))):
        wanted = set(expected) if other == family else set()
        numbers = [d.id for d in TagDetector(other).detect(image) if d.id not in wanted]
        if numbers:
            seen.append(f"{other} {', '.join(map(str, numbers))}")
    told = "; ".join(seen) or "no tag of any known family"
    flipped = np.ascontiguousarray(image[:, ::-1])
    if any(d.id in expected for d in TagDetector(family).detect(flipped)):
        told += "; the expected tags appear mirrored, so the images are mirrored"
    return told


#: Wider edges are out of focus or smeared, [px].
SOFT = 4.5


def edge_width(image: Image) -> float:
    """Width of the sharpest edges of a grey image, [px]: contrast by slope; 1 to 4 in focus."""
    if min(image.shape) < 5:
        return float("inf")
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.7)
    across, down = (cv2.Scharr(smooth, cv2.CV_32F, *axis) / 32.0 for axis in ((1, 0), (0, 1)))
    low, high = np.percentile(smooth, (2.0, 98.0))
    steepest = float(np.percentile(np.hypot(across, down), 99.8))
    return float(high - low) / max(steepest, 1e-9)


def _same(name: str, family: str) -> bool:
    """Whether two families share their tags: ArUco dictionaries of one size do."""
    return name == family or ("X" in name and name.split("_")[0] == family.split("_")[0])
