"""Everything a pose or an edge must keep, in one place, with counts of why edges were refused."""

from __future__ import annotations

from typing import Literal

from cdpr.poses import Array
from cdpr.rig import Rig
from cdpr.scene import Scene
from planner.edges import ObstacleEdges
from planner.feasibility import FeasibleEdges
from planner.self_edges import SelfEdges
from planner.settings import MARGIN_RESERVE
from planner.space import Space, inside

Reason = Literal["workspace", "obstacle clearance", "self clearance", "wrench feasibility"]


class Validity:
    """Whether edges between coordinates of a space are allowed.

    Attributes:
        checks: Number of edges asked about so far.
        rejections: Number of edges refused, by reason.
    """

    def __init__(self, rig: Rig, scene: Scene, space: Space, reserve: float) -> None:
        """Takes the clearances of ``scene`` with ``reserve`` [m] on top."""
        self.space = space
        self.obstacles = ObstacleEdges(rig, scene, scene.obstacle_clearance + reserve)
        self.robot = SelfEdges(rig, scene.self_clearance + reserve)
        rotation = scene.start.rotation
        self.wrenches = FeasibleEdges(rig, scene, rotation, MARGIN_RESERVE * rig.max_tension)
        self.checks = 0
        self.rejections: dict[Reason, int] = {}

    def edge(self, start: Array, end: Array) -> bool:
        """Whether the straight edge between two points, shape (n,) each, is allowed."""
        self.checks += 1
        reason = self._problem(start, end)
        if reason is None:
            return True
        self.rejections[reason] = self.rejections.get(reason, 0) + 1
        return False

    def _problem(self, start: Array, end: Array) -> Reason | None:
        if not (inside(self.space, start) and inside(self.space, end)):
            return "workspace"
        before, after = self.space.pose(start), self.space.pose(end)
        if not self.obstacles.clear(before, after):
            return "obstacle clearance"
        if not self.robot.clear(before, after):
            return "self clearance"
        if not self.wrenches.feasible(before, after):
            return "wrench feasibility"
        return None
