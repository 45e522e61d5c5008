"""Report of a rig's calibration: changes, uncertainty and residuals."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from calibration.geometry.calibrate import RigCalibration
from calibration.geometry.parameters import AXES
from calibration.geometry.quality import RigQuality
from calibration.report import Section, drawing, page_of, table_of
from calibration.statistics import Interval
from model.kinematics import cables_to
from model.pages.charts import DOTTED, Chart, ChartLine, chart_grid, charts
from model.pages.page import bullets, list_table, paragraph, tile, tiles
from model.pages.scene import (
    Label,
    Moment,
    SceneFigure,
    arrows,
    frame_surface,
    grid_floor,
    platform_surface,
)
from model.pages.viewer import SCENE_SCRIPTS, page_data, viewer
from model.pose import Array
from model.rig import Rig

_SHARE = 0.12
"""Length of the longest arrow, as a share of the frame's diagonal."""
_LAYERS = (
    ("outlets", "Outlets moved", "limit", True),
    ("anchors", "Anchors moved", "tag", True),
    ("robot", "Platform and cables, by the rig file", "platform", True),
    ("numbers", "Cable numbers", "ink", True),
    ("frame", "Frame of outlets", "frame", True),
    ("floor", "Floor", "line", True),
)
_HEAD = ("", "rig file", "new", "change", "± 95 %", "changed")


def rig_page(result: RigCalibration, quality: RigQuality, name: str, date: str) -> str:
    """The report page."""
    data, out = result.measured, result.held_out
    kind = "poses and drive positions" if out.poses else "drive positions only"
    scene, factor = _scene(result)
    unidentified = result.not_identified
    sections = [
        Section("What moved", _viewer(result, scene, factor)),
        *_number_sections(result),
        Section(
            "Errors at held-out poses",
            _held_out(quality) + charts(_by_pose(result)),
            "Every fifth pose is held out of the fit in turn.",
        ),
        Section(
            "Residuals of each cable",
            _cables(result) + chart_grid(_residuals(result)),
            "Cable length at the fitted pose minus its encoder length, pose by pose.",
        ),
        *_sensor_sections(result),
        Section(
            "What cannot be identified",
            bullets(unidentified) if unidentified else paragraph("All parameters were identified."),
            "Kept as in the rig file. It makes no difference at the measured poses.",
        ),
        Section(
            "Information of each direction",
            _information_bars(result.observability.information),
            "On a logarithmic scale; below the line the rig file is more accurate than the data.",
        ),
        Section("Poses", _poses(result)),
        Section("Not used", table_of(data.unused.items(), ("pose", "why"))),
    ]
    return page_of(
        f"Calibration of rig {result.rig.name}",
        f"{name}, {date}, {kind} of {len(data)} samples",
        quality.verdict,
        sections,
        tiles=_headline(result, quality),
        scripts=("charts.js", *SCENE_SCRIPTS),
        data=page_data(scene),
    )


def _headline(result: RigCalibration, quality: RigQuality) -> str:
    """Tiles with the key figures."""
    what = "positions" if result.held_out.poses else "lengths of cables"
    moved = np.linalg.norm(result.geometry.outlets - result.rig.outlets, axis=1) * 1e3
    changed = sum(row[-1] == "yes" for row in number_rows(result))
    tilt = np.degrees(quality.tilt)
    return tiles(
        [
            tile(
                "Error" if result.held_out.poses else "Error of lengths",
                f"{quality.before * 1e3:.2f} → {quality.held_out * 1e3:.2f} mm",
                f"RMS of held-out {what}: with the rig file → with this calibration",
                "headline",
            ),
            tile(
                "In the workspace",
                f"{quality.level * 1e3:.2g} mm",
                f"at most, 95 %; rotated by {tilt:.3g}° {quality.rotated * 1e3:.2g} mm",
            ),
            tile(
                "Farthest outlet",
                f"{moved.max():.1f} mm",
                f"from the rig file: outlet {int(np.argmax(moved)) + 1}",
            ),
            tile(
                "Numbers changed",
                f"{changed}",
                f"of {len(result.intervals)} by more than their interval",
            ),
            tile("Poses", f"{len(result.measured)}", f"{len(result.measured.unused)} not used"),
        ]
    )


