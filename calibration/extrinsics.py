"""Where the camera stands, from surveyed tags on the frame."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from cdpr.errors import BadInput
from cdpr.poses import Array, Pose, read_only
from cdpr.rig import Camera, Rig
from tracking.bundle import TagView
from tracking.camera_check import check_camera, measured_camera
from tracking.detector import TagDetector
from tracking.edges import refine
from tracking.marks import modules_across
from tracking.picture import Image


@dataclass(frozen=True, slots=True, eq=False)
class ExtrinsicCalibration:
    """A camera's place in the world.

    Attributes:
        camera: The camera at its new place.
        covariance: Of position [m] and rotation vector [rad] along the world's axes, shape (6, 6);
            it does not hold errors of the tags' survey.
        tag_errors: RMS corner error of each frame tag over the pictures, by number, [px].
        pictures: How many pictures it rests on.
        data_hash: Of the corners it rests on.
    """

    camera: Camera
    covariance: Array
    tag_errors: dict[int, float]
    pictures: int
    data_hash: str

    @property
    def world_from_camera(self) -> Pose:
        """The pose."""
        return self.camera.world_from_camera


def locate_camera(rig: Rig, camera: Camera, images: Iterable[Image]) -> ExtrinsicCalibration:
    """Finds the camera's place from pictures taken while it stood still.

    Args:
        rig: Its frame tags are the surveyed ones.
        camera: Its matrix and distortion hold; its place in the rig file does not matter.
        images: Grey pictures of the camera's size.

    Raises:
        BadInput: The rig has no frame tags, or none of them is to be seen whole.
    """
    if not rig.frame_tags:
        raise BadInput(
            "the rig has no frame tags to find the camera's place by",
            where=f"rig {rig.name}",
            next_step="survey tags on the frame and add them to the rig file under tags: frame",
        )
    tags = {tag.id: tag for tag in rig.frame_tags}
    detector, modules = TagDetector(rig.tag_family), modules_across(rig.tag_family)
    views: list[TagView] = []
    pictures = 0
    for image in images:
        mine = [d for d in detector.detect(image) if d.id in tags]
        corners = np.array([d.corners for d in mine]).reshape(-1, 4, 2)
        squares = refine(image, camera, corners, modules)
        pairs = zip(mine, squares, strict=True)
        new = [TagView(tags[d.id], s) for d, s in pairs if s is not None and s.whole]
        views += new
        pictures += bool(new)
    found = measured_camera(camera, views) if views else None
    if found is None:
        raise BadInput(
            f"none of the frame tags {', '.join(map(str, tags))} is to be seen whole",
            where=f"camera {camera.name}",
            next_step="free them, or turn the camera until it sees some of them",
        )
    pose, covariance = found
    moved = replace(camera, world_from_camera=pose)
    return ExtrinsicCalibration(
        moved, read_only(covariance), _tag_errors(moved, views), pictures, _hash(views)
    )


def _tag_errors(camera: Camera, views: list[TagView]) -> dict[int, float]:
    check = check_camera(camera, views)
    numbers = np.array(check.tags)
    return {
        number: float(np.sqrt(np.mean(check.errors[numbers == number] ** 2)))
        for number in sorted(set(check.tags))
    }


def _hash(views: list[TagView]) -> str:
    digest = hashlib.sha256()
    for view in views:
        digest.update(f"{view.tag.id}".encode() + np.round(view.seen.corners, 6).tobytes())
    return digest.hexdigest()
