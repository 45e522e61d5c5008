"""Chooses the most informative poses for a rig's calibration (D-optimal, greedy)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, degrees, radians

import numpy as np

from calibration.geometry.measurements import RigMeasurements
from calibration.geometry.model import RigModel
from calibration.geometry.parameters import DEFAULT_DEVIATIONS, Parameters
from model.clearance import ClearanceModel
from model.errors import NoSolution
from model.files.documents import PoseDocument
from model.files.plan_file import PlanDocument
from model.files.scene_file import RotationLimitsDocument, StopDocument
from model.kinematics import NoCable, cables_at
from model.plan import Plan, plan_from_document
from model.pose import Array, Pose, largest_rotations, matrix_from_rotation_vector
from model.progress import SILENT, Listener
from model.rig import Rig
from model.scene import Scene, scene_from_document
from model.statics.gravity import working_tensions
from model.statics.tension_distribution import TensionInfeasible
from model.statics.wrench_sets import rms_anchor_radius
from model.winches import WinchMap
from planner.planning import plan_path
from planner.settings import OBJECTIVES, TurningSettings

STEP_OF_TURN = float(np.radians(1.0))
"""A turn is tried in such steps from the orientation of home: cables must not meet on the way."""
CLEARANCE_RESERVE = 1e-3
"""More clearance than the scene asks for, so that a way in and out is left, [m]."""
TURNING_SHARE = 0.3
"""Share of the candidates rotated about the vertical; the others are tilted."""


@dataclass(frozen=True, slots=True)
class Wish:
    """What is wanted of the poses.

    Attributes:
        count: How many.
        tilt: Largest tilt, [rad].
        turn: Largest turn about the vertical, [rad].
        candidates: How many places they are chosen from.
        reserve: Kept between tensions and the rig's limits, [N]: one that is not calibrated pulls
            other than stated.
        length_deviation: Of a cable's length from the encoder, [m].
        pose_deviations: Of measured poses, shape (6,), [m, rad].
    """

    count: int
    tilt: float
    turn: float
    candidates: int
    reserve: float
    length_deviation: float
    pose_deviations: tuple[float, ...]


def chosen_poses(
    rig: Rig, scene: Scene, wish: Wish, parameters: Parameters, seed: int
) -> list[Pose]:
    """The poses, in an order with short ways between them.

    Args:
        rig: The robot.
        scene: Its obstacles, clearances and load.
        wish: What is wanted.
        parameters: What is to be found.
        seed: Of the candidates.

    Raises:
        NoSolution: Too few poses of the workspace can be held and are free.
    """
    found = _candidates(rig, scene, wish, np.random.default_rng(seed))
    if len(found) < wish.count:
        raise NoSolution(
            f"only {len(found)} of {2 * wish.candidates} tried poses are feasible and free",
            where=f"rig {rig.name}, scene {scene.name}",
            next_step="use fewer poses, less --reserve-n, less clearance in the scene, or more"
            " --candidates",
        )
    best = _most_telling(_rows(rig, found, wish, parameters), wish.count)
    reach = rms_anchor_radius(rig.anchors)
    return _in_order([found[k] for k in best], scene.start, reach)


def _candidates(rig: Rig, scene: Scene, wish: Wish, random: np.random.Generator) -> list[Pose]:
    """Places of the workspace, each as at home and turned as far as it can be from there."""
    model = ClearanceModel(rig, scene)
    span = rig.workspace_upper - rig.workspace_lower
    found = []
    for _ in range(wish.candidates):
        position = rig.workspace_lower + random.random(3) * span
        angle, kind = random.uniform(0.0, 2.0 * np.pi), random.random()
        tilted = wish.tilt * np.array([np.cos(angle), np.sin(angle), 0.0])
        turned = np.array([0.0, 0.0, wish.turn if angle < np.pi else -wish.turn])
        whole = turned if kind < TURNING_SHARE else tilted
        steps = max(1, int(np.ceil(np.linalg.norm(whole) / STEP_OF_TURN)))
        last: Pose | None = None
        for share in np.linspace(0.0, 1.0, steps + 1):
            rotation = matrix_from_rotation_vector(share * whole) @ rig.home.rotation
            pose = Pose(position, rotation)
            if not _is_free(rig, scene, model, pose, wish.reserve):
                break
            if share == 0.0:
                found.append(pose)
            last = pose
        if last is not None and last.angle_to(found[-1]) > STEP_OF_TURN / 2.0:
            found.append(last)
    return found


def _is_free(rig: Rig, scene: Scene, model: ClearanceModel, pose: Pose, room: float) -> bool:
    try:
        tensions = working_tensions(rig, pose, scene.load).tensions
        if tensions.min() < rig.min_tension + room or tensions.max() > rig.max_tension - room:
            return False
        near = model.smallest(pose)
        wanted = scene.obstacle_clearance + CLEARANCE_RESERVE
        if near is not None and near.distance < wanted:
            return False
        own = model.self_clearance(pose).distance
    except (TensionInfeasible, NoCable):
        return False
    return own >= scene.self_clearance + CLEARANCE_RESERVE


def _rows(rig: Rig, poses: Sequence[Pose], wish: Wish, parameters: Parameters) -> Array:
    """Information of each pose: derivatives over deviations, with its error in them, (k, m, p)."""
    winches = WinchMap(rig)
    tensions = np.array([working_tensions(rig, pose).tensions for pose in poses])
    lengths = np.array([cables_at(rig, pose).lengths for pose in poses])
    positions = np.array([pose.position for pose in poses])
    rotations = np.array([pose.rotation for pose in poses])
    covariance = np.diag(np.square(wish.pose_deviations))
    places = RigMeasurements(
        names=("",) * len(poses),
        counts=winches.counts(winches.unstrained(lengths, tensions)),
        tensions=tensions,
        positions=positions,
        rotations=rotations,
        covariances=np.tile(covariance, (len(poses), 1, 1)),
    )
    line = RigModel(parameters, places).linearised(np.zeros(len(parameters)), positions, rotations)
    noise = line.by_pose @ covariance @ np.swapaxes(line.by_pose, 1, 2)
    noise += wish.length_deviation**2 * np.eye(rig.cable_count)
    white = np.linalg.inv(np.linalg.cholesky(noise))
    return np.asarray(white @ (line.by_values * parameters.deviations))


def _most_telling(rows: Array, count: int) -> list[int]:
    """The rows that make the determinant of the information largest, one after the other."""
    known = np.eye(rows.shape[2])  # the inverse information; at first the rig file's
    left = np.ones(len(rows), dtype=bool)
    chosen: list[int] = []
    unit = np.eye(rows.shape[1])
    for _ in range(count):
        news = rows @ known @ np.swapaxes(rows, 1, 2)
        gains = np.where(left, np.linalg.slogdet(unit + news)[1], -np.inf)
        best = int(np.argmax(gains))
        chosen.append(best)
        left[best] = False
        row = rows[best]
        known = known - known @ row.T @ np.linalg.solve(unit + news[best], row @ known)
    return chosen


def _in_order(poses: list[Pose], start: Pose, reach: float) -> list[Pose]:
    """From near to near, then without crossings (2-opt); turns count by the anchors' way."""
    stops = [start, *poses]
    ways = np.array([[a.distance_to(b) + reach * a.angle_to(b) for b in stops] for a in stops])
    order, left = [0], set(range(1, len(stops)))
    while left:
        nearest = min(left, key=lambda k: float(ways[order[-1], k]))
        order.append(nearest)
        left.remove(nearest)
    improved = True
    while improved:
        improved = False
        for i in range(1, len(order) - 1):
            for j in range(i + 1, len(order)):
                before, after = ways[order[i - 1], order[i]], ways[order[i - 1], order[j]]
                if j + 1 < len(order):
                    before = before + ways[order[j], order[j + 1]]
                    after = after + ways[order[i], order[j + 1]]
                if after < before - 1e-12:
                    order[i : j + 1] = order[i : j + 1][::-1]
                    improved = True
    return [stops[k] for k in order[1:]]


