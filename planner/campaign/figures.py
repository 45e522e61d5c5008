"""Images of a campaign: Fig. 9, and what the claim owes to the reading and to the box."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from model.pose import Array
from planner.campaign.cases import OWN, SHARES, WIDE
from planner.campaign.claims import NODES
from planner.campaign.results import Results, summary
from planner.campaign.studies import (
    BOXES,
    COMPARISONS,
    COSTS,
    FIGURE_9,
    READINGS,
    SAMPLERS,
    all_readings,
    arms_of,
    figure_9_arm,
)
from planner.campaign.trial import Arm, Case

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FIRST, SECOND, THIRD, CLAIM, MUTED = "#2f7fb5", "#c98500", "#3f9b6b", "#c0392b", "#5c6675"
_COLOURS = {"adaptive": FIRST, "goal-bias": SECOND, "kinematic": THIRD, "length": MUTED}
_SHOWN = ((-45.0, 75.0), (-80.0, 100.0))
"""Changes that the image of the readings shows in place, [%]; beyond, at its edge."""
_SETTINGS: dict[Any, Any] = {  # matplotlib types the keys as a union of every setting's name
    "svg.fonttype": "none",
    "svg.hashsalt": "cdpr",
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": MUTED,
    "legend.frameon": False,
    "savefig.dpi": 150,
}
_NODES_LABEL = "nodes of the tree"
_COST_LABEL = "mean kinematic cost along the path"


def save_figures(results: Results, folder: Path) -> tuple[str, ...]:
    """Writes every image as SVG and PNG; the names without their ends."""
    import matplotlib as mpl

    drawn = {
        "figure_9": figure_9,
        "figure_9_random_ends": lambda r: figure_9(r, "random"),
        "readings": readings_figure,
        "boxes": boxes_figure,
    }
    with mpl.rc_context(_SETTINGS):
        for name, draw in drawn.items():
            figure = draw(results)
            figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
            figure.savefig(folder / f"{name}.png")
    return tuple(drawn)


def figure_9(results: Results, ends: Any = "scene") -> Figure:
    """The paper's Fig. 9: nodes by sampler, kinematic cost by what the search minimises."""
    figure, (left, right) = _new(7.4, 3.0, 2)
    nodes = {s: figure_9_arm(s, "length") for s in SAMPLERS}
    _bars(left, results, ends, nodes, "nodes")
    left.set(title="a  Nodes", ylabel=_NODES_LABEL)
    costs = {c: figure_9_arm("adaptive", c) for c in COSTS}
    _bars(right, results, ends, costs, "cost")
    right.set(title="b  Kinematic cost", ylabel=_COST_LABEL)
    return figure


def readings_figure(results: Results) -> Figure:
    """Every reading as a dot: change of nodes and of their deviation, in both boxes.

    Readings beyond the image are triangles at its edge.
    """
    figure, all_axes = _new(7.4, 3.2, 2)
    for axes, box in zip(all_axes, (OWN, WIDE), strict=True):
        for spacing, colour, name in ((0.0, FIRST, "none"), (0.03, SECOND, "within 30 mm")):
            chosen = [c for c in all_readings() if c.adaptive.spacing == spacing]
            changes = [results.change(READINGS, box, "scene", arms_of(c), "nodes") for c in chosen]
            points = np.array([[mean.mean, deviation.mean] for mean, deviation in changes]) * 100
            _dots(axes, points, colour, f"rejects {name}")
        axes.axvline(NODES * 100, color=CLAIM, lw=1)
        axes.axvline(0.0, color=MUTED, lw=0.6)
        axes.axhline(0.0, color=MUTED, lw=0.6)
        axes.set(title=f"{box} box", xlabel="change of the mean number of nodes [%]")
    all_axes[0].set_ylabel("change of the deviation [%]")
    all_axes[0].legend(loc="lower right")
    all_axes[1].text(
        NODES * 100,
        1.0,
        " claimed",
        transform=all_axes[1].get_xaxis_transform(),
        color=CLAIM,
        va="top",
    )
    return figure


def boxes_figure(results: Results) -> Figure:
    """How the change of the nodes goes with the size of the workspace box."""
    figure, (axes,) = _new(5.2, 3.0, 1)
    places = np.array(list(SHARES.values())) * 100.0
    for comparison, colour in zip(COMPARISONS[1:4], (FIRST, SECOND, THIRD), strict=True):
        arms = arms_of(comparison)
        changes = [results.change(BOXES, box, "scene", arms, "nodes")[0] for box in SHARES]
        middle, low, high = np.array([[c.mean, c.low, c.high] for c in changes]).T * 100.0
        axes.plot(places, middle, "o-", color=colour, ms=4, label=comparison.name)
        axes.fill_between(places, low, high, color=colour, alpha=0.15, lw=0)
    axes.axhline(NODES * 100, color=CLAIM, lw=1)
    axes.text(0.0, NODES * 100, "claimed", color=CLAIM, ha="left", va="top")
    axes.axhline(0.0, color=MUTED, lw=0.6)
    axes.set(
        xlabel="growth of the box, own (0) to wide (100) [%]",
        ylabel="change of the mean number of nodes [%]",
    )
    figure.legend(loc="outside upper left", fontsize=8)
    return figure


def _bars(axes: Axes, results: Results, ends: Any, arms: dict[Any, Arm], quantity: str) -> None:
    environments = results.environments
    width = 0.8 / len(arms)
    for k, (name, arm) in enumerate(arms.items()):
        cases = [Case(OWN, environment, ends) for environment in environments]
        found = [summary(results.values(FIGURE_9, case, arm, quantity)) for case in cases]
        at = np.arange(len(environments)) + (k - (len(arms) - 1) / 2.0) * width
        axes.bar(
            at,
            [s.mean for s in found],
            width * 0.92,
            yerr=[s.deviation for s in found],
            color=_COLOURS[name],
            error_kw={"lw": 1, "capsize": 3, "ecolor": MUTED},
            label=name,
        )
    axes.set_xticks(np.arange(len(environments)), [e.replace("_", " ") for e in environments])
    axes.set_ylim(0.0, 1.15 * axes.get_ylim()[1])
    axes.legend(loc="upper right", ncols=len(arms), fontsize=8)


def _dots(axes: Axes, points: Array, colour: str, name: str) -> None:
    """Points in the image as dots, those beyond it as triangles at its edge."""
    low, high = np.array(_SHOWN).T
    beyond = np.any((points < low) | (points > high), axis=1)
    shown = np.clip(points, low, high)
    style: Any = {"ms": 4, "alpha": 0.7, "color": colour, "clip_on": False}
    axes.plot(*shown[~beyond].T, "o", **style, label=name)
    axes.plot(*shown[beyond].T, ">", **style)
    axes.set(xlim=_SHOWN[0], ylim=_SHOWN[1])


def _new(width: float, height: float, columns: int) -> tuple[Figure, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(1, columns, squeeze=False)[0]
