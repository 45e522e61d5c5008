"""The page of a campaign: each claim of the paper beside its finding."""

from __future__ import annotations

from functools import partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from model.pages.page import list_table, picture, section, table
from model.pages.page import page as html_page
from model.pose import Array
from planner.campaign.studies import (
    ADAPTIVE_REJECTS,
    BOXES,
    COMPARISONS,
    CONDITIONS,
    COSTS,
    COUNTED,
    FIGURE_9,
    MEASURED,
    NODES,
    READINGS,
    SAMPLERS,
    VARIANTS,
    Change,
    Results,
    all_readings,
    arms_of,
    figure_9_arm,
    findings,
    summary,
)
from planner.campaign.trial import OWN, SHARES, WIDE, Arm, Case
from planner.workspace.figures import write_figures

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_QUANTITIES = {
    "nodes": "nodes",
    "searches": "searches",
    "edge_checks": "edge checks",
    "time_ms": "CPU time [ms]",
    "raw_length_mm": "length of the tree's path [mm]",
    "length_mm": "length [mm]",
    "raw_cost": "kinematic cost of the tree's path",
    "cost": "kinematic cost",
    "clearance_mm": "true smallest clearance [mm]",
}


def page(results: Results, about: dict[str, Any]) -> str:
    """The whole page, HTML, with its images beside it as SVG."""
    lead = _paragraph(
        f"{about['seeds']} seeds in each of {len(results.environments)} environments. Changes"
        " are of the mean over the seeds, averaged over the environments; in brackets the 95 %"
        f" bootstrap interval. The own box is {about['boxes'][OWN]}, the wide one"
        f" {about['boxes'][WIDE]}. Random ends are as far apart as the scene's, with an"
        " obstacle across the straight line."
    )
    reading = _paragraph(
        f"Reading: {_reading()}. Both planners take the same steps; the baseline rejects"
        " nothing here; results with the same rejection are below."
    )
    figure_9 = (
        picture("figure_9.svg", "Nodes and kinematic cost by environment"),
        *(_figure_9_table(results, ends) for ends in ("scene", "random")),
        picture("figure_9_random_ends.svg", "The same with random starts and goals"),
    )
    readings = picture("readings.svg", "Change of nodes and of their deviation for every reading")
    boxes = picture("boxes.svg", "Change of nodes against the size of the box")
    rows = [(k, str(v)) for k, v in about.items() if k != "boxes"]
    parts = [
        section("claims", "Claims", _claims(results), reading),
        section("figure-9", "Fig. 9", *figure_9),
        section("difference", "What makes the difference", _comparisons(results)),
        section("readings", "Every reading of sampling and steps", readings, _readings(results)),
        section("boxes", "The box", boxes, _boxes(results)),
        section("about", "About this run", table(rows)),
    ]
    title = "The paper's evaluation, repeated"
    return html_page(title, "\n".join(parts), lead=lead, files_beside=True)


def _claims(results: Results) -> str:
    found = findings(results)
    rows = []
    for claim in dict.fromkeys(finding.claim for finding in found):
        row = [claim]
        for condition in CONDITIONS:
            here = next(f for f in found if f.claim == claim and (f.box, f.ends) == condition)
            row.append(f"{change_text(here.change)}\n{here.verdict}")
        rows.append(row)
    return list_table(
        ["claim", *(f"{box} box, {ends} ends" for box, ends in CONDITIONS)], rows, "wide"
    )


def _figure_9_table(results: Results, ends: Any) -> str:
    rows = []
    for environment in results.environments:
        case = Case(OWN, environment, ends)
        for sampler in SAMPLERS:
            for cost in COSTS:
                arm = figure_9_arm(sampler, cost)
                row = [environment, sampler, cost]
                for quantity in (*COUNTED, *MEASURED):
                    s = summary(results.values(FIGURE_9, case, arm, quantity))
                    interval = f"({s.low:.4g} to {s.high:.4g})"
                    figures = f"{s.mean:.4g} ± {s.deviation:.3g}\n{interval}"
                    row.append(figures if s.count else "no path")
                rows.append(row)
    head = ["environment", "sampler", "minimises"]
    title = f"Own box, {ends} ends: mean ± standard deviation (interval of the mean)"
    quantities = [_QUANTITIES[q] for q in (*COUNTED, *MEASURED)]
    return f"<h3>{title}</h3>" + list_table([*head, *quantities], rows, "numbers")


