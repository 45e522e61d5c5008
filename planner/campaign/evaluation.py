"""The paper's whole evaluation: its searches, their settings, and its files."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from model.files.documents import write_atomic
from model.progress import SILENT, Listener
from model.rig import Rig
from model.scene import Scene
from planner.campaign.cases import SHARES, box_text, with_box
from planner.campaign.figures import save_figures
from planner.campaign.page import page
from planner.campaign.results import Results
from planner.campaign.studies import STUDIES, batches, run_all
from planner.campaign.tables import findings_json, summary_csv, trials_csv
from planner.campaign.trial import run_batch
from planner.kernels.jit import planner_compilation
from planner.parallel import Count, worker_pool


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
        rig: The robot.
        scenes: The paper's environments.
        seeds: Searches of each planner in each case.
        checked: Whether every path of Fig. 9 is put to `planner.check.check_path` as well.
        workers: Processes; one a core when left out.
        dask: Address of a Dask cluster that does the work instead.
        listener: Receives how far it is.

    Raises:
        BadInput: Dask is not installed, or no scheduler answers.
    """
    work = batches(rig, scenes, seeds, checked=checked)
    with planner_compilation("paper", listener):
        run_batch(work[0])  # before several processes would compile the same
    total = sum(len(batch.seeds) for batch in work)
    with (
        worker_pool(workers or os.cpu_count() or 1, dask) as pool,
        listener.progress("searching", total) as advance,
    ):
        return Results(run_all(work, pool, Count(advance).more))


def about(rig: Rig, scenes: Sequence[Scene], seeds: int, results: Results) -> dict[str, Any]:
    """What the campaign was, for its page and its findings."""
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
    """Writes figures, tables, findings and the page of a campaign into a folder."""
    save_figures(results, folder)
    write_atomic(folder / "trials.csv", trials_csv(results))
    write_atomic(folder / "summary.csv", summary_csv(results))
    write_atomic(folder / "findings.json", findings_json(results, described))
    write_atomic(folder / "index.html", page(results, described))
