"""Maps as tables, arrays and one summary, with units in the names."""

from __future__ import annotations

import csv
import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner.workspace.computing import VERDICTS, Maps
from planner.workspace.grid import AXES
from planner.workspace.shown import shown_in

_DIGITS = 9


def arrays_of(maps: Maps) -> dict[str, NDArray[Any]]:
    """Axes ``x_mm`` …, and every map in the shape of the grid, by column name."""
    arrays: dict[str, NDArray[Any]] = {
        f"{letter}_mm": axis * 1e3 for letter, axis in zip(AXES, maps.grid.axes, strict=True)
    }
    for quantity in shown_in(maps):
        arrays[quantity.column] = maps.values[quantity.name] * quantity.scale
    return arrays | _answers(maps)


def csv_of(maps: Maps) -> str:
    """One line a point; answers are 0 or 1, what is not known is empty."""
    arrays = arrays_of(maps)
    places = np.meshgrid(*(arrays.pop(f"{letter}_mm") for letter in AXES), indexing="ij")
    columns = {f"{letter}_mm": p for letter, p in zip(AXES, places, strict=True)} | arrays
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(columns)
    flat = [column.ravel().tolist() for column in columns.values()]
    writer.writerows([_cell(value) for value in row] for row in zip(*flat, strict=True))
    return file.getvalue()


def summary_of(maps: Maps) -> dict[str, Any]:
    """Extent of the grid, share of points that are allowed, and the range of every quantity."""
    return {
        "points": maps.grid.count,
        "lower_mm": [round(float(a[0]) * 1e3, 6) for a in maps.grid.axes],
        "upper_mm": [round(float(a[-1]) * 1e3, 6) for a in maps.grid.axes],
        "share": {name: float(np.mean(answer)) for name, answer in _answers(maps).items()},
        "verdict": {
            text: float(np.mean(maps.verdict == k)) for k, text in enumerate(VERDICTS)
        },
        "range": {
            quantity.column: _range(maps.values[quantity.name] * quantity.scale)
            for quantity in shown_in(maps)
        },
    }  # fmt: skip


def _answers(maps: Maps) -> dict[str, NDArray[np.bool_]]:
    return {
        "closed": maps.closed,
        "feasible": maps.feasible,
        "collision_free": maps.collision_free,
        "allowed": maps.verdict == 0,
    }


def _range(values: NDArray[np.float64]) -> list[float] | None:
    finite = values[np.isfinite(values)]
    return [float(finite.min()), float(finite.max())] if len(finite) else None


def _cell(value: float | bool) -> str:
    if isinstance(value, bool):
        return str(int(value))
    return "" if np.isnan(value) else f"{value:.{_DIGITS}g}"
