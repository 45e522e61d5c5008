"""What is done to drives that follow no path: torque off (`cdpr release`) and `cdpr reset`.

Each is done in the real-time process, with the cycle kept from the first reading to the ordered
end; whatever stops it, all drives are commanded to stop.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

from drivers.drive_group import CycleStatus, GroupCommand, GroupState
from executor.control.preconditions import require_capabilities
from executor.control.sync_master import ReplyTimeout, SyncMaster, late_fault, left_otherwise
from executor.realtime.job import ReadyDrives
from executor.state_machine import CycleRecord, LoopEvent, State
from executor.supervision import OperatorRequests
from model.errors import CdprError, Fault, StoppedByOperator
from model.pose import Pose
from model.rig import Rig

#: All drives must be without torque, or have come to a stop, within this time, [s].
WITHIN_S = 3.0
#: Cycles in which a drive leaves its fault, and the others are seen to hold.
SETTLING_CYCLES = 30


class Standstill(ABC):
    """One procedure on drives that stay where they are; a `Procedure` of the real-time process.

    Attributes:
        cause: Why it did not finish.
        error: The same, to be raised where the operator is.
        holding: Every cable was held in every cycle.
    """

    where = ""

    def __init__(
        self,
        rig: Rig,
        master: SyncMaster,
        wishes: Callable[[], OperatorRequests],
        on_cycle: Callable[[CycleRecord], None],
    ) -> None:
        """Nothing is sent yet; arguments as for `executor.control.loop.Loop`."""
        self._rig, self._master, self._group = rig, master, master.group
        self._wishes, self._on_cycle = wishes, on_cycle
        self._silence = ReplyTimeout(rig)
        self._cycles = 0
        self._longest = round(WITHIN_S / rig.cycle)
        self.cause, self.error = "", None
        self.holding = True

    error: CdprError | None

    def arm(self, require: Callable[[Sequence[int]], None] = lambda _positions: None) -> None:
        """Reads where the drives are; see `executor.control.loop.Loop.arm`.

        Raises:
            Refused: They are not to be worked on so; nothing was changed.
            HardwareMissing: A drive does not answer.
        """
        require_capabilities(self._group.capabilities, self._rig.cycle)
        self._master.read_positions()
        require(self.stands_at)

    @property
    def stands_at(self) -> tuple[int, ...]:
        """Where the drives were when they were last heard, [counts]."""
        status = self._master.status
        return () if status is None else tuple(int(position) for position in status.positions)

    def run(self) -> State:
        """Does it; drives that hold are commanded to stop when anything is wrong.

        Returns:
            FINISHED, or LATCHED with `cause` and `error`.
        """
        try:
            done = self._work()
            otherwise = left_otherwise(self._rig, done, self._master.leave(self._one_more))
            if otherwise:
                raise Fault(
                    otherwise,
                    where=self.where,
                    why="a drive treats loss of its master as a fault, or lost power",
                    next_step="check the platform and the drives, then run `cdpr reset RIG`",
                )
        except CdprError as error:
            self.cause, self.error = error.what, error
            self._stop()
        except BaseException:
            self._stop()
            raise
        return State.LATCHED if self.error else State.FINISHED

    @abstractmethod
    def _work(self) -> CycleStatus:
        """The procedure itself; how it leaves the drives.

        Raises:
            CdprError: It did not finish.
        """

    def _cycle(self) -> CycleStatus:
        """One cycle in which drives stay where they are.

        Raises:
            Fault: It came too late, or the bus failed.
            HardwareMissing: Drives fell silent.
        """
        lateness = self._master.begin()
        self._require_in_time(lateness)
        status = self._master.exchange(self._group.targets.tolist())
        self._record(status, lateness)
        if self._master.overdue:
            raise late_fault(self._master.overdue)
        self._silence.take(status)
        self._require_heard(self._silence)
        return status

    def _require_in_time(self, lateness: float) -> None:
        """Drives that may be under command must not have stopped by themselves meanwhile."""
        status = self._master.status
        following = status is not None and not status.stopped
        if following and not self._master.rule.may_enable(1.0 + lateness):
            raise late_fault(1.0 + lateness)

    @abstractmethod
    def _require_heard(self, silence: ReplyTimeout) -> None:
        """Raises HardwareMissing where drives fell silent."""

    def _record(self, status: CycleStatus, lateness: float) -> None:
        self.holding = self.holding and status.holding
        record = CycleRecord(
            cycle=self._cycles,
            at=self._master.clock.time,
            state=State.SECURING,
            index=0.0,
            rate=0.0,
            targets=tuple(self._group.targets.tolist()),
            actual=tuple(status.positions.tolist()),
            torques=tuple(status.torques.tolist()),
            words=tuple(status.status_words.tolist()),
            missing=int(status.missing.sum()),
            rejected=status.rejected,
            error_frames=status.error_frames,
            following_error=float("nan"),
            lateness=lateness,
        )
        self._cycles += 1
        self._on_cycle(record)

    def _one_more(self) -> bool:
        self._cycle()
        return True

    def _stop(self) -> None:
        """Commands all to stop until every one reports that it follows nothing, or time is over.

        A bus that does not take the stop is no reason to leave off: the next cycle repeats it.
        """
        with suppress(CdprError):
            self._master.stop_now()
        for _ in range(self._longest):
            self._master.begin()
            with suppress(CdprError):
                status = self._master.exchange(self._group.targets.tolist())
                self._record(status, 0.0)
                if status.stopped and not self._group.stopping:
                    break
        self._master.leave_unmoved()


class Release(Standstill):
    """Takes the torque of all drives off, together; they stay where they are."""

    where = "release"

    def arm(self, require: Callable[[Sequence[int]], None] = lambda _positions: None) -> None:
        """See `Standstill`; drives beyond their position limits are not enabled, even for this."""
        super().arm(require)
        self._group.require_releasable()

    def _work(self) -> CycleStatus:
        self._group.command(GroupCommand.RELEASE)
        for _ in range(self._longest):
            if self._wishes().stop:
                raise StoppedByOperator(
                    "stopped while releasing the drives; those under torque hold, a"
                    " fault is latched, and the drives must be homed again",
                    next_step="check the drives (`cdpr status RIG`), then run `cdpr reset RIG`",
                )
            status = self._cycle()
            if status.state is GroupState.RELEASED:
                return status
            if status.state is GroupState.FAULT:
                raise _not_released("; ".join(text for _, text in status.faults))
        raise _not_released(f"the drives still had torque after {WITHIN_S:g} s")

    def _require_heard(self, silence: ReplyTimeout) -> None:
        silence.require_none(
            "while releasing the drives",
            where="release",
            why="it lost power or the bus; the others were stopped and hold",
            next_step="check power and wiring, then run `cdpr reset RIG`",
        )


def _not_released(what: str) -> Fault:
    return Fault(
        what,
        where="release",
        why="a drive did not follow the release sequence; those under torque hold",
        next_step="check the drives, then run `cdpr reset RIG`; if none can be released, cut the"
        " motor power by the emergency stop once the platform is supported",
    )


class FaultReset(Standstill):
    """Resets drives in fault; those that hold keep holding."""

    where = "reset"

    def _work(self) -> CycleStatus:
        if self._group.state is GroupState.FAULT:
            self._group.command(GroupCommand.RESET_FAULT)
        for _ in range(SETTLING_CYCLES):
            status = self._cycle()
        if status.state is GroupState.FAULT:
            raise Fault(
                "; ".join(text for _, text in status.faults),
                where="reset",
                why="the cause persists",
                next_step="remove it, then reset again; the latch stays engaged",
            )
        return status

    def _require_heard(self, silence: ReplyTimeout) -> None:
        silence.require_none(
            "while the drives settled",
            where="reset",
            why="it lost power or the bus after it was configured",
            next_step="check power and wiring, then reset again; the latch stays engaged",
        )


@dataclass(frozen=True, slots=True)
class StandstillMotion:
    """A procedure as a job of the real-time process; see `Motion` there.

    Attributes:
        kind: Which.
        cables: How many.
        cycle: [s].
    """

    kind: type[Release] | type[FaultReset]
    cables: int
    cycle: float

    @classmethod
    def of(cls, kind: type[Release] | type[FaultReset], rig: Rig) -> StandstillMotion:
        """A procedure on the drives of a rig."""
        return cls(kind, rig.cable_count, rig.cycle)

    def loop(
        self,
        drives: ReadyDrives,
        master: SyncMaster,
        *,
        wishes: Callable[[], OperatorRequests],
        on_cycle: Callable[[CycleRecord], None],
        on_event: Callable[[LoopEvent], None],
    ) -> Standstill:
        """See `Motion`."""
        return self.kind(drives.rig, master, wishes, on_cycle)

    def require(self, drives: ReadyDrives, positions: Sequence[int]) -> None:
        """See `Motion`; the drives stay wherever they are."""

    def after(self, record: CycleRecord, drives: ReadyDrives) -> Pose | None:
        """See `Motion`; nothing moves."""
        return None

    def close(self) -> None:
        """See `Motion`; it shares no memory."""
