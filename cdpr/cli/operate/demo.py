"""`cdpr demo`: all steps from plan to report on the paper's rig, simulated."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cdpr.cli.operate.console import serve
from cdpr.cli.operate.run import agreement, show, show_files
from cdpr.cli.operate.supervision import RunSupervisor
from cdpr.cli.output import Terminal, out, show_facts
from cdpr.console.session import ConsoleFiles
from executor import runner
from executor.recording.record_files import free_folder
from executor.recording.run_folder import RunFolder
from model.files.examples import PAPER_RIG, ready_folder
from model.plan import plan_facts, plan_from_document, save_plan
from model.rig import load_rig
from model.scene import load_scene
from planner.planning import plan_path
from planner.settings import OptimalSettings


def demo(
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="folder to create", metavar="DIR")
    ] = None,
    environment: Annotated[
        int, typer.Option(min=1, max=3, help="number of the paper's environment")
    ] = 1,
    seed: Annotated[int, typer.Option(min=0, help="random seed of the planner")] = 0,
    console: Annotated[
        bool,
        typer.Option("--console", help="load it into the operator's page, in real time"),
    ] = False,
) -> None:
    """Plan, check, run on simulated drives, track with a synthetic camera, and report.

    With --console the plan is loaded into the operator's page at the printed address, with drives
    and cameras simulated in real time: take control there, then run, jog or teach.

    [dim]Examples:[/dim]

      cdpr demo --environment 3

      cdpr demo --console
    """
    folder = output or free_folder("demo")
    RunFolder.require_free(folder)
    rig = load_rig(ready_folder() / PAPER_RIG)
    scene_file = ready_folder() / f"environment_{environment}.yaml"
    scene = load_scene(scene_file)
    document = plan_path(rig, scene, OptimalSettings(seed=seed), Terminal())
    show_facts("plan", plan_facts(document))
    if console:
        folder.mkdir(parents=True)
        plan = folder / "plan.json"
        save_plan(document, plan)
        files = ConsoleFiles(ready_folder() / PAPER_RIG, rig, (), (), (), scene_file, False, False)
        serve(files, plan, "127.0.0.1", 0)
        return
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
