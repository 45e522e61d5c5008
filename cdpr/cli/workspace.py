"""`cdpr workspace`: maps of what a rig can do where."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from cdpr.poses import Array
    from cdpr.rig import Rig
    from planner.workspace.computing import Maps
    from planner.workspace.grid import Grid
    from planner.workspace.maps import Question

CELLS_OF_A_SLICE = 50
CELLS_OF_THE_FRAME = 40
POINTS_FOR_ONE_PROCESS = 20000
"""Fewer are done before other processes have started."""

Triple = tuple[float, float, float]


def workspace(
    rig: Annotated[Path, typer.Argument(help="rig file (YAML)", metavar="RIG")],
    output: Annotated[Path, typer.Option("-o", "--output", help="folder to write", metavar="DIR")],
    scene: Annotated[
        Path | None, typer.Option(help="scene file: obstacles, clearances, load", metavar="SCENE")
    ] = None,
    slices: Annotated[
        list[str] | None,
        typer.Option("--slice", help="plane to map; several are possible", metavar="z=MM"),
    ] = None,
    volume: Annotated[
        bool | None,
        typer.Option("--volume/--no-volume", help="map the whole box too (default: no --slice)"),
    ] = None,
    step_mm: Annotated[
        float | None, typer.Option(help="distance of points; else a fiftieth of the longest side")
    ] = None,
    lower_mm: Annotated[
        Triple | None, typer.Option(help="corner of the region instead of the workspace's: x y z")
    ] = None,
    upper_mm: Annotated[Triple | None, typer.Option(help="its opposite corner: x y z")] = None,
    rotation_wxyz: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(help="orientation of the platform; else the scene's start, else home"),
    ] = None,
    length_mm: Annotated[
        float | None,
        typer.Option(
            "--characteristic-length-mm",
            help="divides moments in the condition number; else the anchors' mean radius",
        ),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="processes; else one a core", metavar="N")
    ] = None,
    dask: Annotated[
        str | None, typer.Option(help="do the work on this Dask cluster", metavar="ADDRESS")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="replace the maps in the folder")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="print the summary as JSON")] = False,
) -> None:
    """Map where the robot can be and how well it can work there.

    Wrench closure and feasibility, dexterity, forces and clearances, as one page.

    [dim]Examples:[/dim]

      cdpr workspace configs/gachon_8_6.yaml -o maps

      cdpr workspace configs/gachon_8_6.yaml --scene configs/environment_1.yaml
      --slice z=445 --slice x=0 --step-mm 5 -o maps
    """
    from cdpr.cli.compiling import told_when_compiling
    from cdpr.cli.output import progress_bar, show_facts, show_json, spinner
    from cdpr.cli.workers import Count, make_folder, worker_pool
    from cdpr.cli.workspace_files import write_maps
    from cdpr.rig import load_rig
    from cdpr.scene import load_scene
    from planner.workspace.computing import compute
    from planner.workspace.costs import Extremes
    from planner.workspace.maps import Question

    the_rig = load_rig(rig)
    the_scene = None if scene is None else load_scene(scene)
    length = None if length_mm is None else length_mm / 1000.0
    question = Question.about(the_rig, the_scene, _rotation(rotation_wxyz), length)
    grids = _grids(the_rig, slices or [], volume, step_mm, lower_mm, upper_mm)
    make_folder(output, force)
    with told_when_compiling("maps", not as_json):
        extremes = Extremes.over_workspace(question)
        _warm_up(question)
    total = sum(grid.count for grid in grids)
    made: list[Maps] = []
    cores = 1 if total <= POINTS_FOR_ONE_PROCESS else os.cpu_count() or 1
    with (
        worker_pool(workers or cores, dask) as pool,
        progress_bar("mapping", total, not as_json) as advance,
    ):
        done = Count(advance)
        for grid in grids:
            made.append(compute(question, extremes, grid, pool=pool, progress=done.more))
    with spinner("drawing", not as_json):
        where = f" in {the_scene.name}" if the_scene else ""
        title = f"Workspace of {the_rig.name}{where}"
        summary = write_maps(output, made, title, _lead(question))
    if as_json:
        show_json({"folder": str(output), "maps": summary})
    else:
        show_facts(f"maps of {the_rig.name} in {output}", _sentences(summary, output))


def _rotation(rotation_wxyz: tuple[float, float, float, float] | None) -> Array | None:
    if rotation_wxyz is None:
        return None
    import numpy as np

    from cdpr.errors import BadInput
    from cdpr.poses import matrix_from_quaternion

    norm = float(np.linalg.norm(rotation_wxyz))
    if not 1e-6 < norm < np.inf:
        raise BadInput("the rotation is not a quaternion w x y z of a length above 0")
    return matrix_from_quaternion(np.array(rotation_wxyz) / norm)


def _grids(
    rig: Rig,
    slices: list[str],
    volume: bool | None,
    step_mm: float | None,
    lower_mm: Triple | None,
    upper_mm: Triple | None,
) -> list[Grid]:
    """The slices, and with the volume the frame around it and the region itself."""
    import numpy as np

    from cdpr.document_types import millimetres
    from planner.workspace import grid

    lower = rig.workspace_lower if lower_mm is None else millimetres(list(lower_mm))
    upper = rig.workspace_upper if upper_mm is None else millimetres(list(upper_mm))
    step = float(np.max(upper - lower)) / CELLS_OF_A_SLICE
    if step_mm is not None:
        step = step_mm / 1000.0
    wanted = [grid.parsed_slice(text) for text in slices]
    if not wanted:
        wanted = [(2, float(np.clip(rig.home.position[2], lower[2], upper[2])))]
    grids = [grid.slice_through(axis, value, lower, upper, step) for axis, value in wanted]
    if volume or (volume is None and not slices):
        around = grid.frame_box(rig)
        coarse = float(np.max(around[1] - around[0])) / CELLS_OF_THE_FRAME
        grids.append(grid.volume("frame", *around, coarse))
        grids.append(grid.volume("workspace", lower, upper, step))
    return grids


def _warm_up(question: Question) -> None:
    """Compiles what is needed once, before several processes would do so."""
    from planner.workspace.maps import values_at

    values_at(question, question.rig.home.position[None, :])


def _lead(question: Question) -> str:
    rig = question.rig
    turned = "" if abs(question.rotation.trace() - 3.0) < 1e-12 else ", platform turned"
    return (
        f"Tensions {rig.min_tension:g} to {rig.max_tension:g} N; moments divided by"
        f" {question.length * 1e3:.1f} mm in the condition number{turned}."
    )


def _sentences(summary: dict[str, Any], folder: Path) -> list[tuple[str, str]]:
    facts = []
    for name, found in summary.items():
        share = found["share"]
        margin = found["range"]["capacity_margin_n"]
        text = (
            f"{found['points']} points; wrench closure {share['closed'] * 100:.1f} %,"
            f" feasible {share['feasible'] * 100:.1f} %, allowed {share['allowed'] * 100:.1f} %"
        )
        if margin is not None:
            text += f"; capacity margin {margin[0]:.1f} to {margin[1]:.1f} N"
        facts.append((name.replace("_", " "), text))
    facts.append(("next", f"open {folder / 'index.html'}"))
    return facts
