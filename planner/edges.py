"""Obstacle clearance along whole edges, without sampling.

For every obstacle and every body the planner needs one thing: a plane with at least the required
room between them. Planes found for earlier edges nearby are tried first, all at once; FCL is asked
for a new one only where none of them does. A yes therefore never rests on FCL's distance (which is
wrong once in some thousand cases) but on a plane whose room is computed here.
"""

from __future__ import annotations

import numpy as np

from cdpr.clearance import PLATFORM, cable_name
from cdpr.convex import ConvexBody, convex_bodies, hull_body, is_apart
from cdpr.poses import Array, Pose, interpolate
from cdpr.rig import Rig
from cdpr.scene import Scene
from planner.swept import Swept, swept

_CELL = 0.050
"""Planes are remembered by the cell of this size, [m], that the middle of the edge lies in."""

_FINEST = 1e-5
"""Edges grown by less than this, [m], are no longer halved but refused."""


class ObstacleEdges:
    """Whether all obstacles stay clear of all that moves along an edge."""

    def __init__(self, rig: Rig, scene: Scene, required: float) -> None:
        """Places the obstacles once.

        Args:
            rig: The robot.
            scene: Its obstacles.
            required: Smallest allowed distance, [m].
        """
        self.rig = rig
        self.required = required
        self._pieces: list[ConvexBody] = []
        self._owner: list[str] = []
        for obstacle in scene.obstacles:
            made = convex_bodies(obstacle.shape, obstacle.pose)
            self._pieces += made
            self._owner += [obstacle.name] * len(made)
        self._radii = np.append(np.full(rig.cable_count, rig.cable_radius), 0.0)
        self._planes: dict[tuple[int, ...], tuple[Array, Array]] = {}
        self._latest = self._first_planes()
        self.rejections: dict[tuple[str, str], int] = {}

    def clear(self, start: Pose, end: Pose) -> bool:
        """Whether the required distance is kept everywhere from ``start`` to ``end``."""
        if not self._pieces:
            return True
        hulls = swept(self.rig, start, end)
        if not np.all(np.isfinite(hulls.growth)):
            return self._halves(start, end) if start.distance_to(end) > _FINEST else False
        middle = tuple(np.floor((start.position + end.position) / (2.0 * _CELL)).astype(int))
        planes, extents = self._planes.get(middle) or tuple(a.copy() for a in self._latest)
        needed = self.required + self._radii + hulls.growth
        room = -extents - hulls.reach(planes) - needed
        open_pairs = np.argwhere(room < 0.0)
        order = np.argsort(room[open_pairs[:, 0], open_pairs[:, 1]])
        clear = True
        for piece, body in open_pairs[order].tolist():
            apart, normal = self._apart(hulls, piece, body, float(needed[body]))
            if normal is not None:
                planes[piece, body] = normal
                extents[piece, body] = self._pieces[piece].extent(-normal)
            if not apart:
                clear = False
                break
        self._planes[middle] = self._latest = (planes, extents)
        if clear:
            return True
        return self._decide_unclear(hulls, start, end, piece, body)

    def _first_planes(self) -> tuple[Array, Array]:
        shape = (len(self._pieces), self.rig.cable_count + 1)
        planes = np.zeros((*shape, 3))
        planes[..., 2] = -1.0
        extents = np.array([p.extent(-n) for p, n in zip(self._pieces, planes, strict=True)])
        return planes, extents.reshape(shape)

    def _apart(
        self, hulls: Swept, piece: int, body: int, needed: float
    ) -> tuple[bool, Array | None]:
        moved = hull_body(np.ascontiguousarray(hulls.points(body)))
        return is_apart(moved, self._pieces[piece], needed)

    def _decide_unclear(self, hulls: Swept, start: Pose, end: Pose, piece: int, body: int) -> bool:
        """A hull is too near: that is the truth where it is exact, else a closer look is needed."""
        if hulls.growth[body] < _FINEST:
            self._count(piece, body)
            return False
        middle = interpolate(start, end, 0.5)
        still = swept(self.rig, middle, middle)
        needed = self.required + float(self._radii[body])
        if not self._apart(still, piece, body, needed)[0]:
            self._count(piece, body)
            return False
        return self._halves(start, end)

    def _halves(self, start: Pose, end: Pose) -> bool:
        middle = interpolate(start, end, 0.5)
        return self.clear(start, middle) and self.clear(middle, end)

    def _count(self, piece: int, body: int) -> None:
        name = PLATFORM if body == self.rig.cable_count else cable_name(body)
        pair = (name, self._owner[piece])
        self.rejections[pair] = self.rejections.get(pair, 0) + 1
