"""The page of a campaign: each claim of the paper beside what was found."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

from planner.campaign.boxes import OWN, SHARES, WIDE
from planner.campaign.claims import PLACES, findings
from planner.campaign.results import COUNTED, MEASURED, Results
from planner.campaign.statistics import Change, summary
from planner.campaign.studies import (
    BOXES,
    COMPARISONS,
    COSTS,
    FIGURE_9,
    NEAREST_TO_THE_CLAIM,
    READINGS,
    SAMPLERS,
    VARIANTS,
    all_readings,
    arms_of,
    figure_9_arm,
)
from planner.campaign.trial import Case

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
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 80rem; margin: 2rem auto; padding: 0 1rem;
  color: #20242b; background: #fff; }
table { border-collapse: collapse; margin: 1rem 0; font-size: 13px; }
th, td { padding: .25rem .7rem; border-bottom: 1px solid #dde1e7; text-align: left; }
td + td { font-variant-numeric: tabular-nums; }
p { max-width: 62rem; }
img { max-width: 100%; }
th { vertical-align: bottom; }
.wide { overflow-x: auto; }
.figures { font-size: 12px; }
.figures th, .figures td { padding: .2rem .5rem; }
.figures td { white-space: nowrap; }
"""


def page(results: Results, about: dict[str, Any]) -> str:
    """The whole page, HTML, with its pictures beside it as SVG."""
    parts = [
        "<h1>The paper's evaluation, repeated</h1>",
        _paragraph(
            f"{about['seeds']} seeds in each of {len(results.environments)} environments. Changes"
            " are of the mean over the seeds, averaged over the environments; in brackets the 95 %"
            f" bootstrap interval. The own box is {about['boxes'][OWN]}, the wide one"
            f" {about['boxes'][WIDE]}. Random ends are as far apart as the scene's, with an"
            " obstacle across the straight line."
        ),
        "<h2>Claims</h2>",
        _claims(results),
        _paragraph(
            f"Reading: {_reading()}. Both planners take the same steps; the baseline rejects"
            " nothing here, and below is shown how it does with the same rejection."
        ),
        "<h2>Fig. 9</h2>",
        _image("figure_9", "Nodes and kinematic cost by environment"),
        *(_figure_9_table(results, ends) for ends in ("scene", "random")),
        _image("figure_9_random_ends", "The same with random starts and goals"),
        "<h2>What makes the difference</h2>",
        _comparisons(results),
        "<h2>Every reading of the text</h2>",
        _image("readings", "Change of nodes and of their deviation for every reading"),
        _readings(results),
        "<h2>The box</h2>",
        _image("boxes", "Change of nodes against the size of the box"),
        _boxes(results),
        "<h2>About this run</h2>",
        _table(["", ""], [(k, str(v)) for k, v in about.items() if k != "boxes"]),
    ]
    title = "<title>The paper's evaluation, repeated</title>"
    head = f'<meta charset="utf-8">{title}<style>{_STYLE}</style>'
    body = "\n".join(parts)
    return f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>\n{body}\n</body></html>\n'


def _claims(results: Results) -> str:
    found = findings(results)
    rows = []
    for claim in dict.fromkeys(finding.claim for finding in found):
        row = [claim]
        for place in PLACES:
            here = next(f for f in found if f.claim == claim and (f.box, f.ends) == place)
            row.append(f"{change_text(here.change)}\n{here.verdict}")
        rows.append(row)
    return _table(["claim", *(f"{box} box, {ends} ends" for box, ends in PLACES)], rows)


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
                    row.append(f"{s.mean:.4g} ± {s.deviation:.3g}\n({s.low:.4g} to {s.high:.4g})")
                rows.append(row)
    head = ["environment", "sampler", "minimises"]
    title = f"Own box, {ends} ends: mean ± standard deviation (interval of the mean)"
    quantities = [_QUANTITIES[q] for q in (*COUNTED, *MEASURED)]
    return f"<h3>{title}</h3>" + _table([*head, *quantities], rows, "figures")


def _comparisons(results: Results) -> str:
    rows = []
    for comparison in COMPARISONS:
        row = [comparison.name]
        for box, ends in PLACES:
            arms = arms_of(comparison)
            mean, deviation = results.change(VARIANTS, box, ends, arms, "nodes")
            row.append(f"{change_text(mean)}\ndeviation {percent(deviation.mean)}")
        rows.append(row)
    return _table(["nodes", *(f"{box} box, {ends} ends" for box, ends in PLACES)], rows)


def _readings(results: Results) -> str:
    found = [(c, arms_of(c)) for c in all_readings()]
    changes = [
        (c.name, [results.change(READINGS, box, "scene", arms, "nodes") for box in (OWN, WIDE)])
        for c, arms in found
    ]
    changes.sort(key=lambda entry: entry[1][0][0].mean)
    rows = [
        [name, *(f"{change_text(m)}\ndeviation {percent(d.mean)}" for m, d in by_box)]
        for name, by_box in changes
    ]
    return _table(["reading", "own box, scene ends", "wide box, scene ends"], rows)


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
    return _table(["box", *(c.name for c in chosen)], rows)


def _reading() -> str:
    r = NEAREST_TO_THE_CLAIM.adaptive
    return (
        f"e_r = {r.failure_rate} with k failed expansions since the last success, x_c the"
        f" {r.focus} node, r and θ₁ uniform in their ranges, steps no longer than to the sample,"
        f" new nodes within {r.spacing * 1e3:g} mm of another rejected and counted as failures"
    )


def percent(part: float) -> str:
    """A change, such as -20.5 %, with a true minus sign."""
    return f"{part * 100.0:+.1f} %".replace("-", "\N{MINUS SIGN}")


def change_text(change: Change) -> str:
    """A change with its interval."""
    return f"{percent(change.mean)} ({percent(change.low)} to {percent(change.high)})"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> str:
    first = "".join(f"<th>{escape(name)}</th>" for name in head)
    body = "".join("<tr>" + "".join(map(_cell, row)) + "</tr>\n" for row in rows)
    table = f'<table class="{kind}"><tr>{first}</tr>\n{body}</table>'
    return f'<div class="wide">{table}</div>'


def _cell(text: str) -> str:
    return "<td>" + escape(text).replace("\n", "<br>") + "</td>"


def _paragraph(text: str) -> str:
    return f"<p>{escape(text)}</p>"


def _image(name: str, alternative: str) -> str:
    return f'<p><img src="{name}.svg" alt="{escape(alternative)}"></p>'
