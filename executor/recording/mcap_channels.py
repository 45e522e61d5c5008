"""Channels of ``run.mcap``: Foxglove's Protobuf messages where one fits, else JSON.

Source: the Foxglove schemas, https://docs.foxglove.dev/docs/sdk/schemas (well-known names).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from foxglove import messages as fox

from executor.recording.table_files import Integers
from executor.recording.tables import CycleTable
from executor.recording.verdict import RunContext
from model.cameras import Camera
from model.files.camera_file import FISHEYE
from model.kinematics import cables_to
from model.pose import Array, Pose
from model.rig import Rig
from model.shapes import Obstacle, solid_of

Schema = dict[str, Any]
#: A Foxglove message.
Typed = (
    fox.CameraCalibration
    | fox.CompressedImage
    | fox.FrameTransforms
    | fox.Log
    | fox.PoseInFrame
    | fox.SceneUpdate
)
#: One message: topic, time since the start of the run [s], content; dicts for JSON. A function
#: makes a content that is too large to be in memory with all others.
Message = tuple[str, float, Typed | dict[str, Any] | Callable[[], Typed]]

#: Topic → message type, for Foxglove messages.
TYPED: dict[str, type[Typed]] = {
    "/planned_pose": fox.PoseInFrame,
    "/encoder_pose": fox.PoseInFrame,
    "/tag_pose": fox.PoseInFrame,
    "/fused_pose": fox.PoseInFrame,
    "/events": fox.Log,
    "/pictures": fox.CompressedImage,
    "/camera_calibration": fox.CameraCalibration,
    "/scene": fox.SceneUpdate,
    "/robot": fox.SceneUpdate,
    "/tf": fox.FrameTransforms,
}

_NUMBER: Schema = {"type": ["number", "null"]}
_TEXT: Schema = {"type": "string"}
_INTEGER: Schema = {"type": "integer"}


def _object(**properties: Schema) -> Schema:
    return {"type": "object", "properties": properties}


def _list(items: Schema) -> Schema:
    return {"type": "array", "items": items}


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
        "description": "6 x 6, row by row: position [m] and rotation vector [rad], world axes;"
        " without errors common to all images",
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

#: Topic → (name of the schema, JSON schema), for JSON messages.
OWN: dict[str, tuple[str, Schema]] = {
    "/tag_status": ("cdpr.TagStatus", TAG_STATUS),
    "/drives": ("cdpr.Drives", DRIVES),
    "/clearance": ("cdpr.Clearance", CLEARANCE),
}

WORLD, PLATFORM = "world", "platform"
STILL = fox.Pose(position=fox.Vector3(), orientation=fox.Quaternion(w=1.0))


def topic_of(channel: str, camera: str) -> str:
    """The topic of all cameras together, or of one of several."""
    return f"{channel}/{camera}" if camera else channel


def channel_of(topic: str) -> str:
    """The channel of a topic, for any camera."""
    return "/" + topic.split("/")[1]


def schema_of(topic: str) -> tuple[str, str, str, bytes]:
    """Encoding of messages, and name, encoding and text of their schema."""
    kind = TYPED.get(channel_of(topic))
    if kind is None:
        name, described = OWN[channel_of(topic)]
        return "json", name, "jsonschema", json.dumps(described).encode()
    schema = kind.get_schema()
    return schema.encoding, schema.name, schema.encoding, schema.data


def encoded(content: Typed | dict[str, Any] | Callable[[], Typed]) -> bytes:
    """Encodes a message."""
    if callable(content):
        content = content()
    if isinstance(content, dict):
        return json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
    return content.encode()


def nanoseconds(time: float) -> int:
    """[s] as whole nanoseconds."""
    return round(time * 1e9)


def stamp_of(start: int, time: float) -> fox.Timestamp:
    """The time stamp ``time`` [s] after ``start`` [ns since 1970]."""
    seconds, rest = divmod(start + nanoseconds(time), 1_000_000_000)
    return fox.Timestamp(sec=seconds, nsec=rest)


def vector(values: Sequence[float] | Array) -> fox.Vector3:
    """Three numbers."""
    return fox.Vector3(x=values[0], y=values[1], z=values[2])


def _quaternion(values: Sequence[float] | Array) -> fox.Quaternion:
    w, x, y, z = values
    return fox.Quaternion(x=x, y=y, z=z, w=w)


def pose_message(
    stamp: fox.Timestamp, position: Sequence[float] | Array, quaternion: Sequence[float] | Array
) -> fox.PoseInFrame:
    """A position [m] and a unit quaternion (w, x, y, z) in the world frame."""
    pose = fox.Pose(position=vector(position), orientation=_quaternion(quaternion))
    return fox.PoseInFrame(timestamp=stamp, frame_id=WORLD, pose=pose)


def values_of(values: Array | Integers) -> list[Any]:
    """Values for JSON, in lists as in the array: null for unknown values."""
    found = values.astype(np.object_)
    found[~np.isfinite(values)] = None
    listed: list[Any] = found.tolist()
    return listed


def poses_of(
    topic: str, times: Array, positions: Array, quaternions: Array, start: int
) -> Iterator[Message]:
    """A message per known pose.

    Args:
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
        yield topic, time, pose_message(stamp_of(start, time), position, quaternion)


# Scene for 3-D views: obstacles, path and cameras once, the robot at a low rate.

ROBOT_RATE = 20.0
"""Rate of the robot's geometry, [Hz]; values are logged every cycle."""
_OBSTACLE = fox.Color(r=0.35, g=0.39, b=0.45, a=0.75)
_PLATFORM = fox.Color(r=0.0, g=0.45, b=0.70, a=0.9)
_CABLE = fox.Color(r=0.1, g=0.1, b=0.1, a=1.0)
_PATH = fox.Color(r=0.84, g=0.37, b=0.0, a=1.0)
_STRIP, _LIST = fox.LinePrimitiveLineType.LineStrip, fox.LinePrimitiveLineType.LineList


