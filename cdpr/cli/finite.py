"""Options that take any finite number: `inf` and `nan` pass the limits of an option type."""

from __future__ import annotations

import math

import typer


def finite(value: float | None) -> float | None:
    """The number of an option, as its callback.

    Raises:
        typer.BadParameter: It is not finite.
    """
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"{value} is not a finite number")
    return value