# Parameter tables: rig file, calibration, change and interval.


def numbers_in_file(rig: Rig) -> dict[str, float]:
    """Values of all calibrated parameters in the rig file, by name with unit."""
    found = {
        f"{what}_{i}_{axis}_mm": float(value) * 1e3
        for what, points in (("outlet", rig.outlets), ("anchor", rig.anchors))
        for i, point in enumerate(points, start=1)
        for axis, value in zip(AXES, point, strict=True)
    }
    found["pulley_radius_mm"] = rig.pulley_radius * 1e3
    for i, winch in enumerate(rig.document.winches, start=1):
        found |= {f"drum_{i}_mm_per_rev": winch.drum_mm_per_rev, f"offset_{i}_mm": 0.0}
        found |= {f"stiffness_{i}_n": float(rig.cable_stiffness[i - 1])}
        found |= {f"swivel_zero_{i}_deg": 0.0}
    found |= {f"imu_mounting_{axis}_deg": 0.0 for axis in AXES}
    return {**found, "stiffness_n": float(rig.cable_stiffness.mean())}


def number_rows(result: RigCalibration) -> list[tuple[str, str, str, str, str, str]]:
    """One row per parameter: name, rig file, calibration, change, half width, changed or not."""
    before = numbers_in_file(result.rig)
    return [_row(name, before[name], interval) for name, interval in result.intervals.items()]


def _row(name: str, before: float, found: Interval) -> tuple[str, str, str, str, str, str]:
    change, (low, high) = found.value - before, found.bounds
    digits = 0 if name.endswith("_n") else 2
    return (
        name,
        f"{before:.{digits}f}",
        f"{found.value:.{digits}f}",
        f"{change:+z.{digits}f}",
        found.half_width_text.removeprefix("± "),
        "no" if low <= before <= high else "yes",
    )


def _number_sections(result: RigCalibration) -> list[Section]:
    """One table per kind of parameter."""
    rows = number_rows(result)
    kinds = (
        ("Outlets [mm]", "outlet_", "World frame."),
        ("Anchors [mm]", "anchor_", "Platform frame."),
        ("Drums [mm per revolution]", "drum_", "Cable paid out per drum revolution."),
        (
            "Cable length at home [mm]",
            "offset_",
            "Cable length at the home counts beyond that of the home pose; 0 in the rig file."
            " The result's home counts include it.",
        ),
        ("Pulleys and cables", ("pulley_", "stiffness_n"), ""),
        ("Stiffness of each cable [N]", tuple(f"stiffness_{d}" for d in range(1, 10)), "E·A."),
        ("Zeros of swivel angles [°]", "swivel_", "Reading at the angle of the home pose."),
        ("Mounting of the IMU [°]", "imu_", "Rotation vector from its axes to the platform's."),
    )
    return [
        Section(title, _numbers(chosen), note)
        for title, start, note in kinds
        if (chosen := [row for row in rows if row[0].startswith(start)])
    ]


def _numbers(rows: Sequence[Sequence[str]]) -> str:
    """Table of one kind, with short names and one row per point."""
    if not rows[0][0].startswith(("outlet_", "anchor_")):
        return list_table(_HEAD, [(_short(row[0]), *row[1:]) for row in rows], "numbers")
    points = [rows[k : k + 3] for k in range(0, len(rows), 3)]
    return list_table(_HEAD, map(_point, points), "numbers")


def _short(name: str) -> str:
    words = name.split("_")
    return f"{words[0]} {words[1]}" if words[1].isdigit() else name


def _point(rows: Sequence[Sequence[str]]) -> tuple[str, ...]:
    """One table row with x, y and z of a point on three lines."""
    name = "\n".join((_short(rows[0][0]) if k == 0 else "") + f" {AXES[k]}" for k in range(3))
    return (name, *("\n".join(row[k] for row in rows) for k in range(1, 6)))


