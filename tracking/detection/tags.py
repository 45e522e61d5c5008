"""Tag families: their patterns, the corners of a tag, and decoding of squares in an image.

OpenCV draws every AprilTag family rotated by 180° relative to the images of the AprilTag project,
which labs print; ArUco markers are printed as OpenCV draws them. A tag's frame here is that of the
printed image: x right, y up, z out of it.

A tag is decoded by correlating its brightness with all patterns. Unlike thresholding module by
module, this works for tags whose modules are blurred together: far away, out of focus, in motion,
or with low contrast.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from model.errors import BadInput
from model.files.camera_file import FAMILIES, drawn_upside_down, opencv_dictionary, tags_in
from model.pose import Array, Pose, matrix_from_rotation_vector
from model.rig import Camera, Tag
from tracking.camera_model import Image, distort_pixels

#: Top left, top right, bottom right, bottom left of the upright image, in half sides.
CORNER_SIGNS = np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])


def dictionary(family: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of a family.

    Raises:
        BadInput: The family is unknown.
    """
    if family not in FAMILIES:
        raise BadInput(
            f"unknown tag family {family!r}",
            next_step=f"use one of {', '.join(FAMILIES)}",
        )
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, opencv_dictionary(family)))


def modules_across(family: str) -> int:
    """Modules along the side of the black square, border included."""
    return dictionary(family).markerSize + 2


@lru_cache(maxsize=256)
def official_modules(family: str, number: int) -> NDArray[np.bool_]:
    """White modules of the printed image, black border included, rows from the top."""
    side = modules_across(family)
    picture = cv2.aruco.generateImageMarker(dictionary(family), number, side)
    return np.asarray((picture[::-1, ::-1] if drawn_upside_down(family) else picture) > 127)


@lru_cache
def alike_in_mirror(family: str) -> frozenset[int]:
    """Numbers of tags whose mirror image is read as a tag of the family, often the same.

    Such a reading shows neither that an image is mirrored nor that it is not.
    """
    patterns = _patterns(family)
    modules = patterns.shape[-1]
    side = math.isqrt(modules)
    signs = 2.0 * patterns - 1.0
    flipped = signs[:, 0].reshape(-1, side, side)[:, :, ::-1].reshape(-1, modules)
    nearest = np.max([(flipped @ signs[:, k].T).max(axis=1) for k in range(4)], axis=0)
    differing = (modules - nearest) / 2.0
    return frozenset(np.flatnonzero(differing <= dictionary(family).maxCorrectionBits).tolist())


def _patterns(family: str) -> Array:
    """Inner modules of all tags, each rotated by 0 to 3 quarters, shape (n, 4, modules)."""
    inner = [official_modules(family, n)[1:-1, 1:-1] for n in range(tags_in(family))]
    upright = np.array(inner, dtype=np.float64)
    rotated = [np.rot90(upright, k, axes=(1, 2)).reshape(len(inner), -1) for k in range(4)]
    return np.stack(rotated, axis=1)


def upright_corners(family: str, opencv_corners: Array) -> Array:
    """OpenCV's detected corners, shape (4, 2), in the order of `CORNER_SIGNS`."""
    return np.roll(opencv_corners, 2, axis=0) if drawn_upside_down(family) else opencv_corners


def tag_corners(tag: Tag) -> Array:
    """Corners of a tag in the frame of its carrier (platform or world), shape (4, 3), [m]."""
    flat = np.column_stack([CORNER_SIGNS * tag.size / 2.0, np.zeros(4)])
    return tag.pose.apply(flat)


def view_angle(tag: Tag, camera_from_body: Pose) -> float:
    """Angle between the line of sight and a tag's normal, [rad]; beyond π/2 from behind."""
    camera_from_tag = camera_from_body.compose(tag.pose)
    away = camera_from_tag.position / np.linalg.norm(camera_from_tag.position)
    return math.acos(float(np.clip(-camera_from_tag.rotation[:, 2] @ away, -1.0, 1.0)))


# Tags mounted with another side up.


#: Rotations about its normal in which a tag may be mounted by mistake, [deg].
_WRONG_ROTATIONS = (180, 90, 270)


def rotated_tags(tags: Iterable[Tag], degrees: int) -> tuple[Tag, ...]:
    """The tags, each rotated about its normal, counter-clockwise as seen from its front, [deg]."""
    turn = matrix_from_rotation_vector(np.array([0.0, 0.0, np.radians(degrees)]))
    return tuple(
        replace(tag, pose=Pose(tag.pose.position, tag.pose.rotation @ turn)) for tag in tags
    )


