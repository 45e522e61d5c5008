"""Result of a run of any planner."""

from __future__ import annotations

from dataclasses import dataclass

from model.pose import Array


@dataclass(frozen=True)
class Result:
    """One run of one planner.

    Attributes:
        first_s: Processor time to the first path, [s]; infinite without one.
        lengths_m: Length of the best path at each mark, [m]; infinite without one.
        checks: Number of edges or, with python-fcl, poses checked.
        path: The last path, shape (k, 3), [m]; empty without one.
    """

    first_s: float
    lengths_m: tuple[float, ...]
    checks: int
    path: Array
