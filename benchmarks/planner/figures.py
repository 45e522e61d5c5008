"""Plots of the benchmarks in this folder."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS = {
    "optimal": "#000000",
    "RRTConnect": "#999999",
    "RRTConnect*": "#c98500",
    "RRTstar": "#d55e00",
    "InformedRRTstar": "#009e73",
    "BITstar": "#b85f96",
    "AORRTC": "#0072b2",
}


def curves_figure(rows: Sequence[dict[str, Any]], marks_ms: Sequence[float]) -> Figure:
    """Excess length over time, and time to the first path, per environment."""
    from matplotlib.figure import Figure

    environments = sorted({row["environment"] for row in rows})
    figure = Figure(figsize=(4.4 * len(environments), 7.4), layout="constrained")
    cells = figure.subplots(2, len(environments), squeeze=False)
    for column, environment in enumerate(environments):
        here = [row for row in rows if row["environment"] == environment]
        _curves(cells[0, column], here, marks_ms, environment)
        _firsts(cells[1, column], here)
    cells[0, 0].set_ylabel("median length over the best known [%]")
    handles, labels = cells[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    return figure


def _curves(axes: Any, rows: Sequence[dict[str, Any]], marks_ms: Sequence[float], n: int) -> None:
    for row in rows:
        values = [row[f"excess_percent_{mark:g}_ms"] for mark in marks_ms]
        shown = [np.nan if value is None else max(value, 1e-2) for value in values]
        exact = row["checker"] == "exact"
        name = row["planner"] if exact else f"{row['planner']}, python-fcl"
        axes.plot(
            marks_ms, shown, "o-" if exact else "s--", color=_COLOURS[row["planner"]],
            label=name, markersize=4, linewidth=2.4 if row["planner"] == "optimal" else 1.2,
        )  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_title(f"environment {n}", loc="left", weight="bold")
    axes.set_xlabel("processor time [ms]")
    axes.grid(alpha=0.25)


def _firsts(axes: Any, rows: Sequence[dict[str, Any]]) -> None:
    names, values, colours = [], [], []
    for row in reversed(rows):
        if row["first_median_ms"] is not None:
            mark = "" if row["checker"] == "exact" else ", python-fcl"
            names.append(row["planner"] + mark)
            values.append(row["first_median_ms"])
            colours.append(_COLOURS[row["planner"]])
    bars = axes.barh(names, values, color=colours, left=0.0)
    axes.bar_label(bars, [f"{value:.3g}" for value in values], padding=3, fontsize=7)
    axes.set_xscale("log")
    axes.set_xlim(min(values) / 3.0, max(values) * 6.0)
    axes.set_xlabel("first path, median [ms]")
    axes.tick_params(axis="y", labelsize=7)


def growth_figure(panels: Sequence[tuple[str, str, dict[str, list[tuple[int, float]]]]]) -> Figure:
    """Time over size; the dotted line through the first point of each curve is linear growth.

    Args:
        panels: Title, name of the size, and curves of (size, microseconds) by name.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2 * len(panels), 4.4), layout="constrained")
    for axes, (title, size, curves) in zip(
        np.ravel(figure.subplots(1, len(panels), squeeze=False)), panels, strict=True
    ):
        for number, (name, points) in enumerate(curves.items()):
            x, y = (np.array(values) for values in zip(*points, strict=True))
            colour = f"C{number}"
            axes.plot(x, y, "o-", color=colour, label=name, markersize=4)
            axes.plot(x, y[0] * x / x[0], ":", color=colour, linewidth=1.0)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_title(title, loc="left", weight="bold")
        axes.set_xlabel(size)
        axes.set_ylabel("processor time [µs]")
        axes.grid(alpha=0.25, which="both")
        axes.legend(frameon=False, fontsize=8)
    return figure


def pareto_figure(points: Sequence[dict[str, Any]], claim: float) -> Figure:
    """Change of average kinematic cost over change of length, one panel per environment."""
    from matplotlib.figure import Figure

    environments = sorted({point["environment"] for point in points})
    boxes = list(dict.fromkeys(point["box"] for point in points))
    figure = Figure(figsize=(4.4 * len(environments), 4.2), layout="constrained")
    panels = figure.subplots(1, len(environments), squeeze=False, sharey=True)[0]
    for axes, environment in zip(panels, environments, strict=True):
        for number, box in enumerate(boxes):
            mine = [p for p in points if (p["environment"], p["box"]) == (environment, box)]
            front = sorted((p for p in mine if p["made_by"] == "reference"),
                           key=lambda p: p["length_mm"])  # fmt: skip
            own = [p for p in mine if p["made_by"] != "reference"]
            colour, label = f"C{number}", f"{box} box"
            _percent(axes, front, "o-", color=colour, label=f"{label}: best known")
            _percent(axes, own, "*", color=colour, markersize=13, label=f"{label}: cdpr plan")
        axes.axhline(-claim, color="0.4", linestyle="--", linewidth=1.0, label="the paper's claim")
        axes.set_title(f"environment {environment}", loc="left", weight="bold")
        axes.set_xlabel("longer than the shortest path [%]")
        axes.grid(alpha=0.25)
    panels[0].set_ylabel("average kinematic cost [%]")
    panels[0].legend(frameon=False, fontsize=8)
    return figure


def _percent(axes: Any, points: Sequence[dict[str, Any]], style: str, **options: Any) -> None:
    across, up = ([p[key] for p in points] for key in ("longer_percent", "average_percent"))
    axes.plot(across, up, style, **({"markersize": 4} | options))
