"""Diagnosis of images: unexpected tags, grids and sizes of tags, blur, sharpening, overexposure."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from model.files.camera_file import APRILTAG_FAMILIES
from model.pose import Array
from model.rig import Camera
from tracking.camera_model import Image, distort_pixels, linear
from tracking.detection.detector import TagDetector
from tracking.detection.tags import CORNER_SIGNS, alike_in_mirror, brightness_at
from tracking.edges.refine import RefinedTag

#: Families that are tried to identify a wrong one. The largest ArUco dictionary of a size includes
#: the others; families of 16 modules are left out, as they give false detections.
DIAGNOSED = (*(f for f in APRILTAG_FAMILIES if f != "tag16h5"), "5X5_1000", "6X6_1000", "7X7_1000")


MIRRORED = "the images are mirrored"
"""Part of a diagnosis."""
UNMIRROR = "turn off mirroring in the camera or its driver, and take the images again"
"""Next step of mirrored images."""


def diagnose_tags(image: Image, family: str, expected: Sequence[int]) -> str:
    """Lists the unexpected tags in an image, for an error message.

    Also states whether the expected ones appear mirrored.
    """
    seen = []
    for other in (family, *(name for name in DIAGNOSED if not _same(name, family))):
        wanted = set(expected) if other == family else set()
        numbers = [d.id for d in TagDetector(other).detect(image) if d.id not in wanted]
        if numbers:
            seen.append(f"{other} {', '.join(map(str, numbers))}")
    text = "; ".join(seen) or "no tag of any known family"
    if are_mirrored(image, TagDetector(family), expected):
        text += f"; the expected tags appear mirrored, so {MIRRORED}"
    return text


def are_mirrored(image: Image, detector: TagDetector, expected: Collection[int]) -> bool:
    """Whether expected tags appear in the mirrored image alone.

    A tag of any number in the plain image excludes it. Tags of `alike_in_mirror`, such as tag25h9
    22, count for neither. Tags that only exhaustive detection finds are not considered.
    """
    alike = alike_in_mirror(detector.family)
    if any(d.id not in alike for d in detector.detect(image)):
        return False
    flipped = np.ascontiguousarray(image[:, ::-1])
    return any(d.id in expected and d.id not in alike for d in detector.detect(flipped))


# Numbers of neighbouring tags in a grid.


#: A neighbour is farther away than this, in sides of a tag, and by no more than this slope off the
#: direction.
_APART, _SLOPE = 0.5, 0.3
#: Share of the neighbours whose numbers differ by the same, in a grid numbered row by row.
_LEAST_SHARE = 0.6


@dataclass(frozen=True, slots=True)
class RowNumbering:
    """How a grid of tags is numbered.

    Attributes:
        columns: Tags along a row.
        upward: Whether the numbers increase from row to row upward, not downward.
        start: Remainder of the first number of a row by ``columns``; None if unknown.
    """

    columns: int
    upward: bool
    start: int | None


def tag_offsets(squares: Mapping[int, Array]) -> Array:
    """Offsets between the middles of tags, each by the four corners of one tag only.

    So lens distortion hardly changes those of neighbours.

    Args:
        squares: Corners of n tags by number, in the order of
            `tracking.detection.tags.CORNER_SIGNS`, shape (4, 2) each, [px].

    Returns:
        From the tag of the first axis to that of the second, shape (n, n, 2): x right and y down,
        in sides of the first tag.
    """
    plane = (CORNER_SIGNS * [0.5, -0.5]).astype(np.float32)
    quads = [square.astype(np.float32) for square in squares.values()]
    middles = np.array([[cv2.getPerspectiveTransform(plane, quad)[:2, 2]] for quad in quads])
    return np.array(
        [
            cv2.perspectiveTransform(middles, cv2.getPerspectiveTransform(quad, plane))[:, 0]
            for quad in quads
        ]
    )


def row_numbering(squares: Mapping[int, Array]) -> RowNumbering | None:
    """How a grid of tags, as in `tag_offsets`, is numbered; None if not row by row, or unknown."""
    if not squares:
        return None
    numbers, offsets = list(squares), tag_offsets(squares)
    right, down = _neighbours(numbers, offsets), _neighbours(numbers, offsets[..., ::-1])
    along, across = _common_step(right), _common_step(down)
    columns = abs(across)
    if abs(along) != 1 or columns < 2:  # -1: OpenCV draws some families upside down
        return None
    # Only the last number of a row, of all remainders, has no neighbour with the next number.
    ends = set(range(columns)) - {min(pair) % columns for pair in right if np.ptp(pair) == 1}
    start = (ends.pop() + 1) % columns if len(ends) == 1 else None
    return RowNumbering(columns, along * across < 0, start)


def _neighbours(numbers: Sequence[int], offsets: Array) -> list[tuple[int, int]]:
    """Each tag's number and that of the next tag in the direction of the first coordinate."""
    x, y = offsets[..., 0], offsets[..., 1]
    ahead = np.where((x > _APART) & (np.abs(y) < _SLOPE * x), x, np.inf)
    nearest = ahead.argmin(axis=1)
    return [(numbers[k], numbers[j]) for k, j in enumerate(nearest) if np.isfinite(ahead[k, j])]


