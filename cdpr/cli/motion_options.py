"""Options of every verb that reaches drives: which bus, and how they are moved."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import typer

InterfaceOption = Annotated[
    str | None,
    typer.Option("--interface", help="python-can interface instead of the rig file's"),
]
ChannelOption = Annotated[str | None, typer.Option("--channel", help="its channel")]
FastOption = Annotated[
    bool, typer.Option("--fast", help="simulated time: as fast as the computer can")
]
YesOption = Annotated[bool, typer.Option("--yes", help="do not ask before a real bus moves")]
WithoutRealTimeOption = Annotated[
    bool,
    typer.Option("--without-real-time", help="move even if real-time scheduling is denied"),
]


def require_unused(verb: str, options: Mapping[str, object], why: str) -> None:
    """Refuses options that would have no effect: whoever gave one expects something else.

    Args:
        verb: As it is called, ``cdpr jog``.
        options: Name and value; None and False are not given.
        why: They have no effect.

    Raises:
        BadInput: One was given; with the names of all.
    """
    from cdpr.errors import BadInput

    given = [name for name, value in options.items() if value is not None and value is not False]
    if given:
        raise BadInput(
            f"no effect here: {', '.join(given)}",
            where=verb,
            why=why,
            next_step=f"leave them out, or see `{verb} --help`",
        )
