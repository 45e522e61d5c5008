"""`cdpr sim`: the drives of a rig, simulated in a process of their own."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cdpr.cli.calibrations import CalibrationOption
from cdpr.cli.motion_options import ChannelOption, InterfaceOption

if TYPE_CHECKING:
    from cdpr.poses import Pose
    from cdpr.rig import Rig
    from cdpr.scene import Load


def sim(
    rig: Annotated[Path, typer.Argument(help="rig file (YAML)", metavar="RIG")],
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    start_mm: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--at-mm", help="where the platform stands: x y z (default: home)"),
    ] = None,
    power_lost: Annotated[
        int | None,
        typer.Option(
            "--power-lost", help="drives count from anywhere, cables hang slack: a seed", min=0
        ),
    ] = None,
    slack_mm: Annotated[
        float, typer.Option(min=0.0, max=100.0, help="with --power-lost: at most so slack")
    ] = 5.0,
    on_a_stand: Annotated[
        bool,
        typer.Option("--on-a-stand", help="with --power-lost: held until all cables are taut"),
    ] = False,
    plan: Annotated[
        Path | None, typer.Option(help="put the platform at the start of this plan, with its load")
    ] = None,
    calibration: CalibrationOption = None,
) -> None:
    """Simulate the drives and the platform of a rig on a bus, in real time, until Ctrl-C.

    [dim]Examples:[/dim]

      cdpr sim configs/gachon_8_6.yaml --interface udp_multicast --channel 239.74.163.2
      --plan plan.json

      cdpr run plan.json --rig configs/gachon_8_6.yaml --interface udp_multicast
      --channel 239.74.163.2 --no-camera -o runs/udp --yes
      --without-real-time
    """
    from cdpr.cli.calibrations import calibrated_rig
    from cdpr.cli.named_bus import rig_on_bus
    from cdpr.cli.output import err, out
    from cdpr.errors import BadInput
    from drivers.bus import IN_PROCESS, BusSettings, open_bus
    from executor.realtime import real_time
    from executor.running import stop_requests
    from executor.wishes import OwnBoard
    from simulation.power_loss import PowerLoss
    from simulation.simulate import make_rehearsal

    the_rig = calibrated_rig(rig_on_bus(rig, interface, channel), calibration)
    if the_rig.document.bus.interface == IN_PROCESS:
        raise BadInput(
            "the interface 'virtual' reaches no other process",
            where="bus",
            why="`cdpr run` simulates the drives itself on that interface",
            next_step="pass --interface udp_multicast, or socketcan with a vcan channel",
        )
    pose, load = _start(the_rig, start_mm, plan)
    bus = open_bus(BusSettings.of(the_rig))
    try:
        rehearsal = make_rehearsal(the_rig, bus, pose, load)
        if power_lost is not None:
            loss = PowerLoss.drawn(the_rig, power_lost, slack_mm / 1000.0, on_a_stand=on_a_stand)
            loss.happen_to(the_rig, rehearsal.plant, [d.motor for d in rehearsal.drives])
        x, y, z = rehearsal.pose.position * 1000.0
        out.print(
            f"{the_rig.cable_count} simulated drives of {the_rig.name} on"
            f" {BusSettings.of(the_rig)}; platform at {x:.1f}, {y:.1f}, {z:.1f} mm; Ctrl-C ends it",
            soft_wrap=True,
        )
        board = OwnBoard()
        with stop_requests(board), real_time() as denied:
            if denied:
                err.print(f"[yellow]remark[/] {denied}", soft_wrap=True)
            rehearsal.serve(lambda: board.read().stop)
    finally:
        bus.shutdown()
    out.print("the simulated drives are gone")


def _start(
    rig: Rig, start_mm: tuple[float, float, float] | None, plan: Path | None
) -> tuple[Pose, Load | None]:
    """Where the platform stands, and what it carries."""
    from cdpr.cli.plan_for_rig import require_same_rig
    from cdpr.document_types import millimetres
    from cdpr.errors import BadInput
    from cdpr.plan import load_plan
    from cdpr.poses import Pose

    if start_mm is not None and plan is not None:
        raise BadInput(
            "--at-mm and --plan contradict each other", next_step="leave one of them out"
        )
    if plan is not None:
        the_plan = load_plan(plan)
        require_same_rig(the_plan, rig, plan)
        scene = the_plan.scene
        return scene.start, scene.load
    return (rig.home if start_mm is None else Pose.level(millimetres(list(start_mm)))), None
