"""Line charts as SVG that keeps its text size at any width, and the data for `charts.js`.

The lines are in an inner SVG that stretches with the page; ticks and names are positioned in
percent of its size. Colours are the page's variables, distinguishable with any colour vision (Okabe
and Ito's palette). The script adds zoom and values under the pointer; the page is complete without
it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any
from unicodedata import east_asian_width

import numpy as np
from numpy.typing import NDArray

from model.pose import Array

MOST_POINTS = 900
_SIZE = 1000.0
"""Width and height of the inner SVG's coordinates."""
DASHED, DOTTED, DASH_DOTTED = "dashed", "dotted", "dash-dotted"
"""CSS variables of the dash patterns, in `base.css`."""
_COLUMN = 7.0
"""Mean width of a letter of 11 px, [px]."""
_SERIES = 8
"""Number of the colours of `base.css` for lines of one kind."""


@dataclass(frozen=True, slots=True, eq=False)
class ChartLine:
    """A line of a chart; NaN breaks it.

    Attributes:
        name: In the legend and beside values; empty to leave it out there.
        x: Shape (n,), increasing.
        y: Shape (n,).
        role: CSS variable of its colour, such as ``encoder``.
        width: [px].
        dash: CSS variable of its dash pattern, such as `DASHED`; empty for a full line.
        opacity: 1 for opaque.
        band: Lower and upper edge of a band around it, each of shape (n,).
        fits: Whether the range of y includes it.
    """

    name: str
    x: Array
    y: Array
    role: str
    width: float = 1.5
    dash: str = ""
    opacity: float = 1.0
    band: tuple[Array, Array] | None = None
    fits: bool = True


@dataclass(frozen=True, slots=True)
class Span:
    """A shaded interval of x, and its name, cut if too long for the chart; empty for none."""

    begin: float
    end: float
    name: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """One chart.

    Attributes:
        title: Plain text above it.
        alternative: Plain-text alternative for readers who do not see the chart.
        quantity: Quantity of y.
        unit: Of y; may be empty.
        lines: In drawing order.
        x_range: Both ends of x.
        x_quantity: Quantity of x.
        x_unit: Of x.
        spans: Shaded intervals of x.
        from_zero: Whether y begins at 0 where no value is negative.
        y_includes: Values that the range of y includes, so that charts can be compared.
        logarithmic: Whether y holds decimal logarithms of the quantity.
        names_at_ends: Whether lines are named at their right ends instead of in a legend.
        height: [px].
        group: Charts of one group zoom together.
    """

    title: str
    alternative: str
    quantity: str
    unit: str
    lines: tuple[ChartLine, ...]
    x_range: tuple[float, float]
    x_quantity: str = "time"
    x_unit: str = "s"
    spans: tuple[Span, ...] = ()
    from_zero: bool = False
    y_includes: tuple[float, ...] = ()
    logarithmic: bool = False
    names_at_ends: bool = False
    height: int = 190
    group: str = "time"


