"""The drawn scene of ``run.mcap``: obstacles and path once, the robot often enough to watch."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from executor.recording.cycle_table import CycleTable
from executor.recording.mcap_channels import STILL, WORLD, Message, pose_value, stamp_of, vector
from executor.recording.summary import RunContext
from model.geometry.solids import solid_of
from model.kinematics import cables_to
from model.pose import Pose
from model.rig import Rig

ROBOT_RATE = 20.0
"""How often the drawn robot is logged, [Hz]; the numbers are logged every cycle."""
_LINE_STRIP, _LINE_LIST = 0, 2
_OBSTACLE = {"r": 0.35, "g": 0.39, "b": 0.45, "a": 0.75}
_PLATFORM = {"r": 0.0, "g": 0.45, "b": 0.70, "a": 0.9}
_CABLE = {"r": 0.1, "g": 0.1, "b": 0.1, "a": 1.0}
_PATH = {"r": 0.84, "g": 0.37, "b": 0.0, "a": 1.0}


def scene_messages(context: RunContext, start: int) -> Iterator[Message]:
    """Obstacles and planned path, once."""
    entities = []
    for obstacle in context.plan.scene.obstacles:
        corners = [vector(p) for p in solid_of(obstacle).triangles().reshape(-1, 3).tolist()]
        surface = {"pose": STILL, "points": corners, "color": _OBSTACLE}
        entities.append(_entity(f"obstacle {obstacle.name}", start, 0.0, triangles=[surface]))
    corners = [vector(pose.position.tolist()) for pose in context.plan.waypoints]
    path = _line(_LINE_STRIP, corners, 3.0, _PATH)
    entities.append(_entity("planned path", start, 0.0, lines=[path]))
    yield "/scene", 0.0, {"deletions": [], "entities": entities}


def robot_messages(rig: Rig, cycles: CycleTable, start: int) -> Iterator[Message]:
    """Platform and cables where the encoders place them, often enough to watch."""
    known = np.isfinite(cycles.encoder).all(axis=1) & np.isfinite(cycles.encoder_rotation).all(
        axis=1
    )
    last = -np.inf
    for i in np.flatnonzero(known).tolist():
        time = float(cycles.time[i])
        if time - last < 1.0 / ROBOT_RATE - 1e-6:
            continue
        last = time
        position, quaternion = cycles.encoder[i], cycles.encoder_rotation[i]
        pose = Pose.from_quaternion(position, quaternion)
        cables = cables_to(rig, pose.apply(rig.anchors))
        ends = np.stack([cables.exits, cables.anchors], axis=1).reshape(-1, 3)
        points = [vector(point) for point in ends.tolist()]
        cube = {
            "pose": pose_value(position.tolist(), quaternion.tolist()),
            "size": vector((2.0 * rig.half_size).tolist()),
            "color": _PLATFORM,
        }
        lines = [_line(_LINE_LIST, points, 1.5, _CABLE)]
        entity = _entity("robot", start, time, cubes=[cube], lines=lines)
        yield "/robot", time, {"deletions": [], "entities": [entity]}


def _line(
    kind: int, points: list[dict[str, float | None]], thickness: float, color: dict[str, float]
) -> dict[str, Any]:
    return {
        "type": kind,
        "pose": STILL,
        "thickness": thickness,
        "scale_invariant": True,
        "points": points,
        "color": color,
    }


def _entity(name: str, start: int, time: float, **primitives: list[Any]) -> dict[str, Any]:
    return {
        "timestamp": stamp_of(start, time),
        "frame_id": WORLD,
        "id": name,
        "lifetime": {"sec": 0, "nsec": 0},
        "frame_locked": True,
        **primitives,
    }
