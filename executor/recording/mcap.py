"""``run.mcap``: all channels of a run in one file for Foxglove, rerun or PlotJuggler."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from foxglove.messages import CompressedImage, Log, LogLevel, Timestamp
from mcap.writer import Writer

from executor.recording.clearance import ClearanceTable, camera_of
from executor.recording.mcap_channels import (
    DRIVES,
    OWN,
    TYPED,
    Message,
    encoded,
    frame_of,
    nanoseconds,
    pose_message,
    poses_of,
    robot_messages,
    scene_messages,
    schema_of,
    stamp_of,
    topic_of,
    values_of,
)
from executor.recording.run_folder import PLAN, RIG, RunFolder
from executor.recording.table_files import Column
from executor.recording.tables import OK, CycleTable, FusedTable, PoseTable
from executor.recording.verdict import RunContext
from executor.safety.fault_messages import faults_among
from model.errors import Fault
from tracking.clearance import COVERAGE, MeasuredClearance
from tracking.measurement import NoPose
from tracking.pose_log import LoggedImage

# Camera messages of ``run.mcap``: poses, reasons for missing poses, kept images.


def camera_messages(
    folder: RunFolder, poses: PoseTable, alone: Mapping[str, PoseTable], start: int
) -> Iterator[Message]:
    """All messages of a run's cameras.

    Args:
        folder: Holds the kept images.
        poses: Fused poses of all cameras.
        alone: Poses of each of several cameras, by name; empty for a single camera.
        start: [ns since 1970].
    """
    yield from _tags(poses, start)
    for name, table in alone.items():
        yield from _tags(table, start, name)
        yield from _pictures(folder, table, start, name)
    if not alone:
        yield from _pictures(folder, poses, start)


def _tags(poses: PoseTable, start: int, camera: str = "") -> Iterator[Message]:
    topic = topic_of("/tag_pose", camera)
    yield from poses_of(topic, poses.time, poses.position, poses.rotation, start)
    contents = _records(
        {
            "frame": poses.frame.tolist(),
            "status": poses.status,
            "tags": poses.tags,
            "reprojection_px": values_of(poses.reprojection),
            "covariance": values_of(poses.covariance.reshape(-1, 36)),
        }
    )
    for time, content in zip(poses.time.tolist(), contents, strict=True):
        yield topic_of("/tag_status", camera), time, content


def _records(columns: Mapping[str, Sequence[Any]]) -> Iterator[dict[str, Any]]:
    """A dict for each row of columns."""
    return (dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True))


def _pictures(
    folder: RunFolder, poses: PoseTable, start: int, camera: str = ""
) -> Iterator[Message]:
    for time, name in zip(poses.time.tolist(), poses.picture, strict=True):
        if name and folder.has_image(name):
            picture = partial(_picture, folder, name, stamp_of(start, time), frame_of(camera))
            yield topic_of("/pictures", camera), time, picture


def _picture(folder: RunFolder, name: str, stamp: Timestamp, frame: str) -> CompressedImage:
    data = folder.image(name)
    return CompressedImage(timestamp=stamp, frame_id=frame, data=data, format="jpeg")


def write_mcap(
    folder: RunFolder,
    context: RunContext,
    cycles: CycleTable,
    poses: PoseTable,
    clearance: ClearanceTable,
    fused: FusedTable,
    alone: Mapping[str, PoseTable],
) -> Path:
    """Writes ``run.mcap``; its times are the start of the run plus run time.

    Args:
        folder: Run folder; its images are included, as far as they exist.
        poses: Pose of every image, or why there is none.
        alone: Poses of each of several cameras, by name; empty for a single camera.

    Raises:
        BadInput: An image cannot be read.
        Fault: The disk is full or gone; no partial file is left.
    """
    start = int(context.course.started.timestamp() * 1e6) * 1000
    messages = [
        *scene_messages(context, start),
        *robot_messages(context.rig, cycles, start),
        *_cycles(cycles, start),
        *camera_messages(folder, poses, alone, start),
        *_clearance(clearance),
        *poses_of("/fused_pose", fused.time, fused.position, fused.rotation, start),
        *_events(context, start),
    ]
    attached = [folder.path / name for name in (PLAN, RIG)]
    write_messages(folder.mcap, messages, start, attached)
    return folder.mcap


def write_messages(
    path: Path, messages: Sequence[Message], start: int, attached: Sequence[Path] = ()
) -> None:
    """Writes messages in order of time, atomically.

    Args:
        messages: Of the channels in `executor.recording.mcap_channels`, or of one of them for a
            single camera (`executor.recording.mcap_channels.topic_of`).
        start: Origin of their times, [ns since 1970].
        attached: JSON files to attach.

    Raises:
        Fault: The disk is full or gone; no partial file is left.
    """
    unfinished = path.with_name(f".{path.name[:40]}.{os.getpid()}")
    try:
        _write(unfinished, sorted(messages, key=lambda message: message[1]), start, attached)
        unfinished.replace(path)
    except OSError as error:
        raise Fault(
            "the log cannot be written",
            where=str(path),
            why=error.strerror or str(error),
            next_step="free some space; the CSV files hold the same data",
        ) from None
    finally:
        unfinished.unlink(missing_ok=True)


def _write(path: Path, messages: Sequence[Message], start: int, attached: Sequence[Path]) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="", library="cdpr")
        channels: dict[str, int] = {}
        for topic in sorted({topic for topic, _, _ in messages} | TYPED.keys() | OWN.keys()):
            encoding, name, kind, text = schema_of(topic)
            schema = writer.register_schema(name, kind, text)
            channels[topic] = writer.register_channel(topic, encoding, schema)
        counts = dict.fromkeys(channels, 0)
        for topic, time, content in messages:
            at = start + nanoseconds(time)
            writer.add_message(channels[topic], at, encoded(content), at, counts[topic])
            counts[topic] += 1
        for file in attached:
            content_of_file = file.read_bytes()
            writer.add_attachment(start, start, file.name, "application/json", content_of_file)
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
    columns = {column.name: column for column in cycles.columns()}
    *heads, drives = DRIVES["properties"]
    each = DRIVES["properties"][drives]["items"]["properties"]
    contents = _records({name: _json(columns[name]) for name in heads})
    cables = [
        _records({name: _json(columns[f"_{i}_".join(name.rsplit("_", 1))]) for name in each})
        for i in range(1, cycles.cable_count + 1)
    ]
    del columns  # a long run's numbers are as many bytes as its table
    for time, content, *parts in zip(cycles.time.tolist(), contents, *cables, strict=True):
        content[drives] = parts
        yield "/drives", time, content


def _json(column: Column) -> Sequence[Any]:
    """The values of a column for JSON."""
    return column.values if isinstance(column.values, tuple) else values_of(column.values)


def _clearance(clearance: ClearanceTable) -> Iterator[Message]:
    near = values_of(clearance.distances * 1e3)
    planned = values_of(clearance.planned_distances * 1e3)
    keys = ("distance_mm", "uncertainty_mm", "at_most_mm", "planned_distance_mm")
    columns = {column.name: column for column in clearance.columns()}
    values = zip(*(_json(columns[key]) for key in keys), strict=True)
    for i, row in enumerate(values):
        camera = camera_of(clearance.source[i])
        each = zip(clearance.obstacles, near[i], planned[i], strict=True)
        content: dict[str, Any] = {
            "source": "tag" if camera else clearance.source[i],
            **dict(zip(keys, row, strict=True)),
            "coverage": COVERAGE,
            "body": clearance.body[i],
            "obstacle": clearance.obstacle[i],
            "obstacles": [
                {"name": n, "distance_mm": d, "planned_distance_mm": p} for n, d, p in each
            ],
        }
        yield topic_of("/clearance", camera), float(clearance.time[i]), content


def _events(context: RunContext, start: int) -> Iterator[Message]:
    faults = faults_among(event.code for event in context.events)
    for event in context.events:
        level = LogLevel.Warning if event.code in faults else LogLevel.Info
        stamp = stamp_of(start, event.time_s)
        log = Log(timestamp=stamp, level=level, message=event.text, name=event.code)
        yield "/events", event.time_s, log


# Poses of `cdpr track` as an MCAP file, in the channels of a run's.


def write_track_mcap(
    path: Path,
    pictures: Sequence[LoggedImage],
    alone: Mapping[str, Sequence[LoggedImage]],
    start: int,
) -> None:
    """Writes ``/tag_pose``, ``/tag_status`` and ``/clearance``, also for each of several cameras.

    Args:
        pictures: Measurements; their times count from ``start``.
        alone: Measurements of each of several cameras, by name; empty for a single camera.
        start: [ns since 1970].

    Raises:
        Fault: The disk is full or gone; no partial file is left.
    """
    messages = list(_messages(pictures, start, ""))
    for name, own in alone.items():
        messages += _messages(own, start, name)
    write_messages(path, messages, start)


def _messages(pictures: Sequence[LoggedImage], start: int, camera: str) -> Iterator[Message]:
    pose_topic, status_topic, clearance_topic = (
        topic_of(channel, camera) for channel in ("/tag_pose", "/tag_status", "/clearance")
    )
    for logged in pictures:
        found, frame = logged.observation, logged.frame
        status: dict[str, Any] = {"frame": frame, "status": OK, "tags": "", "reprojection_px": None}
        if isinstance(found, NoPose):
            nothing = [None] * 36
            yield (
                status_topic,
                found.time,
                {**status, "status": found.reason, "covariance": nothing},
            )
            continue
        stamp = stamp_of(start, found.time)
        pose = pose_message(stamp, found.pose.position.tolist(), found.pose.quaternion.tolist())
        yield pose_topic, found.time, pose
        status |= {"tags": " ".join(map(str, found.tags)), "reprojection_px": found.reprojection}
        status["covariance"] = found.covariance.ravel().tolist()
        yield status_topic, found.time, status
        if logged.clearance is not None:
            yield clearance_topic, found.time, _track_clearance(logged.clearance)


def _track_clearance(clearance: MeasuredClearance) -> dict[str, Any]:
    nearest = min(clearance.nearest, key=lambda n: n.distance)
    return {
        "source": "tag",
        "distance_mm": clearance.distance * 1e3,
        "uncertainty_mm": clearance.uncertainty * 1e3,
        "at_most_mm": clearance.at_most * 1e3,
        "coverage": COVERAGE,
        "planned_distance_mm": None,
        "body": nearest.first,
        "obstacle": nearest.second,
        "obstacles": [
            {"name": n.second, "distance_mm": n.distance * 1e3, "planned_distance_mm": None}
            for n in clearance.nearest
        ],
    }
