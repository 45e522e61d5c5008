"""The camera's pose from surveyed frame tags, and the coverage of its intervals."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest

from calibration import Survey
from calibration.extrinsics.result import (
    ExtrinsicCalibration,
    extrinsics_result,
    judge_extrinsics,
    workspace_corners,
)
from calibration.extrinsics.surveyed_tags import locate_by_frame_tags, require_frame_tags
from calibration.result_files import load_result
from calibration.results import write_result
from calibration.tag_map.observations import TagObservations, observe_tags
from model.cameras import Z_95
from model.errors import BadInput
from model.pose import Pose, matrix_from_rotation_vector, rotation_vector_from_matrix
from model.rig import Rig, Tag, load_rig, rig_from_document
from model.scene import load_scene
from simulation.camera.camera import SyntheticCamera
from tests.calibration.exact_sights import observe
from tracking.camera_model import project_undistorted
from tracking.detection.tags import tag_corners
from tracking.pnp import moved
from tracking.shared_errors import change_of_inverse

CONFIGS = Path(__file__).parents[2] / "configs"


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(CONFIGS / "gachon_8_6.yaml")


def elsewhere(rig: Rig) -> Pose:
    """The true pose of the camera, which differs from the rig file's."""
    named = rig.cameras[0].world_from_camera
    turn = matrix_from_rotation_vector([0.02, -0.01, 0.015])
    return Pose(named.position + np.array([0.03, -0.02, 0.01]), turn @ named.rotation)


@pytest.fixture(scope="module")
def pictures(rig: Rig) -> list[tuple[str, np.ndarray]]:
    scene = replace(load_scene(CONFIGS / "environment_1.yaml"), obstacles=())
    there = replace(rig.cameras[0], world_from_camera=elsewhere(rig))
    camera = SyntheticCamera(rig, scene, there, seed=2)
    return [(f"{k}.png", camera.render(Pose.level([0.0, 0.0, 0.55]), k)) for k in range(3)]


def numbers(rig: Rig) -> list[int]:
    return [tag.id for tag in rig.frame_tags]


def test_a_camera_is_located_to_half_a_millimetre(rig: Rig, pictures) -> None:
    truth, camera = elsewhere(rig), rig.cameras[0]
    found = locate_by_frame_tags(
        rig, camera, observe_tags(pictures, rig, camera, numbers(rig)), Survey(0.1e-3)
    )
    pose = found.world_from_camera
    assert pose.distance_to(truth) < 0.5e-3
    assert np.degrees(pose.angle_to(truth)) < 0.02
    turn = rotation_vector_from_matrix(pose.rotation @ truth.rotation.T)
    error = np.concatenate([pose.position - truth.position, turn])
    assert np.all(np.abs(error) < found.half_widths)
    assert found.pictures == 3
    assert set(found.tag_errors) <= {401, 402, 403, 404}
    assert len(found.tag_errors) >= 3
    assert max(found.tag_errors.values()) < 0.1
    assert judge_extrinsics(found, 2e-3).good


def crooked(tags: tuple[Tag, ...], survey: float, rng: np.random.Generator) -> tuple[Tag, ...]:
    """The true tags, with random survey errors along each axis."""
    return tuple(
        replace(
            tag,
            pose=Pose(
                tag.pose.position + survey * rng.standard_normal(3),
                matrix_from_rotation_vector(2.0 * survey / tag.size * rng.standard_normal(3))
                @ tag.pose.rotation,
            ),
        )
        for tag in tags
    )


@pytest.mark.parametrize("survey", [0.5e-3, 2e-3])
def test_intervals_hold_the_truth_as_often_as_they_say(rig: Rig, survey: float) -> None:
    truth, camera, inside, errors, stated = elsewhere(rig), rig.cameras[0], [], [], []
    for seed in range(15):
        rng = np.random.default_rng(seed)
        tags = crooked(rig.frame_tags, survey, rng)
        poses = {str(k): truth.inverse() for k in range(3)}
        found = locate_by_frame_tags(
            rig,
            camera,
            observe(camera, tags, poses, 0.03, rng),
            Survey(survey, 2.0 * survey / tags[0].size),
        )
        pose = found.world_from_camera
        turn = rotation_vector_from_matrix(pose.rotation @ truth.rotation.T)
        off = np.concatenate([pose.position - truth.position, turn])
        inside.append(np.abs(off) <= found.half_widths)
        back = pose.apply(truth.inverse().apply(found.points)) - found.points
        errors.append(np.sqrt(np.mean(np.sum(back**2, axis=1))))
        stated.append(found.error)
    assert np.mean(inside) >= 0.9
    assert np.mean(np.array(errors) <= stated) >= 0.9
    assert np.median(stated) < 3.0 * np.median(errors)  # and not because the intervals are too wide


