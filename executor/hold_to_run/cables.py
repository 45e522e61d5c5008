"""Moves one winch at a time as long as a press is held; a task of the real-time process.

It differs from `cdpr jog --cable` in this: the way is not fixed before it begins. The loop itself
reads what is held, so that neither network nor supervisor lie between a release and the ramp.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from drivers.drive_group import CycleStatus
from drivers.plausibility import position_limits
from executor.control.cycle import Feed
from executor.control.loop import SETTLING, Loop
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
from executor.hold_to_run.presses import CablePress, Press, PressReader, PressState
from executor.realtime.job import ReadyDrives
from executor.realtime.shared_memory import SharedMemory
from executor.safety.gate import Purpose
from executor.state_machine import CycleRecord, Event, LoopEvent, State
from executor.supervision import OperatorRequests
from executor.trajectory.setpoints import CheckedSetpoints, fingerprint
from model.pose import Pose
from model.rig import Rig
from model.winches import WinchMap

#: It slows down where what is left of the longest way lasts no longer than this, [cycles].
MARGIN = 4.0
#: Less than this many reserves below the limit a tension is called near it.
NEAR = 1.5
_ENDLESS = 10**9


@dataclass(frozen=True, slots=True)
class CableLimits:
    """How far and how fast one cable is jogged.

    Attributes:
        tension: That no cable may have, [N].
        speed: Of a winch, [m/s].
        longest: Of one press, [m].
        positions: Smallest and largest of each drive, [counts].
    """

    tension: float
    speed: float
    longest: float
    positions: tuple[tuple[int, int], ...]

    def way(self, rig: Rig, here: Sequence[int], held: PressState) -> float:
        """How far a press may move its cable from here, [m]; negative winds in.

        Args:
            rig: The robot.
            here: Positions of the drives, [counts].
            held: The press.
        """
        cable, sign = held.cable - 1, 1.0 if held.pays_out else -1.0
        per_metre = rig.winches[cable].counts_per_metre
        low, high = self.positions[cable]
        left = high - here[cable] if sign * per_metre > 0.0 else here[cable] - low
        longest = self.longest if held.step is None else min(held.step, self.longest)
        return sign * min(longest, max(0, left) / abs(per_metre))


class CableLoop(Loop):
    """One session of jogs of single cables on one drive group; at rest the drives stay enabled."""

    way = "together"
    slack_counts = False

    def __init__(
        self,
        rig: Rig,
        begin: Sequence[int],
        limits: CableLimits,
        master: SyncMaster,
        *,
        held: Callable[[float], PressState],
        wishes: Callable[[], OperatorRequests],
        on_cycle: Callable[[CycleRecord], None],
        on_event: Callable[[LoopEvent], None],
    ) -> None:
        """Prepares the session; nothing is sent yet.

        Args:
            rig: The robot, with the limits of the session.
            begin: Positions of the drives, [counts].
            limits: Of each press.
            master: As for `Loop`, as all but the next two.
            held: What is held at a moment of the clock [s]; asked every cycle.
            wishes: Only its stop counts.
            on_cycle: See `Loop`.
            on_event: See `Loop`.
        """
        cycle = rig.cycle
        here = np.array([begin], dtype=np.int32)
        course = CheckedSetpoints(rig, cycle, here, fingerprint(cycle, here))
        super().__init__(course, master, wishes=wishes, on_cycle=on_cycle, on_event=on_event)
        self._rig, self._limits, self._held_now = rig, limits, held
        self._feed = self._feed_at(0.0)
        self._status: CycleStatus | None = None
        self._law: OneCableLaw | None = None
        self._press, self._cable, self._from = 0, 0, begin[0]
        self._at_end = False
        self._rested = 0

    def _follow(self) -> None:
        """One cycle of a press, or at rest."""
        if self._status is None:  # no tension is known yet
            self._status = self._send(Purpose.HOLD, self._exchange.resting_targets)
            return
        held = self._held_now(self._clock.now)
        self._steer(held)
        if self._feed.at_rest and (self.machine.state is State.STOPPING or held.ends):
            self.machine.on(Event.AT_REST)
        elif (targets := self._next_targets(self._status)) is not None:
            rests = targets == self._exchange.resting_targets
            self._status = self._send(Purpose.HOLD if rests else Purpose.MOVE, targets)

    def _steer(self, held: PressState) -> None:
        """Begins a press where nothing moves, goes on with it, and slows down where it ended."""
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
        """A press begins where the drives rest; the gate lets through what lies in its reach."""
        here, cable = self._exchange.resting_targets, held.cable - 1
        way = self._limits.way(self._rig, here, held)
        make: type[CableFeed | CableStep] = CableFeed if held.step is None else CableStep
        limit, speed = self._limits.tension, self._limits.speed
        reserve = TensionReserve(self._rig, cable, limit=limit, pays_out=held.pays_out)
        self._law = make(
            self._rig, here, cable=cable, way=way, limit=limit, speed=speed, reserve=reserve
        )
        # A step speeds up and slows down by itself.
        self._feed = self._feed_at(0.0 if held.step is None else held.share)
        self._exchange.allow(np.array(self._law.reach, dtype=np.int32))
        self._press, self._cable, self._from = held.press, cable, here[cable]
        self._at_end, self._rested = False, 0

    def _next_targets(self, status: CycleStatus) -> Targets | None:
        """Of the next cycle; None where what the tensions say ends the session."""
        resting = self._exchange.resting_targets
        if self._law is None:
            return resting
        before = self._feed.index
        pace = self._feed.advance() - before
        # Tensions follow a little later: the law looks at them for as long as winches settle.
        self._rested = self._rested + 1 if self._feed.at_rest else 0
        if self._rested > SETTLING:
            self._law = None
            return resting
        tensions = self._rig.tensions_by(status.torques).tolist()
        targets, findings = self._law.next(pace, tensions)
        if not findings:
            return targets
        self._judge(findings)
        self._law, self._feed = None, self._feed_at(0.0)  # no way on which to slow down
        return None

    def _feed_at(self, rate: float) -> Feed:
        return Feed(_ENDLESS, self._course.cycle, self._rig.motion, rate=rate)

    def _place(self) -> float:
        """Cable that the newest press paid out, [mm]; negative was wound in."""
        moved = self._exchange.resting_targets[self._cable] - self._from
        return 1000.0 * moved / self._rig.winches[self._cable].counts_per_metre

    def _obey(self, wishes: OperatorRequests) -> None:
        """Holding and speed are the held control's."""
        self._obey_stop(wishes)


