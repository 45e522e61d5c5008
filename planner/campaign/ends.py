"""Random starts and goals as far apart as the scene's own (paper, section 5.3)."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from cdpr.errors import NoSolution
from cdpr.poses import Array
from planner.paper.search import PaperPlanner

_TRIES = 100_000


def random_ends(planner: PaperPlanner, distance: float, random: Generator) -> tuple[Array, Array]:
    """A start and a goal that can be used, with an obstacle across the straight line.

    The text says "different start and goal points with the same path length"; of a path that is
    still to be found only the straight line is known, so that is what has the same length. Pairs
    that see each other are left out: neither planner has anything to search there.

    Args:
        planner: Of the scene; tells what is free.
        distance: Of start and goal, [m].
        random: Drawn from.

    Returns:
        Start and goal, shape (3,) each, [m].

    Raises:
        NoSolution: There seem to be no such pairs.
    """
    lower, upper = planner.space.lower, planner.space.upper
    for _ in range(_TRIES):
        start = random.uniform(lower, upper)
        direction = random.normal(size=len(start))
        goal = start + distance * direction / np.linalg.norm(direction)
        if np.any(goal < lower) or np.any(goal > upper):
            continue
        usable = planner.edge(start, start) and planner.edge(goal, goal)
        if usable and not planner.edge(start, goal):
            return start, goal
    raise NoSolution(
        f"no start and goal {distance * 1e3:.0f} mm apart with an obstacle between them",
        where="random starts and goals",
        next_step="ask for less clearance, or leave the random ends out",
    )
