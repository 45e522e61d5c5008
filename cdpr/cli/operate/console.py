"""`cdpr console`: the operator's page in a browser; `cdpr demo`: all steps on simulated drives."""

from __future__ import annotations

import os
import signal
from functools import partial
from pathlib import Path

import typer

from cdpr import console as page  # loads the server where it is asked for
from cdpr.cli.arguments import flag, option
from cdpr.cli.operate.run import supervise
from cdpr.cli.operate.supervision import handling
from cdpr.cli.options import RIG, WITHOUT_REAL_TIME, BusOptions, words_of
from cdpr.cli.output import Terminal, show_facts, show_line
from cdpr.console.session import Console
from cdpr.console.verbs import ConsoleFiles
from executor import runner
from executor.recording.record_files import free_folder
from executor.recording.run_folder import RunFolder
from model.errors import BadInput, HardwareMissing
from model.files.examples import PAPER_RIG
from model.files.reading import docs_page, ready_folder
from model.plan import plan_facts, plan_from_document, save_plan
from model.rig import load_rig
from model.scene import load_scene
from planner.planning import plan_path
from planner.settings import OptimalSettings

#: Addresses that only a browser on this machine reaches.
_LOCAL = ("127.0.0.1", "::1", "localhost")


def console(
    *,
    rig: Path = RIG,
    scene: Path | None = option("scene file: obstacles and payload for jogging"),
    plan: Path | None = option("plan file to load at the start"),
    host: str = option(
        "address to listen on; other than localhost needs --allow-others", default="127.0.0.1"
    ),
    port: int = option("port; 0 for a free one", default=8402, min=0, max=65535),
    read_only: bool = flag("show only; STOP still works"),
    allow_others: bool = flag("let other machines connect: anyone with the address can operate"),
    camera: list[str] | None = option(
        "camera that measures runs (the first also homing): SOURCE or NAME=SOURCE; repeatable",
        metavar="SOURCE",
    ),
    bus: BusOptions,
    without_real_time: bool = WITHOUT_REAL_TIME,
) -> None:
    """Serve the operator's page: live view, jog, teach, preview, run, hold, stop.

    Open the printed address in a browser. Runs are separate processes, and those that move
    continue when the console ends; jogging ends with it. STOP on the page is a software stop: it
    does not replace the emergency-stop button.

    Examples:
      cdpr console configs/gachon_8_6.yaml --scene configs/environment_1.yaml
      cdpr console rig.yaml --interface socketcan --channel can0 --read-only
    """
    if host not in _LOCAL and not allow_others:
        raise BadInput(
            f"{host} lets other machines connect",
            where="--host",
            why="the connection is not encrypted, and anyone with the address can move the robot",
            next_step="use an SSH tunnel, or pass --allow-others on a network that you trust",
        )
    files = ConsoleFiles(
        rig_file=rig,
        rig=bus.rig(rig),
        bus_options=words_of(interface=bus.interface, channel=bus.channel),
        calibration_options=words_of(calibration=bus.calibration),
        cameras=tuple(camera or ()),
        scene_file=scene,
        without_real_time=without_real_time,
        read_only=read_only,
    )
    serve(files, plan, host, port)


def serve(files: ConsoleFiles, plan: Path | None, host: str, port: int) -> None:
    """Prints the page's address, and serves it until interrupted.

    Args:
        files: Rig, scene and options of the console.
        plan: Loaded at the start; None for none.
        host: Address to listen on.
        port: 0 for a free one.

    Raises:
        HardwareMissing: A library of the server is not installed.
        BadInput: The plan cannot be shown, or the address cannot be used.
    """
    try:
        run_server = page.run_server
    except ImportError as error:
        raise HardwareMissing(
            f"the console needs {error.name}",
            where="cdpr console",
            next_step='install it: pip install "cdpr[console]"',
        ) from None
    shown = Console(files)
    if plan is not None:
        shown.begin_with(plan)

    def show_address(address: str) -> None:
        show_line(f"console of {files.rig.name}: {address}")
        show_line("Ctrl-C ends the console and jogging; a run that moves continues")

    try:
        # A closed terminal ends the server as SIGTERM does, and with it a session of jogs.
        with handling(lambda *_: os.kill(os.getpid(), signal.SIGTERM), (signal.SIGHUP,)):
            run_server(shown, host, port, show_address)
    except KeyboardInterrupt:  # the way to end it
        show_line("console ended")


# `cdpr demo`: all steps from plan to report on the paper's rig, simulated.


def demo(
    *,
    output: Path | None = option(
        "folder to create (default: runs/demo)", "-o", "--output", metavar="DIR"
    ),
    environment: int = option("number of the paper's environment", default=1, min=1, max=3),
    seed: int = option("random seed of the planner", default=0, min=0),
    console: bool = flag("load it into the operator's page, in real time"),
) -> None:
    """Plan, check, run on simulated drives, track with a synthetic camera, and report.

    With --console the plan is loaded into the operator's page at the printed address, with drives
    and cameras simulated in real time: take control there, then run, jog or teach.

    Examples:
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
        plan_file = folder / "plan.json"
        save_plan(document, plan_file)
        files = ConsoleFiles(ready_folder() / PAPER_RIG, rig, (), (), (), scene_file, False, False)
        serve(files, plan_file, "127.0.0.1", 0)
        return
    plan = plan_from_document(document)
    code = supervise(partial(runner.run, plan, rig, folder=folder, realtime=False), rig)
    show_line(f"next: open the report in a browser; your own rig: {docs_page('your-own-rig.md')}")
    raise typer.Exit(code)
