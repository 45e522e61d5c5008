"""From start to goal with the recommended planner: rounds until the budget is spent.

Rounds find some first paths and then polish the best of them. A round takes a fraction of a
millisecond and depends only on the seed and the rounds before it, so a search can end after any
round and be repeated from the number of rounds. The best path is stored apart from those being
polished, so more rounds never give a worse one.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np

from model.pose import Array
from model.rig import Rig
from model.scene import Scene
from planner.anytime.connect import EDGES_TESTED, SAMPLES_DRAWN, connect
from planner.anytime.infeasibility import no_path
from planner.anytime.lattice_path import lattice_path
from planner.anytime.local_search import Polyline, cost_of, measure, polish, polyline_of
from planner.anytime.passages import TESTS_MADE, through_passages
from planner.anytime.problem import (
    ASK_PROOF,
    CLEARANCE,
    KINEMATIC,
    LEAST_MARGIN,
    NO_MARGIN,
    UNIT,
    VERTEX,
    PathProblem,
    problem_of,
    set_weights,
)
from planner.anytime.state import (
    BEST,
    FIRST_VERTICES,
    KEPT,
    NODES_BEFORE,
    RESTARTED,
    ROUNDS,
    SOUGHT,
    TESTS_BEFORE,
    AnytimeSearch,
    Handle,
    new_search,
)
from planner.costs import KinematicCost, LimitedSearch
from planner.kernels.jit import kernel, leaf
from planner.kernels.primitives import uniform
from planner.path import Progress, Route
from planner.settings import OptimalSettings, Weights, least_rounds
from planner.wrench.translation import edge_held

_TRIALS, _SLOW_TRIALS = 400, 100
"""Changes tried in a round; the second where clearance has a weight or the rig has pulleys."""
_TURNS = ((20, 8), (40, 15), (100, 30), (300, 90), (600, 180))
"""Samples of the two trees and of the roadmap, alternating, in a round without a path."""
_SAMPLES_OF_TREES = 4000
"""After this many without a path the two trees are restarted."""
_LATTICE_EVERY = 4
"""One in this many rounds without a path searches the lattice, which misses narrow gaps."""
_COARSE, _MIDDLE = 4, 2
_SPREAD = 1.0
_FINE, _FINE_FOR_LENGTH = 1, 9
"""Which of the first paths uses all grid points. It takes longest where the cost is not the
length, and then finds the narrow passages that matter."""
_ANOTHER_EVERY = 8
"""After the first `KEPT` rounds, one in this many begins with a new path."""
_TO_THE_BEST = 0.7
_VERTEX_PRICES = ((2, 1.5e-3), (5, 5e-4), (12, 2e-4))
"""Least saving of a vertex, as part of the straight distance, up to some polishing rounds."""
_LAST_VERTEX_PRICE = 1e-4
_PATIENCE = 8
"""Rounds without a path after which interpolated margins are ignored."""


@kernel
def handle_of(problem: PathProblem, search: AnytimeSearch) -> Handle:
    """Problem and search as one reference; later changes of either show through it."""
    return Handle(problem, search)


@kernel
def advance(handle: Handle, rounds: int) -> float:
    """Does some rounds; returns the cost of the best path so far, infinite without one.

    Where interpolated margins mislead, `PathProblem.terms` changes. If they leave no path, they are
    ignored, which shows whether obstacles alone do. If a path turns out not to be proved
    wrench-feasible, proofs are required from then on.
    """
    problem, search = handle.problem, handle.search
    for _ in range(rounds):
        begun = search.totals[ROUNDS]
        search.totals[ROUNDS] += 1
        if begun == _PATIENCE and search.costs[BEST] == math.inf and _may_mislead(problem):
            _restart(problem, search, NO_MARGIN)
        kept = _chosen(search, begun)
        if search.counts[kept, 0] == 0:
            kept = _begin(problem, search, kept)
            if kept < 0:
                continue
        problem.terms[VERTEX] = _vertex_price(problem, search, float(search.polished[kept]))
        line = _line(search, kept)
        polish(problem, line, search.state, _trials(problem))
        search.polished[kept] += 1
        search.costs[kept] = cost_of(problem, line)
        if _worth(problem, search, kept) < _worth(problem, search, BEST):
            _remember(problem, search, kept)
    return search.costs[BEST]  # type: ignore[no-any-return]


@kernel
def measure_again(problem: PathProblem, search: AnytimeSearch) -> None:
    """Recomputes the costs of all paths after a change of the objective."""
    for k in range(KEPT + 1):
        if search.counts[k, 0] > 0:
            search.costs[k] = measure(problem, _line(search, k))


@kernel
def _cheapest(search: AnytimeSearch) -> int:
    """The index of the cheapest of the paths being polished."""
    best = 0
    for k in range(1, KEPT):
        if search.costs[k] < search.costs[best]:
            best = k
    return best


@kernel
def _worth(problem: PathProblem, search: AnytimeSearch, k: int) -> float:
    """The cost by which the best path is chosen: with the final price of vertices."""
    price = _vertex_price(problem, search, math.inf)
    return search.costs[k] + price * search.counts[k, 0]  # type: ignore[no-any-return]


@kernel
def _remember(problem: PathProblem, search: AnytimeSearch, kept: int) -> None:
    """Stores a path as the best if it is proved wrench-feasible; else restarts with proofs."""
    line = _line(search, kept)
    if _may_mislead(problem):
        for i in range(line.counts[0] - 1):
            start, end = line.points[i], line.points[i + 1]
            if not edge_held(problem.world, problem.load, problem.holding, start, end):
                _restart(problem, search, ASK_PROOF)
                return
    search.points[BEST], search.edges[BEST] = line.points, line.edges
    search.counts[BEST, 0], search.costs[BEST] = line.counts[0], search.costs[kept]


@kernel
def _may_mislead(problem: PathProblem) -> bool:
    """Whether interpolated margins, which prove nothing, decide on edges."""
    return not problem.holding.everywhere and problem.terms[LEAST_MARGIN] != ASK_PROOF


@kernel
def _restart(problem: PathProblem, search: AnytimeSearch, least: float) -> None:
    """Discards all but the best path and changes the least margin."""
    problem.terms[LEAST_MARGIN] = least
    search.totals[SOUGHT], search.totals[RESTARTED] = 0, search.totals[ROUNDS]
    search.counts[:KEPT, 0], search.costs[:KEPT] = 0, math.inf
    search.polished[:] = 0
    _discard_trees(search)


@kernel
def _discard_trees(search: AnytimeSearch) -> None:
    grown, made = search.trees.counts, search.roadmap.made
    search.totals[TESTS_BEFORE] += grown[EDGES_TESTED] + made[TESTS_MADE]
    grown[:], made[:] = 0, 0


@kernel
def _trials(problem: PathProblem) -> int:
    slow = problem.world.pulley > 0.0 or problem.terms[CLEARANCE] > 0.0
    return _SLOW_TRIALS if slow else _TRIALS


@kernel
def _line(search: AnytimeSearch, kept: int) -> Polyline:
    return Polyline(search.points[kept], search.edges[kept], search.counts[kept])


@kernel
def _chosen(search: AnytimeSearch, begun: int) -> int:
    """Which path to polish; one without vertices has to be found first."""
    best, worst = _cheapest(search), 0
    for k in range(1, KEPT):
        if search.costs[k] > search.costs[worst]:
            worst = k
    if search.totals[SOUGHT] < KEPT or search.costs[best] == math.inf:
        return worst
    if begun % _ANOTHER_EVERY == 0:
        search.counts[worst, 0] = 0
        return worst
    if uniform(search.state) < _TO_THE_BEST:
        return best
    other = int(uniform(search.state) * KEPT)
    return other if search.counts[other, 0] > 0 else best


@kernel
def _begin(problem: PathProblem, search: AnytimeSearch, kept: int) -> int:
    """Finds a new path for a slot; returns the slot, else the best path's, or -1 without one."""
    line = _line(search, kept)
    search.costs[kept], line.counts[0] = math.inf, 0
    begun = search.totals[SOUGHT]
    search.totals[SOUGHT] += 1
    is_first = search.totals[FIRST_VERTICES] == 0
    fine = _FINE if problem.terms[KINEMATIC] > 0.0 else _FINE_FOR_LENGTH
    on_lattice = begun == fine or begun % 2 == 1
    if is_first:
        on_lattice = begun % _LATTICE_EVERY == 1
    if on_lattice:
        stride, spread = _COARSE if begun % 4 == 1 else _MIDDLE, _SPREAD
        if begun == fine:
            stride, spread = _MIDDLE if problem.world.pulley > 0.0 else 1, 0.0
        found = lattice_path(
            problem, search.ends, search.state, stride, spread, line.points, line.counts
        )
    else:
        found = sampled_path(problem, search, line.points)
    if found == 0:
        best = _cheapest(search)
        return best if search.costs[best] < math.inf else -1
    if not on_lattice:
        search.totals[NODES_BEFORE] += search.trees.counts[0] + search.trees.counts[1]
        _discard_trees(search)
    line.counts[0], search.polished[kept] = found, 0
    if is_first:
        search.totals[FIRST_VERTICES], search.first[:] = found, line.points
    search.costs[kept] = measure(problem, line)
    return kept


