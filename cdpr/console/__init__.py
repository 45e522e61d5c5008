"""The operator's console: a web page to monitor and operate the robot.

A client of the command socket and of the public API in a separate process. Motions are started as
verbs of the command line, and continue when the console ends.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from model.lazy import lazy_names

if TYPE_CHECKING:
    from cdpr.console.foxglove import FoxgloveStream, foxglove_stream, layout_text
    from cdpr.console.server import run_server

__all__ = ["FoxgloveStream", "foxglove_stream", "layout_text", "run_server"]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "cdpr.console.foxglove": "FoxgloveStream foxglove_stream layout_text",
            "cdpr.console.server": "run_server",
        },
    )
