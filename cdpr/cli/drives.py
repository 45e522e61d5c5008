"""Opens the drives of a rig: on a real bus, or simulated in this process behind a virtual one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cdpr.poses import Pose
    from cdpr.rig import Rig
    from cdpr.scene import Load
    from drivers.drive_group import DriveGroup

#: python-can's interface inside one process; with it the drives are simulated here.
IN_PROCESS = "virtual"


@dataclass(frozen=True, slots=True)
class Drives:
    """Configured drives.

    Attributes:
        group: All of them.
        true_pose: Where the simulated platform is; None on a real bus.
        carry: Gives the simulated platform another load; on a real bus it happens by itself.
    """

    group: DriveGroup
    true_pose: Callable[[], Pose] | None
    carry: Callable[[Load], None]


@contextmanager
def open_drives(rig: Rig, simulated_start: Pose, load: Load) -> Iterator[Drives]:
    """Opens the bus and configures the drives; closes both at the end.

    Args:
        rig: The robot and its bus.
        simulated_start: Where the platform stands when the drives are simulated here.
        load: What it carries then.

    Raises:
        BadInput: python-can has no such interface.
        HardwareMissing: The bus cannot be opened or a drive does not answer.
        Refused: The bus is too slow, or a drive does not keep a setting.
    """
    from cdpr.cli.output import err
    from drivers.bus import BusSettings, open_bus
    from drivers.drive_group import make_drive_group

    settings = BusSettings.of(rig)
    with ExitStack() as stack:
        bus = open_bus(settings)
        stack.callback(bus.shutdown)
        pump, true_pose = None, None
        carry: Callable[[Load], None] = _happens_by_itself
        if settings.interface == IN_PROCESS:
            from simulation.rehearsal import Rehearsal

            far_end = open_bus(settings)
            stack.callback(far_end.shutdown)
            rehearsal = Rehearsal(rig, far_end, simulated_start, load)
            pump, true_pose, carry = rehearsal.pump, lambda: rehearsal.pose, rehearsal.carry
        group = make_drive_group(rig, bus, pump)
        stack.callback(group.close)
        for remark in group.configure():
            err.print(f"[yellow]remark[/] {remark}", soft_wrap=True)
        yield Drives(group, true_pose, carry)


def _happens_by_itself(_load: Load) -> None:
    """What a real gripper takes or leaves is nothing to send."""
