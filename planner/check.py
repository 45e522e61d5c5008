"""The independent check: distances of primitive shapes at dense poses, with proved bounds between.

It shares neither the swept hulls nor the rules of the search, only the model. Every quantity is
sampled along the path, and bounded between samples by how fast it can change (`planner.bounds`):

* obstacle clearance: no faster than the motion, as no point of the robot moves farther; without
  rotation and pulleys by separating planes over whole intervals;
* self clearance: by what two points of the robot can move relative to each other, per metre of
  translation and per radian of rotation;
* capacity margin, which must cover the motion's inertia: by the sum of what each cable's wrench can
  change at its largest tension.

Tensions, at rest, and cable speeds are those at the samples, at most 5 mm apart; the capacity
margin proves that tensions within the limits exist everywhere between. Where the platform rotates,
the scene's rotation limits are compared in closed form.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from model.clearance import ClearanceModel, Nearest
from model.errors import BadInput
from model.kinematics import axis_distances, cables_at, structure_matrix
from model.plan import Plan
from model.pose import Array, Pose, interpolate
from model.rig import Rig
from model.scene import Scene, legs_of
from model.statics.feasibility import WrenchBox, capacity_margin
from model.statics.gravity import (
    STANDARD_GRAVITY,
    inertial_wrench,
    weight_wrench,
    working_tensions,
)
from model.statics.tension_distribution import TensionInfeasible
from model.statics.wrench_sets import rms_anchor_radius
from planner.bounds import Smallest, smallest_along, smallest_over_intervals
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
AXIS_RADII = 4.0
"""Smallest distance of an anchor from its pulley's swivel axis, in pulley radii."""
NEAR_AXIS = "is too close to its pulley's axis to bound its motion"
"""Violation of that distance, after the cable's name."""
SLOWER = "reduce motion.speed_mm_s, or correct winches[].max_speed_mm_s, in the rig file"
"""What to do about winches that are slower than a path needs at the rig's path speed."""
GENTLER = "reduce motion.acceleration_mm_s2, or motion.speed_mm_s, in the rig file"
"""What to do about cables that hold the platform, but cannot also accelerate it."""
CLEARANCE_TOLERANCE = 0.1e-3
"""Tolerance of the smallest clearances, [m]."""
SELF_CLEARANCE_SHARE = 0.01
"""Tolerance of the self clearance, as part of what exceeds the required one, where that is more: on
many robots it is the same along most of a path."""
MARGIN_TOLERANCE = 0.02
"""Tolerance of the smallest capacity margin, as part of the largest tension."""
LARGEST_ROTATION = np.pi - 1e-6
"""Of a move, [rad]: beyond, round-off decides its direction."""
HALF_TURN = "the platform rotates by a half turn in one move, in an undefined direction"
END_TOLERANCE = 1e-6
"""How far a path may pass from the scene's start, stops and goal, [m] and [rad]."""


