"""The report of a camera calibration."""

from __future__ import annotations

import numpy as np

from calibration.camera import CameraCalibration
from calibration.camera_verdict import CameraQuality
from calibration.page import Section, interval_rows, page_of, table_of
from calibration.uncertainty import NAMES

_WIDTH = 560.0


def camera_page(result: CameraCalibration, quality: CameraQuality, name: str, date: str) -> str:
    """The whole page."""
    lead = (
        f"{date}, {result.size[0]} × {result.size[1]} px, {len(result.views)} pictures used,"
        f" {len(result.unused)} not"
    )
    covered = f"{quality.covered:.0%} of the picture's cells have seen corners"
    tilted = "A dot for each picture: forward and backward up and down, left and right across."
    used = "Error, corners, and how fx changes without the picture."
    return page_of(
        f"Calibration of camera {name}",
        lead,
        quality.verdict,
        [
            Section("Numbers, with 95 % intervals", _numbers(result, quality)),
            Section("Where the board was seen", _map(result, quality), covered),
            Section("How the board was tilted", _tilts(quality), tilted),
            Section("Pictures used", _pictures(result), used),
            Section("Pictures not used", table_of(result.unused.items())),
        ],
    )


def _numbers(result: CameraCalibration, quality: CameraQuality) -> str:
    verdict = quality.verdict
    return table_of(
        [
            *interval_rows(result.intervals),
            ("corners off, RMS", f"{result.error:.3f} px"),
            (f"a point {verdict.where}", f"within {verdict.error * 1e3:.2g} mm (95 %)"),
            ("boards were", f"{quality.nearest:.3g} to {quality.farthest:.3g} m away"),
            ("two halves of the pictures", f"{quality.halves * 1e3:.2g} mm apart there"),
            ("data", result.data_hash[:23]),
        ]
    )


def _map(result: CameraCalibration, quality: CameraQuality) -> str:
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
            f' fill="#2f6db5" fill-opacity="{shade:.2f}" stroke="#dde2e8"/>'
        )
    for seen in result.views.values():
        shapes += [
            f'<circle cx="{x * scale:.1f}" cy="{y * scale:.1f}" r="1.4"/>' for x, y in seen.corners
        ]
    return (
        f'<svg viewBox="0 0 {_WIDTH:.0f} {height * scale:.0f}" role="img"'
        f' aria-label="where corners were seen">{"".join(shapes)}</svg>'
    )


def _tilts(quality: CameraQuality) -> str:
    """Tilt of each picture's board, about both axes, ± 50°."""
    dots = "".join(
        f'<circle cx="{140 + 2.4 * np.clip(y, -50, 50):.1f}"'
        f' cy="{140 - 2.4 * np.clip(x, -50, 50):.1f}" r="4"/>'
        for x, y in quality.tilts
    )
    rings = "".join(
        f'<circle cx="140" cy="140" r="{2.4 * ring}" fill="none" stroke="#dde2e8"/>'
        f'<text x="{144 + 2.4 * ring}" y="137">{ring}°</text>'
        for ring in (20, 40)
    )
    return (
        '<svg viewBox="0 0 280 280" class="small" role="img"'
        f' aria-label="how the board was tilted">{rings}{dots}</svg>'
    )


def _pictures(result: CameraCalibration) -> str:
    """Error of each picture, and how much of the focal length hangs on it."""
    change = result.uncertainty.without[:, NAMES.index("fx_px")]
    return table_of(
        (name, f"{error:.3f} px", f"{len(seen.corners)}", f"{without:+.2f} px")
        for (name, error), seen, without in zip(
            result.view_errors.items(), result.views.values(), change, strict=True
        )
    )
