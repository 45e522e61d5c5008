"""Streams a run to Foxglove, in the channels of ``run.mcap``."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from foxglove import Channel, Context, Schema, layouts, set_log_level, start_server
from foxglove import messages as fox
from foxglove.websocket import WebSocketServer

from cdpr.console.view import RobotNow, RobotView
from executor.recording.mcap_channels import (
    Typed,
    encoded,
    pose_message,
    robot_at,
    scene_at,
    schema_of,
)
from model.clearance import Nearest
from model.errors import Fault

#: Period of the scene, [s], for programs that connect later.
SCENE_EVERY = 1.0
TOPICS = ("/scene", "/robot", "/tf", "/encoder_pose", "/drives", "/clearance", "/events")


class FoxgloveStream:
    """Messages to the programs that connect to the server."""

    def __init__(self, server: WebSocketServer, context: Context) -> None:
        """Opens the channels.

        Args:
            server: Already listening.
            context: Of the server's channels.
        """
        self.address = f"ws://127.0.0.1:{server.port}"
        """Address to open in Foxglove."""
        self._channels = {topic: _channel(topic, context) for topic in TOPICS}
        self._scene_at = float("-inf")
        self._sent_events: list[dict[str, Any]] = []

    def take(self, status: dict[str, Any], robot: tuple[RobotView, RobotNow] | None) -> None:
        """Sends the present status of a run.

        Args:
            status: See `executor.remote.status`.
            robot: Pose and clearance from the encoders; None before they are known.
        """
        now = time.time_ns()
        stamp = fox.Timestamp(sec=now // 10**9, nsec=now % 10**9)
        self._events(status, stamp, now)
        if status["drives"]:
            self._send("/drives", _drives(status), now)
        if robot is None:
            return
        view, seen = robot
        if time.monotonic() - self._scene_at >= SCENE_EVERY:
            self._scene_at = time.monotonic()
            self._send("/scene", scene_at(view.scene.obstacles, view.waypoints, stamp), now)
        pose = seen.pose
        for topic, message in robot_at(view.rig, pose, stamp):
            self._send(topic, message, now)
        self._send("/encoder_pose", pose_message(stamp, pose.position, pose.quaternion), now)
        if seen.nearest is not None:
            self._send("/clearance", _clearance(seen.nearest), now)

    def _events(self, status: dict[str, Any], stamp: fox.Timestamp, now: int) -> None:
        for event in status["events"]:
            if event not in self._sent_events:
                level = fox.LogLevel.Info
                text, code = event["text"], event["code"]
                self._send(
                    "/events", fox.Log(timestamp=stamp, level=level, message=text, name=code), now
                )
        self._sent_events = status["events"]

    def _send(self, topic: str, content: Typed | dict[str, Any], now: int) -> None:
        self._channels[topic].log(encoded(content), log_time=now)


@contextmanager
def foxglove_stream(port: int) -> Iterator[FoxgloveStream]:
    """A local server until the end of the block.

    Args:
        port: 0 for a free one.

    Raises:
        Fault: The port is in use.
    """
    set_log_level("ERROR")
    context = Context()
    try:
        server = start_server(name="cdpr", host="127.0.0.1", port=port, context=context)
    except Exception as error:  # the library raises several types
        raise Fault(
            f"Foxglove cannot be served: {error}",
            where=f"port {port}",
            next_step="choose another port with --foxglove PORT",
        ) from None
    try:
        yield FoxgloveStream(server, context)
    finally:
        server.stop()


def layout_text() -> str:
    """A layout for Foxglove: scene, plots of drives and clearance, events."""

    def plot(title: str, **series: str) -> layouts.SplitItem:
        paths = [layouts.PlotSeries(value=value, label=name) for name, value in series.items()]
        return layouts.SplitItem(
            content=layouts.PlotPanel(title=title, config=layouts.PlotConfig(paths=paths))
        )

    shown = layouts.BaseRendererSceneUpdateTopicSettings(visible=True)
    scene = layouts.ThreeDeeConfig(
        fixed_frame="world", follow_tf="world", topics={"/scene": shown, "/robot": shown}
    )
    curves = [
        plot("Tensions, N", tension="/drives.drives[:].tension_n"),
        plot(
            "Clearance, mm",
            clearance="/clearance.distance_mm",
            planned="/clearance.planned_distance_mm",
        ),
        plot("Following error, mm", error="/drives.following_error_mm"),
        layouts.SplitItem(content=layouts.LogPanel()),
    ]
    content = layouts.SplitContainer(
        direction="row",
        items=[
            layouts.SplitItem(proportion=3, content=layouts.ThreeDeePanel(config=scene)),
            layouts.SplitItem(
                proportion=2, content=layouts.SplitContainer(direction="column", items=curves)
            ),
        ],
    )
    return layouts.Layout(content=content).to_json()


def _channel(topic: str, context: Context) -> Channel:
    encoding, name, kind, text = schema_of(topic)
    schema = Schema(name=name, encoding=kind, data=text)
    return Channel(topic, schema=schema, message_encoding=encoding, context=context)


def _drives(status: dict[str, Any]) -> dict[str, Any]:
    return {
        "cycle": status["cycle"],
        "state": status["state"],
        "path_mm": status["path_mm"],
        "lateness_ms": status["lateness_ms"],
        "following_error_mm": status["following_error_mm"],
        "drives": [
            {
                "set_counts": drive["set_counts"],
                "actual_counts": drive["position_counts"],
                "tension_n": drive["tension_n"],
            }
            for drive in status["drives"]
        ],
    }


def _clearance(nearest: Nearest) -> dict[str, Any]:
    return {
        "source": "encoder",
        "distance_mm": 1e3 * nearest.distance,
        "body": nearest.first,
        "obstacle": nearest.second,
        "obstacles": [],
    }
