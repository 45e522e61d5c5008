"""Opens the drives of a rig: on a real bus, or simulated in this process behind a virtual one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cdpr.poses import Pose
    from cdpr.rig import Rig
    from cdpr.rig_file import RigDocument
    from cdpr.scene import Load
    from drivers.drive_group import CycleStatus
    from executor.real_time_job import ReadyDrives
    from simulation.power_loss import PowerLoss


@contextmanager
def open_drives(
    rig: Rig,
    simulated_start: Pose,
    load: Load,
    *,
    to_reset: bool = False,
    lost_power: PowerLoss | None = None,
    set_up_as: Callable[[CycleStatus], tuple[Rig, float]] | None = None,
) -> Iterator[ReadyDrives]:
    """Opens the bus and configures the drives; closes both at the end.

    Drives that are found switched on since their last set-up lose their reference here.

    Args:
        rig: The robot and its bus.
        simulated_start: Where the platform stands when the drives are simulated here.
        load: What it carries then.
        to_reset: Also takes drives in fault, which are going to be reset.
        lost_power: What became of drives that are simulated here.
        set_up_as: For drives that are not referenced, from what they tell: the rig as they count,
            and the largest tension [N] that their torque limit allows.

    Raises:
        BadInput: python-can has no such interface.
        HardwareMissing: The bus cannot be opened or a drive does not answer.
        Refused: The bus is too slow, a drive does not keep a setting, or somebody else sets it up.
    """
    from cdpr.cli.output import err
    from drivers.bus import IN_PROCESS, BusSettings, open_bus
    from drivers.drive_group import make_drive_group
    from executor.custody import Custody
    from executor.real_time_job import ReadyDrives
    from executor.set_up_lock import SetUpLock

    custody, counted = Custody(rig), rig
    settings = BusSettings.of(rig)
    restarted: set[int] = set()

    def note_restarted(nodes: tuple[int, ...]) -> None:
        restarted.update(nodes)
        custody.found_restarted(nodes)

    with ExitStack() as stack:
        stack.enter_context(SetUpLock(settings).held())
        bus = open_bus(settings)
        stack.callback(bus.shutdown)
        pump, true_pose = None, None
        carry: Callable[[Load], None] = _happens_by_itself
        if settings.interface == IN_PROCESS:
            from simulation.simulate import make_rehearsal

            far_end = open_bus(settings)
            stack.callback(far_end.shutdown)
            rehearsal = make_rehearsal(rig, far_end, simulated_start, load)
            if lost_power is not None:
                lost_power.happen_to(rig, rehearsal.plant, [d.motor for d in rehearsal.drives])
            pump, true_pose, carry = rehearsal.pump, lambda: rehearsal.pose, rehearsal.carry
        group = make_drive_group(rig, bus, pump)
        stack.callback(group.close)
        if set_up_as is not None:
            group.configure(to_reset=to_reset, on_restarted=note_restarted)
            counted, max_tension = set_up_as(group.read_positions())
            group.close()
            group = make_drive_group(counted, bus, pump, max_tension=max_tension)
            stack.callback(group.close)
        remarks = group.configure(to_reset=to_reset, on_restarted=note_restarted)
        for remark in remarks:
            err.print(f"[yellow]remark[/] {remark}", soft_wrap=True)
        yield ReadyDrives(counted, group, true_pose, carry, tuple(sorted(restarted)))


def _happens_by_itself(_load: Load) -> None:
    """What a real gripper takes or leaves is nothing to send."""


def drives_of(
    document: RigDocument, simulated_start: Pose, load: Load
) -> AbstractContextManager[ReadyDrives]:
    """`open_drives` for a process of its own: takes what can be sent there."""
    from cdpr.rig import rig_from_document

    return open_drives(rig_from_document(document), simulated_start, load)


def unreferenced_drives_of(
    document: RigDocument, about: Pose, limit: float, lost_power: PowerLoss | None
) -> AbstractContextManager[ReadyDrives]:
    """`open_drives` for a process of its own, for drives that count from anywhere.

    Args:
        document: The rig file.
        about: Where the platform is about, ``world_from_platform``.
        limit: Largest tension, [N]; none is set up that holds more.
        lost_power: What became of drives that are simulated there.
    """
    from cdpr.rig import rig_from_document
    from cdpr.scene import nothing_in_the_way
    from executor.unreferenced import counted_here, require_below

    rig = rig_from_document(document)

    def set_up_as(told: CycleStatus) -> tuple[Rig, float]:
        require_below(rig, told, limit)
        return counted_here(rig, told.positions.tolist(), about), limit

    load = nothing_in_the_way(rig).load
    return open_drives(rig, about, load, lost_power=lost_power, set_up_as=set_up_as)
