"""Error frames of CAN controllers: what they tell, and when it ends a run. Pure.

Source: Linux, include/uapi/linux/can/error.h. Other back ends of python-can mark a message as an
error frame without telling the class; it then counts as an error on the bus.
"""

from __future__ import annotations

from enum import IntFlag

from drivers.bus_faults import BusErrors, BusFault, BusOff, BusPassive, ReceiveOverflow

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
    """The fault that one error frame tells; None for an error that the controller recovers from.

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
        """Takes in an error frame; the fault it tells, if it tells one."""
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