@leaf
def sampled_path(problem: PathProblem, search: AnytimeSearch, points: Array) -> int:
    """Finds a path by two trees, or a roadmap where they miss a gap; number of vertices or 0."""
    ends, state, trees = search.ends, search.state, search.trees
    if trees.counts[SAMPLES_DRAWN] >= _SAMPLES_OF_TREES:
        search.totals[TESTS_BEFORE] += trees.counts[EDGES_TESTED]
        for i in range(len(trees.counts)):
            trees.counts[i] = 0
    for in_trees, in_passages in _TURNS:
        found = connect(problem, ends, state, trees, in_trees, points)
        if found == 0:
            found = through_passages(
                problem, ends, state, search.roadmap, trees, in_passages, points
            )
        if found > 0:
            return found
    return 0


@kernel
def _vertex_price(problem: PathProblem, search: AnytimeSearch, polished: float) -> float:
    """Least saving that a vertex must bring, after a number of polishing rounds."""
    straight = 0.0
    for axis in range(3):
        straight += (search.ends[1, axis] - search.ends[0, axis]) ** 2
    share = _LAST_VERTEX_PRICE
    for rounds, price in _VERTEX_PRICES:
        if polished < rounds:
            share = price
            break
    return share * math.sqrt(straight) * problem.terms[UNIT]  # type: ignore[no-any-return]


