"""Opens the drives of a rig: on a real bus, or simulated in this process behind a virtual one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from can import BusABC

from drivers.can_bus import IN_PROCESS, BusSettings, open_bus
from drivers.drive_group import DriveSnapshot
from drivers.factory import make_drive_group, read_drives
from executor.control.preconditions import counted_here, require_below, set_up_here
from executor.interlock.interlock import MotionInterlock
from executor.interlock.locks import SetUpLock
from executor.kernels import ready_to_simulate
from executor.realtime.job import ReadyDrives
from model.errors import BadInput
from model.files.rig_file import RigDocument
from model.pose import Pose
from model.progress import SILENT, Listener
from model.rig import Rig, rig_from_document
from model.scene import Load, nothing_in_the_way

if TYPE_CHECKING:  # a real bus loads no simulator
    from simulation.ground_truth import PowerLoss
    from simulation.rig import SimulatedRig


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
    document: RigDocument, simulated_start: Pose, load: Load
) -> AbstractContextManager[ReadyDrives]:
    """`open_drives` for a process of its own: takes what can be sent there.

    What the drives cannot do is in `ReadyDrives.remarks`, for the listener of the process that
    asked for them.
    """
    return open_drives(rig_from_document(document), simulated_start, load)


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

    load = nothing_in_the_way(rig).load
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
    load = nothing_in_the_way(rig).load
    set_up_as = partial(set_up_here, rig)
    return open_drives(rig, rig.home, load, to_reset=to_reset, set_up_as=set_up_as)
