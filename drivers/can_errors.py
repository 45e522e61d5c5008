"""What can be wrong with a bus while it is used, each with a name, its causes and the next step."""

from __future__ import annotations

import errno
from collections.abc import Sequence
from enum import IntFlag
from typing import ClassVar

from model.errors import Fault, Refused


class BusFault(Fault):
    """The bus itself fails; the drives stop by themselves when they miss the master."""

    code = "bus_failed"
    cause: ClassVar[str] = "the adapter or its driver reported an error"
    remedy: ClassVar[str] = "check adapter, cable and termination, then start again"

    def __init__(self, what: str, where: str, values: dict[str, float | str] | None = None) -> None:
        """Takes what was seen and on which bus."""
        step = f"the drives stop on their own; {self.remedy}"
        super().__init__(what, where=where, why=self.cause, next_step=step, values=values)


class BusDown(BusFault):
    """The network interface was taken down."""

    code = "bus_down"
    cause = "the interface was set down by a user, or by its driver after an error"
    remedy = "bring it up again (`cdpr doctor RIG` shows how), then start again"


class BusGone(BusFault):
    """The network interface is not there any more."""

    code = "bus_gone"
    cause = "the adapter was unplugged or lost its power"
    remedy = "plug it in, bring the interface up (`cdpr doctor RIG` shows how), then start again"


class BusOff(BusFault):
    """The controller has left the bus after too many errors of its own frames."""

    code = "bus_off"
    cause = "a short circuit, a wrong bit rate, or missing termination"
    remedy = "measure 60 ohm between CAN-H and CAN-L, compare the bit rates, then start again"


class BusPassive(BusFault):
    """The controller's error counter is too high to signal errors any longer."""

    code = "bus_passive"
    cause = "no node acknowledges frames (drives without power, broken cable), or a wrong bit rate"
    remedy = "check the drives' power, cable, termination and bit rate, then start again"


class BusErrors(BusFault):
    """Error frames cycle after cycle."""

    code = "bus_errors"
    cause = "a loose contact, missing termination, interference, or a cable that is too long"
    remedy = "check cable and termination, then start again"


class TransmitQueueFull(BusFault):
    """A frame was not taken because others still wait; sent late, a set-point is wrong."""

    code = "transmit_queue_full"
    cause = "no node acknowledges frames, the bus is overloaded, or txqueuelen is too short"
    remedy = "check the drives' power and the cable; `cdpr doctor RIG` checks the queue"


class ReceiveOverflow(BusFault):
    """Frames were lost because they were not fetched in time."""

    code = "receive_overflow"
    cause = "this program was delayed, or another node floods the bus"
    remedy = "run with real-time scheduling and close other programs (`cdpr doctor RIG`)"


class ForeignMaster(BusFault):
    """Another program commands drives on this bus."""

    code = "foreign_master"
    cause = "two masters must not command the same drives"
    remedy = "end the other program, or wait for its run to finish"


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


# Error frames of CAN controllers: what they mean, and when one ends a run. Pure.
#
# Source: Linux, include/uapi/linux/can/error.h. Other back ends of python-can mark a message as an
# error frame without stating the class; it then counts as an error on the bus.


ERROR_CYCLES = 10
"""Cycles in a row with error frames that are one too many: frames are repeated, and a stop with
them."""


class ErrorClass(IntFlag):
    """What an error frame is about; in its identifier."""

    CONTROLLER = 0x04
    BUS_OFF = 0x40


class ControllerState(IntFlag):
    """Of the controller; in the second byte of an error frame of class CONTROLLER."""

    RECEIVE_OVERFLOW = 0x01
    RECEIVE_PASSIVE = 0x10
    TRANSMIT_PASSIVE = 0x20


