"""Tag corners to hundredths of a pixel: lines fitted to the four edges of the black square.

Across each edge brightness is read along short profiles. The edge lies where the profile's area is
that of a sharp step, which is free of bias for any symmetric blur. The points of an edge are freed
of lens distortion, a line is fitted robustly (a cable may cross the edge), and neighbouring lines
meet at the corners. All edges of all tags go through the same array operations at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cdpr.poses import Array, read_only
from cdpr.rig import Camera
from tracking.edge_lines import Lines, doubted, fit_lines, meet
from tracking.edge_steps import LEVEL_TAPS, TAPS, StepFinder, steepest, step_positions
from tracking.picture import Image
from tracking.projection import ideal_from_pixels, pixels_from_ideal

#: What pixels do to an edge beside noise, so that no edge claims to be exact, [px].
FLOOR = 0.0035
#: Error of an edge whose step is as wide as a module, [px]; it falls with the fifth power of that
#: ratio (measured on rendered pictures of 24 to 90 px, tilted to 75°, blurred to 2 px).
CROWDED = 0.16
#: Blur reaches around a corner this many widths of a step far.
CORNER_REACH = 1.2


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
        noise: Scatter of the edges' points about their lines, RMS, [px].
    """

    corners: Array
    whitening: Array
    target: Array
    edges: NDArray[np.bool_]
    noise: float

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
    brightness = image.astype(np.float32)
    rough = np.array(corners, dtype=np.float64)
    inside = _inside(rough, image.shape)
    rough = np.where(inside[:, None, None], rough, _somewhere(image.shape))
    width = _module_width(rough, modules)
    half = np.clip(0.95 * width, 1.5, 6.0)
    sharp = np.zeros(len(half))
    lines = _fit(brightness, camera, rough, half, half, sharp, steepest, profiles=16)
    better = pixels_from_ideal(camera, meet(lines, ideal_from_pixels(camera, rough)))
    inside &= _inside(better, image.shape)
    better = np.where(inside[:, None, None], better, rough)
    # Just long enough to hold the blurred step: longer profiles only gather noise.
    blur = lines.blur
    half = np.clip(np.minimum(0.5 * blur + 1.3, 0.58 * width), 1.2, 5.0)
    # Ink and paper are read as far as the next modules' blur leaves them alone.
    reach = np.clip(width - CORNER_REACH * blur, half, half + 4.0)
    lines = _fit(brightness, camera, better, half, reach, blur, step_positions, profiles=40)
    lines = doubted(lines, np.hypot(FLOOR, CROWDED * (blur / width) ** 5))
    final = meet(lines, ideal_from_pixels(camera, better))
    return [_refined(final, lines, t) if inside[t] else None for t in range(len(final))]