# A plan through the chosen poses, with a stop at each.

RESERVE_SHARE = 0.075
"""Of the tension range, kept from its ends: more leaves only the middle of the workspace."""
ROUNDS = 3
"""Of shortening each way: measuring is not about speed."""


@dataclass(frozen=True, slots=True, eq=False)
class MeasurementPlan:
    """Poses to measure at, and a plan through them.

    Attributes:
        poses: In their order.
        document: The plan, with a stop at each.
    """

    poses: tuple[Pose, ...]
    document: PlanDocument

    @property
    def plan(self) -> Plan:
        """The path through the poses, which `cdpr.run` takes."""
        return plan_from_document(self.document)

    def __repr__(self) -> str:
        """Number of poses."""
        return f"<MeasurementPlan {len(self.poses)} poses>"


def measurement_poses(
    rig: Rig,
    scene: Scene,
    *,
    count: int = 60,
    tilt: float = radians(15.0),
    turn: float = radians(15.0),
    dwell: float = 1.5,
    candidates: int = 300,
    reserve: float | None = None,
    seed: int = 0,
    listener: Listener = SILENT,
) -> MeasurementPlan:
    """Chooses the most informative poses, and plans a path through them with stops.

    Args:
        rig: The robot.
        scene: Its obstacles, clearances and load.
        count: How many poses.
        tilt: The platform is tilted up to this, [rad].
        turn: It is turned about the vertical up to this, [rad].
        dwell: How long it is at rest at each, [s].
        candidates: How many positions they are chosen from.
        reserve: Kept from the tension limits, [N]; 7.5 % of their range when left out.
        seed: Of the candidates and of the paths.
        listener: Receives how far it is.

    Raises:
        NoSolution: Too few poses can be held and are free, or there is no path between two.
    """
    room = RESERVE_SHARE * (rig.max_tension - rig.min_tension) if reserve is None else reserve
    of_poses = (0.3e-3,) * 3 + (radians(0.05),) * 3
    wish = Wish(count, tilt, turn, candidates, room, 0.1e-3, of_poses)
    with listener.waiting("choosing poses"):
        chosen = chosen_poses(rig, scene, wish, Parameters.of(rig, DEFAULT_DEVIATIONS), seed)
    settings = TurningSettings(weights=OBJECTIVES["length"], seed=seed, rounds=ROUNDS)
    document = plan_path(rig, _with_stops(scene, chosen, dwell), settings, listener)
    return MeasurementPlan(tuple(chosen), document)


def _with_stops(scene: Scene, chosen: Sequence[Pose], dwell: float) -> Scene:
    """The scene with the poses as its stops, ending where it begins, and limits that allow them."""
    stops = [
        StopDocument(name=f"pose {number}", dwell_s=dwell, **PoseDocument.of(pose).model_dump())
        for number, pose in enumerate(chosen, start=1)
    ]
    ends = [scene.start, *chosen]
    found = [largest_rotations(pose.quaternion, pose.quaternion) for pose in ends]
    tilt, turn = (ceil(degrees(max(values))) for values in zip(*found, strict=True))
    changes = {
        "stops": stops,
        "goal": scene.document.start,
        "rotation_limits": RotationLimitsDocument(
            tilt_deg=float(min(tilt, 90)), turn_deg=float(min(turn, 180))
        ),
    }
    return scene_from_document(scene.document.model_copy(update=changes))
