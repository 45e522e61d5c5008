"""A campaign as CSV and JSON."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from planner.campaign.claims import findings
from planner.campaign.results import COUNTED, MEASURED, Results, summary
from planner.campaign.studies import FIGURE_9
from planner.campaign.trial import Arm, Case

_CASE = ("study", "box", "environment", "ends")
_ARM = (
    "sampler",
    "cost_to_minimise",
    "failure_rate",
    "focus",
    "cone_draw",
    "steer",
    "spacing_mm",
    "goal_sight",
)


def trials_csv(results: Results) -> str:
    """One row a search."""
    head = (*_CASE, *_ARM, "seed", "found", *COUNTED, *MEASURED, "passed_check")
    rows = (
        (
            *_case(t.study, t.case),
            *_arm(t.arm),
            t.seed,
            int(t.found),
            *(_text(t.value(name)) for name in (*COUNTED, *MEASURED, "passed")),
        )
        for t in results.trials
    )
    return _csv(head, rows)


def summary_csv(results: Results) -> str:
    """One row a quantity of an arm in a case: mean, standard deviation, bootstrap interval."""
    head = (*_CASE, *_ARM, "quantity", "searches_with_path", "searches", *_FIGURES)
    rows = []
    for (study, case, arm), trials in results.groups():
        for quantity in COUNTED + (MEASURED if study == FIGURE_9 else ()):
            values = results.values(study, case, arm, quantity)
            values = values[~np.isnan(values)]
            if len(values):
                figures = asdict(summary(values))
                count = figures.pop("count")
                texts = [_text(value) for value in figures.values()]
                rows.append((*_case(study, case), *_arm(arm), quantity, count, len(trials), *texts))
    return _csv(head, rows)


_FIGURES = ("mean", "standard_deviation", "interval_low", "interval_high")


def findings_json(results: Results, about: dict[str, Any]) -> str:
    """The claims and what was found, with what the campaign was."""
    listed = [{**asdict(finding), "verdict": finding.verdict} for finding in findings(results)]
    return json.dumps({"about": about, "findings": listed}, indent=1, allow_nan=False) + "\n"


def _case(study: str, case: Case) -> tuple[str, ...]:
    return study, case.box, case.environment, case.ends


def _arm(arm: Arm) -> tuple[object, ...]:
    readings = arm.readings
    adaptive = arm.sampler == "adaptive"
    drawn = (readings.failure_rate, readings.focus, readings.cone_draw) if adaptive else ("",) * 3
    sight = int(readings.goal_sight)
    return arm.sampler, arm.cost, *drawn, readings.steer, f"{readings.spacing * 1e3:g}", sight


def _text(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.6g}"


def _csv(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(head)
    writer.writerows(rows)
    return stream.getvalue()
