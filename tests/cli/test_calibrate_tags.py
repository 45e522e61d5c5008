"""`cdpr calibrate tags` on rendered images of a platform whose tags were glued by hand."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from calibration.tag_map.observations import moved_tags
from model.files.camera_file import TagDocument
from model.pose import Pose
from model.rig import Rig, load_rig, rig_from_document
from model.scene import load_scene
from simulation.camera.camera import SyntheticCamera
from tests.cli.plans import CONFIGS, RIG
from tests.cli.program import call, nothing_written, one_message
from tracking.detection.tags import tag_corners

ALONG_MM = np.array([[0.4, -1.1], [0.0, 0.9], [1.2, 0.3], [-0.8, 0.0], [0.6, 0.7], [-0.3, 1.0]])
OUTWARD_MM = 1.2  # or the platform's faces would hide tags that are not parallel to them
TILTS_DEG = np.roll(ALONG_MM, 1, axis=0) / 2.0


def as_mounted() -> Rig:
    """The rig with its tags where they truly are."""
    rig = load_rig(RIG)
    steps = []
    for tag, along, tilt in zip(rig.platform_tags, ALONG_MM, TILTS_DEG, strict=True):
        shift = tag.pose.rotation @ [*along, OUTWARD_MM] / 1e3
        steps += [shift, tag.pose.rotation @ np.radians([*tilt, 1.0])]
    tags = moved_tags(rig.platform_tags, np.concatenate(steps))
    documents = [
        TagDocument(
            id=tag.id,
            size_mm=tag.size * 1e3,
            position_mm=(tag.pose.position * 1e3).tolist(),
            rotation_wxyz=tag.pose.quaternion.tolist(),
        )
        for tag in tags
    ]
    assert rig.document.tags is not None
    changed = rig.document.tags.model_copy(update={"platform": documents})
    return rig_from_document(rig.document.model_copy(update={"tags": changed}))


def before_the_camera(count: int) -> list[Pose]:
    """Poses ``camera_from_platform``: rotated in all directions, no face square to the camera."""
    rng, poses = np.random.default_rng(8), []
    while len(poses) < count:
        turn = Rotation.random(random_state=rng).as_matrix()
        if np.abs(turn[2]).max() < 0.8:
            poses.append(Pose(np.array([*rng.uniform(-0.05, 0.05, 2), 0.6]), turn))
    return poses


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("platform")
    rig = as_mounted()
    scene = replace(load_scene(CONFIGS / "environment_1.yaml"), obstacles=())
    camera = SyntheticCamera(rig, scene, rig.cameras[0], seed=6)
    for k, pose in enumerate(before_the_camera(18)):
        image = camera.render(rig.cameras[0].world_from_camera.compose(pose), k)
        cv2.imwrite(str(folder / f"{k}.png"), image)
    cv2.imwrite(str(folder / "wall.png"), np.full((720, 1280), 128, np.uint8))
    (folder / "broken.png").write_bytes(b"not a picture")
    return folder


def test_the_tags_are_found_where_they_were_glued_and_the_result_used(folder, tmp_path) -> None:
    out = tmp_path / "out"
    options = ("--fixed-tag", "301", "-o", out, "--json")
    answer = call("calibrate", "tags", RIG, folder, *options)
    found = json.loads(answer.out)
    assert answer.code == 0, found["verdict"]
    assert set(found["unused"]) >= {"wall.png", "broken.png"}
    assert found["rms_px"] < 0.1
    (saved,) = out.glob("calibration_tags_gachon_8_6_*.yaml")
    assert yaml.safe_load(saved.read_text()) == found
    page = saved.with_suffix(".html").read_text()
    assert "Tags against the rig file" in page
    truth, drawn = as_mounted().platform_tags, load_rig(RIG).platform_tags
    shift = drawn[0].pose.compose(truth[0].pose.inverse())
    tags = [TagDocument.model_validate(tag) for tag in found["platform"]]
    gaps = [
        tag_corners(replace(true, pose=tag.pose())) - shift.apply(tag_corners(true))
        for tag, true in zip(tags, truth, strict=True)
    ]
    assert np.sqrt(np.mean(np.sum(np.concatenate(gaps) ** 2, axis=1))) < 0.15e-3
    with nothing_written(out):
        twice = call("calibrate", "tags", RIG, folder, "-o", out)
    one_message(twice, 2, saved.name, "--force")
    saved.rename(out / "of_another_verb.yaml")
    saved.with_suffix(".html").unlink()
    saved = out / "of_another_verb.yaml"
    more = ("--calibration", saved, "-o", out, "--json")  # a folder that holds other results
    again = call("calibrate", "tags", RIG, folder, *more)
    assert len(list(out.iterdir())) == 3
    moved = json.loads(again.out)
    for tag, other in zip(found["platform"], moved["platform"], strict=True):
        assert tag["position_mm"] == pytest.approx(other["position_mm"], abs=0.05)


def test_images_saved_again_count_once(folder, tmp_path) -> None:
    for k in range(18):
        image = cv2.imread(str(folder / f"{k}.png"), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(tmp_path / f"{k}.png"), image)
        if k < 6:
            cv2.imwrite(str(tmp_path / f"copy_{k}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 90])
    found = json.loads(call("calibrate", "tags", RIG, tmp_path, "--json").out)
    copies = {name: why for name, why in found["unused"].items() if "duplicates" in why}
    assert len(copies) == sum(f"{k}.png" in found["picture_errors_px"] for k in range(6))


def test_people_read_what_changed_against_the_rig_file(folder) -> None:
    answer = call("calibrate", "tags", RIG, folder, "--wanted-mm", "0.001")
    (turn,) = (line for line in answer.out.splitlines() if "tag_301_turn_x_deg" in line)
    assert re.fullmatch(r"\s*tag_301_turn_x_deg\s+± 0\.\d+\s*", turn)
    assert answer.code == 3
    assert answer.out.splitlines()[1].split()[:4] == ["verdict", "not", "good", "enough:"]
    assert "moved" in answer.out
    assert "broken.png is not a readable image" in answer.out


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--fixed-tag", "7"), "no tag 7 on the platform"),
        (("--camera", "side"), "unknown camera 'side'"),
        (("--pictures", "2"), "--pictures is for a video or a camera"),
    ],
)
def test_options_that_cannot_be_are_refused(folder, tmp_path, options, named: str) -> None:
    with nothing_written(tmp_path):
        answer = call("calibrate", "tags", RIG, folder, "-o", tmp_path / "out", *options)
    one_message(answer, 2, named)


def test_images_without_the_platform_are_reported(folder, tmp_path) -> None:
    (tmp_path / "a.png").write_bytes((folder / "wall.png").read_bytes())
    answer = call("calibrate", "tags", RIG, tmp_path)
    one_message(answer, 2, "none of the tag36h11 tags 301", "a.png shows no complete tag")
