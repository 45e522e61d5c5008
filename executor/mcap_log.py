"""``run.mcap``: all channels of a run in one file for Foxglove, PlotJuggler or rerun."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mcap.writer import Writer

from cdpr.errors import Fault
from executor.clearance_table import ClearanceTable, camera_of
from executor.cycle_table import CycleTable
from executor.fused_table import FusedTable
from executor.mcap_cameras import camera_messages
from executor.mcap_scene import robot_messages, scene_messages
from executor.mcap_schemas import CHANNELS
from executor.mcap_values import (
    Message,
    channel_of,
    column_of,
    nanoseconds,
    poses_of,
    rows_of,
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
        *camera_messages(folder, poses, alone, start),
        *_clearance(clearance),
        *poses_of("/fused_pose", fused.time, fused.position, fused.rotation, start),
        *_events(context, start),
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


def _cycles(cycles: CycleTable, start: int) -> Iterator[Message]:
    yield from poses_of(
        "/planned_pose", cycles.time, cycles.planned, cycles.planned_rotation, start
    )
    yield from poses_of(
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
        column_of(cycles.travelled * 1e3),
        column_of(cycles.lateness * 1e3),
        cycles.missing.tolist(),
        column_of(cycles.following_error * 1e3),
        strict=True,
    )
    drives = zip(
        cycles.set_counts.tolist(),
        cycles.actual_counts.tolist(),
        rows_of(cycles.lengths * 1e3),
        rows_of(cycles.planned_tensions),
        rows_of(cycles.tensions),
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


def _clearance(clearance: ClearanceTable) -> Iterator[Message]:
    near, planned = rows_of(clearance.distances * 1e3), rows_of(clearance.planned_distances * 1e3)
    keys = ("distance_mm", "uncertainty_mm", "at_most_mm", "planned_distance_mm")
    columns = (
        clearance.distance,
        clearance.uncertainty,
        clearance.at_most,
        clearance.planned_distance,
    )
    values = zip(*(column_of(column * 1e3) for column in columns), strict=True)
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
