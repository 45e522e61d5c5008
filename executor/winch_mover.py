"""Who moves winches by a law: the real-time process, or in simulated time this one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from cdpr.errors import Refused, StoppedByOperator
from cdpr.poses import Pose
from cdpr.rig import Rig
from drivers.drive_group import CycleStatus
from executor.clock import Clock
from executor.loop import Loop
from executor.real_time_job import Armed, Ended, ReadyDrives, Records
from executor.records import CycleRecord, LoopEvent
from executor.unreferenced import careful
from executor.winch_laws import WinchLaw
from executor.winch_loop import WinchLoop
from executor.wishes import WishBoard, Wishes

#: From the rig as its drives count, limited, and where they stand, [counts].
MakeLaw = Callable[[Rig, Sequence[int]], WinchLaw]


class WinchMover(Protocol):
    """Arms the drives, moves them, and can be asked afterwards where they stand."""

    def arm(self, records: Records) -> Armed:
        """Makes all ready; what happens from now on is told to the records.

        Raises:
            CdprError: It cannot be; nothing was enabled.
        """
        ...

    def run(self) -> Ended:
        """Moves; the drives hold by themselves in the end."""
        ...

    def stands_now(self) -> CycleStatus:
        """What the drives tell after the motion."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class LawMotion:
    """A motion by a law as a job of the real-time process; see `Motion` there.

    Attributes:
        cables: How many.
        cycle: [s].
        make_law: Makes what the winches are told; it can be sent to a process.
        limit: Largest tension, [N].
        speed: Fastest winch, [m/s].
    """

    cables: int
    cycle: float
    make_law: MakeLaw
    limit: float
    speed: float

    def loop(
        self,
        drives: ReadyDrives,
        clock: Clock,
        *,
        wishes: Callable[[], Wishes],
        on_cycle: Callable[[CycleRecord], None],
        on_event: Callable[[LoopEvent], None],
    ) -> Loop:
        """See `Motion`."""
        rig = careful(drives.rig, limit=self.limit, speed=self.speed)
        stands = drives.group.read_positions().positions.tolist()
        law = self.make_law(rig, stands)
        return WinchLoop(
            rig, law, drives.group, clock, wishes=wishes, on_cycle=on_cycle, on_event=on_event
        )

    def after(self, record: CycleRecord, drives: ReadyDrives) -> Pose | None:
        """See `Motion`; nobody asks for a pose while winches move without a path."""
        return None

    def close(self) -> None:
        """See `Motion`; it shares no memory."""


class WinchesHere:
    """Moves winches in this process, in simulated time; a `WinchMover`."""

    def __init__(
        self, motion: LawMotion, drives: ReadyDrives, clock: Clock, board: WishBoard
    ) -> None:
        """Nothing is sent yet."""
        self._motion, self._drives, self._clock, self._board = motion, drives, clock, board
        self._loop: Loop | None = None

    def arm(self, records: Records) -> Armed:
        """See `WinchMover`.

        Raises:
            CdprError: The drives cannot be armed.
            StoppedByOperator: The operator wanted to stop before anything moved.
        """
        self._loop = self._motion.loop(
            self._drives,
            self._clock,
            wishes=self._board.read,
            on_cycle=lambda record: records.take_cycle(record, None),
            on_event=records.take_event,
        )
        self._loop.arm()
        if self._board.read().stop:
            raise StoppedByOperator("stopped before anything moved")
        return Armed("", self._loop.stands_at)

    def run(self) -> Ended:
        """See `WinchMover`.

        Raises:
            Refused: It was not armed.
        """
        if self._loop is None:
            raise Refused("the motion was not armed", where="executor")
        state = self._loop.run()
        return Ended(state, self._loop.cause, self._loop.holding, self._drives.true_pose_now())

    def stands_now(self) -> CycleStatus:
        """See `WinchMover`."""
        return self._drives.group.read_positions()
