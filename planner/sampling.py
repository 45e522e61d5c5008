"""Where the tree is asked to grow next: adaptive sampling, and the goal bias it is compared with.

The paper leaves open over what the expansion failure rate e_r and the node x_c of the greatest rate
are taken. Here e_r = k / (k + 1) with k the failed expansions since the last success, and x_c is
the node whose expansion failed last: of the readings that fit the text these gave the smallest
trees in the paper's own workspace. Points are drawn with r and θ uniform, as Eq. 10 is written.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.random import Generator

from cdpr.poses import Array
from planner.space import Space
from planner.tree import Tree

_TRIES = 100


class Sampler(Protocol):
    """Draws points for the tree to grow to, and hears how that went."""

    def draw(self, tree: Tree) -> Array:
        """A point, shape (n,), inside the bounds or clipped to them."""
        ...

    def tell(self, node: int, success: bool) -> None:
        """That ``node`` of the tree could or could not be expanded."""
        ...


class GoalBias:
    """The goal with probability 0.5, else a point of the whole space (paper, section 5.2)."""

    def __init__(self, space: Space, goal: Array, random: Generator) -> None:
        """Draws from ``random``."""
        self._space, self._goal, self._random = space, goal, random

    def draw(self, tree: Tree) -> Array:
        """A point, shape (n,)."""
        if self._random.random() < 0.5:
            return self._goal
        return self._random.uniform(self._space.lower, self._space.upper)

    def tell(self, node: int, success: bool) -> None:
        """Has nothing to learn from it."""


class AdaptiveSample:
    """Algorithm 2: a cone about the goal, and after failures the space away from the tree."""

    def __init__(self, space: Space, start: Array, goal: Array, random: Generator) -> None:
        """Draws from ``random``; the cone opens from ``goal`` toward ``start``, shape (n,)."""
        self._space, self._start, self._goal, self._random = space, start, goal, random
        self._failures = 0
        self._failed_node = 0

    @property
    def failure_rate(self) -> float:
        """e_r, the probability of sampling backward."""
        return self._failures / (self._failures + 1.0)

    def tell(self, node: int, success: bool) -> None:
        """Counts failures since the last success and keeps the node that failed last."""
        if success:
            self._failures = 0
            return
        self._failures += 1
        self._failed_node = node

    def draw(self, tree: Tree) -> Array:
        """A point, shape (n,): forward with probability 1 - e_r, else backward."""
        failed = tree.points[self._failed_node]
        if self._random.random() > self.failure_rate:
            return self._forward(failed)
        return self._backward(tree, failed)

    def _forward(self, failed: Array) -> Array:
        """SamplingForward, Eqs. 10 and 11; a point outside the bounds is clipped to them."""
        to_start, to_failed = self._start - self._goal, failed - self._goal
        axis = _unit(to_start)
        radius = float(np.linalg.norm(to_failed))
        opening = float(np.arccos(np.clip(axis @ _unit(to_failed), -1.0, 1.0)))
        r = self._random.uniform(0.0, radius)
        angles = self._random.uniform(0.0, np.pi, len(axis) - 1)
        angles[-1] *= 2.0
        angles[0] = self._random.uniform(-opening, opening)
        point = self._goal + r * (_frame(axis) @ hypersphere_point(angles))
        clipped: Array = np.clip(point, self._space.lower, self._space.upper)
        return clipped

    def _backward(self, tree: Tree, failed: Array) -> Array:
        """SamplingBackward, Eq. 12: outside the ball about the mean of all nodes through x_c."""
        centre = tree.points.mean(axis=0)
        radius = float(np.linalg.norm(centre - failed))
        drawn = self._random.uniform(self._space.lower, self._space.upper, (_TRIES, len(centre)))
        away = np.linalg.norm(drawn - centre, axis=1)
        outside = np.flatnonzero(away > radius)
        # A ball that leaves no room in the bounds: the farthest of the points drawn.
        chosen = outside[0] if len(outside) else np.argmax(away)
        point: Array = drawn[int(chosen)]
        return point


def hypersphere_point(angles: Array) -> Array:
    """The point of the unit sphere with n - 1 angles, shape (n,) (Eq. 10, last line a sine)."""
    sines = np.concatenate([[1.0], np.cumprod(np.sin(angles))])
    cosines = np.concatenate([np.cos(angles), [1.0]])
    point: Array = sines * cosines
    return point


def _unit(vector: Array) -> Array:
    length = float(np.linalg.norm(vector))
    if length == 0.0:
        first = np.zeros_like(vector)
        first[0] = 1.0
        return first
    unit: Array = vector / length
    return unit


def _frame(axis: Array) -> Array:
    """An orthogonal matrix whose first column is ``axis`` (a Householder reflection)."""
    first = np.zeros_like(axis)
    first[0] = 1.0
    mirror = axis - first
    size = float(mirror @ mirror)
    if size < 1e-24:
        return np.eye(len(axis))
    frame: Array = np.eye(len(axis)) - (2.0 / size) * np.outer(mirror, mirror)
    return frame
