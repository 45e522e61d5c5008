"""From a plan to a checked set-point table: round the corners, time the path, check all.

Each leg between stops begins and ends at rest, so that no corner is rounded at a stop.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from drivers.stopping_distance import require_stopping_room
from executor.trajectory.path import IsAllowed, rounded
from executor.trajectory.setpoints import CheckedTrajectory, build_table, check_table
from executor.trajectory.time_scaling import time_law
from model.clearance import ClearanceModel
from model.pose import Pose
from model.rig import Rig
from model.scene import Scene
from model.statics.wrench_sets import rms_anchor_radius
from planner.check import parted
from planner.check_report import VerifiedPlan


@dataclass(frozen=True, slots=True, eq=False)
class PreparedRun:
    """A checked run, ready to be armed.

    Attributes:
        plan: The plan, verified for this rig.
        rig: The rig file as given; its winches, bus and motion may be newer than the plan's.
        checked: The set-points.
    """

    plan: VerifiedPlan
    rig: Rig
    checked: CheckedTrajectory

    @property
    def scene(self) -> Scene:
        """The plan's scene."""
        return self.plan.plan.scene

    @property
    def length(self) -> float:
        """Length of the path with rounded corners, [m]."""
        return float(self.checked.table.travelled[-1])

    @property
    def duration(self) -> float:
        """Duration including dwells, [s]."""
        return (len(self.checked.table) - 1) * self.checked.table.cycle


def prepare(verified: VerifiedPlan, rig: Rig) -> PreparedRun:
    """Makes and checks the set-points of a plan.

    Raises:
        Refused: The executed curve violates the scene or the rig, or its clearance is less than the
            stopping distance when the master is lost.
        TensionInfeasible: A pose on it cannot be held.
    """
    plan = verified.plan
    weight = rms_anchor_radius(rig.anchors)
    is_allowed = _keeps_clearance(rig, plan.scene)
    legs = []
    for waypoints in parted(plan.waypoints, plan.stops, len(plan.scene.stops)):
        path = rounded(waypoints, rig.motion.blend_tolerance, weight, is_allowed)
        legs.append((path, time_law(path, rig.motion)))
    cycle = rig.cycle
    table = build_table(rig, plan.scene, legs, cycle)
    checked = check_table(rig, plan.scene, table)
    require_stopping_room(rig, checked.report.proved_obstacle_clearance)
    return PreparedRun(verified, rig, checked)


def _keeps_clearance(rig: Rig, scene: Scene) -> IsAllowed:
    """A check that dense poses keep the scene's clearances plus half their spacing.

    Moves between them must keep the scene's rotation limits.
    """
    model = ClearanceModel(rig, scene)

    def is_allowed(poses: Sequence[Pose]) -> bool:
        reach = float(np.max(np.linalg.norm(rig.anchors, axis=1)))
        half_step = 0.5 * max(a.distance_to(b) + reach * a.angle_to(b) for a, b in pairwise(poses))
        limits = scene.rotation_limits
        if limits and any(limits.excess(a, b) for a, b in pairwise(poses)):
            return False
        for pose in poses:
            near = model.smallest(pose)
            if near is not None and near.distance < scene.obstacle_clearance + half_step:
                return False
        positions = np.array([pose.position for pose in poses])
        rotations = np.array([pose.rotation for pose in poses])
        own = float(model.self_clearances(positions, rotations).min())
        return own >= scene.self_clearance + 2.0 * half_step

    return is_allowed
