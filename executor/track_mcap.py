"""Poses of `cdpr track` as an MCAP file, in the channels of a run's."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from executor.mcap_log import write_messages
from executor.mcap_values import WORLD, Message, pose_value, stamp_of, topic_of
from executor.pose_table import OK
from tracking.measured_clearance import MeasuredClearance
from tracking.measurement import NoPose
from tracking.pose_log import LoggedPicture


def write_track_mcap(
    path: Path,
    pictures: Sequence[LoggedPicture],
    alone: Mapping[str, Sequence[LoggedPicture]],
    start: int,
) -> None:
    """Writes ``/tag_pose``, ``/tag_status`` and ``/clearance``, of each of several cameras too.

    Args:
        path: The file.
        pictures: What was measured; their times count from ``start``.
        alone: What each of several cameras measured, by its name; nothing for a single one.
        start: [ns since 1970].

    Raises:
        Fault: The disk is full or gone; no part of the file is left.
    """
    messages = list(_messages(pictures, start, ""))
    for name, own in alone.items():
        messages += _messages(own, start, name)
    write_messages(path, messages, start)


def _messages(pictures: Sequence[LoggedPicture], start: int, camera: str) -> Iterator[Message]:
    pose_topic, status_topic, clearance_topic = (
        topic_of(channel, camera) for channel in ("/tag_pose", "/tag_status", "/clearance")
    )
    for frame, logged in enumerate(pictures):
        found = logged.observation
        status: dict[str, Any] = {"frame": frame, "status": OK, "tags": "", "reprojection_px": None}
        if isinstance(found, NoPose):
            nothing = [None] * 36
            yield (
                status_topic,
                found.time,
                {**status, "status": found.reason, "covariance": nothing},
            )
            continue
        pose = pose_value(found.pose.position.tolist(), found.pose.quaternion.tolist())
        stamp = stamp_of(start, found.time)
        yield pose_topic, found.time, {"timestamp": stamp, "frame_id": WORLD, "pose": pose}
        status |= {"tags": " ".join(map(str, found.tags)), "reprojection_px": found.reprojection}
        status["covariance"] = found.covariance.ravel().tolist()
        yield status_topic, found.time, status
        if logged.clearance is not None:
            yield clearance_topic, found.time, _clearance(logged.clearance)


def _clearance(clearance: MeasuredClearance) -> dict[str, Any]:
    nearest = min(clearance.nearest, key=lambda n: n.distance)
    return {
        "source": "tag",
        "distance_mm": clearance.distance * 1e3,
        "uncertainty_mm": clearance.uncertainty * 1e3,
        "at_most_mm": clearance.at_most * 1e3,
        "planned_distance_mm": None,
        "body": nearest.first,
        "obstacle": nearest.second,
        "obstacles": [
            {"name": n.second, "distance_mm": n.distance * 1e3, "planned_distance_mm": None}
            for n in clearance.nearest
        ],
    }
