"""The report of a camera calibration: one page that needs neither a server nor a network."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from importlib.resources import files
from string import Template

import numpy as np

from calibration.camera import CameraCalibration
from calibration.uncertainty import NAMES
from calibration.verdict import Verdict

_WIDTH = 560.0


def camera_page(result: CameraCalibration, verdict: Verdict, name: str, date: str) -> str:
    """The whole page."""
    template = files("calibration").joinpath("camera_page.template").read_text(encoding="utf-8")
    return Template(template).substitute(
        title=escape(f"Calibration of camera {name}"),
        lead=escape(
            f"{date}, {result.size[0]} × {result.size[1]} px, {len(result.views)} pictures used,"
            f" {len(result.unused)} not"
        ),
        mark="good" if verdict.good else "bad",
        verdict=escape(str(verdict)),
        steps="".join(f"<li>{escape(step)}</li>" for step in verdict.next_steps),
        numbers=_numbers(result, verdict),
        map=_map(result, verdict),
        coverage=escape(f"{verdict.covered:.0%} of the picture's cells have seen corners"),
        tilts=_tilts(verdict),
        pictures=_pictures(result),
        unused=_rows((name, reason) for name, reason in result.unused.items())
        or _rows([("none",)]),
    )


def _numbers(result: CameraCalibration, verdict: Verdict) -> str:
    widths = result.uncertainty.half_widths
    rows = [
        (key, f"{value:.5g} ± {width:.2g}")
        for (key, value), width in zip(result.values.items(), widths, strict=True)
    ]
    rows += [
        ("corners off, RMS", f"{result.error:.3f} px"),
        (f"a point at {verdict.distance:.2f} m", f"within {verdict.error * 1e3:.2g} mm (95 %)"),
        ("two halves of the pictures", f"{verdict.halves * 1e3:.2g} mm apart there"),
        ("data", result.data_hash[:16]),
    ]
    return _rows(rows)


def _map(result: CameraCalibration, verdict: Verdict) -> str:
    """Corners seen, on cells that are darker the more corners they have."""
    width, height = result.size
    scale = _WIDTH / width
    columns, rows = verdict.coverage.shape
    most = max(float(verdict.coverage.max()), 1.0)
    shapes = []
    for (i, j), count in np.ndenumerate(verdict.coverage):
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


def _tilts(verdict: Verdict) -> str:
    """Tilt of each picture's board, about both axes, ± 50°."""
    dots = "".join(
        f'<circle cx="{140 + 2.4 * np.clip(y, -50, 50):.1f}"'
        f' cy="{140 - 2.4 * np.clip(x, -50, 50):.1f}" r="4"/>'
        for x, y in verdict.tilts
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
    return _rows(
        (name, f"{error:.3f} px", f"{len(seen.corners)}", f"{without:+.2f} px")
        for (name, error), seen, without in zip(
            result.view_errors.items(), result.views.values(), change, strict=True
        )
    )


def _rows(rows: Iterable[Sequence[str]]) -> str:
    text = []
    for row in rows:
        first, *rest = row
        cells = "".join(f"<td>{escape(cell)}</td>" for cell in rest)
        text.append(f'<tr><th scope="row">{escape(first)}</th>{cells}</tr>')
    return "".join(text)
