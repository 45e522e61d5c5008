"""Opens the drives of a rig: on a real bus, or simulated in this process behind a virtual one."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from can import BusABC

from drivers.can_bus import IN_PROCESS, BusSettings, open_bus
from drivers.can_errors import before_motion
from drivers.drive_group import DriveSnapshot, how_to_reset
from drivers.factory import (
    blocked_in_fault,
    drive_flags,
    drive_states,
    make_drive_group,
    read_drives,
    stop_alone,
    time_to_stop_alone,
)
from drivers.setup_refusals import TorqueLost
from executor.control.preconditions import configuration_at_rest, require_below, with_counts_at
from executor.control.standstill import is_braked
from executor.interlock.fault_latch import FaultLatch, LatchedFault
from executor.interlock.interlock import MotionInterlock
from executor.interlock.locks import SetUpLock
from executor.kernels import ready_to_simulate
from executor.realtime.child import ReadyDrives
from model.errors import BadInput, CdprError, Refused, require_types
from model.files.rig_file import RigDocument
from model.kinematics import cable_lengths
from model.pose import Array, Pose
from model.progress import SILENT, Listener
from model.rig import Rig, rig_from_document
from model.scene import Load, empty_scene, require_unaltered
from model.statics.gravity import working_tensions
from model.winches import WinchMap

if TYPE_CHECKING:
    from simulation.ground_truth import PowerLoss
    from simulation.rig import SimulatedRig

#: Buses whose drives are simulated in this process at the moment, of any thread.
_simulated: set[str] = set()
_simulating = threading.Lock()


def is_simulated(rig: Rig) -> bool:
    """Whether the drives are simulated in this process: the rig's interface is ``virtual``.

    Raises:
        BadInput: It is not a rig; verbs that move or read drives ask this first.
    """
    require_types((rig, Rig))
    return rig.document.bus.interface == IN_PROCESS


def require_other_process(rig: Rig) -> None:
    """Requires a bus whose drives outlive this process.

    Raises:
        BadInput: The interface is ``virtual``, or the rig is an altered copy.
    """
    if is_simulated(rig):
        raise BadInput(
            "the interface 'virtual' keeps no state",
            where="bus",
            why="its drives are simulated inside a run and end with it",
            next_step="name the bus: --interface and --channel, in Python rig.with_bus()",
        )
    require_unaltered(rig)


def require_drives(rig: Rig, realtime: bool) -> None:
    """Requires drives that can be simulated in this process, or real time for those on a bus.

    Raises:
        BadInput: They cannot, as with a drive profile of one's own; or no real time.
    """
    if is_simulated(rig):
        from simulation.factory import check_drives  # a real bus loads no simulator

        check_drives(rig)
    elif not realtime:
        raise BadInput(
            "`realtime=False` needs drives simulated in this process",
            why="time on a real bus cannot run faster",
            next_step="leave out `realtime=False`, or use the interface 'virtual'",
        )


def require_simulated_start(rig: Rig, start: Pose | None) -> None:
    """Requires drives simulated in this process where a pose of the platform is stated.

    Raises:
        BadInput: The drives are on a bus.
    """
    if start is not None and not is_simulated(rig):
        raise BadInput(
            "a start pose can be set only for a platform simulated in this process",
            where="`start=`",
            next_step="leave it out, or use the interface 'virtual'",
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Drives:
    """An open bus, and its drives if simulated in this process."""

    bus: BusABC
    rehearsal: SimulatedRig[Any] | None

    @property
    def pump(self) -> Callable[[], None] | None:
        return None if self.rehearsal is None else self.rehearsal.pump


@contextmanager
def _held_in_process(settings: BusSettings) -> Iterator[None]:
    """Holds a bus of the interface ``virtual``, whose ends find each other by its name."""
    with _simulating:
        if settings.canonical in _simulated:
            raise Refused(
                "a motion is in progress on this bus in this process",
                where=f"bus {settings}",
                why="the simulated drives of both would answer on one channel",
                next_step="wait until it ends, or simulate on a channel of its own:"
                " rig.with_bus('virtual', name); nothing was moved",
            )
        _simulated.add(settings.canonical)
    try:
        yield
    finally:
        _simulated.discard(settings.canonical)


@contextmanager
def _locked_bus(
    rig: Rig,
    simulated_start: Pose,
    load: Load,
    lost_power: PowerLoss | None = None,
    listener: Listener = SILENT,
) -> Iterator[_Drives]:
    """Opens the bus with its drives locked; arguments and errors as `open_drives`."""
    settings = BusSettings.of(rig)
    with ExitStack() as stack:
        stack.enter_context(SetUpLock(settings).held())
        if settings.interface == IN_PROCESS:
            stack.enter_context(_held_in_process(settings))
        bus = open_bus(settings)
        stack.callback(bus.shutdown)
        if settings.interface != IN_PROCESS:
            yield _Drives(bus, None)
            return
        from simulation.factory import make_rehearsal  # a real bus loads no simulator

        ready_to_simulate(listener)
        far_end = open_bus(settings)
        stack.callback(far_end.shutdown)
        yield _Drives(
            bus, make_rehearsal(rig, far_end, simulated_start, load, lost_power=lost_power)
        )


def read_snapshot(rig: Rig, simulated_start: Pose, load: Load) -> DriveSnapshot:
    """Reads the drives without changing them; arguments and errors as `open_drives`."""
    with _locked_bus(rig, simulated_start, load) as drives, before_motion():
        return read_drives(rig, drives.bus, drives.pump)


def abandoned_drives_fault(document: RigDocument, released: Collection[int]) -> str:
    """Why drives without a master do not hold; empty if all hold.

    Drives simulated in the process that ended are gone as well.

    Args:
        released: Nodes that need not hold, as they were never enabled.
    """
    rig = rig_from_document(document)
    if is_simulated(rig):
        return ""
    time.sleep(time_to_stop_alone(rig))
    try:
        snapshot = read_snapshot(rig, rig.home, empty_scene(rig).load)
    except CdprError as error:
        return f"state of the drives unknown: {error.what}"
    words = snapshot.status_words.tolist()
    states, alone = drive_states(rig, words), stop_alone(rig, words)
    rows = zip(rig.drive_names.items(), states, alone, strict=True)
    wrong = [
        f"{name} is in {state}"
        for (node, name), state, good in rows
        if not (good or node in released)
    ]
    return f"drives do not hold on their own: {', '.join(wrong)}" if wrong else ""


@contextmanager
def open_drives(
    rig: Rig,
    simulated_start: Pose,
    load: Load,
    *,
    to_reset: bool = False,
    lost_power: PowerLoss | None = None,
    configure_as: Callable[[DriveSnapshot], tuple[Rig, float]] | None = None,
    listener: Listener = SILENT,
) -> Iterator[ReadyDrives]:
    """Opens the bus and configures the drives; closes both at the end.

    Drives power-cycled since their last configuration lose their reference here.

    Args:
        rig: The robot and its bus.
        simulated_start: Pose of the platform if the drives are simulated here.
        to_reset: Also accepts drives in fault, to be reset, and in NMT *stopped*.
        lost_power: Effect of a power loss on drives simulated here.
        configure_as: For unreferenced drives: takes their state before any change, returns the rig
            as they count and the largest tension [N] for their torque limit.
        listener: Receives remarks on missing capabilities.

    Raises:
        BadInput: python-can has no such interface.
        HardwareMissing: The bus cannot be opened or a drive does not answer.
        BusFault: The bus failed, or another program commands the drives; see `before_motion`.
        Refused: The bus is too slow, a drive rejects a setting, or another program configures it.
    """
    interlock, counted, max_tension = MotionInterlock(rig), rig, None
    restarted: set[int] = set()

    def note_restarted(nodes: tuple[int, ...]) -> None:
        restarted.update(nodes)
        interlock.found_restarted(nodes)

    with _locked_bus(rig, simulated_start, load, lost_power, listener) as reached:
        if configure_as is not None:
            with before_motion():
                snapshot = read_drives(rig, reached.bus, reached.pump, to_reset=to_reset)
            counted, max_tension = configure_as(snapshot)
        group = make_drive_group(counted, reached.bus, reached.pump, max_tension=max_tension)
        try:
            try:
                with before_motion():
                    remarks = group.configure(to_reset=to_reset, on_restarted=note_restarted)
            except TorqueLost as error:
                interlock.lost_torque(error.what)
                raise
            for remark in remarks:
                listener.remark(remark)
            true_pose: Callable[[], Pose] | None = None
            carry: Callable[[Load], None] = _no_payload_change
            if (rehearsal := reached.rehearsal) is not None:
                true_pose, carry = lambda: rehearsal.pose, rehearsal.carry
            yield ReadyDrives(
                counted, group, true_pose, carry, tuple(sorted(restarted)), tuple(remarks)
            )
        finally:
            group.close()


def _no_payload_change(_load: Load) -> None:
    """A real gripper changes the payload without a message."""


def drives_of(
    document: RigDocument, simulated_start: Pose, load: Load, listener: Listener = SILENT
) -> AbstractContextManager[ReadyDrives]:
    """`open_drives` with picklable arguments, for another process.

    Remarks are in `ReadyDrives.remarks` for the other process; the listener is for a call in this.
    """
    return open_drives(rig_from_document(document), simulated_start, load, listener=listener)


def unreferenced_drives_of(
    document: RigDocument,
    about: Pose,
    limit: float,
    lost_power: PowerLoss | None,
    listener: Listener = SILENT,
) -> AbstractContextManager[ReadyDrives]:
    """`open_drives` with picklable arguments, for unreferenced drives.

    Args:
        about: Approximate pose of the platform, ``world_from_platform``.
        limit: Largest tension, [N]; drives that hold more are refused.
        lost_power: Effect of a power loss on drives simulated there.
        listener: For a call in this process: receives remarks.
    """
    rig = rig_from_document(document)

    def configure_as(snapshot: DriveSnapshot) -> tuple[Rig, float]:
        require_below(rig, snapshot, limit)
        return with_counts_at(rig, snapshot.positions.tolist(), about), limit

    load = empty_scene(rig).load
    return open_drives(
        rig, about, load, lost_power=lost_power, configure_as=configure_as, listener=listener
    )


def resting_drives_of(
    document: RigDocument, *, to_reset: bool = False
) -> AbstractContextManager[ReadyDrives]:
    """`open_drives` with picklable arguments, for drives that stay at rest.

    Args:
        to_reset: As for `open_drives`.
    """
    rig = rig_from_document(document)
    load = empty_scene(rig).load
    configure_as = partial(configuration_at_rest, rig)
    return open_drives(rig, rig.home, load, to_reset=to_reset, configure_as=configure_as)


# Status of drives at rest.


@dataclass(frozen=True, slots=True)
class DriveStatus:
    """Status of one drive.

    Attributes:
        node: Its node ID.
        state: Of its state machine, as text.
        position: Of its encoder, [counts].
        tension: Of its cable, from the drive's torque, [N].
        has_torque: Without torque the tension is not that of the cable, which a brake may hold.
        set_up: It has the configuration for this rig: no power cycle or other cycle time since.
        error: The error that a drive in fault stores, or why one at rest cannot be enabled; empty
            without one.
        in_fault: It has to be reset.
    """

    node: int
    state: str
    position: int
    tension: float
    has_torque: bool
    set_up: bool
    error: str = ""
    in_fault: bool = False

    @property
    def state_with_error(self) -> str:
        """State; with node and error if there is one."""
        return f"drive {self.node} {self.state}: {self.error}" if self.error else self.state


def drive_statuses(rig: Rig, seen: DriveSnapshot) -> tuple[DriveStatus, ...]:
    """The status of each drive that answered."""
    columns = zip(
        [winch for winch in rig.winches if winch.node_id not in seen.silent],
        drive_states(rig, seen.status_words.tolist()),
        drive_flags(rig, seen.status_words.tolist()),
        seen.positions.tolist(),
        seen.torques.tolist(),
        seen.errors,
        strict=True,
    )
    return tuple(
        DriveStatus(
            node=winch.node_id,
            state=state,
            position=position,
            tension=torque / 1000.0 * winch.torque_constant,
            has_torque=flags.torque != "none",
            set_up=winch.node_id not in seen.restarted,
            error=error,
            in_fault=flags.in_fault,
        )
        for winch, state, flags, position, torque, error in columns
    )


def faults_to_release_under(rig: Rig) -> tuple[LatchedFault | None, tuple[str, ...]]:
    """The latched fault, and names of the drives in fault, that a release leaves as they are.

    Raises:
        Refused: A reset must clear the fault first, or winches without a brake cannot hold.
        CdprError: The drives cannot be read.
    """
    latch = FaultLatch(BusSettings.of(rig), rig.drive_names)
    latched = latch.read()
    if latched is None or not latch.is_of(latched, rig.name):
        latch.require_disengaged()
    latch.require_no_run()
    seen = read_snapshot(rig, rig.home, empty_scene(rig).load)
    nodes = blocked_in_fault(rig, seen.status_words.tolist())
    names = tuple(rig.drive_names[node] for node in nodes)
    if not nodes:
        latch.require_disengaged()
    elif not is_braked(rig):
        raise Refused(
            f"{', '.join(names)}: in fault, while other drives hold the platform",
            where="release",
            why="not every winch has a brake (winches[].brake in the rig file)",
            next_step=how_to_reset(braked=False),
        )
    return latched, names


# The pose from drive positions.


def current_pose(rig: Rig, counts: Array, load: Load) -> Pose:
    """The pose at which the drives hold the platform, ``world_from_platform``.

    On a face of the workspace box, rounded counts give a position up to micrometres outside: within
    the start tolerance, the nearest one of the box is meant.

    Args:
        rig: The robot; its drives are referenced.
        counts: Positions of the drives, shape (m,), [counts].
        load: Carried by the platform.

    Raises:
        Refused: The planned drive positions there differ by more than the rig's start tolerance.
        TensionInfeasible: The cables cannot hold the platform there.
        Fault: The platform has no equilibrium at these positions.
    """
    winches = WinchMap(rig)
    unstrained = winches.unstrained_from_counts(counts)
    found = winches.equilibrium(unstrained, load)
    pose = rig.clipped(found)
    tensions = working_tensions(rig, found, load).tensions
    off = np.abs(unstrained - winches.unstrained(cable_lengths(rig, found), tensions))
    worst, limit = int(off.argmax()), rig.motion.start_tolerance
    if off[worst] <= limit and pose.distance_to(found) <= limit:
        return pose
    x, y, z = found.position * 1000.0
    raise Refused(
        f"the drive positions fit no pose in the workspace: the nearest is {x:.1f}, {y:.1f},"
        f" {z:.1f} mm, with cable {worst + 1} {off[worst] * 1000:.1f} mm off",
        where="drive positions",
        why="the homing reference is lost, a cable slipped, the rig file is wrong, or homing left"
        " tensions far from the planned ones",
        next_step="home the drives at a known pose, with a pretension (--tension-n, in Python"
        f" tension=) near the planned {tensions.min():.0f} to {tensions.max():.0f} N; nothing was"
        " moved",
    )
