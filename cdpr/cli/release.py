"""`cdpr release`: the end of a day; brakes close and the torque goes, of all drives together."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cdpr.cli.calibrations import CalibrationOption
from cdpr.cli.motion_options import ChannelOption, InterfaceOption

if TYPE_CHECKING:
    from cdpr.rig import Rig
    from drivers.drive_group import CycleStatus
    from executor.custody import Custody
    from executor.real_time_job import ReadyDrives

#: All drives must be without torque within so many seconds.
WITHIN_S = 3.0
_RELEASED = "released by the operator"


def release(
    rig: Annotated[Path, typer.Argument(help="rig file (YAML)", metavar="RIG")],
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    calibration: CalibrationOption = None,
    yes: Annotated[bool, typer.Option("--yes", help="do not ask")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="print the result as JSON")] = False,
) -> None:
    """End the day: with the platform on a support, close the brakes and take the torque off.

    All drives together; set-points move nothing. Winches without brakes let their cables go, so
    that the drives have to be referenced again.

    [dim]Example:[/dim]

      cdpr release configs/gachon_8_6.yaml --interface socketcan --channel can0
    """
    from functools import partial

    from cdpr.cli.calibrations import calibrated_rig
    from cdpr.cli.carry_out import show_and_ask
    from cdpr.cli.named_bus import require_other_process, rig_on_bus
    from cdpr.cli.output import out, show_facts, show_json
    from cdpr.cli.reference_facts import reference_text, reference_told
    from drivers.bus import BusSettings
    from drivers.drive_group import drive_states
    from executor.custody import Custody

    the_rig = calibrated_rig(rig_on_bus(rig, interface, channel), calibration)
    require_other_process(the_rig)
    custody = Custody(the_rig)
    custody.require_free()
    braked = _braked(the_rig)
    facts = [
        ("rig", the_rig.name),
        ("bus", str(BusSettings.of(the_rig))),
        ("afterwards", "the brakes hold the drums" if braked else "nothing holds the cables"),
        ("reference", "as it is" if braked else "given up: `cdpr home` before the next motion"),
    ]
    show_and_ask(
        partial(show_facts, "ready to take the torque off", facts),
        "Does the platform stand on something, so that no cable carries it?",
        "the drives hold as before",
        asks=not yes,
        as_json=as_json,
    )
    status = _released(the_rig, custody)
    stands = status.positions.tolist()
    told: dict[str, Any] = {
        "drives": list(drive_states(the_rig, status.status_words.tolist())),
        "reference": reference_told(custody, stands),
    }
    if as_json:
        show_json(told)
        return
    out.print(f"no drive has torque any more: {', '.join(sorted(set(told['drives'])))}")
    out.print(f"reference: {reference_text(told['reference'])}", soft_wrap=True, markup=False)


def _braked(rig: Rig) -> bool:
    return all(winch.brake for winch in rig.winches)


def _released(rig: Rig, custody: Custody) -> CycleStatus:
    """The drives' last word, without torque.

    Raises:
        CdprError: They could not be set up, or were not released; then a fault is latched.
    """
    from functools import partial

    from cdpr.cli.drives import open_drives
    from cdpr.scene import nothing_in_the_way
    from executor.machine import State
    from executor.winch_motion import set_up_here

    load = nothing_in_the_way(rig).load
    with open_drives(rig, rig.home, load, set_up_as=partial(set_up_here, rig)) as drives:
        stands = drives.group.read_positions().positions.tolist()
        record = custody.file.path.parent
        custody.begin(record, custody.still_counts(stands))
        try:
            status = _cycled(rig, drives)
        except BaseException as error:
            cause = f"the drives were being released: {str(error) or type(error).__name__}"
            custody.end(State.LATCHED, cause, record, holding=False, stands_at=None)
            raise
        custody.end(
            State.FINISHED,
            _RELEASED,
            record,
            holding=_braked(rig),
            stands_at=status.positions.tolist(),
        )
    return status


def _cycled(rig: Rig, drives: ReadyDrives) -> CycleStatus:
    """Lets the group go its way, cycle by cycle.

    Raises:
        Fault: It did not come to its end.
    """
    from cdpr.errors import Fault
    from drivers.drive_group import GroupCommand, GroupState
    from executor.clock import RealClock
    from executor.realtime import real_time

    group, cycle = drives.group, rig.document.bus.cycle_ms / 1000.0
    clock = RealClock(cycle)
    with real_time():
        group.command(GroupCommand.RELEASE)
        for _ in range(round(WITHIN_S / cycle)):
            clock.next_cycle()
            group.send_cycle(group.targets.tolist())
            status = group.receive(clock.time_left())
            if status.state is GroupState.RELEASED:
                return status
            if status.state is GroupState.FAULT:
                break
    group.quick_stop_now()
    told = "; ".join(text for _, text in status.faults)
    raise Fault(
        told or f"the drives were not without torque within {WITHIN_S:g} s",
        where="release",
        why="a drive did not go the way of all; those under torque hold",
        next_step="look at the drives, then `cdpr reset RIG`; where none can be released, cut the"
        " motor power with the emergency stop once the platform is supported",
    )
