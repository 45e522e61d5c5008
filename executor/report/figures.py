"""The charts of a run over time: clearance, position, cables, following error, lateness."""

from __future__ import annotations

import re
from collections.abc import Mapping
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from executor.recording.clearance import RATE, ClearanceTable
from executor.recording.verdict import following
from executor.report.run_data import RunData
from model.pages.charts import (
    DASH_DOTTED,
    DASHED,
    DOTTED,
    Chart,
    ChartLine,
    Span,
    chart_grid,
    charts,
    series_style,
    thinned,
    with_gaps,
)
from model.pages.page import paragraph
from model.pose import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_OBSTACLES = 6
SMALL_POINTS = 300
"""Points of a line in one of several small charts."""
TOO_SMALL = 1e-6
"""A following error below this is not plotted, [m]."""
_NAMES = {"tag": "measured (camera)", "encoder": "encoders"}
_STEPS = {"tag": 0.0, "encoder": 1.0 / RATE}
"""Largest step of clearances in time, where these are at uneven times, [s]."""


def _whole(run: RunData) -> tuple[float, float]:
    return 0.0, float(run.cycles.time[-1])


def _line(
    name: str, time: Array, values: Array, role: str, most: int = 900, **style: str
) -> ChartLine:
    """A line through at most ``most`` points."""
    dash = style.get("dash", "")
    return ChartLine(name, *thinned(time, values, most), role, dash=dash)


def _drives(run: RunData, values: Array) -> ChartLine:
    """A line through values of the encoder poses, [m]."""
    known = run.cycles.has_encoder_pose
    time, values = with_gaps(run.cycles.time[known], values[known] * 1e3)
    return ChartLine("drives", time, values, "encoder")


def _level(name: str, value: float, run: RunData, *, fits: bool = True) -> ChartLine:
    """A horizontal line at a limit."""
    ends = np.array(_whole(run))
    return ChartLine(name, ends, np.full(2, value), "limit", dash=DOTTED, fits=fits)


def _stops(run: RunData, *, named: bool = False) -> tuple[Span, ...]:
    """Time spans of stops; of zero length without a dwell."""
    last = float(run.cycles.time[-1])
    return tuple(
        Span(
            stop["reached_s"],
            last if stop["left_s"] is None else stop["left_s"],
            stop["name"] if named else "",
        )
        for stop in run.summary["stops"]
        if stop["reached_s"] is not None
    )


# Clearance over time, planned and measured (paper, Fig. 11a and b).


def clearance_figure(run: RunData) -> str:
    """The smallest clearance over time and, below, that to each obstacle; HTML."""
    shown = nearest_obstacles(run.clearance, MOST_OBSTACLES)
    each = [_obstacle(run, index) for index in shown] if len(shown) > 1 else []
    return charts(_smallest(run), _difference(run)) + chart_grid(each)


def nearest_obstacles(clearance: ClearanceTable, most: int) -> list[int]:
    """Up to ``most`` nearest obstacles, in the order of the scene."""
    if not len(clearance) or not clearance.obstacles:
        return []
    least = np.nanmin(clearance.planned_distances, axis=0)
    return sorted(np.argsort(least)[:most].tolist())


def _sources(clearance: ClearanceTable) -> list[ClearanceTable]:
    """The rows of each source, the best first; the last one has rows of all encoder poses."""
    return [rows for rows in map(clearance.of, ("tag", "encoder")) if len(rows)]


def _smallest(run: RunData) -> Chart:
    lines = []
    for rows in _sources(run.clearance):
        source = rows.source[0]
        time, distance, low, high = with_gaps(rows.time, *_band(rows), step=_STEPS[source])
        lines.append(ChartLine(_NAMES[source], time, distance, source, band=(low, high)))
    every = _sources(run.clearance)[-1]
    planned = every.planned_distance * 1e3
    lines.append(_line("planned", every.time, planned, "planned", dash=DASHED))
    lines.append(_required(run))
    return Chart(
        "Cables and platform to the nearest obstacle",
        _clearance_text(run),
        "smallest clearance",
        "mm",
        tuple(lines),
        _whole(run),
        from_zero=True,
        height=250,
    )


