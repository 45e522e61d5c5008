"""The whole way through a scene: its legs planned one after the other, and joined."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cdpr.errors import BadInput, NoSolution
from cdpr.legs import Leg
from cdpr.poses import Array
from cdpr.rig import Rig
from planner.cost import KinematicCost
from planner.optimal.settings import OptimalSettings
from planner.route import Progress, Route
from planner.settings import PlannerSettings
from planner.turning.settings import TurningSettings

if TYPE_CHECKING:
    from planner.optimal.routing import OptimalRoute
    from planner.turning.routing import TurningRoute

Settings = PlannerSettings | OptimalSettings | TurningSettings
"""Of any planner."""


@dataclass(frozen=True, slots=True, eq=False)
class Way:
    """A route through all stops.

    Attributes:
        route: From start to goal; its tree has a root for each leg.
        stops: Which points of the route's path are at stops.
        rounds: Of each leg, which find it again; none of the paper's planners.
        search_time: Of the legs together, [s]; None for the paper's planners.
    """

    route: Route
    stops: tuple[int, ...]
    rounds: tuple[int, ...]
    search_time: float | None


def way_through(
    rig: Rig,
    legs: Sequence[Leg],
    settings: Sequence[Settings],
    kinematic: KinematicCost,
    progress: Progress | None,
    clock: Callable[[], float],
) -> Way:
    """Plans every leg with its own load.

    Args:
        rig: The robot.
        legs: In their order.
        settings: Which planner, and its settings, for each leg.
        kinematic: The cost of poses at the legs' orientation.
        progress: Told how the search of each leg goes on.
        clock: Seconds.

    Raises:
        NoSolution: A leg has no path, or its search ended at its limit; it is named.
    """
    routes: list[Route] = []
    found: list[OptimalRoute | TurningRoute] = []
    for leg, own in zip(legs, settings, strict=True):
        try:
            # Each planner is imported when it is asked for: its kernels take a while to load.
            if isinstance(own, OptimalSettings):
                from planner.optimal.routing import optimal_route

                found.append(optimal_route(rig, leg.scene, own, kinematic, progress, clock))
                routes.append(found[-1].route)
            elif isinstance(own, TurningSettings):
                from planner.turning.routing import turning_route

                found.append(turning_route(rig, leg.scene, own, kinematic, progress, clock))
                routes.append(found[-1].route)
            else:
                from planner.paper.routing import paper_route

                routes.append(paper_route(rig, leg.scene, own, kinematic, progress))
        except NoSolution as error:
            if len(legs) > 1:
                error.what = f"from {leg.begin} to {leg.end}: {error.what}"
            raise
    return Way(
        *_joined(routes),
        rounds=tuple(f.rounds for f in found),
        search_time=sum(max(0.0, f.search_time) for f in found) if found else None,
    )


def settings_of_legs(settings: Settings, rounds: Sequence[int], count: int) -> Sequence[Settings]:
    """The settings of each leg: all alike, but for rounds that are given for each.

    Raises:
        BadInput: Rounds are not one number for each leg, or are for a planner that has none; or a
            longest path is asked for with stops.
    """
    if isinstance(settings, PlannerSettings):
        if rounds:
            raise BadInput("the paper's planners know no rounds", next_step="leave them out")
        return [settings] * count
    if count > 1 and settings.longest < np.inf:
        raise BadInput(
            "a longest path cannot be asked for in a scene with stops",
            why="each leg is planned for itself, and none knows what the others need",
            next_step="leave --longest-mm out, or plan from stop to stop",
        )
    if not rounds:
        return [settings] * count
    if len(rounds) != count:
        raise BadInput(
            f"rounds are given for {len(rounds)} legs; the scene's stops make {count} of the way",
            next_step="give one number for all legs, or one for each",
        )
    return [replace(settings, rounds=own) for own in rounds]


def _joined(routes: Sequence[Route]) -> tuple[Route, tuple[int, ...]]:
    """The routes end to end, and which points of the path are where two of them meet."""
    lengths = [len(route.path) - 1 for route in routes]
    before = [0, *accumulate(len(route.nodes) for route in routes[:-1])]
    joined = Route(
        path=_end_to_end([route.path for route in routes]),
        raw=_end_to_end([route.raw for route in routes]),
        nodes=np.concatenate([route.nodes for route in routes]),
        parents=np.concatenate(
            [_later(route.parents, n) for route, n in zip(routes, before, strict=True)]
        ),
        iterations=sum(route.iterations for route in routes),
        edge_checks=sum(route.edge_checks for route in routes),
    )
    return joined, tuple(accumulate(lengths[:-1]))


def _later(parents: NDArray[np.int64], before: int) -> NDArray[np.int64]:
    """Parents of nodes that come after others."""
    return np.where(parents < 0, -1, parents + before)


def _end_to_end(paths: Sequence[Array]) -> Array:
    """Paths whose ends meet as one; each point where two meet stands once."""
    return np.concatenate([paths[0], *(path[1:] for path in paths[1:])])