def scene_messages(context: RunContext, start: int) -> Iterator[Message]:
    """Obstacles, planned path and the cameras used, once; all cameras if none is on record."""
    stamp = stamp_of(start, 0.0)
    yield "/scene", 0.0, scene_at(context.plan.scene.obstacles, context.plan.waypoints, stamp)
    used = {record.name for record in context.course.cameras}
    cameras = [one for one in context.rig.cameras if one.name in used] or context.rig.cameras
    for camera in cameras:
        alone = camera.name if len(cameras) > 1 else ""
        mounting = camera.world_from_camera
        yield "/tf", 0.0, _transform(stamp, frame_of(alone), mounting.position, mounting.quaternion)
        calibration = _calibration(camera, stamp, frame_of(alone))
        if calibration is not None:
            yield topic_of("/camera_calibration", alone), 0.0, calibration


def scene_at(
    obstacles: Sequence[Obstacle], waypoints: Sequence[Pose], stamp: fox.Timestamp
) -> fox.SceneUpdate:
    """Obstacles, and the path through waypoints, if any."""
    entities = []
    for obstacle in obstacles:
        corners = _points(solid_of(obstacle).triangles().reshape(-1, 3))
        surface = fox.TriangleListPrimitive(pose=STILL, points=corners, color=_OBSTACLE)
        entities.append(_entity(f"obstacle {obstacle.name}", stamp, triangles=[surface]))
    if waypoints:
        path = _line(_STRIP, np.array([p.position for p in waypoints]), 3.0, _PATH)
        entities.append(_entity("planned path", stamp, lines=[path]))
    return fox.SceneUpdate(entities=entities)


def frame_of(camera: str) -> str:
    """The frame of one of several cameras, or of the only one."""
    return f"camera/{camera}" if camera in (WORLD, PLATFORM) else camera or "camera"


def robot_messages(rig: Rig, cycles: CycleTable, start: int) -> Iterator[Message]:
    """Platform and cables at the encoder pose, at `ROBOT_RATE`."""
    last = -np.inf
    for i in np.flatnonzero(cycles.has_encoder_pose).tolist():
        time = float(cycles.time[i])
        if time - last < 1.0 / ROBOT_RATE - 1e-6:
            continue
        last = time
        pose = Pose.from_quaternion(cycles.encoder[i], cycles.encoder_rotation[i])
        for topic, message in robot_at(rig, pose, stamp_of(start, time)):
            yield topic, time, message


def robot_at(rig: Rig, pose: Pose, stamp: fox.Timestamp) -> Iterator[tuple[str, Typed]]:
    """Platform and cables at a pose, and the platform's frame, each with its topic."""
    cables = cables_to(rig, pose.apply(rig.anchors))
    ends = np.stack([cables.exits, cables.anchors], axis=1).reshape(-1, 3)
    drawn = fox.Pose(position=vector(pose.position), orientation=_quaternion(pose.quaternion))
    cube = fox.CubePrimitive(pose=drawn, size=vector(2.0 * rig.half_size), color=_PLATFORM)
    lines = [_line(_LIST, ends, 1.5, _CABLE)]
    yield "/robot", fox.SceneUpdate(entities=[_entity("robot", stamp, cubes=[cube], lines=lines)])
    yield "/tf", _transform(stamp, PLATFORM, pose.position, pose.quaternion)


def _transform(
    stamp: fox.Timestamp, frame: str, position: Array, quaternion: Array
) -> fox.FrameTransforms:
    transform = fox.FrameTransform(
        timestamp=stamp,
        parent_frame_id=WORLD,
        child_frame_id=frame,
        translation=vector(position),
        rotation=_quaternion(quaternion),
    )
    return fox.FrameTransforms(transforms=[transform])


def _calibration(camera: Camera, stamp: fox.Timestamp, frame: str) -> fox.CameraCalibration | None:
    """Camera calibration; None for lenses that Foxglove cannot describe: thin prism or tilt."""
    count = len(camera.distortion)
    if camera.lens == FISHEYE:
        model = "kannala_brandt"
    elif count <= 8:
        model = "plumb_bob" if count <= 5 else "rational_polynomial"
    else:
        return None
    lens = np.zeros({"kannala_brandt": 4, "plumb_bob": 5, "rational_polynomial": 8}[model])
    lens[:count] = camera.distortion
    return fox.CameraCalibration(
        timestamp=stamp,
        frame_id=frame,
        width=camera.width,
        height=camera.height,
        distortion_model=model,
        D=lens.tolist(),
        K=camera.matrix.reshape(-1).tolist(),
        R=np.eye(3).reshape(-1).tolist(),
        P=np.column_stack([camera.matrix, np.zeros(3)]).reshape(-1).tolist(),
    )


def _points(points: Array) -> list[fox.Point3]:
    return [fox.Point3(x=x, y=y, z=z) for x, y, z in points.tolist()]


def _line(
    kind: fox.LinePrimitiveLineType, points: Array, thickness: float, color: fox.Color
) -> fox.LinePrimitive:
    return fox.LinePrimitive(
        type=kind,
        pose=STILL,
        thickness=thickness,
        scale_invariant=True,
        points=_points(points),
        color=color,
    )


def _entity(name: str, stamp: fox.Timestamp, **primitives: Any) -> fox.SceneEntity:
    return fox.SceneEntity(
        timestamp=stamp,
        frame_id=WORLD,
        id=name,
        lifetime=fox.Duration(sec=0),
        frame_locked=True,
        **primitives,
    )