def mounted_rotated(
    tags: Sequence[Tag], family: str, fit: Callable[[tuple[Tag, ...]], bool]
) -> tuple[str, str] | None:
    """Cause and remedy, if tags fit once each is rotated about its normal; else None.

    Args:
        tags: As in the rig file.
        fit: Whether tags at other poses agree with the images.
    """
    for degrees in _WRONG_ROTATIONS:
        if fit(rotated_tags(tags, degrees)):
            return _rotation_cause(family, degrees), _rotation_remedy(degrees)
    return None


def _rotation_cause(family: str, degrees: int) -> str:
    if degrees != 180:
        detail = ", counter-clockwise from its front"
    else:
        detail = ", as AprilTags drawn by OpenCV are" if drawn_upside_down(family) else ""
    return f"all tags fit if each is mounted rotated by {degrees}° about its normal{detail}"


def _rotation_remedy(degrees: int) -> str:
    half = np.radians(degrees) / 2.0
    factor = f"[{np.cos(half):.7g}, 0, 0, {np.sin(half):.7g}]" if degrees != 180 else "[0, 0, 0, 1]"
    return (
        f"multiply the rotation_wxyz of each in the rig file by {factor} from the right, or mount"
        " them with the other side up"
    )


# Decoding by correlation with all patterns.


#: Minimum correlation of a tag of 36 or more modules with its pattern. Patterns of a family
#: correlate by about 0.4, and an arbitrary square with the best of them by 0.7 in 1 % of cases.
#: Fewer modules match by chance more often, so they need a higher correlation.
LEAST_CORRELATION = 0.78
LEAST_MODULES = 36
#: Minimum lead over the second-best number.
MARGIN = 0.1
#: Minimum contrast of the black border to the white around it, relative to that inside a tag.
BORDER_CONTRAST = 0.4


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """The tag decoded in a square.

    Attributes:
        id: Its number.
        corners: In the order of `tracking.detection.tags.CORNER_SIGNS`, shape (4, 2), [px].
        correlation: Of brightness and pattern, at most 1.
    """

    id: int
    corners: Array
    correlation: float


class TagDecoder:
    """Decoder with all patterns of a family.

    Args:
        family: Such as ``tag36h11``.

    Raises:
        BadInput: The family is unknown.
    """

    def __init__(self, family: str) -> None:
        self._side = modules_across(family)
        self._book = _normalised(_patterns(family))
        modules = self._book.shape[-1]
        self.least = 1.0 - (1.0 - LEAST_CORRELATION) * min(1.0, modules / LEAST_MODULES)

    def read(self, image: Image, square: Array) -> Reading | None:
        """Decodes the tag in a square; None if it is not certain.

        Args:
            square: Corners clockwise on the screen, from any, shape (4, 2), [px].
        """
        values = module_brightness(image, square, self._side, around=1)
        inner = values[2:-2, 2:-2].ravel()
        if not _has_border(values, inner):
            return None
        scores = self._book @ _normalised(inner)
        best = int(np.argmax(scores))
        number, turns = divmod(best, 4)
        rest = np.delete(scores, number, axis=0)
        second = float(rest.max()) if rest.size else 0.0
        found = float(scores.flat[best])
        if found < self.least or found - second < MARGIN:
            return None
        # The pattern rotated counter-clockwise by k quarters fits, so its top left is corner -k.
        return Reading(number, np.roll(square, turns, axis=0), found)


def module_brightness(image: Image, square: Array, modules: int, around: int = 0) -> Array:
    """Brightness at the centre of every module of a square.

    Args:
        square: Corners, the first at the upper left of the result, shape (4, 2), [px].
        modules: Along the side of the square.
        around: Rings of modules outside the square to include.

    Returns:
        Shape (modules + 2 around, modules + 2 around).
    """
    middle = np.arange(-around, modules + around) + 0.5
    grid = np.stack(np.meshgrid(middle, middle), axis=-1)
    return brightness_at(image, _in_square(square, modules, grid))


def _in_square(square: Array, modules: int, points: Array) -> Array:
    """Points of a square, shape (..., 2), [modules] from its first corner, in pixels."""
    plane = np.array([[0, 0], [modules, 0], [modules, modules], [0, modules]], dtype=np.float32)
    turn = cv2.getPerspectiveTransform(plane, square.astype(np.float32))
    found = cv2.perspectiveTransform(points.reshape(-1, 1, 2), turn)
    return np.asarray(found, dtype=np.float64).reshape(points.shape)


