"""Moves winches without a path: pretension, and one cable alone. The rest is the loop of a run.

Enabled together, stopped together, gated and watched as a run is. Slack is no fault here: cables
that hang slack are what these motions are for; what must not become slack is the law's to say.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cdpr.rig import Rig
from drivers.drive_group import CycleStatus, DriveGroup
from executor.clock import Clock
from executor.course import Course, fingerprint
from executor.feed import Feed
from executor.loop import Loop
from executor.machine import Event, State
from executor.records import CycleRecord, LoopEvent
from executor.safety.gate import Purpose
from executor.winch_laws import WinchLaw
from executor.wishes import Wishes

_ENDLESS = 10**9


class WinchLoop(Loop):
    """One motion by a law on one drive group; the gate allows what lies in the law's reach."""

    way = "together"
    slack_counts = False

    def __init__(
        self,
        rig: Rig,
        law: WinchLaw,
        group: DriveGroup,
        clock: Clock,
        *,
        wishes: Callable[[], Wishes],
        on_cycle: Callable[[CycleRecord], None],
        on_event: Callable[[LoopEvent], None],
    ) -> None:
        """Prepares the motion; arguments as for `Loop`, with a law in place of a course."""
        cycle = rig.document.bus.cycle_ms / 1000.0
        reach = np.array(law.reach, dtype=np.int32)
        course = Course(rig, cycle, reach, fingerprint(cycle, reach))
        super().__init__(course, group, clock, wishes=wishes, on_cycle=on_cycle, on_event=on_event)
        self._law = law
        self._feed = Feed(_ENDLESS, cycle, rig.motion)
        self._status: CycleStatus | None = None

    def _follow(self) -> None:
        """One cycle by the law, or at rest where it is; a stop has no way on which to slow down."""
        state = self.machine.state
        if self._status is None or (self._feed.at_rest and state is State.HOLDING):
            self._status = self._send(Purpose.HOLD, self._exchange.resting_targets)
        elif state is State.STOPPING or (self._law.done and state is State.MOVING):
            self.machine.on(Event.AT_REST)
        else:
            before = self._feed.index
            pace = self._feed.advance() - before
            tensions = self._course.rig.tensions_by(self._status.torques)
            targets, findings = self._law.next(pace, tensions.tolist())
            if findings:
                self._judge(findings, "")
            if self.machine.state is state:
                self._status = self._send(Purpose.MOVE, targets)

    def _place(self) -> float:
        """How much is done, [%]."""
        return 100.0 * self._law.progress
