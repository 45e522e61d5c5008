"""The report of a rig's calibration."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from calibration.page import Section, interval_rows, page_of, table_of
from calibration.rig_calibration import RigCalibration
from calibration.rig_verdict import RigQuality
from cdpr.poses import Array

_WIDTH, _HEIGHT = 560.0, 200.0


def rig_page(result: RigCalibration, quality: RigQuality, name: str, date: str) -> str:
    """The whole page."""
    data, out = result.measured, result.held_out
    kind = "poses and drive positions" if out.poses else "drive positions alone"
    told = result.not_identified
    residuals = np.sqrt(np.mean(result.fit.residuals**2, axis=0)) * 1e3
    return page_of(
        f"Calibration of rig {result.rig.name}",
        f"{name}, {date}, {kind} in {len(data)} places",
        quality.verdict,
        [
            Section("How well places are told that the fit did not see", _held_out(quality)),
            Section(
                "What cannot be identified",
                "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in told) + "</ul>"
                if told
                else "<p>Everything that was looked for was found.</p>",
                "Left as in the rig file. It makes no difference at the places that were measured.",
            ),
            Section(
                "Information of each direction",
                _falling(result.observability.information),
                "On a logarithmic scale; below the line the rig file knows more than the data.",
            ),
            Section("Numbers, with 95 % intervals", table_of(interval_rows(result.intervals))),
            Section(
                "Cables",
                table_of((f"cable {i}", f"{r:.3f} mm") for i, r in enumerate(residuals, start=1)),
                "How far cables at the fitted poses are from what the drives tell, RMS.",
            ),
            Section(
                "Places",
                table_of(_places(result), ("place", "by the rig file", "left out of the fit")),
            ),
            Section("Not used", table_of(data.unused.items())),
        ],
    )


def _held_out(quality: RigQuality) -> str:
    rows = [
        ("by the rig file as it is", f"{quality.before * 1e3:.3f} mm RMS"),
        ("each left out of the fit once", f"{quality.held_out * 1e3:.3f} mm RMS"),
        ("anywhere in the workspace, turned as at home", f"within {quality.level * 1e3:.2g} mm"),
        (f"turned by {np.degrees(quality.tilt):.3g}°", f"within {quality.turned * 1e3:.2g} mm"),
    ]
    return table_of(rows)


def _places(result: RigCalibration) -> list[Sequence[str]]:
    out = result.held_out
    rows = zip(result.measured.names, out.before * 1e3, out.after * 1e3, strict=True)
    return [(name, f"{before:.3f} mm", f"{after:.3f} mm") for name, before, after in rows]


def _falling(information: Array) -> str:
    """A bar a direction, from 10⁻³ to 10⁶."""
    digits = np.clip(np.log10(np.maximum(information, 1e-3)), -3.0, 6.0)
    step = _WIDTH / len(digits)
    one = _HEIGHT * 6.0 / 9.0
    bars = "".join(
        f'<rect x="{k * step:.1f}" y="{_HEIGHT - (d + 3.0) / 9.0 * _HEIGHT:.1f}"'
        f' width="{0.8 * step:.1f}" height="{(d + 3.0) / 9.0 * _HEIGHT:.1f}"'
        f' fill="{"#2f6db5" if d > 0.0 else "#c0392b"}"/>'
        for k, d in enumerate(digits.tolist())
    )
    line = f'<line x1="0" x2="{_WIDTH}" y1="{one:.1f}" y2="{one:.1f}" stroke="#5c6675"/>'
    return (
        f'<svg viewBox="0 0 {_WIDTH:.0f} {_HEIGHT:.0f}" role="img"'
        f' aria-label="information of each direction">{bars}{line}</svg>'
    )
