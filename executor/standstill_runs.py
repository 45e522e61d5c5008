"""Release and reset of drives in the real-time process: what they mean for latch and reference."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from drivers.drive_group import CycleStatus
from executor.interlock.interlock import MotionInterlock
from executor.realtime.job import Armed, Ended
from executor.realtime.process import RealTimeProcess
from executor.state_machine import CycleRecord, LoopEvent, State
from model.errors import Fault
from model.pose import Pose
from model.rig import Rig

#: By what the reference is lost where no brake holds the drums.
_RELEASED = "the drives were released by the operator, and no brake holds the cables"
_CUT_SHORT = Ended(State.LATCHED, "the program was terminated", holding=False, true_pose=None)


class Unrecorded:
    """Keeps no record of cycles in which nothing moves; see `executor.realtime.job.Records`."""

    def take_cycle(self, record: CycleRecord, true_pose: Pose | None) -> None:
        """Nothing is kept."""

    def take_event(self, event: LoopEvent) -> None:
        """Nothing is kept."""


def is_braked(rig: Rig) -> bool:
    """Every winch has a brake that closes when its drive is released."""
    return all(winch.brake for winch in rig.winches)


def release_drives(
    rig: Rig, interlock: MotionInterlock, process: RealTimeProcess, on_armed: Callable[[str], None]
) -> CycleStatus:
    """Takes the torque off; what becomes of the bus and the reference is kept.

    Args:
        rig: The robot.
        interlock: Of that rig.
        process: For `executor.control.standstill.Release`.
        on_armed: Called when all is ready, with what the system did not grant.

    Returns:
        The drives' last word, without torque.

    Raises:
        StoppedByOperator: The operator stopped it.
        CdprError: They could not be set up, or were not released; then a fault is latched.
    """
    record = interlock.file.path.parent
    armed = process.arm(Unrecorded())
    on_armed(armed.denied)
    interlock.begin(record, interlock.still_counts(armed.stands_at))
    ended = _CUT_SHORT
    try:
        ended = process.run()
        left = process.stands_now() if ended.state is State.FINISHED else None
    except BaseException:
        ended = _CUT_SHORT
        raise
    finally:
        if ended.state is not State.FINISHED:
            cause = f"while releasing the drives: {ended.cause}"
            interlock.end(State.LATCHED, cause, record, holding=False, stands_at=None)
    if left is None:
        raise ended.error or Fault(ended.cause, where="release")
    interlock.end(
        State.FINISHED,
        "",
        record,
        holding=is_braked(rig),
        stands_at=left.positions.tolist(),
        let_go=_RELEASED,
    )
    return left


@dataclass(frozen=True, slots=True, eq=False)
class DrivesReset:
    """How drives are after a reset.

    Attributes:
        left: Their last word.
        restarted: Nodes that were found without their set-up.
    """

    left: CycleStatus
    restarted: tuple[int, ...]


def reset_drives(interlock: MotionInterlock, process: RealTimeProcess) -> DrivesReset:
    """Resets drives in fault; those that hold keep holding.

    Where all held all the while, as after a program that was killed, their reference still counts
    from where they are.

    Args:
        interlock: Of their rig.
        process: For `executor.control.standstill.FaultReset`.

    Raises:
        CdprError: A drive does not answer, may not be reset now, or stays in fault.
    """
    armed: Armed = process.arm(Unrecorded())
    ended = process.run()
    if ended.state is not State.FINISHED:
        raise ended.error or Fault(ended.cause, where="reset")
    left = process.stands_now()
    if ended.holding and not armed.restarted:
        interlock.confirm_held(left.positions.tolist())
    return DrivesReset(left, armed.restarted)
