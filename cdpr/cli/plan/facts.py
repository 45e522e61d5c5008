"""What a plan is, for people and for programs."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np

from model.files.plan_file import OptimalPlannerDocument, PlanDocument, PlannerDocument
from model.rotation_limits import largest_rotations
from model.scene import Scene, legs_of, scene_from_document
from model.statics.dexterity import rms_anchor_radius


def facts_of(document: PlanDocument) -> dict[str, Any]:
    """What a plan is, for programs."""
    return {
        "hash": document.hash,
        "rig": document.rig.name,
        "scene": document.scene.name,
        "planner": document.planner.model_dump(mode="json"),
        "waypoints": len(document.waypoints),
        "stops": [mark.model_dump(mode="json") for mark in document.stops],
        "quality": document.quality.model_dump(mode="json"),
        "statistics": document.statistics.model_dump(mode="json"),
    }


def sentences_of(document: PlanDocument) -> list[tuple[str, str]]:
    """What a plan is, for people."""
    quality = document.quality
    facts = [
        ("rig, scene", f"{document.rig.name}, {document.scene.name}"),
        *stop_facts(scene_from_document(document.scene)),
        (
            "length",
            f"{quality.length_mm:.1f} mm ({len(document.waypoints)} waypoints;"
            f" {quality.raw_length_mm:.1f} mm {_before(document)})",
        ),
    ]
    facts += _rotation(document)
    near = quality.obstacle_clearance
    if near is not None:
        facts.append(("clearance", f"{near.distance_mm:.2f} mm, {near.first} to {near.second}"))
    own = quality.self_clearance
    facts += [
        ("self clearance", f"{own.distance_mm:.2f} mm, {own.first} to {own.second}"),
        ("tension", f"{quality.min_tension_n:.1f} to {quality.max_tension_n:.1f} N"),
        ("kinematic cost", f"{quality.mean_kinematic_cost:.3f} on average"),
        ("search", _search_sentence(document)),
    ]
    return facts


def _before(document: PlanDocument) -> str:
    is_paper = isinstance(document.planner, PlannerDocument)
    return "before post-processing" if is_paper else "first path found"


def _rotation(document: PlanDocument) -> list[tuple[str, str]]:
    """One line for a plan on which the platform turns; none for others."""
    poses = [waypoint.pose() for waypoint in document.waypoints]
    if all(pose.angle_to(poses[0]) == 0.0 for pose in poses):
        return []
    found = [largest_rotations(a.quaternion, b.quaternion) for a, b in pairwise(poses)]
    tilt, turn = (math.degrees(max(values)) for values in zip(*found, strict=True))
    radius = rms_anchor_radius(np.array(document.rig.anchors_mm))
    way = sum(
        math.hypot(a.distance_to(b) * 1e3, radius * a.angle_to(b)) for a, b in pairwise(poses)
    )
    text = f"tilted up to {tilt:.2f}°, rotated up to {turn:.2f}°; {way:.1f} mm with rotation"
    return [("rotation", text)]


def _search_sentence(document: PlanDocument) -> str:
    statistics, planner = document.statistics, document.planner
    rest = f"{statistics.edge_checks} edge checks, {statistics.planning_time_s:.2f} s"
    if isinstance(planner, OptimalPlannerDocument):
        search = f", {(statistics.search_time_s or 0.0) * 1e3:.0f} ms of search"
        again = " ".join(f"--rounds {rounds}" for rounds in planner.rounds)
        return f"{sum(planner.rounds)} rounds (to repeat: {again}), {rest}{search}"
    return f"{statistics.nodes} nodes, {statistics.iterations} samples, {rest}"


def stop_facts(scene: Scene) -> list[tuple[str, str]]:
    """Stops with what happens there and what is carried on; nothing for a scene without."""
    carried = [leg.scene.load.payload_mass for leg in legs_of(scene)]
    shown = []
    for stop, before, after in zip(scene.stops, carried[:-1], carried[1:], strict=True):
        load = f", then {after:g} kg" if after != before else ""
        dwell = f" {stop.dwell:g} s" if stop.dwell > 0.0 else ""
        shown.append(f"{stop.name} ({stop.kind}{dwell}{load})")
    return [("via", ", ".join(shown))] if shown else []
