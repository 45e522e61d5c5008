"""Edges of tags as curves in the picture, bent by the lens, and as lines in ideal pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cdpr.poses import Array
from cdpr.rig import Camera
from tracking.edge_kernels.columns import (
    COVARIANCE,
    HALF,
    MIDDLE,
    OFFSET,
    OFFSET_VARIANCE,
    SHARE,
    TILT,
    TILT_VARIANCE,
)
from tracking.edge_lines import Lines
from tracking.projection import ideal_from_pixels, pixels_from_ideal

#: An edge is used only if this share of it looks like one.
LEAST_SHARE = 0.4
#: Where the brightness of pixels tells so little that one pixel of its length places an edge no
#: better than this, there is none, [px].
MOST_SCATTER = 1.2


@dataclass(frozen=True, slots=True, eq=False)
class EdgeCurves:
    """Where the edges of squares are looked for.

    Attributes:
        camera: In whose picture.
        pixels: Corners, shape (t, 4, 2), [px], lens distortion included.
        ideal: The same in ideal pixels.
        lengths: Of the chords, shape (t, 4), [px].
        along: Unit directions of the chords, shape (t, 4, 2).
        bows: Shape (t, 4, 2): at a share f of its length a curve lies f (1 − f) (b₀ + f b₁) outside
            of its chord, [px].
    """

    camera: Camera
    pixels: Array
    ideal: Array
    lengths: Array
    along: Array
    bows: Array

    @classmethod
    def between(cls, camera: Camera, pixels: Array) -> EdgeCurves:
        """The edges between corners, shape (t, 4, 2), [px]."""
        ideal = ideal_from_pixels(camera, pixels)
        chords = np.roll(pixels, -1, axis=1) - pixels
        lengths = np.maximum(np.linalg.norm(chords, axis=2), 1e-6)
        along = chords / lengths[..., None]
        bows = np.zeros_like(pixels)
        if camera.distortion.size:
            bows = _bows(camera, pixels, ideal, lengths, along)
        return cls(camera, pixels, ideal, lengths, along, bows)

    @property
    def outward(self) -> Array:
        """Unit directions out of the squares, shape (t, 4, 2)."""
        return _outward(self.along)

    def module_widths(self, modules: int) -> Array:
        """Width of a module across each edge, shape (t, 4), [px]."""
        middle = (self.pixels + np.roll(self.pixels, -1, axis=1)) / 2.0
        opposite = np.roll(middle, -2, axis=1) - middle
        return np.asarray(np.abs(np.sum(opposite * self.outward, axis=2)) / modules)

    def lines(self, found: Array, doubt: Array) -> Lines:
        """Straight lines in ideal pixels.

        Args:
            found: What is known of each edge, shape (t, 4, `COLUMNS`).
            doubt: What each edge may be off beside that, shape (t, 4), [px].
        """
        # Where offset and tilt err independently.
        tilt_variance = np.maximum(found[..., TILT_VARIANCE], 1e-12)
        centre = np.clip(-found[..., COVARIANCE] / tilt_variance, -1.0, 1.0)
        variance = found[..., OFFSET_VARIANCE] + centre * found[..., COVARIANCE]
        deviation = np.sqrt(np.maximum(variance, 0.0))
        ends = np.stack([self._points(found, np.full_like(centre, q)) for q in (-1.0, 1.0)])
        middle = self._points(found, centre)
        points = ideal_from_pixels(self.camera, np.stack([*ends, middle, middle + self.outward]))
        way = points[1] - points[0]
        length = np.maximum(np.linalg.norm(way, axis=2), 1e-6)
        ideal_pixel = np.linalg.norm(points[3] - points[2], axis=2)  # how long one pixel is there
        good = (found[..., SHARE] >= LEAST_SHARE) & (
            deviation * np.sqrt(2.0 * found[..., HALF]) < MOST_SCATTER
        )
        more = np.hypot(deviation, doubt) / np.maximum(deviation, 1e-9)
        tilt = np.sqrt(tilt_variance) * ideal_pixel / (length / 2.0)
        return Lines(
            points=points[2].reshape(-1, 2),
            directions=(way / length[..., None]).reshape(-1, 2),
            offset_deviation=np.maximum(deviation * ideal_pixel * more, 1e-6).reshape(-1),
            tilt_deviation=(tilt * more).reshape(-1),
            good=good.reshape(-1),
        )

    def _points(self, found: Array, place: Array) -> Array:
        """Points of the edges that were found, at q of `edge_kernels.columns`, [px]."""
        way = found[..., MIDDLE] + place * found[..., HALF]
        share = way / self.lengths
        aside = share * (1.0 - share) * (self.bows[..., 0] + share * self.bows[..., 1])
        aside += found[..., OFFSET] + place * found[..., TILT]
        return np.asarray(
            self.pixels + way[..., None] * self.along + aside[..., None] * self.outward
        )


def _outward(along: Array) -> Array:
    return np.stack([along[..., 1], -along[..., 0]], axis=-1)  # corners run clockwise on the screen


def _bows(camera: Camera, pixels: Array, ideal: Array, lengths: Array, along: Array) -> Array:
    """Through the pictures of two points of each straight edge."""
    share = np.array([1.0, 2.0])[:, None] / 3.0
    way = np.roll(ideal, -1, axis=1) - ideal
    inner = pixels_from_ideal(camera, ideal[:, :, None] + share * way[:, :, None])
    gap = inner - pixels[:, :, None]
    share = np.sum(gap * along[:, :, None], axis=3) / lengths[..., None]
    aside = np.sum(gap * _outward(along)[:, :, None], axis=3) / (share * (1.0 - share))
    slope = (aside[..., 1] - aside[..., 0]) / (share[..., 1] - share[..., 0])
    return np.stack([aside[..., 0] - slope * share[..., 0], slope], axis=-1)
