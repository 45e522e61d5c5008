"""Random robots with 6 to 12 cables, and random scenes with little room for them.

A seed and a number determine a robot or a scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.second_opinion import Nearness
from model.clearance import ClearanceModel
from model.errors import CdprError
from model.files.rig_file import RigDocument
from model.files.scene_file import SceneDocument
from model.pose import Array, Pose
from model.rig import Rig, load_rig, rig_from_document
from model.scene import Scene, scene_from_document
from planner.costs import capacity_margins
from planner.settings import CLEARANCE_RESERVE, MARGIN_RESERVE

SHAPES = ("box", "turned box", "sphere", "capsule", "cylinder", "convex", "closed mesh", "mesh")
PULLEYS = 0.15
"""Share of the robots whose cables leave over pulleys."""
_BASE = Path(__file__).parents[1] / "configs" / "gachon_8_6.yaml"
_ENOUGH = 0.3
"""Minimum share of the workspace in which a random robot can hold its platform."""
HELD_WELL = 5.0
"""Margin at start and goal, as a multiple of the planner's reserve: near the limits of feasibility
a search needs long proofs."""
_TRIED, _ENDS = 60, 6
"""Random positions tried for start and goal, and number of usable ones required."""


@dataclass(frozen=True)
class Robot:
    """A rig with the common properties of its scenes.

    Attributes:
        rig: The robot.
        wxyz: Orientation of the platform in all its scenes.
        load: The ``load`` of a scene file.
        self_mm: Largest self clearance of its scenes.
    """

    rig: Rig
    wxyz: list[float]
    load: dict[str, Any]
    self_mm: float


def random_robot(seed: int, number: int) -> Robot:
    """A robot that can hold its platform in a good part of its workspace."""
    rng = np.random.default_rng([seed, number, 1])
    count = 6 + number % 7
    while True:
        robot = _drawn_robot(rng, count)
        if robot is not None:
            return robot


def _drawn_robot(rng: np.random.Generator, count: int) -> Robot | None:
    rig = _drawn_rig(rng, count)
    angle = 0.0 if rng.random() < 0.6 else rng.uniform(0.0, 0.2)
    axis = rng.normal(size=3)
    turn = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
    load: dict[str, Any] = {}
    if rng.random() < 0.3:
        load = {"payload_kg": 0.2, "force_n": [0.5, 0.5, 0.5]}
    wxyz = turn.as_quat(scalar_first=True).tolist()
    bare = _scene(rig, wxyz, load, [], 0.0, 0.0, rig.home.position, rig.home.position)
    rotation = bare.start.rotation
    axes = np.linspace(rig.workspace_lower, rig.workspace_upper, 4).T
    positions = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
    try:
        held = (
            capacity_margins(rig, bare, positions, rotation)
            >= HELD_WELL * MARGIN_RESERVE * rig.max_tension
        )
        if held.mean() < _ENOUGH:
            return None
        model = ClearanceModel(rig, bare)
        own = [model.self_clearance(Pose(p, rotation)).distance for p in positions[held]]
    except CdprError:  # an anchor at its outlet, or inside its pulley
        return None
    self_mm = float(np.quantile(own, 0.3)) * 1e3
    return Robot(rig, wxyz, load, self_mm) if self_mm > 0.5 else None


def _drawn_rig(rng: np.random.Generator, count: int) -> Rig:
    frame = np.append(rng.uniform(450.0, 900.0, 2), rng.uniform(900.0, 1500.0))
    size = rng.uniform(60.0, 200.0, 3)
    around = 2.0 * np.pi * (np.arange(count) + rng.uniform(-0.25, 0.25, count)) / count
    upper = np.ones(count, dtype=bool) if count < 8 else np.arange(count) % 2 == 0
    alike = 1 if count < 8 else 2  # suspended cables resist rotations in pairs
    twist = rng.uniform(0.2, 0.9) * np.where(np.arange(count) % (2 * alike) < alike, 1.0, -1.0)
    crossed = count >= 8 and rng.random() < 0.5
    outlets = np.column_stack(
        [
            _square(around) * frame[:2] * rng.uniform(0.9, 1.0, (count, 1)),
            np.where(upper, frame[2], rng.uniform(0.0, 100.0, count)),
        ]
    )
    heights = np.where(upper != crossed, 0.5, -0.5) * size[2]
    anchors = np.column_stack([_square(around + twist) * size[:2] / 2.0, heights])
    low, high = (0.3 if count >= 8 else 0.15) * frame[2], 0.65 * frame[2]
    wide = rng.uniform(0.35, 0.5) if count >= 8 else rng.uniform(0.15, 0.3)
    document = load_rig(_BASE).document.model_dump(mode="json")
    winch = document["winches"][0]
    document |= {
        "name": f"random_{count}",
        "platform": {
            "size_mm": size.tolist(),
            "mass_kg": rng.uniform(0.3, 3.0),
            "centre_of_mass_mm": rng.uniform(-10.0, 10.0, 3).tolist(),
            "home": {"position_mm": [0.0, 0.0, (low + high) / 2.0]},
        },
        "workspace": {
            "lower_mm": [-wide * frame[0], -wide * frame[1], low],
            "upper_mm": [wide * frame[0], wide * frame[1], high],
        },
        "outlets_mm": outlets.tolist(),
        "anchors_mm": anchors.tolist(),
        "cables": document["cables"]
        | {
            "radius_mm": rng.choice([0.0, 1.0, 2.5]),
            "min_tension_n": rng.uniform(0.3, 2.0),
            "max_tension_n": rng.uniform(60.0, 300.0),
        },
        "pulleys": None,
        "winches": [winch | {"node_id": k + 1} for k in range(count)],
        "tags": None,
        "cameras": [],
    }
    if rng.random() < PULLEYS:
        feeds = np.where(upper[:, None], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0])
        document["pulleys"] = {"radius_mm": 15.0, "feed_directions": feeds.tolist()}
    return rig_from_document(RigDocument.model_validate(document))


def _square(angles: Array) -> Array:
    """Points on the border of the square of half width 1 in given directions, shape (k, 2)."""
    points = np.column_stack([np.cos(angles), np.sin(angles)])
    border: Array = points / np.abs(points).max(axis=1)[:, None]
    return border


def random_scene(robot: Robot, seed: int, number: int) -> Scene | None:
    """A scene for a robot; None if there is no room for start and goal."""
    rng = np.random.default_rng([seed, number, 2])
    rig = robot.rig
    reach = float((rig.workspace_upper - rig.workspace_lower).min()) * 1e3
    obstacles = [
        _obstacle(rng, rig, f"obstacle {k}", reach) for k in range(int(rng.integers(1, 9)))
    ]
    clearance_mm = rng.uniform(0.0, 25.0)
    self_mm = rng.uniform(0.0, robot.self_mm)
    fixed = (rig, robot.wxyz, robot.load, obstacles, clearance_mm, self_mm)
    scene = _scene(*fixed, rig.home.position, rig.home.position)
    free = _usable(rng, robot, scene)
    if len(free) < 2:
        return None
    distances = np.linalg.norm(free[:, None, :] - free[None, :, :], axis=-1)
    first, second = np.unravel_index(int(np.argmax(distances)), distances.shape)
    if rng.random() < 0.5:
        second = (first + 1) % len(free)
    return _scene(*fixed, free[first], free[second])


def _usable(rng: np.random.Generator, robot: Robot, scene: Scene) -> Array:
    """Positions where a plan can begin or end, shape (k, 3), [m]."""
    rig, found = robot.rig, []
    nearest = Nearness(rig, scene)
    for position in rng.uniform(rig.workspace_lower, rig.workspace_upper, (_TRIED, 3)):
        if not nearest.is_usable(position, CLEARANCE_RESERVE):
            continue
        margin = capacity_margins(rig, scene, position[None, :], np.array(scene.start.rotation))
        if margin[0] >= HELD_WELL * MARGIN_RESERVE * rig.max_tension:
            found.append(position)
        if len(found) == _ENDS:
            break
    return np.array(found)


def _scene(
    rig: Rig, wxyz: list[float], load: dict[str, Any], obstacles: list[dict[str, Any]],
    clearance_mm: float, self_mm: float, start: Array, goal: Array,
) -> Scene:  # fmt: skip
    start_mm, goal_mm = (np.round(1e3 * end, 6).tolist() for end in (start, goal))
    document = {
        "schema_version": 1,
        "name": f"random for {rig.name}",
        "clearance": {"obstacle_mm": round(clearance_mm, 6), "self_mm": round(self_mm, 6)},
        "load": load,
        "start": {"position_mm": start_mm, "rotation_wxyz": wxyz},
        "goal": {"position_mm": goal_mm, "rotation_wxyz": wxyz},
        "obstacles": obstacles,
    }
    return scene_from_document(SceneDocument.model_validate(document))


def _obstacle(rng: np.random.Generator, rig: Rig, name: str, reach_mm: float) -> dict[str, Any]:
    """An obstacle of random shape in or around the workspace, near cables and platform."""
    size = rig.workspace_upper - rig.workspace_lower
    position = rng.uniform(rig.workspace_lower - 0.4 * size, rig.workspace_upper + 0.4 * size)
    kind = str(rng.choice(SHAPES))
    entry: dict[str, Any] = {"name": f"{kind}, {name}", "position_mm": (1e3 * position).tolist()}
    if kind != "box":
        entry["rotation_wxyz"] = Rotation.random(rng=rng).as_quat(scalar_first=True).tolist()
    return entry | _shape(rng, kind, reach_mm)


def _shape(rng: np.random.Generator, kind: str, reach_mm: float) -> dict[str, Any]:
    radius, length = reach_mm * rng.uniform(0.02, 0.15), reach_mm * rng.uniform(0.1, 0.8)
    cloud = (reach_mm * rng.uniform(-0.2, 0.2, (9, 3))).tolist()
    match kind:
        case "box" | "turned box":
            return {"box": {"size_mm": (reach_mm * rng.uniform(0.03, 0.5, 3)).tolist()}}
        case "sphere":
            return {"sphere": {"radius_mm": radius}}
        case "capsule" | "cylinder":
            return {kind: {"radius_mm": radius, "length_mm": length}}
        case "convex":
            return {"convex": {"points_mm": cloud}}
        case "closed mesh":
            sides = [list(side) for side in combinations(range(4), 3)]
            return {"mesh": {"points_mm": cloud[:4], "triangles": sides}}
        case _:
            sides = [[0, 1, 2], [2, 3, 4], [4, 5, 6]]
            return {"mesh": {"points_mm": cloud[:7], "triangles": sides}}
