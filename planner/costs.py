"""What a path costs, and the best path within a length limit.

The kinematic cost of a pose is c = γ_d + γ_f: the condition number of the structure matrix and the
inverse volume of the force set, each scaled to 0..1 between its extremes over the workspace
(paper, Eqs. 4, 5, 8 and section 3.2; see docs/paper.md for the corrections). A longest path is kept
by `LimitedSearch`, which also finds the clearance worth demanding.

The objectives, with the weights of clearance and capacity, are in `planner.settings`; the optimal
planner evaluates them in `planner.anytime.problem` and `planner.anytime_6d.problem`.
"""

from __future__ import annotations

import hashlib
import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Generic, Protocol, TypeVar

import numpy as np

from model import kinematics
from model.clearance import ClearanceModel
from model.kinematics import cables_exist, cables_to, structure_matrix_of
from model.pose import Array, Pose, interpolate
from model.rig import Rig
from model.scene import Load, Scene
from model.statics import wrench_sets
from model.statics.feasibility import WrenchBox, capacity_margin
from model.statics.gravity import inertial_wrench, weight_wrench
from model.statics.wrench_sets import condition_number, force_volume, rms_anchor_radius
from planner import space
from planner.kernels.jit import stored
from planner.settings import CLEARANCE_RESERVE, MARGIN_RESERVE, OBJECTIVES, Weights
from planner.space import Lattice, corners_and_weights, finite_range, scaled

_SAMPLING = 0.010
_MODULES = (kinematics, wrench_sets, space)
"""The indices on the lattice depend on these and on `KinematicCost`."""


@cache
def _version() -> str:
    """A hash of the code that computes the lattice; a change invalidates the cache."""
    sources = "".join(inspect.getsource(part) for part in (*_MODULES, KinematicCost))
    return hashlib.sha256(sources.encode()).hexdigest()


class KinematicCost:
    """The line integral of c = γ_d + γ_f, [m], for the platform at one orientation.

    The extremes for the scaling, and the values that the search interpolates between, are those on
    a lattice over the workspace box. They depend on rig and orientation alone and are kept in the
    user's cache: for the rigs in `configs/` they take 80 to 200 ms to compute, under 1 ms to read.

    Attributes:
        lattice: Points over the workspace box.
        values: The cost c at them, shape (lattice.count,).
    """

    def __init__(self, rig: Rig, rotation: Array) -> None:
        """Computes the lattice for ``rotation``, ``world_from_platform``, shape (3, 3)."""
        self.rig = rig
        self._rotation = rotation
        self.lattice = Lattice.over(rig.workspace_lower, rig.workspace_upper)
        box = self.lattice.lower, self.lattice.spacing
        tensions = rig.min_tension, rig.max_tension
        cables = rig.outlets, rig.anchors, rig.pulley_radius, rig.feed_directions
        key = [*cables, *tensions, *box, rotation, _version()]
        condition, inverse = stored("cost", key, (2, self.lattice.count), self._on_lattice)
        self.extremes = [finite_range(v) for v in (condition, inverse)]
        self.values = self._scaled(condition, inverse)

    def at(self, positions: Array) -> Array:
        """The cost c of poses, exact; positions shape (k, 3), [m]; shape (k,)."""
        return self._scaled(*self._indices(positions, self._rotation))

    def edge(self, start: Array, end: Array) -> float:
        """Line integral of c along the edge, [m]."""
        return float(self.edges(start[None, :], end)[0])

    def edges(self, starts: Array, end: Array) -> Array:
        """Line integrals of c, shape (k,), [m]: trapezoids between samples at most 10 mm apart."""
        if not len(starts):
            return np.zeros(0)
        lengths = np.linalg.norm(end - starts, axis=1)
        count = max(2, int(np.ceil(float(lengths.max()) / _SAMPLING)) + 1)
        shares = np.linspace(0.0, 1.0, count)[:, None, None]
        points = (starts + shares * (end - starts)).reshape(-1, starts.shape[1])
        corners, weights = corners_and_weights(self.lattice, points)
        values = np.einsum("kc,kc->k", self.values[corners], weights).reshape(count, -1)
        inner = values.sum(axis=0) - (values[0] + values[-1]) / 2.0
        integrals: Array = lengths * inner / (count - 1)
        return integrals

    def mean_along(self, waypoints: Array) -> float:
        """Mean of c over the length of a path, exact at samples; waypoints shape (k, 3), [m]."""
        return self.mean_along_poses([Pose(point, self._rotation) for point in waypoints])

    def mean_along_poses(self, poses: Sequence[Pose]) -> float:
        """Mean of c over the length of a path, exact at samples; rotation counts as length.

        A radian counts as the root mean square radius of the anchors. The scaling stays that of the
        orientation given to the constructor.
        """
        total, length, radian = 0.0, 0.0, rms_anchor_radius(self.rig.anchors)
        for start, end in pairwise(poses):
            part = math.hypot(start.distance_to(end), radian * start.angle_to(end))
            count = max(2, int(np.ceil(part / _SAMPLING)) + 1)
            samples = [interpolate(start, end, s) for s in np.linspace(0.0, 1.0, count).tolist()]
            values = self._at_poses(samples)
            total += part * float(np.mean((values[1:] + values[:-1]) / 2.0))
            length += part
        return total / length if length > 0.0 else float(self._at_poses(poses[:1])[0])

    def _at_poses(self, poses: Sequence[Pose]) -> Array:
        """The cost c of poses, each with its own orientation; shape (k,)."""
        rotations = np.array([pose.rotation for pose in poses])
        return self._scaled(*self._indices(np.array([p.position for p in poses]), rotations))

    def _on_lattice(self) -> Array:
        """Both indices at the lattice's points, shape (2, lattice.count).

        Infinite where the platform is singular, or a cable has no path over its pulley.
        """
        points = self.lattice.points(np.arange(self.lattice.count))
        exist = cables_exist(self.rig, self.rig.anchors @ self._rotation.T + points[:, None, :])
        found = np.full((2, self.lattice.count), np.inf)
        found[:, exist] = self._indices(points[exist], self._rotation)
        return found

    def _indices(self, positions: Array, rotations: Array) -> tuple[Array, Array]:
        """Condition number and inverse volume of the force set, shape (k,) each."""
        rig = self.rig
        anchors = rig.anchors @ np.swapaxes(rotations, -1, -2) + positions[:, None, :]
        matrices = structure_matrix_of(cables_to(rig, anchors), positions)
        condition = condition_number(matrices, rms_anchor_radius(rig.anchors))
        with np.errstate(divide="ignore"):
            return condition, 1.0 / force_volume(matrices, rig.max_tension - rig.min_tension)

    def _scaled(self, condition: Array, inverse: Array) -> Array:
        of_condition, of_inverse = self.extremes
        return scaled(condition, *of_condition) + scaled(inverse, *of_inverse)