def test_known_tag_rotations_halve_the_error_of_the_camera(rig: Rig) -> None:
    """Eight tags on the floor, each 1 mm off as a whole."""
    truth, camera, errors = elsewhere(rig), rig.cameras[0], []
    tags = [
        Tag(401 + k, 0.12, Pose.level([0.45 * np.cos(a), 0.45 * np.sin(a), 0.0]))
        for k, a in enumerate(np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False))
    ]
    rig = replace(rig, frame_tags=tuple(tags))
    for seed in range(8):
        rng = np.random.default_rng(seed)
        shifts = 1e-3 * rng.standard_normal((8, 3))
        there = [
            replace(tag, pose=Pose(tag.pose.position + shift, tag.pose.rotation))
            for tag, shift in zip(tags, shifts, strict=True)
        ]
        observations = observe(camera, there, {"a": truth.inverse()}, 0.03, rng)
        errors.append([])
        for survey in (Survey(1e-3), Survey(1e-3, 0.0)):
            found = locate_by_frame_tags(rig, camera, observations, survey)
            back = found.world_from_camera.apply(truth.inverse().apply(found.points))
            off = np.sqrt(np.mean(np.sum((back - found.points) ** 2, axis=1)))
            errors[-1].append(off)
        assert off < found.error
    unaware, aware = np.sqrt(np.mean(np.square(errors), axis=0))
    assert aware < 0.6 * unaware


@pytest.mark.parametrize("turn", [None, 0.0, 0.01])
def test_the_pixels_of_a_survey_scatter_as_predicted(rig: Rig, turn: float | None) -> None:
    """Against pixels of random tags."""
    rng, camera, tag = np.random.default_rng(5), rig.cameras[0], rig.frame_tags[0]
    world, survey = elsewhere(rig).inverse(), Survey(1e-3, turn)
    pixels = []
    for _ in range(4000):
        corners = tag_corners(tag)
        if turn is None:
            corners = corners + 1e-3 * rng.standard_normal((4, 3))
        else:
            off = matrix_from_rotation_vector(turn * rng.standard_normal(3))
            middle = tag.pose.position
            corners = (corners - middle) @ off.T + middle + 1e-3 * rng.standard_normal(3)
        pixels.append(project_undistorted(camera, world.apply(corners)).ravel())
    predicted = survey.of_pixels(camera, world, tag)
    found = np.cov(np.array(pixels).T)
    np.testing.assert_allclose(found, predicted, atol=0.08 * np.diag(predicted).max())


def test_a_tag_that_was_knocked_is_named_and_does_not_move_the_camera(rig: Rig) -> None:
    camera, truth, rng = rig.cameras[0], elsewhere(rig), np.random.default_rng(3)
    positions = [(0.42, 0), (0, 0.42), (-0.42, 0), (0, -0.42), (0.3, 0.3), (-0.3, 0.3)]
    tags = [Tag(401 + k, 0.12, Pose.level([x, y, 0.0])) for k, (x, y) in enumerate(positions)]
    rig = replace(rig, frame_tags=tuple(tags))
    knocked = [replace(tags[0], pose=Pose.level([0.44, 0.0, 0.0])), *tags[1:]]
    observations = observe(camera, knocked, {"a": truth.inverse()}, 0.02, rng)
    found = locate_by_frame_tags(rig, camera, observations, Survey(0.2e-3))
    assert list(found.unused) == ["tag 401"]
    away = re.search(r"at least ([\d.]+) mm", found.unused["tag 401"])
    assert away is not None
    assert float(away[1]) == pytest.approx(18.0, abs=4.0)  # 20 mm on the floor, seen obliquely
    assert found.world_from_camera.distance_to(truth) < 3e-3


