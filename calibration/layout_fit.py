"""Poses of cameras and tags of a platform fitted together: the start, the fit, what spoils it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.optimize import least_squares

from calibration.tag_sights import TagSights
from calibration.tag_views import TagViews, moved_tags
from cdpr.poses import Array, Pose
from cdpr.rig import Camera, Tag
from tracking.bundle import TagView, moved, solve_bundle

HUBER = 3.0
"""Errors of edges beyond so many deviations count linearly."""
_NARROWING = (1e4, 1e2, 2e1, HUBER)
_FAR_OFF_PX = 2.0
"""A picture whose corners are farther off does not show this platform as it is."""


def far_off(sights: TagSights, errors: Sequence[float]) -> dict[str, str]:
    """The picture that fits the others least, and why, where it is far off: it smears the fit."""
    name, error = max(zip(sights.squares, errors, strict=True), key=lambda item: item[1])
    if error <= max(_FAR_OFF_PX, 4.0 * float(np.median(errors))):
        return {}
    return {name: f"has corners that are {error:.2f} px off, far more than the others"}


def starts_of(
    camera: Camera, drawn: Mapping[int, Tag], sights: TagSights
) -> tuple[dict[str, Pose], TagSights]:
    """``camera_from_platform`` of each picture by the rig file; pictures without one are named."""
    starts = {}
    for name, squares in sights.squares.items():
        found = solve_bundle(camera, [TagView(drawn[k], s) for k, s in squares.items()])
        if found is not None:
            starts[name] = found.camera_from_body
    strange = {
        name: "allows no pose of the platform as in the rig file"
        for name in sights.squares
        if name not in starts
    }
    return starts, sights.without(strange)


def fitted(
    views: TagViews, cameras: Sequence[Pose], tags: tuple[Tag, ...]
) -> tuple[list[Pose], tuple[Tag, ...]]:
    """Poses of the cameras and tags that fit; the first tag holds still meanwhile."""
    count = 6 * len(cameras)

    def at(x: Array) -> tuple[list[Pose], tuple[Tag, ...]]:
        steps = x[:count].reshape(-1, 6)
        own = np.concatenate([np.zeros(6), x[count:]])
        return (
            [moved(pose, step) for pose, step in zip(cameras, steps, strict=True)],
            moved_tags(tags, own),
        )

    def slopes(x: Array) -> Array:
        whole = views.dense_slopes(*at(x))
        return np.delete(whole, np.s_[count : count + 6], axis=1)

    # The rig file may be many deviations off, where Huber's loss hardly pulls: so it narrows.
    # Each round starts anew from what was found: steps are small turns about the present poses.
    for scale in _NARROWING:
        found = least_squares(
            lambda x: views.errors(*at(x)).ravel(),
            np.zeros(count + 6 * (len(tags) - 1)),
            jac=slopes,
            loss="huber",
            f_scale=scale,
            x_scale="jac",
            max_nfev=40,
        )
        cameras, tags = at(found.x)
    return list(cameras), tags