def _inside(corners: Array, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    limit = np.array([shape[1], shape[0]]) - 3.0
    return np.asarray(np.all((corners >= 2.0) & (corners <= limit), axis=(1, 2)))


def _somewhere(shape: tuple[int, ...]) -> Array:
    """A square in the picture that stands in for unusable tags, so that arrays stay whole."""
    return np.array([[4.0, 4.0], [14.0, 4.0], [14.0, 14.0], [4.0, 14.0]])


def _fit(
    image: NDArray[np.float32],
    camera: Camera,
    corners: Array,
    half: Array,
    reach: Array,
    blur: Array,
    find: StepFinder,
    profiles: int,
) -> Lines:
    """Lines of the four edges of every tag.

    Args:
        image: Brightness.
        camera: Whose picture it is.
        corners: Of the tags, shape (t, 4, 2), [px].
        half: Half length of the profiles that are read, shape (e,), [px].
        reach: Up to there the levels of ink and paper are read, shape (e,), [px].
        blur: Width of the edges' steps, shape (e,), [px]; corners are kept away from by it.
        find: Finds the step in each profile.
        profiles: How many are read an edge.
    """
    start = corners.reshape(-1, 2)
    side = np.roll(corners, -1, axis=1).reshape(-1, 2) - start
    length = np.maximum(np.hypot(side[:, 0], side[:, 1]), 1e-6)
    along = side / length[:, None]
    outward = np.stack([along[:, 1], -along[:, 0]], axis=1)  # corners run clockwise on the screen
    first, last = _usable_span(corners, length, half, blur)
    share = (np.arange(profiles) + 0.5) / profiles
    places = first[:, None] + share * (last - first)[:, None]  # (e, n)
    shift = (np.arange(profiles) * 0.381966) % 1.0 - 0.5  # spreads the taps over the pixels
    taps = (np.arange(TAPS) + 0.5)[None, None, :] + shift[None, :, None]
    across = half[:, None, None] * (2.0 * taps / TAPS - 1.0)  # (e, n, k), outward positive
    ends = half * (1.0 - 2.0 / TAPS)
    beyond = ends[:, None] + np.linspace(0.0, 1.0, LEVEL_TAPS) * (reach - ends)[:, None]
    beyond = np.broadcast_to(beyond[:, None, :], (*places.shape, LEVEL_TAPS))
    across = np.concatenate([-beyond[..., ::-1], across, beyond], axis=-1)
    base = start[:, None, :] + places[..., None] * along[:, None, :]
    positions = base[:, :, None, :] + across[..., None] * outward[:, None, None, :]
    values = _bilinear(image, positions)
    steps = find(values, places, across, half)
    points = ideal_from_pixels(camera, base + steps.offset[..., None] * outward[:, None, :])
    return fit_lines(points, steps, last - first)


def _module_width(corners: Array, modules: int) -> Array:
    """Width of a module across each edge, shape (e,), [px]."""
    side = np.roll(corners, -1, axis=1) - corners
    middle = corners + side / 2.0
    opposite = np.roll(middle, -2, axis=1) - middle
    area = np.abs(opposite[..., 0] * side[..., 1] - opposite[..., 1] * side[..., 0])
    length = np.maximum(np.linalg.norm(side, axis=2), 1e-6)
    return np.asarray((area / length).reshape(-1) / modules)


def _usable_span(corners: Array, length: Array, half: Array, blur: Array) -> tuple[Array, Array]:
    """Part of each edge whose profiles do not meet the neighbouring edges, shape (e,), [px]."""
    clear = np.maximum(2.0, CORNER_REACH * blur)
    to_next = np.roll(corners, -1, axis=1) - corners
    unit = to_next / np.maximum(np.linalg.norm(to_next, axis=2, keepdims=True), 1e-6)
    before = -np.roll(unit, 1, axis=1)  # from a corner back along the edge before it
    cosine = np.sum(unit * before, axis=2)
    sine = np.sqrt(np.maximum(1.0 - cosine**2, 1e-4))
    slope = np.maximum(cosine / sine, 0.0)  # an acute corner leaves less black beside the edge
    at_start, at_end = slope.reshape(-1), np.roll(slope, -1, axis=1).reshape(-1)
    first = np.minimum(clear + half * at_start, 0.3 * length)
    last = length - np.minimum(clear + half * at_end, 0.3 * length)
    return first, last


def _bilinear(image: NDArray[np.float32], positions: Array) -> Array:
    """Brightness at positions (x, y), shape (..., 2); in full precision, unlike cv2.remap."""
    height, width = image.shape
    x = np.clip(positions[..., 0], 0.0, width - 1.001)
    y = np.clip(positions[..., 1], 0.0, height - 1.001)
    column, row = x.astype(np.int64), y.astype(np.int64)
    right, down = x - column, y - row
    flat, index = image.ravel(), row * width + column
    top = flat[index] * (1.0 - right) + flat[index + 1] * right
    bottom = flat[index + width] * (1.0 - right) + flat[index + width + 1] * right
    return np.asarray(top * (1.0 - down) + bottom * down)


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
    noise = float(np.sqrt(np.mean(lines.noise[4 * tag : 4 * tag + 4][edges] ** 2)))
    return RefinedTag(read_only(quad), read_only(whitening), read_only(target), edges.copy(), noise)
