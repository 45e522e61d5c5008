"""What cameras saw, as messages of ``run.mcap``: poses, why there is none, kept pictures."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping

from executor.mcap_values import Message, column_of, poses_of, rows_of, stamp_of, topic_of
from executor.pose_table import PoseTable
from executor.run_folder import RunFolder


def camera_messages(
    folder: RunFolder, poses: PoseTable, alone: Mapping[str, PoseTable], start: int
) -> Iterator[Message]:
    """All messages of a run's cameras.

    Args:
        folder: Holds the kept pictures.
        poses: What all cameras measured together.
        alone: What each of several measured, by its name; nothing for a single one.
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
    covariances = rows_of(poses.covariance.reshape(-1, 36))
    rows = zip(
        poses.time.tolist(),
        poses.frame.tolist(),
        poses.status,
        poses.tags,
        column_of(poses.reprojection),
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
