"""JSON schemas of the channels of ``run.mcap``: Foxglove's own where one fits, else ours.

Source: the Foxglove schemas, https://docs.foxglove.dev/docs/sdk/schemas (well-known names).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from executor.recording.cycle_table import CycleTable
from executor.recording.summary import RunContext
from model.geometry.solids import solid_of
from model.kinematics import cables_to
from model.pose import Array, Pose
from model.rig import Rig

Schema = dict[str, Any]

_NUMBER: Schema = {"type": ["number", "null"]}
_TEXT: Schema = {"type": "string"}


def _object(**properties: Schema) -> Schema:
    return {"type": "object", "properties": properties}


def _list(items: Schema) -> Schema:
    return {"type": "array", "items": items}


_INTEGER: Schema = {"type": "integer"}
_TIME = _object(sec=_INTEGER, nsec=_INTEGER)
_VECTOR = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE = _object(position=_VECTOR, orientation=_QUATERNION)
_COLOR = _object(r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)

POSE_IN_FRAME = _object(timestamp=_TIME, frame_id=_TEXT, pose=_POSE)
LOG = _object(timestamp=_TIME, level=_INTEGER, message=_TEXT, name=_TEXT, file=_TEXT, line=_INTEGER)
COMPRESSED_IMAGE = _object(
    timestamp=_TIME,
    frame_id=_TEXT,
    data={"type": "string", "contentEncoding": "base64"},
    format=_TEXT,
)
_PRIMITIVES = {
    "cubes": _list(_object(pose=_POSE, size=_VECTOR, color=_COLOR)),
    "lines": _list(
        _object(
            type=_INTEGER,
            pose=_POSE,
            thickness=_NUMBER,
            scale_invariant={"type": "boolean"},
            points=_list(_VECTOR),
            color=_COLOR,
        )
    ),
    "triangles": _list(_object(pose=_POSE, points=_list(_VECTOR), color=_COLOR)),
}
SCENE_UPDATE = _object(
    deletions=_list(_object(timestamp=_TIME, type=_INTEGER, id=_TEXT)),
    entities=_list(
        _object(
            timestamp=_TIME,
            frame_id=_TEXT,
            id=_TEXT,
            lifetime=_TIME,
            frame_locked={"type": "boolean"},
            **_PRIMITIVES,
        )
    ),
)
DRIVES = _object(
    cycle=_INTEGER,
    state=_TEXT,
    path_index=_INTEGER,
    leg=_INTEGER,
    stop=_TEXT,
    path_mm=_NUMBER,
    lateness_ms=_NUMBER,
    missing=_INTEGER,
    following_error_mm=_NUMBER,
    drives=_list(
        _object(
            set_counts=_INTEGER,
            actual_counts=_INTEGER,
            length_mm=_NUMBER,
            planned_tension_n=_NUMBER,
            tension_n=_NUMBER,
        )
    ),
)
TAG_STATUS = _object(
    frame=_INTEGER,
    status=_TEXT,
    tags=_TEXT,
    reprojection_px=_NUMBER,
    covariance={
        **_list(_NUMBER),
        "description": "6 x 6, row by row: position [m] and rotation vector [rad], world axes",
    },
)
CLEARANCE = _object(
    source=_TEXT,
    distance_mm=_NUMBER,
    uncertainty_mm=_NUMBER,
    at_most_mm=_NUMBER,
    coverage={**_NUMBER, "description": "share of true distances within the interval"},
    planned_distance_mm=_NUMBER,
    body=_TEXT,
    obstacle=_TEXT,
    obstacles=_list(_object(name=_TEXT, distance_mm=_NUMBER, planned_distance_mm=_NUMBER)),
)

#: Topic → (name of the schema, schema).
CHANNELS: dict[str, tuple[str, Schema]] = {
    "/planned_pose": ("foxglove.PoseInFrame", POSE_IN_FRAME),
    "/encoder_pose": ("foxglove.PoseInFrame", POSE_IN_FRAME),
    "/tag_pose": ("foxglove.PoseInFrame", POSE_IN_FRAME),
    "/fused_pose": ("foxglove.PoseInFrame", POSE_IN_FRAME),
    "/tag_status": ("cdpr.TagStatus", TAG_STATUS),
    "/drives": ("cdpr.Drives", DRIVES),
    "/clearance": ("cdpr.Clearance", CLEARANCE),
    "/events": ("foxglove.Log", LOG),
    "/pictures": ("foxglove.CompressedImage", COMPRESSED_IMAGE),
    "/scene": ("foxglove.SceneUpdate", SCENE_UPDATE),
    "/robot": ("foxglove.SceneUpdate", SCENE_UPDATE),
}


# Times, vectors and poses as the messages of ``run.mcap`` write them.


#: One message: topic, time since the start of the run [s], content.
Message = tuple[str, float, dict[str, Any]]
WORLD = "world"


def topic_of(channel: str, camera: str) -> str:
    """The channel of all cameras together, or that of one of several alone."""
    return f"{channel}/{camera}" if camera else channel


def channel_of(topic: str) -> str:
    """The channel that a topic is of, whichever camera it is for."""
    return "/" + topic.split("/")[1]


def nanoseconds(time: float) -> int:
    """[s] as whole nanoseconds."""
    return round(time * 1e9)


def stamp_of(start: int, time: float) -> dict[str, int]:
    """The moment ``time`` [s] after ``start`` [ns since 1970]."""
    seconds, rest = divmod(start + nanoseconds(time), 1_000_000_000)
    return {"sec": seconds, "nsec": rest}


def vector(values: Sequence[float | None]) -> dict[str, float | None]:
    """Three numbers by axis."""
    return {"x": values[0], "y": values[1], "z": values[2]}


def pose_value(
    position: Sequence[float | None], quaternion: Sequence[float | None]
) -> dict[str, dict[str, float | None]]:
    """A position [m] and a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion
    return {"position": vector(position), "orientation": {"x": x, "y": y, "z": z, "w": w}}


STILL = pose_value((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))


def rows_of(values: Array) -> list[list[float | None]]:
    """Rows as JSON can say them: null for what is not known."""
    if np.isfinite(values).all():
        rows: list[list[float | None]] = values.tolist()
        return rows
    return [[v if np.isfinite(v) else None for v in row] for row in values.tolist()]


def column_of(values: Array) -> list[float | None]:
    """A column as JSON can say it."""
    return [v if np.isfinite(v) else None for v in values.tolist()]


def poses_of(
    topic: str, times: Array, positions: Array, quaternions: Array, start: int
) -> Iterator[Message]:
    """A message a pose that is known.

    Args:
        topic: Of the messages.
        times: Since the start of the run, shape (n,), [s].
        positions: Shape (n, 3), [m].
        quaternions: (w, x, y, z), shape (n, 4).
        start: [ns since 1970].
    """
    known = np.isfinite(positions).all(axis=1) & np.isfinite(quaternions).all(axis=1)
    rows = zip(
        times[known].tolist(), positions[known].tolist(), quaternions[known].tolist(), strict=True
    )
    for time, position, quaternion in rows:
        stamp = stamp_of(start, time)
        yield (
            topic,
            time,
            {"timestamp": stamp, "frame_id": WORLD, "pose": pose_value(position, quaternion)},
        )


# The drawn scene of ``run.mcap``: obstacles and path once, the robot often enough to watch.


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
