"""What rig and scene must allow for a plan: at start, stops and goal, and along the path found."""

from __future__ import annotations

from math import comb

import numpy as np

from model.clearance import PLATFORM, ClearanceModel, Nearest, SelfModel, cable_name
from model.distances import convex_bodies, separation
from model.errors import BadInput, distinct_figures
from model.files.new_rig import CABLES_MOST
from model.kinematics import NoCable, axis_distances, structure_matrix
from model.pose import Pose
from model.rig import Rig
from model.scene import NO_SCENE, Leg, Scene, empty_scene, legs_of
from model.shapes import Sphere
from model.statics.feasibility import limiting_cables
from model.statics.gravity import inertial_wrench, working_tensions
from model.statics.tension_distribution import TensionInfeasible, remedy
from model.statics.wrench_sets import rms_anchor_radius
from planner.check import GENTLER, NEAR_AXIS, least_axis_distance
from planner.check_report import CheckReport
from planner.costs import LENGTH_ROUND_OFF, capacity_margins, external_wrenches, margin_reserve
from planner.settings import CLEARANCE_RESERVE, MARGIN_RESERVE

SAME_ROTATION = 1e-7
"""Angle up to which two orientations are the same, [rad]: files round quaternions to nine digits.
The path keeps the start's, and its check allows ten times this."""
_NEAR_AXIS_WHY = "nearer than four pulley radii the motion of the cable's exit cannot be bounded"


def unusable_home(rig: Rig) -> list[str]:
    """Why no motion can begin at home, as remarks; empty if one can.

    The cables cannot hold the platform there, or are nearer to each other or to it than a scene
    allows by default.
    """
    try:
        working_tensions(rig, rig.home)
    except (NoCable, TensionInfeasible) as error:
        return [f"platform.home: {error.what}; {error.why}; {error.next_step}"]
    scene = empty_scene(rig)
    near = ClearanceModel(rig, scene).self_clearance(rig.home)
    required = scene.self_clearance + CLEARANCE_RESERVE
    if near.distance >= required:
        return []
    gap, least = distinct_figures((near.distance * 1e3, required * 1e3), 2)
    apart = f"is {gap} mm from" if near.distance > 0.0 else "touches"
    return [
        f"platform.home: {near.first} {apart} {near.second}; a motion that begins there needs"
        f" {least} mm, by the default of a scene's clearance.self_mm; if two outlets or anchors are"
        " interchanged, correct them; otherwise move them or the home position"
    ]


def require_usable_ends(rig: Rig, scene: Scene, *, free_rotation: bool = False) -> None:
    """Refuses a start, stop or goal at which no path can begin or end.

    The cables must hold the platform at a stop with the load it brings and the load it leaves with.

    Args:
        scene: Start, stops and goal.
        free_rotation: Whether they may differ in orientation.

    Raises:
        BadInput: The rig has too many cables; an anchor is too deep inside the platform's box; one
            of them is outside the workspace box, violates an obstacle or self clearance, or cannot
            be held; or they differ in orientation.
    """
    _require_few_cables(rig)
    _require_outer_anchors(rig, scene)
    model = ClearanceModel(rig, scene)
    for leg in legs_of(scene):
        if not free_rotation:
            _require_same_orientation(scene, leg)
        for name, pose in ((leg.begin, leg.scene.start), (leg.end, leg.scene.goal)):
            _require_in_workspace(rig, name, pose)
            _require_off_pulley_axes(rig, name, pose)
            _require_clear(scene, model, name, pose)
            _require_holdable(rig, leg.scene, name, pose, turns=free_rotation)


def require_feasible_length(scene: Scene, longest: float) -> None:
    """Refuses a longest path, [m], below the straight distance from start to goal.

    Raises:
        BadInput: The longest path is too short.
    """
    straight = scene.start.distance_to(scene.goal)
    if longest >= straight - LENGTH_ROUND_OFF:
        return
    most, least = distinct_figures((longest * 1e3, straight * 1e3), 1)
    raise BadInput(
        f"no path of at most {most} mm joins start and goal: the straight line is {least} mm long",
        where=f"scene {scene.name}",
        next_step="allow a longer path with `longest=`, or leave it out",
        values={"longest_mm": longest * 1e3, "straight_mm": straight * 1e3},
    )


