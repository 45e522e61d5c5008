"""A whole rig in software: m simulated drives on one bus, and the plant behind them."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import can
import numpy as np

from cdpr.poses import Array, Pose
from cdpr.rig import Rig
from cdpr.scene import Load
from drivers.bus import SentFrame, take, transmit
from drivers.bus_faults import BusDown
from drivers.cia402.frames import (
    HEARTBEAT_BASE,
    MASTER_NODE,
    NMT_ID,
    RPDO1_BASE,
    SDO_REQUEST_BASE,
    SYNC_ID,
)
from drivers.cia402.states import DriveState
from drivers.torque import winding_signs
from simulation.drive import Frame, SimulatedDrive
from simulation.plant import Plant

TOP_SPEED_RESERVE = 1.5
"""A simulated motor turns this much faster than its winch's speed limit."""

IDLE_WAIT = 0.005
"""Longest wait for a frame before time-outs of the drives are looked at, [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class RehearsalStatus:
    """What `Rehearsal.serve` tells while it runs.

    Attributes:
        cycles: SYNCs seen.
        states: State of each drive.
        pose: Of the platform, ``world_from_platform``.
        tensions: Shape (m,), [N].
    """

    cycles: int
    states: tuple[DriveState, ...]
    pose: Pose
    tensions: Array


class Rehearsal:
    """Simulated drives and their platform on one end of a CAN bus.

    Attributes:
        drives: In the order of the winches.
        plant: What they move.
        cycles: SYNCs seen.
    """

    def __init__(
        self, rig: Rig, bus: can.BusABC, start_pose: Pose, load: Load | None = None
    ) -> None:
        """Switches the drives on with the platform hanging at a pose under working tensions.

        Args:
            rig: The robot.
            bus: An open bus for the drives; the caller's.
            start_pose: ``world_from_platform``.
            load: What the platform carries.

        Raises:
            TensionInfeasible: The cables cannot hold the platform there.
            Fault: The bus did not take the drives' first frames.
        """
        self._rig, self._bus = rig, bus
        self._cycle = rig.document.bus.cycle_ms / 1000.0
        self.plant = Plant(rig, start_pose, load)
        self.cycles = 0
        rated = [w.torque_constant for w in rig.winches]
        self._per_newton = winding_signs(rig) * 1000.0 / np.array(rated)
        self._counts = np.rint(self.plant.counts_for(start_pose, self.plant.tensions))
        self.plant.settle_counts(self._counts)
        self.drives: tuple[SimulatedDrive, ...] = ()
        self.drives = tuple(
            SimulatedDrive(
                winch.node_id,
                float(counts),
                TOP_SPEED_RESERVE * winch.max_speed * abs(winch.counts_per_metre),
                self._send,
            )
            for winch, counts in zip(rig.winches, self._counts, strict=True)
        )
        self._handlers = self._routes()
        self._cyclic = {SYNC_ID, *(RPDO1_BASE + drive.node for drive in self.drives)}
        self._begun = False

    @property
    def pose(self) -> Pose:
        """Where the platform truly is, ``world_from_platform``."""
        self._settle()
        return self.plant.pose

    @property
    def tensions(self) -> Array:
        """Of the cables, shape (m,), [N]."""
        self._settle()
        return self.plant.tensions

    def carry(self, load: Load) -> None:
        """The platform carries something else from now on.

        Raises:
            Fault: The platform has no equilibrium with it.
        """
        self._settle()
        self.plant.carry(load)

    def pump(self) -> None:
        """Works off every frame that waits, and answers; each cycle of the master lets one pass.

        A cycle begins with the first of its set-points, or with its SYNC where none came.

        Raises:
            Fault: The bus failed, or the platform has no equilibrium.
        """
        while (message := take(self._bus, 0.0)) is not None:
            if message.arbitration_id in self._cyclic and not self._begun:
                self._advance(self._cycle)
                self._begun = True
            self._begun = self._begun and message.arbitration_id != SYNC_ID
            self._handle(message)

    def advance(self, seconds: float) -> None:
        """Lets time pass without a SYNC, in cycles at most: time-outs run, motors move."""
        while seconds > 1e-12:
            step = min(seconds, self._cycle)
            self._advance(step)
            seconds -= step

    def serve(
        self,
        stop_requested: Callable[[], bool],
        on_status: Callable[[RehearsalStatus], None] | None = None,
        *,
        status_period: float = 0.5,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Answers in real time until told to stop or interrupted from the keyboard.

        As in a real drive, time is locked to SYNC: one cycle passes from one to the next, however
        they jitter, and more only while none comes. When this process is held up, the drives' time
        stands still: they do not blame the master for it. While the interface is down they hear and
        reach nobody, as with their cable pulled, and go on when it is up again.

        Args:
            stop_requested: Asked every few milliseconds; true ends it.
            on_status: Called every ``status_period`` seconds, between two frames.
            status_period: [s].
            clock: Monotonic seconds.

        Raises:
            Fault: The bus failed, or the platform has no equilibrium.
        """
        try:
            self._serve(stop_requested, on_status, status_period, clock)
        except KeyboardInterrupt:
            return

    def status(self) -> RehearsalStatus:
        """Where everything stands."""
        states = tuple(drive.state for drive in self.drives)
        return RehearsalStatus(self.cycles, states, self.pose, self.tensions)

    def _serve(
        self,
        stop_requested: Callable[[], bool],
        on_status: Callable[[RehearsalStatus], None] | None,
        status_period: float,
        clock: Callable[[], float],
    ) -> None:
        last = told = clock()
        passed = 0.0  # of the drives' time since the last SYNC
        while not stop_requested():
            message = self._heard()
            now = clock()
            if message is not None and message.arbitration_id == SYNC_ID:
                self._advance(self._cycle - passed)
                passed, last = 0.0, now
            else:  # time passes whatever else is said on the bus
                waited = min(now - last, self._cycle)
                self._advance(waited)
                passed, last = passed + waited, now
            if message is not None:
                self._handle(message)
            elif on_status is not None and now - told >= status_period:
                told = now
                on_status(self.status())

    def _heard(self) -> can.Message | None:
        """The next frame; none while the interface is down."""
        try:
            return take(self._bus, IDLE_WAIT)
        except BusDown:
            time.sleep(IDLE_WAIT)  # the kernel tells it at once, and time must pass all the same
            return None

    def _routes(self) -> dict[int, Callable[[Frame], None]]:
        """What to do with each identifier."""
        routes: dict[int, Callable[[Frame], None]] = {
            NMT_ID: self._on_nmt,
            SYNC_ID: self._on_sync,
            HEARTBEAT_BASE + MASTER_NODE: lambda data: self._on_heartbeat(MASTER_NODE, data),
        }
        for drive in self.drives:
            routes[RPDO1_BASE + drive.node] = drive.on_set_point
            routes[SDO_REQUEST_BASE + drive.node] = drive.on_sdo
        return routes

    def _handle(self, message: can.Message) -> None:
        if message.is_extended_id or message.is_error_frame or message.is_remote_frame:
            return
        handler = self._handlers.get(message.arbitration_id)
        if handler is not None:
            handler(message.data)

    def _advance(self, elapsed: float) -> None:
        for drive in self.drives:
            drive.advance(elapsed)

    def _on_sync(self, data: Frame) -> None:
        self.cycles += 1
        self._settle()
        torques = self.plant.tensions * self._per_newton
        for drive, torque in zip(self.drives, torques.tolist(), strict=True):
            drive.torque = torque if drive.torque_on else 0.0
        for drive in self.drives:
            drive.on_sync()

    def _settle(self) -> None:
        """The platform goes where the drums let it; nothing to do while none has turned."""
        counts = np.array([drive.motor.position for drive in self.drives])
        if not np.array_equal(counts, self._counts):
            self.plant.settle_counts(counts)
            self._counts = counts

    def _on_nmt(self, data: Frame) -> None:
        if len(data) == 2:
            for drive in self.drives:
                drive.on_nmt(data[0], data[1])

    def _on_heartbeat(self, node: int, data: Frame) -> None:
        for drive in self.drives:
            if drive.node != node:
                drive.on_heartbeat(node, data)

    def _send(self, can_id: int, data: Frame) -> None:
        """On the bus, and to the other drives, which sit on the same end of it."""
        with suppress(BusDown):  # nobody is reached
            transmit(self._bus, SentFrame(can_id, data))
        if can_id > HEARTBEAT_BASE:
            self._on_heartbeat(can_id - HEARTBEAT_BASE, data)
