"""Messages that a client like Foxglove receives, decoded by the announced schemas."""

from __future__ import annotations

import base64
import json
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from websockets.sync.client import connect

from cdpr.cli.operate import monitor
from cdpr.console.foxglove import TOPICS, foxglove_stream, layout_text
from model.errors import Fault
from tests.cli.program import call
from tests.cli.test_monitor import status
from tests.executor import fake_run

_DATA = struct.Struct("<BIQ")  # opcode, subscription, time; the protocol's document has it


@pytest.fixture(scope="module")
def run_status(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """A run's status in the middle of its path."""
    run = fake_run.make(rate_hz=2.0, every=20)
    folder = fake_run.write(run, tmp_path_factory.mktemp("live") / "run", pictures=False)
    k = len(run.cycles) // 2
    drives = [
        {"node": i + 1, "state": "operation enabled", "position_counts": int(counts)}
        | {"set_counts": int(counts), "tension_n": float(run.cycles.planned_tensions[k, i])}
        for i, counts in enumerate(run.cycles.set_counts[k])
    ]
    where = {"planned": run.cycles.planned[k], "obstacles": run.context.plan.scene.obstacles}
    return {**status(folder=str(folder.path), drives=drives), **where}


def decoded(channel: dict[str, Any], data: bytes) -> Any:
    """A message decoded only by the schema of its channel."""
    if channel["encoding"] == "json":
        return json.loads(data)
    files = descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(channel["schema"]))
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"]))
    return kind.FromString(data)


def seen_by_a_client(run_status: dict[str, Any]) -> dict[str, Any]:
    """The first message of each topic."""
    robot = monitor._Robot().seen(run_status)
    found: dict[str, Any] = {}
    with (
        foxglove_stream(0) as stream,
        connect(stream.address, subprotocols=["foxglove.sdk.v1"]) as client,  # type: ignore[list-item]
    ):
        channels: dict[int, dict[str, Any]] = {}
        while len(channels) < len(TOPICS):
            message = json.loads(client.recv(timeout=10.0))
            if message["op"] == "advertise":
                channels |= {one["id"]: one for one in message["channels"]}
        wanted = [{"id": number, "channelId": number} for number in channels]
        client.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        for _ in range(100):
            if len(found) == len(TOPICS):
                break
            stream._scene_at = float("-inf")  # the client may have subscribed after the first
            stream._sent_events = []
            stream.take(run_status, robot)
            for data in _received(client):
                _, number, _ = _DATA.unpack_from(data)
                found[channels[number]["topic"]] = decoded(channels[number], data[_DATA.size :])
    return found


def _received(client: Any) -> Iterator[bytes]:
    while True:
        try:
            message = client.recv(timeout=0.1)
        except TimeoutError:
            return
        if isinstance(message, bytes):
            yield message


def test_a_client_sees_robot_scene_drives_clearance_and_events(run_status: dict[str, Any]) -> None:
    seen = seen_by_a_client(run_status)
    assert seen.keys() == set(TOPICS)
    position = seen["/encoder_pose"].pose.position
    np.testing.assert_allclose(
        [position.x, position.y, position.z], run_status["planned"], atol=2e-5
    )
    moved = seen["/tf"].transforms[0]
    assert (moved.parent_frame_id, moved.child_frame_id) == ("world", "platform")
    names = {entity.id for entity in seen["/scene"].entities}
    assert names == {f"obstacle {o.name}" for o in run_status["obstacles"]} | {"planned path"}
    assert len(seen["/drives"]["drives"]) == 8
    # In ``run.mcap``: drives that did not answer in that cycle; a status has those of the run.
    assert "missing" not in seen["/drives"]
    assert seen["/events"].message == "what [drives] reported"
    assert 0.0 < seen["/clearance"]["distance_mm"] < 1000.0


def test_a_port_in_use_is_reported() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        with pytest.raises(Fault, match="Foxglove cannot be served"):
            foxglove_stream(other.getsockname()[1]).__enter__()


def test_the_layout_is_json_with_topics_that_are_streamed(tmp_path: Path) -> None:
    file = tmp_path / "layout.json"
    assert call("monitor", "--foxglove-layout", file).code == 0
    text = file.read_text()
    assert json.loads(text) == json.loads(layout_text())
    for topic in ("/scene", "/robot", "/drives", "/clearance"):
        assert topic in text
        assert topic in TOPICS
    again = call("monitor", "--foxglove-layout", file)
    assert again.code == 2
    assert "exists already" in again.err
