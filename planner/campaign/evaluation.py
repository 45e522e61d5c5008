"""The paper's whole evaluation: its searches, their settings, and its output files."""

from __future__ import annotations

import csv
import io
import json
import math
import platform
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from model.files.documents import write_atomic
from model.progress import SILENT, Listener
from model.rig import Rig
from model.scene import Scene
from planner.campaign.page import page, save_figures
from planner.campaign.studies import (
    COUNTED,
    FIGURE_9,
    MEASURED,
    STUDIES,
    Change,
    Results,
    batches,
    findings,
    run_all,
    summary,
)
from planner.campaign.trial import SHARES, Arm, Case, box_text, run_batch, with_box
from planner.kernels.jit import planner_compilation
from planner.parallel import Count, default_workers, worker_pool


def run_campaign(
    rig: Rig,
    scenes: Sequence[Scene],
    seeds: int,
    *,
    checked: bool = False,
    workers: int | None = None,
    dask: str | None = None,
    listener: Listener = SILENT,
) -> Results:
    """Repeats the paper's evaluation (section 5.3, Fig. 9).

    Args:
        seeds: Searches of each planner in each case.
        checked: Whether `planner.check.check_path` checks every path of Fig. 9 as well.
        workers: Processes; one per core when left out.
        dask: Address of a Dask cluster to use instead.

    Raises:
        BadInput: Dask is not installed, or no scheduler answers.
    """
    work = batches(rig, scenes, seeds, checked=checked)
    with planner_compilation("paper", listener):
        run_batch(work[0])  # or every process would compile
    total = sum(len(batch.seeds) for batch in work)
    with (
        worker_pool(workers or default_workers(), dask) as pool,
        listener.progress("searching", total) as advance,
    ):
        return Results(run_all(work, pool, Count(advance).more))


def about(rig: Rig, scenes: Sequence[Scene], seeds: int, results: Results) -> dict[str, Any]:
    """Facts about the campaign, for its page and its findings."""
    lost = {study: results.lost(study) for study in STUDIES}
    checked = [t.path.passed for t in results.trials if t.path.passed == t.path.passed]
    return {
        "seeds": seeds,
        "searches": len(results.trials),
        "searches without a path": ", ".join(f"{study} {count}" for study, count in lost.items()),
        "paths checked": len(checked),
        "paths that failed their check": int(len(checked) - sum(checked)),
        "boxes": {name: box_text(with_box(rig, name)) for name in SHARES},
        "rig": f"{rig.name}, hash {rig.plan_hash}",
        "scenes": ", ".join(f"{scene.name}, hash {scene.hash}" for scene in scenes),
        "version": f"cdpr {version('cdpr')}, Python {platform.python_version()}",
    }


def write_campaign(folder: Path, results: Results, described: dict[str, Any]) -> None:
    """Writes tables, figures, findings and the page of a campaign into a folder."""
    write_atomic(folder / "trials.csv", trials_csv(results))  # first: the rest is made from it
    save_figures(results, folder)
    write_atomic(folder / "summary.csv", summary_csv(results))
    write_atomic(folder / "findings.json", findings_json(results, described))
    write_atomic(folder / "index.html", page(results, described))


# A campaign as CSV and JSON.


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
    """One row per search."""
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
    """One row per quantity, arm and case: mean, standard deviation, bootstrap interval."""
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
    """The claims, the findings, and facts about the campaign; null where a change is unknown."""
    listed = [
        {**asdict(finding), "change": _known(finding.change), "verdict": finding.verdict}
        for finding in findings(results)
    ]
    return json.dumps({"about": about, "findings": listed}, indent=1, allow_nan=False) + "\n"


def _known(change: Change) -> dict[str, Any]:
    """A change as JSON."""
    numbers = asdict(change)
    numbers["each"] = [_number(x) for x in change.each]
    return numbers | {name: _number(numbers[name]) for name in ("mean", "low", "high")}


def _number(value: float) -> float | None:
    return None if math.isnan(value) else value


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
