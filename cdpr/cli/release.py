"""`cdpr release`: the end of a day; brakes close and the torque goes, of all drives together."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cdpr.cli.calibrations import CalibrationOption
from cdpr.cli.motion_options import ChannelOption, InterfaceOption, WithoutRealTimeOption

if TYPE_CHECKING:
    from cdpr.rig import Rig
    from drivers.drive_group import CycleStatus
    from executor.custody import Custody
    from executor.real_time_job import ReadyDrives
    from executor.wishes import WishBoard

#: By what the reference is lost where no brake holds the drums.
_RELEASED = "the drives were released by the operator, and no brake holds the cables"


def release(
    rig: Annotated[Path, typer.Argument(help="rig file (YAML)", metavar="RIG")],
    interface: InterfaceOption = None,
    channel: ChannelOption = None,
    calibration: CalibrationOption = None,
    yes: Annotated[bool, typer.Option("--yes", help="do not ask")] = False,
    without_real_time: WithoutRealTimeOption = False,
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
    kept = reference_text(reference_told(custody))
    facts = [
        ("rig", the_rig.name),
        ("bus", str(BusSettings.of(the_rig))),
        ("afterwards", "the brakes hold the drums" if braked else "nothing holds the cables"),
        ("reference", kept if braked else "given up: `cdpr home` before the next motion"),
    ]
    show_and_ask(
        partial(show_facts, "ready to take the torque off", facts),
        "Does the platform stand on something, so that no cable carries it?",
        "the drives hold as before",
        asks=not yes,
        as_json=as_json,
    )
    status = _released(the_rig, custody, without_real_time)
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


def _released(rig: Rig, custody: Custody, without_real_time: bool) -> CycleStatus:
    """The drives' last word, without torque.

    Raises:
        StoppedByOperator: The operator stopped it.
        CdprError: They could not be set up, or were not released; then a fault is latched.
    """
    from functools import partial

    from cdpr.cli.drives import open_drives
    from cdpr.errors import CdprError, StoppedByOperator
    from cdpr.scene import nothing_in_the_way
    from executor.arming import require_capabilities
    from executor.command_server import serving
    from executor.machine import State
    from executor.running import announced, stop_requests
    from executor.status import WinchStatus
    from executor.unreferenced import set_up_here
    from executor.wishes import OwnBoard

    board = OwnBoard()
    told = WinchStatus(rig, board, simulated_time=False)
    load = nothing_in_the_way(rig).load
    with (
        stop_requests(board),
        announced() as listeners,
        serving(listeners, board, told),
        open_drives(rig, rig.home, load, set_up_as=partial(set_up_here, rig)) as drives,
    ):
        require_capabilities(drives.group.capabilities, rig.document.bus.cycle_ms / 1000.0)
        stands = drives.group.read_positions().positions.tolist()
        if board.read().stop:
            raise StoppedByOperator("stopped before anything was released; the drives hold")
        told.take_release()
        try:
            status = _in_custody(rig, custody, drives, stands, board, without_real_time)
        except CdprError as error:
            told.take_end(State.LATCHED, error.what)
            raise
        told.take_end(State.FINISHED, "")
        return status


def _in_custody(
    rig: Rig,
    custody: Custody,
    drives: ReadyDrives,
    stands: Sequence[int],
    board: WishBoard,
    without_real_time: bool,
) -> CycleStatus:
    """Takes the torque off; what becomes of the bus and the reference is kept."""
    from cdpr.cli.output import err
    from cdpr.errors import CdprError, Refused
    from executor.clock import RealClock
    from executor.machine import State
    from executor.realtime import real_time, require_real_time
    from executor.torque_off import take_torque_off

    record = custody.file.path.parent
    clock = RealClock(rig.document.bus.cycle_ms / 1000.0)
    with real_time() as denied:
        require_real_time(denied, needed=not without_real_time)
        if denied:
            err.print(f"[yellow]remark[/] {denied}", soft_wrap=True)
        custody.begin(record, custody.still_counts(stands))
        try:
            status = take_torque_off(rig, drives.group, clock, lambda: board.read().stop)
        except Refused:  # nothing was enabled
            custody.prevented()
            raise
        except BaseException as error:
            what = error.what if isinstance(error, CdprError) else "the program was ended"
            cause = f"the drives were being released: {what}"
            custody.end(State.LATCHED, cause, record, holding=False, stands_at=None)
            raise
    custody.end(
        State.FINISHED,
        "",
        record,
        holding=_braked(rig),
        stands_at=status.positions.tolist(),
        let_go=_RELEASED,
    )
    return status
