"""Tag corners to hundredths of a pixel: lines fitted to the four edges of the black square.

Across each edge brightness is read along short profiles. The edge lies where the profile's area is
that of a sharp step, which is free of bias for any symmetric blur. The points of an edge are freed
of lens distortion, a line is fitted robustly (a cable may cross the edge), and neighbouring lines
meet at the corners. All edges of all tags go through the same array operations at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cdpr.poses import Array, read_only
from cdpr.rig import Camera
from tracking.picture import Image
from tracking.projection import ideal_from_pixels, pixels_from_ideal

#: Taps along a profile.
TAPS = 17
#: Smallest step of brightness that counts as an edge, [grey levels].
LEAST_CONTRAST = 8.0
#: An edge is used only if this share of its profiles lies on its line.
LEAST_SHARE = 0.4
#: Points that scatter more than this about their line are not those of an edge, [px].
MOST_NOISE = 0.6
#: What pixels and lens do to an edge beside noise, so that no edge claims to be exact, [px].
FLOOR = 0.014


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


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    """Lines of edges in ideal pixels, four a tag."""

    points: Array  # (e, 2) on the lines
    directions: Array  # (e, 2) unit
    offset_deviation: Array  # (e,) [px] at ``points``
    tilt_deviation: Array  # (e,) [rad]
    noise: Array  # (e,) [px]
    good: NDArray[np.bool_]  # (e,)
    blur: Array  # (e,) width over which brightness rises, [px]


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
    lines = _fit(brightness, camera, rough, half, _steepest, profiles=16)
    better = pixels_from_ideal(camera, _meet(lines, ideal_from_pixels(camera, rough)))
    inside &= _inside(better, image.shape)
    better = np.where(inside[:, None, None], better, rough)
    # Just long enough to hold the blurred step: longer profiles only gather noise.
    half = np.clip(np.minimum(0.5 * lines.blur + 1.3, 0.75 * width), 1.2, 5.0)
    lines = _fit(brightness, camera, better, half, _step_positions, profiles=40)
    final = _meet(lines, ideal_from_pixels(camera, better))
    return [_refined(final, lines, t) if inside[t] else None for t in range(len(final))]


def _inside(corners: Array, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    limit = np.array([shape[1], shape[0]]) - 3.0
    return np.asarray(np.all((corners >= 2.0) & (corners <= limit), axis=(1, 2)))


def _somewhere(shape: tuple[int, ...]) -> Array:
    """A square in the picture that stands in for unusable tags, so that arrays stay whole."""
    return np.array([[4.0, 4.0], [14.0, 4.0], [14.0, 14.0], [4.0, 14.0]])


#: Finds the step in profiles: (values, places, across, half) to (places, weights, blur).
_StepFinder = Callable[[Array, Array, Array, Array], tuple[Array, Array, Array]]


def _fit(
    image: NDArray[np.float32],
    camera: Camera,
    corners: Array,
    half: Array,
    find: _StepFinder,
    profiles: int,
) -> _Lines:
    """Lines of the four edges of every tag, read along profiles of ± ``half``, shape (e,), [px]."""
    start = corners.reshape(-1, 2)
    side = np.roll(corners, -1, axis=1).reshape(-1, 2) - start
    length = np.maximum(np.hypot(side[:, 0], side[:, 1]), 1e-6)
    along = side / length[:, None]
    outward = np.stack([along[:, 1], -along[:, 0]], axis=1)  # corners run clockwise on the screen
    first, last = _usable_span(corners, length, half)
    share = (np.arange(profiles) + 0.5) / profiles
    places = first[:, None] + share * (last - first)[:, None]  # (e, n)
    shift = (np.arange(profiles) * 0.381966) % 1.0 - 0.5  # spreads the taps over the pixels
    taps = (np.arange(TAPS) + 0.5)[None, None, :] + shift[None, :, None]
    across = half[:, None, None] * (2.0 * taps / TAPS - 1.0)  # (e, n, k), outward positive
    base = start[:, None, :] + places[..., None] * along[:, None, :]
    positions = base[:, :, None, :] + across[..., None] * outward[:, None, None, :]
    values = _bilinear(image, positions)
    offset, weight, blur = find(values, places, across, half)
    points = ideal_from_pixels(camera, base + offset[..., None] * outward[:, None, :])
    return _fit_lines(points, weight, last - first, blur)


def _module_width(corners: Array, modules: int) -> Array:
    """Width of a module across each edge, shape (e,), [px]."""
    side = np.roll(corners, -1, axis=1) - corners
    middle = corners + side / 2.0
    opposite = np.roll(middle, -2, axis=1) - middle
    area = np.abs(opposite[..., 0] * side[..., 1] - opposite[..., 1] * side[..., 0])
    length = np.maximum(np.linalg.norm(side, axis=2), 1e-6)
    return np.asarray((area / length).reshape(-1) / modules)


def _usable_span(corners: Array, length: Array, half: Array) -> tuple[Array, Array]:
    """Part of each edge whose profiles do not meet the neighbouring edges, shape (e,), [px]."""
    to_next = np.roll(corners, -1, axis=1) - corners
    unit = to_next / np.maximum(np.linalg.norm(to_next, axis=2, keepdims=True), 1e-6)
    before = -np.roll(unit, 1, axis=1)  # from a corner back along the edge before it
    cosine = np.sum(unit * before, axis=2)
    sine = np.sqrt(np.maximum(1.0 - cosine**2, 1e-4))
    slope = np.maximum(cosine / sine, 0.0)  # an acute corner leaves less black beside the edge
    at_start, at_end = slope.reshape(-1), np.roll(slope, -1, axis=1).reshape(-1)
    first = np.minimum(2.0 + half * at_start, 0.3 * length)
    last = length - np.minimum(2.0 + half * at_end, 0.3 * length)
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


def _steepest(
    values: Array, places: Array, across: Array, half: Array
) -> tuple[Array, Array, Array]:
    """Where each profile rises most, to a few tenths of a pixel; as `_step_positions`.

    White modules inside the border and cables in the white around it do not move it, as they move
    the area of a profile that starts pixels away from the edge.
    """
    rise = values[..., 2:] - values[..., :-2]
    peak = np.argmax(rise, axis=-1)
    slope = np.take_along_axis(rise, peak[..., None], axis=-1)[..., 0]
    usual = np.median(slope, axis=1)
    offset = np.take_along_axis(across[:, :, 1:-1], peak[..., None], axis=-1)[..., 0]
    good = (slope > 0.4 * usual[:, None]) & (slope > 0.25 * LEAST_CONTRAST)
    contrast = np.median(values.max(axis=-1) - values.min(axis=-1), axis=1)
    blur = contrast / np.maximum(usual, 1.0) * (4.0 * half / TAPS)
    return np.where(good, offset, 0.0), good.astype(np.float64), blur


def _step_positions(
    values: Array, places: Array, across: Array, half: Array
) -> tuple[Array, Array, Array]:
    """Where each profile steps from dark to bright.

    Args:
        values: Brightness at the taps, shape (e, n, k).
        places: Of the profiles along their edge, shape (e, n), [px].
        across: Of the taps, outward positive, shape (e, n, k), [px].
        half: Half length of the profiles, shape (e,), [px].

    Returns:
        Places of the steps, shape (e, n), [px]; 1 where there is one step and no more, shape
        (e, n); width of the steps, shape (e,), [px] (nought: not estimated here).
    """
    dark_end, bright_end = values[..., :2].mean(axis=-1), values[..., -2:].mean(axis=-1)
    usual = np.quantile(dark_end, 0.4, axis=1), np.quantile(bright_end, 0.7, axis=1)
    near = np.maximum(0.12 * (usual[1] - usual[0]), 6.0)
    dark = _level(dark_end, places, usual[0], near)
    bright = _level(bright_end, places, usual[1], near)
    contrast = bright - dark
    enough = contrast > LEAST_CONTRAST
    share = (values - dark[..., None]) / np.where(enough, contrast, 1.0)[..., None]
    offset = half[:, None] * (1.0 - 2.0 * share.mean(axis=-1)) + across.mean(axis=-1)
    good = enough & (np.abs(offset) < 0.8 * half[:, None])
    good &= _is_one_step(share, across - offset[..., None], half)
    return np.where(good, offset, 0.0), good.astype(np.float64), np.zeros(len(values))


def _is_one_step(share: Array, across: Array, half: Array) -> NDArray[np.bool_]:
    """Whether profiles are dark before and bright behind their step: no cable lies there."""
    clear = np.maximum(1.2, 0.4 * half)[:, None, None]
    noise = 1.4826 * np.median(np.abs(share[..., 0] - share[..., 1]), axis=1) / np.sqrt(2.0)
    tolerance = np.maximum(0.2, 5.0 * noise)[:, None, None]
    wrong = np.where(across > clear, np.abs(share - 1.0) > tolerance, False)
    wrong |= np.where(across < -clear, np.abs(share) > tolerance, False)
    return np.asarray(~wrong.any(axis=-1))


def _level(brightness: Array, places: Array, usual: Array, near: Array) -> Array:
    """Brightness beside an edge as a straight function of place, blind to what crosses it."""
    weight = (np.abs(brightness - usual[:, None]) < near[:, None]).astype(np.float64)
    total = np.maximum(weight.sum(axis=1, keepdims=True), 1.0)
    x = places - (weight * places).sum(axis=1, keepdims=True) / total
    mean = (weight * brightness).sum(axis=1, keepdims=True) / total
    square = np.maximum((weight * x * x).sum(axis=1, keepdims=True), 1e-9)
    slope = (weight * x * (brightness - mean)).sum(axis=1, keepdims=True) / square
    return np.asarray(mean + slope * x)


def _fit_lines(points: Array, weight: Array, span: Array, blur: Array) -> _Lines:
    """Robust lines through points, shape (e, n, 2), of weight 0 or 1, spanning ``span`` [px]."""
    chord = points[:, -1] - points[:, 0]
    chord /= np.maximum(np.linalg.norm(chord, axis=1, keepdims=True), 1e-9)
    normal = np.stack([chord[:, 1], -chord[:, 0]], axis=1)
    origin = points.mean(axis=1)
    relative = points - origin[:, None, :]
    t = np.einsum("enk,ek->en", relative, chord)
    r = np.einsum("enk,ek->en", relative, normal)
    robust = weight
    for _ in range(5):
        total = np.maximum(robust.sum(axis=1), 1e-9)
        middle = (robust * t).sum(axis=1) / total
        centred = t - middle[:, None]
        square = np.maximum((robust * centred**2).sum(axis=1), 1e-9)
        height = (robust * r).sum(axis=1) / total
        slope = (robust * centred * r).sum(axis=1) / square
        error = r - height[:, None] - slope[:, None] * centred
        size = np.where(weight > 0, np.abs(error), np.nan)
        scale = 1.4826 * _median(size) + 0.005
        robust = weight * np.maximum(1.0 - (error / (4.0 * scale[:, None])) ** 2, 0.0) ** 2
    inlier = robust > 0.1
    count = inlier.sum(axis=1)
    noise = np.sqrt((inlier * error**2).sum(axis=1) / np.maximum(count - 2, 1))
    # Profiles closer together than a pixel and a half read the same pixels.
    independent = np.maximum(np.minimum(count, count / points.shape[1] * span / 1.5), 3.0)
    deviation = noise / np.sqrt(independent)
    arm = np.sqrt(square / total)
    direction = chord + slope[:, None] * normal
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return _Lines(
        points=origin + middle[:, None] * chord + height[:, None] * normal,
        directions=direction,
        offset_deviation=np.hypot(deviation, FLOOR),
        tilt_deviation=np.hypot(deviation, FLOOR) / np.maximum(arm, 1e-6),
        noise=noise,
        good=(count >= LEAST_SHARE * points.shape[1]) & (noise < MOST_NOISE),
        blur=blur,
    )


def _median(values: Array) -> Array:
    """Median of each row without its NaNs; large for a row of nothing else."""
    filled = np.sort(np.where(np.isnan(values), np.inf, values), axis=1)
    count = np.sum(np.isfinite(filled), axis=1)
    rows = np.arange(len(values))
    return np.where(count > 0, filled[rows, np.maximum(count - 1, 0) // 2], 1e3)


def _meet(lines: _Lines, rough: Array) -> Array:
    """Corners where neighbouring good lines meet, else the rough ones; shape (t, 4, 2)."""
    points, directions = lines.points.reshape(-1, 4, 2), lines.directions.reshape(-1, 4, 2)
    before_point, before = np.roll(points, 1, axis=1), np.roll(directions, 1, axis=1)
    cross = directions[..., 0] * before[..., 1] - directions[..., 1] * before[..., 0]
    good = lines.good.reshape(-1, 4)
    good = good & np.roll(good, 1, axis=1) & (np.abs(cross) > 1e-3)
    gap = before_point - points
    share = gap[..., 0] * before[..., 1] - gap[..., 1] * before[..., 0]
    share /= np.where(good, cross, 1.0)
    return np.where(good[..., None], points + share[..., None] * directions, rough)


def _refined(corners: Array, lines: _Lines, tag: int) -> RefinedTag | None:
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
