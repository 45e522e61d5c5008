"""Options of every verb that reaches drives: which bus, and how they are moved."""

from __future__ import annotations

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
