"""Tag detection in an image or a region of it, with the detector that a rig file names."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from model.errors import BadInput
from model.files.camera_file import DETECTORS
from model.pose import Array, read_only
from model.rig import Camera, Tag
from tracking.camera_model import Image, Region, pixels_of
from tracking.detection.tags import TagDecoder, dictionary, tag_corners, upright_corners

# Candidate squares for tags, including small, faint and blurred ones.


#: Smallest perimeter of a square, [px].
LEAST_SQUARE_PERIMETER = 30.0
#: Larger images are not upscaled: their tags have enough pixels, and it takes too long, [px].
MOST_PIXELS = 4_000_000
#: Reduction factor: noise averages out, and the smallest tag still spans two pixels.
REDUCED = 4
#: Minimum contrast of ink and paper in the reduced image, [grey levels] and relative to noise.
LEAST_CONTRAST, LEAST_SIGNAL = 6.0, 8.0
#: Row step for the noise estimate.
NOISE_ROWS = 8
#: Side of the neighbourhood for the contrast, [px of the reduced image].
NEIGHBOURS = 5


@dataclass(frozen=True, slots=True)
class Pass:
    """Preprocessing for one search for dark squares.

    Attributes:
        scale: Upscaling factor of the image.
        smoothing: Standard deviation of prior Gaussian smoothing, [px].
        step: Threshold of ink below the mean of its surroundings, [grey levels].
        windows: Sides of the surroundings: smallest, largest, step, [px of the upscaled image].
    """

    scale: int
    smoothing: float
    step: float
    windows: tuple[int, int, int]


#: For small tags; for faint and noisy ones; for blurred ones.
PASSES = (
    Pass(1, 0.0, 2.0, (3, 23, 10)),
    Pass(2, 0.8, 2.0, (7, 47, 20)),
    Pass(2, 1.2, 3.0, (21, 81, 30)),
)


def squares_in(image: Image, family: str) -> list[Array]:
    """Outlines of squares, clockwise on the screen from any corner, shape (4, 2) each, [px].

    Args:
        family: Of the tags searched for.
    """
    found: list[Array] = []
    if is_blank(image):
        return found
    for search in PASSES:
        if search.scale == 1 or image.size <= MOST_PIXELS:
            found += _squares(image, family, search)
    return found


def is_blank(image: Image) -> bool:
    """Whether an image shows only slow brightness changes and noise."""
    high, wide = (length // REDUCED for length in image.shape)
    whole = image[: high * REDUCED, : wide * REDUCED]  # OpenCV is slow for sizes that do not divide
    reduced = np.asarray(cv2.resize(whole, (wide, high), interpolation=cv2.INTER_AREA))
    square = np.ones((NEIGHBOURS, NEIGHBOURS), dtype=np.uint8)
    contrast = float(cv2.subtract(cv2.dilate(reduced, square), cv2.erode(reduced, square)).max())
    steps = np.abs(np.diff(reduced[::NOISE_ROWS].astype(np.int16), axis=1))
    noise = float(np.median(steps)) / 0.954  # of differences of two normal errors
    return contrast < max(LEAST_CONTRAST, LEAST_SIGNAL * noise)


def _squares(image: Image, family: str, search: Pass) -> list[Array]:
    if search.smoothing > 0.0:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), search.smoothing), dtype=np.uint8)
    if search.scale > 1:
        size = (image.shape[1] * search.scale, image.shape[0] * search.scale)
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    parameters.adaptiveThreshConstant = search.step
    parameters.adaptiveThreshWinSizeMin = search.windows[0]
    parameters.adaptiveThreshWinSizeMax = search.windows[1]
    parameters.adaptiveThreshWinSizeStep = search.windows[2]
    parameters.minMarkerPerimeterRate = LEAST_SQUARE_PERIMETER * search.scale / max(image.shape)
    parameters.minOtsuStdDev = 1.0
    detector = cv2.aruco.ArucoDetector(dictionary(family), parameters)
    read, _, unread = detector.detectMarkers(image)
    squares = [np.asarray(s, dtype=np.float64).reshape(4, 2) for s in (*read, *unread)]
    return [(square + 0.5) / search.scale - 0.5 for square in squares]


#: Smallest perimeter of a tag in standard detection, [px].
LEAST_PERIMETER = 44.0
#: Smallest side of a search region, [px].
LEAST_SIDE = 16


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """A detected tag.

    Attributes:
        id: Its number.
        corners: Approximate, in the order of `tracking.detection.tags.CORNER_SIGNS`, shape
            (4, 2), [px].
    """

    id: int
    corners: Array


class TagDetector:
    """Detects the tags of one family with OpenCV, without its corner refinement.

    OpenCV's refinements are off by 0.26 px and more (sub-pixel) or biased by 0.45 px (AprilTag);
    `tracking.edges.refine` replaces them.

    Args:
        family: Such as ``tag36h11``.

    Raises:
        BadInput: The family is unknown.
    """

    def __init__(self, family: str) -> None:
        self.family = family
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
        self._parameters = parameters
        self._detector = cv2.aruco.ArucoDetector(dictionary(family), parameters)

    def detect(self, image: Image) -> list[Detection]:
        """Tags in a grey image, each number once (the largest)."""
        return list({d.id: d for d in self.detect_all(image)}.values())

    def detect_all(self, image: Image, region: Region | None = None) -> list[Detection]:
        """Tags in the image or in a region of it; those of one number largest last."""
        origin = np.zeros(2)
        if region is not None:
            image = image[region.top : region.bottom, region.left : region.right]
            origin = np.array([region.left, region.top], dtype=np.float64)
            if min(image.shape) < LEAST_SIDE:
                return []
        image = np.ascontiguousarray(image)
        found = self._standard(image)
        return _sorted([Detection(d.id, read_only(d.corners + origin)) for d in found])

    def detect_exhaustively(self, image: Image, known: Sequence[Detection]) -> list[Detection]:
        """Extends `detect_all`, which found ``known``, to small, faint and blurred tags.

        It takes about ten times as long.
        """
        image = np.ascontiguousarray(image)
        return _sorted([*known, *self._exhaustive(image, known)])

    def _standard(self, image: Image) -> list[Detection]:
        # OpenCV's limit is relative to the image size: in a small region noise would pass it.
        self._parameters.minMarkerPerimeterRate = LEAST_PERIMETER / max(image.shape)
        self._detector.setDetectorParameters(self._parameters)
        corners, numbers, _ = self._detector.detectMarkers(image)
        if numbers is None:
            return []
        squares = [np.asarray(c, dtype=np.float64).reshape(4, 2) for c in corners]
        return [
            Detection(int(number), upright_corners(self.family, square))
            for number, square in zip(np.ravel(numbers), squares, strict=True)
        ]

    def _exhaustive(self, image: Image, known: Sequence[Detection]) -> list[Detection]:
        """Further tags, in squares that OpenCV does not find or cannot decode."""
        readings = [self._decoder.read(image, square) for square in squares_in(image, self.family)]
        better = sorted((r for r in readings if r is not None), key=lambda r: -r.correlation)
        return _new((Detection(r.id, r.corners) for r in better), known)

    @cached_property
    def _decoder(self) -> TagDecoder:
        return TagDecoder(self.family)


def _new(found: Iterable[Detection], known: Sequence[Detection]) -> list[Detection]:
    """Detections that overlap neither known ones nor each other."""
    new: list[Detection] = []
    for one in found:
        if not any(_overlap(one.corners, other.corners) for other in (*known, *new)):
            new.append(one)
    return new


def _sorted(found: list[Detection]) -> list[Detection]:
    return sorted(found, key=lambda d: (d.id, _area(d.corners)))


def _overlap(a: Array, b: Array) -> bool:
    """Whether the centre of one square is inside the other."""
    return any(
        cv2.pointPolygonTest(one.astype(np.float32), other.mean(axis=0).tolist(), False) >= 0
        for one, other in ((a, b), (b, a))
    )


def _area(corners: Array) -> float:
    """Area of a quadrilateral, [px²]."""
    x, y = (corners[2] - corners[0]), (corners[3] - corners[1])
    return abs(float(x[0] * y[1] - x[1] * y[0])) / 2.0


# Expected positions in the image: frame tags, the platform.


#: Smallest visible distance from the camera's plane, [m].
NEAREST = 0.02


def region_around(camera: Camera, points: Array, slack: float) -> Region | None:
    """The region around world points, or None if out of view.

    Args:
        points: World frame, shape (n, 3), [m].
        slack: Border on each side, as a share of the larger side.
    """
    pixels = _pixels(camera, points)
    if pixels is None:
        return None
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    border = slack * (high - low).max() + 8.0
    size = np.array([camera.width, camera.height])
    left, top = np.clip(np.floor(low - border), 0, size).astype(int).tolist()
    right, bottom = np.clip(np.ceil(high + border), 0, size).astype(int).tolist()
    if right - left < LEAST_SIDE or bottom - top < LEAST_SIDE:
        return None
    return Region(left, top, right, bottom)


def detect_expected(
    camera: Camera, tags: Mapping[int, Tag], detector: TagDetector, image: Image
) -> list[Detection]:
    """Detects frame tags near their expected positions."""
    found = []
    for tag in tags.values():
        region = region_around(camera, tag_corners(tag), slack=0.5)
        if region is not None:
            found += [d for d in detector.detect_all(image, region) if d.id == tag.id]
    return found


def nearest_to_expected(
    camera: Camera, tags: Mapping[int, Tag], detections: Sequence[Detection]
) -> list[Detection]:
    """The detection of each frame tag nearest to its expected position: others are other prints."""
    nearest: dict[int, tuple[float, Detection]] = {}
    for found in detections:
        pixels = _pixels(camera, tag_corners(tags[found.id])) if found.id in tags else None
        if pixels is None:
            continue
        distance = float(np.linalg.norm(pixels.mean(axis=0) - found.corners.mean(axis=0)))
        if found.id not in nearest or distance < nearest[found.id][0]:
            nearest[found.id] = (distance, found)
    return [found for _, found in nearest.values()]


def _pixels(camera: Camera, points: Array) -> Array | None:
    """Pixels of world points, or None if one is not in front of the camera."""
    in_camera = camera.world_from_camera.inverse().apply(points)
    return None if np.any(in_camera[:, 2] < NEAREST) else pixels_of(camera, in_camera)


# Detector by name.


def make_detector(name: str, family: str) -> TagDetector:
    """The detector of a name in rig files.

    Args:
        name: One of `model.files.rig_file.DETECTORS`.
        family: Such as ``tag36h11``.

    Raises:
        BadInput: It is unknown, not installed, or does not support the family.
    """
    if name not in DETECTORS:
        raise BadInput(
            f"unknown tag detector {name!r}", next_step=f"use one of {', '.join(DETECTORS)}"
        )
    if name == "apriltag":
        return AprilTagLibrary(family)
    return TagDetector(family)


# Detection with pyapriltags, the AprilTag project's own detector (extra ``apriltag``).


#: Its families among those of rig files.
FAMILIES = ("tag16h5", "tag25h9", "tag36h11")


class AprilTagLibrary(TagDetector):
    """As `TagDetector`, with pyapriltags: better at small and faint tags, several times slower.

    Standard detection uses the image at half size, exhaustive detection at full size.

    Args:
        family: Such as ``tag36h11``.

    Raises:
        BadInput: It does not know the family, or is not installed.
    """

    def __init__(self, family: str) -> None:
        if family not in FAMILIES:
            raise BadInput(
                f"pyapriltags does not find tags of the family {family!r}",
                where="tags: detector",
                next_step=f"use the detector 'opencv', or one of {', '.join(FAMILIES)}",
            )
        try:
            from pyapriltags import Detector
        except ImportError as error:
            raise BadInput(
                "the tag detector 'apriltag' is not installed",
                where="tags: detector",
                why=str(error),
                next_step="install it with `pip install 'cdpr[apriltag]'`, or use 'opencv'",
            ) from None
        super().__init__(family)
        self._halved = Detector(families=family, nthreads=1, quad_decimate=2.0)
        self._full = Detector(families=family, nthreads=1, quad_decimate=1.0)

    def _standard(self, image: Image) -> list[Detection]:
        return _theirs(self._halved, image)

    def _exhaustive(self, image: Image, known: Sequence[Detection]) -> list[Detection]:
        return _new(_theirs(self._full, image), known)


def _theirs(detector: Any, image: Image) -> list[Detection]:
    found = detector.detect(image)
    return [Detection(int(tag.tag_id), _our_corners(tag.corners)) for tag in found]


def _our_corners(corners: Array) -> Array:
    """Its corners run from the bottom left against the clock, and pixels' centres lie at 0.5."""
    return np.asarray(corners, dtype=np.float64)[::-1] - 0.5
