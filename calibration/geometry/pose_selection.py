"""Selects the most informative poses for a rig's calibration (greedy D-optimal design)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, degrees, radians

import numpy as np

from calibration.geometry.measurements import RigMeasurements
from calibration.geometry.model import RigModel
from calibration.geometry.parameters import DEFAULT_DEVIATIONS, Parameters
from model.clearance import ClearanceModel
from model.errors import NoSolution, positive_number, require_types
from model.files.documents import PoseDocument
from model.files.plan_file import PlanDocument
from model.files.scene_file import RotationLimitsDocument, StopDocument
from model.kinematics import NoCable, cables_at
from model.pages.page import FactsDisplay
from model.plan import Plan, plan_facts, plan_from_document
from model.pose import Array, Pose, largest_rotations, matrix_from_rotation_vector
from model.progress import SILENT, Listener
from model.rig import Rig
from model.scene import Load, Scene, require_unaltered, scene_from_document
from model.statics.gravity import working_tensions
from model.statics.tension_distribution import TensionInfeasible
from model.statics.wrench_sets import rms_anchor_radius
from model.winches import WinchMap
from planner.planning import plan_path
from planner.settings import OBJECTIVES, TurningSettings, whole_number

STEP_OF_TURN = float(np.radians(1.0))
"""Step in which rotations from the home orientation are checked for collisions, [rad]."""
CLEARANCE_RESERVE = 1e-3
"""Clearance beyond the scene's, so that a path in and out remains, [m]."""
TURNING_SHARE = 0.3
"""Share of the candidates rotated about the vertical; the others are tilted."""


@dataclass(frozen=True, slots=True)
class PoseRequirements:
    """Requirements on the poses.

    Attributes:
        count: Number of poses.
        tilt: Largest tilt, [rad].
        turn: Largest rotation about the vertical, [rad].
        candidates: Number of positions to choose from.
        reserve: Margin of tensions to the rig's limits, [N]: those of an uncalibrated rig differ
            from the computed ones.
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


def choose_poses(
    rig: Rig, scene: Scene, requirements: PoseRequirements, parameters: Parameters, seed: int
) -> list[Pose]:
    """Selects the poses, in an order with short paths between them.

    Args:
        scene: Its obstacles, clearances and load.
        parameters: The parameters to estimate.
        seed: Random seed of the candidates.

    Raises:
        NoSolution: Too few poses of the workspace are feasible and free.
    """
    found = _candidates(rig, scene, requirements, np.random.default_rng(seed))
    if len(found) < requirements.count:
        raise NoSolution(
            f"only {len(found)} of {2 * requirements.candidates} tried poses are feasible and free",
            where=f"rig {rig.name}, scene {scene.name}",
            next_step="use fewer poses, a smaller `reserve=`, less clearance in the scene, or more"
            " `candidates=`",
        )
    rows = _rows(rig, scene.load, found, requirements, parameters)
    best = _d_optimal(rows, requirements.count)
    reach = rms_anchor_radius(rig.anchors)
    return _short_tour([found[k] for k in best], scene.start, reach)


def _candidates(
    rig: Rig, scene: Scene, requirements: PoseRequirements, random: np.random.Generator
) -> list[Pose]:
    """Random positions, each in the home orientation and rotated as far as is free."""
    model = ClearanceModel(rig, scene)
    span = rig.workspace_upper - rig.workspace_lower
    found = []
    for _ in range(requirements.candidates):
        position = rig.workspace_lower + random.random(3) * span
        angle, kind = random.uniform(0.0, 2.0 * np.pi), random.random()
        tilted = requirements.tilt * np.array([np.cos(angle), np.sin(angle), 0.0])
        turn = requirements.turn if angle < np.pi else -requirements.turn
        about_vertical = np.array([0.0, 0.0, turn])
        whole = about_vertical if kind < TURNING_SHARE else tilted
        steps = max(1, int(np.ceil(np.linalg.norm(whole) / STEP_OF_TURN)))
        last: Pose | None = None
        for share in np.linspace(0.0, 1.0, steps + 1):
            rotation = matrix_from_rotation_vector(share * whole) @ rig.home.rotation
            pose = Pose(position, rotation)
            if not _is_free(rig, scene, model, pose, requirements.reserve):
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


def _rows(
    rig: Rig,
    load: Load,
    poses: Sequence[Pose],
    requirements: PoseRequirements,
    parameters: Parameters,
) -> Array:
    """Whitened Jacobian of each pose, its pose error included, shape (k, m, p)."""
    winches = WinchMap(rig)
    tensions = np.array([working_tensions(rig, pose, load).tensions for pose in poses])
    lengths = np.array([cables_at(rig, pose).lengths for pose in poses])
    positions = np.array([pose.position for pose in poses])
    rotations = np.array([pose.rotation for pose in poses])
    covariance = np.diag(np.square(requirements.pose_deviations))
    samples = RigMeasurements(
        names=("",) * len(poses),
        counts=winches.counts(winches.unstrained(lengths, tensions)),
        tensions=tensions,
        positions=positions,
        rotations=rotations,
        covariances=np.tile(covariance, (len(poses), 1, 1)),
    )
    line = RigModel(parameters, samples).linearised(np.zeros(len(parameters)), positions, rotations)
    noise = line.by_pose @ covariance @ np.swapaxes(line.by_pose, 1, 2)
    noise += requirements.length_deviation**2 * np.eye(rig.cable_count)
    white = np.linalg.inv(np.linalg.cholesky(noise))
    return np.asarray(white @ (line.by_values * parameters.deviations))


def _d_optimal(rows: Array, count: int) -> list[int]:
    """Indices that maximise the determinant of the information, greedily."""
    known = np.eye(rows.shape[2])  # inverse information; initially the rig file's
    remaining = np.ones(len(rows), dtype=bool)
    chosen: list[int] = []
    unit = np.eye(rows.shape[1])
    for _ in range(count):
        gained = rows @ known @ np.swapaxes(rows, 1, 2)
        gains = np.where(remaining, np.linalg.slogdet(unit + gained)[1], -np.inf)
        best = int(np.argmax(gains))
        chosen.append(best)
        remaining[best] = False
        row = rows[best]
        known = known - known @ row.T @ np.linalg.solve(unit + gained[best], row @ known)
    return chosen


def _short_tour(poses: list[Pose], start: Pose, reach: float) -> list[Pose]:
    """Nearest-neighbour order, improved by 2-opt; rotations count by the anchors' path."""
    stops = [start, *poses]
    distances = np.array([[a.distance_to(b) + reach * a.angle_to(b) for b in stops] for a in stops])
    order, remaining = [0], set(range(1, len(stops)))
    while remaining:
        nearest = min(remaining, key=lambda k: float(distances[order[-1], k]))
        order.append(nearest)
        remaining.remove(nearest)
    improved = True
    while improved:
        improved = False
        for i in range(1, len(order) - 1):
            for j in range(i + 1, len(order)):
                before, after = distances[order[i - 1], order[i]], distances[order[i - 1], order[j]]
                if j + 1 < len(order):
                    before = before + distances[order[j], order[j + 1]]
                    after = after + distances[order[i], order[j + 1]]
                if after < before - 1e-12:
                    order[i : j + 1] = order[i : j + 1][::-1]
                    improved = True
    return [stops[k] for k in order[1:]]