@dataclass(frozen=True, slots=True, eq=False)
class CableMotion:
    """A session of jogs of single cables; see `MotionTask` in `executor.realtime.job`.

    Attributes:
        cables: How many.
        cycle: [s].
        limit: Largest tension, [N].
        speed: Fastest winch, [m/s].
        longest: Way of one press, [m].
        presses: See `PressBoard`.
    """

    cables: int
    cycle: float
    limit: float
    speed: float
    longest: float
    presses: SharedMemory

    def loop(
        self,
        drives: ReadyDrives,
        master: SyncMaster,
        *,
        wishes: Callable[[], OperatorRequests],
        on_cycle: Callable[[CycleRecord], None],
        on_event: Callable[[LoopEvent], None],
    ) -> Loop:
        """See `MotionTask`."""
        winches = WinchMap(drives.rig)
        positions = tuple(position_limits(drives.rig, k, winches) for k in range(self.cables))
        return CableLoop(
            with_reduced_limits(drives.rig, limit=self.limit, speed=self.speed),
            master.read_positions().positions.tolist(),
            CableLimits(self.limit, self.speed, self.longest, positions),
            master,
            held=PressReader(self.presses).read,
            wishes=wishes,
            on_cycle=on_cycle,
            on_event=on_event,
        )

    def require(self, drives: ReadyDrives, positions: Sequence[int]) -> None:
        """See `MotionTask`; single cables are jogged from wherever they are."""

    def after(self, record: CycleRecord, drives: ReadyDrives) -> Pose | None:
        """See `MotionTask`; no pose is needed while winches move without a path."""
        return None

    def close(self) -> None:
        """See `MotionTask`; the memory is the session's."""


class CableTravel:
    """What the supervisor knows of a session of single cables: which moves, and how far."""

    def __init__(self, rig: Rig, limit: float, longest: float) -> None:
        """Nothing has moved.

        Args:
            rig: The robot.
            limit: Largest tension, [N].
            longest: Way of one press, [m].
        """
        self._rig, self._longest = rig, longest
        self._near = limit - NEAR * tension_reserve(rig, limit)
        self._per_metre = np.array([winch.counts_per_metre for winch in rig.winches])
        self._begin: tuple[int, ...] | None = None
        self._targets: tuple[int, ...] = ()
        self._tensions: list[float] = []
        self.tension_limit = limit
        """That no cable may have, [N]."""
        self.cable = 0
        """That moved last, from 1; 0 for none yet."""
        self.by_press = 0.0
        """What the newest press paid out, [m]; negative was wound in."""

    @property
    def by_session(self) -> list[float]:
        """What was paid out of each cable since the session began, [m]."""
        if self._begin is None:
            return [0.0] * self._rig.cable_count
        moved = np.subtract(self._targets, self._begin) / self._per_metre
        return [float(length) for length in moved]

    @property
    def limit(self) -> str:
        """Why the cable goes on more slowly, or no further; empty while nothing is near."""
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
        """A cycle is over, and that press was held then."""
        if record.state not in (State.MOVING, State.STOPPING):
            return
        if self._begin is None:
            self._begin = self._targets = record.targets
        moved = np.flatnonzero(np.not_equal(record.targets, self._targets))
        if moved.size:
            self.cable = int(moved[0]) + 1
        elif isinstance(press, CablePress) and record.rate == 0.0:
            self.cable = press.cable
        self._targets, self.by_press = record.targets, record.index / 1000.0
        self._tensions = self._rig.tensions_by(record.torques).tolist()
