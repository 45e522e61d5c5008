"""Why drives are not set up, whatever they speak."""

from __future__ import annotations

from cdpr.errors import Refused

SETTING_UP = "configuring the drives"


def answers_twice(node: int) -> Refused:
    """Two devices have the node id of a drive."""
    return Refused(
        f"drive {node} answers twice",
        where=SETTING_UP,
        why="two devices have this node id, or `cdpr sim` was started twice",
        next_step="give every device on the bus its own node id",
        values={"node": node},
    )


def moved_by_another(node: int, what: str, where: str) -> Refused:
    """A drive is not at rest: it is ``what``, as it told in ``where``."""
    return Refused(
        f"drive {node} is {what}",
        where=f"drive {node}, {where}",
        why="another program moves it, or it did not stop when its master went away",
        next_step="end the other program; otherwise press the emergency stop",
        values={"node": node},
    )


def in_fault(node: int, what: str, where: str, why: str) -> Refused:
    """A drive stopped itself; ``what`` it tells of it, in ``where``, and what that means."""
    return Refused(
        f"drive {node} is in fault{what}",
        where=f"drive {node}, {where}",
        why=why,
        next_step="remove the cause, then `cdpr reset RIG`",
        values={"node": node},
    )


def keeps_another(node: int, place: str, found: str, wanted: str, why: str, manual: str) -> Refused:
    """A drive does not keep a setting.

    Args:
        node: Of the drive.
        place: Of the setting, such as ``object 6007h:00 abort connection option code``.
        found: What it holds.
        wanted: What it must hold.
        why: What that is needed for.
        manual: Where the setting is described.
    """
    return Refused(
        f"the drive holds {found}, it must hold {wanted}",
        where=f"drive {node}, {place}",
        why=f"needed because: {why}",
        next_step=f"look it up in {manual}; the drives stay as they are",
        values={"node": node, "object": place, "found": found, "wanted": wanted},
    )
