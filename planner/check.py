"""The independent check: distances of primitive shapes at dense poses, with proved bounds between.

It shares neither the swept hulls nor the rules of the search, only the model. Every quantity is
sampled along the path, and between samples bounded by how fast it can change (`planner.bounds`):

* obstacle clearance: no faster than the motion, as no point of the robot moves farther; without
  turning and pulleys by separating planes over whole stretches (`planner.bounds`);
* self clearance: with level point exits no faster than the motion, else by a stated multiple;
* capacity margin: by the sum of what each cable's wrench can change at its largest tension.

Tensions and cable speeds are those at the samples, at most 5 mm apart; that there are tensions
within the limits everywhere between is what the capacity margin proves. Where the platform turns,
the scene's rotation limits are compared in closed form.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from model.clearance import ClearanceModel, Nearest
from model.errors import BadInput
from model.kinematics import cables_at, structure_matrix
from model.plan import Plan
from model.pose import Array, Pose
from model.rig import Rig
from model.scene import Scene, legs_of
from model.statics.feasibility import WrenchBox, capacity_margin
from model.statics.gravity import STANDARD_GRAVITY, weight_wrench, working_tensions
from model.statics.tension_distribution import TensionInfeasible
from model.statics.wrench_sets import rms_anchor_radius
from planner.bounds import Smallest, smallest_along, smallest_over_stretches
from planner.check_report import (
    CheckReport,
    Closest,
    PlanRejected,
    VerifiedPlan,
    Violation,
    joined,
    verified,
)
from planner.path import PosePath

SPACING = 0.005
CLEARANCE_TOLERANCE = 0.1e-3
"""How exactly the smallest clearances are found, [m]."""
MARGIN_TOLERANCE = 0.02
"""How exactly the smallest capacity margin is found, part of the largest tension."""
END_TOLERANCE = 1e-6
"""How far a path may pass from the scene's start, stops and goal, [m] and [rad]."""


def verify(plan: Plan, rig: Rig | None = None) -> VerifiedPlan:
    """Proves a plan for a rig and the scene it carries.

    Args:
        plan: The plan.
        rig: The rig as it is now, when its winches or motion may differ from the plan's own.

    Raises:
        PlanRejected: With every violation, what by how much and where.
    """
    report = check_path(rig or plan.rig, plan.scene, plan.waypoints, plan.stops)
    if not report.passed:
        raise PlanRejected(
            report,
            where=f"plan for {plan.rig.name} in {plan.scene.name}",
            next_step="plan again with `cdpr plan`; nothing has moved",
        )
    return verified(plan, report)


def check_path(
    rig: Rig,
    scene: Scene,
    poses: Sequence[Pose],
    stops: Sequence[int] = (),
    *,
    ends: bool = True,
) -> CheckReport:
    """Checks a path, whether a few corners or thousands of poses of an executed curve.

    Between two stops it is checked with the load that is carried there. Where the load changes,
    both are: all between them is then held as well.

    Args:
        rig: The robot.
        scene: Obstacles, clearances, load, start, stops and goal.
        poses: ``world_from_platform``; between two the platform moves straight.
        stops: Which of the poses are at the scene's stops, one for each.
        ends: Whether the path must begin at the scene's start, meet its stops and end at its goal.

    Raises:
        BadInput: There is no pose, or not one in order for each stop.
    """
    legs = legs_of(scene)
    tracks = [PosePath(rig, part) for part in parted(poses, stops, len(legs) - 1)]
    reports = [
        _Check(rig, leg.scene, track).report((leg.begin, leg.end) if ends else None)
        for leg, track in zip(legs, tracks, strict=True)
    ]
    return joined(reports, [float(track.marks[-1]) for track in tracks])


