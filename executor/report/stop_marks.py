"""Where a run stood at its stops, marked in figures over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

from executor.report.figure_style import STAND_IN
from executor.report.run_data import RunData

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def mark_stops(axes: Axes, run: RunData, *, named: bool = False) -> None:
    """Shades the times at stops; a stop that is only passed becomes a line.

    Args:
        axes: Over run time, with final limits.
        run: The run.
        named: Whether the stops' names are written at the upper edge.
    """
    for stop in run.summary["stops"]:
        begin, end = stop["reached_s"], stop["left_s"]
        if begin is None:
            continue
        end = float(run.cycles.time[-1]) if end is None else end
        axes.axvspan(begin, end, color=STAND_IN["muted"], alpha=0.18, zorder=0.5)
        if named:
            axes.annotate(
                stop["name"],
                ((begin + end) / 2.0, 0.97),
                xycoords=("data", "axes fraction"),
                rotation=90,
                ha="center",
                va="top",
                fontsize=7.5,
                color=STAND_IN["muted"],
            )
