"""Faults of a bus in use, each with a code, its likely cause and the next step."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntFlag
from typing import ClassVar

import can
from can.interfaces.socketcan import SocketcanBus
from can.interfaces.udp_multicast import UdpMulticastBus
from can.interfaces.virtual import VirtualBus

from drivers.setup_refusals import SETTING_UP
from model.errors import Fault, HardwareMissing, Refused


class BusFault(Fault):
    """The bus failed; the drives stop on their own when they lose the master."""

    code = "bus_failed"
    cause: ClassVar[str] = "the adapter or its driver reported an error"
    remedy: ClassVar[str] = "check adapter, cable and termination, then start again"

    def __init__(self, what: str, where: str, values: dict[str, float | str] | None = None) -> None:
        """Takes the symptom and the bus."""
        step = f"the drives stop on their own; {self.remedy}"
        super().__init__(what, where=where, why=self.cause, next_step=step, values=values)


class BusDown(BusFault):
    """The network interface was taken down."""

    code = "bus_down"
    cause = "a user took the interface down, or its driver did after an error"
    remedy = "bring it up again (`cdpr doctor RIG` shows how), then start again"


class BusGone(BusFault):
    """The network interface has disappeared."""

    code = "bus_gone"
    cause = "the adapter was unplugged or lost its power"
    remedy = "plug it in, bring the interface up (`cdpr doctor RIG` shows how), then start again"


class BusOff(BusFault):
    """The controller left the bus after too many transmit errors."""

    code = "bus_off"
    cause = "a short circuit, a wrong bit rate, or missing termination"
    remedy = (
        "measure 60 ohm between CAN-H and CAN-L, compare the bit rates, take the interface down and"
        " up (`cdpr doctor RIG` shows how), then start again"
    )


class BusPassive(BusFault):
    """The controller is error-passive: its error counter exceeds the limit."""

    code = "bus_passive"
    cause = "no node acknowledges frames (drives without power, broken cable), or a wrong bit rate"
    remedy = "check the drives' power, cable, termination and bit rate, then start again"


class BusErrors(BusFault):
    """Error frames in every cycle."""

    code = "bus_errors"
    cause = "a loose contact, missing termination, interference, or a cable that is too long"
    remedy = "check cable and termination, then start again"


class TransmitQueueFull(BusFault):
    """The transmit queue is full; a late set-point would be wrong."""

    code = "transmit_queue_full"
    cause = "no node acknowledges frames, the bus is overloaded, or txqueuelen is too short"
    remedy = "check the drives' power and the cable; `cdpr doctor RIG` checks the queue"


class ReceiveOverflow(BusFault):
    """Received frames were lost because they were not read in time."""

    code = "receive_overflow"
    cause = "this program was delayed, or another node floods the bus"
    remedy = "run with real-time scheduling and close other programs (`cdpr doctor RIG`)"


class ForeignMaster(BusFault):
    """Another program commands drives on this bus."""

    code = "foreign_master"
    cause = "two masters must not command the same drives"
    remedy = "end the other program, or wait for its run to finish"


class OtherMaster(Refused):
    """Another program commanded CiA 402 drives while they were read or configured."""

    def __init__(self, what: str) -> None:
        """Takes its command; no ``node`` in the values, so that the set-up ends at once."""
        why, step = ForeignMaster.cause, ForeignMaster.remedy
        super().__init__(what, where=SETTING_UP, why=why, next_step=step)


@contextmanager
def before_motion() -> Iterator[None]:
    """While no drive is enabled: a failed bus counts as missing hardware, another master refuses.

    Raises:
        BusFault: Of the block, with the exit code of `HardwareMissing` or `Refused`.
    """
    try:
        yield
    except BusFault as fault:
        kind = Refused if isinstance(fault, ForeignMaster) else HardwareMissing
        fault.exit_code = kind.exit_code
        fault.next_step = f"{fault.remedy}; no drive was enabled"
        raise


def bus_text(bus: can.BusABC) -> str:
    """Name of the bus for messages."""
    return f"bus {bus.channel_info}"


SOCKET_FULL = "Transmit buffer full"
"""python-can's message, without an error number, for a full socket."""

_BY_NUMBER: dict[int, type[BusFault]] = {
    errno.ENETDOWN: BusDown,
    errno.ENODEV: BusGone,
    errno.ENXIO: BusGone,
    errno.ENOBUFS: TransmitQueueFull,
}


