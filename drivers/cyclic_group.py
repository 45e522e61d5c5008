"""What groups of drives have in common, whatever their protocol: one thread, one bus, one state."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Protocol

import can

from cdpr.errors import Refused
from cdpr.rig import Rig
from drivers.bus_faults import BusFault
from drivers.cyclic_bus import CyclicBus, Listener
from drivers.drive_group import WHOLE_BUS, CycleStatus, GroupState, Pump
from drivers.set_up_refusals import SETTING_UP


class GroupWatch(Listener, Protocol):
    """The last word of every drive."""

    def end_cycle(self) -> None:
        """A cycle is over."""
        ...


class CyclicGroup(ABC):
    """A group that is sent to and heard once a cycle; see `drivers.drive_group.DriveGroup`.

    What a protocol adds makes `_cyclic` and `_watch` anew with every set-up.
    """

    _cyclic: CyclicBus

    def __init__(self, rig: Rig, bus: can.BusABC, pump: Pump | None) -> None:
        """Takes an open bus and sends nothing yet; arguments as for `make_drive_group`."""
        self._rig, self._bus, self._pump = rig, bus, pump
        self._nodes = tuple(winch.node_id for winch in rig.winches)
        self._state = GroupState.OFFLINE
        self._faults: list[tuple[int, str]] = []

    @property
    @abstractmethod
    def _heard(self) -> GroupWatch:
        """Takes in what the drives send."""

    @abstractmethod
    def _latch(self, found: list[tuple[int, str]]) -> None:
        """Keeps faults; the group stops for good when there are some."""

    @abstractmethod
    def _look_for_faults(self) -> None:
        """What the drives told in this cycle, and is wrong."""

    @abstractmethod
    def _advance(self) -> None:
        """Sees whether the way under way has come to its end, or was not in time."""

    @abstractmethod
    def _status(self) -> CycleStatus:
        """What the drives told in this cycle."""

    @property
    def state(self) -> GroupState:
        """Where the group stands."""
        return self._state

    def receive(self, timeout_s: float) -> CycleStatus:
        """Takes what the drives tell in this cycle; see `DriveGroup.receive`."""
        self._online()
        if self._pump is not None:
            self._pump()
            timeout_s = 0.0
        try:
            self._cyclic.take_replies(self._heard, timeout_s)
            self._cyclic.end_cycle()
        except BusFault as fault:
            self._latch_bus(fault)
            raise
        self._heard.end_cycle()
        self._look_for_faults()
        self._advance()
        return self._status()

    def close(self) -> None:
        """Lets go of the bus without sending anything."""
        self._state = GroupState.OFFLINE

    def _discard_stale(self) -> None:
        """What came too late for its cycle counts for none.

        Raises:
            BusFault: The bus failed; the group is stopped.
        """
        try:
            self._cyclic.discard_stale(self._heard)
        except BusFault as fault:
            self._latch_bus(fault)
            raise

    def _latch_bus(self, fault: BusFault) -> None:
        """A bus that fails stops the group for good, whatever the caller does with the error."""
        self._latch([(WHOLE_BUS, fault.what)])

    def _online(self) -> None:
        if self._state is GroupState.OFFLINE:
            raise Refused(
                "the drives are not set up",
                where="drive group",
                next_step="call configure() first",
            )

    def _refuse_enabled(self) -> None:
        """Drives that follow set-points, or are still to be stopped, are not set up.

        Raises:
            Refused: They do.
        """
        if self._state in (GroupState.ENABLING, GroupState.ENABLED) or self.stopping:
            raise Refused(
                "the drives are enabled; they cannot be set up now",
                where=SETTING_UP,
                next_step="stop them first",
            )

    @property
    @abstractmethod
    def stopping(self) -> bool:
        """A stop is under way that needs more cycles."""

    def _refuse_latched(self, wish: str) -> None:
        """After a fault nothing is done to the drives but stopping and resetting them.

        Raises:
            Refused: A fault is latched.
        """
        if self._state is GroupState.FAULT:
            raise Refused(
                f"cannot {wish}: a fault is latched",
                where="drive group",
                why="; ".join(text for _, text in self._faults),
                next_step="find the cause, then reset the fault",
            )
