"""Tag corners to hundredths of a pixel: lines fitted to the four edges of the black square.

A blurred step from ink to paper is fitted to the pixels beside each edge, freed of what its corners
and the modules next to it add. Pixels tell their noise themselves, so each line comes with what it
may be off. The lines are freed of lens distortion and meet at the corners.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cdpr.poses import Array, read_only
from cdpr.rig import Camera
from tracking.edge_curves import EdgeCurves
from tracking.edge_kernels.columns import COLUMNS, SHARE, SPREAD
from tracking.edge_kernels.fit import fit_edges
from tracking.edge_kernels.rough import find_edges
from tracking.edge_lines import Lines, meet
from tracking.picture import Image
from tracking.projection import pixels_from_ideal

#: What an edge may be off beside noise, so that none claims to be exact: pixels are no mixture of a
#: bell and a box, nor is paper flat, [px].
FLOOR = 0.0015
#: The second row of modules inside an edge is not modelled: this many times the share of it that
#: the blur brings to the first row's middle, in deviations of the blur.
SECOND_ROW = 1.0
#: Where the blur is wider than this share of a module, corners are fitted again as long as they
#: move by more than `NEAR` and half of what an edge may be off: what the modules beside an edge add
#: hangs on where they lie.
CROWDED = 0.22
#: Elsewhere they are fitted again only if they move by more than `FAR`, [px].
NEAR, FAR = 0.03, 0.3
#: At most so many fits.
MOST_FITS = 4


@dataclass(frozen=True, slots=True, eq=False)
class RefinedTag:
    """The square of one tag in ideal (undistorted) pixels.

    For true corners c, flattened, ``whitening @ c - target`` holds eight independent errors of unit
    variance: offset and tilt of the four edges in turn; both are nought for a hidden edge.

    Attributes:
        corners: In the order of `tracking.marks.CORNER_SIGNS`, shape (4, 2), [px]; rough where an
            edge is hidden.
        whitening: Shape (8, 8), [1/px].
        target: Shape (8,).
        edges: Which edges were measured, shape (4,).
    """

    corners: Array
    whitening: Array
    target: Array
    edges: NDArray[np.bool_]

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
        image: Grey picture, shape (h, w).
        camera: Whose picture it is.
        corners: Roughly (to about a module), in the order of `tracking.marks.CORNER_SIGNS`, shape
            (t, 4, 2), [px], lens distortion included.
        modules: Modules along the side of the black square.

    Returns:
        One entry a tag: None where it leaves the picture or fewer than two edges are to be seen.
    """
    if not len(corners):
        return []
    pixels = np.ascontiguousarray(image)[:]
    pixels.flags.writeable = False  # kernels are compiled for pictures that nobody writes to
    rough = np.array(corners, dtype=np.float64)
    inside = _inside(rough, image.shape)
    curves = EdgeCurves.between(camera, np.where(inside, rough, _somewhere(image.shape)))
    found = np.zeros((len(rough), 4, COLUMNS))
    widths = curves.module_widths(modules)
    find_edges(pixels, curves.pixels, curves.bows, widths, found)
    final = meet(curves.lines(found, _doubt(found, widths)), curves.ideal)
    again = inside.copy()
    for _ in range(MOST_FITS):
        better = pixels_from_ideal(camera, final)
        inside &= _inside(better, image.shape)
        again &= inside
        curves = EdgeCurves.between(camera, np.where(again, better, curves.pixels))
        widths, which = curves.module_widths(modules), np.flatnonzero(again)
        fit = np.empty((len(which), 4, COLUMNS))
        places = curves.pixels[which], curves.bows[which], widths[which]
        fit_edges(pixels, *places, modules, found[which], fit)
        found[which] = fit
        lines = curves.lines(found, _doubt(found, widths))
        final = meet(lines, curves.ideal)
        again = inside & _unsettled(final - curves.ideal, found, widths, lines)[:, None, None]
        if not again.any():
            break
    return [_refined(final, lines, t) if inside[t, 0, 0] else None for t in range(len(final))]


def load_kernels() -> None:
    """Loads the machine code of `refine`, or compiles it, so that no picture waits for it."""
    grey = np.zeros((16, 16), dtype=np.uint8)
    grey.flags.writeable = False
    square, bows = _somewhere(grey.shape)[None], np.zeros((1, 4, 2))
    widths, found = np.ones((1, 4)), np.zeros((1, 4, COLUMNS))
    find_edges(grey, square, bows, widths, found)
    fit_edges(grey, square, bows, widths, 8, found, np.zeros_like(found))


def _inside(corners: Array, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Which tags lie in the picture, shape (t, 1, 1)."""
    limit = np.array([shape[1], shape[0]]) - 3.0
    return np.asarray(
        np.all((corners >= 2.0) & (corners <= limit), axis=(1, 2), keepdims=True), dtype=np.bool_
    )


def _somewhere(shape: tuple[int, ...]) -> Array:
    """A square in the picture that stands in for unusable tags, so that arrays stay whole."""
    return np.array([[4.0, 4.0], [14.0, 4.0], [14.0, 14.0], [4.0, 14.0]])


def _unsettled(moved: Array, found: Array, widths: Array, lines: Lines) -> NDArray[np.bool_]:
    """Which tags' corners moved so far that they are fitted again, shape (t,)."""
    blurred = np.where(found[..., SHARE] > 0.0, found[..., SPREAD] / widths, 0.0).max(axis=1)
    unsure = lines.offset_deviation.reshape(-1, 4).max(axis=1)
    limit = np.where(blurred > CROWDED, np.maximum(NEAR, 0.5 * unsure), FAR)
    return np.asarray(np.abs(moved).max(axis=(1, 2)) > limit, dtype=np.bool_)


def _doubt(found: Array, widths: Array) -> Array:
    """What the edges may be off beside noise, shape (t, 4), [px]."""
    spread = np.maximum(found[..., SPREAD], 1e-6)
    away = np.clip(widths / spread, 1.0, 20.0)
    tail = np.exp(-0.5 * away**2) / (np.sqrt(2.0 * np.pi) * away)  # of a bell, beyond a module
    return np.asarray(np.hypot(FLOOR, SECOND_ROW * spread * tail))


def _refined(corners: Array, lines: Lines, tag: int) -> RefinedTag | None:
    """Corners of a tag with the whitening that its lines' deviations give."""
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
    return RefinedTag(read_only(quad), read_only(whitening), read_only(target), edges.copy())
