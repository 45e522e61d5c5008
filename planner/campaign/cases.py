"""Random starts and goals as far apart as the scene's own (paper, section 5.3)."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from model.errors import NoSolution
from model.pose import Array
from model.rig import Rig, rig_from_document
from planner.rrt.search import PaperPlanner

_TRIES = 100_000


def random_ends(planner: PaperPlanner, distance: float, random: Generator) -> tuple[Array, Array]:
    """A start and a goal that can be used, with an obstacle across the straight line.

    The text says "different start and goal points with the same path length"; of a path that is
    still to be found only the straight line is known, so that is what has the same length. Pairs
    that see each other are left out: neither planner has anything to search there.

    Args:
        planner: Of the scene; decides what is free.
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
        next_step="reduce the clearance, or leave out the random ends",
    )


# Workspace boxes: the rig's own, and larger ones to see what a claim owes to the box.


GROWTH_MM = ((-100.0, -100.0, -50.0), (100.0, 100.0, 100.0))
"""From the rig's own box to the wide one; the paper's rig goes from ±250, 150 to 650 mm to ±350,
100 to 750 mm."""

OWN, WIDE = "own", "wide"
SHARES = {OWN: 0.0, "25 %": 0.25, "50 %": 0.5, "75 %": 0.75, WIDE: 1.0}
"""Boxes by name: the share of `GROWTH_MM` they are grown by."""


def with_box(rig: Rig, name: str) -> Rig:
    """The same rig with its workspace grown to the box of a name in `SHARES`."""
    share, box = SHARES[name], rig.document.workspace
    lower, upper = (
        [edge + share * growth for edge, growth in zip(edges, grown, strict=True)]
        for edges, grown in zip((box.lower_mm, box.upper_mm), GROWTH_MM, strict=True)
    )
    changed = box.model_copy(update={"lower_mm": lower, "upper_mm": upper})
    return rig_from_document(rig.document.model_copy(update={"workspace": changed}))


def box_text(rig: Rig) -> str:
    """The box in words, such as "x ±250, y ±250, z 150 to 650 mm"."""
    parts = []
    for axis, low, high in zip(
        "xyz", rig.workspace_lower * 1e3, rig.workspace_upper * 1e3, strict=True
    ):
        symmetric = abs(low + high) < 1e-9
        parts.append(f"{axis} ±{high:g}" if symmetric else f"{axis} {low:g} to {high:g}")
    return ", ".join(parts) + " mm"
