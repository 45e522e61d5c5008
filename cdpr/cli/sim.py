"""`cdpr sim`: simulates the drives of a rig in a separate process."""

from __future__ import annotations

from pathlib import Path

import typer

from cdpr.cli.arguments import flag, option
from cdpr.cli.operate.supervision import stop_requests
from cdpr.cli.options import CALIBRATION, CHANNEL, INTERFACE, RIG, Triple, level_pose, rig_on_bus
from cdpr.cli.output import Terminal, out, show_line
from drivers.can_bus import IN_PROCESS, BusSettings
from executor.kernels import ready_to_simulate
from executor.realtime.scheduling import real_time
from executor.supervision import LocalRequests
from model.errors import BadInput
from model.plan import load_plan, require_same_rig
from model.pose import Pose
from model.rig import Rig
from model.scene import Load
from simulation.drives.behaviour import DriveBehaviour, behaviour_named, table
from simulation.factory import check_drives, open_rehearsal
from simulation.ground_truth import PowerLoss


def sim(
    *,
    rig: Path = RIG,
    interface: str | None = INTERFACE,
    channel: str | None = CHANNEL,
    start_mm: Triple | None = option(
        "initial position of the platform x y z (default: home)", "--at-mm"
    ),
    power_lost: int | None = option(
        "simulate a power loss (lost counts, slack cables) with this random seed", min=0
    ),
    slack_mm: float | None = option(
        "with --power-lost: largest slack (default: 5)", min=0.0, max=100.0
    ),
    on_a_stand: bool = flag("with --power-lost: platform supported until all cables are taut"),
    plan: Path | None = option("start the platform at the start of this plan, with its load"),
    eds: Path | None = option(
        "EDS file of the simulated drives, such as their maker's (default: that of the rig"
        " file's drive profile)"
    ),
    drive_behaviour: list[str] | None = option(
        "deviation of the drives from strict CiA 402, repeatable; 'list' shows all",
        metavar="NAME[=VALUE]",
    ),
    calibration: list[Path] | None = CALIBRATION,
) -> None:
    """Simulate the drives and the platform of a rig on a bus, in real time, until Ctrl-C.

    Examples:
      cdpr sim configs/gachon_8_6.yaml --interface udp_multicast --channel 239.74.163.2
          --plan plan.json

    In another terminal:
      cdpr run plan.json --rig configs/gachon_8_6.yaml --interface udp_multicast
          --channel 239.74.163.2 --no-camera -o runs/udp --yes
          --without-real-time
    """
    if power_lost is None and (slack_mm is not None or on_a_stand):
        raise BadInput(
            "--slack-mm and --on-a-stand describe the state after a power loss",
            where="command line",
            next_step="pass --power-lost SEED as well, or leave them out",
        )
    behaviour = _behaviour(drive_behaviour or [])
    the_rig = rig_on_bus(rig, interface, channel, calibration)
    if the_rig.document.bus.interface == IN_PROCESS:
        raise BadInput(
            "the interface 'virtual' cannot reach another process",
            where="bus",
            why="`cdpr run` simulates the drives itself on that interface",
            next_step="pass --interface udp_multicast, or socketcan with a vcan channel",
        )
    check_drives(the_rig, behaviour, eds)
    pose, load = _start(the_rig, start_mm, plan)
    lost_power = None
    if power_lost is not None:
        slack = 0.005 if slack_mm is None else slack_mm / 1000.0
        lost_power = PowerLoss.drawn(the_rig, power_lost, slack, on_a_stand=on_a_stand)
    listener, board = Terminal(), LocalRequests()
    ready_to_simulate(listener)
    with open_rehearsal(
        the_rig, pose, load, lost_power=lost_power, behaviour=behaviour, eds=eds
    ) as rehearsal:
        x, y, z = rehearsal.pose.position * 1000.0
        show_line(
            f"{the_rig.cable_count} simulated drives of {the_rig.name} on"
            f" {BusSettings.of(the_rig)}; platform at {x:z.1f}, {y:z.1f}, {z:z.1f} mm;"
            " Ctrl-C ends the simulation"
        )
        with stop_requests(board), real_time() as denied:
            if denied:
                listener.remark(denied)
            rehearsal.serve(lambda: board.read().stop)
    out.print("simulation ended")


def _behaviour(names: list[str]) -> DriveBehaviour:
    """Behaviour of the simulated drives; ``list`` prints all names and exits."""
    if "list" in names:
        width = max(len(name) for name, _ in table())
        for name, text in table():
            out.print(f"{name:<{width}}  {text}", soft_wrap=True, markup=False, highlight=False)
        raise typer.Exit
    return behaviour_named(names)


def _start(rig: Rig, start_mm: Triple | None, plan: Path | None) -> tuple[Pose | None, Load | None]:
    """The platform's initial pose (None: home), and its load."""
    if start_mm is not None and plan is not None:
        raise BadInput(
            "--at-mm and --plan contradict each other", next_step="leave out one of them"
        )
    if plan is not None:
        the_plan = load_plan(plan)
        require_same_rig(the_plan, rig, plan)
        scene = the_plan.scene
        return scene.start, scene.load
    return level_pose(start_mm), None
