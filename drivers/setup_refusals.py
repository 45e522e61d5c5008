"""Refusals of drives during set-up, independent of the protocol.

Faults of the bus are in `drivers.can_errors`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from model.errors import Refused

SETTING_UP = "configuring the drives"


class SdoAborted(Refused):
    """A drive aborted the transfer of an object: no other refusal says anything about an object.

    Attributes:
        abort_code: Source: CiA 301, 7.2.4.3.17.
    """

    def __init__(self, node: int, target: str, abort_code: int, text: str) -> None:
        super().__init__(
            f"the drive refused: {text}",
            where=f"drive {node}, object {target}",
            next_step="compare the object with the drive's manual and its EDS file;"
            " `cdpr doctor RIG --drives` lists all objects of all drives",
            values={"node": node, "object": target, "abort_code": abort_code},
        )
        self.abort_code = abort_code


class DriveRestarted(Refused):
    """A drive restarted while it was configured.

    Attributes:
        node: Of the drive.
    """

    def __init__(self, node: int) -> None:
        """Takes the node; no ``node`` in the values, so that the set-up ends at once."""
        super().__init__(
            f"drive {node} restarted during set-up",
            where=SETTING_UP,
            why="its power failed or another program reset it: what was written to it is lost",
            next_step="check its power supply, end other programs, then repeat the command; no"
            " drive is enabled",
            values={"nodes": str(node)},
        )
        self.node = node


class TorqueLost(Refused):
    """A drive that held its cable lost its torque while it was configured."""

    def __init__(self, node: int, state: str) -> None:
        """Takes node and state of the drive; no ``node`` in the values, as for `DriveRestarted`."""
        super().__init__(
            f"drive {node} held its cable before the set-up and is now in {state}",
            where=SETTING_UP,
            why="it removes its torque when it leaves the NMT state operational, or an error or its"
            " safe torque off removed it; the platform may have dropped",
            next_step="support the platform and press the emergency stop: each repeated command may"
            " release one more drive; drives that do this between two commands cannot be used;"
            " otherwise run `cdpr home`",
            values={"nodes": str(node)},
        )


def answers_twice(node: int, otherwise: str = "", cure: str = "") -> Refused:
    """Two devices have the same node id; ``otherwise`` is another possible cause, with its cure."""
    return Refused(
        f"drive {node} answered twice",
        where=SETTING_UP,
        why="two devices have this node id, or `cdpr sim` was started twice"
        + (f", or {otherwise}" if otherwise else ""),
        next_step="give each device on the bus a unique node id" + (f", or {cure}" if cure else ""),
        values={"node": node},
    )


def moved_by_another(node: int, what: str, where: str) -> Refused:
    """A drive is not at rest, but ``what``, as reported in ``where``."""
    return Refused(
        f"drive {node} is {what}",
        where=f"drive {node}, {where}",
        why="another program moves it, or it did not stop when its master was lost",
        next_step="end the other program, or press the emergency stop",
        values={"node": node},
    )


def in_fault(node: int, what: str, where: str, why: str) -> Refused:
    """A drive is in fault: ``what`` it reports in ``where``, and ``why``."""
    return Refused(
        f"drive {node} is in fault{what}",
        where=f"drive {node}, {where}",
        why=why,
        next_step="remove the cause, then run `cdpr reset RIG`",
        values={"node": node},
    )


def wrong_setting(
    node: int, setting: str, found: str, wanted: str, why: str, next_step: str
) -> Refused:
    """A drive holds a wrong value of a setting.

    Args:
        setting: Such as ``object 6007h:00 abort connection option code``.
        found: Value in the drive.
        why: Reason for the required value.
        next_step: What the user can do now.
    """
    return Refused(
        f"the drive has {found}; {wanted} is required",
        where=f"drive {node}, {setting}",
        why=f"required because: {why}",
        next_step=next_step,
        values={"node": node, "object": setting, "found": found, "wanted": wanted},
    )


def combined_refusal(refusals: Sequence[Refused], left: str) -> Refused:
    """One refusal that lists all others, with equal ones of several drives merged.

    Args:
        refusals: Of the drives; at least one.
        left: The state that the drives are left in.
    """
    nodes: dict[str, list[str]] = {}
    for each in refusals:
        node = str(each.values.get("node", ""))
        setting = each.where.removeprefix(f"drive {node}, ")
        why = f" ({each.why})" if each.why else ""
        listed = nodes.setdefault(f"{setting}: {each.what}{why}", [])
        if node not in listed:
            listed.append(node)
    drives = {node for each in nodes.values() for node in each}
    if len(nodes) == len(drives) == 1:
        refusals[0].next_step = f"{refusals[0].next_step}; {left}"
        return refusals[0]
    found = "".join(f"\n  drive {', '.join(each)}, {text}" for text, each in nodes.items())
    return Refused(
        f"{len(nodes)} object{'s' if len(nodes) > 1 else ''} of {len(drives)}"
        f" drive{'s' if len(drives) > 1 else ''} have unsuitable values:{found}",
        where=SETTING_UP,
        next_step="compare with the drive's manual; `cdpr doctor RIG --drives` lists every object,"
        f" and drives.profile of the rig file describes the drives; {left}",
        values={"nodes": ", ".join(sorted(drives)), "count": len(nodes)},
    )


class Refusals:
    """Collects refusals of drives, so that one message reports all."""

    def __init__(self) -> None:
        self._found: list[Refused] = []

    def note(self, action: Callable[..., object], *arguments: Any) -> bool:
        """Calls an action; records a refusal of the drive and returns False."""
        try:
            action(*arguments)
        except Refused as error:
            if "node" not in error.values:  # as another master: the other drives do not matter
                raise
            self._found.append(error)
            return False
        return True

    def raise_any(self, left: str) -> None:
        """Raises if a refusal was recorded.

        Args:
            left: The state that the drives are left in.

        Raises:
            Refused: With all recorded refusals.
        """
        if self._found:
            raise combined_refusal(self._found, left)
