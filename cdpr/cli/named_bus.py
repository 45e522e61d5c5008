"""The rig of a file on the bus that was named, and whether time may be simulated there."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cdpr.rig import Rig


def rig_on_bus(path: Path, interface: str | None, channel: str | None) -> Rig:
    """The rig of a file, on another bus when one is named."""
    from cdpr.rig import load_rig, rig_from_document

    document = load_rig(path).document
    changes = {"interface": interface, "channel": channel}
    given = {key: value for key, value in changes.items() if value is not None}
    bus = document.bus.model_copy(update=given)
    return rig_from_document(document.model_copy(update={"bus": bus}))


def require_other_process(rig: Rig) -> None:
    """The bus reaches drives that outlive this process.

    Raises:
        BadInput: It is the interface ``virtual``.
    """
    from cdpr.errors import BadInput
    from drivers.bus import IN_PROCESS

    if rig.document.bus.interface == IN_PROCESS:
        raise BadInput(
            "nothing is kept on the interface 'virtual'",
            where="bus",
            why="its drives are simulated in the process of a run and end with it",
            next_step="name the bus with --interface and --channel",
        )


def require_own_time(fast: bool, in_process: bool) -> None:
    """Only drives that are simulated in this process can go faster than time.

    Raises:
        BadInput: Others were to.
    """
    from cdpr.errors import BadInput

    if fast and not in_process:
        raise BadInput(
            "--fast needs drives that are simulated in this process",
            where="--fast",
            why="time on a real bus cannot be made faster",
            next_step="leave --fast out, or use the interface 'virtual'",
        )