def _band(rows: ClearanceTable) -> tuple[Array, Array, Array]:
    """The smallest distance and the bounds of the true one, [mm]."""
    low = rows.distance - rows.uncertainty
    return rows.distance * 1e3, low * 1e3, rows.at_most * 1e3


def _difference(run: RunData) -> Chart:
    """The best measurement minus the plan; its band should contain zero."""
    rows = _sources(run.clearance)[0]
    planned, step = rows.planned_distance * 1e3, _STEPS[rows.source[0]]
    band = (values - planned for values in _band(rows))
    time, off, low, high = with_gaps(rows.time, *band, step=step)
    name = _NAMES[rows.source[0]]
    zero = ChartLine("", np.array(_whole(run)), np.zeros(2), "planned", dash=DASHED)
    measured = ChartLine("difference", time, off, rows.source[0], 1.0, band=(low, high))
    return Chart(
        f"{name} less planned, with its uncertainty".capitalize(),
        f"Line chart of the clearance {name} less the planned one, within"
        f" {np.nanmin(off):.1f} to {np.nanmax(off):.1f} mm.",
        "difference",
        "mm",
        (measured, zero),
        _whole(run),
        height=130,
    )


def _obstacle(run: RunData, index: int) -> Chart:
    lines = []
    for rows in _sources(run.clearance):
        near = rows.distances[:, index] * 1e3
        step = _STEPS[rows.source[0]]
        time, distance = with_gaps(rows.time, near, most=SMALL_POINTS, step=step)
        by_camera = rows.source[0] == "tag"
        width, opacity = (4.0, 0.5) if by_camera else (1.3, 1.0)
        name = "camera" if by_camera else "drives"
        lines.append(ChartLine(name, time, distance, rows.source[0], width, opacity=opacity))
    every = _sources(run.clearance)[-1]
    planned = every.planned_distances[:, index] * 1e3
    lines.append(_line("planned", every.time, planned, "planned", SMALL_POINTS, dash=DASHED))
    lines.append(_required(run))
    name = run.clearance.obstacles[index]
    text = f"Line chart of the clearance to {name}, planned at least {np.nanmin(planned):.1f} mm."
    return Chart(
        name, text, "clearance", "mm", tuple(lines), _whole(run), from_zero=True, height=150
    )


def _required(run: RunData) -> ChartLine:
    value = run.plan.scene.obstacle_clearance * 1e3
    return _level(f"required ({value:g} mm)", value, run)


def _clearance_text(run: RunData) -> str:
    key = run.summary["clearance_mm"]
    if key is None or key["measured_min"] is None:
        return "No clearance was measured."
    return (
        f"Line chart of the smallest clearance over time. Planned at least {key['planned_min']:.1f}"
        f" mm, measured at least {key['measured_min']:.1f} mm with an uncertainty of"
        f" {key['measured_uncertainty']:.1f} mm below it and an upper bound of"
        f" {key['measured_at_most']:.1f} mm, between {key['pair'][0]} and {key['pair'][1]};"
        f" required {key['required']:g} mm."
    )


# Drives: cable lengths, tensions, following error, lateness of the cycles.


def length_figure(run: RunData) -> str:
    """Length of every cable over time; HTML."""
    cycles = run.cycles
    lines = tuple(
        _line(f"cable {i + 1}", cycles.time, cycles.lengths[:, i] * 1e3, role, dash=dash)
        for i, (role, dash) in enumerate(map(series_style, range(cycles.cable_count)))
    )
    low, high = np.nanmin(cycles.lengths) * 1e3, np.nanmax(cycles.lengths) * 1e3
    text = f"Line chart of {cycles.cable_count} cable lengths, {low:.0f} to {high:.0f} mm."
    return charts(
        Chart(
            "Length of each cable",
            text,
            "length",
            "mm",
            lines,
            _whole(run),
            names_at_ends=True,
            height=max(280, 14 * cycles.cable_count),
        )
    )


