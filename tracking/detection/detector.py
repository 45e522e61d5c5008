"""Finding tags in an image, in all of it or in a part, by the detector that a rig file names."""

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

# Squares in an image that may be tags, also small, faint and blurred ones.


#: Shortest outline of a square, [px].
LEAST_SQUARE_PERIMETER = 30.0
#: Larger images are not enlarged: their tags have pixels enough, and time is short, [px].
MOST_PIXELS = 4_000_000
#: Reduced so much, noise averages out and the smallest tag still spans two pixels.
REDUCED = 4
#: Least difference of ink and paper in the reduced image, [grey levels] and in units of its noise.
LEAST_CONTRAST, LEAST_SIGNAL = 6.0, 8.0
#: Every so many rows of it show its noise.
NOISE_ROWS = 8
#: Side of the surroundings in which they differ, [px of the reduced image].
NEIGHBOURS = 5


@dataclass(frozen=True, slots=True)
class Pass:
    """One way to make dark squares stand out.

    Attributes:
        scale: How much the image is enlarged.
        smoothing: Standard deviation of the smoothing before, [px].
        step: How much darker than its surroundings ink is, [grey levels].
        windows: Sides of the surroundings: smallest, largest, step, [px of the enlarged image].
    """

    scale: int
    smoothing: float
    step: float
    windows: tuple[int, int, int]


#: Small ones; faint and noisy ones; blurred ones.
PASSES = (
    Pass(1, 0.0, 2.0, (3, 23, 10)),
    Pass(2, 0.8, 2.0, (7, 47, 20)),
    Pass(2, 1.2, 3.0, (21, 81, 30)),
)


def squares_in(image: Image, family: str) -> list[Array]:
    """Outlines of squares, clockwise on the screen from any corner, shape (4, 2) each, [px].

    Args:
        image: Grey image.
        family: Whose tags are looked for.
    """
    found: list[Array] = []
    if is_blank(image):
        return found
    for way in PASSES:
        if way.scale == 1 or image.size <= MOST_PIXELS:
            found += _squares(image, family, way)
    return found


def is_blank(image: Image) -> bool:
    """Whether it shows nothing but slow changes of brightness and noise."""
    high, wide = (length // REDUCED for length in image.shape)
    whole = image[: high * REDUCED, : wide * REDUCED]  # OpenCV is slow where it does not divide
    reduced = np.asarray(cv2.resize(whole, (wide, high), interpolation=cv2.INTER_AREA))
    square = np.ones((NEIGHBOURS, NEIGHBOURS), dtype=np.uint8)
    contrast = float(cv2.subtract(cv2.dilate(reduced, square), cv2.erode(reduced, square)).max())
    steps = np.abs(np.diff(reduced[::NOISE_ROWS].astype(np.int16), axis=1))
    noise = float(np.median(steps)) / 0.954  # of a difference of two, each normally distributed
    return contrast < max(LEAST_CONTRAST, LEAST_SIGNAL * noise)


def _squares(image: Image, family: str, way: Pass) -> list[Array]:
    if way.smoothing > 0.0:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), way.smoothing), dtype=np.uint8)
    if way.scale > 1:
        size = (image.shape[1] * way.scale, image.shape[0] * way.scale)
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    parameters.adaptiveThreshConstant = way.step
    parameters.adaptiveThreshWinSizeMin = way.windows[0]
    parameters.adaptiveThreshWinSizeMax = way.windows[1]
    parameters.adaptiveThreshWinSizeStep = way.windows[2]
    parameters.minMarkerPerimeterRate = LEAST_SQUARE_PERIMETER * way.scale / max(image.shape)
    parameters.minOtsuStdDev = 1.0
    detector = cv2.aruco.ArucoDetector(dictionary(family), parameters)
    read, _, unread = detector.detectMarkers(image)
    squares = [np.asarray(s, dtype=np.float64).reshape(4, 2) for s in (*read, *unread)]
    return [(square + 0.5) / way.scale - 0.5 for square in squares]


#: Shortest outline of a tag that is looked for, [px].
LEAST_PERIMETER = 44.0
#: Smallest side of a region that is searched, [px].
LEAST_SIDE = 16


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """A tag that was seen.

    Attributes:
        id: Its number.
        corners: Roughly, in the order of `tracking.detection.tags.CORNER_SIGNS`, shape (4, 2),
            [px].
    """

    id: int
    corners: Array


