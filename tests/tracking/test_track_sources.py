"""Measuring whole sources from a script, as with `cdpr track`."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader

from drivers.cameras.live import Frame
from executor.track import track_sources
from model.cameras import Z_95
from model.errors import BadInput, Fault, StoppedByOperator
from model.pose import Pose
from model.progress import Listener
from model.rig import Camera, Rig
from model.scene import Scene
from simulation.camera.camera import SyntheticCamera
from tests.tracking.test_cameras_together import other_side
from tracking.detection.tags import rotated_tags
from tracking.pose_log import POSE_COLUMNS
from tracking.shared_errors import CameraMoved
from tracking.track import NoPlatformSeen

TRUTH = [Pose.level([0.10 - 0.01 * k, 0.1, 0.4]) for k in range(3)]


@pytest.fixture
def folder(tmp_path: Path, synthetic: SyntheticCamera) -> Path:
    """Three images, and a file that is not an image."""
    images = tmp_path / "pictures"
    images.mkdir()
    for k, pose in enumerate(TRUTH):
        cv2.imwrite(str(images / f"{k}.png"), synthetic.render(pose, k))
    (images / "broken.png").write_bytes(b"cut short")
    return images


@pytest.fixture(scope="module")
def eyes(rig: Rig, scene: Scene) -> tuple[SyntheticCamera, ...]:
    """The front camera and one at another side, without obstacles."""
    front, empty = rig.cameras[0], replace(scene, obstacles=())
    return tuple(SyntheticCamera(rig, empty, c, seed=4) for c in (front, other_side(front)))


def test_a_folder_is_measured_and_saved(folder: Path, rig: Rig, tmp_path: Path) -> None:
    camera = rig.cameras[0]
    result = track_sources(rig, {camera: str(folder)})
    positions = [found.pose.position for found in result.poses]
    for pose, position in zip(TRUTH, positions, strict=True):
        assert pose.distance_to(Pose.level(list(position))) < 1e-3
    assert set(result.unused[camera.name]) == {"broken.png"}
    assert result.by_camera == {}
    result.save(tmp_path / "poses.csv")
    head, *rows = (tmp_path / "poses.csv").read_text().splitlines()
    assert head == ",".join(POSE_COLUMNS)
    assert len(rows) == 3


def test_errors_common_to_all_images_are_stated_beside_their_scatter(
    folder: Path, rig: Rig
) -> None:
    """4 mm with 95 %, of each coordinate; nothing if it is unknown."""
    for error, expected in ((4e-3, 4.0 / Z_95 * np.sqrt(3.0)), (None, None)):
        camera = replace(rig.cameras[0], error=error, lens_covariance=None)
        facts = track_sources(replace(rig, cameras=(camera,)), {camera: str(folder)}).summary()
        assert facts["position_deviation_mm"] < 0.2
        assert facts.get("common_deviation_mm") == pytest.approx(expected, abs=1e-3)


def column(path: Path, name: str) -> list[str]:
    with path.open(newline="") as stream:
        return [row[name] for row in csv.DictReader(stream)]


def test_a_frame_is_the_number_of_the_image_and_not_of_the_row(
    folder: Path, rig: Rig, tmp_path: Path
) -> None:
    (folder / "1.png").write_bytes(b"cut short")
    result = track_sources(rig, {rig.cameras[0]: str(folder)})
    result.save(tmp_path / "poses.csv", tmp_path / "poses.mcap")
    assert column(tmp_path / "poses.csv", "picture") == ["0.png", "2.png"]
    assert column(tmp_path / "poses.csv", "frame") == ["0", "2"]
    with (tmp_path / "poses.mcap").open("rb") as stream:
        status = make_reader(stream).iter_messages(topics=["/tag_status"])
        assert [json.loads(message.data)["frame"] for _, _, message in status] == [0, 2]


def test_frames_of_several_cameras_are_those_of_one_time(
    rig: Rig, eyes: tuple[SyntheticCamera, ...], tmp_path: Path
) -> None:
    """The second image of the first camera, and the third of the second one, cannot be read."""
    for name, eye, broken in zip(("front", "side"), eyes, (1, 2), strict=True):
        (tmp_path / name).mkdir()
        for k, pose in enumerate([*TRUTH, TRUTH[-1]]):
            cv2.imwrite(str(tmp_path / name / f"{k}.png"), eye.render(pose, k))
        (tmp_path / name / f"{broken}.png").write_bytes(b"cut short")
    sources = {eye.camera: str(tmp_path / eye.camera.name) for eye in eyes}
    track_sources(replace(rig, cameras=tuple(sources)), sources).save(tmp_path / "poses.csv")
    assert column(tmp_path / "poses.csv", "frame") == ["0", "1", "2", "3"]
    for camera, kept in zip(sources, ([0, 2, 3], [0, 1, 3]), strict=True):
        path = tmp_path / f"poses-{camera.name}.csv"
        assert column(path, "frame") == [str(k) for k in kept]
        assert column(path, "picture") == [f"{k}.png" for k in kept]


def test_it_stops_before_the_next_picture_when_it_is_asked_to(folder: Path, rig: Rig) -> None:
    answers = iter([False, True])
    result = track_sources(rig, {rig.cameras[0]: str(folder)}, stopped=lambda: next(answers))
    assert len(result.pictures) == 1


def test_one_that_is_stopped_before_the_first_picture_is_no_bad_input(
    folder: Path, rig: Rig
) -> None:
    with pytest.raises(StoppedByOperator, match="before the first image"):
        track_sources(rig, {rig.cameras[0]: str(folder)}, stopped=lambda: True)


def test_a_source_that_is_none_and_a_camera_without_a_path_are_refused(rig: Rig) -> None:
    camera = rig.cameras[0]
    with pytest.raises(BadInput, match="not a folder of images"):
        track_sources(rig, {camera: "nowhere"})
    with pytest.raises(BadInput, match="needs a path to render"):
        track_sources(rig, {camera: "synthetic"})


class Remarks(Listener):
    def __init__(self) -> None:
        self.texts: list[str] = []

    def remark(self, text: str) -> None:
        self.texts.append(text)


def test_skipped_images_are_counted_when_the_camera_is_lost_too(
    rig: Rig, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Live:
        late, truncated = 3, 0

        def __init__(self, _source: str, camera: Camera, **_: object) -> None:
            self._image = SyntheticCamera(rig, scene, camera, seed=4).render(rig.home, 0)

        def __iter__(self) -> Iterator[Frame]:
            yield Frame(5.0, self._image, "image 0")
            raise Fault("the camera delivers no more images")

    monkeypatch.setattr("executor.track.LiveCamera", Live)
    listener = Remarks()
    with pytest.raises(Fault, match="no more images"):
        track_sources(rig, {rig.cameras[0]: "0"}, listener=listener)
    assert "3 images came late and were skipped" in "; ".join(listener.texts)


def test_live_cameras_with_different_latencies_measure_the_platform_where_it_was(
    rig: Rig, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It moves at 0.3 m/s; the images of both are exposed at the same times, which they state."""

    def pose_at(time: float) -> Pose:
        return Pose.level([0.3 * (time - 5.2), 0.05, 0.4])

    class Live:
        late, truncated = 3, 2

        def __init__(self, _source: str, camera: Camera, **_: object) -> None:
            self._eye = SyntheticCamera(rig, replace(scene, obstacles=()), camera, seed=4)

        def __iter__(self) -> Iterator[Frame]:
            for k, time in enumerate(np.arange(5.0, 5.5, 0.1).tolist()):
                yield Frame(time, self._eye.render(pose_at(time), k), f"image {k}")

    monkeypatch.setattr("executor.track.LiveCamera", Live)
    front = replace(rig.cameras[0], latency=0.02)
    side = replace(other_side(front), latency=0.12)
    listener = Remarks()
    both = replace(rig, cameras=(front, side))
    result = track_sources(both, {front: "0", side: "1"}, listener=listener)
    assert result.together is not None
    assert result.together.without_partner == 0
    assert "camera front: 3 images came late and were skipped" in listener.texts[0]
    assert "camera front: 2 images were truncated and not measured" in listener.texts[1]
    assert len(result.poses) == 5
    for found in result.poses:
        assert found.pose.distance_to(pose_at(found.time)) < 1e-3


