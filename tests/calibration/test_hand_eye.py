"""The camera's pose from the rig's own motion."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.extrinsics.hand_eye import locate_by_motion
from calibration.extrinsics.result import judge_extrinsics
from calibration.run_data import read_poses
from calibration.tag_map.observations import TagObservations
from model.errors import BadInput, InvalidFile
from model.pose import Pose, matrix_from_rotation_vector, rotation_vector_from_matrix
from model.rig import Camera, Rig, load_rig
from tests.calibration.exact_sights import observe

CONFIGS = Path(__file__).parents[2] / "configs"


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(CONFIGS / "gachon_8_6.yaml")


def shaken(pose: Pose, noise: float, rng: np.random.Generator) -> Pose:
    turn = matrix_from_rotation_vector(2.0 * noise * rng.standard_normal(3))
    return Pose(pose.position + noise * rng.standard_normal(3), turn @ pose.rotation)


def session(
    rig: Rig,
    count: int,
    turn: float,
    noise: float,
    seed: int,
    tags_off: Pose | None = None,
    pixels: float = 0.03,
):
    """Images of a platform near its encoder poses: observations and encoder poses."""
    rng = np.random.default_rng(seed)
    camera, encoder, seen = rig.cameras[0], {}, {}
    off = tags_off or Pose.level(np.zeros(3))
    for k in range(count):
        position = rng.uniform([-0.2, -0.2, 0.25], [0.2, 0.2, 0.6])
        pose = Pose(position, matrix_from_rotation_vector(rng.uniform(-turn, turn, 3)))
        encoder[f"{k}.png"] = shaken(pose, noise, rng)
        seen[f"{k}.png"] = camera.world_from_camera.inverse().compose(pose).compose(off)
    return observe(camera, rig.platform_tags, seen, pixels, rng), encoder


def unaware(camera: Camera) -> Camera:
    """The camera as in a rig file with an unknown camera pose."""
    return replace(camera, world_from_camera=Pose.level([0.0, 0.0, 1.0]))


def test_exact_poses_give_the_exact_camera_pose(rig: Rig) -> None:
    off = Pose(np.array([4e-4, -3e-4, 2e-4]), matrix_from_rotation_vector([0.002, 0.001, -0.003]))
    observations, encoder = session(rig, 30, 0.3, 1e-6, seed=1, tags_off=off)
    found = locate_by_motion(rig, unaware(rig.cameras[0]), observations, encoder)
    truth = rig.cameras[0].world_from_camera
    assert found.world_from_camera.distance_to(truth) < 1e-3
    assert np.degrees(found.world_from_camera.angle_to(truth)) < 0.05
    assert found.by == "rig motion"


@pytest.mark.parametrize("turn", [0.3, 0.0])
def test_intervals_hold_the_truth_as_often_as_they_say(rig: Rig, turn: float) -> None:
    truth, inside = rig.cameras[0].world_from_camera, []
    for seed in range(4):
        rng = np.random.default_rng(1000 + seed)
        off = shaken(Pose.level(np.zeros(3)), 1e-3, rng)
        observations, encoder = session(rig, 16, turn, 0.5e-3, seed, off)
        result = locate_by_motion(rig, unaware(rig.cameras[0]), observations, encoder)
        pose = result.world_from_camera
        rotation = rotation_vector_from_matrix(pose.rotation @ truth.rotation.T)
        gap = np.concatenate([pose.position - truth.position, rotation])
        inside.append(np.abs(gap) <= result.half_widths)
    assert np.mean(inside) >= 0.9


def test_motion_without_rotation_leaves_the_drawing_and_says_so(rig: Rig) -> None:
    """The tags' poses on the platform cannot be separated from the camera's pose."""
    still = locate_by_motion(rig, rig.cameras[0], *session(rig, 20, 0.0, 1e-5, seed=4))
    turning = locate_by_motion(rig, rig.cameras[0], *session(rig, 20, 0.3, 1e-5, seed=4))
    assert (still.half_widths[:3] > 1.5e-3).all()
    assert (turning.half_widths[:3] < 1.0e-3).all()
    verdict = judge_extrinsics(still, 1e-3)
    assert not verdict.good
    assert "rotated up to 20°" in " ".join(verdict.next_steps)


def test_a_pose_that_was_written_wrongly_counts_little(rig: Rig) -> None:
    observations, encoder = session(rig, 16, 0.3, 1e-4, seed=5)
    encoder["3.png"] = Pose(
        encoder["3.png"].position + np.array([0.05, 0, 0]), encoder["3.png"].rotation
    )
    found = locate_by_motion(rig, unaware(rig.cameras[0]), observations, encoder)
    assert found.world_from_camera.distance_to(rig.cameras[0].world_from_camera) < 2e-3


def test_poses_that_are_all_alike_are_not_good_enough(rig: Rig) -> None:
    rng, camera = np.random.default_rng(7), rig.cameras[0]
    encoder = {
        f"{k}.png": Pose.level(rig.home.position + 1e-3 * rng.uniform(-1.0, 1.0, 3))
        for k in range(10)
    }
    world = camera.world_from_camera.inverse()
    seen = {name: world.compose(pose) for name, pose in encoder.items()}
    observations = observe(camera, rig.platform_tags, seen, 0.03, rng)
    verdict = judge_extrinsics(locate_by_motion(rig, camera, observations, encoder), 1.0)
    assert any("all poses lie within" in reason for reason in verdict.reasons)


def test_the_same_view_counts_once(rig: Rig) -> None:
    """As with one image saved several times, or a platform at rest."""
    observations, encoder = session(rig, 10, 0.3, 1e-4, seed=7)
    rng = np.random.default_rng(1)
    copies = {
        f"again {name}": {
            k: replace(square, corners=square.corners + 0.04 * rng.standard_normal((4, 2)))
            for k, square in squares.items()
        }
        for name, squares in observations.squares.items()
    }
    both = TagObservations({**observations.squares, **copies}, {})
    named = {f"again {name}": pose for name, pose in encoder.items()}
    once = locate_by_motion(rig, rig.cameras[0], observations, encoder)
    found = locate_by_motion(rig, rig.cameras[0], both, {**encoder, **named})
    assert found.pictures == once.pictures
    assert found.half_widths == pytest.approx(once.half_widths)
    assert set(found.unused) == set(copies)
    assert found.unused["again 3.png"] == "duplicates 3.png: nothing moved in between"


def test_of_two_views_of_one_pose_the_one_with_more_tags_counts(rig: Rig) -> None:
    observations, _ = session(rig, 4, 0.3, 1e-4, seed=7)
    squares = max(observations.squares.values(), key=len)
    assert len(squares) > 1
    fewer = dict(list(squares.items())[:1])
    for order in ({"a": fewer, "b": squares}, {"b": squares, "a": fewer}):
        once = TagObservations(order, {}).without_duplicates(rig.cameras[0])
        assert set(once.squares) == {"b"}
        assert once.unused == {"a": "duplicates b: nothing moved in between"}


def test_pictures_without_a_pose_are_named_and_too_few_are_refused(rig: Rig) -> None:
    observations, encoder = session(rig, 6, 0.3, 1e-4, seed=6)
    del encoder["2.png"]
    found = locate_by_motion(rig, rig.cameras[0], observations, encoder)
    assert found.unused == {"2.png": "has no pose"}
    assert any("5 poses were observed; 8 are required" in issue.reason for issue in found.issues)
    few = {name: encoder[name] for name in ("0.png", "1.png")}
    with pytest.raises(BadInput, match="2 images show the platform at a known pose"):
        locate_by_motion(rig, rig.cameras[0], observations, few)


# Poses and images that contradict each other.


def with_camera(rig: Rig, longer: float) -> Rig:
    """A rig whose camera has a focal length so many times as long."""
    matrix = np.array(rig.cameras[0].matrix)
    matrix[[0, 1], [0, 1]] *= longer
    return replace(rig, cameras=(replace(rig.cameras[0], matrix=matrix),))


def with_tags(rig: Rig, larger: float) -> Rig:
    """A rig whose platform tags are so many times as large."""
    tags = tuple(replace(tag, size=tag.size * larger) for tag in rig.platform_tags)
    return replace(rig, platform_tags=tags)


def changed(poses: dict[str, Pose], change: Callable[[Pose], Pose]) -> dict[str, Pose]:
    return {name: change(pose) for name, pose in poses.items()}


@pytest.mark.parametrize("longer", [0.98, 1.02])
def test_a_wrong_focal_length_is_measured_and_never_good_enough(rig: Rig, longer: float) -> None:
    """The fit takes most of its effect as noise of the poses: the more poses, the surer it is."""
    images, encoder = session(with_camera(rig, longer), 40, 0.3, 3e-4, seed=11)
    verdict = judge_extrinsics(locate_by_motion(rig, rig.cameras[0], images, encoder), 1.0)
    assert not verdict.good
    side = "longer" if longer > 1.0 else "shorter"
    (reason,), (step,) = verdict.reasons, verdict.next_steps
    found = re.fullmatch(rf"the poses fit a focal length that is (.*)% {side} than in .*", reason)
    assert found is not None, reason
    assert float(found[1]) == pytest.approx(2.0, abs=0.3)
    for part in ("units of the poses", "size_mm of the tags", "camera's matrix"):
        assert part in step


def test_a_wrong_tag_size_is_measured_and_never_good_enough(rig: Rig) -> None:
    images, encoder = session(with_tags(rig, 0.96), 40, 0.3, 3e-4, seed=12)
    verdict = judge_extrinsics(locate_by_motion(rig, rig.cameras[0], images, encoder), 1.0)
    assert "% larger than the poses" in verdict.reasons[0]
    assert "size_mm" in verdict.next_steps[0]


def test_poses_in_metres_are_named(rig: Rig) -> None:
    """A file's columns are in millimetres, so that they are read as 1000 times too small."""
    images, encoder = session(rig, 16, 0.3, 3e-4, seed=13)
    small = changed(encoder, lambda pose: Pose(pose.position / 1e3, pose.rotation))
    verdict = judge_extrinsics(locate_by_motion(rig, rig.cameras[0], images, small), 1.0)
    assert "times as far as by the poses" in verdict.reasons[0]
    assert "they seem to be in metres" in verdict.next_steps[0]
    assert len(verdict.reasons) == 1