# Wrench feasibility: weight, payload and the box of disturbances, within the tension limits.


def external_wrenches(rig: Rig, scene: Scene, rotation: Array) -> WrenchBox:
    """The required wrenches at an orientation, shape (3, 3): weight and disturbances."""
    load = scene.load
    weight = weight_wrench(rig, Pose(rig.home.position, rotation), load)
    return WrenchBox(weight, np.concatenate([load.force, load.moment]))


def margin_reserve(rig: Rig, load: Load | None, *, turns: bool) -> float:
    """Capacity margin that ends and edges must keep, [N].

    What the check requires for the motion's acceleration is exceeded by half of the reserve for
    proofs at least.

    Args:
        load: Payload; none when left out.
        turns: Whether the search rotates the platform.
    """
    for_proofs = MARGIN_RESERVE * rig.max_tension
    return max(for_proofs, inertial_wrench(rig, load, turns=turns) + for_proofs / 2.0)


def capacity_margins(rig: Rig, scene: Scene, positions: Array, rotation: Array) -> Array:
    """Capacity margins at one orientation, positions shape (k, 3), [m]; shape (k,), [N].

    Moments are divided by the root mean square radius of the anchors.
    """
    anchors = rig.anchors @ rotation.T + positions[:, None, :]
    matrices = structure_matrix_of(cables_to(rig, anchors), positions)
    return capacity_margin(
        matrices,
        rig.min_tension,
        rig.max_tension,
        external_wrenches(rig, scene, rotation),
        rms_anchor_radius(rig.anchors),
    )


# The best path within a length limit.
#
# A search seeks the shortest path until the limit is kept; only then does the objective count, plus
# a price λ of length. A higher λ gives a shorter path. Every few rounds λ is raised where the best
# path is too long, else lowered, by steps halved towards the smallest λ that keeps the limit. A
# path not yet polished may mislead, so steps grow again where λ has to move in one direction for
# long.
#
# A price of length hardly ever leads to a clearance between the least and the largest possible. So
# clearance is not left to the price but demanded, of one search after the other; without a limit
# too, as small changes seldom raise the clearance of a whole path. Every other round improves the
# best path, with the clearance demanded of it.


