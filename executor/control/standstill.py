"""Procedures on drives at rest: torque off (`cdpr release`) and fault reset (`cdpr reset`).

Each runs in the real-time process, cyclically from the first reading to the ordered end;
if anything interrupts it, all drives are commanded to stop.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

from drivers.drive_group import CycleStatus, GroupCommand, GroupState
from executor.control.preconditions import require_capabilities
from executor.control.sync_master import ReplyTimeout, SyncMaster, changed_states, late_fault
from executor.interlock.fault_latch import AFTER_A_FAULT, LatchedFault
from executor.interlock.interlock import MotionInterlock
from executor.realtime.child import Armed, Ended, MotionTask, ReadyDrives
from executor.realtime.process import RealTimeProcess
from executor.state_machine import CycleRecord, LoopEvent, State
from executor.supervision import OperatorRequests, SupervisorCalls
from model.errors import CdprError, Fault, StoppedByOperator
from model.pose import Pose
from model.rig import Rig

#: Time for a drive to leave its fault, and for the others to be confirmed holding, [s].
SETTLING_S = 1.5


class Standstill(ABC):
    """Procedure on drives at rest; a `Procedure` of the real-time process.

    Attributes:
        cause: Why it did not finish.
        error: The same, raised in the supervisor.
        holding: Every cable was held in every cycle.
    """

    where = ""

    def __init__(
        self,
        rig: Rig,
        master: SyncMaster,
        requests: Callable[[], OperatorRequests],
        on_cycle: Callable[[CycleRecord], None],
    ) -> None:
        """Sends nothing yet; ``requests`` and ``on_cycle`` as in `SupervisorCalls`."""
        self._rig, self._master, self._group = rig, master, master.group
        self._requests, self._on_cycle = requests, on_cycle
        self._silence = ReplyTimeout(rig)
        self._cycles = 0
        self.cause, self.error = "", None
        self.holding = True

    error: CdprError | None

    def arm(self, require: Callable[[CycleStatus], None] = lambda _seen: None) -> None:
        """Reads the drive positions; see `executor.control.loop.Loop.arm`.

        Raises:
            Refused: The procedure is not allowed on these drives; nothing was changed.
            HardwareMissing: A drive does not answer.
        """
        require_capabilities(self._group.capabilities, self._rig.cycle)
        require(self._master.read_positions())

    @property
    def positions(self) -> tuple[int, ...]:
        """Last reported positions of the drives, [counts]."""
        status = self._master.status
        return () if status is None else tuple(int(position) for position in status.positions)

    def run(self) -> State:
        """Runs the procedure; on any fault all drives are commanded to stop.

        Returns:
            FINISHED, or LATCHED with `cause` and `error`.
        """
        try:
            done = self._work()
            otherwise = changed_states(self._rig, done, self._master.leave(self._one_more))
            if otherwise:
                raise Fault(
                    otherwise,
                    where=self.where,
                    why="a drive treats loss of its master as a fault, or lost power",
                    next_step=AFTER_A_FAULT,
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
        """Runs the procedure itself; returns the final drive status.

        Raises:
            CdprError: It did not finish.
        """

    def _cycle(self) -> CycleStatus:
        """One cycle with unchanged targets.

        Raises:
            Fault: The cycle was too late, or the bus failed.
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
        """Refuses a cycle so late that following drives may have stopped on their own."""
        status = self._master.status
        following = status is not None and not status.all_stopped
        if following and not self._master.rule.may_enable(1.0 + lateness):
            raise late_fault(1.0 + lateness)

    @abstractmethod
    def _require_heard(self, silence: ReplyTimeout) -> None:
        """Raises HardwareMissing if drives fell silent."""

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
            tension_known=(False,) * len(status.missing),
        )
        self._cycles += 1
        self._on_cycle(record)

    def _one_more(self) -> bool:
        self._cycle()
        return True

    def _stop(self) -> None:
        """Commands a stop until every drive reports that it is stopped, or times out.

        If the bus does not accept the stop, the next cycle repeats it.
        """
        with suppress(CdprError):
            self._master.stop_now()
        for _ in range(round(self._master.hold_timeout / self._rig.cycle)):
            self._master.begin()
            with suppress(CdprError):
                status = self._master.exchange(self._group.targets.tolist())
                self._record(status, 0.0)
                if status.all_stopped and not self._group.stopping:
                    break
        self._master.leave_disabled()


class Release(Standstill):
    """Switches off the torque of all drives together, without motion."""

    where = "release"

    def arm(self, require: Callable[[CycleStatus], None] = lambda _seen: None) -> None:
        """See `Standstill`; drives beyond their position limits are not enabled, even for this."""
        super().arm(require)
        self._group.require_releasable()

    def _work(self) -> CycleStatus:
        self._group.command(GroupCommand.RELEASE)
        within = self._group.capabilities.released_within
        for _ in range(round(within / self._rig.cycle)):
            if self._requests().stop:
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
        raise _not_released(f"the drives still had torque after {within:g} s")

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
        next_step=f"{AFTER_A_FAULT}; if none can be released, cut the motor power by the emergency"
        " stop once the platform is supported",
    )