def of_body(offset: Pose) -> Callable[[Pose], Pose]:
    """The pose of a body on the platform instead of that of its origin."""
    return lambda pose: pose.compose(offset)


ABOVE = Pose.level([0.0, 0.0, 0.05])
ROTATED = Pose(np.zeros(3), matrix_from_rotation_vector([0.0, 0.0, np.pi / 2]))


@pytest.mark.parametrize(
    ("offset", "turn", "words"),
    [(ABOVE, 0.3, "50."), (ABOVE, 0.035, "mm"), (ROTATED, 0.3, "90.0°")],
)
def test_tags_that_are_elsewhere_on_the_platform_are_never_good_enough(
    rig: Rig, offset: Pose, turn: float, words: str
) -> None:
    """With small rotations the camera's pose takes most of it: the stated error is far too low."""
    images, encoder = session(rig, 40, turn, 3e-4, seed=14)
    other = changed(encoder, of_body(offset))
    found = locate_by_motion(rig, rig.cameras[0], images, other)
    verdict = judge_extrinsics(found, 1.0)
    assert not verdict.good
    (reason,) = verdict.reasons
    assert reason.startswith("the tags fit the poses only ")
    assert words in reason
    assert "4.0 mm and 2.0° are allowed" in reason
    assert "platform's frame, not of another body" in verdict.next_steps[0]
    assert "from the rig file" in dict(found.details)["tags' frame"]


