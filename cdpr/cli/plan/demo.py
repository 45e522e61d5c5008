"""`cdpr demo`: the whole way on the paper's rig, simulated."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cdpr.cli.operate.run import agreement, show, show_files
from cdpr.cli.operate.supervision import RunSupervisor
from cdpr.cli.output import Terminal, out, show_facts
from cdpr.cli.plan.examples import configs
from cdpr.cli.plan.facts import sentences_of
from executor import runner
from executor.recording.run_course import free_folder
from executor.recording.run_folder import RunFolder
from model.plan import plan_from_document
from model.rig import load_rig
from model.scene import load_scene
from planner.planning import plan_path
from planner.settings import OptimalSettings

RIG = "gachon_8_6.yaml"


def demo(
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="folder to create", metavar="DIR")
    ] = None,
    environment: Annotated[
        int, typer.Option(min=1, max=3, help="number of the paper's environment")
    ] = 1,
    seed: Annotated[int, typer.Option(min=0, help="random seed of the planner")] = 0,
) -> None:
    """Plan, check, run on simulated drives, track with a synthetic camera, and report.

    [dim]Example:[/dim]

      cdpr demo --environment 3
    """
    folder = output or free_folder("demo")
    RunFolder.require_free(folder)
    rig = load_rig(configs() / RIG)
    scene = load_scene(configs() / f"environment_{environment}.yaml")
    document = plan_path(rig, scene, OptimalSettings(seed=seed), Terminal())
    show_facts("plan", sentences_of(document))
    with RunSupervisor(lambda result: show(result, False)) as supervisor:
        result = runner.run(
            plan_from_document(document),
            rig,
            folder=folder,
            realtime=False,
            listener=Terminal(),
            confirm=agreement(supervisor, rig, False, False),
            supervisor=supervisor,
        )
        show_files(result, False)
    out.print("next: open the report in a browser; your own rig: docs/your-own-rig.md")
    raise typer.Exit(result.exit_code)
