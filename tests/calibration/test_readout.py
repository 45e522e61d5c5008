"""The readout of a rolling shutter, measured from a moving platform and used afterwards."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from calibration.intrinsics.readout import _motion_at, open_timed_images, readout_page
from calibration.procedures import measure_readout
from calibration.result_files import load_result
from model.errors import BadInput
from model.pose import Pose, matrix_from_rotation_vector
from model.progress import Listener
from model.rig import Rig, load_rig
from model.scene import empty_scene
from simulation.camera.camera import SyntheticCamera
from simulation.ground_truth import Optics
from tests.cli.program import call, one_message
from tracking.rolling_shutter import PlatformMotion

RIG = Path(__file__).parents[2] / "configs" / "gachon_8_6.yaml"
TRUE, RATE = 0.025, 20.0


def swinging(rig: Rig, time: float) -> Pose:
    """Vertical and lateral oscillation, at most 0.12 m/s."""
    shift = np.array([0.02 * np.sin(4.0 * time), 0.0, 0.02 * np.sin(5.0 * time + 1.0)])
    return Pose(rig.home.position + shift, rig.home.rotation)


def write_film(rig: Rig, folder: Path, readout: float, images: int, still: bool = False) -> None:
    camera = replace(rig.cameras[0], readout=readout)
    optics = Optics(noise=1.5, exposure=2e-3)
    eye = SyntheticCamera(rig, empty_scene(rig), camera, 2, optics)
    for number in range(images):
        time, step = (0.0 if still else number / RATE), 1e-4
        ends = (swinging(rig, time + sign * step) for sign in (-1.0, 1.0))
        motion = None if still else PlatformMotion.between(*ends, 2.0 * step)
        image = eye.render(swinging(rig, time), number, motion)
        cv2.imwrite(str(folder / f"{number:03}.png"), image)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(RIG)


@pytest.fixture(scope="module")
def film(rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("film")
    write_film(rig, folder, TRUE, 24)
    return folder


def test_the_readout_is_found_within_its_interval_and_is_tight(rig: Rig, film: Path) -> None:
    made = measure_readout(rig, film, rate=RATE)
    found = made.found
    twice = {f"{name}, tag 3": "is detected more than once" for name in found.speeds}
    page = readout_page(replace(found, unused={**twice, "x": "no pose"}), made.quality, "today")
    assert f"{len(found.speeds)} images used, 1 not" in page
    assert abs(found.readout - TRUE) < found.half_width
    assert found.half_width < 0.05 * TRUE
    assert len(found.speeds) == 22
    assert found.after < 0.7 * found.before
    assert made.quality.good
    camera = rig.with_calibration(made).document.cameras[0]
    assert camera.readout_ms == pytest.approx(found.readout * 1e3)


def test_the_speed_of_a_quick_oscillation_is_not_the_mean_between_images(rig: Rig) -> None:
    """Twice a second at 30 Hz, the mean would be 3 % too low; at the ends it has to do."""
    rate, size = 2.0 * np.pi * 2.0, np.array([0.0, 0.01, -0.004])
    moments = [k / 30.0 for k in range(16)]
    poses = [
        Pose(
            rig.home.position + size * np.sin(rate * t),
            matrix_from_rotation_vector(2.0 * size * np.sin(rate * t)),
        )
        for t in moments
    ]
    fastest = rate * float(np.linalg.norm(size))
    for k in range(1, 15):
        true = rate * np.cos(rate * moments[k]) * size
        off = np.linalg.norm(_motion_at(k, poses, moments).velocity - true)
        assert off < (0.005 if 2 <= k < 14 else 0.035) * fastest
        if 2 <= k < 14:
            turning = _motion_at(k, poses, moments).turning
            assert np.linalg.norm(turning - 2.0 * true) < 0.01 * fastest


def test_a_camera_that_exposes_all_rows_at_once_has_none(rig: Rig, tmp_path: Path) -> None:
    write_film(rig, tmp_path, 0.0, 9)
    found = measure_readout(rig, tmp_path, rate=RATE).found
    assert abs(found.readout) < max(found.half_width, 5e-4)


def test_a_platform_at_rest_shows_no_readout(rig: Rig, tmp_path: Path) -> None:
    write_film(rig, tmp_path, TRUE, 8, still=True)
    with pytest.raises(BadInput, match="do not determine it"):
        measure_readout(rig, tmp_path, rate=RATE)


def test_the_verb_writes_a_result_that_applies_to_the_rig(film: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    answer = call("calibrate", "readout", RIG, film, "--rate-hz", RATE, "-o", out, "--json")
    assert answer.code == 0, answer
    result = json.loads(answer.out)
    assert result["kind"] == "readout"
    [file] = out.glob("calibration_readout_front_*.yaml")
    assert load_result(file).good_enough
    assert "Readout of camera front" in file.with_suffix(".html").read_text()
    new = tmp_path / "new.yaml"
    assert call("calibrate", "apply", RIG, file, "-o", new).code == 0
    assert yaml.safe_load(new.read_text())["cameras"][0]["readout_ms"] == result["readout_ms"]


def test_few_images_and_a_rate_for_a_video_are_refused(rig: Rig, film: Path, tmp_path) -> None:
    for name in ("000.png", "001.png", "002.png"):
        (tmp_path / name).write_bytes((film / name).read_bytes())
    one_message(call("calibrate", "readout", RIG, tmp_path), 2, "5 are required")
    video, size = tmp_path / "a.avi", (rig.cameras[0].width, rig.cameras[0].height)
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, size, False)
    writer.write(np.zeros(size[::-1], np.uint8))
    writer.release()
    one_message(
        call("calibrate", "readout", RIG, video, "--rate-hz", "3"),
        2,
        "a rate can be given for a folder",
    )


def test_the_rate_of_a_video_without_times_may_be_stated(rig: Rig, tmp_path: Path) -> None:
    """Without, it is the camera's, which is remarked on."""

    class Remarks(Listener):
        def remark(self, text: str) -> None:
            texts.append(text)

    texts: list[str] = []
    camera, video = rig.cameras[0], tmp_path / "a.mjpeg"
    black = np.zeros((camera.height, camera.width), np.uint8)
    video.write_bytes(3 * cv2.imencode(".jpg", black)[1].tobytes())
    for rate, last in ((40.0, "0.050000 s image 2"), (None, f"{2.0 / camera.rate:.6f} s image 2")):
        assert texts == []
        opened, _ = open_timed_images(video, camera, rate, Remarks())
        assert [name for name, _ in opened.images][-1] == last
    assert "a.mjpeg states no times" in texts[0]


def test_times_do_not_depend_on_the_names_of_images(rig: Rig, film: Path) -> None:
    """The name states the time for people; the fit needs more digits."""
    opened, times = open_timed_images(film, rig.cameras[0], 7.0, Listener())
    names = [name for name, _ in opened.images]
    assert list(times) == names
    assert list(times.values()) == [k / 7.0 for k in range(len(names))]
