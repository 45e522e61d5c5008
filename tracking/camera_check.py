"""Whether the camera stands where the rig file says, by tags of known place in the world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.errors import Fault
from model.pose import Array, Pose, read_only, skew
from model.rig import Camera
from tracking.camera_model import project_undistorted
from tracking.detection.tags import tag_corners
from tracking.pnp import TagView, solve_pnp


class CameraMoved(Fault):
    """The tags on the frame are not where the camera should see them."""

    code = "camera_moved"


@dataclass(frozen=True, slots=True, eq=False)
class CameraCheck:
    """How far frame tags lie from where the rig file puts them in the image.

    Attributes:
        tags: Numbers of the tags seen whole.
        errors: RMS error of each tag's corners, shape (t,), [px].
        distances: The same at each tag's place, shape (t,), [m].
    """

    tags: tuple[int, ...]
    errors: Array
    distances: Array

    @property
    def error(self) -> float:
        """Median of the tags' errors: one knocked tag among several does not count, [px]."""
        return float(np.median(self.errors)) if len(self.errors) else 0.0

    @property
    def distance(self) -> float:
        """Median of the tags' errors at their places, [m]."""
        return float(np.median(self.distances)) if len(self.distances) else 0.0


def check_camera(camera: Camera, views: Sequence[TagView]) -> CameraCheck:
    """Compares frame tags with where they should be seen; tags seen in part are left out."""
    camera_from_world = camera.world_from_camera.inverse()
    whole = [view for view in views if view.seen.whole]
    errors, distances = [], []
    for view in whole:
        points = camera_from_world.apply(tag_corners(view.tag))
        gap = project_undistorted(camera, points) - view.seen.corners
        errors.append(float(np.sqrt(np.mean(np.sum(gap**2, axis=1)))))
        distances.append(errors[-1] * float(points[:, 2].mean()) / float(camera.matrix[0, 0]))
    tags = tuple(view.tag.id for view in whole)
    return CameraCheck(tags, read_only(errors), read_only(distances))


def measured_camera(camera: Camera, views: Sequence[TagView]) -> tuple[Pose, Array] | None:
    """Where the camera stands by the frame tags it sees.

    Returns:
        ``world_from_camera`` and the covariance of position [m] and rotation vector [rad] along the
        world's axes, shape (6, 6); None when the tags do not give one.
    """
    found = solve_pnp(camera, views, camera.world_from_camera.inverse())
    if found is None or not np.all(np.isfinite(found.covariance)):
        return None
    change = change_of_inverse(found.camera_from_body)
    return found.camera_from_body.inverse(), read_only(change @ found.covariance @ change.T)


def change_of_inverse(pose: Pose) -> Array:
    """How the inverse of a pose shifts and turns when the pose does, shape (6, 6).

    Each shifts [m] and turns [rad] along the axes of its own outer frame: when (R, p) does, its
    inverse turns by −Rᵀ turn, and its position −Rᵀ p shifts by −Rᵀ shift − Rᵀ (p × turn).
    """
    back = pose.rotation.T
    change = np.zeros((6, 6))
    change[:3, :3] = change[3:, 3:] = -back
    change[:3, 3:] = -back @ skew(pose.position)
    return change


def refuse_moved_camera(
    camera: Camera, views: Sequence[TagView], limit_px: float
) -> CameraCheck | None:
    """Checks the camera when frame tags are seen.

    Returns:
        The check, or None when no frame tag is seen whole.

    Raises:
        CameraMoved: Most tags lie farther than ``limit_px`` from where they should be.
    """
    check = check_camera(camera, views)
    if not check.tags:
        return None
    if check.error <= limit_px:
        return check
    values: dict[str, float | str] = {
        "error_px": round(check.error, 3),
        "limit_px": limit_px,
        "error_mm": round(check.distance * 1e3, 2),
        "frame_tags": ", ".join(map(str, check.tags)),
    }
    by = ""
    found = measured_camera(camera, views)
    if found is not None:
        shift = camera.world_from_camera.distance_to(found[0])
        turn = float(np.degrees(camera.world_from_camera.angle_to(found[0])))
        values |= {"moved_mm": round(shift * 1e3, 1), "turned_deg": round(turn, 3)}
        by = f": it is off by {shift * 1e3:.1f} mm and {turn:.2f}°"
    raise CameraMoved(
        f"camera {camera.name!r} is not at the pose in the rig file{by}",
        where=f"frame tags {values['frame_tags']}",
        why=f"reprojection error {check.error:.2f} px ({check.distance * 1e3:.1f} mm), limit"
        f" {limit_px:g} px: the camera or the tags were moved, or the lens refocused",
        next_step="restore it, or calibrate its pose again and write it into the rig file under"
        " cameras: world_from_camera",
        values=values,
    )