def wrong_order(pose: Pose) -> Pose:
    """Its quaternion written with qw last and read with qw first."""
    return Pose.from_quaternion(pose.position, np.roll(pose.quaternion, -1))


MIRROR = np.diag([1.0, -1.0, 1.0])


@pytest.mark.parametrize(
    "change",
    [
        Pose.inverse,
        wrong_order,
        lambda pose: Pose(pose.position[[1, 0, 2]], pose.rotation),
        lambda pose: Pose(MIRROR @ pose.position, MIRROR @ pose.rotation @ MIRROR),
        lambda pose: Pose(pose.position, pose.rotation.T),
        None,
    ],
    ids=["inverse", "qw last", "axes exchanged", "left-handed", "rotations inverse", "shifted"],
)
def test_poses_of_another_convention_are_named_as_such(
    rig: Rig, change: Callable[[Pose], Pose] | None
) -> None:
    images, encoder = session(rig, 24, 0.3, 3e-4, seed=15)
    if change is None:  # each image has the pose of the next one
        names, poses = list(encoder), list(encoder.values())
        other = dict(zip(names, [*poses[1:], poses[0]], strict=True))
    else:
        other = changed(encoder, change)
    verdict = judge_extrinsics(locate_by_motion(rig, rig.cameras[0], images, other), 1e-3)
    (reason,), (step,) = verdict.reasons, verdict.next_steps
    assert re.fullmatch(r"poses and images contradict each other by [\d.]+ mm, [\d.]+°", reason)
    for part in ("qw comes first", "units", "right-handed", "inverse", "image"):
        assert part in step