# The search as called from Python.


Clock = Callable[[], float]

LEAST_WITH_PROOFS = 2
"""As `LEAST_ROUNDS`, where every edge needs a proof of wrench feasibility, which takes long."""
_REPORT_EVERY = 0.1
"""Between calls of the progress function, [s]."""


def optimal_route(
    rig: Rig,
    scene: Scene,
    settings: OptimalSettings,
    kinematic: KinematicCost,
    progress: Progress | None = None,
    clock: Clock = time.perf_counter,
) -> Route:
    """Finds a path and improves it until the budget is spent.

    Args:
        scene: Obstacles, clearances, load, start and goal.
        settings: Objective, seed and budget.
        kinematic: The cost of poses at the start's orientation.
        progress: Called with the work done and its limit, both in seconds of the budget or in
            rounds, and the cost of the best path; about ten times a second.
        clock: Seconds; decides when a budget is spent.

    Raises:
        NoSolution: There is no path, none was found, or none is short enough.
    """
    weights = settings.weights.normalized()

    def begin(at: Scene, by: Weights) -> CompiledSearch:
        return CompiledSearch(rig, at, by, kinematic, settings.seed)

    to_do: CompiledSearch | LimitedSearch[CompiledSearch]
    if weights.clearance > 0.0 or settings.longest < math.inf:
        to_do = LimitedSearch(begin, scene, weights, settings.longest, kinematic)
        search = to_do.first
    else:
        to_do = search = begin(scene, weights)
    load(search)
    prepared = clock()
    rounds = _improve(to_do, search, settings, prepared, progress, clock)
    path = to_do.path
    if path is None:
        raise no_path(rig, scene, search.problem, search.state, settings)
    return Route.from_rounds(path, search.first, rounds, to_do.checks, clock() - prepared)