def test_tags_that_contradict_each_other_are_named(rig: Rig) -> None:
    camera, truth, rng = rig.cameras[0], elsewhere(rig), np.random.default_rng(3)
    tags = crooked(rig.frame_tags, 10e-3, rng)
    found = locate_by_frame_tags(
        rig, camera, observe(camera, tags, {"a": truth.inverse()}, 0.02, rng), Survey(1e-4)
    )
    verdict = judge_extrinsics(found, 1.0)
    assert not verdict.good
    assert any("from its position in the rig file" in reason for reason in verdict.reasons)
    assert any("again, or remove it from the rig file" in step for step in verdict.next_steps)


@pytest.mark.parametrize(("count", "seen"), [(1, "1 frame tag is"), (2, "2 frame tags are")])
def test_too_few_tags_are_not_good_enough(rig: Rig, count: int, seen: str) -> None:
    camera, truth = rig.cameras[0], elsewhere(rig)
    rng = np.random.default_rng(3)
    observations = observe(camera, rig.frame_tags[:count], {"a": truth.inverse()}, 0.02, rng)
    found = locate_by_frame_tags(rig, camera, observations, Survey(0.5e-3))
    verdict = judge_extrinsics(found, 1e-3)
    assert f"{seen} visible; 3 are required" in verdict.reasons
    assert "survey more tags, all around the camera's view" in verdict.next_steps


def test_a_picture_of_a_camera_that_was_moved_is_left_out_by_name(rig: Rig) -> None:
    camera, truth, rng = rig.cameras[0], elsewhere(rig), np.random.default_rng(3)
    poses = {f"{k}.png": truth.inverse() for k in range(4)}
    poses["3.png"] = moved(truth.inverse(), np.array([0.01, 0, 0, 0, 0, 0]))
    found = locate_by_frame_tags(
        rig, camera, observe(camera, rig.frame_tags, poses, 0.02, rng), Survey(1e-4)
    )
    assert list(found.unused) == ["3.png"]
    assert "the camera moved" in found.unused["3.png"]
    assert found.pictures == 3


BUMPED = np.array([0.01, 0, 0, 0, 0, 0])
"""Step of a camera between two images."""


@pytest.mark.parametrize(("before", "after"), [(1, 1), (2, 2), (3, 3), (4, 4)])
def test_a_camera_that_was_moved_half_way_is_refused(rig: Rig, before: int, after: int) -> None:
    """Neither half has a majority, and a pose between both is wrong for either."""
    camera, truth, rng = rig.cameras[0], elsewhere(rig), np.random.default_rng(3)
    poses = {f"{k}.png": truth.inverse() for k in range(before + after)}
    poses |= {f"{k}.png": moved(truth.inverse(), BUMPED) for k in range(before, before + after)}
    observations = observe(camera, rig.frame_tags, poses, 0.02, rng)
    with pytest.raises(BadInput, match="the camera moved between the images") as caught:
        locate_by_frame_tags(rig, camera, observations, Survey(1e-4))
    assert f"{before} of {before + after} images" in caught.value.why
    assert f"{before}.png shows the tags" in caught.value.why
    assert "take the images again" in caught.value.next_step


@pytest.mark.parametrize(("count", "off"), [(3, 1), (5, 2), (7, 3)])
@pytest.mark.parametrize("together", [True, False])
def test_the_majority_of_images_locates_the_camera(
    rig: Rig, count: int, off: int, together: bool
) -> None:
    """In any order, and however often the camera was moved meanwhile."""
    camera, truth, rng = rig.cameras[0], elsewhere(rig), np.random.default_rng(count)
    steps = {f"{k}.png": BUMPED if together else (k + 1) * BUMPED for k in range(off)}
    steps |= {f"{k}.png": 0.0 * BUMPED for k in range(off, count)}
    mixed = {name: moved(truth.inverse(), steps[name]) for name in rng.permutation(list(steps))}
    found = locate_by_frame_tags(
        rig, camera, observe(camera, rig.frame_tags, mixed, 0.02, rng), Survey(1e-4)
    )
    assert sorted(found.unused) == [f"{k}.png" for k in range(off)]
    assert found.pictures == count - off
    assert found.world_from_camera.distance_to(truth) < 1e-3


