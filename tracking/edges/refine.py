"""Tag corners to hundredths of a pixel: lines fitted to the four edges of the black square.

A blurred step from ink to paper is fitted to the pixels near each edge, with the contributions of
corners and adjacent modules. The residuals show the noise, so each line has a covariance. The lines
are undistorted and intersect at the corners.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from model.pose import Array, read_only
from model.rig import Camera
from tracking.camera_model import Image, distort_pixels, linear, undistort_pixels
from tracking.edges.coarse import locate_edges
from tracking.edges.fit import fit_edges
from tracking.edges.sampling import (
    COLUMNS,
    COVARIANCE,
    HALF,
    HIDDEN,
    MIDDLE,
    OFFSET,
    OFFSET_VARIANCE,
    SHARE,
    SPREAD,
    TILT,
    TILT_VARIANCE,
)

# Lines of edges and their intersections.


@dataclass(frozen=True, slots=True, eq=False)
class Lines:
    """Lines of edges in undistorted pixels, four per tag."""

    points: Array  # (e, 2) on the lines
    directions: Array  # (e, 2) unit
    offset_deviation: Array  # (e,) [px] at ``points``
    tilt_deviation: Array  # (e,) [rad]
    good: NDArray[np.bool_]  # (e,)


def intersect(lines: Lines, rough: Array) -> Array:
    """Intersections of neighbouring good lines, else the rough corners; shape (t, 4, 2)."""
    points, directions = lines.points.reshape(-1, 4, 2), lines.directions.reshape(-1, 4, 2)
    before_point, before = np.roll(points, 1, axis=1), np.roll(directions, 1, axis=1)
    cross = directions[..., 0] * before[..., 1] - directions[..., 1] * before[..., 0]
    good = lines.good.reshape(-1, 4)
    good = good & np.roll(good, 1, axis=1) & (np.abs(cross) > 1e-3)
    gap = before_point - points
    share = gap[..., 0] * before[..., 1] - gap[..., 1] * before[..., 0]
    share /= np.where(good, cross, 1.0)
    return np.where(good[..., None], points + share[..., None] * directions, rough)


# Edges of tags as curves in the distorted image, and as lines in undistorted pixels.


#: Required share of an edge that fits the model.
LEAST_SHARE = 0.4
#: An edge is rejected if one pixel of its length locates it worse than this, [px].
MOST_SCATTER = 1.2


@dataclass(frozen=True, slots=True, eq=False)
class EdgeCurves:
    """Expected edges of squares in an image.

    Attributes:
        camera: Of the image.
        pixels: Corners, shape (t, 4, 2), [px], lens distortion included.
        undistorted: The same in undistorted pixels.
        lengths: Of the chords, shape (t, 4), [px].
        along: Unit directions of the chords, shape (t, 4, 2).
        bows: Shape (t, 4, 2): at a share f of its length a curve lies f (1 − f) (b₀ + f b₁) outside
            of its chord, [px].
    """

    camera: Camera
    pixels: Array
    undistorted: Array
    lengths: Array
    along: Array
    bows: Array

    @classmethod
    def between(cls, camera: Camera, pixels: Array) -> EdgeCurves:
        """The edges between corners, shape (t, 4, 2), [px]."""
        undistorted = undistort_pixels(camera, pixels)
        chords = np.roll(pixels, -1, axis=1) - pixels
        lengths = np.maximum(np.linalg.norm(chords, axis=2), 1e-6)
        along = chords / lengths[..., None]
        bows = np.zeros_like(pixels)
        if camera.distortion.size:
            bows = _bows(camera, pixels, undistorted, lengths, along)
        return cls(camera, pixels, undistorted, lengths, along, bows)

    @property
    def outward(self) -> Array:
        """Unit directions out of the squares, shape (t, 4, 2)."""
        return _outward(self.along)

    def module_widths(self, modules: int) -> Array:
        """Width of a module across each edge, shape (t, 4), [px]."""
        middle = (self.pixels + np.roll(self.pixels, -1, axis=1)) / 2.0
        opposite = np.roll(middle, -2, axis=1) - middle
        return np.asarray(np.abs(np.sum(opposite * self.outward, axis=2)) / modules)

    def lines(self, found: Array, model_error: Array) -> Lines:
        """Fitted lines in undistorted pixels.

        Args:
            found: Columns of each edge, shape (t, 4, `COLUMNS`).
            model_error: Further deviation of each edge, shape (t, 4), [px].
        """
        # At the point where errors of offset and tilt are uncorrelated.
        tilt_variance = np.maximum(found[..., TILT_VARIANCE], 1e-12)
        centre = np.clip(-found[..., COVARIANCE] / tilt_variance, -1.0, 1.0)
        variance = found[..., OFFSET_VARIANCE] + centre * found[..., COVARIANCE]
        deviation = np.sqrt(np.maximum(variance, 0.0))
        ends = np.stack([self._points(found, np.full_like(centre, q)) for q in (-1.0, 1.0)])
        middle = self._points(found, centre)
        points = undistort_pixels(self.camera, np.stack([*ends, middle, middle + self.outward]))
        chord = points[1] - points[0]
        length = np.maximum(np.linalg.norm(chord, axis=2), 1e-6)
        scale = np.linalg.norm(points[3] - points[2], axis=2)  # length of one image pixel
        good = (found[..., SHARE] >= LEAST_SHARE) & (
            deviation * np.sqrt(2.0 * found[..., HALF]) < MOST_SCATTER
        )
        more = np.hypot(deviation, model_error) / np.maximum(deviation, 1e-9)
        tilt = np.sqrt(tilt_variance) * scale / (length / 2.0)
        return Lines(
            points=points[2].reshape(-1, 2),
            directions=(chord / length[..., None]).reshape(-1, 2),
            offset_deviation=np.maximum(deviation * scale * more, 1e-6).reshape(-1),
            tilt_deviation=(tilt * more).reshape(-1),
            good=good.reshape(-1),
        )

    def _points(self, found: Array, q: Array) -> Array:
        """Points of the fitted edges at q, see `tracking.edges.sampling`, [px]."""
        distance = found[..., MIDDLE] + q * found[..., HALF]
        share = distance / self.lengths
        aside = share * (1.0 - share) * (self.bows[..., 0] + share * self.bows[..., 1])
        aside += found[..., OFFSET] + q * found[..., TILT]
        return np.asarray(
            self.pixels + distance[..., None] * self.along + aside[..., None] * self.outward
        )


def _outward(along: Array) -> Array:
    return np.stack([along[..., 1], -along[..., 0]], axis=-1)  # corners run clockwise on the screen


def _bows(camera: Camera, pixels: Array, undistorted: Array, lengths: Array, along: Array) -> Array:
    """Bows of the edges, through the images of two points of each."""
    share = np.array([1.0, 2.0])[:, None] / 3.0
    chord = np.roll(undistorted, -1, axis=1) - undistorted
    inner = distort_pixels(camera, undistorted[:, :, None] + share * chord[:, :, None])
    gap = inner - pixels[:, :, None]
    share = np.sum(gap * along[:, :, None], axis=3) / lengths[..., None]
    aside = np.sum(gap * _outward(along)[:, :, None], axis=3) / (share * (1.0 - share))
    slope = (aside[..., 1] - aside[..., 0]) / (share[..., 1] - share[..., 0])
    return np.stack([aside[..., 0] - slope * share[..., 0], slope], axis=-1)


#: Minimum deviation of an edge beside noise: blur is not exactly a mixture of a Gaussian and a box,
#: and paper is not exactly flat, [px].
FLOOR = 0.0015
#: Deviation from the second row of modules, which is not modelled: factor on its blurred share at
#: the middle of the first row, in deviations of the blur.
SECOND_ROW = 1.0
#: Deviation from overexposed paper, where only the foot of the step is visible and the result
#: depends on the blur's shape: factor on the hidden share, in deviations of the blur.
OVEREXPOSED = 0.15
#: If the blur is wider than this share of a module, the fit repeats as long as corners move by more
#: than `NEAR` and half of an edge's deviation: the contributions of modules depend on the corners.
CROWDED = 0.22
#: Otherwise it repeats only if they move by more than `FAR`, [px].
NEAR, FAR = 0.03, 0.3
#: Maximum number of fits.
MOST_FITS = 4
#: A square in every image, which replaces unusable tags, so that arrays keep their shape.
_DUMMY_SQUARE = np.array([[4.0, 4.0], [14.0, 4.0], [14.0, 14.0], [4.0, 14.0]])


@dataclass(frozen=True, slots=True, eq=False)
class RefinedTag:
    """The square of one tag in undistorted pixels.

    For true corners c, flattened, ``whitening @ c - target`` has eight independent errors of unit
    variance: offset and tilt of each of the four edges; both are 0 for a hidden edge.

    Attributes:
        corners: In the order of `tracking.detection.tags.CORNER_SIGNS`, shape (4, 2), [px];
            approximate where an edge is hidden.
        whitening: Shape (8, 8), [1/px].
        target: Shape (8,).
        edges: Which edges were measured, shape (4,).
        spreads: Standard deviations of the blur across them, shape (4,), [px].
    """

    corners: Array
    whitening: Array
    target: Array
    edges: NDArray[np.bool_]
    spreads: Array = field(default_factory=lambda: np.zeros(4))

    @property
    def whole(self) -> bool:
        """Whether all four edges were measured."""
        return bool(self.edges.all())

    @property
    def covariance(self) -> Array:
        """Covariance of the corners of a whole tag, flattened, shape (8, 8), [px²]."""
        inverse = np.linalg.inv(self.whitening)
        return np.asarray(inverse @ inverse.T)


def refine(image: Image, camera: Camera, corners: Array, modules: int) -> list[RefinedTag | None]:
    """Refines the corners of tags.

    Args:
        image: Grey image, shape (h, w).
        camera: The camera of the image.
        corners: Approximate (to about a module), in the order of
            `tracking.detection.tags.CORNER_SIGNS`, shape (t, 4, 2), [px], lens distortion included.
        modules: Modules along the side of the black square.

    Returns:
        One entry per tag: None if it leaves the image or has fewer than two visible edges.
    """
    if not len(corners):
        return []
    pixels = np.ascontiguousarray(linear(camera, image))[:]
    pixels.flags.writeable = False  # kernels are compiled for images that are read-only
    rough = np.array(corners, dtype=np.float64)
    inside = _inside(rough, image.shape)
    curves = EdgeCurves.between(camera, np.where(inside, rough, _DUMMY_SQUARE))
    found = np.zeros((len(rough), 4, COLUMNS))
    widths = curves.module_widths(modules)
    locate_edges(pixels, curves.pixels, curves.bows, widths, found)
    final = intersect(curves.lines(found, _model_errors(found, widths)), curves.undistorted)
    again = inside.copy()
    for _ in range(MOST_FITS):
        better = distort_pixels(camera, final)
        inside &= _inside(better, image.shape)
        again &= inside
        curves = EdgeCurves.between(camera, np.where(again, better, curves.pixels))
        widths, which = curves.module_widths(modules), np.flatnonzero(again)
        fit = np.empty((len(which), 4, COLUMNS))
        geometry = curves.pixels[which], curves.bows[which], widths[which]
        fit_edges(pixels, *geometry, modules, found[which], fit)
        found[which] = fit
        lines = curves.lines(found, _model_errors(found, widths))
        final = intersect(lines, curves.undistorted)
        again = inside & _unsettled(final - curves.undistorted, found, widths, lines)[:, None, None]
        if not again.any():
            break
    return [
        _refined(final, lines, found, t) if inside[t, 0, 0] else None for t in range(len(final))
    ]


def load_kernels() -> None:
    """Loads or compiles the machine code of `refine` in advance."""
    grey = np.zeros((16, 16), dtype=np.uint8)
    grey.flags.writeable = False
    square, bows = _DUMMY_SQUARE[None], np.zeros((1, 4, 2))
    widths, found = np.ones((1, 4)), np.zeros((1, 4, COLUMNS))
    locate_edges(grey, square, bows, widths, found)
    fit_edges(grey, square, bows, widths, 8, found, np.zeros_like(found))


def _inside(corners: Array, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Whether each tag is in the image, shape (t, 1, 1)."""
    limit = np.array([shape[1], shape[0]]) - 3.0
    return np.asarray(
        np.all((corners >= 2.0) & (corners <= limit), axis=(1, 2), keepdims=True), dtype=np.bool_
    )