def error_frame_fault(identifier: int, data: bytes | bytearray, where: str) -> BusFault | None:
    """The fault that one error frame reports; None for an error that the controller recovers from.

    Args:
        identifier: Of the error frame, without its flags.
        data: Its eight bytes, or none.
        where: The bus.
    """
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
    """Error frames of a bus, counted cycle by cycle.

    Attributes:
        total: All that came.
    """

    def __init__(self, where: str) -> None:
        """Takes the bus as messages name it."""
        self.total = 0
        self._where = where
        self._now = 0
        self._in_a_row = 0

    def take(self, identifier: int, data: bytes | bytearray) -> BusFault | None:
        """Counts an error frame; returns the fault it reports, if any."""
        self.total += 1
        self._now += 1
        return error_frame_fault(identifier, data, self._where)

    def end_cycle(self) -> BusFault | None:
        """Closes a cycle; a fault when errors do not cease."""
        self._in_a_row = self._in_a_row + 1 if self._now else 0
        self._now = 0
        if self._in_a_row < ERROR_CYCLES:
            return None
        what = f"error frames in {self._in_a_row} cycles in a row, {self.total} in all"
        return BusErrors(what, self._where, {"error_frames": self.total})


# Why drives are not set up, whatever they speak.


SETTING_UP = "configuring the drives"


def answers_twice(node: int) -> Refused:
    """Two devices have the node id of a drive."""
    return Refused(
        f"drive {node} answered twice",
        where=SETTING_UP,
        why="two devices have this node id, or `cdpr sim` was started twice",
        next_step="give each device on the bus a unique node id",
        values={"node": node},
    )


def moved_by_another(node: int, what: str, where: str) -> Refused:
    """A drive is not at rest: it is ``what``, as reported in ``where``."""
    return Refused(
        f"drive {node} is {what}",
        where=f"drive {node}, {where}",
        why="another program moves it, or it did not stop when its master was lost",
        next_step="end the other program, or press the emergency stop",
        values={"node": node},
    )


def in_fault(node: int, what: str, where: str, why: str) -> Refused:
    """A drive stopped itself; ``what`` it reports in ``where``, and what that means."""
    return Refused(
        f"drive {node} is in fault{what}",
        where=f"drive {node}, {where}",
        why=why,
        next_step="remove the cause, then run `cdpr reset RIG`",
        values={"node": node},
    )


def keeps_another(node: int, place: str, found: str, wanted: str, why: str, manual: str) -> Refused:
    """A drive does not keep a setting.

    Args:
        node: Of the drive.
        place: Of the setting, such as ``object 6007h:00 abort connection option code``.
        found: What it holds.
        wanted: What it must hold.
        why: What that is needed for.
        manual: Where the setting is described.
    """
    return Refused(
        f"the drive has {found}; {wanted} is required",
        where=f"drive {node}, {place}",
        why=f"required because: {why}",
        next_step=f"see {manual}; the drives were not changed",
        values={"node": node, "object": place, "found": found, "wanted": wanted},
    )


def all_of_them(refusals: Sequence[Refused]) -> Refused:
    """One refusal that says everything that was found, the same of several drives once."""
    nodes: dict[str, list[str]] = {}
    for each in refusals:
        node = str(each.values.get("node", ""))
        place = each.where.removeprefix(f"drive {node}, ")
        why = f" ({each.why})" if each.why else ""
        told = nodes.setdefault(f"{place}: {each.what}{why}", [])
        if node not in told:
            told.append(node)
    drives = {node for each in nodes.values() for node in each}
    if len(nodes) == len(drives) == 1:
        return refusals[0]
    found = "".join(f"\n  drive {', '.join(each)}, {text}" for text, each in nodes.items())
    return Refused(
        f"{len(nodes)} object{'s' if len(nodes) > 1 else ''} of {len(drives)}"
        f" drive{'s' if len(drives) > 1 else ''} have unsuitable values:{found}",
        where=SETTING_UP,
        next_step="compare with the drive's manual; `cdpr doctor RIG --drives` lists every object,"
        " and drives.profile of the rig file describes the drives",
        values={"nodes": ", ".join(sorted(drives)), "count": len(nodes)},
    )
