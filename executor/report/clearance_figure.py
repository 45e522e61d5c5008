"""Clearance over time, planned and measured (paper, Fig. 11a and b)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cdpr.poses import Array
from executor.clearance_table import ClearanceTable
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

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_OBSTACLES = 6
_COLUMNS = 3
_NAMES = {"tag": "measured (camera)", "encoder": "from the drives"}


def clearance_figure(run: RunData) -> str:
    """The smallest clearance over time and, below, that to each obstacle; an SVG element."""
    shown = nearest_obstacles(run.clearance, MOST_OBSTACLES)
    rows = 0 if len(shown) < 2 else -(-len(shown) // _COLUMNS)
    with settings():
        heights = [3.2, 1.6] + [1.9] * rows
        figure = new_figure(sum(heights))
        grid = figure.add_gridspec(2 + rows, _COLUMNS, height_ratios=heights)
        main = figure.add_subplot(grid[0, :])
        _smallest(main, run)
        _difference(figure.add_subplot(grid[1, :], sharex=main), run)
        for place, index in enumerate(shown if rows else []):
            cell = grid[2 + place // _COLUMNS, place % _COLUMNS]
            _obstacle(figure.add_subplot(cell, sharex=main), run, index)
        return as_svg(figure, "clearance", _alternative(run))


def nearest_obstacles(clearance: ClearanceTable, most: int) -> list[int]:
    """Up to ``most`` obstacles that came nearest, in the order of the scene."""
    if not len(clearance) or not clearance.obstacles:
        return []
    least = np.nanmin(clearance.planned_distances, axis=0)
    return sorted(np.argsort(least)[:most].tolist())


def _sources(clearance: ClearanceTable) -> list[ClearanceTable]:
    return [rows for rows in map(clearance.of, ("tag", "encoder")) if len(rows)]


def _smallest(axes: Axes, run: RunData) -> None:
    for rows in _sources(run.clearance):
        source = rows.source[0]
        time, distance, low, high = with_gaps(rows.time, *_band(rows))
        colour = STAND_IN[source]
        axes.fill_between(time, low, high, color=colour, alpha=0.22, linewidth=0)
        axes.plot(time, distance, color=colour, label=_NAMES[source], linewidth=1.3)
    reference = _sources(run.clearance)[0]
    _planned(axes, reference.time, reference.planned_distance * 1e3)
    _required(axes, run.plan.scene.obstacle_clearance * 1e3)
    axes.set_ylabel("smallest clearance [mm]")
    axes.tick_params(labelbottom=False)
    axes.set_title("Cables and platform to the nearest obstacle")
    axes.set_xlim(0.0, float(run.cycles.time[-1]))
    _from_zero(axes)
    legend_above(axes)


def _band(rows: ClearanceTable) -> tuple[Array, Array, Array]:
    """The smallest distance, and between what the true one lies, [mm]."""
    low = rows.distance - rows.uncertainty
    return rows.distance * 1e3, low * 1e3, rows.at_most * 1e3


def _difference(axes: Axes, run: RunData) -> None:
    """The best measurement less the plan; zero outside the band would be a contradiction."""
    rows = _sources(run.clearance)[0]
    planned = rows.planned_distance * 1e3
    time, off, low, high = with_gaps(rows.time, *(values - planned for values in _band(rows)))
    colour = STAND_IN[rows.source[0]]
    axes.fill_between(time, low, high, color=colour, alpha=0.22, linewidth=0)
    axes.plot(time, off, color=colour, linewidth=1.0)
    axes.axhline(0.0, color=STAND_IN["planned"], linestyle=(0, (4, 2)), linewidth=1.2)
    axes.set_title(f"{_NAMES[rows.source[0]]} less planned, with its uncertainty".capitalize())
    axes.set_ylabel("difference [mm]")
    axes.set_xlabel("time [s]")


def _obstacle(axes: Axes, run: RunData, index: int) -> None:
    for rows in _sources(run.clearance):
        time, distance = with_gaps(rows.time, rows.distances[:, index] * 1e3)
        by_camera = rows.source[0] == "tag"
        axes.plot(
            time,
            distance,
            color=STAND_IN[rows.source[0]],
            linewidth=3.4 if by_camera else 1.3,
            alpha=0.5 if by_camera else 1.0,
        )
    reference = _sources(run.clearance)[0]
    _planned(axes, reference.time, reference.planned_distances[:, index] * 1e3)
    _required(axes, run.plan.scene.obstacle_clearance * 1e3)
    axes.set_title(run.clearance.obstacles[index])
    axes.set_ylabel("clearance [mm]")
    axes.set_xlabel("time [s]")
    _from_zero(axes)


def _planned(axes: Axes, time: Array, values: Array) -> None:
    x, y = thinned(time, values)
    axes.plot(
        x, y, color=STAND_IN["planned"], linestyle=(0, (4, 2)), label="planned", linewidth=1.3
    )


def _required(axes: Axes, value: float) -> None:
    label = f"required ({value:g} mm)"
    axes.axhline(value, color=STAND_IN["limit"], linestyle=(0, (1, 1.5)), label=label)


def _from_zero(axes: Axes) -> None:
    low, high = axes.get_ylim()
    axes.set_ylim(min(0.0, low), high)


def _alternative(run: RunData) -> str:
    key = run.summary["clearance_mm"]
    if key is None:
        return "No clearance was measured."
    return (
        f"Line chart of the smallest clearance over time. Planned at least {key['planned_min']:.1f}"
        f" mm, measured at least {key['measured_min']:.1f} mm with an uncertainty of"
        f" {key['measured_uncertainty']:.1f} mm below it and surely at most"
        f" {key['measured_at_most']:.1f} mm, between {key['pair'][0]} and {key['pair'][1]};"
        f" required {key['required']:g} mm."
    )
