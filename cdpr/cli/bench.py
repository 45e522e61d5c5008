"""`cdpr bench`: measurements of the planner that take a while."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from cdpr.cli.options import DaskOption, WorkersOption
from cdpr.cli.output import Terminal, out, show_json
from model.files.examples import PAPER_RIG, ready_folder
from model.files.output import make_folder
from model.rig import load_rig
from model.scene import load_scene
from planner.campaign.evaluation import about, run_campaign, write_campaign
from planner.campaign.page import change_text
from planner.campaign.results import Finding, findings
from planner.campaign.trial import OWN

ENVIRONMENTS = ("environment_1", "environment_2", "environment_3")
DEFAULT_FOLDER = Path("bench-paper")


def paper(
    output: Annotated[
        Path, typer.Option("-o", "--output", help="folder to write", metavar="DIR")
    ] = DEFAULT_FOLDER,
    seeds: Annotated[int, typer.Option(min=2, help="searches of each planner in each case")] = 100,
    workers: WorkersOption = None,
    dask: DaskOption = None,
    check: Annotated[
        bool, typer.Option("--check", help="also run `cdpr check` on every path of Fig. 9")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="replace the folder's content")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="print the findings as JSON")] = False,
) -> None:
    """Repeat the paper's evaluation (section 5.3, Fig. 9) and report which claims hold.

    Adaptive sampling against the goal bias, kinematic cost against length, in three environments,
    with the scene's ends and with random ones, in the rig's workspace box and in larger ones, and
    for every reading of the text. Writes index.html, images, trials.csv, summary.csv and
    findings.json. The numbers depend on the seeds alone, the times aside.

    [dim]Example:[/dim]

      cdpr bench paper --seeds 100 -o bench-paper
    """
    rig = load_rig(ready_folder() / PAPER_RIG)
    scenes = [load_scene(ready_folder() / f"{name}.yaml") for name in ENVIRONMENTS]
    make_folder(output, force)
    listener = Terminal(quiet=as_json)
    results = run_campaign(
        rig, scenes, seeds, checked=check, workers=workers, dask=dask, listener=listener
    )
    described = about(rig, scenes, seeds, results)
    with listener.waiting("drawing"):
        write_campaign(output, results, described)
    if as_json:
        show_json(json.loads((output / "findings.json").read_text(encoding="utf-8")))
    else:
        out.print(_table([finding for finding in findings(results) if finding.box == OWN]))
        out.print(f"searches without a path: {described['searches without a path']}")
        if described["paths checked"]:
            for name in ("paths checked", "paths that failed their check"):
                out.print(f"{name}: {described[name]}")
        else:
            out.print("paths were not checked; pass --check to check them")
        out.print(f"larger boxes, every reading, figures: open {output / 'index.html'}")
    if described["paths that failed their check"]:
        raise typer.Exit(1)


def _table(found: Sequence[Finding]) -> Table:
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