class FaultReset(Standstill):
    """Resets drives in fault; drives that hold keep holding."""

    where = "reset"

    def _work(self) -> CycleStatus:
        if self._group.state is GroupState.FAULT:
            self._group.command(GroupCommand.RESET_FAULT)
        for _ in range(round(SETTLING_S / self._rig.cycle)):
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
class StandstillMotion(MotionTask):
    """A procedure without motion.

    Attributes:
        kind: Class of the procedure.
    """

    kind: type[Release] | type[FaultReset]

    @classmethod
    def of(cls, kind: type[Release] | type[FaultReset], rig: Rig) -> StandstillMotion:
        """The procedure for the drives of a rig."""
        return cls(rig.cable_count, rig.cycle, kind)

    def loop(self, drives: ReadyDrives, master: SyncMaster, calls: SupervisorCalls) -> Standstill:
        """See `MotionTask`."""
        return self.kind(drives.rig, master, calls.requests, calls.on_cycle)


# In the real-time process, with their effect on latch and reference.


#: Why the reference is lost where no brake holds the drums.
_RELEASED = "the drives were released by the operator, and no brake holds the cables"
_CUT_SHORT = Ended(State.LATCHED, "the program was terminated", holding=False, true_pose=None)


class Unrecorded:
    """Discards records of cycles without motion; see `executor.realtime.child.Records`."""

    def take_cycle(self, record: CycleRecord, true_pose: Pose | None) -> None:
        """Discards it."""

    def take_event(self, event: LoopEvent) -> None:
        """Discards it."""


def is_braked(rig: Rig) -> bool:
    """Whether every winch has a brake that closes when its drive is released."""
    return all(winch.brake for winch in rig.winches)


def release_drives(
    rig: Rig,
    interlock: MotionInterlock,
    process: RealTimeProcess,
    on_armed: Callable[[str], None],
    on_begun: Callable[[], None],
    under: LatchedFault | None = None,
) -> CycleStatus:
    """Switches off the torque, and updates latch and reference.

    Args:
        interlock: Of that rig.
        process: For `Release`.
        on_armed: Called when armed, with what the system denied.
        on_begun: Called once the latch is engaged; any error after it latches a fault.
        under: Latched fault that stays; see `MotionInterlock.begin`.

    Returns:
        The drives' last status, without torque.

    Raises:
        StoppedByOperator: Stopped by the operator.
        CdprError: They could not be configured, or were not released; then a fault is latched.
    """
    record = interlock.file.path.parent
    armed = process.arm(Unrecorded())
    on_armed(armed.denied)
    interlock.found_at_rest(armed.positions, armed.restarted, armed.released)
    interlock.begin(record, interlock.still_counts(armed.positions), under=under)
    ended, left, released = _CUT_SHORT, None, False
    try:
        on_begun()
        ended = process.run()
        released = ended.state is State.FINISHED
        left = process.read_status() if released else None
    except CdprError as error:
        ended = replace(ended, state=State.LATCHED, cause=error.what, error=error)
    except BaseException:
        ended = _CUT_SHORT
        raise
    finally:
        interlock.end(
            ended.state,
            ended.cause and f"while releasing the drives: {ended.cause}",
            record,
            holding=released and is_braked(rig),
            positions=armed.positions if left is None else left.positions.tolist(),
            released=[winch.node_id for winch in rig.winches],
            release_reason=_RELEASED if released else "",
        )
    if left is None:
        raise ended.error or Fault(ended.cause, where="release")
    return left


@dataclass(frozen=True, slots=True, eq=False)
class DrivesReset:
    """State of drives after a reset.

    Attributes:
        left: Their last status.
        restarted: Nodes found without their configuration.
    """

    left: CycleStatus
    restarted: tuple[int, ...]


def reset_drives(interlock: MotionInterlock, process: RealTimeProcess) -> DrivesReset:
    """Resets drives in fault; those that hold keep holding.

    If all held throughout, as after a program was killed, their reference remains valid at their
    present positions; so does that of absolute encoders which lost no turns.

    Args:
        process: For `FaultReset`.

    Raises:
        CdprError: A drive does not answer, may not be reset now, or stays in fault.
    """
    armed: Armed = process.arm(Unrecorded())
    ended = process.run()
    if ended.state is not State.FINISHED:
        raise ended.error or Fault(ended.cause, where="reset")
    left = process.read_status()
    interlock.found_at_rest(armed.positions, armed.restarted, armed.released)
    held = ended.holding and not armed.restarted
    interlock.confirm_at_rest(left.positions.tolist(), held=held)
    return DrivesReset(left, armed.restarted)