def parted(poses: Sequence[Pose], stops: Sequence[int], count: int) -> list[Sequence[Pose]]:
    """The poses from stop to stop; that of a stop ends one part and begins the next.

    Args:
        poses: Of the whole path.
        stops: Which of them are at stops.
        count: How many stops there must be.

    Raises:
        BadInput: There are more or fewer stops, or they are not in order.
    """
    bounds = [0, *stops, len(poses) - 1]
    if len(stops) != count or any(a > b for a, b in pairwise(bounds)):
        raise BadInput(
            f"the path's stops are its poses {list(stops)}; required are {count} in order"
            f" between 0 and {len(poses) - 1}",
            where="stops of a path",
        )
    return [poses[a : b + 1] for a, b in pairwise(bounds)]


class _Check:
    """One check of one path."""

    def __init__(self, rig: Rig, scene: Scene, track: PosePath) -> None:
        self.rig, self.scene, self.track = rig, scene, track
        self.model = ClearanceModel(rig, scene)
        self.places = track.places(SPACING)
        self.violations: list[Violation] = []
        self.length_unit = rms_anchor_radius(rig.anchors)
        self._poses = {place: track.pose(place) for place in self.places.tolist()}

    def report(self, ends: tuple[str, str] | None) -> CheckReport:
        """Figures and violations; ``ends`` are the names of what it must begin and end at."""
        self._check_workspace()
        if ends is not None:
            self._check_ends(ends)
        self._check_rotations()
        self._check_pulleys()
        obstacle, obstacle_proof = self._obstacle_clearance()
        own, own_proof = self._self_clearance()
        margin = self._margin()
        tensions, speed = self._tensions(), self._cable_speed()
        return CheckReport(
            length=self.track.length,
            samples=obstacle_proof.samples if obstacle_proof else own_proof.samples,
            obstacle_clearance=obstacle,
            proved_obstacle_clearance=obstacle_proof.proved if obstacle_proof else float("inf"),
            required_obstacle_clearance=self.scene.obstacle_clearance,
            self_clearance=own,
            proved_self_clearance=own_proof.proved,
            required_self_clearance=self.scene.self_clearance,
            min_tension=tensions[0],
            max_tension=tensions[1],
            capacity_margin=margin.value,
            proved_capacity_margin=margin.proved,
            max_cable_speed=speed,
            violations=tuple(self.violations),
        )

    def _pose(self, place: float) -> Pose:
        return self._poses.get(place) or self.track.pose(place)

    def _check_workspace(self) -> None:
        positions = np.array([pose.position for pose in self.track.poses])
        outside = np.maximum(
            self.rig.workspace_lower - positions, positions - self.rig.workspace_upper
        ).max(axis=1)
        worst = int(np.argmax(outside))
        if not outside[worst] <= END_TOLERANCE:
            what = "the path leaves the workspace box"
            self._violation(what, float(outside[worst]), 0.0, "mm", positions[worst])

    def _check_ends(self, ends: tuple[str, str]) -> None:
        scene, poses = self.scene, self.track.poses
        for name, pose, wanted in (
            (ends[0], poses[0], scene.start),
            (ends[1], poses[-1], scene.goal),
        ):
            what = f"the path does not meet the scene's {name}"
            away, turned = pose.distance_to(wanted), pose.angle_to(wanted)
            if not away <= END_TOLERANCE:
                self._violation(what, away, END_TOLERANCE, "mm", pose.position)
            if not turned <= END_TOLERANCE:
                self._violation(what, turned, END_TOLERANCE, "°", pose.position)

    def _check_rotations(self) -> None:
        """The scene's limits along every move, in closed form."""
        limits = self.scene.rotation_limits
        if limits is None:
            return
        for start, end in pairwise(self.track.poses):
            excess = limits.excess(start, end)
            if excess is not None:
                what = f"the platform is {excess.how} too far"
                self._violation(what, excess.measured, excess.limit, "°", start.position)
                return

    def _check_pulleys(self) -> None:
        """Anchors four pulley radii from the swivel axis, so that exits move half as fast at most.

        An anchor's motion dB moves its exit by at most 2 r dB / ρ about the axis and r dB / l along
        the pulley, ρ its distance from the axis and l the free length, which is then over 2.8 r.
        """
        radius = self.rig.pulley_radius
        if radius == 0.0:
            return
        for place in self.places.tolist():
            pose = self._pose(place)
            offset = pose.apply(self.rig.anchors) - self.rig.outlets
            along = np.sum(offset * self.rig.feed_directions, axis=-1, keepdims=True)
            reach = np.linalg.norm(offset - along * self.rig.feed_directions, axis=-1)
            k = int(np.argmin(reach))
            nearest = float(reach[k]) - SPACING  # between two places it may come nearer
            if not nearest >= 4.0 * radius:
                what = f"cable {k + 1} is too close to its pulley's axis to bound its motion"
                self._violation(what, nearest, 4.0 * radius, "mm", pose.position)
                return

    def _obstacle_clearance(self) -> tuple[Closest | None, Smallest | None]:
        if not self.scene.obstacles:
            return None, None

        def nearest(pose: Pose) -> Nearest:
            found = self.model.smallest(pose)
            if found is None:
                raise ValueError("a scene with obstacles has a nearest one")
            return found

        required = self.scene.obstacle_clearance
        if self.track.turns or self.rig.pulley_radius > 0.0:

            def distances(poses: Sequence[Pose]) -> Array:
                return np.array([nearest(pose).distance for pose in poses])

            closest, proof = self._closest(nearest, distances, 1.0, required)
        else:
            proof = smallest_over_stretches(self.model, self.track, required, CLEARANCE_TOLERANCE)
            pose = self.track.pose(proof.at)
            closest = Closest(nearest(pose), pose, proof.at)
        self._clearance_violation("obstacle clearance", closest, proof, required)
        return closest, proof

    def _self_clearance(self) -> tuple[Closest, Smallest]:
        def distances(poses: Sequence[Pose]) -> Array:
            positions = np.array([pose.position for pose in poses])
            rotations = np.array([pose.rotation for pose in poses])
            return self.model.self_clearances(positions, rotations)

        required, slope = self.scene.self_clearance, self._self_slope()
        closest, proof = self._closest(self.model.self_clearance, distances, slope, required)
        self._clearance_violation("self clearance", closest, proof, required)
        return closest, proof

    def _self_slope(self) -> float:
        """How fast self clearance can change, per unit of motion.

        Two points of cables whose anchors move alike part by at most the motion; exits on pulleys
        add half of it each; turning adds the levers of anchors and, to the platform, of exits.
        """
        slope = 1.0 if self.rig.pulley_radius == 0.0 else 2.0
        if self.track.turns:
            positions = np.array([pose.position for pose in self.track.poses])
            levers = np.linalg.norm(self.rig.outlets - positions[:, None, :], axis=-1)
            farthest = float(levers.max()) + 2.0 * self.rig.pulley_radius
            slope = max(2.0 * slope, 2.0 + farthest / self.track.radius)
        return slope

    def _closest(
        self,
        nearest: Callable[[Pose], Nearest],
        distances: Callable[[Sequence[Pose]], Array],
        slope: float,
        required: float,
    ) -> tuple[Closest, Smallest]:
        """Where ``nearest`` is closest, of ``distances``, which are those of many poses at once."""

        def evaluate(places: Array) -> Array:
            return distances([self._pose(p) for p in places.tolist()])

        proof = smallest_along(self.places, evaluate, slope, required, CLEARANCE_TOLERANCE)
        pose = self._pose(proof.at)
        return Closest(nearest(pose), pose, proof.at), proof

    def _clearance_violation(
        self, name: str, closest: Closest, proof: Smallest, required: float
    ) -> None:
        pair = f"{closest.nearest.first} – {closest.nearest.second}"
        if not proof.value >= required:
            what = f"{name} too small, {pair}"
            self._violation(what, proof.value, required, "mm", closest.pose.position)
        elif not proof.proved >= required:
            what = f"{name} not proved between samples, {pair}"
            self._violation(what, proof.proved, required, "mm", closest.pose.position)

    def _margin(self) -> Smallest:
        load = self.scene.load
        disturbance = np.concatenate([load.force, load.moment])

        def evaluate(places: Array) -> Array:
            poses = [self._pose(p) for p in places.tolist()]
            matrices = np.array([structure_matrix(self.rig, pose) for pose in poses])
            weights = np.array([weight_wrench(self.rig, pose, load) for pose in poses])
            spread = np.broadcast_to(disturbance, weights.shape)
            box = WrenchBox(weights, spread)
            return capacity_margin(
                matrices, self.rig.min_tension, self.rig.max_tension, box, self.length_unit
            )

        tolerance = MARGIN_TOLERANCE * self.rig.max_tension
        found = smallest_along(self.places, evaluate, self._margin_slope(), 0.0, tolerance)
        if not found.proved >= 0.0:
            what = "the cables cannot hold every required load: capacity margin"
            place = self._pose(found.at).position
            self._violation(what, min(found.value, found.proved), 0.0, "N", place)
        return found

    def _margin_slope(self) -> float:
        """How fast the set of wrenches can change, [N] per metre of motion.

        A cable's direction turns by at most the motion of its ends over its free length; its wrench
        changes by that, with its arm over the unit of length for the moment; and the arm itself
        turns with the platform, as does the weight's.
        """
        free = np.min(
            [
                np.linalg.norm(c.exits - c.anchors, axis=-1)
                for c in (cables_at(self.rig, self._pose(p)) for p in self.places.tolist())
            ],
            axis=0,
        )
        ends = 1.0 if self.rig.pulley_radius == 0.0 else 1.5
        arms = np.linalg.norm(self.rig.anchors, axis=1) / self.length_unit
        turn = ends / np.maximum(free - SPACING * ends, 1e-6)
        change = turn * np.sqrt(1.0 + arms**2)
        slope = float(np.sum(self.rig.max_tension * change))
        if self.track.turns:
            load = self.scene.load
            moment = self.rig.mass * float(np.linalg.norm(self.rig.centre_of_mass))
            moment += load.payload_mass * float(np.linalg.norm(load.payload_centre))
            levers = self.rig.max_tension * float(arms.sum())
            levers += moment * STANDARD_GRAVITY / self.length_unit
            slope += levers / self.track.radius
        return slope

    def _tensions(self) -> tuple[float, float]:
        low, high = np.inf, -np.inf
        for place in self.places.tolist():
            pose = self._pose(place)
            try:
                tensions = working_tensions(self.rig, pose, self.scene.load).tensions
            except TensionInfeasible as error:
                what = "no tensions within the limits hold the weight; short by"
                self._violation(what, error.shortfall, 0.0, "N", pose.position)
                return float("nan"), float("nan")
            low, high = min(low, float(tensions.min())), max(high, float(tensions.max()))
        return low, high

    def _cable_speed(self) -> float:
        """The largest speed of a cable at the rig's path speed, [m/s]."""
        twists = self.rig.motion.speed * self.track.twists(self.places, self.length_unit)
        limits = np.array([winch.max_speed for winch in self.rig.winches])
        largest = 0.0
        for place, twist in zip(self.places.tolist(), twists, strict=True):
            pose = self._pose(place)
            speeds = np.abs(structure_matrix(self.rig, pose).T @ twist)
            largest = max(largest, float(speeds.max()))
            over = int(np.argmax(speeds - limits))
            if not speeds[over] <= limits[over]:
                what = f"cable {over + 1} would have to move faster than its winch"
                self._violation(what, speeds[over], limits[over], "mm/s", pose.position)
                break
        return largest

    def _violation(
        self, what: str, measured: float, limit: float, unit: str, position: Array
    ) -> None:
        self.violations.append(Violation(what, float(measured), float(limit), unit, position))
