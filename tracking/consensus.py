"""Which of the squares that were seen belong to the body: geometry decides.

A tag of the same family and number may hang on a wall, lie on a table or stand on a screen. Every
square allows two poses of the body; the pose that most squares agree on is the body's, and of a tag
that is seen twice the square that fits it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from model.pose import Pose
from model.rig import Camera
from tracking.camera_model import project_undistorted
from tracking.detection.tags import tag_corners
from tracking.pnp import TagView, square_poses

#: A square agrees with a pose when its corners are this near, as a share of its own side, and [px].
AGREEMENT, LEAST_AGREEMENT = 0.15, 3.0
#: Poses that differ less are one and the same, [m].
SAME = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Consensus:
    """The squares that agree.

    Attributes:
        views: Of each tag at most one.
        ambiguous: Numbers of tags that are seen more than once while it is unknown which is the
            body's; then there are no views.
    """

    views: list[TagView]
    ambiguous: tuple[int, ...] = ()


def agreeing(
    camera: Camera, views: Sequence[TagView], possible: Callable[[Pose], bool]
) -> Consensus:
    """The largest set of squares that agree on one possible pose of the body.

    Args:
        camera: The camera that saw them.
        views: Squares with the tags whose numbers they carry; a tag may be there more than once.
        possible: Whether the body can be at ``camera_from_body``.
    """
    found: list[tuple[int, float, Pose, list[TagView]]] = []
    for view in views:
        for pose in square_poses(camera, view):
            if possible(pose):
                fitting = _fitting(camera, views, pose)
                misfit = sum(gap for gap, _ in fitting.values()) / max(1, len(fitting))
                found.append((len(fitting), misfit, pose, [v for _, v in fitting.values()]))
    if not found:
        return Consensus([])
    found.sort(key=lambda item: (-item[0], item[1]))
    most, _, best, members = found[0]
    chosen = {id(view) for view in members}
    for count, _, pose, others in found[1:]:
        elsewhere = not chosen & {id(view) for view in others}
        if count == most and elsewhere and pose.distance_to(best) > SAME:
            twice = sorted({view.tag.id for view in (*members, *others)})
            return Consensus([], tuple(twice))
    return Consensus(members)


def _fitting(
    camera: Camera, views: Sequence[TagView], pose: Pose
) -> dict[int, tuple[float, TagView]]:
    """Of each tag the square that fits a pose best, with its misfit, where one fits at all."""
    best: dict[int, tuple[float, TagView]] = {}
    for view in views:
        points = pose.apply(tag_corners(view.tag))
        if np.any(points[:, 2] < 1e-3):
            continue
        seen = view.seen.corners
        side = float(np.sqrt(np.mean(np.sum((seen - np.roll(seen, 1, axis=0)) ** 2, axis=1))))
        gap = float(
            np.sqrt(np.mean(np.sum((project_undistorted(camera, points) - seen) ** 2, axis=1)))
        )
        near = gap < max(LEAST_AGREEMENT, AGREEMENT * side)
        if near and (view.tag.id not in best or gap < best[view.tag.id][0]):
            best[view.tag.id] = (gap, view)
    return best