# A plan through the chosen poses, with a stop at each.

RESERVE_SHARE = 0.075
"""Margin to the tension limits as a share of their range; more leaves only the middle of the
workspace."""
ROUNDS = 3
"""Improvement rounds per path; few, as measuring does not need short paths."""


@dataclass(frozen=True, slots=True, eq=False)
class MeasurementPlan(FactsDisplay):
    """Poses to measure at, and a plan through them.

    Attributes:
        poses: In order.
        document: The plan, with a stop at each.
    """

    poses: tuple[Pose, ...]
    document: PlanDocument

    @property
    def plan(self) -> Plan:
        """The plan through the poses, for `cdpr.run`."""
        return plan_from_document(self.document)

    def facts(self) -> list[tuple[str, str]]:
        """Number of poses, and what the plan through them is."""
        return [("poses", str(len(self.poses))), *plan_facts(self.document)]

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
    """Selects the most informative poses and plans a path with stops through them.

    Args:
        rig: The robot.
        scene: Its obstacles, clearances and load.
        count: Number of poses.
        tilt: Largest tilt of the platform, [rad].
        turn: Largest rotation about the vertical, [rad].
        dwell: Dwell time at each pose, [s].
        candidates: Number of positions to choose from.
        reserve: Margin to the tension limits, [N]; 7.5 % of their range when left out.
        seed: Random seed of the candidates and paths.
        listener: Receives the progress.

    Raises:
        BadInput: An argument is of another type, or the seed is out of range.
        NoSolution: Too few poses are feasible and free, or there is no path between two.
    """
    require_types((rig, Rig), (scene, Scene), (listener, Listener))
    require_unaltered(rig, scene)
    count = whole_number("count", count, least=1)
    candidates = whole_number("candidates", candidates, least=1)
    settings = TurningSettings(weights=OBJECTIVES["length"], seed=seed, rounds=ROUNDS)
    tilt = positive_number("tilt", tilt, "rad", or_zero=True)
    turn = positive_number("turn", turn, "rad", or_zero=True)
    dwell = positive_number("dwell", dwell, "s", or_zero=True, most=3600.0)
    room = RESERVE_SHARE * (rig.max_tension - rig.min_tension)
    room = room if reserve is None else positive_number("reserve", reserve, "N", or_zero=True)
    of_poses = (0.3e-3,) * 3 + (radians(0.05),) * 3
    requirements = PoseRequirements(count, tilt, turn, candidates, room, 0.1e-3, of_poses)
    with listener.waiting("choosing poses"):
        parameters = Parameters.of(rig, DEFAULT_DEVIATIONS)
        chosen = choose_poses(rig, scene, requirements, parameters, settings.seed)
    document = plan_path(rig, _with_stops(scene, chosen, dwell), settings, listener)
    return MeasurementPlan(tuple(chosen), document)


def _with_stops(scene: Scene, chosen: Sequence[Pose], dwell: float) -> Scene:
    """The scene with the poses as stops, back to its start, and rotation limits to match."""
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
        "rotation_limits": RotationLimitsDocument.containing(float(tilt), float(turn)),
    }
    return scene_from_document(scene.document.model_copy(update=changes))
