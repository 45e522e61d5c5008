"""The search tree: nodes, parents and costs in arrays that grow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cdpr.poses import Array

ROOT = -1


class Tree:
    """A tree of points in an n-dimensional space.

    Attributes:
        count: Number of nodes; node 0 is the root.
    """

    def __init__(self, root: Array) -> None:
        """A tree of one node at ``root``, shape (n,)."""
        self.count = 1
        self._points = np.zeros((256, len(root)))
        self._points[0] = root
        self._parents = np.full(256, ROOT, dtype=np.int64)
        self._costs = np.zeros(256)
        self._children: list[list[int]] = [[]]

    @property
    def points(self) -> Array:
        """The nodes, shape (count, n)."""
        return self._points[: self.count]

    @property
    def parents(self) -> NDArray[np.int64]:
        """The parent of each node, shape (count,); -1 for the root."""
        return self._parents[: self.count]

    @property
    def costs(self) -> Array:
        """The cost from the root to each node, shape (count,)."""
        return self._costs[: self.count]

    def nearest(self, point: Array) -> int:
        """The node nearest to a point, shape (n,)."""
        away = self.points - point
        return int(np.argmin(np.einsum("ki,ki->k", away, away)))

    def within(self, point: Array, radius: float) -> NDArray[np.int64]:
        """The nodes within ``radius`` of a point, shape (n,)."""
        away = self.points - point
        near: NDArray[np.int64] = np.flatnonzero(np.einsum("ki,ki->k", away, away) <= radius**2)
        return near

    def add(self, point: Array, parent: int, cost: float) -> int:
        """Adds a node and returns its number; ``cost`` is from the root."""
        if self.count == len(self._points):
            self._points = np.concatenate([self._points, np.zeros_like(self._points)])
            self._parents = np.concatenate([self._parents, np.full_like(self._parents, ROOT)])
            self._costs = np.concatenate([self._costs, np.zeros_like(self._costs)])
        node = self.count
        self._points[node], self._parents[node], self._costs[node] = point, parent, cost
        self._children.append([])
        self._children[parent].append(node)
        self.count += 1
        return node

    def move(self, node: int, parent: int, cost: float) -> None:
        """Gives a node another parent and carries the change of cost to all below it."""
        self._children[int(self._parents[node])].remove(node)
        self._children[parent].append(node)
        self._parents[node] = parent
        change = cost - self._costs[node]
        below = [node]
        while below:
            current = below.pop()
            self._costs[current] += change
            below += self._children[current]

    def way_to(self, node: int) -> Array:
        """The nodes from the root to ``node``, shape (k, n)."""
        way = [node]
        while self._parents[way[-1]] != ROOT:
            way.append(int(self._parents[way[-1]]))
        points: Array = self.points[way[::-1]].copy()
        return points
