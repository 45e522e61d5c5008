"""`cdpr workspace`: maps of what a rig can do where."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from cdpr.cli.options import DaskOption, RigArgument, Triple, WorkersOption
from cdpr.cli.output import Terminal, show_facts, show_json
from model.errors import BadInput
from model.files.documents import millimetres
from model.files.output import make_folder
from model.pose import Array, matrix_from_quaternion
from model.rig import load_rig
from model.scene import load_scene
from planner.workspace.compute import map_workspace, workspace_grids
from planner.workspace.files import write_maps
from planner.workspace.grid import parsed_slice
from planner.workspace.maps import Question
from planner.workspace.report import summary_facts


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
        tuple[float, float, float, float] | None,
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
    """Map the workspace: feasibility, wrench closure, capacity margin and dexterity.

    Wrench closure and feasibility, dexterity, forces and clearances, as one page.

    [dim]Examples:[/dim]

      cdpr workspace configs/gachon_8_6.yaml -o maps

      cdpr workspace configs/gachon_8_6.yaml --scene configs/environment_1.yaml
      --slice z=445 --slice x=0 --step-mm 5 -o maps
    """
    the_rig = load_rig(rig)
    the_scene = None if scene is None else load_scene(scene)
    length = None if length_mm is None else length_mm / 1000.0
    question = Question.about(the_rig, the_scene, _rotation(rotation_wxyz), length)
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


def _rotation(rotation_wxyz: tuple[float, float, float, float] | None) -> Array | None:
    if rotation_wxyz is None:
        return None
    norm = float(np.linalg.norm(rotation_wxyz))
    if not 1e-6 < norm < np.inf:
        raise BadInput("the rotation is not a quaternion w x y z of non-zero length")
    return matrix_from_quaternion(np.array(rotation_wxyz) / norm)