def test_images_of_different_tags_do_not_contradict_each_other(rig: Rig) -> None:
    """As where the platform hides others in each."""
    camera, truth, rng = rig.cameras[0], elsewhere(rig), np.random.default_rng(3)
    poses = {"a.png": truth.inverse(), "b.png": truth.inverse()}
    whole = observe(camera, rig.frame_tags, poses, 0.02, rng)
    half = {
        name: {k: s for k, s in squares.items() if (k % 2 == 0) == (name == "a.png")}
        for name, squares in whole.squares.items()
    }
    found = locate_by_frame_tags(rig, camera, TagObservations(half, {}), Survey(1e-4))
    assert found.pictures == 2
    assert found.unused == {}


def test_the_inverse_of_a_pose_changes_as_predicted() -> None:
    base = Pose(np.array([0.1, -0.3, 1.2]), matrix_from_rotation_vector([0.4, 2.0, -0.7]))
    change = np.zeros((6, 6))
    for k in range(6):
        ends = []
        for sign in (1.0, -1.0):
            step = np.zeros(6)
            step[k] = sign * 1e-6
            ends.append(moved(base, step).inverse())
        turn = rotation_vector_from_matrix(ends[0].rotation @ ends[1].rotation.T)
        change[:, k] = np.concatenate([ends[0].position - ends[1].position, turn]) / 2e-6
    np.testing.assert_allclose(change_of_inverse(base), change, atol=1e-6)


def test_the_result_replaces_the_pose_of_the_rig_file(rig: Rig, pictures, tmp_path: Path) -> None:
    camera = rig.cameras[0]
    found = locate_by_frame_tags(
        rig, camera, observe_tags(pictures, rig, camera, numbers(rig)), Survey(5e-4)
    )
    verdict = judge_extrinsics(found, 1e-3)
    result = extrinsics_result(found, verdict, rig.document, date(2026, 3, 2))
    path = write_result(tmp_path, result)
    assert path.name == "calibration_extrinsics_front_2026-03-02.yaml"
    read = load_result(path)
    assert read == result.sealed()
    better = rig.with_calibration(read)
    assert better.cameras[0].world_from_camera.distance_to(found.world_from_camera) < 1e-8
    assert result.apart_mm(result) == pytest.approx(0.0, abs=1e-9)


def test_a_result_is_refused_where_what_it_rests_on_was_changed(rig: Rig, pictures) -> None:
    camera = rig.cameras[0]
    found = locate_by_frame_tags(
        rig, camera, observe_tags(pictures, rig, camera, numbers(rig)), Survey(5e-4)
    )
    result = extrinsics_result(found, judge_extrinsics(found, 1e-3), rig.document, date(2026, 3, 2))
    other = rig.document.cameras[0].model_copy(update={"fx_px": 901.0})
    changed = rig_from_document(rig.document.model_copy(update={"cameras": [other]}))
    with pytest.raises(BadInput, match="was made with parameters of the camera or frame tags"):
        changed.with_calibration(result)


def test_a_result_for_a_camera_at_rest_outlives_a_latency_stated_later(rig: Rig, pictures) -> None:
    camera = rig.cameras[0]
    found = locate_by_frame_tags(
        rig, camera, observe_tags(pictures, rig, camera, numbers(rig)), Survey(5e-4)
    )
    result = extrinsics_result(found, judge_extrinsics(found, 1e-3), rig.document, date(2026, 3, 2))
    known = rig.document.cameras[0].model_copy(update={"latency_ms": 40.0})
    changed = rig_from_document(rig.document.model_copy(update={"cameras": [known]}))
    pose = changed.with_calibration(result).cameras[0].world_from_camera
    assert pose.distance_to(found.world_from_camera) < 1e-8


def test_two_results_are_compared_by_what_they_do_in_the_work_space(rig: Rig, pictures) -> None:
    camera = rig.cameras[0]
    found = locate_by_frame_tags(
        rig, camera, observe_tags(pictures, rig, camera, numbers(rig)), Survey(5e-4)
    )
    verdict = judge_extrinsics(found, 1e-3)
    one = extrinsics_result(found, verdict, rig.document, date(2026, 3, 2))
    pose = found.world_from_camera
    rotated = Pose(
        pose.position + np.array([0.001, 0.0, 0.0]),
        matrix_from_rotation_vector([0, 0, 0.002]) @ pose.rotation,
    )
    there = replace(found, camera=replace(found.camera, world_from_camera=rotated))
    two = extrinsics_result(there, verdict, rig.document, date(2026, 3, 3))
    changes = one.changes_to(two)
    assert changes["x_mm"] == pytest.approx(1.0, abs=1e-6)
    assert changes["turn_z_deg"] == pytest.approx(np.degrees(0.002), abs=1e-6)
    arms = found.points - pose.position
    by_hand = np.array([0.001, 0, 0]) + np.cross([0, 0, 0.002], arms)
    expected = np.sqrt(np.mean(np.sum(by_hand**2, axis=1))) * 1e3
    assert one.apart_mm(two) == pytest.approx(expected, rel=2e-3)


