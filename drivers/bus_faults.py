"""What can be wrong with a bus while it is used, each with a name, its causes and the next step."""

from __future__ import annotations

import errno
from typing import ClassVar

from cdpr.errors import Fault


class BusFault(Fault):
    """The bus itself fails; the drives stop by themselves when they miss the master."""

    code = "bus_failed"
    cause: ClassVar[str] = "the adapter or its driver reported an error"
    remedy: ClassVar[str] = "check adapter, cable and termination, then start again"

    def __init__(self, what: str, where: str, values: dict[str, float | str] | None = None) -> None:
        """Takes what was seen and on which bus."""
        step = f"the drives stop by themselves; {self.remedy}"
        super().__init__(what, where=where, why=self.cause, next_step=step, values=values)


class BusDown(BusFault):
    """The network interface was taken down."""

    code = "bus_down"
    cause = "somebody set the interface down, or its driver did after an error"
    remedy = "bring it up again (`cdpr doctor RIG` tells how), then start again"


class BusGone(BusFault):
    """The network interface is not there any more."""

    code = "bus_gone"
    cause = "the adapter was unplugged or lost its power"
    remedy = "plug it in, bring the interface up (`cdpr doctor RIG` tells how), then start again"


class BusOff(BusFault):
    """The controller has left the bus after too many errors of its own frames."""

    code = "bus_off"
    cause = "a short circuit, a wrong bit rate, or missing termination"
    remedy = "measure 60 ohm between CAN-H and CAN-L, compare the bit rates, then start again"


class BusPassive(BusFault):
    """The controller counts so many errors that it may no longer signal them."""

    code = "bus_passive"
    cause = "nobody acknowledges frames (drives without power, broken cable), or a wrong bit rate"
    remedy = "check the drives' power, cable, termination and bit rate, then start again"


class BusErrors(BusFault):
    """Error frames cycle after cycle."""

    code = "bus_errors"
    cause = "a loose contact, missing termination, interference, or too long a cable"
    remedy = "check cable and termination, then start again"


class TransmitQueueFull(BusFault):
    """A frame was not taken because others still wait; sent late, a set-point is wrong."""

    code = "transmit_queue_full"
    cause = "nobody acknowledges frames, the bus is overloaded, or txqueuelen is too short"
    remedy = "check the drives' power and the cable; `cdpr doctor RIG` looks at the queue"


class ReceiveOverflow(BusFault):
    """Frames were lost because they were not fetched in time."""

    code = "receive_overflow"
    cause = "this program was held up, or something floods the bus"
    remedy = "run with real-time scheduling and nothing else beside it (`cdpr doctor RIG`)"


class ForeignMaster(BusFault):
    """Another program commands drives on this bus."""

    code = "foreign_master"
    cause = "two masters would move the same drives"
    remedy = "end the other program, or wait until its run is over"


SOCKET_FULL = "Transmit buffer full"
"""python-can's words, without a number, for a socket whose frames wait to be sent."""

_BY_NUMBER: dict[int, type[BusFault]] = {
    errno.ENETDOWN: BusDown,
    errno.ENODEV: BusGone,
    errno.ENXIO: BusGone,
    errno.ENOBUFS: TransmitQueueFull,
}


def bus_fault(what: str, where: str, error: Exception) -> BusFault:
    """The fault behind what a back end raised, by its error number where it has one.

    Args:
        what: What was being done.
        where: The bus.
        error: What the back end raised; its number may be in the error that caused it.
    """
    number = getattr(error, "error_code", None) or getattr(error.__cause__, "errno", None)
    if str(error) == SOCKET_FULL:
        number = errno.ENOBUFS
    kind = _BY_NUMBER.get(number, BusFault) if isinstance(number, int) else BusFault
    return kind(f"{what}: {str(error) or type(error).__name__}", where)