def _unsettled(moved: Array, found: Array, widths: Array, lines: Lines) -> NDArray[np.bool_]:
    """Whether each tag's corners moved so far that the fit repeats, shape (t,)."""
    blurred = np.where(found[..., SHARE] > 0.0, found[..., SPREAD] / widths, 0.0).max(axis=1)
    unsure = lines.offset_deviation.reshape(-1, 4).max(axis=1)
    limit = np.where(blurred > CROWDED, np.maximum(NEAR, 0.5 * unsure), FAR)
    return np.asarray(np.abs(moved).max(axis=(1, 2)) > limit, dtype=np.bool_)


def _model_errors(found: Array, widths: Array) -> Array:
    """Deviations of the edges beside noise, shape (t, 4), [px]."""
    spread = np.maximum(found[..., SPREAD], 1e-6)
    away = np.clip(widths / spread, 1.0, 20.0)
    tail = np.exp(-0.5 * away**2) / (np.sqrt(2.0 * np.pi) * away)  # of a Gaussian, beyond a module
    hidden = OVEREXPOSED * found[..., HIDDEN]
    return np.asarray(np.hypot(FLOOR, spread * np.hypot(SECOND_ROW * tail, hidden)))


def _refined(corners: Array, lines: Lines, found: Array, tag: int) -> RefinedTag | None:
    """The refined tag with the whitening from its lines' deviations."""
    quad, edges = corners[tag], lines.good[4 * tag : 4 * tag + 4]
    if edges.sum() < 2:
        return None
    whitening, target = np.zeros((8, 8)), np.zeros(8)
    for edge in np.flatnonzero(edges).tolist():
        index, other = 4 * tag + edge, (edge + 1) % 4
        point, direction = lines.points[index], lines.directions[index]
        normal = np.array([direction[1], -direction[0]])
        length = float((quad[other] - quad[edge]) @ direction)
        share = float((point - quad[edge]) @ direction) / length
        offset, tilt = lines.offset_deviation[index], lines.tilt_deviation[index]
        start, end = slice(2 * edge, 2 * edge + 2), slice(2 * other, 2 * other + 2)
        whitening[2 * edge, start] = (1.0 - share) * normal / offset
        whitening[2 * edge, end] = share * normal / offset
        target[2 * edge] = normal @ point / offset
        whitening[2 * edge + 1, start] = -normal / length / tilt
        whitening[2 * edge + 1, end] = normal / length / tilt
    return RefinedTag(
        read_only(quad),
        read_only(whitening),
        read_only(target),
        edges.copy(),
        read_only(found[tag, :, SPREAD]),
    )