def _common_step(pairs: Sequence[tuple[int, int]]) -> int:
    """The usual difference of neighbours' numbers; 0 where there is none."""
    steps = Counter(after - before for before, after in pairs)
    step, count = max(steps.items(), key=lambda item: item[1], default=(0, 0))
    return step if count >= _LEAST_SHARE * len(pairs) else 0


#: Wider edges are out of focus or blurred by motion, [px].
SOFT = 4.5


def edge_width(image: Image) -> float:
    """Width of the sharpest edges of a grey image, [px]: contrast by slope; 1 to 4 in focus."""
    if min(image.shape) < 5:
        return float("inf")
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.7)
    across, down = (cv2.Scharr(smooth, cv2.CV_32F, *axis) / 32.0 for axis in ((1, 0), (0, 1)))
    low, high = np.percentile(smooth, (2.0, 98.0))
    steepest = float(np.percentile(np.hypot(across, down), 99.8))
    return float(high - low) / max(steepest, 1e-9)


# Size of printed markers.


#: Corners of a square of side 1.
UNIT_SQUARE = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32)
#: Numbers of positions along an edge and of distances from it at which brightness is read, and the
#: part of the edge that is read: near its ends, paper is on two sides.
_ALONG, _ACROSS, _PART = 7, 15, (0.2, 0.8)
#: Brightness is read from the middle of the black border, [modules], to this share of the paper up
#: to the next square, at most this far, [modules].
_INK, _PAPER, _MOST_PAPER = 0.5, 0.85, 0.8


def printed_share(image: Image, markers: Array, squares: Array, modules: int) -> float:
    """Median side of markers as a share of the squares around them, by the ink across their edges.

    OpenCV's corners lie in the ink, by 0.6 px and more, so they only show where the edges are.

    Args:
        image: Grey image of black markers on paper.
        markers: Corners of n markers by OpenCV, shape (n, 4, 2), [px].
        squares: Corners of the paper around each, shape (n, 4, 2), [px]; NaN where unknown.
        modules: Along the side of a marker.

    Returns:
        The share; NaN if all squares are unknown.
    """
    known = np.isfinite(squares).all(axis=(1, 2))
    if not known.any():
        return math.nan
    planes = squares[known].astype(np.float32)
    flat = _transformed(
        np.array([cv2.getPerspectiveTransform(plane, UNIT_SQUARE) for plane in planes]),
        markers[known],
    )
    edges = np.roll(flat, -1, axis=1) - flat
    sides = np.linalg.norm(edges, axis=2).mean(axis=1)
    side = float(np.median(sides))
    # Distances from the middle at which brightness is read, in half sides.
    first = 1.0 - 2.0 * _INK / modules
    last = 1.0 + max(0.0, min(_PAPER * (1.0 / side - 1.0), 2.0 * _MOST_PAPER / modules))
    middles = flat.mean(axis=1)[:, None, None, None]
    on_edges = flat[:, :, None] + np.linspace(*_PART, _ALONG)[:, None] * edges[:, :, None]
    lines = middles + np.linspace(first, last, _ACROSS)[:, None, None] * (
        on_edges[:, :, None] - middles
    )
    back = np.array([cv2.getPerspectiveTransform(UNIT_SQUARE, plane) for plane in planes])
    read = brightness_at(image, _transformed(back, lines.reshape(len(flat), -1, 2)))
    brightness = read.reshape(lines.shape[:4]).mean(axis=3)
    black, white = brightness.min(axis=2, keepdims=True), brightness.max(axis=2, keepdims=True)
    ink = (white - brightness) / np.maximum(white - black, 1.0)
    reach = first + (last - first) * (ink[..., 1:] + ink[..., :-1]).mean(axis=2) / 2.0
    return float(np.median(sides * reach.mean(axis=1)))


def _transformed(homographies: Array, points: Array) -> Array:
    """Points, shape (n, k, 2), each set by its homography, shape (n, 3, 3)."""
    found = points @ homographies[:, :, :2].transpose(0, 2, 1) + homographies[:, None, :, 2]
    return np.asarray(found[..., :2] / found[..., 2:])


# Image faults from the edges of tags.


#: Numbers of positions along an edge and of distances from it at which brightness is read.
_POSITIONS, _DISTANCES = 9, 4
#: Sharpening shows between these distances from an edge, [px]; plain paper and ink between these
#: shares of a module.
_NEAR, _FAR = (1.3, 2.6), (0.6, 0.85)
#: Smaller modules have no room for both, [px].
_LEAST_MODULE = 4.7
#: Brighter pixels are clipped, [grey levels].
_CLIPPED = 254.0
#: Fewer edges do not show the direction of motion blur.
_LEAST_EDGES = 6
#: Motion blur and share of overexposed edges from which they are reported, [px] and share; and the
#: share above which no usable edge is left.
LEAST_SMEAR, LEAST_CLIPPED, MOST_CLIPPED = 3.0, 0.3, 0.9
#: Edges sharper than those of ideal pixels behind a lens, [px], and an overshoot above this share
#: of the contrast mean that the camera sharpens. Clipping then shifts the edges.
SHARP, OVERSHOOT = 0.385, 0.05