def brightness_at(picture: cv2.typing.MatLike, points: Array) -> Array:
    """Brightness between pixels, bilinear; points shape (..., 2), [px], result shape (...)."""
    maps = points.reshape(len(points), -1, 2).astype(np.float32)
    column, row = (np.ascontiguousarray(maps[..., k]) for k in (0, 1))
    values = cv2.remap(picture, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, dtype=np.float64).reshape(points.shape[:-1])


def _has_border(values: Array, inner: Array) -> bool:
    """Whether the square has a dark border with white around it."""
    ring = np.concatenate([values[1, 1:-1], values[-2, 1:-1], values[2:-2, 1], values[2:-2, -2]])
    outside = np.concatenate([values[0, 1:-1], values[-1, 1:-1], values[1:-1, 0], values[1:-1, -1]])
    contrast = float(inner.max() - inner.min())
    return contrast > 0.0 and float(np.median(outside) - np.median(ring)) > (
        BORDER_CONTRAST * contrast
    )


def _normalised(values: Array) -> Array:
    """Normalised to mean 0 and length 1 along the last axis."""
    centred = values - values.mean(axis=-1, keepdims=True)
    length = np.linalg.norm(centred, axis=-1, keepdims=True)
    return np.asarray(centred / np.maximum(length, 1e-12))


# Verification of a known tag's pattern in a square.


#: Minimum correlation of brightness and pattern; another tag's pattern reaches about 0.5.
LEAST_KNOWN_CORRELATION = 0.75


def carries_tag(image: Image, corners: Array, family: str, number: int) -> bool:
    """Whether the inner modules of a square match a tag's.

    Args:
        corners: In the order of `tracking.detection.tags.CORNER_SIGNS`, shape (4, 2), [px], as in
            the image.
        family: Such as ``tag36h11``.
        number: Number in the family.
    """
    values = module_brightness(image, corners, modules_across(family))
    seen = values[1:-1, 1:-1].ravel()
    wanted = official_modules(family, number)[1:-1, 1:-1].ravel().astype(np.float64)
    seen, wanted = seen - seen.mean(), wanted - wanted.mean()
    size = float(np.linalg.norm(seen) * np.linalg.norm(wanted))
    return size > 0.0 and float(seen @ wanted) > LEAST_KNOWN_CORRELATION * size


# Inner modules against edges.


#: Samples per module of a rendered tag, and per module of an image, along each axis.
_DRAWN, _SAMPLED = 16, 6
#: Blur of a sharp image, [px].
_BLUR = 0.75
#: Inner modules agree with an edge within this distance, [px].
AGREE = 0.3


def agrees_with_modules(
    image: Image, camera: Camera, corners: Array, family: str, number: int
) -> bool:
    """Whether the inner modules of a tag are where its edges put them.

    Something along an edge moves that edge, but not the modules. An inaccurate print, or a wrong
    lens calibration, moves both alike.

    Args:
        corners: Undistorted intersections of the tag's measured edges, in the order of
            `CORNER_SIGNS`, shape (4, 2), [px].
        family: Such as ``tag36h11``.
        number: Number in the family.
    """
    white = official_modules(family, number).astype(np.float32)
    side = len(white)
    scale = math.sqrt(abs(cv2.contourArea(corners.astype(np.float32)))) / side
    across = np.arange(0.5, side - 0.49, 1.0 / _SAMPLED)
    points = np.stack(np.meshgrid(across, across), axis=-1).reshape(-1, 2)
    seen = brightness_at(image, distort_pixels(camera, _in_square(corners, side, points)))
    sharp = np.pad(white, 1, constant_values=1.0).repeat(_DRAWN, axis=0).repeat(_DRAWN, axis=1)
    drawn = cv2.GaussianBlur(sharp, (0, 0), _BLUR / scale * _DRAWN)
    down, right = np.gradient(drawn, 1.0 / _DRAWN)
    u, v = points.T / side
    weights = np.column_stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v])
    shifts: Array = np.zeros((4, 2))  # of the corners, from edges to modules, [modules]
    for _ in range(6):
        where = (points - weights @ shifts + 1.0) * _DRAWN - 0.5
        pictures = (drawn, right, down)
        values, by_x, by_y = (brightness_at(picture, where)[:, None] for picture in pictures)
        design = np.hstack([np.ones_like(values), values, -weights * by_x, -weights * by_y])
        fit = np.linalg.lstsq(design, seen, rcond=None)[0]
        if not fit[1] > 0.0:
            return False
        shifts = shifts + fit[2:].reshape(2, 4).T / fit[1]
    ends = np.array([shifts[[k, (k + 1) % 4], 1 - k % 2] for k in range(4)])
    return bool(np.all(np.abs(ends) * scale < AGREE))
