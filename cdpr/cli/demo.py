"""`cdpr demo`: the whole way on the paper's rig, simulated."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

RIG = "gachon_8_6.yaml"


def demo(
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="folder to make", metavar="DIR")
    ] = None,
    environment: Annotated[
        int, typer.Option(min=1, max=3, help="which of the paper's environments")
    ] = 1,
    seed: Annotated[int, typer.Option(min=0, help="random seed of the planner")] = 0,
) -> None:
    """Plan, check, run on simulated drives, track with a synthetic camera, and report.

    [dim]Example:[/dim]

      cdpr demo --environment 3
    """
    from cdpr.cli.camera_choice import choose_cameras
    from cdpr.cli.carry_out import carry_out, prepared_run
    from cdpr.cli.output import out, show_facts
    from cdpr.cli.plan import planned, sentences_of
    from cdpr.cli.run_folders import free_folder
    from cdpr.plan import plan_from_document
    from cdpr.rig import load_rig
    from cdpr.scene import load_scene
    from executor.run_folder import RunFolder
    from planner.optimal.settings import OptimalSettings

    folder = output or free_folder("demo")
    RunFolder.require_free(folder)
    rig = load_rig(configs() / RIG)
    scene = load_scene(configs() / f"environment_{environment}.yaml")
    document = planned(rig, scene, OptimalSettings(seed=seed), True)
    show_facts("plan", sentences_of(document))
    prepared = prepared_run(plan_from_document(document), rig, quiet=False)
    code = carry_out(
        prepared, folder, choose_cameras(rig, [], without=False, in_process=True), fast=True
    )
    out.print("next: open the report in a browser; your own rig: docs/your-own-rig.md")
    raise typer.Exit(code)


def configs() -> Path:
    """The folder of the ready rigs and scenes: in the package, or in the repository."""
    import cdpr

    package = Path(cdpr.__file__).resolve().parent
    inside = package / "configs"
    return inside if inside.is_dir() else package.parent / "configs"
