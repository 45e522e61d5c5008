"""`cdpr reset`: the only way out of a latched fault."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cdpr.cli.calibrations import CalibrationOption
from cdpr.cli.motion_options import ChannelOption, InterfaceOption

if TYPE_CHECKING:
    from cdpr.rig import Rig

#: Cycles in which a drive leaves its fault, and the others are seen to hold.
SETTLING_CYCLES = 30


def reset(
    rig: Annotated[Path, typer.Argument(help="rig file (YAML)", metavar="RIG")],
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    calibration: CalibrationOption = None,
    yes: Annotated[bool, typer.Option("--yes", help="do not ask")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="print the result as JSON")] = False,
) -> None:
    """Take a latched fault off, after its cause is gone: resets drives in fault; moves nothing.

    Drives that hold keep holding. A drive in fault is not reset while others hold the platform.
    Afterwards a run starts only from where the platform stands.

    [dim]Example:[/dim]

      cdpr reset configs/gachon_8_6.yaml --interface socketcan --channel can0
    """
    from cdpr.cli.calibrations import calibrated_rig
    from cdpr.cli.carry_out import show_and_ask
    from cdpr.cli.named_bus import require_other_process, rig_on_bus
    from cdpr.cli.output import out, show_json
    from cdpr.cli.reference_facts import reference_text
    from drivers.bus import BusSettings
    from executor.latch import Latch

    the_rig = calibrated_rig(rig_on_bus(rig, interface, channel), calibration)
    require_other_process(the_rig)
    bus = BusSettings.of(the_rig)
    latch = Latch(bus)
    latched = latch.read()
    latch.require_no_run()
    cause = f"latched since {latched.since}: {latched.cause}" if latched else "no fault latched"
    show_and_ask(
        lambda on: on.print(f"bus {bus}: {cause}", soft_wrap=True, markup=False),
        "Is the cause gone and the platform safe?",
        "nothing was reset",
        asks=not yes,
        as_json=as_json,
    )
    with latch.held_for_reset(the_rig.name, latched):
        told = _drives_reset(the_rig)
    if as_json:
        cause_before = latched.cause if latched else None
        show_json({"was_latched": latched is not None, "cause": cause_before, **told})
        return
    out.print(f"drives: {', '.join(sorted(set(told['drives'])))}", soft_wrap=True)
    if told["restarted"]:
        names = ", ".join(the_rig.drive_names[node] for node in told["restarted"])
        out.print(f"switched on since they were last set up: {names}", soft_wrap=True)
    out.print(f"reference: {reference_text(told['reference'])}", soft_wrap=True, markup=False)
    latch_now = "the latch is off" if latched else "nothing was latched"
    out.print(f"{latch_now}; the next run starts only from where the platform stands now")


def _drives_reset(rig: Rig) -> dict[str, Any]:
    """Sets the drives up, resets those in fault.

    Returns:
        ``drives``, the state of each afterwards; ``restarted``, nodes that were found without their
        set-up; ``reference``, see `reference_told`.

    Where all held all the while, as after a program that was killed, their reference still counts
    from where they stand.

    Raises:
        CdprError: A drive does not answer, may not be reset now, or stays in fault.
    """
    from functools import partial

    from cdpr.cli.drives import open_drives
    from cdpr.cli.reference_facts import reference_told
    from cdpr.errors import Fault
    from cdpr.scene import nothing_in_the_way
    from drivers.drive_group import GroupCommand, GroupState, drive_states
    from executor.clock import RealClock
    from executor.custody import Custody
    from executor.silence import Silence
    from executor.unreferenced import set_up_here

    clock = RealClock(rig.document.bus.cycle_ms / 1000.0)
    load = nothing_in_the_way(rig).load
    with open_drives(
        rig, rig.home, load, to_reset=True, set_up_as=partial(set_up_here, rig)
    ) as drives:
        group = drives.group
        status = group.read_positions()
        if status.state is GroupState.FAULT:
            group.command(GroupCommand.RESET_FAULT)
        silence, held = Silence(rig), status.holding
        for _ in range(SETTLING_CYCLES):
            clock.next_cycle()
            group.send_cycle(status.positions.tolist())
            status = group.receive(clock.time_left())
            silence.take(status)
            held = held and status.holding
        if status.state is GroupState.FAULT:
            raise Fault(
                "; ".join(text for _, text in status.faults),
                where="reset",
                why="the cause is still there",
                next_step="remove it, then reset again; the latch stays engaged",
            )
        silence.require_none(
            "while the drives settled",
            where="reset",
            why="it lost power or the bus since it was set up",
            next_step="check power and wiring, then reset again; the latch stays engaged",
        )
        custody, stands = Custody(rig), status.positions.tolist()
        if held and not drives.restarted:
            custody.found_held(stands)
        return {
            "drives": list(drive_states(rig, status.status_words.tolist())),
            "restarted": list(drives.restarted),
            "reference": reference_told(custody, stands),
        }