def require_limits_not_searched(rig: Rig, report: CheckReport) -> None:
    """Refuses a path for what is checked but not searched for.

    Raises:
        BadInput: An anchor comes too near its pulley's swivel axis, or all violations are of the
            rig's motion: its winches are too slow for it, or its cables cannot give the force.
    """
    for violation in report.violations:
        if violation.what.endswith(NEAR_AXIS):
            raise BadInput(
                violation.sentence(),
                where=f"path found for rig {rig.name}",
                why=f"{_NEAR_AXIS_WHY}, and the search does not avoid such poses",
                next_step="add a stop to the scene that leads the platform around that pose, or"
                " give waypoints to `cdpr.plan_from_waypoints`; no plan was written",
            )
    if report.cure:
        raise BadInput(
            "; ".join(violation.sentence() for violation in report.violations),
            where=f"rig {rig.name}",
            why="the search does not avoid poses by the rig's motion limits",
            next_step=report.cure,
        )


def _require_few_cables(rig: Rig) -> None:
    """Refuses rigs for which planning would take minutes without a word."""
    count = rig.cable_count
    if count > CABLES_MOST:
        raise BadInput(
            f"{count} cables are too many to plan for; the largest number is {CABLES_MOST}",
            where=f"rig {rig.name}",
            why=f"each set of five cables bounds the wrenches that all can produce:"
            f" {comb(count, 5)} bounds at each of thousands of poses",
            next_step="plan with fewer cables, such as one where several pull in parallel",
            values={"cables": count, "cables_most": CABLES_MOST},
        )


def _require_outer_anchors(rig: Rig, scene: Scene) -> None:
    """Refuses anchors so deep in the platform's box that no pose keeps the self clearance.

    A cable is compared with the box from a stub's length off its anchor on. Whatever its direction,
    it is there no farther outside than the stub is longer than the anchor is deep.
    """
    stub, needed = SelfModel(rig).stub, scene.self_clearance + CLEARANCE_RESERVE
    depths = np.min(rig.half_size - np.abs(rig.anchors), axis=1)
    cable = int(np.argmax(depths))
    depth, most = float(depths[cable]), stub - rig.cable_radius - needed
    if depth < 0.0 or depth <= most:
        return
    where = f"{depth * 1e3:.1f} mm inside the platform's box" if depth else "on the platform's box"
    deep = f"move the anchor to at most {most * 1e3:.2f} mm inside the box, correct the box"
    raise BadInput(
        f"at no pose does cable {cable + 1} keep {needed * 1e3:.2f} mm from the platform: its"
        f" anchor is {where}",
        where=f"rig {rig.name}",
        why=f"only the first {stub * 1e3:.1f} mm of a cable, a quarter of the shortest side of the"
        " box, may be nearer",
        next_step=f"{deep if most >= 0.0 else 'declare a thicker box'}, or {_nearer_cables(scene)}",
        values={"cable": cable + 1, "depth_mm": depth * 1e3, "required_mm": needed * 1e3},
    )


def _require_same_orientation(scene: Scene, leg: Leg) -> None:
    angle = scene.start.angle_to(leg.scene.goal)
    if angle > SAME_ROTATION:
        raise BadInput(
            f"start and {leg.end} differ in orientation by {np.degrees(angle):.3g} deg",
            where=f"scene {leg.scene.name}",
            why="without `free_rotation=True` the search keeps the platform's orientation",
            next_step="plan with `planner='optimal'` and `free_rotation=True` (the scene then needs"
            f" rotation_limits), or give the {leg.end} the start's rotation_wxyz; in Python a"
            " measured start may take the goal's: cdpr.Pose(pose.position, scene.goal.rotation)",
            values={"angle_deg": float(np.degrees(angle))},
        )


def _require_in_workspace(rig: Rig, name: str, pose: Pose) -> None:
    below = rig.workspace_lower - pose.position
    above = pose.position - rig.workspace_upper
    outside = float(np.max(np.maximum(below, above)))
    if outside <= 1e-9:
        return
    axis = int(np.argmax(np.maximum(below, above)))
    low, high = rig.workspace_lower[axis] * 1e3, rig.workspace_upper[axis] * 1e3
    at, *_ = distinct_figures((float(pose.position[axis]) * 1e3, low, high), 1)
    by, _ = distinct_figures((outside * 1e3, 0.0), 1)
    raise BadInput(
        f"the {name} is {by} mm outside the workspace: {'xyz'[axis]} = {at} mm,"
        f" limits {low:g} to {high:g} mm",
        where=f"scene {name}",
        next_step=f"move the {name} into the workspace box of the rig file",
        values={"outside_mm": outside * 1e3},
    )