class CompiledSearch:
    """A compiled search as an object.

    Attributes:
        problem: Limits and costs.
        state: Of the search.
    """

    def __init__(
        self, rig: Rig, scene: Scene, weights: Weights, kinematic: KinematicCost, seed: int
    ) -> None:
        """A search that has not begun; see `optimal_route` for the arguments."""
        self.problem = problem_of(rig, scene, weights, kinematic)
        start, goal = np.array(scene.start.position), np.array(scene.goal.position)
        self.state = new_search(start, goal, seed)
        self._handle = handle_of(self.problem, self.state)

    @property
    def cost(self) -> float:
        """Cost of the best path; infinite without one."""
        return float(self.state.costs[BEST])

    @property
    def path(self) -> Array | None:
        """The best path, shape (k, 3), [m]; None without one."""
        return best_path(self.state)

    @property
    def length(self) -> float:
        """Length of the best path, [m]; infinite without one."""
        path = self.path
        if path is None:
            return math.inf
        return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())

    @property
    def first(self) -> Array:
        """The very first path, shape (k, 3), [m]; empty without one."""
        return self.state.first[: self.state.totals[FIRST_VERTICES]].copy()

    @property
    def checks(self) -> int:
        """Number of edges checked."""
        state = self.state
        of_trees = state.totals[TESTS_BEFORE] + state.trees.counts[EDGES_TESTED]
        return int(of_trees + state.counts[:, 1].sum())

    def advance(self) -> None:
        """Does one round."""
        advance(self._handle, 1)

    def weigh(self, weights: Weights) -> None:
        """Changes the weights of the objective."""
        set_weights(self.problem, weights)
        measure_again(self.problem, self.state)

    def cost_by(self, weights: Weights) -> float:
        """Cost of the best path by other weights; infinite without one."""
        path = self.path
        if path is None:
            return math.inf
        problem = self.problem._replace(terms=self.problem.terms.copy())
        set_weights(problem, weights)
        return float(measure(problem, polyline_of(path)))


def load(search: CompiledSearch) -> None:
    """Calls every kernel of a round once, so that compiling or loading is not timed."""
    advance(handle_of(search.problem, search.state), 0)
    measure_again(search.problem, search.state)
    measure(search.problem, polyline_of(search.state.ends))


def _improve(
    to_do: CompiledSearch | LimitedSearch[CompiledSearch],
    search: CompiledSearch,
    settings: OptimalSettings,
    began: float,
    progress: Progress | None,
    clock: Clock,
) -> int:
    """Does rounds until the budget is spent or the path is known to be optimal; their number.

    ``search`` is the one with the scene's own clearance; ``began`` the time of the clock, [s].
    """
    rounds, spent, reported = 0, 0.0, 0.0
    while not _is_over(search, settings, rounds, spent):
        to_do.advance()
        rounds += 1
        if search.cost <= _least(search.state, settings):
            break
        spent = clock() - began
        if progress is not None and spent - reported >= _REPORT_EVERY:
            reported = spent
            settings.report(progress, rounds, spent, to_do.cost)
    return rounds


def _is_over(search: CompiledSearch, settings: OptimalSettings, rounds: int, spent: float) -> bool:
    begun = int(search.state.totals[RESTARTED])
    least = least_rounds(
        has_limit=settings.longest < math.inf, has_clearance=settings.weights.clearance > 0.0
    )
    if search.problem.terms[LEAST_MARGIN] == ASK_PROOF:
        least = LEAST_WITH_PROOFS
    return settings.is_over(rounds, spent, begun + least)


def _least(search: AnytimeSearch, settings: OptimalSettings) -> float:
    """A lower bound of the normalized cost; known only where the length alone counts."""
    if not settings.weights.is_length:
        return -math.inf
    straight = float(np.linalg.norm(search.ends[1] - search.ends[0]))
    return straight * (1.0 + 1e-12)


def best_path(search: AnytimeSearch) -> Array | None:
    """The cheapest path so far, shape (k, 3), [m]; None without one."""
    if not search.costs[BEST] < math.inf:
        return None
    return search.points[BEST, : search.counts[BEST, 0]].copy()
