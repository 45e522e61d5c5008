"""From a plan to a checked set-point table: round the corners, time the path, check all of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from cdpr.clearance import ClearanceModel
from cdpr.poses import Pose
from cdpr.rig import Rig
from cdpr.scene import Scene
from executor.blending import IsAllowed, rounded
from executor.path import Path
from executor.setpoints import CheckedTable, build_table, check_table
from executor.timing import TimeLaw, time_law
from planner.check_report import VerifiedPlan


@dataclass(frozen=True, slots=True, eq=False)
class PreparedRun:
    """A run that is proved and ready to be sent.

    Attributes:
        plan: The plan, verified for this rig.
        rig: The rig file as given; its winches, bus and motion may be newer than the plan's.
        path: With rounded corners.
        law: How fast it is run.
        checked: The set-points.
    """

    plan: VerifiedPlan
    rig: Rig
    path: Path
    law: TimeLaw
    checked: CheckedTable

    @property
    def scene(self) -> Scene:
        """The plan's scene."""
        return self.plan.plan.scene


def prepare(verified: VerifiedPlan, rig: Rig) -> PreparedRun:
    """Makes and checks the set-points of a plan.

    Raises:
        Refused: The executed curve does not keep what the scene and the rig ask for.
        TensionInfeasible: A pose on it cannot be held.
    """
    scene = verified.plan.scene
    weight = float(np.sqrt(np.mean(np.sum(rig.anchors**2, axis=1))))
    tolerance = rig.motion.blend_tolerance
    path = rounded(verified.plan.waypoints, tolerance, weight, _keeps_clearance(rig, scene))
    law = time_law(path, rig.motion)
    cycle = rig.document.bus.cycle_ms / 1000.0
    checked = check_table(rig, scene, build_table(rig, scene, path, law, cycle))
    return PreparedRun(verified, rig, path, law, checked)


def _keeps_clearance(rig: Rig, scene: Scene) -> IsAllowed:
    """Dense poses keep the scene's clearances and half of the way between two of them as well.

    And every move between them the scene's rotation limits.
    """
    model = ClearanceModel(rig, scene)

    def is_allowed(poses: Sequence[Pose]) -> bool:
        reach = float(np.max(np.linalg.norm(rig.anchors, axis=1)))
        half_way = 0.5 * max(a.distance_to(b) + reach * a.angle_to(b) for a, b in pairwise(poses))
        limits = scene.rotation_limits
        if limits and any(limits.excess(a, b) for a, b in pairwise(poses)):
            return False
        for pose in poses:
            near = model.smallest(pose)
            if near is not None and near.distance < scene.obstacle_clearance + half_way:
                return False
            if model.self_clearance(pose).distance < scene.self_clearance + 2.0 * half_way:
                return False
        return True

    return is_allowed
