"""Measuring whole sources from a script, as with `cdpr track`."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest

from executor.track import track_sources
from model.errors import BadInput
from model.pose import Pose
from model.rig import Rig
from simulation.camera.camera import SyntheticCamera
from tracking.pose_log import POSE_COLUMNS

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


def test_it_stops_before_the_next_picture_when_it_is_asked_to(folder: Path, rig: Rig) -> None:
    answers = iter([False, True])
    result = track_sources(rig, {rig.cameras[0]: str(folder)}, stopped=lambda: next(answers))
    assert len(result.pictures) == 1


def test_a_source_that_is_none_and_a_camera_without_a_path_are_refused(rig: Rig) -> None:
    camera = rig.cameras[0]
    with pytest.raises(BadInput, match="not a folder of images"):
        track_sources(rig, {camera: "nowhere"})
    with pytest.raises(BadInput, match="needs a path to render"):
        track_sources(rig, {camera: "synthetic"})
