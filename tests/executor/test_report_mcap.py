"""``run.mcap`` read back with the library's own reader: every channel, count and time."""

from __future__ import annotations

import json
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.json_format import MessageToDict
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory

from executor.recording.mcap import write_mcap
from executor.recording.mcap_channels import OWN, TYPED
from executor.recording.record_files import CameraRecord
from executor.recording.run_folder import RunFolder
from executor.recording.tables import fused_table
from model.errors import BadInput, Fault
from tests.executor import fake_run

#: Of each channel: time, and the message as its own schema in the file decodes it.
Messages = dict[str, list[tuple[int, Any]]]


@pytest.fixture(scope="module")
def run() -> fake_run.FakeRun:
    return fake_run.make(rate_hz=2.0, every=20)


@pytest.fixture(scope="module")
def folder(run: fake_run.FakeRun, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return fake_run.write(run, tmp_path_factory.mktemp("mcap") / "run")


@pytest.fixture(scope="module")
def messages(folder: RunFolder) -> Messages:
    return read(folder)


def read(folder: RunFolder) -> Messages:
    found: Messages = defaultdict(list)
    decoders = DecoderFactory()
    with folder.mcap.open("rb") as stream:
        for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            decode = decoders.decoder_for(channel.message_encoding, schema) or json.loads
            found[channel.topic].append((message.log_time, decode(message.data)))
    return found


def test_no_row_is_lost(run: fake_run.FakeRun, folder: RunFolder, messages: Messages) -> None:
    cycles, poses = len(run.cycles), run.poses
    seen = sum(status == "ok" for status in poses.status)
    counts = {topic: len(rows) for topic, rows in messages.items()}
    assert counts.pop("/robot") > 100
    assert counts.pop("/tf") > 100
    assert counts == {
        "/planned_pose": cycles,
        "/encoder_pose": cycles,
        "/drives": cycles,
        "/tag_pose": seen,
        "/fused_pose": len(fused_table(run.cycles, poses)),
        "/tag_status": len(poses),
        "/clearance": len(run.clearance),
        "/events": len(run.context.events),
        "/pictures": sum(bool(name) for name in folder.poses().picture),
        "/scene": 1,
        "/camera_calibration": 1,
    }


def test_times_are_the_start_plus_run_time(run: fake_run.FakeRun, messages: Messages) -> None:
    start = int(run.context.course.started.timestamp()) * 1_000_000_000
    times = np.array([time - start for time, _ in messages["/drives"]]) / 1e9
    np.testing.assert_allclose(times, run.cycles.time, atol=1e-9)
    stamps = [m.timestamp for _, m in messages["/tag_pose"]]
    at = [s.seconds * 1_000_000_000 + s.nanos for s in stamps]
    assert at == [time for time, _ in messages["/tag_pose"]]


def test_numbers_are_those_of_the_tables(run: fake_run.FakeRun, messages: Messages) -> None:
    _, drive = messages["/drives"][33]
    assert drive["path_index"] == run.cycles.path_index[33]
    assert drive["drives"][4]["set_counts"] == run.cycles.set_counts[33, 4]
    assert drive["drives"][7]["tension_n"] == run.cycles.tensions[33, 7]
    _, pose = messages["/encoder_pose"][33]
    assert pose.frame_id == "world"
    assert pose.pose.position.y == run.cycles.encoder[33, 1]
    turn = pose.pose.orientation
    assert (turn.x, turn.y, turn.z, turn.w) == (0.0, 0.0, 0.0, 1.0)
    highs = [m["at_most_mm"] for _, m in messages["/clearance"]]
    order = np.argsort(run.clearance.time, kind="stable")
    np.testing.assert_allclose(highs, run.clearance.at_most[order] * 1e3)
    _, status = messages["/tag_status"][0]
    np.testing.assert_array_equal(
        np.array(status["covariance"]).reshape(6, 6), run.poses.covariance[0]
    )


def test_a_image_without_a_pose_states_why_and_has_nulls(
    run: fake_run.FakeRun, messages: Messages
) -> None:
    lost = run.poses.status.index("no tags seen, 2 needed")
    _, status = messages["/tag_status"][lost]
    assert status["status"] == "no tags seen, 2 needed"
    assert status["reprojection_px"] is None
    assert set(status["covariance"]) == {None}


def test_images_are_the_jpegs_of_the_folder(folder: RunFolder, messages: Messages) -> None:
    name = next(name for name in folder.poses().picture if name)
    _, picture = messages["/pictures"][0]
    assert picture.data == folder.image(name)
    assert (picture.format, picture.frame_id) == ("jpeg", "camera")


def test_the_camera_is_in_the_tree_of_frames_with_its_lens(
    run: fake_run.FakeRun, messages: Messages
) -> None:
    (camera,) = run.context.rig.cameras
    _, calibration = messages["/camera_calibration"][0]
    assert list(calibration.K) == camera.matrix.reshape(-1).tolist()
    assert list(calibration.D)[: len(camera.distortion)] == camera.distortion.tolist()
    assert (calibration.width, calibration.height) == (camera.width, camera.height)
    frames = {m.transforms[0].child_frame_id: m.transforms[0] for _, m in messages["/tf"]}
    assert frames.keys() == {"camera", "platform"}
    assert {frame.parent_frame_id for frame in frames.values()} == {"world"}
    translation = frames["camera"].translation
    assert [
        translation.x,
        translation.y,
        translation.z,
    ] == camera.world_from_camera.position.tolist()


@pytest.mark.parametrize("used", [("right",), ("left", "right"), ("platform", "world")])
def test_cameras_that_were_not_used_name_nothing(
    run: fake_run.FakeRun, tmp_path: Path, used: tuple[str, ...]
) -> None:
    """Images, frames and calibrations belong together, also of one of a rig's cameras."""
    (camera,) = run.context.rig.cameras
    cameras = tuple(replace(camera, name=name) for name in (*used, "spare"))
    context = fake_run.changed(
        run.context,
        rig=replace(run.context.rig, cameras=cameras),
        cameras=tuple(CameraRecord(name, "0", 9, 9, 0, 2.0, "") for name in used),
    )
    folder = fake_run.write(replace(run, context=context), tmp_path / "run")
    poses, fused = folder.poses(), fused_table(run.cycles, run.poses)
    alone = dict.fromkeys(used, poses) if len(used) > 1 else {}
    write_mcap(folder, context, run.cycles, poses, run.clearance, fused, alone)
    found = read(folder)
    of_images = {topic: rows[0][1].frame_id for topic, rows in found.items() if "pict" in topic}
    of_lenses = {topic: rows[0][1].frame_id for topic, rows in found.items() if "calib" in topic}
    frames = {m.transforms[0].child_frame_id for _, m in found["/tf"]} - {"platform"}
    assert "world" not in frames
    assert frames == set(of_images.values()) == set(of_lenses.values())
    assert of_lenses == {
        topic.replace("/pictures", "/camera_calibration"): name for topic, name in of_images.items()
    }
    assert len(of_images) == len(used)


def test_cables_are_drawn_from_their_outlets_to_the_platform(
    run: fake_run.FakeRun, messages: Messages
) -> None:
    rig, (at, robot) = run.context.rig, messages["/robot"][40]
    (entity,) = robot.entities
    points = np.array([[p.x, p.y, p.z] for p in entity.lines[0].points]).reshape(-1, 2, 3)
    transform = next(m.transforms[0] for time, m in messages["/tf"] if time == at)
    centre = transform.translation
    np.testing.assert_allclose(points[:, 1] - [centre.x, centre.y, centre.z], rig.anchors)
    lengths = np.linalg.norm(points[:, 0] - points[:, 1], axis=1)
    assert lengths.min() > 0.1
    assert lengths.max() < 3.0


def test_plan_and_rig_are_attached_as_they_were(folder: RunFolder) -> None:
    with folder.mcap.open("rb") as stream:
        attached = {a.name: a.data for a in make_reader(stream).iter_attachments()}
    assert attached == {
        name: (folder.path / name).read_bytes() for name in ("plan.json", "rig.json")
    }


def test_every_channel_has_its_schema_and_messages_fit_it(
    folder: RunFolder, messages: Messages
) -> None:
    with folder.mcap.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    schemas = {c.topic: summary.schemas[c.schema_id] for c in summary.channels.values()}
    assert schemas.keys() == TYPED.keys() | OWN.keys()
    for topic, schema in schemas.items():
        if topic in OWN:
            assert (schema.name, schema.encoding) == (OWN[topic][0], "jsonschema")
            for _, message in messages[topic][:3]:
                assert_fits(message, json.loads(schema.data), topic)
        else:
            assert schema.encoding == "protobuf"
            assert schema.name.startswith("foxglove.")
            assert all(MessageToDict(message) for _, message in messages[topic][:3])


def assert_fits(value: Any, schema: dict[str, Any], path: str) -> None:
    kinds = {
        "object": dict,
        "array": list,
        "string": str,
        "integer": int,
        "number": (int, float),
        "null": type(None),
        "boolean": bool,
    }
    types = schema["type"] if isinstance(schema["type"], list) else [schema["type"]]
    assert any(isinstance(value, kinds[name]) for name in types), f"{path}: {value!r}"
    if isinstance(value, dict):
        assert set(value) <= set(schema["properties"]), path
        for key, inner in value.items():
            assert_fits(inner, schema["properties"][key], f"{path}.{key}")
    elif isinstance(value, list):
        for inner in value[:3]:
            assert_fits(inner, schema["items"], f"{path}[]")


def test_one_image_at_a_time_is_in_memory(
    folder: RunFolder, tmp_path: Path, run: fake_run.FakeRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A long run keeps many, of several megabytes each."""
    order: list[str] = []
    read_image, add_message = RunFolder.image, Writer.add_message

    def reading(self: RunFolder, name: str) -> bytes:
        order.append("read")
        return read_image(self, name)

    def writing(self: Writer, channel: int, at: int, data: bytes, *more: int) -> None:
        if b"jpeg" in data:
            order.append("written")
        add_message(self, channel, at, data, *more)

    monkeypatch.setattr(RunFolder, "image", reading)
    monkeypatch.setattr(Writer, "add_message", writing)
    poses, fused = folder.poses(), fused_table(run.cycles, run.poses)
    write_mcap(folder, run.context, run.cycles, poses, run.clearance, fused, {})
    assert order == ["read", "written"] * sum(map(bool, poses.picture))
    assert len(order) > 4


def test_an_image_that_cannot_be_read_leaves_no_broken_log(
    tmp_path: Path, run: fake_run.FakeRun
) -> None:
    folder = fake_run.write(run, tmp_path / "run")
    poses, before = folder.poses(), {*folder.path.iterdir()}
    poses = replace(poses, picture=tuple("rig.json" if name else "" for name in poses.picture))
    with pytest.raises(BadInput, match="image cannot be read"):
        write_mcap(
            folder, run.context, run.cycles, poses, run.clearance,
            fused_table(run.cycles, run.poses), {},
        )  # fmt: skip
    assert {*folder.path.iterdir()} == before


def test_a_full_disk_leaves_no_broken_log(
    tmp_path: Path, run: fake_run.FakeRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = RunFolder.create(tmp_path / "run")

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("mcap.writer.Writer.add_message", full)
    with pytest.raises(Fault, match="log cannot be written"):
        write_mcap(
            folder,
            run.context,
            run.cycles,
            run.poses,
            run.clearance,
            fused_table(run.cycles, run.poses),
            {},
        )
    assert not folder.mcap.exists()


def test_poses_fused_after_reading_the_tables_are_the_same(
    run: fake_run.FakeRun, tmp_path: Path
) -> None:
    """Images at the times of cycles, apart by less than the tables show."""
    late = replace(run, poses=replace(run.poses, time=run.poses.time + 1e-12))
    folder = fake_run.write(late, tmp_path / "run", pictures=False)
    again = fused_table(folder.cycles(), folder.poses())
    assert again.csv_rows() == fused_table(late.cycles, late.poses).csv_rows()
    assert again.age.min() == 0.0


def test_an_image_in_a_gap_of_the_encoder_poses_corrects_none(run: fake_run.FakeRun) -> None:
    """The poses around the gap say nothing about where the platform was in between."""
    cycles, poses = run.cycles, run.poses
    rows = np.flatnonzero(poses.ok)
    first, last = poses.time[rows[len(rows) // 3]], poses.time[rows[len(rows) // 2]]
    encoder = cycles.encoder.copy()
    encoder[(cycles.time > first) & (cycles.time < last)] = np.nan
    gap = replace(cycles, encoder=encoder)
    inside = (poses.time > first) & (poses.time < last)
    assert inside.sum() > 2
    pairs = zip(inside, poses.status, strict=True)
    without = replace(poses, status=tuple("covered" if bad else text for bad, text in pairs))
    found, expected = fused_table(gap, poses), fused_table(gap, without)
    assert len(found) == len(expected) < len(fused_table(cycles, poses))
    np.testing.assert_array_equal(found.position, expected.position)
