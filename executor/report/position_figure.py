"""Position over time: planned, from the drives, from the camera (paper, Fig. 11c)."""

from __future__ import annotations

from itertools import cycle
from typing import TYPE_CHECKING

from executor.report.figure_style import (
    STAND_IN,
    as_svg,
    legend_above,
    new_figure,
    settings,
    thinned,
    with_gaps,
)
from executor.report.run_data import RunData
from executor.report.stop_marks import mark_stops

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Lines of single cameras, by which they are told apart.
_DASHES = ((4, 1.5), (1, 1), (6, 1.5, 1, 1.5))


def position_figure(run: RunData) -> str:
    """x, y and z over time, and the distances from the planned position below; an SVG element."""
    with settings():
        figure = new_figure(7.2)
        rows = figure.subplots(4, 1, sharex=True, height_ratios=[1, 1, 1, 1.15])
        for i, axes in enumerate(rows[:3]):
            _coordinate(axes, run, i)
        legend_above(rows[0])
        _error(rows[3], run)
        rows[3].set_xlim(0.0, float(run.cycles.time[-1]))
        for axes in rows:
            mark_stops(axes, run, named=axes is rows[0])
        figure.align_ylabels(rows)
        return as_svg(figure, "position", _alternative(run))


def _coordinate(axes: Axes, run: RunData, i: int) -> None:
    cycles, poses = run.cycles, run.poses
    # The camera's wide line lies under the thin ones, or it would hide them where all agree.
    if poses.ok.any():
        time, position = with_gaps(poses.time[poses.ok], poses.position[poses.ok, i] * 1e3)
        axes.plot(time, position, color=STAND_IN["tag"], alpha=0.45, linewidth=4.5, label="camera")
    encoder = thinned(cycles.time, cycles.encoder[:, i] * 1e3)
    axes.plot(*encoder, color=STAND_IN["encoder"], linewidth=1.6, label="drives")
    planned = thinned(cycles.time, cycles.planned[:, i] * 1e3)
    axes.plot(
        *planned, color=STAND_IN["ink"], linestyle=(0, (2, 3)), linewidth=1.1, label="planned"
    )
    axes.set_ylabel(f"{'xyz'[i]} [mm]")


def _error(axes: Axes, run: RunData) -> None:
    cycles, poses = run.cycles, run.poses
    for (name, alone), dashes in zip(run.alone.items(), cycle(_DASHES), strict=False):
        if alone.ok.any():
            time, error = with_gaps(alone.time[alone.ok], alone.error[alone.ok] * 1e3)
            axes.plot(
                time,
                error,
                color=STAND_IN["tag"],
                linestyle=(0, dashes),
                linewidth=0.8,
                label=f"{name} alone",
            )
    if poses.ok.any():
        label = "cameras together" if run.alone else "camera"
        time, error = with_gaps(poses.time[poses.ok], poses.error[poses.ok] * 1e3)
        axes.plot(time, error, color=STAND_IN["tag"], linewidth=1.0, label=label)
    time, error = thinned(cycles.time, cycles.encoder_error * 1e3)
    axes.plot(time, error, color=STAND_IN["encoder"], linewidth=1.2, label="drives")
    axes.set_title("Distance from the planned position")
    axes.set_ylabel("error [mm]")
    axes.set_xlabel("time [s]")
    axes.set_ylim(bottom=0.0)
    legend_above(axes)


def _alternative(run: RunData) -> str:
    text = "Line charts of x, y and z over time and of the distance from the planned position."
    encoder = run.summary["encoder_error_mm"]
    if encoder["max"] is not None:
        text += f" The drives place the platform at most {encoder['max']:.3f} mm from the plan."
    tag = run.summary["tag_error_mm"]
    if tag and tag["rms"] is not None:
        text += f" The camera places it {tag['rms']:.2f} mm RMS from the plan."
    return text
