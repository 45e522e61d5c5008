"""`cdpr track`: pose log, clearance, MCAP, and images with the measurements."""

from __future__ import annotations

import csv
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader

from drivers.cameras.files import ImageFolder, image_files, read_image
from model.errors import BadInput
from model.rig import load_rig
from tests.cli.plans import CONFIGS, RIG, write_short_plan
from tests.cli.program import call, nothing_written, one_message
from tracking.measurement import NoPose
from tracking.pose_log import CLEARANCE_COLUMNS, POSE_COLUMNS
from tracking.track import USED, draw_measurement
from tracking.track import track as tracked
from tracking.tracker import Tracker

SESSION = CONFIGS.parent / "examples" / "rig_session" / "pictures"


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_short_plan(tmp_path_factory.mktemp("plan") / "plan.json")


def test_poses_clearance_mcap_and_pictures_agree(plan: Path, tmp_path: Path) -> None:
    log, mcap, drawn = tmp_path / "poses.csv", tmp_path / "poses.mcap", tmp_path / "drawn"
    arguments = ("synthetic", "--plan", plan, "-o", log, "--mcap", mcap, "--overlay", drawn)
    answer = call("track", RIG, *arguments, "--pictures", "3", "--json")
    assert answer.code == 0, answer
    facts = json.loads(answer.out)
    assert facts["poses"] == 3
    assert facts["measuring_ms"] > 0.0
    assert facts["pictures_per_second"] > 0.0
    with log.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert tuple(rows[0]) == POSE_COLUMNS + CLEARANCE_COLUMNS
    nearest = min(float(row["clearance_mm"]) for row in rows)
    assert nearest == pytest.approx(facts["smallest_clearance_mm"], abs=1e-3)
    assert all(float(row["clearance_uncertainty_mm"]) > 0.5 for row in rows)
    at_most = [float(row["clearance_at_most_mm"]) for row in rows]
    assert all(high > float(row["clearance_mm"]) for high, row in zip(at_most, rows, strict=True))
    assert {row["obstacle"] for row in rows} == {"block"}
    with mcap.open("rb") as stream:
        messages = [
            (channel.topic, message.data)
            for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages()
        ]
    measured = [json.loads(data) for topic, data in messages if topic == "/clearance"]
    counted = Counter(topic for topic, _ in messages)
    assert counted == {"/tag_pose": 3, "/tag_status": 3, "/clearance": 3}
    distances = [content["distance_mm"] for content in measured]
    assert distances == pytest.approx([float(row["clearance_mm"]) for row in rows], abs=1e-5)
    highs = [content["at_most_mm"] for content in measured]
    assert highs == pytest.approx(at_most, abs=1e-5)
    names = sorted(path.name for path in drawn.iterdir())
    assert names == ["rendered_0.png", "rendered_1.png", "rendered_2.png"]
    picture = cv2.imread(str(drawn / names[0]))
    assert picture is not None
    greenish = np.all(np.abs(picture.astype(int) - USED) < 60, axis=-1)
    assert greenish.sum() > 100, "outlines of the tags"


def test_an_image_of_another_size_is_skipped_and_reported(tmp_path: Path) -> None:
    for picture in image_files(SESSION)[:2]:
        (tmp_path / picture.name).write_bytes(picture.read_bytes())
    cv2.imwrite(str(tmp_path / "a[0].png"), np.zeros((48, 64), np.uint8))
    rig = CONFIGS / "gachon_8_6_rehearsal.yaml"
    answer = call("track", rig, tmp_path, "-o", tmp_path / "poses.csv", "--json")
    assert answer.code == 0, answer
    document = json.loads(answer.out)
    assert document["pictures"] == 2
    assert document["unused"] == {"a[0].png": "has 64 x 48 px, the camera has 1280 x 720 px"}
    assert "skipped: a[0].png has 64 x 48 px" in " ".join(answer.err.split())


def test_mirrored_images_are_reported(tmp_path: Path) -> None:
    grey = read_image(image_files(SESSION)[0])
    assert grey is not None
    cv2.imwrite(str(tmp_path / "a.png"), grey[:, ::-1])
    rig = CONFIGS / "gachon_8_6_rehearsal.yaml"
    answer = call("track", rig, tmp_path, "-o", tmp_path / "poses.csv")
    one_message(
        answer, 2, "a.png shows no tag of any known family; the expected tags appear mirrored"
    )
    assert "turn off mirroring in the camera or its driver" in " ".join(answer.err.split())


def test_tags_that_differ_from_the_rig_file_are_named_as_the_cause(tmp_path: Path) -> None:
    (tmp_path / "pictures").mkdir()
    picture = image_files(SESSION)[0]
    (tmp_path / "pictures" / picture.name).write_bytes(picture.read_bytes())
    rig = load_rig(CONFIGS / "gachon_8_6_rehearsal.yaml")
    tags = tuple(replace(tag, size=0.4 * tag.size) for tag in rig.platform_tags)
    wrong = replace(rig, platform_tags=tags)
    with pytest.raises(BadInput) as caught:
        list(
            tracked(
                ImageFolder(tmp_path / "pictures", rig.cameras[0]), Tracker(wrong, rig.cameras[0])
            )
        )
    assert "size_mm, position_mm and rotation_wxyz of tags.platform" in caught.value.next_step


