"""Why a pose that was found is not believed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cdpr.poses import Pose
from tracking.bundle import BundlePose, TagView
from tracking.settings import TrackerSettings


def doubt(
    limits: TrackerSettings, views: Sequence[TagView], bundle: BundlePose, prior: Pose | None
) -> str:
    """Why a pose is not believed, empty when it is.

    Args:
        limits: When poses are.
        views: The tags that it rests on.
        bundle: The pose, in the camera's frame.
        prior: Where a camera has led to expect it, in the same frame; of the two poses that a
            single tag allows the one near it is believed.
    """
    if bundle.reprojection > limits.reprojection_px:
        return (
            f"the corners fit to {bundle.reprojection:.2f} px only,"
            f" the limit is {limits.reprojection_px:g} px"
        )
    if len(views) == 1 and bundle.rival_cost - bundle.cost < limits.single_tag_margin:
        near = prior is not None and prior.angle_to(bundle.camera_from_body) < 0.1
        if not near:
            return f"only tag {views[0].tag.id} is to be seen, and it allows two poses"
    largest = float(np.sqrt(np.linalg.norm(bundle.covariance[:3, :3], 2)))
    if not largest <= limits.position_deviation:
        return (
            f"the position is uncertain to {largest * 1e3:.1f} mm,"
            f" the limit is {limits.position_deviation * 1e3:g} mm"
        )
    return ""
