"""Takes the torque of all drives off, together; whatever stops that, all are told to stop."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

from cdpr.errors import CdprError, Fault, StoppedByOperator
from cdpr.rig import Rig
from drivers.drive_group import CycleStatus, DriveGroup, GroupCommand, GroupState
from executor.clock import Clock
from executor.silence import Silence

#: All drives must be without torque within so many seconds.
WITHIN_S = 3.0


def take_torque_off(
    rig: Rig, group: DriveGroup, clock: Clock, is_stop_wished: Callable[[], bool]
) -> CycleStatus:
    """Lets the group go its way, cycle by cycle; the drives stand where they stood.

    Args:
        rig: The robot as its drives count.
        group: Its drives, configured, with their positions read.
        clock: Real or simulated.
        is_stop_wished: Whether the operator wants it to end; asked every cycle.

    Returns:
        The drives' last word, without torque.

    Raises:
        Fault: A drive did not go the way of all.
        HardwareMissing: A drive fell silent.
        StoppedByOperator: The operator stopped it.
        Refused: The drives are not to be released; nothing was enabled.
    """
    group.command(GroupCommand.RELEASE)
    try:
        return _cycled(rig, group, clock, is_stop_wished)
    except BaseException:
        _stop(rig, group, clock)
        raise


def _cycles(rig: Rig) -> int:
    return round(WITHIN_S / (rig.document.bus.cycle_ms / 1000.0))


def _cycled(
    rig: Rig, group: DriveGroup, clock: Clock, is_stop_wished: Callable[[], bool]
) -> CycleStatus:
    silence = Silence(rig)
    for _ in range(_cycles(rig)):
        clock.next_cycle()
        if is_stop_wished():
            raise StoppedByOperator(
                "stopped while the torque was being taken off; drives under torque hold, a fault is"
                " latched, and the drives have to be referenced again",
                next_step="look at the drives (`cdpr status RIG`), then `cdpr reset RIG`",
            )
        group.send_cycle(group.targets.tolist())
        status = group.receive(clock.time_left())
        if status.state is GroupState.RELEASED:
            return status
        if status.state is GroupState.FAULT:
            raise _not_released("; ".join(text for _, text in status.faults))
        silence.take(status)
        silence.require_none(
            "while the torque was being taken off",
            where="release",
            why="it lost power or the bus; the others were stopped and hold",
            next_step="check power and wiring, then `cdpr reset RIG`",
        )
    raise _not_released(f"the drives were not without torque within {WITHIN_S:g} s")


def _not_released(what: str) -> Fault:
    return Fault(
        what,
        where="release",
        why="a drive did not go the way of all; those under torque hold",
        next_step="look at the drives, then `cdpr reset RIG`; where none can be released, cut the"
        " motor power with the emergency stop once the platform is supported",
    )


def _stop(rig: Rig, group: DriveGroup, clock: Clock) -> None:
    """All are told to stop until every one tells that it follows nothing, or time is over.

    A bus that does not take the stop is no reason to leave off: it is told again the next cycle.
    """
    with suppress(CdprError):
        group.quick_stop_now()
    for _ in range(_cycles(rig)):
        clock.next_cycle()
        with suppress(CdprError):
            group.send_cycle(group.targets.tolist())
            if group.receive(clock.time_left()).stopped and not group.stopping:
                return
