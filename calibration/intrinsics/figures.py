"""Figures of a camera calibration: what was covered, how sure pixels are, and how corners err."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape

import cv2
import numpy as np

from calibration.intrinsics.calibrate import CameraCalibration
from calibration.intrinsics.quality import CameraQuality, corner_errors, pixel_uncertainty
from calibration.report import Section, drawing
from calibration.targets.board import Seen
from model.pose import Array, rotation_vector_from_matrix

_WIDTH = 560.0
_MOST_ARROWS = 1500
"""More of them hide each other and make the page slow."""
_LONGEST = 0.04
"""Of an arrow of the usual error, as share of the figure's width."""
_MAP = (16, 10)
"""Columns and rows of the map of uncertainty."""
_RINGS = 12


def coverage_map(result: CameraCalibration, quality: CameraQuality) -> str:
    """Corners seen, on cells that are darker the more corners they have."""
    width, height = result.size
    scale = _WIDTH / width
    columns, rows = quality.coverage.shape
    most = max(float(quality.coverage.max()), 1.0)
    shapes = []
    for (i, j), count in np.ndenumerate(quality.coverage):
        shade = 0.0 if count == 0 else 0.15 + 0.45 * float(count) / most
        shapes.append(
            f'<rect x="{i * _WIDTH / columns:.1f}" y="{j * height * scale / rows:.1f}"'
            f' width="{_WIDTH / columns:.1f}" height="{height * scale / rows:.1f}"'
            f' fill="var(--encoder)" fill-opacity="{shade:.2f}" stroke="var(--line)"/>'
        )
    for seen in result.views.values():
        shapes += [
            f'<circle cx="{x * scale:.1f}" cy="{y * scale:.1f}" r="1.4" fill="var(--ink)"/>'
            for x, y in seen.corners
        ]
    label = f"Corners in the camera's image, in {quality.covered:.0%} of its cells."
    return drawing("".join(shapes), (_WIDTH, height * scale), label)


def tilt_figure(quality: CameraQuality) -> str:
    """Tilt of each image's board, about both axes, ± 50°."""
    dots = "".join(
        f'<circle cx="{140 + 2.4 * np.clip(y, -50, 50):.1f}"'
        f' cy="{140 - 2.4 * np.clip(x, -50, 50):.1f}" r="4" fill="var(--ink)"/>'
        for x, y in quality.tilts
    )
    rings = "".join(
        f'<circle cx="140" cy="140" r="{2.4 * ring}" fill="none" stroke="var(--muted)"/>'
        f'<text x="{144 + 2.4 * ring}" y="137">{ring}°</text>'
        for ring in (20, 40)
    )
    label = f"Tilt of the board in {len(quality.tilts)} images; rings at 20° and 40°."
    return drawing(rings + dots, (280, 280), label, "small")