def _require_off_pulley_axes(rig: Rig, name: str, pose: Pose) -> None:
    """As the check of a path requires."""
    reach, needed = axis_distances(rig, pose.apply(rig.anchors)), least_axis_distance(rig)
    cable = int(np.argmin(reach))
    if reach[cable] >= needed:
        return
    distance, least = distinct_figures((float(reach[cable]) * 1e3, needed * 1e3), 1)
    raise BadInput(
        f"at the {name} the anchor of cable {cable + 1} is {distance} mm from the swivel axis of"
        f" its pulley, less than the required {least} mm",
        where=f"scene {name}",
        why=_NEAR_AXIS_WHY,
        next_step=f"move the {name}, or the outlet in the rig file",
        values={"cable": cable + 1, "distance_mm": float(reach[cable]) * 1e3},
    )


def _require_clear(scene: Scene, model: ClearanceModel, name: str, pose: Pose) -> None:
    nearest = model.smallest(pose)
    pairs = [(model.self_clearance(pose), scene.self_clearance, "self_mm")]
    if nearest is not None:
        pairs.insert(0, (nearest, scene.obstacle_clearance, "obstacle_mm"))
    for near, asked, key in pairs:
        needed = asked + CLEARANCE_RESERVE
        if near.distance < needed:
            if key == "obstacle_mm":
                _require_clear_outlet(model.rig, scene, near, needed)
            raise _clearance_error(scene, name, near, needed, key, model.rig)


def _require_clear_outlet(rig: Rig, scene: Scene, near: Nearest, needed: float) -> None:
    """Refuses an obstacle so near to a cable's outlet that the cable is too near at every pose."""
    names = [cable_name(cable) for cable in range(rig.cable_count)]
    if rig.pulley_radius or near.first not in names:  # the exit moves along the pulley
        return
    outlet = Pose.level(rig.outlets[names.index(near.first)])
    [end] = convex_bodies(Sphere(rig.cable_radius), outlet)
    [obstacle] = (one for one in scene.obstacles if one.name == near.second)
    parts = convex_bodies(obstacle.shape, obstacle.pose)
    distance = min(separation(end, part).distance for part in parts)
    if distance >= needed:
        return
    gap, least = distinct_figures((distance * 1e3, needed * 1e3), 2)
    where = f"{gap} mm from it" if distance > 0.0 else "in it"
    reduced = ", or reduce clearance.obstacle_mm in the scene" if distance > 0.0 else ""
    raise BadInput(
        f"at no pose does {near.first} keep {least} mm from {near.second}: its outlet is {where}",
        where=f"scene {scene.name}",
        why="every cable begins at its outlet",
        next_step=f"let {near.second} end short of the outlet, leave it out if the platform cannot"
        f" reach it{reduced}",
        values={"distance_mm": distance * 1e3, "required_mm": needed * 1e3, "pair": _pair(near)},
    )


def _nearer_cables(scene: Scene) -> str:
    """The step that lets cables be nearer to each other and to the platform."""
    if scene.name == NO_SCENE:
        return (
            "pass a scene with a smaller clearance.self_mm: `cdpr jog --scene FILE`, in Python"
            " scene="
        )
    return "reduce clearance.self_mm in the scene"


