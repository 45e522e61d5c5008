"""What the drives did: cable lengths, tensions, following error, lateness of the cycles."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cdpr.poses import Array
from executor.report.figure_style import (
    STAND_IN,
    as_svg,
    label_right,
    new_figure,
    settings,
    thinned,
)
from executor.report.run_data import RunData
from executor.report.stop_marks import mark_stops

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLUMNS = 4


def _colour(cable: int) -> str:
    return STAND_IN[f"series{cable % 8 + 1}"]


def length_figure(run: RunData) -> str:
    """Length of every cable over time; an SVG element."""
    cycles = run.cycles
    with settings():
        figure = new_figure(3.6)
        axes = figure.subplots()
        ends = []
        for i in range(cycles.cable_count):
            time, length = thinned(cycles.time, cycles.lengths[:, i] * 1e3)
            axes.plot(time, length, color=_colour(i))
            ends.append((f"cable {i + 1}", float(length[-1]), _colour(i)))
        axes.set_xlim(0.0, float(cycles.time[-1]))
        axes.set_ylabel("cable length [mm]")
        axes.set_xlabel("time [s]")
        label_right(axes, 3.0, ends)
        low, high = np.nanmin(cycles.lengths) * 1e3, np.nanmax(cycles.lengths) * 1e3
        text = f"Line chart of {cycles.cable_count} cable lengths, {low:.0f} to {high:.0f} mm."
        return as_svg(figure, "lengths", text)


def tension_figure(run: RunData) -> str:
    """Tension of every cable over time, planned and measured; an SVG element."""
    cycles = run.cycles
    rows = -(-cycles.cable_count // _COLUMNS)
    top = 1.12 * max(
        float(np.nanmax(cycles.planned_tensions)), _largest(cycles.tensions), run.rig.min_tension
    )
    with settings():
        figure = new_figure(1.75 * rows + 0.3)
        grid = figure.subplots(rows, _COLUMNS, sharex=True, sharey=True, squeeze=False)
        for i, axes in enumerate(grid.flat):
            if i < cycles.cable_count:
                _tension(axes, run, i)
            else:
                axes.set_visible(False)
        grid[0, 0].set_ylim(0.0, top)
        grid[0, 0].set_xlim(0.0, float(cycles.time[-1]))
        for axes in grid[:, 0]:
            axes.set_ylabel("tension [N]")
        for axes in grid[-1]:
            axes.set_xlabel("time [s]")
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper right", ncols=len(labels))
        return as_svg(figure, "tensions", _tension_text(run))


def _largest(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.max()) if known.size else 0.0


def _tension(axes: Axes, run: RunData, i: int) -> None:
    cycles = run.cycles
    measured = thinned(cycles.time, cycles.tensions[:, i], 300)
    axes.plot(
        *measured, color=STAND_IN["encoder"], alpha=0.55, linewidth=2.4, label="measured (torque)"
    )
    planned = thinned(cycles.time, cycles.planned_tensions[:, i], 300)
    axes.plot(
        *planned, color=STAND_IN["ink"], linewidth=0.9, linestyle=(0, (3, 2)), label="planned"
    )
    lower, upper = run.rig.min_tension, run.rig.max_tension
    axes.axhline(lower, color=STAND_IN["limit"], linestyle=(0, (1, 1.5)), label="limits")
    axes.axhline(upper, color=STAND_IN["limit"], linestyle=(0, (1, 1.5)))
    axes.set_title(f"cable {i + 1}")
    mark_stops(axes, run)


def _tension_text(run: RunData) -> str:
    key = run.summary["tension_n"]
    text = f"Line charts of the tensions of {run.cycles.cable_count} cables."
    if key["min"] is not None:
        text += f" Measured {key['min']:.1f} to {key['max']:.1f} N,"
    return f"{text} allowed {key['lower_limit']:g} to {key['upper_limit']:g} N."


def timing_figure(run: RunData) -> str:
    """Following error over time and, for a run in real time, how late cycles were; SVG."""
    with settings():
        figure = new_figure(2.8)
        if run.fast or not np.isfinite(run.cycles.lateness).any():
            _following(figure.subplots(), run)
        else:
            left, right = figure.subplots(1, 2)
            _following(left, run)
            _lateness(right, run.cycles.lateness * 1e3)
        return as_svg(figure, "timing", _timing_text(run))


def _following(axes: Axes, run: RunData) -> None:
    time, error = thinned(run.cycles.time, run.cycles.following_error * 1e3)
    axes.plot(time, error, color=STAND_IN["encoder"], linewidth=1.0)
    limit = run.rig.motion.following_error * 1e3
    axes.set_title(f"Following error, the worst cable (limit {limit:g} mm)")
    axes.set_ylabel("following error [mm]")
    axes.set_xlabel("time [s]")
    axes.set_xlim(0.0, float(run.cycles.time[-1]))
    axes.set_ylim(bottom=0.0)


def _lateness(axes: Axes, lateness: Array) -> None:
    known = lateness[np.isfinite(lateness)]
    axes.hist(known, bins=60, color=STAND_IN["encoder"], log=True)
    high = float(np.percentile(known, 99.0))
    axes.axvline(high, color=STAND_IN["limit"], linestyle=(0, (4, 2)))
    axes.annotate(
        f"99 % within {high:.2f} ms",
        (high, 1.0),
        (5, -3),
        xycoords=("data", "axes fraction"),
        textcoords="offset points",
        va="top",
    )
    axes.set_title("Lateness of the cycles")
    axes.set_ylabel("cycles")
    axes.set_xlabel("lateness [ms]")


def _timing_text(run: RunData) -> str:
    error = run.summary["following_error_mm"]
    text = "Line chart of the largest following error."
    if error["max"] is not None:
        text += f" At most {error['max']:.3f} mm; the limit is {error['limit']:g} mm."
    late = run.summary["lateness_ms"]
    if late is not None and late["max"] is not None:
        text += f" Histogram of lateness: 99 % within {late['p99']:.2f} ms,"
        text += f" at most {late['max']:.2f} ms."
    return text