def two_folders(
    rig: Rig, scene: Scene, root: Path, names: dict[str, list[str]]
) -> tuple[Rig, dict[Camera, str]]:
    """A moving platform; each camera's images, by file name or "" for one that it lost."""
    front = rig.cameras[0]
    sources = {}
    for camera in (front, other_side(front)):
        eye = SyntheticCamera(rig, replace(scene, obstacles=()), camera, seed=4)
        (root / camera.name).mkdir()
        for k, name in enumerate(names[camera.name]):
            if name:
                cv2.imwrite(str(root / camera.name / name), eye.render(TRUTH[k], k))
        sources[camera] = str(root / camera.name)
    return replace(rig, cameras=tuple(sources)), sources


def test_an_image_that_a_camera_lost_shifts_none_of_its_others(
    rig: Rig, scene: Scene, tmp_path: Path
) -> None:
    names = [f"img_{k:04}.png" for k in range(3)]
    rig, sources = two_folders(rig, scene, tmp_path, {"front": names, "side": ["", *names[1:]]})
    result = track_sources(rig, sources)
    assert result.together is not None
    assert result.together.without_partner == 1
    assert [found.time for found in result.poses] == pytest.approx([0.0, 0.1, 0.2])
    for found, pose in zip(result.poses, TRUTH, strict=True):
        assert found.pose.distance_to(pose) < 1e-3


