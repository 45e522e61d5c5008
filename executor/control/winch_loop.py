"""Winch motion without a path, in the control loop: pretension, and one cable alone.

Drives are enabled, stopped, gated and monitored as in a run. Slack is not a fault here: these
motions are for slack cables; the law decides which cables must not go slack.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from drivers.drive_group import CycleStatus
from drivers.plausibility import position_limits
from executor.control.cycle import Feed
from executor.control.loop import Loop
from executor.control.preconditions import with_reduced_limits
from executor.control.sync_master import SyncMaster
from executor.control.winch_laws import WinchLaw
from executor.realtime.child import MotionTask, ReadyDrives
from executor.safety.gate import Purpose
from executor.state_machine import Event, State
from executor.supervision import SupervisorCalls
from executor.trajectory.setpoints import CheckedSetpoints, fingerprint
from model.errors import Refused
from model.rig import Rig
from model.winches import WinchMap

_ENDLESS = 10**9


class WinchLoop(Loop):
    """One motion by a law on one drive group; the gate allows the law's reach."""

    motion_phrase = "together"
    slack_counts = False

    def __init__(self, rig: Rig, law: WinchLaw, master: SyncMaster, calls: SupervisorCalls) -> None:
        """Prepares the motion; arguments as for `Loop`, with a law instead of set-points."""
        cycle = rig.cycle
        reach = np.array(law.reach, dtype=np.int32)
        checked = CheckedSetpoints(rig, cycle, reach, fingerprint(cycle, reach))
        super().__init__(checked, master, calls)
        self._law = law
        self._feed = Feed(_ENDLESS, cycle, rig.motion)
        self._status: CycleStatus | None = None

    def _follow(self) -> None:
        """One cycle by the law, or at rest; a stop has no path to slow down along."""
        state = self.machine.state
        if self._status is None or (self._feed.at_rest and state is State.HOLDING):
            self._status = self._send(Purpose.HOLD, self._sender.resting_targets)
        elif state is State.STOPPING or (self._law.done and state is State.MOVING):
            self.machine.on(Event.AT_REST)
        else:
            before = self._feed.index
            pace = self._feed.advance() - before
            tensions = self._rig.tensions_by(self._status.torques)
            targets, alarms = self._law.next(pace, tensions.tolist())
            if alarms:
                self._handle_alarms(alarms)
            if self.machine.state is state:
                self._status = self._send(Purpose.MOVE, targets)

    def _index(self) -> float:
        """Share done, [%]."""
        return 100.0 * self._law.progress


# Its task, for the real-time process or for simulated time in this one.


#: Makes a law from the referenced rig with reduced limits and the drive positions [counts].
MakeLaw = Callable[[Rig, Sequence[int]], WinchLaw]


@dataclass(frozen=True, slots=True, eq=False)
class LawMotion(MotionTask):
    """A motion by a law.

    Attributes:
        make_law: Makes the winch law; picklable.
        limit: Largest tension, [N].
        speed: Fastest winch, [m/s].
    """

    make_law: MakeLaw
    limit: float
    speed: float

    def loop(self, drives: ReadyDrives, master: SyncMaster, calls: SupervisorCalls) -> Loop:
        """See `MotionTask`."""
        rig = with_reduced_limits(drives.rig, limit=self.limit, speed=self.speed)
        law = self.make_law(rig, master.read_positions().positions.tolist())
        _require_reach_allowed(drives.rig, law)
        return WinchLoop(rig, law, master, calls)


def _require_reach_allowed(rig: Rig, law: WinchLaw) -> None:
    """Requires that no drive would have to move beyond where the workspace can need it."""
    winches = WinchMap(rig)
    for drive, (first, farthest) in enumerate(zip(*law.reach, strict=True)):
        low, high = position_limits(rig, drive, winches)
        beyond = max(low - farthest, farthest - high)
        if beyond > 0:
            per_mm = abs(rig.winches[drive].counts_per_metre) / 1000.0
            travel = abs(farthest - first) / per_mm
            name = rig.drive_names[rig.winches[drive].node_id]
            raise Refused(
                f"{name} would move by up to {travel:.4g} mm, {beyond / per_mm:.2g} mm beyond its"
                " position limits",
                where="winches",
                why="at the assumed pose no pose in the workspace needs such a cable length; a"
                " drive with position limits (607Dh) stops at them, or with a fault",
                next_step="allow a shorter reach or length, or take a pose farther inside the"
                " workspace box; nothing was enabled",
            )