_CLEARANCE_ROUND_OFF = 1e-9
LENGTH_ROUND_OFF = 1e-9
"""Tolerance of a longest path, [m]: one of exactly the straight distance is a path."""
_ROUNDS = 6
"""Between changes of λ."""
_FIRST, _LEAST, _MOST = 2.0**-2, 2.0**-10, 64.0
"""The first and the smallest λ above 0, in costs of a metre by the objective; and the λ at which
practically only the length counts, for weights of scale 1."""
_FINEST, _COARSEST = 2.0**-5, 2.0
"""Steps of λ, in powers of 2."""
_PERSISTENT, _GROWTH = 4, 1.5
"""Steps in one direction from which they grow, and by how much: halved steps nearly reach the λ at
which the direction changed, but not past it."""


class LengthPrice:
    """The search for λ, updated after every round.

    Attributes:
        price: λ, cost of a metre on top of the objective.
    """

    def __init__(self, unit: float) -> None:
        """Begins without a price of length; ``unit`` is the objective's typical cost of a metre."""
        self.price = 0.0
        self._unit = unit
        self._step, self._repeated, self._was_short = _COARSEST, _PERSISTENT - 1, False
        self._rounds = 0

    def after_round(self, short_enough: bool) -> bool:
        """Changes the price every few rounds; returns whether it has."""
        self._rounds += 1
        return self._rounds % _ROUNDS == 0 and self._moved(short_enough)

    def _moved(self, short_enough: bool) -> bool:
        self._repeated = self._repeated + 1 if short_enough == self._was_short else 1
        self._was_short = short_enough
        factor = _GROWTH if self._repeated >= _PERSISTENT else 0.5
        self._step = min(max(factor * self._step, _FINEST), _COARSEST)
        if self.price == 0.0:
            self.price = 0.0 if short_enough else min(_FIRST * self._unit, _MOST)
            return not short_enough  # else the objective alone keeps the limit
        wanted = self.price * 2.0 ** (-self._step if short_enough else self._step)
        self.price = min(max(wanted, _LEAST * self._unit), _MOST)
        return True


class ClearanceSteps:
    """The clearance to demand next: bisection below the lowest that failed.

    A failure may be bad luck: from the finest step on, steps grow again with success.

    Attributes:
        demanded: Clearance, [m].
    """

    _FINEST = 2e-5
    _GROWTH = 1.5

    def __init__(self, least: float, most: float) -> None:
        """Begins with the least clearance; the first step leads to the middle, [m]."""
        self.demanded = self._best = least
        self._most, self._bisects = most, False
        self._step = (most - least) / (2.0 * self._GROWTH)

    def after_search(self, improved: bool) -> bool:
        """Moves on from a search; returns whether there is a higher clearance to demand."""
        if improved:
            self._best = self.demanded
        if self._bisects or not improved:
            self._step = max(self._step / 2.0, self._FINEST)
            self._bisects = self._step > self._FINEST
        else:
            self._step = min(self._step * self._GROWTH, self._most - self._best)
        self.demanded = min(self._best + self._step, self._most)
        return self.demanded > self._best


class RoundSearch(Protocol):
    """A search in rounds whose objective can be changed."""

    @property
    def path(self) -> Array | None:
        """The best path, shape (k, n); None without one."""

    @property
    def length(self) -> float:
        """Length of the best path, [m]; infinite without one."""

    @property
    def checks(self) -> int:
        """Number of edges checked."""

    def advance(self) -> None:
        """Does one round."""

    def weigh(self, weights: Weights) -> None:
        """Changes the weights of the objective."""

    def cost_by(self, weights: Weights) -> float:
        """Cost of the best path by other weights."""


Search = TypeVar("Search", bound=RoundSearch)


class _Stage(Generic[Search]):
    """A search with one clearance demanded, for the shortest path at first.

    Attributes:
        search: With the objective of the current round.
        rounds: Done so far.
        cost: Of its best path within the limit; infinite without one.
    """

    def __init__(self, search: Search, rest: Weights, unit: float) -> None:
        self.search, self.rounds, self.cost = search, 0, math.inf
        self._rest, self._unit = rest, unit
        self._price: LengthPrice | None = None
        search.weigh(OBJECTIVES["length"])

    def advance(self, longest: float, weights: Weights) -> Array | None:
        """Does one round; returns the path if it costs less than all before, else None."""
        search, better = self.search, None
        search.advance()
        self.rounds += 1
        path, short_enough = search.path, search.length <= longest + LENGTH_ROUND_OFF
        if path is not None and short_enough:
            cost = search.cost_by(weights)
            if cost < self.cost:
                self.cost, better = cost, path
        if self._price is not None:
            if self._price.after_round(short_enough):
                search.weigh(replace(self._rest, length=self._rest.length + self._price.price))
        elif short_enough and not self._rest.is_length:
            self._price = LengthPrice(self._unit)
            search.weigh(self._rest)
        return better