def uncertainty_figure(result: CameraCalibration, quality: CameraQuality) -> str:
    """Half widths of the 95 % intervals of pixels, on a map with a number in every third cell."""
    (width, height), (columns, rows) = result.size, _MAP
    scale = _WIDTH / width
    across = (np.arange(columns) + 0.5) / columns * width
    down = (np.arange(rows) + 0.5) / rows * height
    pixels = np.array([(x, y) for y in down for x in across])
    found = pixel_uncertainty(result, pixels)
    most, cell = float(found.max()), (_WIDTH / columns, height * scale / rows)
    focal = float(np.sqrt(result.matrix[0, 0] * result.matrix[1, 1]))
    shapes = []
    for k, (value, (x, y)) in enumerate(zip(found, pixels * scale, strict=True)):
        shade = 0.05 + 0.7 * float(np.sqrt(value / max(most, 1e-12)))
        shapes.append(
            f'<rect x="{x - cell[0] / 2:.1f}" y="{y - cell[1] / 2:.1f}" width="{cell[0]:.1f}"'
            f' height="{cell[1]:.1f}" fill="var(--limit)" fill-opacity="{shade:.2f}"/>'
        )
        if (k // columns) % 3 == 0 and (k % columns) % 3 == 0:
            shapes.append(
                f'<text x="{x:.1f}" y="{y + 4:.1f}" text-anchor="middle">{value:.2g}</text>'
            )
    at = quality.distance / focal * 1e3
    label = (
        f"Uncertainty of pixels over the image, {found.min():.2g} to {most:.2g} px, which are"
        f" {found.min() * at:.2g} to {most * at:.2g} mm at {quality.distance:.2g} m."
    )
    return drawing("".join(shapes), (_WIDTH, height * scale), label) + _caption(label)


def residual_arrows(result: CameraCalibration) -> str:
    """Errors of the corners of all images, magnified."""
    corners, errors = corner_errors(result)
    every = -(-len(corners) // _MOST_ARROWS)
    scale = _WIDTH / result.size[0]
    usual = float(np.median(np.linalg.norm(errors, axis=1)))
    by = _LONGEST * _WIDTH / max(usual, 1e-9)
    shapes = _arrows((corners - errors)[::every] * scale, errors[::every] * by)
    label = f"Errors of corners, {by / scale:.3g} times as long; half are above {usual:.2g} px."
    return drawing(shapes, (_WIDTH, result.size[1] * scale), label) + _caption(label)


def _caption(text: str) -> str:
    return f'<p class="quiet">{escape(text)}</p>'


def _arrows(begins: Array, ways: Array) -> str:
    """Lines with a dot where they begin; both in the figure's coordinates, shape (n, 2)."""
    return "".join(
        f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{x + dx:.1f}" y2="{y + dy:.1f}"'
        f' stroke="var(--ink)"/><circle cx="{x:.1f}" cy="{y:.1f}" r="1" fill="var(--limit)"/>'
        for (x, y), (dx, dy) in zip(begins, ways, strict=True)
    )


def radial_pattern(result: CameraCalibration) -> str:
    """Mean radial error in rings around the principal point, with its 95 % interval."""
    corners, errors = corner_errors(result)
    away = corners - result.matrix[:2, 2]
    distance = np.linalg.norm(away, axis=1)
    radial = np.sum(errors * away, axis=1) / np.maximum(distance, 1e-9)
    order = np.argsort(distance)
    rings = [part for part in np.array_split(order, _RINGS) if len(part) > 1]
    means = np.array([radial[part].mean() for part in rings])
    doubts = np.array([1.96 * radial[part].std(ddof=1) / np.sqrt(len(part)) for part in rings])
    radii = np.array([distance[part].mean() for part in rings])
    top = max(float(np.max(np.abs(means) + doubts)), 1e-9)
    x = 80.0 + (_WIDTH - 100.0) * radii / float(distance.max())
    y, spread = 110.0 - 90.0 * means / top, 90.0 * doubts / top
    shapes = f'<line x1="80" y1="110" x2="{_WIDTH:.0f}" y2="110" stroke="var(--muted)"/>'
    for value, at in ((top, 24), (0.0, 114), (-top, 204)):
        shapes += f'<text x="74" y="{at}" text-anchor="end">{value:+.2g} px</text>'
    shapes += "".join(
        f'<line x1="{a:.1f}" y1="{b - c:.1f}" x2="{a:.1f}" y2="{b + c:.1f}" stroke="var(--muted)"/>'
        f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3.5" fill="var(--ink)"/>'
        for a, b, c in zip(x, y, spread, strict=True)
    )
    last = f"{distance.max():.0f} px"
    shapes += f'<text x="{_WIDTH - 4:.0f}" y="226" text-anchor="end">radius up to {last}</text>'
    label = f"Mean radial error by radius up to {last}, at most {np.abs(means).max():.2g} px."
    return drawing(shapes, (_WIDTH, 232.0), label)


def worst_picture(result: CameraCalibration) -> Sequence[Section]:
    """The image with the greatest error and the board as the fit puts it; none without images."""
    name = max(result.view_errors, key=lambda key: result.view_errors[key])
    image = result.previews.get(name)
    if image is None:
        return []
    scale = _WIDTH / result.size[0]
    size = (_WIDTH, result.size[1] * scale)
    seen, pose = result.views[name], result.boards[name]
    turn = rotation_vector_from_matrix(pose.rotation)
    there = result.lens.slopes(seen.points, turn, pose.position, result.matrix, result.distortion)[
        0
    ]
    data = base64.b64encode(cv2.imencode(".jpg", image)[1].tobytes()).decode()
    area = f'width="{size[0]:.0f}" height="{size[1]:.1f}"'
    shapes = f'<image href="data:image/jpeg;base64,{data}" {area}/>'
    drawn = there * scale
    for a, b in _neighbours(seen):
        (x1, y1), (x2, y2) = drawn[a], drawn[b]
        shapes += (
            f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"'
            ' stroke="var(--encoder)" stroke-opacity="0.8"/>'
        )
    errors = seen.corners - there
    usual = float(np.median(np.linalg.norm(errors, axis=1)))
    by = _LONGEST * _WIDTH / max(usual, 1e-9)
    shapes += "".join(
        f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{x + dx:.1f}" y2="{y + dy:.1f}"'
        ' stroke="var(--limit)" stroke-width="1.5"/>'
        for (x, y), (dx, dy) in zip(drawn, errors * by, strict=True)
    )
    label = (
        f"{name}: {result.view_errors[name]:.2f} px; the board where the fit puts it, and errors"
        f" {by / scale:.3g} times as long."
    )
    return [Section("The worst image", drawing(shapes, size, label), label)]


def _neighbours(seen: Seen) -> list[tuple[int, int]]:
    """Pairs of points of a board that are next to each other."""
    gaps = np.linalg.norm(seen.points[:, None] - seen.points[None], axis=2)
    np.fill_diagonal(gaps, np.inf)
    near = gaps < 1.05 * np.median(gaps.min(axis=1))
    return [(int(a), int(b)) for a, b in np.argwhere(np.triu(near))]