def verify(plan: Plan, rig: Rig | None = None) -> VerifiedPlan:
    """Proves a plan for a rig and the scene it carries.

    Args:
        plan: The plan.
        rig: The rig as it is now, where its winches or motion may differ from the plan's own.

    Raises:
        PlanRejected: With every violation: what, by how much and where.
    """
    report = check_path(rig or plan.rig, plan.scene, plan.waypoints, plan.stops)
    if not report.passed:
        raise PlanRejected(
            report,
            where=f"plan for {plan.rig.name} in {plan.scene.name}",
            next_step=f"{report.cure or 'plan again with `cdpr plan`'}; nothing has moved",
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
    """Checks a path, from a few corners to the thousands of poses of an executed curve.

    Each leg from stop to stop is checked with the load carried on it. Where the load changes, both
    loads are checked; every load between them is then held as well.

    Args:
        rig: The robot.
        scene: Obstacles, clearances, load, start, stops and goal.
        poses: ``world_from_platform``; between two the platform moves straight.
        stops: Index of the pose at each of the scene's stops.
        ends: Whether the path must begin at the scene's start, meet its stops and end at its goal.

    Raises:
        BadInput: There are no poses, or ``stops`` does not match the scene's stops in order.
    """
    legs = legs_of(scene)
    paths = [PosePath(rig, part) for part in parted(poses, stops, len(legs) - 1)]
    reports = [
        _Check(rig, leg.scene, path).report((leg.begin, leg.end) if ends else None)
        for leg, path in zip(legs, paths, strict=True)
    ]
    return joined(reports, [float(path.marks[-1]) for path in paths])


def parted(poses: Sequence[Pose], stops: Sequence[int], count: int) -> list[Sequence[Pose]]:
    """The poses from stop to stop; a stop's pose ends one part and begins the next.

    Args:
        poses: Of the whole path.
        stops: Indices of those at stops.
        count: Number of stops required.

    Raises:
        BadInput: There are more or fewer stops, or they are not in order.
    """
    bounds = [0, *stops, len(poses) - 1]
    if len(stops) != count or any(a > b for a, b in pairwise(bounds)):
        raise BadInput(
            f"the path has its stops at poses {list(stops)}; required are {count} in ascending"
            f" order between 0 and {len(poses) - 1}",
            where="stops of a path",
        )
    return [poses[a : b + 1] for a, b in pairwise(bounds)]


class _Check:
    """One check of one path."""

    def __init__(self, rig: Rig, scene: Scene, path: PosePath) -> None:
        self.rig, self.scene, self.path = rig, scene, path
        self.model = ClearanceModel(rig, scene)
        self.violations: list[Violation] = []
        self.length_unit = rms_anchor_radius(rig.anchors)
        self.inertia = inertial_wrench(rig, scene.load, turns=path.turns)
        is_far = self._check_workspace()
        self.samples = np.empty(0) if is_far else path.samples(SPACING)
        self._poses = {sample: path.pose(sample) for sample in self.samples.tolist()}

    def report(self, ends: tuple[str, str] | None) -> CheckReport:
        """Figures and violations; ``ends`` names the poses that it must begin and end at."""
        if ends is not None:
            self._check_ends(ends)
        if not self.samples.size:
            return self._unchecked()
        self._check_rotations()
        self._check_pulleys()
        obstacle, obstacle_proof = self._obstacle_clearance()
        own, own_proof = self._self_clearance()
        margin = self._margin()
        tensions, speed = self._tensions(), self._cable_speed()
        return replace(
            self._unchecked(),
            samples=obstacle_proof.samples if obstacle_proof else own_proof.samples,
            obstacle_clearance=obstacle,
            proved_obstacle_clearance=obstacle_proof.proved if obstacle_proof else float("inf"),
            self_clearance=own,
            proved_self_clearance=own_proof.proved,
            min_tension=tensions[0],
            max_tension=tensions[1],
            capacity_margin=margin.value,
            proved_capacity_margin=margin.proved,
            max_cable_speed=speed,
        )

    def _unchecked(self) -> CheckReport:
        """The report of a path so far outside that sampling it would take hours or all memory."""
        first = self.path.poses[0]
        return CheckReport(
            length=self.path.length,
            required_obstacle_clearance=self.scene.obstacle_clearance,
            self_clearance=Closest(self.model.self_clearance(first), first, 0.0),
            required_self_clearance=self.scene.self_clearance,
            required_capacity_margin=self.inertia,
            violations=tuple(self.violations),
        )

    def _pose(self, position: float) -> Pose:
        return self._poses.get(position) or self.path.pose(position)

    def _check_workspace(self) -> bool:
        """Whether the path is farther outside the workspace box than the box is large."""
        positions = np.array([pose.position for pose in self.path.poses])
        outside = np.maximum(
            self.rig.workspace_lower - positions, positions - self.rig.workspace_upper
        ).max(axis=1)
        worst = int(np.argmax(outside))
        size = float(np.linalg.norm(self.rig.workspace_upper - self.rig.workspace_lower))
        is_far = not outside[worst] <= size
        if not outside[worst] <= END_TOLERANCE:
            what = "the path leaves the workspace box"
            if is_far:
                what += " so far that nothing else was checked (are all positions in metres?)"
            self._violation(what, float(outside[worst]), 0.0, "mm", positions[worst])
        return is_far

    def _check_ends(self, ends: tuple[str, str]) -> None:
        scene, poses = self.scene, self.path.poses
        for name, pose, wanted in (
            (ends[0], poses[0], scene.start),
            (ends[1], poses[-1], scene.goal),
        ):
            what = f"the path does not meet the scene's {name}"
            away, rotated = pose.distance_to(wanted), pose.angle_to(wanted)
            if not away <= END_TOLERANCE:
                self._violation(what, away, END_TOLERANCE, "mm", pose.position)
            if not rotated <= END_TOLERANCE:
                self._violation(what, rotated, END_TOLERANCE, "°", pose.position)

    def _check_rotations(self) -> None:
        """The scene's limits along every move, in closed form; a half turn has no direction."""
        angles, poses = self.path.angles, self.path.poses
        for k in np.flatnonzero(angles > LARGEST_ROTATION).tolist():
            self._violation(HALF_TURN, angles[k], LARGEST_ROTATION, "°", poses[k].position)
        limits = self.scene.rotation_limits
        if limits is None:
            return
        for start, end in pairwise(poses):
            excess = limits.excess(start, end)
            if excess is not None:
                what = f"the platform is {excess.how} too far"
                between = [interpolate(start, end, share) for share in np.linspace(0.0, 1.0, 101)]
                most = [p.tilt if excess.how == "tilted" else abs(p.turn) for p in between]
                position = between[int(np.argmax(most))].position
                self._violation(what, excess.measured, excess.limit, "°", position)
                return

    def _check_pulleys(self) -> None:
        """Anchors stay four pulley radii off the swivel axis: exits move at most half as fast.

        An anchor's motion dB moves its exit by at most 2 r dB / ρ about the axis and r dB / l along
        the pulley, with ρ the anchor's distance from the axis and l the free length, then > 2.8 r.
        """
        least = least_axis_distance(self.rig)
        if least == 0.0:
            return
        for sample in self.samples.tolist():
            pose = self._pose(sample)
            reach = axis_distances(self.rig, pose.apply(self.rig.anchors))
            k = int(np.argmin(reach))
            if not reach[k] >= least:
                self._violation(f"cable {k + 1} {NEAR_AXIS}", reach[k], least, "mm", pose.position)
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
        if self.path.turns or self.rig.pulley_radius > 0.0:

            def distances(poses: Sequence[Pose]) -> Array:
                return np.array([nearest(pose).distance for pose in poses])

            closest, proof = self._closest(nearest, distances, lambda motion: motion, required)
        else:
            proof = smallest_over_intervals(self.model, self.path, required, CLEARANCE_TOLERANCE)
            pose = self.path.pose(proof.at)
            closest = Closest(nearest(pose), pose, proof.at)
        self._clearance_violation("obstacle clearance", closest, proof, required)
        return closest, proof

    def _self_clearance(self) -> tuple[Closest, Smallest]:
        def distances(poses: Sequence[Pose]) -> Array:
            positions = np.array([pose.position for pose in poses])
            rotations = np.array([pose.rotation for pose in poses])
            return self.model.self_clearances(positions, rotations)

        required, change = self.scene.self_clearance, self._self_change()
        closest, proof = self._closest(
            self.model.self_clearance, distances, change, required, SELF_CLEARANCE_SHARE
        )
        self._clearance_violation("self clearance", closest, proof, required)
        return closest, proof

    def _self_change(self) -> Callable[[Array], Array]:
        """Largest change of self clearance from the start to positions along the path.

        Two cables: in translation their anchors move alike, so their points by at most that motion
        relative to each other; exits on pulleys add half of it each. In rotation anchors move by
        up to the platform's reach each, exits by half of it. Cable and platform: seen from the
        platform, a cable's point moves no farther than its exit, in rotation by its lever arm.
        That is largest at an end of a move.
        """
        exits = 0.0 if self.rig.pulley_radius == 0.0 else 0.5
        positions = np.array([pose.position for pose in self.path.poses])
        arms = np.linalg.norm(self.rig.outlets - positions[:, None, :], axis=-1).max(axis=1)
        levers = np.maximum(arms[:-1], arms[1:]) + 2.0 * self.rig.pulley_radius
        radius = self.path.radius
        per_radian = np.maximum(2.0 * (1.0 + exits) * radius, levers + exits * radius)
        return self.path.largest_change(1.0 + 2.0 * exits, per_radian)

    def _closest(
        self,
        nearest: Callable[[Pose], Nearest],
        distances: Callable[[Sequence[Pose]], Array],
        change: Callable[[Array], Array],
        required: float,
        share: float = 0.0,
    ) -> tuple[Closest, Smallest]:
        """The closest pose; ``distances`` is ``nearest`` for many poses at once."""

        def evaluate(positions: Array) -> Array:
            return distances([self._pose(p) for p in positions.tolist()])

        proof = smallest_along(self.samples, evaluate, change, required, CLEARANCE_TOLERANCE, share)
        pose = self._pose(proof.at)
        return Closest(nearest(pose), pose, proof.at), proof

    def _clearance_violation(
        self, name: str, closest: Closest, proof: Smallest, required: float
    ) -> None:
        pair = f"{closest.nearest.first} – {closest.nearest.second}"
        what = (f"{name} too small, {pair}", f"{name} not proved between samples, {pair}")
        self._smallest_violation(what, proof, required, "mm")

    def _smallest_violation(
        self, what: tuple[str, str], proof: Smallest, limit: float, unit: str, cure: str = ""
    ) -> None:
        """``what`` is said of a sample below the limit, and of a bound below it between samples."""
        below, unproved = what
        position = self._pose(proof.at).position
        if not proof.value >= limit:
            found = Violation(below, proof.value, limit, unit, position, cure=cure)
            self.violations.append(found)
        elif not proof.proved >= limit:
            found = Violation(unproved, proof.value, limit, unit, position, proof.proved)
            self.violations.append(found)

    def _margin(self) -> Smallest:
        load = self.scene.load
        disturbance = np.concatenate([load.force, load.moment])

        def evaluate(positions: Array) -> Array:
            poses = [self._pose(p) for p in positions.tolist()]
            matrices = np.array([structure_matrix(self.rig, pose) for pose in poses])
            weights = np.array([weight_wrench(self.rig, pose, load) for pose in poses])
            box = WrenchBox(weights, np.broadcast_to(disturbance, weights.shape))
            return capacity_margin(
                matrices, self.rig.min_tension, self.rig.max_tension, box, self.length_unit
            )

        tolerance = MARGIN_TOLERANCE * self.rig.max_tension
        change = self._margin_change()
        found = smallest_along(self.samples, evaluate, change, self.inertia, tolerance)
        below, limit, cure = "hold every required load", 0.0, ""
        if found.value >= 0.0:
            below, limit, cure = (
                "accelerate the platform by its motion limits",
                self.inertia,
                GENTLER,
            )
        below = f"the cables cannot {below}: capacity margin"
        unproved = "capacity margin not proved between samples"
        self._smallest_violation((below, unproved), found, limit, "N", cure)
        return found

    def _margin_change(self) -> Callable[[Array], Array]:
        """Largest change of the available wrench set, [N], from the start to positions.

        A cable's direction rotates by at most the motion of its ends over its free length. Its
        force changes by that, its moment by that times its lever arm over the unit of length. The
        lever arms of cables and weight rotate with the platform.
        """
        free = np.min(
            [
                np.linalg.norm(c.exits - c.anchors, axis=-1)
                for c in (cables_at(self.rig, self._pose(p)) for p in self.samples.tolist())
            ],
            axis=0,
        )
        ends = 1.0 if self.rig.pulley_radius == 0.0 else 1.5
        arms = np.linalg.norm(self.rig.anchors, axis=1) / self.length_unit
        turn = ends / np.maximum(free - SPACING * ends, 1e-6)
        change = turn * np.sqrt(1.0 + arms**2)
        per_metre = float(np.sum(self.rig.max_tension * change))
        load = self.scene.load
        moment = self.rig.mass * float(np.linalg.norm(self.rig.centre_of_mass))
        moment += load.payload_mass * float(np.linalg.norm(load.payload_centre))
        levers = self.rig.max_tension * float(arms.sum())
        levers += moment * STANDARD_GRAVITY / self.length_unit
        return self.path.largest_change(per_metre, per_metre * self.path.radius + levers)

    def _tensions(self) -> tuple[float, float]:
        low, high = np.inf, -np.inf
        for sample in self.samples.tolist():
            pose = self._pose(sample)
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
        twists = self.rig.motion.speed * self.path.twists(self.samples, self.length_unit)
        limits = np.array([winch.max_speed for winch in self.rig.winches])
        poses = [self._pose(sample) for sample in self.samples.tolist()]
        matrices = np.array([structure_matrix(self.rig, pose) for pose in poses])
        speeds = np.abs(np.einsum("kim,ki->km", matrices, twists))
        at, cable = np.unravel_index(np.argmax(speeds - limits), speeds.shape)
        if not speeds[at, cable] <= limits[cable]:
            what = f"cable {cable + 1} would have to move faster than its winch can"
            figures = float(speeds[at, cable]), float(limits[cable])
            found = Violation(what, *figures, "mm/s", poses[at].position, cure=SLOWER)
            self.violations.append(found)
        return float(speeds.max())

    def _violation(
        self, what: str, measured: float, limit: float, unit: str, position: Array
    ) -> None:
        self.violations.append(Violation(what, float(measured), float(limit), unit, position))


def least_axis_distance(rig: Rig) -> float:
    """Smallest distance of an anchor from its pulley's swivel axis, [m]; 0 without pulleys."""
    # An anchor may come nearer between samples.
    return AXIS_RADII * rig.pulley_radius + SPACING if rig.pulley_radius > 0.0 else 0.0
