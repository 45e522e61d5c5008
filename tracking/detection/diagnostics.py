"""Which tags an image shows besides the expected ones, for helpful messages."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from model.files.rig_file import APRILTAG_FAMILIES
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


def _same(name: str, family: str) -> bool:
    """Whether two families share their tags: ArUco dictionaries of one size do."""
    return name == family or ("X" in name and name.split("_")[0] == family.split("_")[0])
