"""An image with what was measured in it drawn over it."""

from __future__ import annotations

from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from model.pose import Array, Pose
from model.rig import Camera, Rig
from tracking.camera_model import Image, pixels_of
from tracking.clearance import MeasuredClearance
from tracking.detection.tags import tag_corners
from tracking.measurement import Observation, PoseMeasurement

#: Colours, blue green red.
USED, BOX, TEXT = (80, 220, 60), (230, 160, 40), (255, 255, 255)
AXES = ((60, 60, 235), (60, 200, 60), (235, 120, 40))
FONT = cv2.FONT_HERSHEY_SIMPLEX
#: Drawing takes whole sixteenths of pixels.
_SHIFT = 4


def drawn_over(
    image: Image,
    rig: Rig,
    camera: Camera,
    found: Observation,
    clearance: MeasuredClearance | None = None,
) -> NDArray[np.uint8]:
    """The image in colour with the platform's box and axes, its tags, and the numbers.

    Args:
        image: Grey image of the camera.
        rig: Whose platform it is.
        camera: Its place and lens.
        found: What was measured in the image.
        clearance: At the measured pose, if there are obstacles.

    Returns:
        Shape (height, width, 3), blue green red.
    """
    canvas = outlined(image, rig, camera, found)
    _draw_text(canvas, _lines(found, clearance))
    return canvas


def outlined(image: Image, rig: Rig, camera: Camera, found: Observation) -> NDArray[np.uint8]:
    """The image in colour with the platform's box and axes and its tags; as for `drawn_over`."""
    canvas = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    if isinstance(found, PoseMeasurement):
        camera_from_platform = camera.world_from_camera.inverse().compose(found.pose)
        _draw_box(canvas, rig, camera, camera_from_platform)
        for tag in rig.platform_tags:
            if tag.id in found.tags:
                _draw_line(canvas, camera, camera_from_platform.apply(tag_corners(tag)), USED, True)
    return canvas


def _draw_box(canvas: NDArray[np.uint8], rig: Rig, camera: Camera, pose: Pose) -> None:
    corners = rig.platform_corners
    for a, b in combinations(corners, 2):
        if np.count_nonzero(a != b) == 1:
            _draw_line(canvas, camera, pose.apply(np.array([a, b])), BOX)
    length = float(rig.half_size.max()) * 1.4
    for axis, colour in zip(np.eye(3) * length, AXES, strict=True):
        _draw_line(canvas, camera, pose.apply(np.array([np.zeros(3), axis])), colour)


def _draw_line(
    canvas: NDArray[np.uint8],
    camera: Camera,
    points_in_camera: Array,
    colour: tuple[int, ...],
    closed: bool = False,
) -> None:
    if np.any(points_in_camera[:, 2] < 0.02):
        return
    fine = np.round(pixels_of(camera, points_in_camera) * 2**_SHIFT).astype(np.int32)
    cv2.polylines(canvas, [fine], closed, colour, 1, cv2.LINE_AA, _SHIFT)


def _lines(found: Observation, clearance: MeasuredClearance | None) -> list[str]:
    """What the image says, line by line; plain ASCII, as OpenCV's letters are."""
    head = f"t {found.time:.3f} s"
    if not isinstance(found, PoseMeasurement):
        return [head, f"no pose: {found.reason}"]
    place, spread = found.pose.position * 1e3, found.position_deviation * 1e3
    text = [
        f"{head}  tags {' '.join(map(str, found.tags))}  {found.reprojection:.3f} px",
        *(
            f"{axis} {value:9.2f} +- {deviation:.2f} mm"
            for axis, value, deviation in zip("xyz", place, spread, strict=True)
        ),
    ]
    if clearance is not None:
        nearest = min(clearance.nearest, key=lambda n: n.distance)
        low, high = clearance.distance - clearance.uncertainty, clearance.at_most
        text.append(
            f"clearance {clearance.distance * 1e3:.1f} mm, bounds {low * 1e3:.1f} to"
            f" {high * 1e3:.1f}  {nearest.first} to {nearest.second}"
        )
    return text


def _draw_text(canvas: NDArray[np.uint8], lines: list[str]) -> None:
    """White letters on a darkened corner of the image."""
    scale = max(0.4, canvas.shape[0] / 1400.0)
    step = round(34 * scale)
    ascii_only = [line.encode("ascii", "replace").decode() for line in lines]
    sizes = [cv2.getTextSize(line, FONT, scale, 1)[0][0] for line in ascii_only]
    corner = canvas[: step * len(lines) + step // 2, : max(sizes) + step]
    corner[:] = corner // 3
    for number, line in enumerate(ascii_only, start=1):
        at = (step // 2, step * number)
        cv2.putText(canvas, line, at, FONT, scale, TEXT, 1, cv2.LINE_AA)
