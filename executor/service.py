"""Service of a rig: status, reset of a latched fault, release of the drives."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, ExitStack, closing
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np

from drivers.can_bus import BusSettings, open_bus
from drivers.can_errors import BusFault, ForeignMaster, before_motion
from drivers.drive_group import CycleStatus, how_to_reset
from drivers.factory import (
    blocked_in_fault,
    drive_states,
    read_drives,
    stop_alone,
    unready_remarks,
    without_torque,
)
from drivers.plausibility import HOMING_POSE
from executor.control.standstill import (
    FaultReset,
    Release,
    StandstillMotion,
    is_braked,
    release_drives,
    reset_drives,
)
from executor.drives import (
    DriveStatus,
    abandoned_drives_fault,
    current_pose,
    drive_statuses,
    faults_to_release_under,
    require_other_process,
    resting_drives_of,
)
from executor.interlock.fault_latch import FaultLatch, LatchedFault
from executor.interlock.interlock import MotionInterlock, reference_status
from executor.interlock.locks import SetUpLock
from executor.interlock.reference import RESTARTED, ReferenceStatus
from executor.proposals import Facts, Proposal, release_proposal, require_confirmed, reset_proposal
from executor.realtime.process import RealTimeProcess, real_time_process
from executor.realtime.scheduling import require_imported_script
from executor.realtime.shared_memory import SharedRequests
from executor.remote.client import motions_on
from executor.remote.command_server import Commands, commands_from_start
from executor.remote.status import WinchStatus, bus_name
from executor.state_machine import State
from executor.supervision import Supervisor, ctrl_c_interrupts
from model.errors import CdprError, require_child_processes, require_types, truth_value
from model.files.documents import PoseDocument
from model.pages.page import FactsDisplay
from model.pose import Pose
from model.progress import SILENT, Listener
from model.rig import Rig
from model.scene import empty_scene


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class StatusResult(FactsDisplay):
    """Status of a rig; None for what was not read or is unknown.

    Attributes:
        rig: Its name.
        bus: Interface and channel.
        run: ID of the process that moves or resets it.
        preparing: IDs of processes that prepare a motion.
        latched: Cause of a latched fault.
        being_set_up: Another program prepares a motion of the drives or reads them.
        reference: Homing reference of the drives.
        drives: The drives that answered, in the order of the rig file.
        pose: From the encoders, without a load, ``world_from_platform``.
        why_no_pose: Why there is no pose, though the drives were read.
        missing: Why drives could not be read; the reference is unknown then, unless it is lost.
        silent: Nodes of the drives that did not answer.
        how_to_reset: How to reset where `cdpr reset RIG` alone is refused; None where it is not.
    """

    rig: str
    bus: str
    run: int | None
    preparing: tuple[int, ...]
    latched: str | None
    being_set_up: bool
    reference: ReferenceStatus
    drives: tuple[DriveStatus, ...] | None = None
    pose: Pose | None = None
    why_no_pose: str | None = None
    missing: CdprError | None = None
    silent: tuple[int, ...] = ()
    how_to_reset: str | None = None

    def facts(self, rig_file: Path = Path("RIG")) -> Facts:
        """Human-readable status, with the next step before a run.

        Args:
            rig_file: For the suggested commands.
        """
        latched = self.latched or "none"
        if self.run is not None:
            latched += f"; process {self.run} is moving or resetting the rig, see `cdpr monitor`"
        facts = [
            ("rig", self.rig),
            ("bus", self.bus),
            ("latched fault", latched),
            ("reference", str(self.reference)),
        ]
        if self.preparing:
            who = ", ".join(map(str, self.preparing))
            facts.append(("motion", f"process {who} is preparing one; `cdpr stop` cancels it"))
        found = sorted({drive.state_with_error for drive in self.drives or ()})
        found += [self.missing.what] if self.missing is not None else []
        if self.being_set_up:
            found = ["not read: another program is preparing a motion or reading them"]
        if found:
            facts.append(("drives", "; ".join(found)))
        if self.pose is not None:
            x, y, z = self.pose.position * 1000.0
            position = f"{x:z.2f}, {y:z.2f}, {z:z.2f} mm from the encoders, without a load"
            facts.append(("platform", position))
        elif self.why_no_pose is not None:
            facts.append(("platform", self.why_no_pose))
        next_step = self.next_step(rig_file)
        return [*facts, ("next", next_step)] if next_step else facts

    def next_step(self, rig_file: Path = Path("RIG")) -> str:
        """Next step before a run; empty if none is needed or a run is active."""
        if self.run is not None or self.being_set_up:
            return ""
        file, steps = quote(str(rig_file)), []
        if self.how_to_reset is not None:
            how = self.how_to_reset.replace(" RIG`", f" {file}").replace("`", "")
            steps.append(f"find the cause; {how}")
        elif self.latched is not None or self.reference.valid_after_reset:
            steps.append(f"find the cause and check the platform, then run cdpr reset {file}")
        elif any(drive.in_fault for drive in self.drives or ()):
            steps.append(f"run cdpr reset {file}")
        if failed := [str(drive.node) for drive in self.drives or () if drive.error]:
            steps.insert(0, f"remove the cause shown for drive {', '.join(failed)}")
        if self.reference.why_lost is not None:
            steps.append(f"cdpr home {file} with {HOMING_POSE}")
        return "; then ".join(steps)

    def drive_lines(self, names: Mapping[int, str]) -> list[str]:
        """One line per drive.

        Args:
            names: Of the drives, by node (`Rig.drive_names`).
        """
        lines = {
            drive.node: f"{drive.state:<24} {drive.position:>11} counts {drive.tension:8.2f} N"
            f"{'' if drive.set_up else '  not set up, or for another cycle'}"
            f"{f'  {drive.error}' if drive.error else ''}"
            for drive in self.drives or ()
        } | dict.fromkeys(self.silent, "does not answer")
        return [f"{name:<19} {lines[node]}" for node, name in names.items() if node in lines]

    def as_dict(self) -> dict[str, Any]:
        """Values for `--json`, rounded, with units in the keys."""
        pose = None if self.why_no_pose is None else {"why_not": self.why_no_pose}
        if self.pose is not None:
            pose = PoseDocument.of(self.pose).model_dump(mode="json")
        drives = [
            {
                "node": drive.node,
                "state": drive.state,
                "position_counts": drive.position,
                "tension_n": round(drive.tension, 2),
                "set_up": drive.set_up,
                "error": drive.error or None,
            }
            for drive in self.drives or ()
        ]
        return {
            "rig": self.rig,
            "bus": self.bus,
            "run": self.run,
            "preparing": list(self.preparing),
            "latched": self.latched,
            "being_set_up": self.being_set_up,
            "reference": asdict(self.reference),
            "drives": None if self.drives is None else drives,
            "silent": list(self.silent),
            "how_to_reset": self.how_to_reset,
            "pose": pose,
        }


def status(rig: Rig) -> StatusResult:
    """The status of a rig: faults, reference, drives, tensions, pose. Moves and writes nothing.

    While a run is active or being prepared, the drives are not read.

    Args:
        rig: The robot and its bus.

    Raises:
        BadInput: The interface is ``virtual``, which reaches no other process.
    """
    require_other_process(rig)
    settings, interlock = BusSettings.of(rig), MotionInterlock(rig)
    latch = FaultLatch(settings, rig.drive_names)
    latched, run = latch.read_in_motion()
    refusal = latch.why_not_reset(rig.name, latched) if latched else None
    motions = motions_on(bus_name(rig))  # also armed without the latch yet, or no longer with it
    run = run or next((one for one, state in motions.items() if state != "preparing"), None)
    ahead = (process for process, state in motions.items() if state == "preparing")
    preparing = tuple(process for process in ahead if process != run)
    known = StatusResult(
        rig=rig.name,
        bus=str(settings),
        run=run,
        preparing=preparing,
        latched=latched.cause if latched else None,
        being_set_up=bool(preparing),
        reference=reference_status(interlock),
        how_to_reset=refusal.next_step if refusal else None,
    )
    if run is not None or preparing:
        return known
    try:
        with SetUpLock(settings).tried() as alone, before_motion():
            return _read(rig, interlock, known) if alone else replace(known, being_set_up=True)
    except CdprError as error:  # the state on file is still reported
        failed = isinstance(error, BusFault) and not isinstance(error, ForeignMaster)
        silent, unread = tuple(rig.drive_names if failed else ()), known.reference.if_unread
        return replace(known, reference=unread(error.what), missing=error, silent=silent)


def _read(rig: Rig, interlock: MotionInterlock, known: StatusResult) -> StatusResult:
    """Reads the drives that answer; if all do, computes the pose.

    Raises:
        CdprError: A drive fails while it is read, or the bus cannot be opened.
    """
    with open_bus(BusSettings.of(rig)) as bus:
        seen = read_drives(rig, bus, partial=True)
    known = replace(known, drives=drive_statuses(rig, seen) or None, silent=seen.silent)
    if seen.silence is not None:
        unread = known.reference.if_unread(seen.silence.what)
        return replace(known, reference=unread, missing=seen.silence)
    positions, words = seen.positions.tolist(), seen.status_words.tolist()
    held = not seen.restarted and all(stop_alone(rig, words))
    reference = reference_status(interlock, positions, held=held)
    restarted = [w.node_id for w in rig.winches if not w.absolute and w.node_id in seen.restarted]
    if reference.counts and restarted:
        why = f"{', '.join(rig.drive_names[node] for node in restarted)}: {RESTARTED}"
        reference = replace(reference, counts=False, why_not=why)
    released = without_torque(rig, words)
    if reference.counts and (why := interlock.why_released(seen.restarted, released)):
        reference = replace(reference, counts=False, why_not=why)
    how = how_to_reset(braked=is_braked(rig)) if blocked_in_fault(rig, words) else None
    read = replace(known, reference=reference, how_to_reset=known.how_to_reset or how)
    if not reference.counts:
        return read
    counts, referenced = seen.positions.astype(np.float64), interlock.referenced_rig()
    try:
        return replace(read, pose=current_pose(referenced, counts, empty_scene(referenced).load))
    except CdprError as error:
        return replace(read, why_no_pose=error.what)


@dataclass(frozen=True, slots=True, repr=False)
class ResetResult(FactsDisplay):
    """State of a rig after a reset.

    Attributes:
        was_latched: Whether a fault was latched.
        cause: Of that fault.
        drives: State of each drive, as text.
        restarted: Nodes power-cycled since their last configuration.
        reference: Homing reference of the drives.
    """

    was_latched: bool
    cause: str | None
    drives: tuple[str, ...]
    restarted: tuple[int, ...]
    reference: ReferenceStatus

    def facts(self) -> Facts:
        """Human-readable latch, drives and reference."""
        latch = f"cleared: {self.cause}" if self.was_latched else "none was latched"
        facts = [("latched fault", latch), ("drives", ", ".join(sorted({*self.drives})))]
        if self.restarted:
            facts.append(("power-cycled", f"drive {', '.join(map(str, self.restarted))}"))
        return [*facts, ("reference", str(self.reference))]


@ctrl_c_interrupts()
def reset(
    rig: Rig,
    *,
    confirm: Callable[[Proposal], bool] | None = None,
    listener: Listener = SILENT,
) -> ResetResult:
    """Clears a latched fault after its cause is removed: resets drives in fault; moves nothing.

    Drives that hold keep holding. A drive in fault is not reset while others hold the platform.
    Afterwards a run must start at the platform's current pose.

    Args:
        rig: The robot and its bus.
        confirm: Called once, before anything is reset; False cancels it.
        listener: Receives remarks on missing capabilities of the drives, and on those that cannot
            be enabled.

    Raises:
        StoppedByOperator: Cancelled.
        BadInput: It needs a process of its own, which this one cannot start.
        CdprError: A run is active; or a drive does not answer, may not be reset now, or stays in
            fault.
    """
    require_types((rig, Rig), (listener, Listener))
    require_imported_script()
    require_child_processes("drives in real time")
    require_other_process(rig)
    settings = BusSettings.of(rig)
    latch = FaultLatch(settings, rig.drive_names)
    latched = latch.read()
    latch.require_no_run()
    require_confirmed(confirm, reset_proposal(str(settings), latched))
    interlock, motion = MotionInterlock(rig), StandstillMotion.of(FaultReset, rig)
    with (
        latch.held_for_reset(rig.name, latched),
        closing(SharedRequests()) as board,
        real_time_process(
            motion,
            partial(resting_drives_of, rig.document, to_reset=True),
            board,
            need_real_time=False,
            check_drives=partial(abandoned_drives_fault, rig.document),
            listener=listener,
        ) as process,
    ):
        done = reset_drives(interlock, process)
    for remark in unready_remarks(rig, done.left.status_words.tolist()):
        listener.remark(f"{remark}; correct this before a motion")
    return ResetResult(
        was_latched=latched is not None,
        cause=latched.cause if latched else None,
        drives=tuple(drive_states(rig, done.left.status_words.tolist())),
        restarted=done.restarted,
        reference=reference_status(interlock, done.left.positions.tolist()),
    )


@dataclass(frozen=True, slots=True, repr=False)
class ReleaseResult(FactsDisplay):
    """State of a rig after its drives were released.

    Attributes:
        drives: State of each drive, as text.
        reference: Homing reference of the drives.
    """

    drives: tuple[str, ...]
    reference: ReferenceStatus

    def facts(self) -> Facts:
        """Human-readable drives and reference."""
        return [("drives", ", ".join(sorted({*self.drives}))), ("reference", str(self.reference))]


def release(
    rig: Rig,
    *,
    need_real_time_rights: bool = True,
    listener: Listener = SILENT,
    confirm: Callable[[Proposal], bool] | None = None,
    supervisor: Supervisor | None = None,
) -> ReleaseResult:
    """Closes the brakes and switches off the torque of all drives; the platform must be supported.

    Winches without brakes release their cables, so that the drives must be homed again. Where all
    have brakes, a drive in fault that cannot be reset while others hold stays in fault, as does a
    latched fault.

    Args:
        rig: The robot and its bus.
        need_real_time_rights: Refuse without real-time scheduling.
        listener: Receives what the system denies, and remarks on the drives.
        confirm: Called once, before anything is released; False cancels it. Without it the call
            itself confirms.
        supervisor: Turns interrupts into stops; None for what signal handlers raise.

    Raises:
        StoppedByOperator: Cancelled, or stopped.
        CdprError: The bus is latched, and a reset can clear it; a drive is in fault and not all
            winches have brakes; the drives could not be configured; or they were not released, and
            a fault is latched.
    """
    require_types((rig, Rig), (listener, Listener))
    need_real_time_rights = truth_value("need_real_time_rights", need_real_time_rights)
    require_other_process(rig)
    interlock = MotionInterlock(rig)
    with commands_from_start("release", rig, supervisor, realtime=True) as commands:
        under, in_fault = faults_to_release_under(rig)
        bus, braked = str(BusSettings.of(rig)), is_braked(rig)
        proposal = release_proposal(rig, bus, braked, reference_status(interlock), in_fault)
        require_confirmed(confirm, proposal)
        commands.require_no_stop()
        process = partial(
            real_time_process,
            StandstillMotion.of(Release, rig),
            partial(resting_drives_of, rig.document, to_reset=bool(in_fault)),
            need_real_time=need_real_time_rights,
            check_drives=partial(abandoned_drives_fault, rig.document),
            listener=listener,
        )
        released = partial(_released, rig, interlock, commands, process, listener, under)
        left = commands.supervisor.during(commands.board, released)
    commands.supervisor.finish()
    return ReleaseResult(
        drives=tuple(drive_states(rig, left.status_words.tolist())),
        reference=reference_status(interlock, left.positions.tolist()),
    )


def _released(
    rig: Rig,
    interlock: MotionInterlock,
    commands: Commands,
    make_process: Callable[[SharedRequests], AbstractContextManager[RealTimeProcess]],
    listener: Listener,
    under: LatchedFault | None,
) -> CycleStatus:
    """Releases the drives; returns their last status. Errors as `release_drives`."""
    board = commands.board
    assert isinstance(board, SharedRequests)
    status = WinchStatus(rig, board, simulated_time=False)

    def on_armed(denied: str) -> None:
        if denied:
            listener.remark(denied)

    with ExitStack() as stack:
        stack.enter_context(commands.during_motion(status))
        process = stack.enter_context(make_process(board))
        left = release_drives(rig, interlock, process, on_armed, status.take_release, under)
        status.take_end(State.FINISHED, "")
        return left
