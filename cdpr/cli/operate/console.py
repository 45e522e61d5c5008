"""`cdpr console`: the operator's page in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cdpr import console as page  # loads the server where it is asked for
from cdpr.cli.options import (
    DEFAULT_BUS,
    BusOptions,
    RigArgument,
    WithoutRealTimeOption,
    with_option_groups,
)
from cdpr.cli.output import show_line
from cdpr.console.session import Console, ConsoleFiles
from model.errors import BadInput, HardwareMissing

#: Addresses that only a browser on this machine reaches.
_LOCAL = ("127.0.0.1", "::1", "localhost")


@with_option_groups
def console(
    rig: RigArgument,
    scene: Annotated[
        Path | None,
        typer.Option(help="scene file: obstacles and payload for jogging"),
    ] = None,
    plan: Annotated[Path | None, typer.Option(help="plan file to load at the start")] = None,
    host: Annotated[
        str,
        typer.Option(help="address to listen on; other than localhost needs --allow-others"),
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="port; 0 for a free one")] = 8402,
    read_only: Annotated[
        bool, typer.Option("--read-only", help="show only; STOP still works")
    ] = False,
    allow_others: Annotated[
        bool,
        typer.Option(
            "--allow-others", help="let other machines connect: anyone with the address can operate"
        ),
    ] = False,
    camera: Annotated[
        list[str] | None,
        typer.Option(
            "--camera",
            help="camera that measures runs (the first also homing): SOURCE or NAME=SOURCE;"
            " repeatable",
            metavar="SOURCE",
        ),
    ] = None,
    bus: BusOptions = DEFAULT_BUS,
    without_real_time: WithoutRealTimeOption = False,
) -> None:
    """Serve the operator's page: live view, jog, teach, preview, run, hold, stop.

    Open the printed address in a browser. Runs are separate processes, and continue when the
    console ends. STOP on the page is a software stop: it does not replace the emergency-stop
    button.

    [dim]Examples:[/dim]

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
    options = [("--interface", bus.interface), ("--channel", bus.channel)]
    files = ConsoleFiles(
        rig_file=rig,
        rig=bus.rig(rig),
        bus_options=tuple(text for name, value in options if value for text in (name, value)),
        calibration_options=tuple(
            text for path in bus.calibration or () for text in ("--calibration", str(path))
        ),
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
        shown.load_plan(plan)

    def show_address(address: str) -> None:
        show_line(f"console of {files.rig.name}: {address}")
        show_line("Ctrl-C ends the console; a run continues")

    run_server(shown, host, port, show_address)
