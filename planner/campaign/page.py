"""The page of a campaign: each claim of the paper beside what was found."""

from __future__ import annotations

from html import escape
from typing import Any

from model.pages.page import list_table, picture, section, table
from model.pages.page import page as html_page
from planner.campaign.cases import OWN, SHARES, WIDE
from planner.campaign.claims import PLACES, findings
from planner.campaign.results import COUNTED, MEASURED, Change, Results, summary
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
        section("readings", "Every reading of the text", readings, _readings(results)),
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
        for place in PLACES:
            here = next(f for f in found if f.claim == claim and (f.box, f.ends) == place)
            row.append(f"{change_text(here.change)}\n{here.verdict}")
        rows.append(row)
    return list_table(["claim", *(f"{box} box, {ends} ends" for box, ends in PLACES)], rows, "wide")


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
    return f"<h3>{title}</h3>" + list_table([*head, *quantities], rows, "numbers")


def _comparisons(results: Results) -> str:
    rows = []
    for comparison in COMPARISONS:
        row = [comparison.name]
        for box, ends in PLACES:
            arms = arms_of(comparison)
            mean, deviation = results.change(VARIANTS, box, ends, arms, "nodes")
            row.append(f"{change_text(mean)}\ndeviation {percent(deviation.mean)}")
        rows.append(row)
    return list_table(["nodes", *(f"{box} box, {ends} ends" for box, ends in PLACES)], rows, "wide")


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


def _paragraph(text: str) -> str:
    return f"<p>{escape(text)}</p>"
