"""Studies on all cores: `cdpr workspace`, maps of a rig's workspace, and `cdpr bench`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from cdpr.cli.options import Quaternion, RigArgument, Triple, rotation_of
from cdpr.cli.output import Terminal, out, show_facts, show_json
from model.files.documents import millimetres
from model.files.examples import PAPER_RIG, ready_folder
from model.files.output import make_folder
from model.rig import load_rig
from model.scene import load_scene
from planner.campaign.evaluation import about, run_campaign, write_campaign
from planner.campaign.page import change_text
from planner.campaign.studies import Finding, findings
from planner.campaign.trial import OWN
from planner.workspace.compute import map_workspace, workspace_grids
from planner.workspace.files import write_maps
from planner.workspace.grid import parsed_slice
from planner.workspace.maps import Question
from planner.workspace.report import summary_facts

WorkersOption = Annotated[
    int | None, typer.Option(min=1, help="number of processes (default: one per core)", metavar="N")
]
DaskOption = Annotated[
    str | None, typer.Option(help="compute on this Dask cluster", metavar="ADDRESS")
]


def workspace(
    rig: RigArgument,
    output: Annotated[Path, typer.Option("-o", "--output", help="folder to write", metavar="DIR")],
    scene: Annotated[
        Path | None, typer.Option(help="scene file: obstacles, clearances, load", metavar="SCENE")
    ] = None,
    slices: Annotated[
        list[str] | None,
        typer.Option("--slice", help="plane to map; repeatable", metavar="z=MM"),
    ] = None,
    volume: Annotated[
        bool | None,
        typer.Option(
            "--volume/--no-volume", help="also map the whole box (default: without --slice)"
        ),
    ] = None,
    step_mm: Annotated[
        float | None, typer.Option(help="grid spacing (default: a fiftieth of the longest side)")
    ] = None,
    lower_mm: Annotated[
        Triple | None,
        typer.Option(help="lower corner of the region x y z (default: the workspace's)"),
    ] = None,
    upper_mm: Annotated[
        Triple | None,
        typer.Option(help="upper corner of the region x y z (default: the workspace's)"),
    ] = None,
    rotation_wxyz: Annotated[
        Quaternion | None,
        typer.Option(help="platform orientation (default: the scene's start, else home)"),
    ] = None,
    length_mm: Annotated[
        float | None,
        typer.Option(
            "--characteristic-length-mm",
            help="characteristic length for moments (default: the anchors' mean radius)",
        ),
    ] = None,
    workers: WorkersOption = None,
    dask: DaskOption = None,
    force: Annotated[bool, typer.Option("--force", help="replace the maps in the folder")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="print the summary as JSON")] = False,
) -> None:
    """Map the workspace: wrench feasibility and closure, capacity margin, dexterity, clearance.

    The maps are written as arrays and as one HTML page.

    [dim]Examples:[/dim]

      cdpr workspace configs/gachon_8_6.yaml -o maps

      cdpr workspace configs/gachon_8_6.yaml --scene configs/environment_1.yaml
      --slice z=445 --slice x=0 --step-mm 5 -o maps
    """
    the_rig = load_rig(rig)
    the_scene = None if scene is None else load_scene(scene)
    length = None if length_mm is None else length_mm / 1000.0
    question = Question.about(the_rig, the_scene, rotation_of(rotation_wxyz), length)
    grids = workspace_grids(
        the_rig,
        [parsed_slice(text) for text in slices or []],
        volume=volume,
        step=None if step_mm is None else step_mm / 1000.0,
        lower=None if lower_mm is None else millimetres(list(lower_mm)),
        upper=None if upper_mm is None else millimetres(list(upper_mm)),
    )
    make_folder(output, force)
    listener = Terminal(quiet=as_json)
    made = map_workspace(question, grids, workers=workers, dask=dask, listener=listener)
    with listener.waiting("drawing"):
        summary = write_maps(output, made, question, the_scene)
    if as_json:
        show_json({"folder": str(output), "maps": summary})
    else:
        facts = [*summary_facts(summary), ("next", f"open {output / 'index.html'}")]
        show_facts(f"maps of {the_rig.name} in {output}", facts)


# `cdpr bench`: long measurements of the planner.


ENVIRONMENTS = ("environment_1", "environment_2", "environment_3")
DEFAULT_FOLDER = Path("bench-paper")


def paper(
    output: Annotated[
        Path, typer.Option("-o", "--output", help="folder to write", metavar="DIR")
    ] = DEFAULT_FOLDER,
    seeds: Annotated[int, typer.Option(min=2, help="searches per planner and case")] = 100,
    workers: WorkersOption = None,
    dask: DaskOption = None,
    check: Annotated[
        bool, typer.Option("--check", help="also run `cdpr check` on every path of Fig. 9")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="replace the folder's content")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="print the findings as JSON")] = False,
) -> None:
    """Repeat the paper's evaluation (section 5.3, Fig. 9) and report which claims hold.

    Compares adaptive sampling with goal bias and kinematic cost with length, in three environments,
    with the scene's start and goal and with random ones, in the rig's workspace box and in larger
    ones, and for every reading of the text. Writes index.html, images, trials.csv, summary.csv and
    findings.json. Apart from times, the numbers depend only on the seeds.

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
        out.print(f"for larger boxes, every reading and figures, open {output / 'index.html'}")
    if described["paths that failed their check"]:
        raise typer.Exit(1)


def _table(found: Sequence[Finding]) -> Table:
    table = Table(
        title="the paper's claims in the rig's workspace box",
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