# The rig in 3-D.


def _scene(result: RigCalibration) -> tuple[SceneFigure, float]:
    """The rig as in its file, arrows to the calibrated points, and the arrows' scale."""
    rig, geometry = result.rig, result.geometry
    home = rig.home
    by_outlets, by_anchors = geometry.outlets - rig.outlets, geometry.anchors - rig.anchors
    frame = frame_surface(rig)
    longest = max(float(np.linalg.norm(d, axis=1).max()) for d in (by_outlets, by_anchors))
    span = float(np.linalg.norm(np.ptp(frame.vertices, axis=0)))
    factor = _round(_SHARE * span / longest) if longest > 0.0 else 1.0
    floor, _ = grid_floor(frame.vertices)
    anchors = home.apply(rig.anchors)
    exits = cables_to(rig, anchors).exits if rig.pulley_radius else rig.outlets
    by_anchors_in_world = by_anchors @ home.rotation.T
    scene = SceneFigure(
        surfaces=(frame,),
        strokes=(
            floor,
            arrows("outlets", "limit", rig.outlets, rig.outlets + factor * by_outlets, 2.5),
            arrows("anchors", "tag", anchors, anchors + factor * by_anchors_in_world, 2.0),
        ),
        labels=_moved_labels(rig, by_outlets),
        anchors=rig.anchors,
        platform=platform_surface(rig),
        moments=(Moment(0.0, home.position, home.rotation, exits),),
    )
    return scene, factor


