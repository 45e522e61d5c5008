"""What a path costs: its length, or the line integral of the kinematic cost.

The kinematic cost of a pose is c = γ_d + γ_f: the condition number of the structure matrix and the
inverse volume of the force set, each scaled to 0..1 between its extremes over the workspace
(paper, Eqs. 4, 5, 8 and section 3.2; see docs/paper.md for the corrections). A longest path is kept
by a price of length, `LengthLimit`.

The objectives, with the weights of clearance and capacity, are in `planner.settings`; the optimal
planner evaluates them in `planner.anytime.problem` and `planner.anytime_6d.problem`.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Protocol

import numpy as np

from model import kinematics
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
from planner.settings import MARGIN_RESERVE
from planner.space import Lattice, corners_and_weights

_SAMPLING = 0.010
_MODULES = (kinematics, wrench_sets, space)
"""The indices on the lattice depend on these and on this module."""


@cache
def _version() -> str:
    """A hash of the code that computes the lattice; a change invalidates the cache."""
    digest = hashlib.sha256(Path(__file__).read_bytes())
    for module in _MODULES:
        digest.update(Path(str(module.__file__)).read_bytes())
    return digest.hexdigest()


class Cost(Protocol):
    """A cost of straight edges between coordinates."""

    def edge(self, start: Array, end: Array) -> float:
        """Cost of the straight edge from ``start`` to ``end``, shape (n,) each."""
        ...

    def edges(self, starts: Array, end: Array) -> Array:
        """Costs of straight edges from many points, shape (k, n), to one; shape (k,)."""
        ...


class LengthCost:
    """The length of an edge, [m]."""

    def edge(self, start: Array, end: Array) -> float:
        """Length of the edge, [m]."""
        return float(np.linalg.norm(end - start))

    def edges(self, starts: Array, end: Array) -> Array:
        """Lengths of the edges, shape (k,), [m]."""
        lengths: Array = np.linalg.norm(end - starts, axis=1)
        return lengths


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
        rig: The robot.
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


# The best path within a length limit: a price λ of length is raised until the limit is kept.
#
# With the objective plus λ times the length, a higher λ gives a shorter path. Every few rounds λ is
# raised where the best path is too long, else lowered, by steps halved towards the smallest λ that
# keeps the limit; the best path within the limit is kept. A path not yet polished may mislead, so
# steps grow again where λ has to move in one direction for long.


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


class LengthLimit:
    """The search for λ, updated after every round.

    Attributes:
        price: λ, cost of a metre on top of the objective.
        path: The best path found that is short enough, shape (k, n); None without one.
    """

    def __init__(self, longest: float, unit: float) -> None:
        """Begins without a price of length.

        Args:
            longest: Longest path allowed, [m].
            unit: Typical cost of a metre by the objective.
        """
        self.price = 0.0
        self.path: Array | None = None
        self._longest, self._unit = longest, unit
        self._step, self._repeated, self._was_short = _COARSEST, _PERSISTENT - 1, False
        self._rounds = 0
        self._least = math.inf

    def after_round(self, path: Array, length: float, cost: Callable[[], float]) -> bool:
        """Records the best path at this price; changes the price every few rounds.

        Args:
            path: Best path of the round, shape (k, n).
            length: Its length, [m].
            cost: Computes its cost by the objective alone.

        Returns:
            Whether the price has changed.
        """
        short_enough = length <= self._longest + LENGTH_ROUND_OFF
        if short_enough:
            self._keep(path, cost())
        self._rounds += 1
        return self._rounds % _ROUNDS == 0 and self._moved(short_enough)

    def _keep(self, path: Array, cost: float) -> None:
        if cost < self._least:
            self._least, self.path = cost, path

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