@pytest.mark.parametrize("noise", [1e-4, 1e-3])
def test_right_poses_are_no_contradiction_and_their_scatter_is_shown(
    rig: Rig, noise: float
) -> None:
    off = Pose(np.array([1e-3, -1e-3, 1e-3]), matrix_from_rotation_vector([0.005, 0.0, -0.005]))
    images, encoder = session(rig, 24, 0.2, noise, 16, off, pixels=0.01)
    found = locate_by_motion(rig, rig.cameras[0], images, encoder)
    assert not found.is_contradictory
    assert found.issues == ()
    shown = dict(found.details)
    assert list(shown) == ["poses", "distances", "tags' frame"]
    scatter = re.match(r"scatter (\S+) mm, (\S+)° about the images", shown["poses"])
    assert scatter is not None
    assert float(scatter[1]) == pytest.approx(1e3 * noise, rel=0.5)


def test_slow_errors_of_the_encoders_are_no_wrong_scale(rig: Rig) -> None:
    """They are alike in consecutive images, so that leaving out one at a time shows too little."""
    images, encoder = session(rig, 40, 0.3, 1e-5, seed=17)
    angles = np.linspace(0.0, 3.0 * np.pi, 40)
    slow = {
        name: Pose(
            pose.position + 5e-4 * np.array([np.sin(a), np.cos(a), np.sin(a)]), pose.rotation
        )
        for (name, pose), a in zip(encoder.items(), angles, strict=True)
    }
    found = locate_by_motion(rig, rig.cameras[0], images, slow)
    assert found.issues == ()


@pytest.mark.parametrize("seed", [100, 102, 103])
def test_a_platform_that_only_translates_says_nothing_about_the_place_of_its_tags(
    rig: Rig, seed: int
) -> None:
    """The errors of an uncalibrated rig's poses, which vary smoothly, look like rotations."""
    images, encoder = session(rig, 30, 0.0, 1e-6, seed)
    rng = np.random.default_rng(99 + seed)
    shift, turn = (scale * rng.standard_normal((3, 3)) for scale in (0.02, 0.1))
    poses = {}
    for name, pose in encoder.items():
        squares = (pose.position - [0.0, 0.0, 0.42]) ** 2
        rotation = matrix_from_rotation_vector(turn @ squares) @ pose.rotation
        poses[name] = Pose(pose.position + shift @ squares, rotation)
    assert not locate_by_motion(rig, unaware(rig.cameras[0]), images, poses).is_contradictory


def test_an_error_is_not_stated_as_what_is_required(rig: Rig) -> None:
    found = locate_by_motion(rig, rig.cameras[0], *session(rig, 16, 0.3, 3e-4, seed=18))
    for share in (0.9, 0.996, 0.99999):
        (reason,) = judge_extrinsics(found, share * found.error).reasons
        measured, required = re.findall(r"within (.*); (.*) are required", reason)[0]
        assert measured != required


HEAD = "picture,x_mm,y_mm,z_mm,qw,qx,qy,qz\n"


def test_poses_are_read_by_picture_and_rows_without_one_left_out(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text(HEAD + "a.png,1,2,3,1,0,0,0\nb.png,,,,,,,\npictures/c.png,0,0,500,0,1,0,0\n")
    poses = read_poses(path)
    assert list(poses) == ["a.png", "c.png"]
    assert poses["a.png"].position.tolist() == pytest.approx([0.001, 0.002, 0.003])


def test_a_log_of_a_run_is_read_as_far_as_it_has_poses_and_images(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    head = "frame, status, picture, x_mm, y_mm, z_mm, qw, qx, qy, qz\n"
    rows = ("0,ok,a.png,1,2,3,1,0,0,0", "1,ok,,1,2,3,1,0,0,0", "2,no tag,b.png" + ",nan" * 7)
    path.write_text(head + "\n".join(rows))
    assert list(read_poses(path)) == ["a.png"]


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (HEAD + "a.png,1,2,x,1,0,0,0\n", "2:1: a.png: 1, 2, x, 1, 0, 0, 0 are not seven numbers"),
        (HEAD + "a.png,1,2,nan,1,0,0,0\n", "not finite"),
        (HEAD + "a.png,1,2,3,1,1,0,0\n", "length 1"),
        (HEAD + "a.png,1,2,3,1,0,0,0\n" * 2, "appears twice"),
        (HEAD + ",1,2,3,1,0,0,0\n", "no image is named"),
    ],
)
def test_unusable_pose_files_are_refused_with_the_reason(
    tmp_path: Path, text: str, named: str
) -> None:
    path = tmp_path / "poses.csv"
    path.write_text(text)
    with pytest.raises(InvalidFile) as caught:
        read_poses(path)
    assert named in str(caught.value)