@dataclass(frozen=True, slots=True)
class EdgeFaults:
    """Faults of an image, from the edges of its tags.

    Attributes:
        smear: Length of the motion blur, [px].
        spread: Median deviation of the blur across edges, [px].
        overshoot: Overshoot of brightness beyond paper and ink, share of the contrast.
        clipped: Share of edges with saturated paper.
    """

    smear: float
    spread: float
    overshoot: float
    clipped: float

    @property
    def sharpened(self) -> bool:
        """Whether sharpening by the camera shifts the edges."""
        return self.spread < SHARP and self.overshoot > OVERSHOOT

    @property
    def unusable(self) -> bool:
        """Whether pose intervals from these edges would be invalid."""
        return self.sharpened or self.clipped > MOST_CLIPPED

    def __str__(self) -> str:
        """The fault and its remedy; empty without a fault."""
        if self.sharpened:
            return (
                f"the image is sharpened: edges overshoot by {self.overshoot:.0%} of the contrast;"
                " switch off the camera's sharpening"
            )
        if self.smear > LEAST_SMEAR:
            return f"the image is blurred by {self.smear:.0f} px of motion: shorten the exposure"
        if self.clipped > LEAST_CLIPPED:
            return (
                f"paper is overexposed at {self.clipped:.0%} of the edges: shorten the exposure, or"
                " keep lamps out of view"
            )
        return ""


def edge_faults(
    image: Image, camera: Camera, squares: Sequence[RefinedTag], modules: int
) -> EdgeFaults:
    """Diagnoses an image from the edges of its tags.

    Args:
        camera: The camera of the image.
        modules: Along the side of a tag's square.
    """
    corners = distort_pixels(camera, np.array([square.corners for square in squares]))
    measured = np.array([square.edges for square in squares])
    starts, ends = corners[measured], np.roll(corners, -1, axis=1)[measured]
    along = ends - starts
    lengths = np.maximum(np.linalg.norm(along, axis=1), 1e-6)
    outward = np.column_stack([along[:, 1], -along[:, 0]]) / lengths[:, None]
    spreads = np.array([square.spreads for square in squares])[measured]
    opposite = np.roll(corners, -2, axis=1)[measured] - starts
    widths = np.abs(np.sum(opposite * outward, axis=1)) / modules
    overshoot, clipped = _beside_edges(linear(camera, image), starts, along, outward, widths)
    return EdgeFaults(_smear(outward, spreads), float(np.median(spreads)), overshoot, clipped)


def _smear(normals: Array, spreads: Array) -> float:
    """Length of the motion blur, from the blur of edges by direction, [px].

    A motion by b at an angle a to an edge's normal adds (b cos a)² / 12 to the blur's variance.
    """
    if len(normals) < _LEAST_EDGES:
        return 0.0
    double = 2.0 * np.arctan2(normals[:, 1], normals[:, 0])
    terms = np.column_stack([np.ones(len(double)), np.cos(double), np.sin(double)])
    found = np.linalg.lstsq(terms, spreads**2, rcond=None)[0]
    return float(np.sqrt(24.0 * np.hypot(found[1], found[2])))


def _beside_edges(
    image: Image, starts: Array, along: Array, outward: Array, widths: Array
) -> tuple[float, float]:
    """Median overshoot as a share of the contrast, and share of edges with clipped paper."""
    wide = widths >= _LEAST_MODULE
    if not wide.any():
        return 0.0, 0.0
    starts, along, outward, widths = (a[wide] for a in (starts, along, outward, widths))
    share = np.linspace(0.2, 0.8, _POSITIONS)
    near = np.tile(np.linspace(*_NEAR, _DISTANCES), (len(widths), 1))
    far = np.linspace(*_FAR, _DISTANCES) * widths[:, None]
    away = np.concatenate([-far, -near, near, far], axis=1)
    points = (
        starts[:, None, None]
        + share[:, None, None] * along[:, None, None]
        + away[:, None, :, None] * outward[:, None, None]
    )
    lines = (
        brightness_at(image, points).reshape(len(points), _POSITIONS, 4, _DISTANCES).mean(axis=3)
    )
    ink, dark, bright, paper = np.median(lines, axis=1).T  # robust against cables across an edge
    overshoot = np.median((bright - paper + ink - dark) / np.maximum(paper - ink, 1.0))
    return float(overshoot), float(np.mean(paper >= _CLIPPED))


def _same(name: str, family: str) -> bool:
    """Whether two families share their tags, as ArUco dictionaries of one size do."""
    return name == family or ("X" in name and name.split("_")[0] == family.split("_")[0])
