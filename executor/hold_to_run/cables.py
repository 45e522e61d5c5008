"""Moves one winch at a time while a press is held; a task of the real-time process.

Unlike with `cdpr jog --cable`, the travel is not fixed in advance. The loop itself reads the
presses, so that neither network nor supervisor delay the ramp after a release.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from drivers.drive_group import CycleStatus
from drivers.plausibility import position_limits
from executor.control.cycle import SETTLING, Feed
from executor.control.loop import Loop
from executor.control.preconditions import with_reduced_limits
from executor.control.sync_master import SyncMaster
from executor.control.winch_laws import (
    LEAST_SHARE,
    CableFeed,
    CableStep,
    OneCableLaw,
    Targets,
    TensionReserve,
    tension_reserve,
)
from executor.hold_to_run.presses import CableMove, Press, PressReader, PressState
from executor.realtime.child import MotionTask, ReadyDrives
from executor.realtime.shared_memory import SharedMemory
from executor.safety.gate import Purpose
from executor.state_machine import CycleRecord, Event, State
from executor.supervision import SupervisorCalls
from executor.trajectory.setpoints import CheckedSetpoints, fingerprint
from model.rig import Rig
from model.winches import WinchMap

#: It slows down when this much of the largest travel is left beyond the ramp, [cycles].
MARGIN = 4.0
#: A tension closer to the limit than this many reserves is reported as near it.
NEAR = 1.5
_ENDLESS = 10**9


@dataclass(frozen=True, slots=True)
class CableLimits:
    """Limits of a cable jog.

    Attributes:
        tension: Largest tension of any cable, [N].
        speed: Of a winch, [m/s].
        longest: Largest travel of one press, [m].
        positions: Smallest and largest of each drive, [counts].
    """

    tension: float
    speed: float
    longest: float
    positions: tuple[tuple[int, int], ...]

    def travel(self, rig: Rig, here: Sequence[int], held: PressState) -> float:
        """Travel that a press may move its cable from here, [m]; negative winds in.

        Args:
            here: Positions of the drives, [counts].
        """
        cable, sign = held.cable - 1, 1.0 if held.pays_out else -1.0
        per_metre = rig.winches[cable].counts_per_metre
        low, high = self.positions[cable]
        left = high - here[cable] if sign * per_metre > 0.0 else here[cable] - low
        longest = self.longest if held.step is None else min(held.step, self.longest)
        return sign * min(longest, max(0, left) / abs(per_metre))


class CableLoop(Loop):
    """One session of jogs of single cables on one drive group; at rest the drives stay enabled."""

    motion_phrase = "together"
    slack_counts = False
    takes_feed_requests = False  # the held control sets hold and speed

    def __init__(
        self,
        rig: Rig,
        begin: Sequence[int],
        limits: CableLimits,
        master: SyncMaster,
        calls: SupervisorCalls,
        *,
        held: Callable[[], PressState],
    ) -> None:
        """Prepares the session; sends nothing yet.

        Args:
            rig: The robot, with the limits of the session.
            begin: Positions of the drives, [counts].
            limits: Of each press.
            master: See `Loop`.
            calls: See `Loop`; of the requests only a stop counts.
            held: Returns the press held now; called every cycle.
        """
        cycle = rig.cycle
        here = np.array([begin], dtype=np.int32)
        checked = CheckedSetpoints(rig, cycle, here, fingerprint(cycle, here))
        super().__init__(checked, master, calls)
        self._limits, self._held_now = limits, held
        self._feed = self._feed_at(0.0)
        self._status: CycleStatus | None = None
        self._law: OneCableLaw | None = None
        self._press, self._cable, self._from = 0, 0, begin[0]
        self._at_end = False
        self._rested = 0

    def _follow(self) -> None:
        """One cycle of a press, or at rest."""
        if self._status is None:  # no tension is known yet
            self._status = self._send(Purpose.HOLD, self._sender.resting_targets)
            return
        held = self._held_now()
        self._steer(held)
        if self._feed.at_rest and (self.machine.state is State.STOPPING or held.ends):
            self.machine.on(Event.AT_REST)
        elif (targets := self._next_targets(self._status)) is not None:
            rests = targets == self._sender.resting_targets
            self._status = self._send(Purpose.HOLD if rests else Purpose.MOVE, targets)

    def _steer(self, held: PressState) -> None:
        """Begins a press at rest, continues it, and slows down after its end."""
        is_moving = self.machine.state is State.MOVING
        is_new = held.press not in (0, self._press) and held.cable > 0
        if is_moving and is_new and self._feed.at_rest:
            self._begin(held)
        law = self._law
        if law is not None and law.done:
            self._feed = self._feed_at(0.0)
        if isinstance(law, CableFeed):
            self._at_end |= law.cycles_left <= self._feed.rows_to_rest + MARGIN
        if is_moving and law is not None and held.press == self._press and not self._at_end:
            self._feed.go_to(0.0 if law.done else held.share)
        else:
            self._feed.stop()

    def _begin(self, held: PressState) -> None:
        """Begins a press at the present positions; the gate allows its reach."""
        here, cable = self._sender.resting_targets, held.cable - 1
        travel = self._limits.travel(self._rig, here, held)
        make: type[CableFeed | CableStep] = CableFeed if held.step is None else CableStep
        limit, speed = self._limits.tension, self._limits.speed
        reserve = TensionReserve(self._rig, cable, limit=limit, pays_out=held.pays_out)
        self._law = make(
            self._rig, here, cable=cable, length=travel, limit=limit, speed=speed, reserve=reserve
        )
        # A step speeds up and slows down on its own.
        self._feed = self._feed_at(0.0 if held.step is None else held.share)
        self._sender.allow(np.array(self._law.reach, dtype=np.int32))
        self._press, self._cable, self._from = held.press, cable, here[cable]
        self._at_end, self._rested = False, 0

    def _next_targets(self, status: CycleStatus) -> Targets | None:
        """Targets of the next cycle; None if the tensions end the session."""
        resting = self._sender.resting_targets
        if self._law is None:
            return resting
        before = self._feed.index
        pace = self._feed.advance() - before
        # Tensions follow with a delay: the law monitors them while the winches settle.
        self._rested = self._rested + 1 if self._feed.at_rest else 0
        if self._rested > SETTLING:
            self._law = None
            return resting
        tensions = self._rig.tensions_by(status.torques).tolist()
        targets, alarms = self._law.next(pace, tensions)
        if not alarms:
            return targets
        self._handle_alarms(alarms)
        self._law, self._feed = None, self._feed_at(0.0)  # stop without a ramp
        return None

    def _feed_at(self, rate: float) -> Feed:
        return Feed(_ENDLESS, self._checked.cycle, self._rig.motion, rate=rate)

    def _index(self) -> float:
        """Length paid out by the latest press, [mm]; negative for wound in."""
        moved = self._sender.resting_targets[self._cable] - self._from
        return 1000.0 * moved / self._rig.winches[self._cable].counts_per_metre


@dataclass(frozen=True, slots=True, eq=False)
class CableMotion(MotionTask):
    """A session of jogs of single cables, which owns the memory.

    Attributes:
        limit: Largest tension, [N].
        speed: Fastest winch, [m/s].
        longest: Largest travel of one press, [m].
        presses: See `PressBoard`.
    """

    limit: float
    speed: float
    longest: float
    presses: SharedMemory

    def loop(self, drives: ReadyDrives, master: SyncMaster, calls: SupervisorCalls) -> Loop:
        """See `MotionTask`."""
        winches = WinchMap(drives.rig)
        positions = tuple(position_limits(drives.rig, k, winches) for k in range(self.cables))
        return CableLoop(
            with_reduced_limits(drives.rig, limit=self.limit, speed=self.speed),
            master.read_positions().positions.tolist(),
            CableLimits(self.limit, self.speed, self.longest, positions),
            master,
            calls,
            held=PressReader(self.presses, lambda: master.clock.now).read,
        )


class CableTravel:
    """The supervisor's record of a cable session: which cable moves, and how far."""

    def __init__(self, rig: Rig, limit: float, longest: float) -> None:
        """Starts without motion.

        Args:
            limit: Largest tension, [N].
            longest: Largest travel of one press, [m].
        """
        self._rig, self._longest = rig, longest
        self._near = limit - NEAR * tension_reserve(rig, limit)
        self._per_metre = np.array([winch.counts_per_metre for winch in rig.winches])
        self._begin: tuple[int, ...] | None = None
        self._targets: tuple[int, ...] = ()
        self._tensions: list[float] = []
        self.tension_limit = limit
        """Largest tension of any cable, [N]."""
        self.cable = 0
        """Number of the cable that moved last, from 1; 0 for none yet."""
        self.by_press = 0.0
        """Length paid out by the latest press, [m]; negative for wound in."""

    @property
    def by_session(self) -> list[float]:
        """Length paid out of each cable since the session began, [m]."""
        if self._begin is None:
            return [0.0] * self._rig.cable_count
        moved = np.subtract(self._targets, self._begin) / self._per_metre
        return [float(length) for length in moved]

    @property
    def limit(self) -> str:
        """Why the cable slows down or stops; empty without a limit nearby."""
        if not self._tensions or not self.cable:
            return ""
        tightest = int(np.argmax(self._tensions))
        most = self._tensions[tightest]
        if not most <= self._near:
            text = f"cable {tightest + 1} carries {most:.1f} N"
            return f"{text}, near the limit of {self.tension_limit:g} N"
        slack, least = self._rig.min_tension / 2.0, LEAST_SHARE * self._rig.min_tension
        for cable, tension in enumerate(self._tensions, start=1):
            if slack <= tension < least and cable != self.cable and self.by_press:
                return f"cable {cable} carries {tension:.1f} N: it is nearly slack"
        if abs(self.by_press) > 0.9 * self._longest:
            return f"a press moves a cable by {1e3 * self._longest:g} mm at most"
        return ""

    def take_cycle(self, record: CycleRecord, press: Press | None) -> None:
        """Takes a cycle, and the press held in it."""
        if record.state not in (State.MOVING, State.STOPPING):
            return
        if self._begin is None:
            self._begin = self._targets = record.targets
        moved = np.flatnonzero(np.not_equal(record.targets, self._targets))
        if moved.size:
            self.cable = int(moved[0]) + 1
        elif press is not None and isinstance(press.move, CableMove) and record.rate == 0.0:
            self.cable = press.move.cable
        self._targets, self.by_press = record.targets, record.index / 1000.0
        self._tensions = self._rig.tensions_by(record.torques).tolist()
