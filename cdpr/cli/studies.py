"""Studies on all cores: `cdpr workspace`, maps of a rig's workspace, and `cdpr bench`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import typer
from rich.table import Table

from cdpr.cli.arguments import flag, option, required
from cdpr.cli.options import RIG, Quaternion, Triple, rotation_of
from cdpr.cli.output import Terminal, out, present, show_json, show_line
from model.files.documents import millimetres
from model.files.examples import PAPER_RIG
from model.files.output import make_folder
from model.files.reading import ready_folder
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

WORKERS = option("number of processes (default: one per core)", min=1, metavar="N")
DASK = option("compute on this Dask cluster", metavar="ADDRESS")


def workspace(
    *,
    rig: Path = RIG,
    output: Path = required("folder to write", "-o", "--output", metavar="DIR"),
    scene: Path | None = option("scene file: obstacles, clearances, load", metavar="SCENE"),
    slices: list[str] | None = option("plane to map; repeatable", "--slice", metavar="z=MM"),
    volume: bool | None = option(
        "also map the whole box (default: without --slice)", "--volume/--no-volume"
    ),
    step_mm: float | None = option("grid spacing (default: a fiftieth of the longest side)"),
    lower_mm: Triple | None = option("lower corner of the region x y z (default: the workspace's)"),
    upper_mm: Triple | None = option("upper corner of the region x y z (default: the workspace's)"),
    rotation_wxyz: Quaternion | None = option(
        "platform orientation (default: the scene's start, else home)"
    ),
    length_mm: float | None = option(
        "characteristic length for moments (default: the anchors' RMS radius)",
        "--characteristic-length-mm",
    ),
    workers: int | None = WORKERS,
    dask: str | None = DASK,
    force: bool = flag("replace the maps in the folder"),
    as_json: bool = flag("print the summary as JSON", "--json"),
) -> None:
    """Map the workspace: wrench feasibility and closure, capacity margin, dexterity, clearance.

    The maps are written as arrays and as one HTML page.

    Examples:
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
    facts = [*summary_facts(summary), ("next", f"open {output / 'index.html'}")]
    document = {"folder": str(output), "maps": summary}
    present(as_json, document, f"maps of {the_rig.name} in {output}", facts)


# `cdpr bench`: long measurements of the planner.


ENVIRONMENTS = ("environment_1", "environment_2", "environment_3")
DEFAULT_FOLDER = Path("bench-paper")


def paper(
    *,
    output: Path = option(
        "folder to write", "-o", "--output", default=DEFAULT_FOLDER, metavar="DIR"
    ),
    seeds: int = option("searches per planner and case", default=100, min=2),
    workers: int | None = WORKERS,
    dask: str | None = DASK,
    check: bool = flag("also run `cdpr check` on every path of Fig. 9"),
    force: bool = flag("replace the folder's content"),
    as_json: bool = flag("print the findings as JSON", "--json"),
) -> None:
    """Repeat the paper's evaluation (section 5.3, Fig. 9) and report which claims hold.

    Compares adaptive sampling with goal bias and kinematic cost with length, in three environments,
    with the scene's start and goal and with random ones, in the rig's workspace box and in larger
    ones, and for every reading of sampling and steps. Writes index.html, images, trials.csv,
    summary.csv and findings.json. Apart from times, the numbers depend only on the seeds.

    Example:
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
        show_line(f"for larger boxes, every reading and figures, open {output / 'index.html'}")
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
