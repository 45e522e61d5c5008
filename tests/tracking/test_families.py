"""Every family: printed by the synthetic camera, found with its corners in order."""

from __future__ import annotations

import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest

from model.errors import BadInput
from model.files.camera_file import FAMILIES, opencv_dictionary, tags_in
from model.pose import Pose
from model.rig import Camera, Rig, rig_from_document
from model.scene import Scene
from simulation.camera.camera import SyntheticCamera
from tests.tracking.hard_images import Condition, HardPrinter
from tests.tracking.tag_images import FAMILY
from tracking.camera_model import distort_pixels
from tracking.detection.detector import make_detector
from tracking.detection.tags import modules_across
from tracking.edges.refine import refine
from tracking.measurement import PoseMeasurement
from tracking.tracker import Tracker


@pytest.mark.parametrize("family", FAMILIES)
def test_a_printed_tag_is_found_with_its_corners_in_order(family: str) -> None:
    printer, rng = HardPrinter(family, tags_in(family)), np.random.default_rng(6)
    detector = make_detector("opencv", family)
    for _ in range(2):
        picture = printer.image(Condition(side_px=60), rng)
        found = {d.id: d for d in detector.detect(picture.image)}
        corners = found[picture.number].corners[None]
        (square,) = refine(picture.image, printer.camera, corners, modules_across(family))
        assert square is not None
        pixels = distort_pixels(printer.camera, square.corners)
        assert np.abs(pixels - picture.corners).max() < 0.1


@pytest.mark.parametrize("family", FAMILIES)
def test_counts_of_tags_are_those_of_opencv(family: str) -> None:
    name = getattr(cv2.aruco, opencv_dictionary(family))
    assert tags_in(family) == len(cv2.aruco.getPredefinedDictionary(name).bytesList)


@pytest.mark.parametrize("family", ["6X6_1000", "tag36h10"])
def test_a_rig_with_other_tags_is_tracked(
    rig: Rig, scene: Scene, camera: Camera, family: str
) -> None:
    other = replace(rig, tag_family=family)
    truth = Pose.level([0.1, 0.1, 0.4])
    picture = SyntheticCamera(other, scene, camera, seed=3).render(truth, 0)
    found = Tracker(other, camera).observe(picture, 0.0)
    assert isinstance(found, PoseMeasurement)
    assert found.pose.distance_to(truth) < 2e-3


def test_a_number_that_the_family_does_not_have_is_refused(rig: Rig) -> None:
    tags = rig.document.tags
    assert tags is not None
    small = rig.document.model_copy(update={"tags": tags.model_copy(update={"family": "6X6_250"})})
    with pytest.raises(BadInput, match="6X6_250 has the tags 0 to 249"):
        rig_from_document(small)


def test_an_unknown_detector_is_refused() -> None:
    with pytest.raises(BadInput, match="unknown tag detector 'eyes'"):
        make_detector("eyes", FAMILY)


@pytest.mark.parametrize("family", ["tag36h10", "6X6_250"])
def test_the_apriltag_library_refuses_families_it_does_not_know(family: str) -> None:
    with pytest.raises(BadInput, match=family):
        make_detector("apriltag", family)


def test_a_missing_apriltag_library_is_reported_with_how_to_install_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "pyapriltags", None)
    with pytest.raises(BadInput, match="not installed") as caught:
        make_detector("apriltag", FAMILY)
    assert "cdpr[apriltag]" in caught.value.next_step


@pytest.mark.parametrize("family", ["tag16h5", "tag25h9", "tag36h11"])
def test_the_apriltag_library_gives_the_same_corners(family: str) -> None:
    pytest.importorskip("pyapriltags", reason="the extra `apriltag` is not installed")
    printer, rng = HardPrinter(family, tags_in(family)), np.random.default_rng(6)
    library, gaps = make_detector("apriltag", family), []
    for _ in range(8):
        picture = printer.image(Condition(side_px=60), rng)
        standard = library.detect_all(picture.image)
        found = {d.id: d for d in library.detect_exhaustively(picture.image, standard)}
        gaps.append(found[picture.number].corners - picture.corners)
    assert np.abs(gaps).max() < 0.2
    assert np.abs(np.mean(gaps, axis=(0, 1))).max() < 0.03  # a shift of half a pixel would show
