"""The tags' poses on the platform from images taken from anywhere."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from calibration.result_files import load_result
from calibration.results import write_result
from calibration.tag_map.bundle_adjustment import TagLayout, measure_layout, require_tags
from calibration.tag_map.observations import (
    TagObservations,
    TagViews,
    connected_tags,
    moved_tags,
)
from calibration.tag_map.result import judge_layout, layout_facts, tags_page, tags_result
from model.errors import BadInput
from model.pose import Pose
from model.rig import Rig, Tag, load_rig, rig_from_document
from tests.calibration.exact_sights import observe
from tracking.detection.tags import tag_corners
from tracking.pnp import moved

CONFIGS = Path(__file__).parents[2] / "configs"


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(CONFIGS / "gachon_8_6.yaml")


def as_mounted(rig: Rig, rng: np.random.Generator, shift: float = 1e-3) -> tuple[Tag, ...]:
    """Tags as mounted by hand: shifted and rotated by small random amounts."""
    steps = rng.standard_normal((len(rig.platform_tags), 6)) * np.repeat([shift, 10 * shift], 3)
    return moved_tags(rig.platform_tags, steps.ravel())


def around(rig: Rig, count: int, rng: np.random.Generator) -> dict[str, Pose]:
    """Poses ``camera_from_platform`` of a platform rotated in all directions before the camera.

    As recommended, no image is frontal to a face.
    """
    poses = {}
    for k in range(count):
        turn = Rotation.random(random_state=rng).as_matrix()
        while np.abs(turn[2]).max() > 0.85:
            turn = Rotation.random(random_state=rng).as_matrix()
        position = np.array([*rng.uniform(-0.05, 0.05, 2), rng.uniform(0.5, 0.7)])
        poses[f"{k:02}.png"] = Pose(position, turn)
    return poses


def session(rig: Rig, tags, count: int, seed: int, noise: float = 0.02) -> TagObservations:
    rng = np.random.default_rng(seed)
    return observe(rig.cameras[0], tags, around(rig, count, rng), noise, rng)


def gaps(found: TagLayout, truth) -> tuple[float, float]:
    """RMS error of corners [mm] and rotations [deg], with the truth aligned to the rig file."""
    true = {tag.id: tag for tag in truth}
    here = np.concatenate([tag_corners(true[tag.id]) for tag in found.tags])
    there = np.concatenate([tag_corners(tag) for tag in found.nominal])
    middle, target = here.mean(axis=0), there.mean(axis=0)
    u, _, vt = np.linalg.svd((there - target).T @ (here - middle))
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    shift = Pose(target - turn @ middle, turn)
    placed = [replace(true[tag.id], pose=shift.compose(true[tag.id].pose)) for tag in found.tags]
    corners = np.concatenate(
        [tag_corners(a) - tag_corners(b) for a, b in zip(found.tags, placed, strict=True)]
    )
    angles = [a.pose.angle_to(b.pose) for a, b in zip(found.tags, placed, strict=True)]
    off = np.sqrt(np.mean(np.sum(corners**2, axis=1)))
    return float(off * 1e3), float(np.degrees(np.sqrt(np.mean(np.square(angles)))))


def test_twenty_pictures_give_the_layout_to_hundredths_of_a_millimetre(rig: Rig) -> None:
    tags = as_mounted(rig, np.random.default_rng(1))
    found = measure_layout(rig, rig.cameras[0], session(rig, tags, 24, seed=2))
    off, rotated = gaps(found, tags)
    assert off < 0.04
    assert rotated < 0.02
    assert found.reprojection < 0.05
    assert found.unseen == {}
    verdict = judge_layout(found, 0.2e-3)
    assert verdict.good, verdict.reasons
    (reason,) = judge_layout(found, 0.99999 * found.error).reasons
    measured, required = re.findall(r"within (.*); (.*) are required", reason)[0]
    assert measured != required


def test_intervals_hold_the_truth_as_often_as_they_say(rig: Rig) -> None:
    inside, errors, stated = [], [], []
    for seed in range(5):
        tags = as_mounted(rig, np.random.default_rng(seed))
        observations = session(rig, tags, 16, seed=100 + seed, noise=0.05)
        found = measure_layout(rig, rig.cameras[0], observations, fixed=301)
        true = {tag.id: tag for tag in tags}
        home = next(tag for tag in found.nominal if tag.id == 301)
        shift = home.pose.compose(true[301].pose.inverse())
        off = np.array(
            [tag.pose.position - shift.compose(true[tag.id].pose).position for tag in found.tags]
        )
        widths = found.half_widths.reshape(-1, 6)[:, :3]
        inside.append(np.abs(off[1:]) <= widths[1:])
        errors.append(np.sqrt(np.mean(np.sum(off**2, axis=1))))
        stated.append(found.error)
        assert widths[0] == pytest.approx(0.0, abs=1e-6)  # the fixed tag is as drawn
    assert np.mean(inside) >= 0.9
    assert np.median(stated) < 8.0 * np.median(errors)


def test_slopes_are_those_of_finite_differences(rig: Rig) -> None:
    observations = session(rig, rig.platform_tags, 4, seed=3)
    tags = tuple(rig.platform_tags)
    views = TagViews.of(rig.cameras[0], observations, tags)
    rng = np.random.default_rng(3)
    poses = [
        p
        for name, p in around(rig, 4, np.random.default_rng(3)).items()
        if name in observations.squares
    ]
    poses = [moved(p, 1e-3 * rng.standard_normal(6)) for p in poses]
    exact = views.dense_slopes(poses, tags)
    count = 6 * len(poses)
    numeric = np.zeros_like(exact)
    for column in range(exact.shape[1]):
        ends = []
        for sign in (1.0, -1.0):
            step = np.zeros(exact.shape[1])
            step[column] = sign * 1e-6
            cameras = [moved(p, s) for p, s in zip(poses, step[:count].reshape(-1, 6), strict=True)]
            ends.append(views.errors(cameras, moved_tags(tags, step[count:])).ravel())
        numeric[:, column] = (ends[0] - ends[1]) / 2e-6
    scale = np.abs(exact).max()
    np.testing.assert_allclose(exact / scale, numeric / scale, atol=1e-6)
    by_size = views.size_slopes(poses, tags)
    for column in range(len(tags)):
        ends = [
            views.errors(poses, sized(tags, {tags[column].id: np.exp(sign * 1e-6)})).ravel()
            for sign in (1.0, -1.0)
        ]
        numeric_size = (ends[0] - ends[1]) / 2e-6
        np.testing.assert_allclose(by_size[:, column] / scale, numeric_size / scale, atol=1e-6)


def test_what_images_do_not_determine_is_reported(rig: Rig) -> None:
    """A tag never seen with others stays nominal; an image of one tag adds nothing."""
    observations = session(rig, rig.platform_tags, 24, seed=4)
    squares = {
        name: {k: s for k, s in seen.items() if k != 306}
        for name, seen in observations.squares.items()
    }
    squares["alone.png"] = {301: next(s[301] for s in squares.values() if 301 in s)}
    found = measure_layout(rig, rig.cameras[0], TagObservations(squares, {}))
    assert found.unseen == {306: "was not detected together with the others"}
    assert "only one tag" in found.unused["alone.png"]
    verdict = judge_layout(found, 1e-3)
    assert "take images that show tag 306 together with others" in verdict.next_steps


@pytest.mark.parametrize("printed", [0.97, 0.8])
def test_wrong_tag_sizes_are_the_only_cause_stated(rig: Rig, printed: float) -> None:
    """All positions are right, but the tags were printed smaller."""
    small = tuple(replace(tag, size=printed * tag.size) for tag in rig.platform_tags)
    found = measure_layout(rig, rig.cameras[0], session(rig, small, 24, seed=5))
    verdict = judge_layout(found, 1.0)
    (reason,), (step,) = verdict.reasons, verdict.next_steps
    assert reason == f"the layout is {1.0 / printed - 1.0:.1%} larger than in the rig file"
    assert "size_mm" in step


def mistaken(rig: Rig, change) -> Rig:
    """The rig with a mistake in each of its tags, or in their order."""
    return replace(rig, platform_tags=tuple(change(rig.platform_tags)))


def rotated(tag: Tag, rotation: np.ndarray) -> Tag:
    return replace(tag, pose=Pose(tag.pose.position, rotation))


def read_as_wxyz(tag: Tag) -> Tag:
    """Its quaternion was written as x, y, z, w."""
    numbers = np.roll(tag.pose.quaternion, -1)
    return rotated(tag, Pose.from_quaternion(tag.pose.position, numbers).rotation)


def renumbered(tags: tuple[Tag, ...], numbers: dict[int, int]) -> list[Tag]:
    return [replace(tag, id=numbers.get(tag.id, tag.id)) for tag in tags]


def sized(tags: tuple[Tag, ...], sizes: dict[int, float]) -> tuple[Tag, ...]:
    return tuple(replace(tag, size=sizes.get(tag.id, 1.0) * tag.size) for tag in tags)


UPSIDE_DOWN = np.diag([-1.0, -1.0, 1.0])
MISTAKES = {
    "rotated": (
        lambda tags: [rotated(tag, tag.pose.rotation @ UPSIDE_DOWN) for tag in tags],
        "all tags fit if each is mounted rotated by 180° about its normal, as AprilTags drawn by",
        "multiply the rotation_wxyz of each in the rig file by [0, 0, 0, 1] from the right",
    ),
    "xyzw": (
        lambda tags: [read_as_wxyz(tag) for tag in tags],
        "all tags fit if the numbers of rotation_wxyz are read as x, y, z, w",
        "write w first in the rotation_wxyz of tags.platform in the rig file",
    ),
    "two exchanged": (
        lambda tags: renumbered(tags, {302: 305, 305: 302}),
        "all tags fit if tag 302 is at the pose of tag 305 and tag 305 is at the pose of tag 302",
        "exchange the ids of tags 302 and 305 in the rig file, or the prints",
    ),
    "three exchanged": (
        lambda tags: renumbered(tags, {302: 303, 303: 305, 305: 302}),
        "all tags fit if tag 302 is at the pose of tag 303 and tag 303 is at the pose of tag 305"
        " and tag 305 is at the pose of tag 302",
        "exchange the ids of tags 302 and 303 and 305 in the rig file, or the prints",
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_in_the_rig_file_is_the_only_cause_stated(rig: Rig, name: str) -> None:
    change, cause, step = MISTAKES[name]
    observations = session(rig, as_mounted(rig, np.random.default_rng(1)), 24, seed=2)
    found = measure_layout(mistaken(rig, change), rig.cameras[0], observations)
    assert found.reprojection < 0.05
    verdict = judge_layout(found, 0.2e-3)
    (reason,), (found_step,) = verdict.reasons, verdict.next_steps
    assert reason.startswith(cause)
    assert found_step.startswith(step)


def test_two_tags_of_other_sizes_with_exchanged_numbers_are_named(rig: Rig) -> None:
    tags = sized(rig.platform_tags, {302: 0.7, 305: 1.2})
    observations = session(rig, tags, 24, seed=2)
    wrong = mistaken(rig, lambda _: renumbered(tags, {302: 305, 305: 302}))
    found = measure_layout(wrong, rig.cameras[0], observations)
    verdict = judge_layout(found, 0.2e-3)
    assert verdict.next_steps == (
        "exchange the ids of tags 302 and 305 in the rig file, or the prints",
    )
    assert found.has_failed


def test_no_size_is_stated_if_less_than_half_of_the_tags_have_theirs(rig: Rig) -> None:
    numbers = [tag.id for tag in rig.platform_tags]
    tags = sized(
        rig.platform_tags, dict(zip(numbers, (0.8, 0.9, 1.0, 1.05, 1.1, 1.2), strict=True))
    )
    observations = session(rig, tags, 16, seed=2)
    wrong = mistaken(rig, lambda own: [replace(tag, size=0.09) for tag in own])
    verdict = judge_layout(measure_layout(wrong, rig.cameras[0], observations), 0.2e-3)
    assert any(
        step.startswith("check sizes and numbers of the tags") for step in verdict.next_steps
    )
    assert not any("wide" in reason for reason in verdict.reasons)


@pytest.mark.parametrize("factor", [0.6, 0.9, 1.04])
def test_a_tag_of_wrong_size_is_named_alone(rig: Rig, factor: float) -> None:
    tags = sized(rig.platform_tags, {304: factor})
    found = measure_layout(rig, rig.cameras[0], session(rig, tags, 24, seed=2))
    verdict = judge_layout(found, 0.2e-3)
    wide, stated = rig.platform_tags[3].size * 1e3 * factor, rig.platform_tags[3].size * 1e3
    reason = next(text for text in verdict.reasons if "reprojection" in text)
    assert f"the images fit if tag 304 is {wide:.1f} mm wide, not {stated:g} mm" in reason
    step = "measure the black square of tag 304 and correct size_mm in the rig file"
    assert step in verdict.next_steps
    assert all("only one tag" in why for why in found.unused.values())
    if found.has_failed:
        assert len(verdict.reasons) == 1
        assert [name for name, _ in layout_facts(found)] == ["images"]


def test_a_failed_fit_states_no_layout(rig: Rig) -> None:
    """Corners are off by several pixels: neither poses nor sizes explain the images."""
    observations = session(rig, rig.platform_tags, 24, seed=2, noise=4.0)
    found = measure_layout(rig, rig.cameras[0], observations)
    verdict = judge_layout(found, 0.2e-3)
    assert verdict.reasons == (f"the reprojection error is {found.reprojection:.2f} px",)
    result = tags_result(found, verdict, rig.document, date(2026, 3, 4))
    assert result.in_words() == []
    assert "Tags against the rig file" not in tags_page(found, result, verdict)


def test_a_tag_that_was_glued_elsewhere_is_named(rig: Rig) -> None:
    step = np.zeros(36)
    step[6:9] = [0.0, 0.012, 0.008]
    tags = moved_tags(rig.platform_tags, step)
    found = measure_layout(rig, rig.cameras[0], session(rig, tags, 24, seed=6))
    verdict = judge_layout(found, 1e-3)
    assert any(reason.startswith("tag 302 is") for reason in verdict.reasons), verdict


def test_a_picture_of_another_tag_is_left_out_by_name(rig: Rig) -> None:
    observations = session(rig, rig.platform_tags, 16, seed=8)
    numbers = [number for seen in observations.squares.values() for number in seen]
    number = max(set(numbers), key=numbers.count)
    name, seen = next(
        (n, s) for n, s in observations.squares.items() if number in s and len(s) == 3
    )
    square = seen[number]
    off = replace(
        square,
        corners=square.corners + 12.0,
        target=square.whitening @ (square.corners + 12.0).ravel(),
    )
    wrong = {**observations.squares, name: {**seen, number: off}}
    found = measure_layout(rig, rig.cameras[0], TagObservations(wrong, {}))
    others = [why for other, why in found.unused.items() if other != name]
    assert all("only one tag" in why for why in others)
    assert "px, far more than the others" in found.unused[name]
    assert gaps(found, rig.platform_tags)[0] < 0.08


def test_pictures_that_are_all_alike_are_not_good_enough(rig: Rig) -> None:
    rng = np.random.default_rng(9)
    base = next(iter(around(rig, 1, rng).values()))
    poses = {f"{k}.png": moved(base, 0.01 * rng.standard_normal(6)) for k in range(20)}
    camera = rig.cameras[0]
    observations = observe(camera, rig.platform_tags, poses, 0.02, rng)
    verdict = judge_layout(measure_layout(rig, camera, observations), 1.0)
    assert any("all images are taken from within" in reason for reason in verdict.reasons)
    assert "take images from all sides, all different" in verdict.next_steps


def test_too_few_pictures_and_tags_are_refused(rig: Rig) -> None:
    with pytest.raises(BadInput, match="images show two platform tags or more; 4 are"):
        measure_layout(rig, rig.cameras[0], session(rig, rig.platform_tags, 3, seed=7))
    with pytest.raises(BadInput, match="no tag 999 on the platform"):
        require_tags(rig, 999)
    with pytest.raises(BadInput, match="fewer than two tags"):
        require_tags(replace(rig, platform_tags=rig.platform_tags[:1]), None)


def test_a_fixed_tag_that_no_picture_shows_is_refused_by_name(rig: Rig) -> None:
    unseen, *seen = rig.platform_tags
    with pytest.raises(BadInput, match=f"^0 images show .* linked to tag {unseen.id}") as caught:
        measure_layout(rig, rig.cameras[0], session(rig, seen, 6, seed=3), unseen.id)
    assert f"two tags that several images connect to tag {unseen.id}" in caught.value.why


@pytest.mark.parametrize("fixed", [None, 301])
def test_a_tag_in_a_single_image_is_not_located(rig: Rig, fixed: int | None) -> None:
    """Without that image it could be anywhere; the others keep their intervals."""
    whole = session(rig, rig.platform_tags, 24, seed=4)
    first = next(n for n, seen in whole.squares.items() if 306 in seen and len(seen) == 3)
    squares = {
        name: {k: s for k, s in seen.items() if k != 306 or name == first}
        for name, seen in whole.squares.items()
    }
    without = {name: {k: s for k, s in seen.items() if k != 306} for name, seen in squares.items()}
    found, plain = (
        measure_layout(rig, rig.cameras[0], TagObservations(one, {}), fixed)
        for one in (squares, without)
    )
    assert found.unseen == {306: f"is connected to the others by {first} alone"}
    np.testing.assert_allclose(found.half_widths, plain.half_widths, rtol=1e-6)
    assert found.half_widths.reshape(-1, 6)[:, :3].max() < 1e-3
    verdict = judge_layout(found, 1e-3)
    assert "take images that show tag 306 together with others" in verdict.next_steps


@pytest.mark.parametrize("fixed", [301, 302])
def test_groups_of_tags_that_a_single_image_connects_are_measured_apart(
    rig: Rig, fixed: int
) -> None:
    whole = session(rig, rig.platform_tags, 40, seed=4)
    groups = ({301, 303, 305}, {302, 304, 306})
    mine, others = groups if fixed in groups[0] else groups[::-1]
    squares = {
        f"{name} {k}": own
        for name, seen in whole.squares.items()
        for k, group in enumerate(groups)
        if len(own := {n: s for n, s in seen.items() if n in group}) >= 2
    }
    bridge = next(n for n, s in whole.squares.items() if len(mine & s.keys()) == 2 and len(s) == 3)
    del squares[f"{bridge} {groups.index(mine)}"]
    squares[bridge] = whole.squares[bridge]
    (linked,) = others & squares[bridge].keys()
    found = measure_layout(rig, rig.cameras[0], TagObservations(squares, {}), fixed)
    assert {tag.id for tag in found.tags} == mine
    assert found.half_widths.reshape(-1, 6)[:, :3].max() < 1e-3
    assert found.unseen == {n: "was not detected together with the others" for n in others} | {
        linked: f"is connected to the others by {bridge} alone"
    }


def test_the_result_replaces_the_nominal_layout(rig: Rig, tmp_path: Path) -> None:
    tags = as_mounted(rig, np.random.default_rng(1))
    found = measure_layout(rig, rig.cameras[0], session(rig, tags, 16, seed=2))
    verdict = judge_layout(found, 2e-4)
    result = tags_result(found, verdict, rig.document, date(2026, 3, 4))
    path = write_result(tmp_path, result)
    assert path.name == "calibration_tags_gachon_8_6_2026-03-04.yaml"
    read = load_result(path)
    assert read == result.sealed()
    better = rig.with_calibration(read)
    for tag, own in zip(better.platform_tags, found.tags, strict=True):
        assert tag.pose.distance_to(own.pose) < 1e-8
        assert tag.size == pytest.approx(own.size)
    other = rig.document.tags.platform[0].model_copy(update={"size_mm": 95.0})
    resized = rig.document.tags.model_copy(
        update={"platform": [other, *rig.document.tags.platform[1:]]}
    )
    changed = rig_from_document(rig.document.model_copy(update={"tags": resized}))
    with pytest.raises(BadInput, match="made with sizes or numbers of tags"):
        changed.with_calibration(read)


def test_results_are_compared_tag_by_tag(rig: Rig) -> None:
    found = measure_layout(rig, rig.cameras[0], session(rig, rig.platform_tags, 16, seed=2))
    step = np.zeros(36)
    step[:6] = [1e-3, 0, 0, 0, 0, 2e-3]
    other = replace(found, tags=moved_tags(found.tags, step))
    verdict = judge_layout(found, 2e-4)
    one, two = (
        tags_result(layout, verdict, rig.document, date(2026, 3, 4)) for layout in (found, other)
    )
    changes = one.changes_to(two)
    assert changes["tag_301_x_mm"] == pytest.approx(1.0, abs=1e-5)
    assert changes["tag_301_turn_z_deg"] == pytest.approx(np.degrees(2e-3), abs=1e-5)
    assert changes["tag_302_x_mm"] == pytest.approx(0.0, abs=1e-9)
    strange = [tag.model_copy(update={"id": tag.id + 100}) for tag in two.platform]
    with pytest.raises(BadInput, match="no tag in common"):
        one.apart_mm(two.model_copy(update={"platform": strange}))
    assert one.apart_mm(two) == pytest.approx(np.hypot(1.0, 0.048 * 2.0) / np.sqrt(6), rel=0.05)


@given(
    pictures=st.lists(st.sets(st.integers(0, 7), min_size=1, max_size=3), max_size=10),
    fixed=st.one_of(st.none(), st.integers(0, 7)),
)
def test_tags_are_connected_as_by_walks_around_each_image(pictures, fixed) -> None:
    found = connected_tags(pictures, fixed)

    def walked(start: int, around: int) -> set[int]:
        reached = {start}
        for _ in range(8):
            rest = (p for k, p in enumerate(pictures) if k != around)
            reached |= {n for p in rest if p & reached for n in p}
        return reached

    def group(start: int) -> set[int]:
        return set.intersection(*(walked(start, k) for k in range(len(pictures))))

    seen = {n for p in pictures for n in p}
    twice = {n for n in seen if sum(n in p for p in pictures) > 1}
    groups = [group(n) for n in twice if fixed is None or fixed in group(n)]
    assert len(found) == max((len(group) for group in groups), default=0)
    assert not found or set(found) in groups