def _comparisons(results: Results) -> str:
    rows = []
    for comparison in COMPARISONS:
        row = [comparison.name]
        for box, ends in CONDITIONS:
            arms = arms_of(comparison)
            mean, deviation = results.change(VARIANTS, box, ends, arms, "nodes")
            row.append(f"{change_text(mean)}\ndeviation {percent(deviation.mean)}")
        rows.append(row)
    return list_table(
        ["nodes", *(f"{box} box, {ends} ends" for box, ends in CONDITIONS)], rows, "wide"
    )


def _readings(results: Results) -> str:
    found = [(c, arms_of(c)) for c in all_readings()]
    changes = [
        (c.name, [results.change(READINGS, box, "scene", arms, "nodes") for box in (OWN, WIDE)])
        for c, arms in found
    ]
    changes.sort(key=lambda entry: np.nan_to_num(entry[1][0][0].mean, nan=np.inf))
    rows = [
        [name, *(f"{change_text(m)}\ndeviation {percent(d.mean)}" for m, d in by_box)]
        for name, by_box in changes
    ]
    return list_table(["reading", "own box, scene ends", "wide box, scene ends"], rows, "wide")


def _boxes(results: Results) -> str:
    chosen = COMPARISONS[1:4]
    rows = []
    for box in SHARES:
        row = [box]
        for comparison in chosen:
            mean, _ = results.change(BOXES, box, "scene", arms_of(comparison), "nodes")
            each = ", ".join(percent(part) for part in mean.each)
            row.append(f"{change_text(mean)}\nby environment {each}")
        rows.append(row)
    return list_table(["box", *(c.name for c in chosen)], rows, "wide")


def _reading() -> str:
    r = ADAPTIVE_REJECTS.adaptive
    return (
        f"e_r = {r.failure_rate} with k failed expansions since the last success, x_c the"
        f" {r.focus} node, r and θ₁ uniform in their ranges, steps no longer than to the sample,"
        f" new nodes within {r.spacing * 1e3:g} mm of another rejected and counted as failures"
    )


def percent(part: float) -> str:
    """A change, such as -20.5 %, with a true minus sign; "unknown" for NaN."""
    if np.isnan(part):
        return "unknown"
    return f"{part * 100.0:+.1f} %".replace("-", "\N{MINUS SIGN}")


def change_text(change: Change) -> str:
    """A change with its interval, and the number of environments if it is not of all."""
    known, total = int(np.sum(~np.isnan(change.each))), len(change.each)
    if not known:
        return percent(change.mean)
    text = f"{percent(change.mean)} ({percent(change.low)} to {percent(change.high)})"
    return text if known == total else f"{text}, in {known} of {total} environments"


def _paragraph(text: str) -> str:
    return f"<p>{escape(text)}</p>"


# Images of a campaign: Fig. 9, and how the claim depends on the reading and on the box.


FIRST, SECOND, THIRD, CLAIM, MUTED = "#2f7fb5", "#c98500", "#3f9b6b", "#c0392b", "#5c6675"
_COLOURS = {"adaptive": FIRST, "goal-bias": SECOND, "kinematic": THIRD, "length": MUTED}
_SHOWN = ((-45.0, 75.0), (-80.0, 100.0))
"""Range of the image of the readings, [%]; changes beyond it are drawn at its edge."""
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
    """Writes every image as SVG and PNG; returns the names without suffix."""
    drawn = {
        "figure_9": partial(figure_9, results),
        "figure_9_random_ends": partial(figure_9, results, "random"),
        "readings": partial(readings_figure, results),
        "boxes": partial(boxes_figure, results),
    }
    write_figures(folder, drawn, _SETTINGS)
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
    """Change of the number of nodes against the size of the workspace box."""
    figure, (axes,) = _new(5.2, 3.0, 1)
    growth = np.array(list(SHARES.values())) * 100.0
    for comparison, colour in zip(COMPARISONS[1:4], (FIRST, SECOND, THIRD), strict=True):
        arms = arms_of(comparison)
        changes = [results.change(BOXES, box, "scene", arms, "nodes")[0] for box in SHARES]
        middle, low, high = np.array([[c.mean, c.low, c.high] for c in changes]).T * 100.0
        axes.plot(growth, middle, "o-", color=colour, ms=4, label=comparison.name)
        axes.fill_between(growth, low, high, color=colour, alpha=0.15, lw=0)
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
    """Points within the image as dots, those beyond it as triangles at its edge."""
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
