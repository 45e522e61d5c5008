"""`cdpr bench`: measurements of the planner that take a while."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cdpr.rig import Rig
    from cdpr.scene import Scene
    from planner.campaign.results import Results

ENVIRONMENTS = ("environment_1", "environment_2", "environment_3")
DEFAULT_FOLDER = Path("bench-paper")


def paper(
    output: Annotated[
        Path, typer.Option("-o", "--output", help="folder to write", metavar="DIR")
    ] = DEFAULT_FOLDER,
    seeds: Annotated[int, typer.Option(min=2, help="searches of each planner in each case")] = 100,
    workers: Annotated[
        int | None, typer.Option(min=1, help="processes; else one a core", metavar="N")
    ] = None,
    dask: Annotated[
        str | None, typer.Option(help="do the work on this Dask cluster", metavar="ADDRESS")
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="put every path of Fig. 9 to `cdpr check` as well")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="replace what the folder holds")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="print the findings as JSON")] = False,
) -> None:
    """Repeat the paper's evaluation (section 5.3, Fig. 9) and tell which claims hold.

    Adaptive sampling against the goal bias, kinematic cost against length, in three environments,
    with the scene's ends and with random ones, in the rig's workspace box and in larger ones, and
    for every reading of the text. Writes index.html, pictures, trials.csv, summary.csv and
    findings.json. The numbers depend on the seeds alone, the times aside.

    [dim]Example:[/dim]

      cdpr bench paper --seeds 100 -o bench-paper
    """
    from cdpr.cli.compiling import told_when_compiling
    from cdpr.cli.demo import RIG, configs
    from cdpr.cli.output import out, progress_bar, show_json, spinner
    from cdpr.cli.workers import Count, make_folder, worker_pool
    from cdpr.rig import load_rig
    from cdpr.scene import load_scene
    from planner.campaign.boxes import OWN
    from planner.campaign.claims import findings
    from planner.campaign.results import Results
    from planner.campaign.running import run_all
    from planner.campaign.studies import batches
    from planner.campaign.trial import run_batch

    rig = load_rig(configs() / RIG)
    scenes = [load_scene(configs() / f"{name}.yaml") for name in ENVIRONMENTS]
    make_folder(output, force)
    work = batches(rig, scenes, seeds, checked=check)
    with told_when_compiling("paper", not as_json):
        run_batch(work[0])  # before several processes would compile the same
    total = sum(len(batch.seeds) for batch in work)
    with (
        worker_pool(workers or os.cpu_count() or 1, dask) as pool,
        progress_bar("searching", total, not as_json) as advance,
    ):
        results = Results(run_all(work, pool, Count(advance).more))
    told = about(rig, scenes, seeds, results)
    with spinner("drawing", not as_json):
        _write(output, results, told)
    if as_json:
        from json import loads

        show_json(loads((output / "findings.json").read_text(encoding="utf-8")))
    else:
        out.print(_table([finding for finding in findings(results) if finding.box == OWN]))
        for name in ("searches without a path", "paths checked", "paths that failed their check"):
            out.print(f"{name}: {told[name]}")
        out.print(f"larger boxes, every reading, figures: open {output / 'index.html'}")
    if told["paths that failed their check"]:
        raise typer.Exit(1)


def about(rig: Rig, scenes: Sequence[Scene], seeds: int, results: Results) -> dict[str, Any]:
    """What the campaign was, for its page and its findings."""
    import platform
    from importlib.metadata import version

    from planner.campaign.boxes import SHARES, box_text, with_box
    from planner.campaign.studies import STUDIES

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


def _write(folder: Path, results: Results, described: dict[str, Any]) -> None:
    from cdpr.documents import write_atomic
    from planner.campaign.figures import save_figures
    from planner.campaign.page import page
    from planner.campaign.tables import findings_json, summary_csv, trials_csv

    save_figures(results, folder)
    write_atomic(folder / "trials.csv", trials_csv(results))
    write_atomic(folder / "summary.csv", summary_csv(results))
    write_atomic(folder / "findings.json", findings_json(results, described))
    write_atomic(folder / "index.html", page(results, described))


def _table(found: Any) -> Any:
    from rich.table import Table

    from planner.campaign.page import change_text

    table = Table(
        title="the paper's claims in the rig's own box",
        box=None,
        title_justify="left",
        padding=(0, 2),
    )
    for name in ("claim", "ends", "found", "verdict"):
        table.add_column(name, overflow="fold")
    for finding in found:
        change = change_text(finding.change)
        table.add_row(finding.claim, finding.ends, change, finding.verdict)
    return table
