"""One look for all pictures of maps."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CLOSED = "#3f9b6b"
FEASIBLE = "#2f7fb5"
FREE = "#c98500"
FRAME = "#c0392b"
LIMIT = "#d0004f"
VERDICT_COLOURS = ("#dcefe3", "#2b2f36", "#2f7fb5", "#e08a3c", "#c1465a")
"""In the order of `planner.workspace.computing.VERDICTS`."""
MUTED = "#5c6675"
DOTS_PER_INCH = 150

SETTINGS: dict[Any, Any] = {  # matplotlib types the keys as a union of every setting's name
    "svg.fonttype": "none",
    "svg.hashsalt": "cdpr",
    "font.family": "sans-serif",
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": MUTED,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "legend.frameon": False,
    "figure.dpi": DOTS_PER_INCH,
    "savefig.dpi": DOTS_PER_INCH,
}


def new_figure(
    width: float, height: float, layout: Literal["constrained"] | None = "constrained"
) -> Figure:
    """An empty figure, [in], outside of any window system."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout=layout)