@pytest.mark.parametrize("blur", [3.5, 8.0])
def test_pictures_out_of_focus_are_not_blamed_on_the_tags_sizes(
    tmp_path: Path, blur: float
) -> None:
    (tmp_path / "pictures").mkdir()
    grey = read_image(image_files(SESSION)[0])
    assert grey is not None
    soft = cv2.GaussianBlur(grey, (0, 0), blur)
    cv2.imwrite(str(tmp_path / "pictures" / "a.png"), soft)
    rig = load_rig(CONFIGS / "gachon_8_6_rehearsal.yaml")
    source = ImageFolder(tmp_path / "pictures", rig.cameras[0])
    with pytest.raises(BadInput) as caught:
        list(tracked(source, Tracker(rig, rig.cameras[0])))
    assert "focus the camera" in caught.value.next_step
    assert "size_mm" not in caught.value.next_step


def test_a_video_is_written_with_a_frame_a_picture(plan: Path, tmp_path: Path) -> None:
    video = tmp_path / "drawn.avi"
    arguments = ("synthetic", "--plan", plan, "-o", tmp_path / "poses.csv", "--overlay", video)
    assert call("track", RIG, *arguments, "--pictures", "2").code == 0
    capture = cv2.VideoCapture(str(video))
    frames = 0
    while capture.read()[0]:
        frames += 1
    capture.release()
    assert frames == 2


def test_the_overlay_of_a_video_has_its_rate(tmp_path: Path) -> None:
    """Not the camera's, at which it would be shown too slowly."""
    video, drawn = tmp_path / "recorded.avi", tmp_path / "drawn.mp4"
    size = cv2.imread(str(image_files(SESSION)[0])).shape[1::-1]
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 29.97, size)
    for path in image_files(SESSION)[:2]:
        writer.write(cv2.imread(str(path)))
    writer.release()
    arguments = (video, "-o", tmp_path / "poses.csv", "--overlay", drawn)
    assert call("track", RIG, *arguments).code == 0
    capture = cv2.VideoCapture(str(drawn))
    rate = capture.get(cv2.CAP_PROP_FPS)
    capture.release()
    assert rate == pytest.approx(29.97, abs=0.01)


@pytest.mark.parametrize(
    ("is_video", "order", "kept", "remark"),
    [
        (
            True,
            (0, 0, 1, 1, 1, 0),
            [0, 2, 5],
            "3 images are exact copies of the one before and were",
        ),
        (False, (0, 1, 1, 1, 0), [0, 1, 4], "2 images are exact copies of the one before and were"),
        (False, (0, 0), [0], "1 image is an exact copy of the one before and was"),
    ],
)
def test_repeated_images_are_not_measured_as_new_ones(
    tmp_path: Path, is_video: bool, order: tuple[int, ...], kept: list[int], remark: str
) -> None:
    """A converter to a constant rate repeats them; the others keep their numbers and times."""
    images = [cv2.imread(str(path)) for path in image_files(SESSION)[:2]]
    jpegs = [cv2.imencode(".jpg", images[k])[1].tobytes() for k in order]
    source = tmp_path / ("recorded.mjpeg" if is_video else "folder")
    if is_video:
        source.write_bytes(b"".join(jpegs))
    else:
        source.mkdir()
        for number, data in enumerate(jpegs):
            (source / f"{number}.jpg").write_bytes(data)
    answer = call("track", RIG, source, "-o", tmp_path / "poses.csv", "--json")
    assert answer.code == 0, answer
    with (tmp_path / "poses.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["frame"]) for row in rows] == kept
    rate = load_rig(RIG).camera().rate
    assert [float(row["time_s"]) * rate for row in rows] == pytest.approx(kept, abs=1e-4)
    assert {row["status"] for row in rows} == {"ok"}
    assert f"camera front: {remark} not measured" in " ".join(answer.err.split())


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("drawn.gif", "neither a folder nor a supported video"),
        ("there.avi", "the file exists already"),
    ],
)
def test_an_output_that_cannot_be_written_is_refused(
    plan: Path, tmp_path: Path, name: str, words: str
) -> None:
    (tmp_path / "there.avi").write_text("kept")
    log, target = tmp_path / "poses.csv", tmp_path / name
    with nothing_written(tmp_path):
        answer = call("track", RIG, "synthetic", "--plan", plan, "-o", log, "--overlay", target)
    one_message(answer, 2, words, name)


def test_an_unknown_detector_is_refused(plan: Path, tmp_path: Path) -> None:
    arguments = ("synthetic", "--plan", plan, "-o", tmp_path / "poses.csv", "--detector", "eyes")
    with nothing_written(tmp_path):
        answer = call("track", RIG, *arguments)
    one_message(answer, 2, "unknown tag detector 'eyes'", "opencv, apriltag")


def test_a_picture_without_a_pose_says_why() -> None:
    rig = load_rig(RIG)
    camera = rig.cameras[0]
    grey = np.full((camera.height, camera.width), 90, dtype=np.uint8)
    drawn = draw_measurement(grey, rig, camera, NoPose(0.5, "no tag is to be seen"))
    assert drawn.shape == (camera.height, camera.width, 3)
    changed = np.any(drawn != 90, axis=-1)
    assert changed[:60].any()
    assert not changed[200:].any()