def by_another_lens(rig: Rig, change: np.ndarray, noise: float = 1e-4, pixels: float = 0.03):
    """The camera's pose from images that another lens took.

    Args:
        rig: Its camera has no distortion.
        change: Of fx, fy, cx, cy from the stated to the true lens, [px].
        noise: Of the encoder poses, [m].
        pixels: Noise of the corners, [px].
    """
    matrix = np.array(rig.cameras[0].matrix)
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] += change
    true = replace(rig, cameras=(replace(rig.cameras[0], matrix=matrix),))
    observations, encoder = session(true, 16, 0.3, noise, seed=4, pixels=pixels)
    return locate_by_motion(rig, rig.cameras[0], observations, encoder)


@pytest.fixture(scope="module")
def calibrated(rig: Rig) -> Rig:
    """A camera without distortion, whose focal length is known to 0.1 % (1 σ)."""
    plain = replace(rig.cameras[0], distortion=np.zeros(0))
    focal = float(plain.matrix[0, 0])
    lens = np.diag([0.5, 0.5, 0.5, 0.5]) ** 2
    lens[:2, :2] += (1e-3 * focal) ** 2
    return replace(rig, cameras=(replace(plain, lens_covariance=lens),))


def test_the_pose_follows_the_lens_as_its_derivatives_state(calibrated: Rig) -> None:
    same = by_another_lens(calibrated, np.zeros(4), 1e-6, 1e-3)
    for change in 0.02 * np.eye(4):
        pose = by_another_lens(calibrated, change, 1e-6, 1e-3).world_from_camera
        rotation = rotation_vector_from_matrix(pose.rotation @ same.world_from_camera.rotation.T)
        shift = pose.position - same.world_from_camera.position
        stated = -same.by_lens @ change  # the stated lens is off by the opposite
        gap = np.concatenate([shift, rotation]) - stated
        assert np.linalg.norm(gap) < 0.08 * np.linalg.norm(stated)


def test_a_focal_length_that_is_off_is_in_the_interval_of_the_pose(calibrated: Rig) -> None:
    """It shifts all poses alike, so the scatter does not show it."""
    camera = calibrated.cameras[0]
    change = np.array([*2 * [1.5e-3 * float(camera.matrix[0, 0])], 0.0, 0.0])
    found = by_another_lens(calibrated, change)
    gap = found.world_from_camera.position - camera.world_from_camera.position
    assert np.linalg.norm(gap) > 1.5e-3
    assert (np.abs(gap) <= found.half_widths[:3]).all()
    verdict = judge_extrinsics(found, 1e-3)
    assert not verdict.good
    assert "calibrate the camera's lens" in verdict.next_steps[0]
    unknown = replace(calibrated, cameras=(replace(camera, lens_covariance=None),))
    scatter = by_another_lens(unknown, change)
    assert scatter.by_lens is None
    assert not (np.abs(gap) <= scatter.half_widths[:3]).all()


LOG_HEAD = HEAD.replace("\n", ",status\n")


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "no values"),
        (HEAD.replace(",y_mm", "") + "a.png,1,2,1,0,0,0\n", "column 'y_mm' is missing"),
        ("picture,x_mm\na.png,1\n", "columns 'y_mm', 'z_mm', 'qw', 'qx', 'qy', 'qz' are missing"),
        (HEAD.replace(",", ";") + "a.png;1,5;2\n", "separated by semicolons"),
        (HEAD.replace(",", "\t") + "a.png\t1\t2\n", "separated by tabs"),
        (LOG_HEAD + "a.png,1,2,3,1,0,0,0,ok\n\nb.png,4,5,300,1,0,0,0\n", "line 4 has 8 values"),
        (LOG_HEAD + "a.png,1,2,3,1,0,0,0,ok,1\n", "line 2 has 10 values for 9 columns"),
        (HEAD + "a.png,1,2,3\n", "line 2 has 4 values for 8 columns"),
        (HEAD.replace("qx", "qw") + "a.png,1,2,3,1,0,0,0\n", "'qw' appears twice"),
    ],
)
def test_rows_and_columns_that_are_missing_are_named(tmp_path: Path, text: str, named: str) -> None:
    path = tmp_path / "poses.csv"
    path.write_text(text)
    with pytest.raises(BadInput) as caught:
        read_poses(path)
    assert named in str(caught.value)