def tension_figure(run: RunData) -> str:
    """Tension of every cable over time, planned and measured; HTML."""
    key = run.summary["tension_n"]
    limits = f"allowed {key['lower_limit']:g} to {key['upper_limit']:g} N"
    both = np.concatenate([run.cycles.tensions, run.cycles.planned_tensions])
    reached = float(np.nanmax(both))
    return chart_grid([_tension(run, i, limits, reached) for i in range(run.cycles.cable_count)])


def _tension(run: RunData, i: int, limits: str, reached: float) -> Chart:
    cycles, lower, upper = run.cycles, run.rig.min_tension, run.rig.max_tension
    time, measured = thinned(cycles.time, cycles.tensions[:, i], SMALL_POINTS)
    planned = cycles.planned_tensions[:, i]
    known = measured[np.isfinite(measured)]
    said = f"measured {known.min():.1f} to {known.max():.1f} N" if known.size else "not measured"
    return Chart(
        f"Cable {i + 1}",
        f"Line chart of the tension of cable {i + 1}, {said}, {limits}.",
        "tension",
        "N",
        (
            ChartLine("measured (torque)", time, measured, "encoder", 2.4, opacity=0.55),
            _line("planned", cycles.time, planned, "ink", SMALL_POINTS, dash=DASHED),
            _level("limits", lower, run),
            _level("", upper, run, fits=reached > 0.8 * upper),
        ),
        _whole(run),
        spans=_stops(run),
        from_zero=True,
        y_includes=(0.0, reached),
        height=140,
    )


def timing_figure(run: RunData) -> str:
    """Following error over time and, for a run in real time, lateness of cycles; HTML."""
    parts = _following(run)
    lateness = run.cycles.lateness * 1e3
    if not run.fast and np.isfinite(lateness).any():
        parts += charts(_lateness(run, lateness[np.isfinite(lateness)]))
    return parts


def _following(run: RunData) -> str:
    """The worst cable over time, or one sentence if negligible."""
    limit, error = run.rig.motion.following_error * 1e3, run.cycles.following_error
    known = error[np.isfinite(error)]
    if not known.size:
        return paragraph(following(run.cycles, run.rig.motion.following_error).text)
    largest = float(known.max())
    if largest < TOO_SMALL:
        return paragraph(
            f"The following error stayed below 0.001 mm on all cables (limit {limit:g} mm), so"
            " there is no curve to show."
        )
    return charts(
        Chart(
            f"Following error, the worst cable (limit {limit:g} mm)",
            f"Line chart of the largest following error. At most {largest * 1e3:.3f} mm; the"
            f" limit is {limit:g} mm.",
            "following error",
            "mm",
            (
                _line("worst cable", run.cycles.time, error * 1e3, "encoder"),
                _level("limit", limit, run, fits=largest * 1e3 > 0.5 * limit),
            ),
            _whole(run),
            from_zero=True,
        )
    )


def _lateness(run: RunData, late: Array) -> Chart:
    """Histogram of lateness, on a logarithmic scale."""
    counts, edges = np.histogram(late, bins=60)
    x = np.repeat(edges, 2)[1:-1]
    y = np.repeat(np.log10(np.maximum(counts, 0.5)), 2)
    floor = np.full(len(y), np.log10(0.5))
    key = run.summary["lateness_ms"]
    text = f"Histogram of the lateness of {len(late)} cycles."
    if key is not None and key["max"] is not None:
        text += f" 99 % within {key['p99']:.2f} ms, at most {key['max']:.2f} ms."
    high = float(np.percentile(late, 99.0))
    return Chart(
        "Lateness of the cycles",
        text,
        "cycles",
        "",
        (ChartLine("cycles", x, y, "encoder", 1.0, band=(floor, y)),),
        (float(edges[0]), float(edges[-1])),
        x_quantity="lateness",
        x_unit="ms",
        spans=(Span(high, high, f"99 % within {high:.2f} ms"),),
        logarithmic=True,
        group="lateness",
    )


# Position over time: planned, from the encoders, from the camera (paper, Fig. 11c).


