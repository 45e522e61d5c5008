"""Opens the drives of a rig: on a real bus, or simulated in this process behind a virtual one."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from can import BusABC

from drivers.can_bus import IN_PROCESS, BusSettings, open_bus
from drivers.drive_group import DriveSnapshot
from drivers.factory import drive_states, make_drive_group, read_drives, stop_alone
from executor.control.preconditions import counted_here, require_below, set_up_here
from executor.interlock.interlock import MotionInterlock
from executor.interlock.locks import SetUpLock
from executor.kernels import ready_to_simulate
from executor.realtime.job import ReadyDrives
from model.errors import BadInput, CdprError, Fault, Refused
from model.files.rig_file import RigDocument
from model.kinematics import forward_kinematics
from model.pose import Array, Pose
from model.progress import SILENT, Listener
from model.rig import Rig, rig_from_document
from model.scene import Load, empty_scene
from model.statics.gravity import working_tensions
from model.winches import WinchMap

if TYPE_CHECKING:
    from simulation.ground_truth import PowerLoss
    from simulation.rig import SimulatedRig

#: Within this time drives that lost their master have noticed it and come to rest, [s].
ALONE = 1.0


def is_simulated(rig: Rig) -> bool:
    """Whether the drives are simulated in this process: the rig's interface is ``virtual``."""
    return rig.document.bus.interface == IN_PROCESS


def require_other_process(rig: Rig) -> None:
    """The bus reaches drives that outlive this process.

    Raises:
        BadInput: It is the interface ``virtual``.
    """
    if is_simulated(rig):
        raise BadInput(
            "the interface 'virtual' keeps no state",
            where="bus",
            why="its drives are simulated inside a run and end with it",
            next_step="name the bus with --interface and --channel",
        )