def test_unused_images_are_listed_by_name(rig: Rig, pictures) -> None:
    camera = rig.cameras[0]
    blank = np.full((720, 1280), 100, np.uint8)
    first, image = pictures[0]
    more = [("blank.png", blank), ("copy.png", image.copy())]
    observations = observe_tags([*pictures, *more], rig, camera, numbers(rig))
    assert observations.unused == {
        "blank.png": "shows no complete tag",
        "copy.png": f"is the same image as {first}",
    }
    assert observations.squares.keys() == {name for name, _ in pictures}
    with pytest.raises(BadInput, match="none of the tag36h11 tags 401, 402, 403, 404"):
        observe_tags([("blank.png", blank)], rig, camera, numbers(rig))


def test_mirrored_images_and_other_tags_are_reported(rig: Rig, pictures) -> None:
    camera, (name, image) = rig.cameras[0], pictures[0]
    flipped = np.ascontiguousarray(image[:, ::-1])
    with pytest.raises(BadInput) as caught:
        observe_tags([(name, flipped)], rig, camera, numbers(rig))
    assert "mirrored" in caught.value.why
    with pytest.raises(BadInput) as caught:
        observe_tags([(name, image)], rig, camera, [411, 412])
    assert "shows tag36h11" in caught.value.why
    assert "401" in caught.value.why
    with pytest.raises(BadInput, match="none of the tag25h9 tags 401") as caught:
        observe_tags([(name, image)], replace(rig, tag_family="tag25h9"), camera, numbers(rig))
    assert "shows tag36h11 301" in caught.value.why


def test_a_number_that_is_seen_twice_is_left_out_by_name(rig: Rig, pictures) -> None:
    camera, (name, image) = rig.cameras[0], pictures[0]
    seen = observe_tags(pictures[:1], rig, camera, numbers(rig)).squares[name]
    corners = seen[402].corners
    low, high = corners.min(axis=0).astype(int) - 8, corners.max(axis=0).astype(int) + 9
    patch = image[low[1] : high[1], low[0] : high[0]]
    doubled = image.copy()
    doubled[4 : 4 + patch.shape[0], 4 : 4 + patch.shape[1]] = patch
    observations = observe_tags([(name, doubled)], rig, camera, numbers(rig))
    assert observations.unused == {f"{name}, tag 402": "is detected more than once"}
    assert 402 not in observations.squares[name]
    assert observations.squares[name].keys() == seen.keys() - {402}


def test_a_rig_without_frame_tags_is_refused(rig: Rig) -> None:
    with pytest.raises(BadInput, match="no frame tags"):
        require_frame_tags(replace(rig, frame_tags=()))


@pytest.mark.parametrize("seed", range(4))
def test_the_stated_error_of_a_camera_pose_is_exceeded_in_one_case_of_twenty(
    rig, seed: int
) -> None:
    """As 1.96 RMS it was exceeded in one of 200, and good poses were refused."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6, 6)) * np.array([*[3e-4] * 3, *[3e-4] * 3])[:, None]
    camera = rig.cameras[0]
    covariance = root @ root.T
    result = ExtrinsicCalibration(
        camera=camera,
        by="frame tags",
        covariance=covariance,
        half_widths=Z_95 * np.sqrt(np.diag(covariance)),
        by_lens=None,
        points=workspace_corners(rig),
        tag_errors={},
        pictures=1,
        unused={},
        issues=(),
        data_hash="",
    )
    arms = result.points - camera.world_from_camera.position
    steps = rng.multivariate_normal(np.zeros(6), covariance, size=4000)
    moved_by = steps[:, None, :3] + np.cross(steps[:, None, 3:], arms)
    errors = np.sqrt(np.mean(np.sum(moved_by**2, axis=2), axis=1))
    assert np.mean(errors > result.error) == pytest.approx(0.05, abs=0.015)