class LimitedSearch(Generic[Search]):
    """Searches for the best path within a length limit, one for each clearance demanded.

    Attributes:
        first: The first search, with the scene's own clearance.
        path: The best path found that is short enough, shape (k, n); None without one.
        cost: Of that path; infinite without one.
    """

    _FEWEST, _FEWEST_EAGER, _FEWEST_WITH_LIMIT, _FEWEST_OF_PRICES = 8, 4, 16, 48
    """Rounds of a search at least; of an eager one; with a limit; and where λ has to be found."""
    _SHARE = 4
    """A search may take one in this many of the rounds before it."""
    _EAGER = 10.0
    """If a metre of clearance is worth more than this many of path, a search ends with its first
    path that is better than all before: more clearance is worth more than polishing. Not if the
    price of length has to be found too, or capacity counts."""

    def __init__(
        self,
        begin: Callable[[Scene, Weights], Search],
        scene: Scene,
        weights: Weights,
        longest: float,
        kinematic: KinematicCost,
    ) -> None:
        """Begins the first search.

        Args:
            begin: Makes a search of a scene by weights.
            scene: Obstacles, clearances, start and goal.
            weights: The objective, with a scale of 1.
            longest: Longest path allowed, [m]; infinite for no limit.
            kinematic: The cost of poses at the start's orientation.
        """
        self.path: Array | None = None
        self.cost = math.inf
        self._begin, self._scene = begin, scene
        self._weights, self._longest = weights, longest
        self._rest = replace(weights, clearance=0.0).normalized()
        self._unit = typical_cost(self._rest, kinematic)
        has_price = not self._rest.is_length and longest < math.inf
        metre = typical_cost(weights, kinematic)
        self._eager = weights.clearance > self._EAGER * metre and not (
            has_price or weights.capacity
        )
        if longest < math.inf:
            self._fewest = self._FEWEST_OF_PRICES if has_price else self._FEWEST_WITH_LIMIT
        else:
            self._fewest = self._FEWEST_EAGER if self._eager else self._FEWEST
        most = _largest_clearance(kinematic.rig, scene) if weights.clearance > 0.0 else 0.0
        least = scene.obstacle_clearance
        self._steps = ClearanceSteps(least, most) if least < most < math.inf else None
        self._rounds, self._checks = 0, 0
        self._best = self._newest = self._open(scene)
        self.first = self._best.search

    @property
    def checks(self) -> int:
        """Number of edges checked."""
        newest = 0 if self._newest is self._best else self._newest.search.checks
        return self._checks + self._best.search.checks + newest

    def advance(self) -> None:
        """Does one round."""
        stage = self._best
        if self.path is None or self._rounds % 2 == 0:
            if self._steps is not None and self._is_done():
                self._next(self._steps)
            stage = self._newest
        self._rounds += 1
        path = stage.advance(self._longest, self._weights)
        if path is not None and stage.cost < self.cost:
            if stage is not self._best:
                self._checks += self._best.search.checks
            self.path, self.cost, self._best = path, stage.cost, stage

    def _open(self, scene: Scene) -> _Stage[Search]:
        self._allowed = max(self._fewest, self._rounds // self._SHARE)
        self._before = self.cost
        return _Stage(self._begin(scene, self._rest), self._rest, self._unit)

    def _is_done(self) -> bool:
        if self.path is None:
            return False
        stage = self._newest
        return stage.rounds >= self._allowed or (self._eager and stage.cost < self._before)

    def _next(self, steps: ClearanceSteps) -> None:
        if not steps.after_search(self._newest.cost < self._before):
            self._steps = None
            return
        if self._newest is not self._best:
            self._checks += self._newest.search.checks
        self._newest = self._open(self._scene.changed(clearance=steps.demanded))


def typical_cost(weights: Weights, kinematic: KinematicCost) -> float:
    """Typical cost of a metre by length and kinematic cost."""
    return weights.length + weights.kinematic * float(kinematic.values.mean())


def _largest_clearance(rig: Rig, scene: Scene) -> float:
    """The largest clearance that start and goal allow to demand, [m]."""
    model = ClearanceModel(rig, scene)
    found = [model.smallest(pose) for pose in (scene.start, scene.goal)]
    least = min((near.distance for near in found if near is not None), default=math.inf)
    return least - CLEARANCE_RESERVE - _CLEARANCE_ROUND_OFF