class TagDetector:
    """Finds the tags of one family with OpenCV, without its corner refinement.

    OpenCV's refinements are off by 0.26 px and more (sub-pixel) or biased by 0.45 px (AprilTag);
    `tracking.edges.refine` does it instead.

    Args:
        family: Such as ``tag36h11``.

    Raises:
        BadInput: The family is not known.
    """

    def __init__(self, family: str) -> None:
        self.family = family
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
        self._parameters = parameters
        self._detector = cv2.aruco.ArucoDetector(dictionary(family), parameters)

    def detect(
        self, image: Image, region: Region | None = None, *, thorough: bool = False
    ) -> list[Detection]:
        """Tags in the image or in a region of it, each number once (the largest).

        Args:
            image: Grey image.
            region: Where to look; everywhere when left out.
            thorough: Also finds small, faint and blurred tags, in about ten times the time.
        """
        largest = {d.id: d for d in self.detect_all(image, region, thorough=thorough)}
        return list(largest.values())

    def detect_all(
        self, image: Image, region: Region | None = None, *, thorough: bool = False
    ) -> list[Detection]:
        """As `detect`, but every tag of a number that is seen more than once, the largest last."""
        origin = np.zeros(2)
        if region is not None:
            image = image[region.top : region.bottom, region.left : region.right]
            origin = np.array([region.left, region.top], dtype=np.float64)
            if min(image.shape) < LEAST_SIDE:
                return []
        image = np.ascontiguousarray(image)
        found = self._plainly(image)
        if thorough:
            found += self._thoroughly(image, found)
        return _sorted([Detection(d.id, read_only(d.corners + origin)) for d in found])

    def look_again(self, image: Image, known: Sequence[Detection]) -> list[Detection]:
        """As a thorough `detect_all` of an image in which a plain one found ``known``."""
        image = np.ascontiguousarray(image)
        return _sorted([*known, *self._thoroughly(image, known)])

    def _plainly(self, image: Image) -> list[Detection]:
        # OpenCV counts this limit in shares of the image: in a small region noise would pass it.
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

    def _thoroughly(self, image: Image, known: Sequence[Detection]) -> list[Detection]:
        """Further tags, of squares that OpenCV does not find or cannot read."""
        readings = [self._decoder.read(image, square) for square in squares_in(image, self.family)]
        better = sorted((r for r in readings if r is not None), key=lambda r: -r.correlation)
        return _new((Detection(r.id, r.corners) for r in better), known)

    @cached_property
    def _decoder(self) -> TagDecoder:
        return TagDecoder(self.family)


def _new(found: Iterable[Detection], known: Sequence[Detection]) -> list[Detection]:
    """Those that lie on none of the known ones, nor on one before them."""
    new: list[Detection] = []
    for one in found:
        if not any(_overlap(one.corners, other.corners) for other in (*known, *new)):
            new.append(one)
    return new


def _sorted(found: list[Detection]) -> list[Detection]:
    return sorted(found, key=lambda d: (d.id, _area(d.corners)))


def _overlap(a: Array, b: Array) -> bool:
    """Whether the middle of one square lies in the other."""
    return any(
        cv2.pointPolygonTest(one.astype(np.float32), other.mean(axis=0).tolist(), False) >= 0
        for one, other in ((a, b), (b, a))
    )


def _area(corners: Array) -> float:
    """Area of a quadrilateral, [px²]."""
    x, y = (corners[2] - corners[0]), (corners[3] - corners[1])
    return abs(float(x[0] * y[1] - x[1] * y[0])) / 2.0


# Where things of known place in the world lie in a camera's image: frame tags, the platform.


#: Nearer to the camera's plane nothing is seen, [m].
NEAREST = 0.02


def region_around(camera: Camera, points: Array, slack: float) -> Region | None:
    """The pixels around points of the world, or None out of view.

    Args:
        camera: Whose pixels they are.
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


def near_places(
    camera: Camera, tags: Mapping[int, Tag], detector: TagDetector, image: Image
) -> list[Detection]:
    """Frame tags that are seen near where they should be."""
    found = []
    for tag in tags.values():
        region = region_around(camera, tag_corners(tag), slack=0.5)
        if region is not None:
            found += [d for d in detector.detect_all(image, region) if d.id == tag.id]
    return found


def nearest_to(
    camera: Camera, tags: Mapping[int, Tag], detections: Sequence[Detection]
) -> list[Detection]:
    """Of each frame tag the detection nearest to its place: others are of another print."""
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
    """Pixels of points of the world, None when one is not in front of the camera."""
    in_camera = camera.world_from_camera.inverse().apply(points)
    return None if np.any(in_camera[:, 2] < NEAREST) else pixels_of(camera, in_camera)


# The detector of tags that a rig file names.


def make_detector(name: str, family: str) -> TagDetector:
    """A detector by its name in rig files.

    Args:
        name: One of `model.files.rig_file.DETECTORS`.
        family: Such as ``tag36h11``.

    Raises:
        BadInput: It is not known, not installed, or does not find the family.
    """
    if name not in DETECTORS:
        raise BadInput(
            f"unknown tag detector {name!r}", next_step=f"use one of {', '.join(DETECTORS)}"
        )
    if name == "apriltag":
        return AprilTagLibrary(family)
    return TagDetector(family)


# Finding tags with pyapriltags, the AprilTag project's own detector (extra ``apriltag``).


#: Its families among those of rig files.
FAMILIES = ("tag16h5", "tag25h9", "tag36h11")


class AprilTagLibrary(TagDetector):
    """As `TagDetector`, by pyapriltags: better at small and faint tags, some times slower.

    Plainly it looks at an image of half the size, thoroughly at the whole one.

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

    def _plainly(self, image: Image) -> list[Detection]:
        return _theirs(self._halved, image)

    def _thoroughly(self, image: Image, known: Sequence[Detection]) -> list[Detection]:
        return _new(_theirs(self._full, image), known)


def _theirs(detector: Any, image: Image) -> list[Detection]:
    found = detector.detect(image)
    return [Detection(int(tag.tag_id), _our_corners(tag.corners)) for tag in found]


def _our_corners(corners: Array) -> Array:
    """Its corners run from the bottom left against the clock, and pixels' centres lie at 0.5."""
    return np.asarray(corners, dtype=np.float64)[::-1] - 0.5