def _round(value: float) -> float:
    """The largest of 1, 2 or 5 times a power of ten that is not above ``value``."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(f for f in (1.0, 2.0, 5.0) if f * power <= value) * power)


def _moved_labels(rig: Rig, moved: Array) -> tuple[Label, ...]:
    return tuple(
        Label("outlets", f"{np.linalg.norm(shift) * 1e3:.1f} mm", outlet)
        for outlet, shift in zip(rig.outlets, moved, strict=True)
    )


def _viewer(result: RigCalibration, scene: SceneFigure, factor: float) -> str:
    moved = np.linalg.norm(result.geometry.outlets - result.rig.outlets, axis=1) * 1e3
    label = (
        f"The rig of the rig file, with arrows to the {len(moved)} calibrated outlets and"
        f" anchors, {factor:g} times as long as the change; outlets moved by {moved.min():.1f} to"
        f" {moved.max():.1f} mm."
    )
    hint = f"Arrows are {factor:g} times as long as the change from the rig file."
    return viewer(scene, label, _LAYERS, hint)


# Residuals.


def _chart(title: str, text: str, quantity: str, lines: Iterable[ChartLine], count: int) -> Chart:
    """A chart over pose numbers."""
    return Chart(
        title,
        text,
        quantity,
        "mm",
        tuple(lines),
        (0.5, count + 0.5),
        x_quantity="pose",
        x_unit="number",
        from_zero=True,
        group="poses",
    )


def _by_pose(result: RigCalibration) -> Chart:
    out, number = result.held_out, np.arange(1.0, len(result.measured) + 1.0)
    text = (
        f"Line chart of the error of {len(number)} poses: {out.before.max() * 1e3:.2f} mm with"
        f" the rig file, up to {out.after.max() * 1e3:.2f} mm held out of the fit."
    )
    lines = (
        ChartLine("with the rig file", number, out.before * 1e3, "limit", dash=DOTTED),
        ChartLine("held out of the fit", number, out.after * 1e3, "encoder"),
    )
    return _chart("Error at each pose", text, "error", lines, len(number))


def _residuals(result: RigCalibration) -> list[Chart]:
    """One chart per cable, all of the same height."""
    residuals = result.fit.cables * 1e3
    number = np.arange(1.0, len(residuals) + 1.0)
    largest = float(np.abs(residuals).max())
    return [
        Chart(
            f"Cable {i}",
            f"Line chart of the residual of cable {i} at each pose, at most"
            f" {np.abs(column).max():.3f} mm.",
            "residual",
            "mm",
            (ChartLine("residual", number, column, "encoder", 1.2),),
            (0.5, len(number) + 0.5),
            x_quantity="pose",
            x_unit="number",
            y_includes=(-largest, 0.0, largest),
            height=120,
            group="poses",
        )
        for i, column in enumerate(residuals.T, start=1)
    ]


def _sensor_sections(result: RigCalibration) -> list[Section]:
    """Residuals of sensors beside cable lengths, one row each."""
    fit = result.fit
    if not fit.sensors:
        return []
    residuals = np.degrees(np.abs(fit.residuals[:, fit.cables.shape[1] :]))
    rows = [
        (name, f"{rms:.3f}", f"{column.max():.3f}", f"pose {int(column.argmax()) + 1}")
        for name, rms, column in zip(
            fit.sensors, np.degrees(fit.sensor_rms), residuals.T, strict=True
        )
    ]
    text = list_table(("", "RMS [°]", "largest [°]", "at"), rows, "numbers")
    note = "Angle at the fitted pose minus the measured one; of an IMU about both axes."
    return [Section("Residuals of swivel angles and IMU", text, note)]


def _cables(result: RigCalibration) -> str:
    residuals = result.fit.cables * 1e3
    rows = [
        (
            f"cable {i}",
            f"{np.sqrt(np.mean(column**2)):.3f}",
            f"{np.abs(column).max():.3f}",
            f"pose {int(np.argmax(np.abs(column))) + 1}",
        )
        for i, column in enumerate(residuals.T, start=1)
    ]
    return list_table(("", "RMS [mm]", "largest [mm]", "at"), rows, "numbers")


def _held_out(quality: RigQuality) -> str:
    rows = [
        ("with the rig file as it is", f"{quality.before * 1e3:.3f} mm RMS"),
        ("held out of the fit", f"{quality.held_out * 1e3:.3f} mm RMS"),
        ("anywhere in the workspace, home orientation", f"within {quality.level * 1e3:.2g} mm"),
        (f"rotated by {np.degrees(quality.tilt):.3g}°", f"within {quality.rotated * 1e3:.2g} mm"),
    ]
    return table_of(rows)


def _poses(result: RigCalibration) -> str:
    """Collapsible table with one row per pose."""
    out, residuals = result.held_out, np.abs(result.fit.cables) * 1e3
    each = zip(result.measured.names, out.before * 1e3, out.after * 1e3, residuals, strict=True)
    rows = [
        (
            f"{k}",
            name,
            f"{before:.3f}",
            f"{after:.3f}",
            f"{worst.max():.3f}",
            f"{worst.argmax() + 1}",
        )
        for k, (name, before, after, worst) in enumerate(each, start=1)
    ]
    head = ("", "pose", "rig file [mm]", "held out [mm]", "largest residual [mm]", "of cable")
    return (
        f"<details><summary>All {len(rows)} poses</summary>"
        f"{list_table(head, rows, 'numbers')}</details>"
    )


def _information_bars(information: Array) -> str:
    """One bar per direction, from 10⁻³ to 10⁶."""
    width, height = 560.0, 200.0
    digits = np.clip(np.log10(np.maximum(information, 1e-3)), -3.0, 6.0)
    step, one = width / len(digits), height * 6.0 / 9.0
    bars = "".join(
        f'<rect x="{k * step:.1f}" y="{height - (d + 3.0) / 9.0 * height:.1f}"'
        f' width="{0.8 * step:.1f}" height="{(d + 3.0) / 9.0 * height:.1f}"'
        f' style="fill:var(--{"encoder" if d > 0.0 else "limit"})"/>'
        for k, d in enumerate(digits.tolist())
    )
    line = f'<path d="M0 {one:.1f}H{width:.0f}" style="stroke:var(--ink)"/>'
    known = int((information > 1.0).sum())
    label = (
        f"Bars of the information of {len(information)} directions; of {known} of them the data"
        " are more accurate than the rig file."
    )
    return drawing(bars + line, (width, height), label)