@pytest.mark.parametrize(("ahead", "source"), [(0.0, None), (0.1, "tag:side")])
def test_a_clearance_that_one_camera_alone_measures_counts(
    rig: Rig, scene: Scene, tmp_path: Path, ahead: float, source: str | None
) -> None:
    """Cameras that contradict each other have no fused pose, but one of them may be right."""
    names = ["0.png", "1.png", "2.png"]
    rig, sources = two_folders(rig, scene, tmp_path, {"front": names, "side": names})
    side = next(camera for camera in sources if camera.name == "side")
    eye = SyntheticCamera(rig, replace(scene, obstacles=()), side, seed=4)
    nearer = Pose.level(TRUTH[1].position - np.array([ahead, 0.0, 0.0]))
    cv2.imwrite(str(tmp_path / "side" / "1.png"), eye.render(nearer, 1))
    block = replace(scene.obstacles[0], pose=Pose.level([-0.4, 0.1, 0.4]))
    result = track_sources(rig, sources, scene=replace(scene, obstacles=(block,)))
    assert len(result.poses) == (2 if ahead else 3)
    facts = result.summary()
    least = {
        name: min(1e3 * one.clearance.distance for one in images if one.clearance)
        for name, images in [
            ("tag", result.pictures),
            *((f"tag:{camera}", alone) for camera, alone in result.by_camera.items()),
        ]
    }
    assert facts["smallest_clearance_mm"] == pytest.approx(min(least.values()), abs=1e-3)
    assert facts["clearance_source"] == min(least, key=lambda name: least[name])
    if source is not None:
        assert facts["clearance_source"] == source
        assert least[source] < least["tag"] - 20.0


def test_an_error_before_the_first_frame_set_keeps_what_was_written(
    rig: Rig, scene: Scene, tmp_path: Path
) -> None:
    """An image of another size, of the second camera: nothing was measured together."""
    names = ["0.png", "1.png", "2.png"]
    rig, sources = two_folders(rig, scene, tmp_path, {"front": names, "side": names})
    for name in names:
        small = np.zeros((48, 64), np.uint8)
        cv2.imwrite(str(tmp_path / "side" / name), small)
    kept: list[object] = []
    with pytest.raises(BadInput):
        track_sources(rig, sources, keep=kept.append, listener=(remarks := Remarks()))
    assert kept == []
    assert remarks.texts == [
        "skipped: 3 files (side/0.png, side/1.png, side/2.png); each has 64 x 48 px, the camera has"
        " 1280 x 720 px"
    ]


