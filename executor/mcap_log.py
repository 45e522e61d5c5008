"""``run.mcap``: all channels of a run in one file for Foxglove, PlotJuggler or rerun."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer

from cdpr.errors import Fault
from cdpr.poses import Array
from executor.clearance_table import ClearanceTable, camera_of
from executor.cycle_table import CycleTable
from executor.fused_table import FusedTable
from executor.mcap_scene import robot_messages, scene_messages
from executor.mcap_schemas import CHANNELS
from executor.mcap_values import (
    WORLD,
    Message,
    channel_of,
    nanoseconds,
    pose_value,
    stamp_of,
    topic_of,
)
from executor.pose_table import PoseTable
from executor.run_folder import RunFolder
from executor.summary import RunContext

_INFO, _WARNING = 2, 3


def write_mcap(
    folder: RunFolder,
    context: RunContext,
    cycles: CycleTable,
    poses: PoseTable,
    clearance: ClearanceTable,
    fused: FusedTable,
    alone: Mapping[str, PoseTable],
) -> Path:
    """Writes ``run.mcap``; times in it are the start of the run plus run time.

    Args:
        folder: The run's folder; its pictures go into the file too.
        context: What the run was.
        cycles: Every cycle is logged.
        poses: Every picture's pose, or why there is none.
        clearance: Every row.
        fused: Every row.
        alone: What each of several cameras measured, by its name; nothing for a single one.

    Raises:
        Fault: The disk is full or gone; no part of the file is left.
    """
    start = int(context.started.timestamp() * 1e6) * 1000
    messages = [
        *scene_messages(context, start),
        *robot_messages(context.rig, cycles, start),
        *_cycles(cycles, start),
        *_tags(poses, start),
        *(message for name in alone for message in _tags(alone[name], start, name)),
        *_clearance(clearance),
        *_poses_of("/fused_pose", fused.time, fused.position, fused.rotation, start),
        *_events(context, start),
        *_all_pictures(folder, poses, alone, start),
    ]
    write_messages(folder.mcap, messages, start)
    return folder.mcap


def write_messages(path: Path, messages: Sequence[Message], start: int) -> None:
    """Writes messages in the order of their times, or no file.

    Args:
        path: The file.
        messages: Of the channels in `executor.mcap_schemas.CHANNELS`, or of one of them for a
            camera alone (`executor.mcap_values.topic_of`).
        start: What their times count from, [ns since 1970].

    Raises:
        Fault: The disk is full or gone; no part of the file is left.
    """
    try:
        _write(path, sorted(messages, key=lambda message: message[1]), start)
    except OSError as error:
        path.unlink(missing_ok=True)
        raise Fault(
            "the log cannot be written",
            where=str(path),
            why=error.strerror or str(error),
            next_step="free some space; the CSV files hold the same numbers",
        ) from None


def _write(path: Path, messages: Sequence[Message], start: int) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="", library="cdpr")
        schemas, channels = {}, {}
        for topic, (name, schema) in CHANNELS.items():
            data = json.dumps(schema).encode()
            schemas[topic] = writer.register_schema(name, "jsonschema", data)
        of_cameras = {topic for topic, _, _ in messages} - CHANNELS.keys()
        for topic in (*CHANNELS, *sorted(of_cameras)):
            number = schemas[channel_of(topic)]
            channels[topic] = writer.register_channel(topic, "json", number)
        counts = dict.fromkeys(channels, 0)
        for topic, time, content in messages:
            at = start + nanoseconds(time)
            data = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
            writer.add_message(channels[topic], at, data, at, counts[topic])
            counts[topic] += 1
        writer.finish()  # type: ignore[no-untyped-call]


def _rows(values: Array) -> list[list[float | None]]:
    """Rows as JSON can say them: null for what is not known."""
    if np.isfinite(values).all():
        rows: list[list[float | None]] = values.tolist()
        return rows
    return [[v if np.isfinite(v) else None for v in row] for row in values.tolist()]


def _column(values: Array) -> list[float | None]:
    return [v if np.isfinite(v) else None for v in values.tolist()]


def _poses_of(
    topic: str, times: Array, positions: Array, quaternions: Array, start: int
) -> Iterator[Message]:
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


def _cycles(cycles: CycleTable, start: int) -> Iterator[Message]:
    yield from _poses_of(
        "/planned_pose", cycles.time, cycles.planned, cycles.planned_rotation, start
    )
    yield from _poses_of(
        "/encoder_pose", cycles.time, cycles.encoder, cycles.encoder_rotation, start
    )
    yield from _drives(cycles)


def _drives(cycles: CycleTable) -> Iterator[Message]:
    drive_keys = ("set_counts", "actual_counts", "length_mm", "planned_tension_n", "tension_n")
    heads = zip(
        cycles.state,
        cycles.path_index.tolist(),
        cycles.leg.tolist(),
        cycles.stop,
        _column(cycles.travelled * 1e3),
        _column(cycles.lateness * 1e3),
        cycles.missing.tolist(),
        _column(cycles.following_error * 1e3),
        strict=True,
    )
    drives = zip(
        cycles.set_counts.tolist(),
        cycles.actual_counts.tolist(),
        _rows(cycles.lengths * 1e3),
        _rows(cycles.planned_tensions),
        _rows(cycles.tensions),
        strict=True,
    )
    where, how = ("state", "path_index", "leg", "stop", "path_mm"), ("lateness_ms", "missing")
    head_keys = (*where, *how, "following_error_mm")
    every = zip(cycles.time.tolist(), heads, drives, strict=True)
    for number, (time, head, values) in enumerate(every):
        content: dict[str, Any] = {"cycle": number, **dict(zip(head_keys, head, strict=True))}
        content["drives"] = [
            dict(zip(drive_keys, one, strict=True)) for one in zip(*values, strict=True)
        ]
        yield "/drives", time, content


def _tags(poses: PoseTable, start: int, camera: str = "") -> Iterator[Message]:
    topic = topic_of("/tag_pose", camera)
    yield from _poses_of(topic, poses.time, poses.position, poses.rotation, start)
    covariances = _rows(poses.covariance.reshape(-1, 36))
    rows = zip(
        poses.time.tolist(),
        poses.frame.tolist(),
        poses.status,
        poses.tags,
        _column(poses.reprojection),
        covariances,
        strict=True,
    )
    for time, frame, status, tags, reprojection, covariance in rows:
        content = {
            "frame": frame,
            "status": status,
            "tags": tags,
            "reprojection_px": reprojection,
            "covariance": covariance,
        }
        yield topic_of("/tag_status", camera), time, content


def _clearance(clearance: ClearanceTable) -> Iterator[Message]:
    near, planned = _rows(clearance.distances * 1e3), _rows(clearance.planned_distances * 1e3)
    keys = ("distance_mm", "uncertainty_mm", "at_most_mm", "planned_distance_mm")
    columns = (
        clearance.distance,
        clearance.uncertainty,
        clearance.at_most,
        clearance.planned_distance,
    )
    values = zip(*(_column(column * 1e3) for column in columns), strict=True)
    for i, row in enumerate(values):
        camera = camera_of(clearance.source[i])
        each = zip(clearance.obstacles, near[i], planned[i], strict=True)
        content: dict[str, Any] = {
            "source": "tag" if camera else clearance.source[i],
            **dict(zip(keys, row, strict=True)),
            "body": clearance.body[i],
            "obstacle": clearance.obstacle[i],
            "obstacles": [
                {"name": n, "distance_mm": d, "planned_distance_mm": p} for n, d, p in each
            ],
        }
        yield topic_of("/clearance", camera), float(clearance.time[i]), content


def _events(context: RunContext, start: int) -> Iterator[Message]:
    for event in context.events:
        content = {
            "timestamp": stamp_of(start, event.time_s),
            "level": _INFO if context.final_state == "finished" else _WARNING,
            "message": event.text,
            "name": event.code,
            "file": "",
            "line": 0,
        }
        yield "/events", event.time_s, content


def _all_pictures(
    folder: RunFolder, poses: PoseTable, alone: Mapping[str, PoseTable], start: int
) -> Iterator[Message]:
    if not alone:
        yield from _pictures(folder, poses, start)
    for name, table in alone.items():
        yield from _pictures(folder, table, start, name)


def _pictures(
    folder: RunFolder, poses: PoseTable, start: int, camera: str = ""
) -> Iterator[Message]:
    for time, name in zip(poses.time.tolist(), poses.picture, strict=True):
        if name:
            content = {
                "timestamp": stamp_of(start, time),
                "frame_id": camera or "camera",
                "data": base64.b64encode(folder.picture(name)).decode(),
                "format": "jpeg",
            }
            yield topic_of("/pictures", camera), time, content
