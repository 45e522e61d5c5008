"""`cdpr reset`: the only way out of a latched fault."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from cdpr.rig import Rig
    from executor.latch import Latch, Latched

#: Cycles in which a drive leaves its fault, and the others are seen to hold.
SETTLING_CYCLES = 30


def reset(
    rig: Annotated[Path, typer.Argument(help="rig file (YAML)", metavar="RIG")],
    interface: Annotated[
        str | None, typer.Option(help="python-can interface instead of the rig file's")
    ] = None,
    channel: Annotated[str | None, typer.Option(help="its channel")] = None,
    yes: Annotated[bool, typer.Option("--yes", help="do not ask")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="print the result as JSON")] = False,
) -> None:
    """Release a latched fault, after its cause is gone: resets drives in fault; moves nothing.

    Drives that hold keep holding. A drive in fault is not reset while others hold the platform.
    Afterwards a run starts only from where the platform stands.

    [dim]Example:[/dim]

      cdpr reset configs/gachon_8_6.yaml --interface socketcan --channel can0
    """
    from cdpr.cli.output import out, show_json
    from cdpr.cli.run import ask_operator, rig_on_bus
    from drivers.bus import BusSettings
    from executor.latch import Latch

    the_rig = rig_on_bus(rig, interface, channel)
    _require_bus(the_rig)
    latch = Latch(BusSettings.of(the_rig))
    latched = latch.read()
    _require_nobody_moves(latch, latched)
    if not as_json:
        cause = f"latched since {latched.since}: {latched.cause}" if latched else "no fault latched"
        out.print(f"bus {BusSettings.of(the_rig)}: {cause}", soft_wrap=True, markup=False)
    if not yes:
        ask_operator("Is the cause gone and the platform safe?", "nothing was reset")
    states = _drives_reset(the_rig)
    latch.release()
    if as_json:
        cause_before = latched.cause if latched else None
        show_json({"released": latched is not None, "cause": cause_before, "drives": states})
        return
    out.print(f"drives: {', '.join(sorted(set(states)))}", soft_wrap=True)
    out.print("released; the next run starts only from where the platform stands now")


def _require_bus(rig: Rig) -> None:
    from cdpr.cli.drives import IN_PROCESS
    from cdpr.errors import BadInput

    if rig.document.bus.interface == IN_PROCESS:
        raise BadInput(
            "nothing is latched on the interface 'virtual'",
            where="bus",
            why="its drives are simulated in the process of a run and end with it",
            next_step="name the bus with --interface and --channel",
        )


def _require_nobody_moves(latch: Latch, latched: Latched | None) -> None:
    """A run under way has its own process; its mark is not a fault.

    Raises:
        Refused: It is still there.
    """
    from executor.running import reached_runs

    with reached_runs() as runs:
        if latched is not None and latched.process in {run.process for run in runs}:
            latch.require_released()


def _drives_reset(rig: Rig) -> list[str]:
    """Sets the drives up, resets those in fault; their states afterwards.

    Raises:
        CdprError: A drive does not answer, may not be reset now, or stays in fault.
    """
    from cdpr.cli.drives import open_drives
    from cdpr.errors import Fault
    from cdpr.scene import load_from_document
    from cdpr.scene_file import LoadDocument
    from drivers.drive_group import GroupCommand, GroupState, drive_states
    from executor.clock import RealClock

    clock = RealClock(rig.document.bus.cycle_ms / 1000.0)
    with open_drives(rig, rig.home, load_from_document(LoadDocument()), to_reset=True) as drives:
        group = drives.group
        status = group.read_positions()
        if status.state is GroupState.FAULT:
            group.command(GroupCommand.RESET_FAULT)
        for _ in range(SETTLING_CYCLES):
            clock.next_cycle()
            group.send_cycle(status.positions.tolist())
            status = group.receive(clock.time_left())
        if status.state is GroupState.FAULT:
            raise Fault(
                "; ".join(text for _, text in status.faults),
                where="reset",
                why="the cause is still there",
                next_step="remove it, then reset again; the latch stays engaged",
            )
        return list(drive_states(status.status_words.tolist()))