def bus_fault(what: str, where: str, error: Exception) -> BusFault:
    """The fault for an error of a back end, by its error number if it has one.

    Args:
        what: The operation that failed.
        error: Raised by the back end; its cause may hold the number.
    """
    number = getattr(error, "error_code", None) or getattr(error.__cause__, "errno", None)
    if str(error) == SOCKET_FULL:
        number = errno.ENOBUFS
    kind = _BY_NUMBER.get(number, BusFault) if isinstance(number, int) else BusFault
    return kind(f"{what}: {str(error) or type(error).__name__}", where)


# Distinguishes this master's frames from those of another master. No bus.


class EchoFilter:
    """Counts sent frames, so that their echoes are not taken for another master's frames.

    On a bus with echoes each sent frame excuses one received frame.
    """

    #: Largest number of pending echoes per identifier, which limits the credit of lost frames.
    MOST_CREDIT = 8

    def __init__(self, ids: frozenset[int], *, echoes_own_frames: bool, batch: int = 0) -> None:
        """Starts without a frame sent.

        Args:
            echoes_own_frames: Whether the bus echoes sent frames.
            batch: Largest number of frames of one identifier sent before an echo is read.
        """
        self._ids, self._most = ids, max(self.MOST_CREDIT, batch)
        self._credit: dict[int, int] | None = dict.fromkeys(ids, 0) if echoes_own_frames else None

    def sent(self, can_id: int) -> None:
        """Counts a sent frame."""
        if self._credit is not None and can_id in self._credit:
            self._credit[can_id] = min(self._most, self._credit[can_id] + 1)

    def is_foreign(self, can_id: int) -> bool:
        """Whether a received frame is another master's."""
        if can_id not in self._ids:
            return False
        if self._credit is None:
            return True
        if self._credit[can_id] > 0:
            self._credit[can_id] -= 1
            return False
        return True


# Error frames of CAN controllers: meaning, and when they end a run. Pure.
#
# Source: Linux, include/uapi/linux/can/error.h. Other back ends of python-can give error frames the
# codes of their makers, such as 4 for a stuff error (PCAN-Basic); these count as errors on the bus.

WITH_CLASSES = (SocketcanBus, UdpMulticastBus, VirtualBus)
"""SocketCAN, and the buses between programs, which carry its frames."""

ERROR_CYCLES = 10
"""Consecutive cycles with error frames that end a run: retransmissions would delay a stop."""


class ErrorClass(IntFlag):
    """Class of an error frame, in its identifier."""

    LOST_ARBITRATION = 0x02
    CONTROLLER = 0x04
    BUS_OFF = 0x40


class ControllerState(IntFlag):
    """State of the controller, in the second byte of an error frame of class CONTROLLER."""

    RECEIVE_OVERFLOW = 0x01
    RECEIVE_PASSIVE = 0x10
    TRANSMIT_PASSIVE = 0x20


def error_frame_fault(bus: can.BusABC, frame: can.Message) -> BusFault | None:
    """The fault reported by an error frame; None if the controller recovers on its own.

    Args:
        bus: That gave the frame.
        frame: The error frame, with eight data bytes or none.
    """
    if not isinstance(bus, WITH_CLASSES):
        return None
    identifier, data, where = frame.arbitration_id, frame.data, bus_text(bus)
    if identifier & ErrorClass.BUS_OFF:
        return BusOff("the controller went bus-off", where)
    if not identifier & ErrorClass.CONTROLLER or len(data) < 2:
        return None
    if data[1] & ControllerState.RECEIVE_OVERFLOW:
        return ReceiveOverflow("the controller lost received frames", where)
    if data[1] & (ControllerState.RECEIVE_PASSIVE | ControllerState.TRANSMIT_PASSIVE):
        return BusPassive("the controller is error-passive", where)
    return None


class ErrorFrames:
    """Counts the error frames of a bus per cycle.

    Attributes:
        total: Number of all error frames.
    """

    def __init__(self, bus: can.BusABC) -> None:
        self.total = 0
        self._bus = bus
        self._now = 0
        self._in_a_row = 0

    def take(self, frame: can.Message) -> BusFault | None:
        """Counts an error frame; returns the fault it reports, if any.

        Lost arbitration is no error: the frame waits for one of higher priority.
        """
        lost = frame.arbitration_id == ErrorClass.LOST_ARBITRATION
        if lost and isinstance(self._bus, WITH_CLASSES):
            return None
        self.total += 1
        self._now += 1
        return error_frame_fault(self._bus, frame)

    def end_cycle(self) -> BusFault | None:
        """Ends a cycle; returns a fault if errors persist."""
        self._in_a_row = self._in_a_row + 1 if self._now else 0
        self._now = 0
        if self._in_a_row < ERROR_CYCLES:
            return None
        what = f"error frames in {self._in_a_row} cycles in a row, {self.total} in all"
        return BusErrors(what, bus_text(self._bus), {"error_frames": self.total})
