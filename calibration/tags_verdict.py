"""Whether the tags of a platform are located well enough."""

from __future__ import annotations

import numpy as np

from calibration.tag_layout import TagLayout
from calibration.verdict import Lack, Verdict

GOOD_PICTURES, GOOD_VIEWS, GOOD_ERROR = 12, 4, 0.3
"""Pictures in all, pictures of each tag, pixels."""
GOOD_SIDES_DEG = 40.0
GOOD_SCALE = 0.02
"""Share by which a layout may be larger or smaller than in the rig file."""
FAR_MM, FAR_DEG = 10.0, 8.0
"""A tag farther from its place in the rig file was glued elsewhere, or this is another platform."""


def judge_layout(result: TagLayout, wanted: float) -> Verdict:
    """Judges a layout.

    Args:
        result: What was found.
        wanted: What is good enough, for corners of tags, [m].
    """
    lacks = [*_about_pictures(result), *_about_tags(result)]
    error = result.error
    if not error <= wanted:
        what = f"tags are located within {error * 1e3:.2g} mm, {wanted * 1e3:.2g} mm are wanted"
        lacks.append(Lack(what, "take more pictures, closer, sharp and from all sides"))
    return Verdict.of(error, wanted, "in the tags' places", lacks)


def _about_pictures(result: TagLayout) -> list[Lack]:
    lacks = []
    if len(result.errors) < GOOD_PICTURES:
        what = f"{len(result.errors)} pictures show two tags or more, {GOOD_PICTURES} are needed"
        lacks.append(Lack(what, "take 20 pictures from all sides, two or three tags in each"))
    if np.degrees(result.sides) < GOOD_SIDES_DEG:
        what = (
            f"all pictures are taken from within {np.degrees(result.sides):.0f}°,"
            f" {GOOD_SIDES_DEG:.0f}° are needed"
        )
        lacks.append(Lack(what, "take pictures from all sides, not alike"))
    if result.reprojection > GOOD_ERROR:
        what = f"corners are {result.reprojection:.2f} px off"
        step = "check sizes and numbers of the tags, that they lie flat, and the camera's numbers"
        lacks.append(Lack(what, step))
    if abs(result.scale - 1.0) > GOOD_SCALE:
        way = "larger" if result.scale > 1.0 else "smaller"
        what = f"the layout is {abs(result.scale - 1.0):.1%} {way} than in the rig file"
        lacks.append(Lack(what, "measure the black squares and correct size_mm in the rig file"))
    return lacks


def _about_tags(result: TagLayout) -> list[Lack]:
    lacks = []
    for number, why in result.unseen.items():
        step = f"take pictures that show tag {number} together with others"
        lacks.append(Lack(f"tag {number} {why}", step))
    for number, count in result.seen.items():
        if count < GOOD_VIEWS:
            what = f"tag {number} is in {count} pictures, {GOOD_VIEWS} are needed"
            lacks.append(Lack(what, f"take more pictures of tag {number} with its neighbours"))
    for tag, drawn in zip(result.tags, result.drawn, strict=True):
        shift, turn = drawn.pose.distance_to(tag.pose) * 1e3, drawn.pose.angle_to(tag.pose)
        if shift > FAR_MM or np.degrees(turn) > FAR_DEG:
            what = f"tag {tag.id} is {shift:.1f} mm and {np.degrees(turn):.1f}° from the rig file"
            step = f"check that tag {tag.id} is where, and turned as, the rig file says"
            lacks.append(Lack(what, step))
    return lacks