def test_images_missing_in_all_folders_are_remarked_on(
    rig: Rig, scene: Scene, tmp_path: Path
) -> None:
    """Later times are too early; an image that only one camera lost shifts none."""
    front, side = rig.cameras[0], other_side(rig.cameras[0])
    names = {"front": ["f0.png", "f1.png", "f3.png"], "side": ["f0.png", "f1.png", "f3.png"]}
    both, sources = two_folders(rig, scene, tmp_path, names)
    for robot, given in ((rig, {front: sources[front]}), (both, sources)):
        track_sources(robot, given, listener=(remarks := Remarks()))
        (text,) = remarks.texts
        assert "missing between f1.png and f3.png" in text
    cv2.imwrite(str(tmp_path / side.name / "f2.png"), np.zeros((720, 1280), np.uint8))
    track_sources(both, sources, listener=(remarks := Remarks()))
    assert not any("missing" in text for text in remarks.texts)


@pytest.mark.parametrize("behind", [0.0, 0.05])
def test_images_of_the_same_name_that_are_not_simultaneous_are_remarked_on(
    rig: Rig, eyes: tuple[SyntheticCamera, ...], tmp_path: Path, behind: float
) -> None:
    """The platform accelerates to 0.1 m/s and back to rest."""

    remarks, cameras = Remarks(), tuple(eye.camera for eye in eyes)
    for eye, late in zip(eyes, (0.0, behind), strict=True):
        camera = eye.camera
        (tmp_path / camera.name).mkdir()
        for k in range(16):
            shift = 0.05 * np.cos(2.0 * (0.1 * k + late))
            image = eye.render(Pose.level([0.05 + shift, 0.1, 0.4]), k)
            cv2.imwrite(str(tmp_path / camera.name / f"{k:02}.png"), image)
    sources = {camera: str(tmp_path / camera.name) for camera in cameras}
    track_sources(replace(rig, cameras=cameras), sources, listener=remarks)
    found = [text for text in remarks.texts if "latency_ms" in text]
    assert len(found) == (behind > 0.0)
    for text in found:
        stated = re.search(r"images of side are taken (\d+) ± (\d+) ms", text)
        assert stated, text
        assert float(stated[1]) == pytest.approx(50.0, abs=3.0 + float(stated[2]))


def test_folders_without_common_names_are_refused(rig: Rig, scene: Scene, tmp_path: Path) -> None:
    names = {"front": ["f0.png", "f1.png", "f2.png"], "side": ["s0.png", "s1.png", "s2.png"]}
    rig, sources = two_folders(rig, scene, tmp_path, names)
    with pytest.raises(BadInput, match="0 of the 3 images") as caught:
        track_sources(rig, sources)
    assert "the same name in every folder" in caught.value.next_step


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_tags_mounted_with_another_side_up_are_named_as_the_cause(
    folder: Path, rig: Rig, degrees: int
) -> None:
    (folder / "2.png").unlink()  # a moved camera is found in two images
    camera = rig.cameras[0]
    stated = rotated_tags(rig.platform_tags, -degrees)
    with pytest.raises(NoPlatformSeen, match="no pose") as caught:
        track_sources(replace(rig, platform_tags=stated, frame_tags=()), {camera: str(folder)})
    assert f"rotated by {degrees}°" in caught.value.why
    assert ("OpenCV" in caught.value.why) is (degrees == 180)
    wrong = replace(rig, frame_tags=rotated_tags(rig.frame_tags, -degrees))
    with pytest.raises(CameraMoved, match="not mounted as the rig file states") as moved:
        track_sources(wrong, {camera: str(folder)})
    assert f"rotated by {degrees}°" in moved.value.why