def _clearance_error(
    scene: Scene, name: str, near: Nearest, needed: float, key: str, rig: Rig
) -> BadInput:
    distance, limit = near.distance * 1e3, needed * 1e3
    if near.distance <= 0.0:
        depth = f" (overlap {-distance:.1f} mm)" if distance < -0.05 else ""
        what = f"at the {name} {near.first} touches {near.second}{depth}"
    else:
        gap, least = distinct_figures((distance, limit), 2)
        what = (
            f"at the {name} {near.first} is {gap} mm from {near.second},"
            f" less than the required {least} mm"
        )
    given = ", or --clearance-mm of `cdpr plan` and `cdpr jog`, in Python clearance=,"
    given = "" if key == "self_mm" else given
    whose = "the default" if scene.name == NO_SCENE else "the scene's"
    why = f"{whose} clearance.{key}{given} plus 0.05 mm that the planner keeps in reserve"
    next_step = f"move the {name} or the obstacle, or reduce the clearance"
    values: dict[str, float | str] = {
        "distance_mm": distance,
        "required_mm": limit,
        "pair": _pair(near),
    }
    if key == "self_mm":
        reduced = f", or {_nearer_cables(scene)}" if near.distance > 0.0 else ""
        order = "if two outlets or anchors are interchanged, correct the rig file"
        next_step = f"move the {name}{reduced}; {order}"
        if near.second == PLATFORM:
            box = "correct the anchor or the platform's box in the rig file"
            next_step = f"move the {name}, {box}, or {_nearer_cables(scene)}"
        elif shared := _shared_end(rig, near):
            end, exempt = shared
            why += (
                f"; they share an {end}, and only the first {exempt * 1e3:.1f} mm from there, a"
                " quarter of the box's shortest side, may be nearer"
            )
            next_step = (
                f"declare a thicker platform box in the rig file, move the {name}, or"
                f" {_nearer_cables(scene)}"
            )
            values["exempt_mm"] = exempt * 1e3
    return BadInput(what, where=f"scene {name}", why=why, next_step=next_step, values=values)


def _shared_end(rig: Rig, near: Nearest) -> tuple[str, float] | None:
    """The end that two cables share, and the length there that is not compared, [m]."""
    own = SelfModel(rig)
    pair = {near.first, near.second}
    for cables, stubs in zip(own.pairs.tolist(), own.stubs.tolist(), strict=True):
        if {cable_name(cable) for cable in cables} == pair and max(stubs) > 0.0:
            return ("anchor" if stubs[0] > 0.0 else "outlet"), max(stubs)
    return None


def _pair(near: Nearest) -> str:
    return f"{near.first} – {near.second}"


def _require_holdable(rig: Rig, scene: Scene, name: str, pose: Pose, *, turns: bool) -> None:
    margin = float(capacity_margins(rig, scene, pose.position[None, :], pose.rotation)[0])
    reserve = margin_reserve(rig, scene.load, turns=turns)
    if margin >= reserve:
        return
    if not np.isfinite(margin):
        raise BadInput(
            f"at the {name} the cables cannot hold the platform at any tension",
            where=f"scene {scene.name}",
            why="they act in too few directions: the structure matrix is rank-deficient there",
            next_step=f"move the {name}, or change the rig's outlets and anchors",
        )
    values: dict[str, float | str] = {"margin_n": margin, "required_n": reserve}
    binding = limiting_cables(
        structure_matrix(rig, pose),
        rig.min_tension,
        rig.max_tension,
        external_wrenches(rig, scene, pose.rotation),
        rms_anchor_radius(rig.anchors),
    )
    has, needs, _ = distinct_figures((margin, reserve, 0.0), 2)
    larger = f"move the {name} to a larger margin (`cdpr workspace` maps it), {remedy(*binding)}"
    if turns and margin >= margin_reserve(rig, scene.load, turns=False):
        larger += ", or plan without `free_rotation=True`"
    if 0.0 <= margin < inertial_wrench(rig, scene.load, turns=turns):
        raise BadInput(
            f"at the {name} the cables can hold the platform, but not accelerate it by its motion"
            f" limits: the capacity margin is {has} N, required {needs} N",
            where=f"scene {name}",
            next_step=f"{GENTLER}, or {larger}",
            values=values,
        )
    if margin >= 0.0:
        raise BadInput(
            f"at the {name} the cables can hold the platform, but the capacity margin is"
            f" {has} N, less than the planner's reserve of {needs} N",
            where=f"scene {name}",
            why=f"with less than {MARGIN_RESERVE:.1%} of max_tension_n, or half of it beyond the"
            " force of the motion's acceleration, feasibility between poses is seldom proved",
            next_step=f"{larger}, or give waypoints to `cdpr.plan_from_waypoints`, which keeps no"
            " reserve",
            values=values,
        )
    raise BadInput(
        f"at the {name} the cables cannot hold the platform: the capacity margin is {has} N,"
        f" required {needs} N",
        where=f"scene {name}",
        why="weight, payload and disturbances need tensions outside min_tension_n..max_tension_n",
        next_step=f"{remedy(*binding)}, or move the {name} inward",
        values=values,
    )