def require_own_time(rig: Rig, realtime: bool) -> None:
    """Only drives that are simulated in this process can go faster than time.

    Raises:
        BadInput: Others were to.
    """
    if not (realtime or is_simulated(rig)):
        raise BadInput(
            "--fast needs drives simulated in this process",
            where="--fast",
            why="time on a real bus cannot run faster",
            next_step="leave out --fast, or use the interface 'virtual'",
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Drives:
    """An open bus, and the drives behind it where they are simulated in this process."""

    bus: BusABC
    rehearsal: SimulatedRig[Any] | None

    @property
    def pump(self) -> Callable[[], None] | None:
        return None if self.rehearsal is None else self.rehearsal.pump


@contextmanager
def _reached(
    rig: Rig,
    simulated_start: Pose,
    load: Load,
    lost_power: PowerLoss | None = None,
    listener: Listener = SILENT,
) -> Iterator[_Drives]:
    """The bus, with its drives locked; arguments and errors as `open_drives`."""
    settings = BusSettings.of(rig)
    with ExitStack() as stack:
        stack.enter_context(SetUpLock(settings).held())
        bus = open_bus(settings)
        stack.callback(bus.shutdown)
        if settings.interface != IN_PROCESS:
            yield _Drives(bus, None)
            return
        from simulation.factory import make_rehearsal  # a real bus loads no simulator

        ready_to_simulate(listener)
        far_end = open_bus(settings)
        stack.callback(far_end.shutdown)
        rehearsal = make_rehearsal(rig, far_end, simulated_start, load)
        if lost_power is not None:
            lost_power.apply_to(rig, rehearsal.plant, [d.motor for d in rehearsal.drives])
        yield _Drives(bus, rehearsal)


def look_at(rig: Rig, simulated_start: Pose, load: Load) -> DriveSnapshot:
    """What the drives report; nothing of them is changed. Arguments and errors as `open_drives`."""
    with _reached(rig, simulated_start, load) as drives:
        return read_drives(rig, drives.bus, drives.pump)


def left_alone(document: RigDocument) -> str:
    """How drives stand whose master is gone; what is wrong with it, empty where all hold.

    Those that are simulated in the process that is gone are gone, too.

    Args:
        document: The rig file.
    """
    rig = rig_from_document(document)
    if is_simulated(rig):
        return ""
    time.sleep(ALONE)
    try:
        told = look_at(rig, rig.home, empty_scene(rig).load)
    except CdprError as error:
        return f"it is not known whether the drives hold: {error.what}"
    words = told.status_words.tolist()
    rows = zip(
        rig.drive_names.values(), drive_states(rig, words), stop_alone(rig, words), strict=True
    )
    wrong = [f"{name} is in {state}" for name, state, good in rows if not good]
    return f"drives do not hold by themselves: {', '.join(wrong)}" if wrong else ""


@contextmanager
def open_drives(
    rig: Rig,
    simulated_start: Pose,
    load: Load,
    *,
    to_reset: bool = False,
    lost_power: PowerLoss | None = None,
    set_up_as: Callable[[DriveSnapshot], tuple[Rig, float]] | None = None,
    listener: Listener = SILENT,
) -> Iterator[ReadyDrives]:
    """Opens the bus and configures the drives; closes both at the end.

    Drives that are found switched on since their last set-up lose their reference here.

    Args:
        rig: The robot and its bus.
        simulated_start: Where the platform stands when the drives are simulated here.
        load: What it carries then.
        to_reset: Also takes drives in fault, which are going to be reset.
        lost_power: What became of drives that are simulated here.
        set_up_as: For drives that are not referenced, from what they report before anything of
            them is changed: the rig as they count, and the largest tension [N] that their torque
            limit allows.
        listener: Receives what the drives cannot do.

    Raises:
        BadInput: python-can has no such interface.
        HardwareMissing: The bus cannot be opened or a drive does not answer.
        Refused: The bus is too slow, a drive does not keep a setting, or somebody else sets it up.
    """
    interlock, counted, max_tension = MotionInterlock(rig), rig, None
    restarted: set[int] = set()

    def note_restarted(nodes: tuple[int, ...]) -> None:
        restarted.update(nodes)
        interlock.found_restarted(nodes)

    with _reached(rig, simulated_start, load, lost_power, listener) as reached:
        if set_up_as is not None:
            counted, max_tension = set_up_as(read_drives(rig, reached.bus, reached.pump))
        group = make_drive_group(counted, reached.bus, reached.pump, max_tension=max_tension)
        try:
            remarks = group.configure(to_reset=to_reset, on_restarted=note_restarted)
            for remark in remarks:
                listener.remark(remark)
            true_pose: Callable[[], Pose] | None = None
            carry: Callable[[Load], None] = _happens_by_itself
            if (rehearsal := reached.rehearsal) is not None:
                true_pose, carry = lambda: rehearsal.pose, rehearsal.carry
            yield ReadyDrives(
                counted, group, true_pose, carry, tuple(sorted(restarted)), tuple(remarks)
            )
        finally:
            group.close()


def _happens_by_itself(_load: Load) -> None:
    """What a real gripper takes or leaves is nothing to send."""


def drives_of(
    document: RigDocument, simulated_start: Pose, load: Load, listener: Listener = SILENT
) -> AbstractContextManager[ReadyDrives]:
    """`open_drives` for a process of its own: takes what can be sent there.

    What the drives cannot do is in `ReadyDrives.remarks`, for the listener of the process that
    asked for them; the one given here is for a call in this process.
    """
    return open_drives(rig_from_document(document), simulated_start, load, listener=listener)


def unreferenced_drives_of(
    document: RigDocument,
    about: Pose,
    limit: float,
    lost_power: PowerLoss | None,
    listener: Listener = SILENT,
) -> AbstractContextManager[ReadyDrives]:
    """`open_drives` for a process of its own, for drives that count from anywhere.

    Args:
        document: The rig file.
        about: Where the platform is about, ``world_from_platform``.
        limit: Largest tension, [N]; none is set up that holds more.
        lost_power: What became of drives that are simulated there.
        listener: For a call in this process: receives what the drives cannot do.
    """
    rig = rig_from_document(document)

    def set_up_as(told: DriveSnapshot) -> tuple[Rig, float]:
        require_below(rig, told, limit)
        return counted_here(rig, told.positions.tolist(), about), limit

    load = empty_scene(rig).load
    return open_drives(
        rig, about, load, lost_power=lost_power, set_up_as=set_up_as, listener=listener
    )


def resting_drives_of(
    document: RigDocument, *, to_reset: bool = False
) -> AbstractContextManager[ReadyDrives]:
    """`open_drives` for a process of its own, for drives that stay where they are.

    Args:
        document: The rig file.
        to_reset: Also takes drives in fault, which are going to be reset.
    """
    rig = rig_from_document(document)
    load = empty_scene(rig).load
    set_up_as = partial(set_up_here, rig)
    return open_drives(rig, rig.home, load, to_reset=to_reset, set_up_as=set_up_as)


# Where the platform stands, from where its drives stand.


#: The stretch of the cables depends on the pose: rounds until the pose changes no more than this,
#: [m]; soft cables on a large robot need some twenty.
_SETTLED, _ROUNDS = 1e-8, 200


def current_pose(rig: Rig, counts: Array, load: Load) -> Pose:
    """The pose whose planned drive positions are these, ``world_from_platform``.

    Args:
        rig: The robot; its drives are referenced.
        counts: Positions of the drives, shape (m,), [counts].
        load: What the platform carries.

    Raises:
        Refused: No pose of the workspace fits them within the rig's start tolerance.
        TensionInfeasible: The cables cannot hold the platform there.
        Fault: The search for a pose ended without one.
    """
    winches = WinchMap(rig)
    unstrained = winches.unstrained_from_counts(counts)
    tensions = working_tensions(rig, rig.home, load).tensions
    found = forward_kinematics(rig, winches.strained(unstrained, tensions))
    for _ in range(_ROUNDS):
        before = found.pose
        tensions = working_tensions(rig, before, load).tensions
        found = forward_kinematics(rig, winches.strained(unstrained, tensions), before)
        if found.pose.distance_to(before) < _SETTLED:
            break
    else:
        raise Fault(
            "the platform pose could not be computed from the drive positions",
            where="drive positions",
            why="the solver did not converge",
            next_step="report this with the rig file and the positions; nothing has moved",
        )
    place = found.pose.position
    inside = np.all((rig.workspace_lower <= place) & (place <= rig.workspace_upper))
    if not (inside and found.worst <= rig.motion.start_tolerance):
        x, y, z = place * 1000.0
        raise Refused(
            f"the drive positions fit no pose in the workspace: the nearest is {x:.1f}, {y:.1f},"
            f" {z:.1f} mm, with a cable {found.worst * 1000:.1f} mm off",
            where="drive positions",
            why="the homing reference is lost, a cable slipped, or the rig file is wrong",
            next_step="home the drives at a known pose (home_counts in the rig file);"
            " nothing was moved",
        )
    return found.pose
