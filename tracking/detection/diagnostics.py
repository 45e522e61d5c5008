"""What is wrong with an image: other tags than expected, smear, sharpening, too much light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from model.files.camera_file import APRILTAG_FAMILIES
from model.pose import Array
from model.rig import Camera
from tracking.camera_model import Image, pixels_from_ideal
from tracking.detection.detector import TagDetector
from tracking.edges.refine import RefinedTag

#: Families that identify a wrong one: of ArUco dictionaries of a size the largest holds the
#: others. Those with 16 modules are left out: they are found by chance.
TOLD = (*(f for f in APRILTAG_FAMILIES if f != "tag16h5"), "5X5_1000", "6X6_1000", "7X7_1000")


def diagnose_tags(image: Image, family: str, expected: Sequence[int]) -> str:
    """Says which tags an image shows that are not the expected ones, for an error message.

    Also whether the expected ones are there once it is flipped over.
    """
    seen = []
    for other in (family, *(name for name in TOLD if not _same(name, family))):
        wanted = set(expected) if other == family else set()
        numbers = [d.id for d in TagDetector(other).detect(image) if d.id not in wanted]
        if numbers:
            seen.append(f"{other} {', '.join(map(str, numbers))}")
    told = "; ".join(seen) or "no tag of any known family"
    flipped = np.ascontiguousarray(image[:, ::-1])
    if any(d.id in expected for d in TagDetector(family).detect(flipped)):
        told += "; the expected tags appear mirrored, so the images are mirrored"
    return told


#: Wider edges are out of focus or smeared, [px].
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


# What the edges of tags say of the image.


#: Places along an edge and distances from it at which brightness is read.
_PLACES, _DISTANCES = 9, 4
#: What sharpening adds lies between these distances from an edge, [px], and paper and ink alone
#: between these shares of a module.
_NEAR, _FAR = (1.3, 2.6), (0.6, 0.85)
#: Smaller modules leave no room for both, [px].
_LEAST_MODULE = 4.7
#: Brighter pixels are clipped, [grey levels].
_CLIPPED = 254.0
#: Fewer edges do not show in which direction the image is smeared.
_LEAST_EDGES = 6
#: Shorter smears and smaller shares of overexposed edges are not worth a word, [px] and share;
#: with larger shares of them no edge is left that shows where it is.
LEAST_SMEAR, LEAST_CLIPPED, MOST_CLIPPED = 3.0, 0.3, 0.9
#: Edges sharper than those of a pixel that is a perfect square, seen through a lens, [px], and
#: brightness that goes beyond paper and ink by more than this share of the contrast, are a
#: camera's doing. Black and white cut the rest off, and edges are not where they seem to be.
SHARP, OVERSHOOT = 0.385, 0.05


@dataclass(frozen=True, slots=True)
class EdgeFaults:
    """What is wrong with an image by the edges of its tags.

    Attributes:
        smear: Length of a motion's smear, [px].
        spread: Median deviation of the blur across edges, [px].
        overshoot: How far brightness goes beyond paper and ink beside edges, share of the contrast.
        clipped: Share of the edges whose paper is as bright as a pixel can be.
    """

    smear: float
    spread: float
    overshoot: float
    clipped: float

    @property
    def sharpened(self) -> bool:
        """Whether the camera sharpened it until edges are not where they seem to be."""
        return self.spread < SHARP and self.overshoot > OVERSHOOT

    @property
    def unusable(self) -> bool:
        """Whether no interval of a pose by these edges can be trusted."""
        return self.sharpened or self.clipped > MOST_CLIPPED

    def __str__(self) -> str:
        """What is wrong and what to do, empty when nothing is."""
        if self.sharpened:
            return (
                f"the image is sharpened: edges overshoot by {self.overshoot:.0%} of the contrast;"
                " switch off the camera's sharpening"
            )
        if self.smear > LEAST_SMEAR:
            return f"the image is smeared by {self.smear:.0f} px: shorten the exposure"
        if self.clipped > LEAST_CLIPPED:
            return (
                f"paper is overexposed at {self.clipped:.0%} of the edges: shorten the exposure, or"
                " keep lamps out of view"
            )
        return ""


def edge_faults(
    image: Image, camera: Camera, squares: Sequence[RefinedTag], modules: int
) -> EdgeFaults:
    """What is wrong with an image by the edges of tags.

    Args:
        image: Grey.
        camera: Whose image it is.
        squares: The tags that were measured.
        modules: Along the side of a tag's square.
    """
    corners = pixels_from_ideal(camera, np.array([square.corners for square in squares]))
    measured = np.array([square.edges for square in squares])
    starts, ends = corners[measured], np.roll(corners, -1, axis=1)[measured]
    along = ends - starts
    lengths = np.maximum(np.linalg.norm(along, axis=1), 1e-6)
    outward = np.column_stack([along[:, 1], -along[:, 0]]) / lengths[:, None]
    spreads = np.array([square.spreads for square in squares])[measured]
    opposite = np.roll(corners, -2, axis=1)[measured] - starts
    widths = np.abs(np.sum(opposite * outward, axis=1)) / modules
    overshoot, clipped = _beside_edges(image, starts, along, outward, widths)
    return EdgeFaults(_smear(outward, spreads), float(np.median(spreads)), overshoot, clipped)


def _smear(normals: Array, spreads: Array) -> float:
    """Length of a motion that blurs edges by their direction, [px].

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
    """Median overshoot, share of the contrast, and share of edges whose paper is clipped."""
    wide = widths >= _LEAST_MODULE
    if not wide.any():
        return 0.0, 0.0
    starts, along, outward, widths = (a[wide] for a in (starts, along, outward, widths))
    share = np.linspace(0.2, 0.8, _PLACES)
    near = np.tile(np.linspace(*_NEAR, _DISTANCES), (len(widths), 1))
    far = np.linspace(*_FAR, _DISTANCES) * widths[:, None]
    away = np.concatenate([-far, -near, near, far], axis=1)
    points = (
        starts[:, None, None]
        + share[:, None, None] * along[:, None, None]
        + away[:, None, :, None] * outward[:, None, None]
    ).astype(np.float32)
    column = np.ascontiguousarray(points[..., 0]).reshape(len(points), -1)
    row = np.ascontiguousarray(points[..., 1]).reshape(len(points), -1)
    read = cv2.remap(image, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    lines = read.reshape(len(points), _PLACES, 4, _DISTANCES).mean(axis=3)
    ink, dark, bright, paper = np.median(lines, axis=1).T  # blind to cables across an edge
    overshoot = np.median((bright - paper + ink - dark) / np.maximum(paper - ink, 1.0))
    return float(overshoot), float(np.mean(paper >= _CLIPPED))


def _same(name: str, family: str) -> bool:
    """Whether two families share their tags: ArUco dictionaries of one size do."""
    return name == family or ("X" in name and name.split("_")[0] == family.split("_")[0])
