"""One look for all figures: roles instead of colours, so that a page can be light or dark.

Matplotlib draws with a stand-in colour for each role; the finished SVG names the page's CSS
variable (``--planned`` …) instead. The palette on the page is Okabe and Ito's, which people with
any colour vision can tell apart.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from cdpr.poses import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Role → stand-in; each is unique and used for nothing else.
STAND_IN = {
    "ink": "#010101",
    "muted": "#020101",
    "grid": "#030101",
    "surface": "#040101",
    "planned": "#050101",
    "encoder": "#060101",
    "tag": "#070101",
    "limit": "#080101",
    "obstacle": "#090101",
    "platform": "#0a0101",
    "cable": "#0b0101",
    "tree": "#0c0101",
    "raw": "#0d0101",
    "frame": "#0e0101",
    **{f"series{i + 1}": f"#0{i + 1}0202" for i in range(8)},
}
WIDTH = 10.0
"""Width of every figure, [in]; on the page it is as wide as the text."""
MOST_POINTS = 700

_SETTINGS: Any = {  # matplotlib types the keys as a union of every setting's name
    "svg.fonttype": "none",
    "svg.hashsalt": "cdpr",
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": STAND_IN["muted"],
    "axes.labelcolor": STAND_IN["ink"],
    "axes.titlecolor": STAND_IN["ink"],
    "axes.facecolor": "none",
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.prop_cycle": f"cycler('color', {[STAND_IN[f'series{i + 1}'] for i in range(8)]})",
    "grid.color": STAND_IN["grid"],
    "grid.linewidth": 0.7,
    "text.color": STAND_IN["ink"],
    "xtick.color": STAND_IN["muted"],
    "ytick.color": STAND_IN["muted"],
    "xtick.labelcolor": STAND_IN["ink"],
    "ytick.labelcolor": STAND_IN["ink"],
    "lines.linewidth": 1.4,
    "figure.facecolor": "none",
    "legend.frameon": False,
    "legend.labelcolor": STAND_IN["ink"],
    "path.simplify_threshold": 0.2,
}


def new_figure(height: float) -> Figure:
    """An empty figure, ``height`` in inches; drawing and `as_svg` happen inside `settings`."""
    from matplotlib.figure import Figure

    return Figure(figsize=(WIDTH, height), layout="constrained")


def settings() -> Any:
    """Context in which figures are made and saved."""
    import matplotlib as mpl

    return mpl.rc_context(_SETTINGS)


def as_svg(figure: Figure, name: str, alternative: str) -> str:
    """A figure as an SVG element for a page: its colours are the page's, its ids its own.

    Args:
        figure: The figure.
        name: Prefix of its ids, unique in the page.
        alternative: What a reader who does not see it should know; no markup.
    """
    from html import escape

    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r'(href="|url\()#', rf"\1#{name}-", text)
    for role, colour in STAND_IN.items():
        text = text.replace(colour, f"var(--{role})")
    head, rest = text.split(">", 1)
    box = re.search(r'viewBox="[^"]*"', head)
    if box is None:
        raise RuntimeError("matplotlib wrote an SVG without a viewBox")
    label = escape(alternative, quote=True)
    opening = f'<svg {box[0]} role="img" aria-label="{label}" xmlns="http://www.w3.org/2000/svg"'
    return f'{opening} xmlns:xlink="http://www.w3.org/1999/xlink">{rest}'


def thinned(time: Array, values: Array, most: int = MOST_POINTS) -> tuple[Array, Array]:
    """A line with at most about ``most`` points that still shows every peak.

    Keeps the first smallest and the first largest value of each of ``most / 2`` equal stretches.

    Args:
        time: Shape (n,).
        values: Shape (n,); NaN is left out.
        most: Points to keep.
    """
    known = np.flatnonzero(np.isfinite(values))
    if len(known) <= most:
        return time[known], values[known]
    keep: set[int] = {int(known[0]), int(known[-1])}
    for stretch in np.array_split(known, most // 2):
        keep.add(int(stretch[np.argmin(values[stretch])]))
        keep.add(int(stretch[np.argmax(values[stretch])]))
    chosen = np.array(sorted(keep))
    return time[chosen], values[chosen]


def with_gaps(time: Array, *columns: Array) -> tuple[Array, ...]:
    """Puts a NaN where samples are missing, so that a line does not bridge the gap."""
    if len(time) < 3:
        return (time, *columns)
    steps = np.diff(time)
    gaps = np.flatnonzero(steps > 2.5 * np.median(steps)) + 1
    between = (time[gaps - 1] + time[gaps]) / 2.0
    return (np.insert(time, gaps, between), *(np.insert(c, gaps, np.nan) for c in columns))


def legend_above(axes: Axes) -> None:
    """Names the lines over the axes, where no data can be."""
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(
        handles,
        labels,
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        ncols=len(labels),
        borderaxespad=0.2,
        handlelength=1.8,
        columnspacing=1.4,
    )


def spread(values: Iterable[float], gap: float) -> Array:
    """Places for labels: near their values, at least ``gap`` apart, in the same order."""
    wanted = np.asarray(list(values), dtype=np.float64)
    order = np.argsort(wanted)
    places = wanted[order].copy()
    for _ in range(200):
        short = gap - np.diff(places)
        close = np.flatnonzero(short > 1e-9 * gap)
        if not close.size:
            break
        for i in close:
            push = max(gap - (places[i + 1] - places[i]), 0.0) / 2.0
            places[i] -= push
            places[i + 1] += push
    result = np.empty_like(places)
    result[order] = places
    return result


def label_right(axes: Axes, height: float, lines: list[tuple[str, float, str]]) -> None:
    """Writes names at the right ends of lines, spread so that they do not cover each other.

    Args:
        axes: Axes whose limits are final.
        height: Of the axes, about, [in].
        lines: For each line its name, its last value and its colour.
    """
    low, high = axes.get_ylim()
    gap = (high - low) * 0.165 / height
    places = spread([value for _, value, _ in lines], gap)
    for (name, value, colour), place in zip(lines, places, strict=True):
        axes.annotate(
            name,
            (1.0, value),
            (1.025, place),
            xycoords=("axes fraction", "data"),
            textcoords=("axes fraction", "data"),
            color=colour,
            va="center",
            fontsize=8.5,
            arrowprops={"arrowstyle": "-", "color": colour, "lw": 0.7, "shrinkA": 0, "shrinkB": 0},
        )