def series_style(index: int) -> tuple[str, str]:
    """Role and dash of one of several lines of one kind, such as of a cable; 24 are different."""
    return f"series{index % _SERIES + 1}", ("", DASHED, DASH_DOTTED)[index // _SERIES % 3]


def charts(*parts: Chart) -> str:
    """Charts below each other; HTML."""
    return "".join(map(_figure, parts))


def chart_grid(parts: Iterable[Chart]) -> str:
    """Small charts beside each other where there is room; HTML."""
    return f'<div class="plots">{"".join(map(_figure, parts))}</div>'


def _figure(chart: Chart) -> str:
    low, high = _y_range(chart)
    text = escape(chart.alternative, quote=True)
    kind = "plot ends" if chart.names_at_ends else "plot"
    inner = "".join(_mark(chart, span) for span in chart.spans)
    inner += "".join(_drawn(line, chart.x_range, (low, high)) for line in chart.lines)
    return (
        f'<figure class="{kind}"><figcaption><b>{escape(chart.title)}</b>{_legend(chart)}'
        f'</figcaption><div class="area" style="height:{chart.height}px">'
        f'<svg role="img" aria-label="{text}" tabindex="0">'
        f'<g class="ticks">{_ticks(chart, low, high)}</g>'
        f'<svg class="lines" viewBox="0 0 {_SIZE:g} {_SIZE:g}" preserveAspectRatio="none"'
        f' width="100%" height="100%">{inner}</svg>'
        f'<g class="names">{_names(chart, low, high)}</g></svg></div>'
        f'<script type="application/json">{_data(chart, low, high)}</script></figure>'
    )


def _legend(chart: Chart) -> str:
    if chart.names_at_ends:
        return ""
    return "".join(
        f'<span class="key"><svg width="26" height="10" aria-hidden="true"><path d="M1 5H25"'
        f" {_stroke(line)}/></svg>{escape(line.name)}</span>"
        for line in chart.lines
        if line.name
    )


def _stroke(line: ChartLine) -> str:
    return f'fill="none" vector-effect="non-scaling-stroke" style="{_style(line)}"'


def _style(line: ChartLine) -> str:
    """CSS of a line in the chart, in its legend and under the pointer."""
    dash = f";stroke-dasharray:var(--{line.dash})" if line.dash else ""
    return (
        f"stroke:var(--{line.role});stroke-width:{line.width:g}px;"
        f"stroke-opacity:{line.opacity:g}{dash}"
    )


def _y_range(chart: Chart) -> tuple[float, float]:
    """From the smallest to the largest value with a little room."""
    values = [a for line in chart.lines if line.fits for a in (line.y, *(line.band or ()))]
    values.append(np.array(chart.y_includes))
    known = np.concatenate([np.asarray(v)[np.isfinite(v)] for v in values])
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    room = 0.06 * (high - low) or 0.05 * abs(high) or 1.0
    at_zero = chart.from_zero and low >= 0.0
    return (0.0 if at_zero else low - room), high + room


def round_step(least: float) -> float:
    """The smallest of 1, 2 or 5 times a power of ten that is not below ``least``."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(f * power for f in (1.0, 2.0, 5.0, 10.0) if f * power >= least * (1 - 1e-9))


def ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Round numbers between two ends, steps of 1, 2 or 5 times a power of ten."""
    step = round_step((high - low) / most)
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def _ticks(chart: Chart, low: float, high: float) -> str:
    """Grid lines, numbers and names of both axes; `charts.js` draws the same after a zoom."""
    begin, end = chart.x_range
    across, up = ticks(begin, end), ticks(low, high, 5)
    if chart.logarithmic:
        up = [v for v in up if abs(v - round(v)) < 1e-9]
    parts = []
    for value in across:
        at = f"{(value - begin) / (end - begin):.4%}"
        parts.append(f'<line x1="{at}" x2="{at}" y1="0" y2="100%"/>')
        parts.append(f'<text class="x" x="{at}" y="100%" dy="16">{value:.10g}</text>')
    for value in up:
        at = f"{(high - value) / (high - low):.4%}"
        number = 10.0**value if chart.logarithmic else value
        parts.append(f'<line x1="0" x2="100%" y1="{at}" y2="{at}"/>')
        parts.append(f'<text class="y" x="0" dx="-6" y="{at}" dy="4">{number:.10g}</text>')
    parts.append(f'<text class="unit" x="0" dx="-44" y="-7">{escape(_of(chart))}</text>')
    x_name = escape(f"{chart.x_quantity} [{chart.x_unit}]")
    parts.append(f'<text class="unit end" x="100%" y="100%" dy="31">{x_name}</text>')
    for span in chart.spans:
        at = f"{((span.begin + span.end) / 2.0 - begin) / (end - begin):.4%}"
        name = escape(_shortened(span.name, chart.height))
        parts.append(f'<text class="span" x="{at}" y="4">{name}</text>')
    return "".join(parts)


def _shortened(name: str, height: float) -> str:
    """A vertical name, cut where it would reach beyond a chart of this height, [px]."""
    columns = 0
    for k, letter in enumerate(name):
        columns += 2 if east_asian_width(letter) in "WF" else 1
        if columns > (height - 8.0) / _COLUMN:
            return f"{name[: k - 1]}…"
    return name


def _of(chart: Chart) -> str:
    return f"{chart.quantity} [{chart.unit}]" if chart.unit else chart.quantity


def _mark(chart: Chart, span: Span) -> str:
    begin, end = chart.x_range
    x, width = ((v / (end - begin)) * _SIZE for v in (span.begin - begin, span.end - span.begin))
    return (
        f'<rect class="span" x="{x:.2f}" width="{max(width, 1.0):.2f}" y="-9000" height="19000"/>'
    )


def _drawn(line: ChartLine, x_range: tuple[float, float], y_range: tuple[float, float]) -> str:
    x = (line.x - x_range[0]) / (x_range[1] - x_range[0]) * _SIZE
    scale = _SIZE / (y_range[1] - y_range[0])
    y, text = (y_range[1] - line.y) * scale, ""
    if line.band is not None:
        low, high = ((y_range[1] - edge) * scale for edge in line.band)
        for part in _unbroken(low + high):
            points = [*zip(x[part], high[part], strict=True)]
            points += [*zip(x[part][::-1], low[part][::-1], strict=True)]
            text += f'<path d="{_polyline(points)}Z" style="fill:var(--{line.role})" opacity=".2"/>'
    path = "".join(_polyline(zip(x[part], y[part], strict=True)) for part in _unbroken(y))
    return f'{text}<path d="{path}" {_stroke(line)}/>' if path else text


def _unbroken(values: Array) -> list[slice]:
    """Slices of consecutive finite values."""
    known = np.concatenate([[False], np.isfinite(values), [False]])
    ends = np.flatnonzero(known[1:] != known[:-1])
    return [slice(int(a), int(b)) for a, b in ends.reshape(-1, 2)]


def _polyline(points: Iterable[tuple[float, float]]) -> str:
    text = "L".join(f"{x:.2f} {y:.2f}" for x, y in points)
    return f"M{text}" if "L" in text else f"M{text}h.1"


def _names(chart: Chart, low: float, high: float) -> str:
    """Names at the right ends of lines with a piece of each, spread so that none overlap."""
    if not chart.names_at_ends:
        return ""
    lines = [line for line in chart.lines if line.name and np.isfinite(line.y).any()]
    last = [float(line.y[np.isfinite(line.y)][-1]) for line in lines]
    ends = [(high - value) / (high - low) for value in last]
    label_ys = spread(ends, 14.0 / chart.height)
    return "".join(
        f'<svg x="100%" y="{label_y:.2%}"><path d="M6 0H22" {_stroke(line)}/>'
        f'<text x="26" dy="4">{escape(line.name)}</text></svg>'
        for line, label_y in zip(lines, label_ys, strict=True)
    )


def _data(chart: Chart, low: float, high: float) -> str:
    """Data for the script: JSON that cannot close its element."""
    data: dict[str, Any] = {
        "group": chart.group,
        "x": [_rounded(v) for v in chart.x_range],
        "y": [low, high],
        "quantity": _of(chart),
        "unit": chart.unit,
        "xQuantity": f"{chart.x_quantity} [{chart.x_unit}]",
        "xUnit": chart.x_unit,
        "log": chart.logarithmic,
        "zero": chart.from_zero,
        "spans": [[s.begin, s.end, _shortened(s.name, chart.height)] for s in chart.spans],
        "lines": [_line_data(line) for line in chart.lines],
    }
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c")


def _line_data(line: ChartLine) -> dict[str, Any]:
    found: dict[str, Any] = {"name": line.name, "stroke": _style(line), "fits": line.fits}
    found |= {"x": _column(line.x), "y": _column(line.y)}
    if line.band is not None:
        found |= {"low": _column(line.band[0]), "high": _column(line.band[1])}
    return found


def _column(values: Array) -> list[float | None]:
    return [_rounded(v) if math.isfinite(v) else None for v in np.asarray(values).tolist()]


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


# Thinning, gaps, and spread of labels.


def thinned(time: Array, values: Array, most: int = MOST_POINTS) -> tuple[Array, Array]:
    """A line with at most about ``most`` points that still shows every peak.

    Keeps the first smallest and the first largest value of each of ``most / 2`` equal intervals.

    Args:
        time: Shape (n,).
        values: Shape (n,); NaN is left out.
    """
    known = np.flatnonzero(np.isfinite(values))
    if len(known) <= most:
        return time[known], values[known]
    chosen = _extremes(known, most // 2, [values])
    return time[chosen], values[chosen]


def with_gaps(
    time: Array, *columns: Array, most: int = MOST_POINTS, step: float = 0.0
) -> tuple[Array, ...]:
    """Lines of common samples, thinned, with a NaN where samples are missing.

    A line then does not bridge the gap. At most about ``most`` points are left, among them every
    peak of each line; of several gaps that are too short to be seen one is left.

    Args:
        time: Shape (n,).
        columns: A line and the edges of its band, each of shape (n,).
        step: Largest step in time of samples of which none is missing, if their steps differ.
    """
    if len(time) < 3:
        return (time, *columns)
    steps = np.diff(time)
    gaps = np.flatnonzero(steps > 2.5 * max(float(np.median(steps)), step)) + 1
    time = np.insert(time, gaps, (time[gaps - 1] + time[gaps]) / 2.0)
    columns = tuple(np.insert(column, gaps, np.nan) for column in columns)
    if len(time) <= most:
        return (time, *columns)
    chosen = _extremes(np.arange(len(time)), most // (2 * len(columns) + 1), columns)
    return (time[chosen], *(column[chosen] for column in columns))


def _extremes(rows: NDArray[np.int64], parts: int, columns: Sequence[Array]) -> NDArray[np.int64]:
    """The ends of rows and, in each of ``parts`` parts, every column's extremes and first gap."""
    keep = {int(rows[0]), int(rows[-1])}
    for part in np.array_split(rows, parts):
        for values in columns:
            known = part[np.isfinite(values[part])]
            if len(known):
                keep |= {int(known[np.argmin(values[known])]), int(known[np.argmax(values[known])])}
            if len(known) < len(part):
                keep.add(int(part[np.argmax(~np.isfinite(values[part]))]))
    return np.array(sorted(keep))


def spread(values: Sequence[float], gap: float) -> Array:
    """Positions of labels: near their values, at least ``gap`` apart, in the same order."""
    wanted = np.asarray(list(values), dtype=np.float64)
    order = np.argsort(wanted)
    positions = wanted[order].copy()
    for _ in range(200):
        short = gap - np.diff(positions)
        close = np.flatnonzero(short > 1e-9 * gap)
        if not close.size:
            break
        for i in close:
            push = max(gap - (positions[i + 1] - positions[i]), 0.0) / 2.0
            positions[i] -= push
            positions[i + 1] += push
    result = np.empty_like(positions)
    result[order] = positions
    return result
