"""What a path costs, and the best path within a length limit.

The kinematic cost of a pose is c = γ_d + γ_f: the condition number of the structure matrix and the
inverse volume of the force set, each scaled to 0..1 between its extremes over the workspace
(paper, Eqs. 4, 5, 8 and section 3.2; see docs/paper.md for the corrections). A longest path is kept
by `LimitedSearch`.

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
from planner.space import Lattice, corners_and_weights

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


def finite_range(values: Array) -> tuple[float, float]:
    """The smallest and the largest finite value; 0 without any."""
    finite = values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 0.0)


def scaled(values: Array, low: float, high: float) -> Array:
    """An index as a cost: 0 at its best within the workspace or better, 1 at a singular pose.

    An orientation other than the one of the extremes may be better than their best.
    """
    rising = np.maximum((values - low) / (high - low if high > low else 1.0), 0.0)
    return np.where(np.isfinite(values), rising, 1.0)


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
# clearance is not left to the price but demanded, of one search after the other.


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
    """The clearance to demand next: higher by steps that grow with success, else are halved.

    Attributes:
        demanded: Clearance, [m].
    """

    _FINEST = 2e-5
    _GROWTH = 1.5

    def __init__(self, least: float, most: float) -> None:
        """Begins with the least clearance; the first step leads to the middle, [m]."""
        self.demanded = self._best = least
        self._most, self._step, self._grows = most, (most - least) / 2.0, False

    def after_search(self, improved: bool) -> bool:
        """Moves on from a search; returns whether there is a higher clearance to demand."""
        if improved:
            self._best = self.demanded
            self._step *= self._GROWTH if self._grows else 1.0
        else:
            self._step = max(self._step / 2.0, self._FINEST)
        self._grows = True
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


class LimitedSearch(Generic[Search]):
    """Searches for the best path within a length limit, one for each clearance demanded.

    Attributes:
        first: The first search, with the scene's own clearance.
        path: The best path found that is short enough, shape (k, n); None without one.
    """

    _FEWEST, _FEWEST_OF_PRICES = 16, 48
    """Rounds of a search at least; the second where λ has to be found."""
    _SHARE = 8
    """A search may take one in this many of the rounds before it."""
    _EAGER = 10.0
    """With the length as the only other term, and clearance weighed higher by this factor, a search
    ends with its first path within the limit: more clearance is worth more than polishing."""

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
            longest: Longest path allowed, [m].
            kinematic: The cost of poses at the start's orientation.
        """
        self.path: Array | None = None
        self._begin, self._scene = begin, scene
        self._weights, self._longest = weights, longest
        self._rest = replace(weights, clearance=0.0).normalized()
        self._unit = typical_cost(self._rest, kinematic)
        self._eager = self._rest.is_length and weights.clearance > self._EAGER * weights.length
        most = _largest_clearance(kinematic.rig, scene) if weights.clearance > 0.0 else 0.0
        least = scene.obstacle_clearance
        self._steps = ClearanceSteps(least, most) if least < most < math.inf else None
        self._rounds, self._checks, self._least = 0, 0, math.inf
        self._own_rounds, self._allowed = 0, 0
        self._before = self._of_search = math.inf
        self._price: LengthPrice | None = None
        self.first = self._search = self._open(scene)

    @property
    def cost(self) -> float:
        """Cost of the best path within the limit; infinite without one."""
        return self._least

    @property
    def checks(self) -> int:
        """Number of edges checked."""
        return self._checks + self._search.checks

    def advance(self) -> None:
        """Does one round."""
        if self._steps is not None and self._is_done():
            self._next(self._steps)
        search = self._search
        search.advance()
        self._rounds += 1
        self._own_rounds += 1
        path, length = search.path, search.length
        short_enough = length <= self._longest + LENGTH_ROUND_OFF
        if path is not None and short_enough:
            self._record(path, search.cost_by(self._weights))
        if self._price is not None:
            if self._price.after_round(short_enough):
                length_weight = self._rest.length + self._price.price
                search.weigh(replace(self._rest, length=length_weight))
        elif short_enough and not self._rest.is_length:
            self._price = LengthPrice(self._unit)
            search.weigh(self._rest)

    def _open(self, scene: Scene) -> Search:
        """A new search, for the shortest path at first."""
        search = self._begin(scene, self._rest)
        search.weigh(OBJECTIVES["length"])
        self._price = None
        self._own_rounds, self._before, self._of_search = 0, self._least, math.inf
        fewest = self._FEWEST if self._rest.is_length else self._FEWEST_OF_PRICES
        self._allowed = max(fewest, self._rounds // self._SHARE)
        return search

    def _is_done(self) -> bool:
        if self.path is None:
            return False
        return self._own_rounds >= self._allowed or (self._eager and self._of_search < math.inf)

    def _next(self, steps: ClearanceSteps) -> None:
        improved = self._of_search < self._before
        if not steps.after_search(improved):
            self._steps = None
            return
        self._checks += self._search.checks
        self._search = self._open(self._scene.changed(clearance=steps.demanded))

    def _record(self, path: Array, cost: float) -> None:
        self._of_search = min(self._of_search, cost)
        if cost < self._least:
            self._least, self.path = cost, path


def typical_cost(weights: Weights, kinematic: KinematicCost) -> float:
    """Typical cost of a metre by length and kinematic cost."""
    return weights.length + weights.kinematic * float(kinematic.values.mean())


def _largest_clearance(rig: Rig, scene: Scene) -> float:
    """The largest clearance that start and goal allow to demand, [m]."""
    model = ClearanceModel(rig, scene)
    found = [model.smallest(pose) for pose in (scene.start, scene.goal)]
    least = min((near.distance for near in found if near is not None), default=math.inf)
    return least - CLEARANCE_RESERVE - _CLEARANCE_ROUND_OFF