#: Line styles of single cameras.
_DASHES = (DASHED, DOTTED, DASH_DOTTED)


def position_figure(run: RunData) -> str:
    """x, y and z over time, and distances from the planned position; HTML."""
    return charts(*(_coordinate(run, i) for i in range(3)), _error(run))


def _coordinate(run: RunData, i: int) -> Chart:
    cycles, poses, axis = run.cycles, run.poses, "xyz"[i]
    lines = []
    # The camera's wide line lies under the thin ones, which it would hide where all agree.
    if poses.ok.any():
        time, position = with_gaps(poses.time[poses.ok], poses.position[poses.ok, i] * 1e3)
        lines.append(ChartLine("camera", time, position, "tag", 4.5, opacity=0.45))
    lines.append(_drives(run, cycles.encoder[:, i]))
    planned = cycles.planned[:, i] * 1e3
    lines.append(_line("planned", cycles.time, planned, "ink", dash=DOTTED))
    text = (
        f"Line chart of {axis} over time, planned {np.nanmin(planned):.0f} to"
        f" {np.nanmax(planned):.0f} mm."
    )
    return Chart(
        f"Position, {axis}",
        text,
        axis,
        "mm",
        tuple(lines),
        _whole(run),
        spans=_stops(run, named=i == 0),
        height=150,
    )


def _error(run: RunData) -> Chart:
    cycles, poses = run.cycles, run.poses
    lines = []
    for (name, alone), dash in zip(run.alone.items(), cycle(_DASHES), strict=False):
        if alone.ok.any():
            time, error = with_gaps(alone.time[alone.ok], alone.error[alone.ok] * 1e3)
            lines.append(ChartLine(f"{name} alone", time, error, "tag", 0.8, dash=dash))
    if poses.ok.any():
        label = "cameras together" if run.alone else "camera"
        time, error = with_gaps(poses.time[poses.ok], poses.error[poses.ok] * 1e3)
        lines.append(ChartLine(label, time, error, "tag", 1.2))
    lines.append(_drives(run, cycles.encoder_error))
    return Chart(
        "Distance from the planned position",
        _error_text(run),
        "error",
        "mm",
        tuple(lines),
        _whole(run),
        spans=_stops(run),
        from_zero=True,
    )


def _error_text(run: RunData) -> str:
    text = "Line chart of the distance from the planned position."
    encoder = run.summary["encoder_error_mm"]
    if encoder["max"] is not None:
        text += f" The drives' pose is at most {encoder['max']:.3f} mm from the plan."
    tag = run.summary["tag_error_mm"]
    if tag and tag["rms"] is not None:
        text += f" The camera's is {tag['rms']:.2f} mm RMS from the plan."
    return text


# Overview figure for scripts and notebooks, from the columns of the tables.


def run_figure(cycles: Mapping[str, NDArray[Any]], clearance: Mapping[str, NDArray[Any]]) -> Figure:
    """Following error, tensions and measured clearance over time.

    Args:
        cycles: The columns of ``cycles.csv``.
        clearance: The columns of ``clearance.csv``.
    """
    import matplotlib.pyplot as plt  # drawn with the user's settings, not those of a page

    figure, (error, tension, near) = plt.subplots(
        3, 1, sharex=True, figsize=(7.0, 6.0), layout="constrained"
    )
    time = cycles["time_s"]
    error.plot(time, cycles["following_error_mm"])
    error.set_ylabel("following error [mm]")
    for name in (name for name in cycles if re.fullmatch(r"tension_\d+_n", name)):
        tension.plot(time, cycles[name], label=name.split("_")[1], linewidth=1.0)
    tension.set_ylabel("tension [N]")
    tension.legend(title="cable", ncols=8, fontsize=7.0)
    for source, name in _NAMES.items():
        rows = clearance["source"] == source
        if np.any(rows):
            near.plot(clearance["time_s"][rows], clearance["distance_mm"][rows], label=name)
    if len(clearance["time_s"]):
        near.legend()
    near.set_ylabel("clearance [mm]")
    near.set_xlabel("time [s]")
    return figure
