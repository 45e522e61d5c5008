"""Times, vectors and poses as the messages of ``run.mcap`` write them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from cdpr.poses import Array

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
