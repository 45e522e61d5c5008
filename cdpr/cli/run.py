"""`cdpr run`: runs a plan on the drives and measures it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cdpr.cli.calibrations import CalibrationOption
from cdpr.cli.motion_options import (
    ChannelOption,
    FastOption,
    InterfaceOption,
    WithoutRealTimeOption,
    YesOption,
    require_unused,
)

if TYPE_CHECKING:
    from cdpr.poses import Pose


def run(
    plan: Annotated[Path, typer.Argument(help="plan file (JSON)", metavar="PLAN")],
    rig: Annotated[Path, typer.Option("--rig", help="rig file (YAML)", metavar="RIG")],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="run folder to make", metavar="RUNDIR")
    ],
    fast: FastOption = False,
    camera: Annotated[
        list[str] | None,
        typer.Option(
            help="a camera's index, or 'synthetic': all of the rig file's (the default with the"
            " interface 'virtual'); for each of several cameras NAME=SOURCE, again and again",
            metavar="SOURCE",
        ),
    ] = None,
    calibration: CalibrationOption = None,
    no_camera: Annotated[bool, typer.Option("--no-camera", help="run without a camera")] = False,
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    simulated_start_mm: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="where the simulated platform stands: x y z (default: at the start)"),
    ] = None,
    yes: YesOption = False,
    without_real_time: WithoutRealTimeOption = False,
    no_clearance_stop: Annotated[
        bool,
        typer.Option("--no-clearance-stop", help="go on when the camera sees too little clearance"),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="print the summary as JSON")] = False,
) -> None:
    """Run a plan: prove it, make its set-points, arm the drives, move, measure, report.

    With the interface 'virtual' the drives, the platform and the camera are simulated in this
    process. Ctrl-C and `cdpr stop` slow all drives down together along the path; they then hold.

    [dim]Examples:[/dim]

      cdpr run plan.json --rig configs/gachon_8_6.yaml -o runs/first --fast

      cdpr run plan.json --rig rig.yaml -o runs/second --camera 0

      cdpr run plan.json --rig rig.yaml -o runs/third --camera front=0 --camera side=1
    """
    from cdpr.cli.calibrations import calibrated_rig
    from cdpr.cli.camera_choice import choose_cameras, require_simulated_pictures
    from cdpr.cli.carry_out import carry_out, prepared_run
    from cdpr.cli.named_bus import rig_on_bus
    from cdpr.cli.plan_for_rig import require_same_rig
    from cdpr.plan import load_plan
    from drivers.bus import IN_PROCESS
    from executor.custody import Custody
    from executor.run_folder import RunFolder

    the_rig = calibrated_rig(rig_on_bus(rig, interface, channel), calibration)
    in_process = the_rig.document.bus.interface == IN_PROCESS
    eyes = choose_cameras(the_rig, camera or [], no_camera, in_process)
    require_simulated_pictures(eyes.values(), fast)
    if not eyes:
        why = "without a camera no clearance is measured, and nothing stops the run for it"
        require_unused("cdpr run", {"--no-clearance-stop": no_clearance_stop}, why)
    start = _simulated_start(simulated_start_mm, in_process, fast)
    RunFolder.require_free(output)
    Custody(the_rig).require_free()
    the_rig = Custody(the_rig).referenced_rig()
    the_plan = load_plan(plan)
    require_same_rig(the_plan, the_rig, plan)
    code = carry_out(
        prepared_run(the_plan, the_rig, quiet=as_json),
        output,
        eyes,
        fast=fast,
        start=start,
        yes=yes,
        without_real_time=without_real_time,
        clearance_stop=not no_clearance_stop,
        as_json=as_json,
    )
    raise typer.Exit(code)


def _simulated_start(
    start_mm: tuple[float, float, float] | None, in_process: bool, fast: bool
) -> Pose | None:
    from cdpr.cli.named_bus import require_own_time
    from cdpr.document_types import millimetres
    from cdpr.errors import BadInput
    from cdpr.poses import Pose

    require_own_time(fast, in_process)
    if start_mm is None:
        return None
    if not in_process:
        raise BadInput(
            "only a platform that is simulated in this process can be placed",
            where="--simulated-start-mm",
            next_step="leave it out, or use the interface 'virtual'",
        )
    return Pose.level(millimetres(list(start_mm)))
