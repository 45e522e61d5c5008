"""Where runs are kept that nobody named a folder for."""

from __future__ import annotations

from pathlib import Path


def free_folder(name: str) -> Path:
    """``runs/NAME``, or with the first free number; makes ``runs`` where it is missing."""
    from itertools import count

    from cdpr.errors import BadInput

    runs = Path("runs")
    try:
        runs.mkdir(exist_ok=True)
    except OSError as error:
        raise BadInput(
            "the folder for runs cannot be made",
            where=str(runs),
            why=error.strerror or str(error),
            next_step="change to a folder that you may write to, or name one with -o",
        ) from None
    names = (runs / (name if n == 1 else f"{name}-{n}") for n in count(1))
    return next(path for path in names if not path.exists())
