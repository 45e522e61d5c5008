"""Several cameras: better than each alone, robust against a wrong one."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import chdtri

from model.pose import Array, Pose, matrix_from_rotation_vector, moved, step_between
from model.rig import Camera, Rig
from model.scene import Scene
from simulation.camera.camera import Optics, SyntheticCamera
from tests.tracking.test_tracker import error_of
from tracking.fusion import UNSTATED_ERROR, MultiCameraFusion, fuse_poses
from tracking.measurement import NoPose, Observation, PoseMeasurement, extrapolate
from tracking.pose_log import LoggedImage
from tracking.track import MultiCameraCount, NoPlatformSeen, track_cameras
from tracking.tracker import Tracker

HERE = Pose.level([0.05, 0.05, 0.4])


def other_side(camera: Camera) -> Camera:
    """The same camera, rotated by 90° about the frame."""
    quarter = matrix_from_rotation_vector(np.array([0.0, 0.0, np.pi / 2]))
    pose = camera.world_from_camera
    there = Pose(quarter @ pose.position, quarter @ pose.rotation)
    return replace(camera, name="side", world_from_camera=there)


def measured(position: list[float], sigma: list[float]) -> PoseMeasurement:
    covariance = np.diag(np.square([*sigma, 1e-3, 1e-3, 1e-3]))
    return PoseMeasurement(0.0, Pose.level(position), covariance, (301,), 0.1, "tracked")


def logged(found: Observation) -> LoggedImage:
    return LoggedImage("0.png", found, None, 0)


def without_shared(found: Observation) -> Observation:
    """A measurement by a camera whose lens, pose and tags are exactly those of the rig file."""
    assert isinstance(found, PoseMeasurement), found
    return replace(found, shared=np.zeros((6, 6)))


def test_each_camera_counts_where_it_measures_well() -> None:
    a = measured([1e-3, 0.0, 0.4], [1e-3, 1e-5, 1e-3])
    b = measured([0.0, 1e-3, 0.4], [1e-5, 1e-3, 1e-3])
    found = fuse_poses({"a": a, "b": b})
    assert isinstance(found, PoseMeasurement)
    assert np.abs(found.pose.position - [0.0, 0.0, 0.4]).max() < 1e-6
    assert np.sqrt(np.diag(found.covariance)[:2]).max() < 1.01e-5
    assert np.diag(found.covariance)[2] == pytest.approx(0.5e-6)


def test_two_cameras_give_a_better_pose_than_each_alone(
    rig: Rig, camera: Camera, scene: Scene
) -> None:
    empty, optics = replace(scene, obstacles=()), Optics(blur=0.6)
    eyes = {"front": camera, "side": other_side(camera)}
    pictures = {n: SyntheticCamera(rig, empty, c, seed=3, optics=optics) for n, c in eyes.items()}
    rng = np.random.default_rng(8)
    squares: dict[str, list[float]] = {"front": [], "side": [], "both": []}
    values = []
    for frame in range(8):
        truth = Pose(
            rng.uniform([-0.1, -0.1, 0.35], [0.1, 0.1, 0.5]),
            matrix_from_rotation_vector(rng.normal(size=3) * 0.1),
        )
        seen = {
            name: without_shared(
                Tracker(rig, eyes[name]).observe(pictures[name].render(truth, frame), 0.0)
            )
            for name in eyes
        }
        for name, one in {**seen, "both": fuse_poses(seen)}.items():
            assert isinstance(one, PoseMeasurement), one
            error = error_of(one, truth)
            squares[name].append(float(error[:3] @ error[:3]))
            if name == "both":
                values.append(error @ np.linalg.solve(one.covariance, error))
    rms = {name: np.sqrt(np.mean(values)) for name, values in squares.items()}
    assert rms["both"] < 0.8 * min(rms["front"], rms["side"])
    low, high = chdtri(6 * len(values), [0.9995, 0.0005]) / len(values)
    assert 0.5 * low < np.mean(values) < high


#: Standard deviations of scatter and shared errors of a camera, in `UNSTATED_ERROR`.
CAMERA = st.tuples(st.floats(0.02, 0.5), st.floats(0.0, 5.0))


def covariances(seed: int, size: float) -> np.ndarray:
    """The root of a random covariance, shape (6, 6), of about ``size`` in `UNSTATED_ERROR`."""
    root = np.random.default_rng(seed).normal(size=(6, 6)) / np.sqrt(6.0) + 0.3 * np.eye(6)
    return size * UNSTATED_ERROR[:, None] * root


@given(cameras=st.lists(CAMERA, min_size=2, max_size=4), seed=st.integers(0, 2**16))
def test_errors_common_to_all_images_count_in_the_weights(
    cameras: list[tuple[float, float]], seed: int
) -> None:
    """Against generalized least squares, for independent and for equal shared errors.

    The fused pose is that of independent errors, and what it states covers both.
    """
    roots = [
        (covariances(seed + 2 * k, own), covariances(seed + 2 * k + 1, common))
        for k, (own, common) in enumerate(cameras)
    ]
    steps = [
        0.1 * size * UNSTATED_ERROR * np.random.default_rng(seed + 100 + k).uniform(-1, 1, 6)
        for k, (size, _) in enumerate(cameras)
    ]
    seen = {}
    for k, ((own, common), step) in enumerate(zip(roots, steps, strict=True)):
        one = PoseMeasurement(0.0, moved(HERE, step), own @ own.T, (301,), 0.1, "tracked")
        seen[str(k)] = replace(one, shared=common @ common.T)
    found = fuse_poses(seen)
    assert isinstance(found, PoseMeasurement)
    weights = [np.linalg.inv(own @ own.T + common @ common.T) for own, common in roots]
    best = np.linalg.inv(np.sum(weights, axis=0))
    wanted = best @ np.sum([w @ s for w, s in zip(weights, steps, strict=True)], axis=0)
    error = (step_between(HERE, found.pose) - wanted) / UNSTATED_ERROR
    assert np.abs(error).max() < 1e-3
    scatter = np.zeros((6, 6))
    for weight, (own, _) in zip(weights, roots, strict=True):
        scatter += best @ weight @ own @ own.T @ weight @ best
    units = np.outer(UNSTATED_ERROR, UNSTATED_ERROR)
    assert found.covariance / units == pytest.approx(scatter / units, rel=1e-6, abs=1e-9)
    sums = [best @ w @ common for w, (_, common) in zip(weights, roots, strict=True)]
    for true in (sum(s @ s.T for s in sums), sum(sums) @ sum(sums).T):
        assert np.linalg.eigvalsh((found.shared - true) / units).min() > -1e-9


@given(poor=st.floats(1.0, 100.0), count=st.integers(1, 3), sharp=st.booleans())
def test_poorer_cameras_hardly_change_what_a_good_one_measures(
    poor: float, count: int, sharp: bool
) -> None:
    """Also where a poorer one, such as a camera that was located badly, scatters less."""
    good = replace(measured([0.0, 0.0, 0.4], [2e-5] * 3), shared=np.diag([2e-4**2] * 3 + [0.0] * 3))
    own, common = (5e-6 if sharp else 2e-5 * poor), 2e-4 * poor
    bad = replace(
        measured([common, 0.0, 0.4], [own] * 3), shared=np.diag([common**2] * 3 + [0.0] * 3)
    )
    found = fuse_poses({"good": good} | {str(k): bad for k in range(count)})
    assert isinstance(found, PoseMeasurement)

    def deviation(one: PoseMeasurement) -> float:
        return float(np.sqrt((one.covariance + one.shared)[0, 0]))

    assert deviation(found) < (1.0 + 1.1 * count / (poor + 1.0)) * deviation(good)
    assert found.pose.position[0] < 1.1 * count * 2e-4 / poor


@pytest.mark.parametrize(
    ("stated", "fused"), [([0.005, 0.0], 0.0), ([0.005, 0.001], 0.001), ([0.002] * 2, 0.002)]
)
def test_the_cables_are_as_certain_as_the_best_statement_says(
    stated: list[float], fused: float
) -> None:
    """One camera with a rough value of the operator makes no cable less certain."""
    one = measured([0.0, 0.0, 0.4], [1e-4] * 3)
    seen = {str(k): replace(one, cable_error=error) for k, error in enumerate(stated)}
    for order in (seen, dict(reversed(seen.items()))):
        found = fuse_poses(order)
        assert isinstance(found, PoseMeasurement)
        assert found.cable_error == fused


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0, 1.5])
@pytest.mark.parametrize("ratio", [1.0, 8.0])
@pytest.mark.parametrize("count", [2, 3])
def test_what_is_accepted_as_agreeing_is_within_the_stated_covariance(
    count: int, ratio: float, share: float
) -> None:
    """Cameras with errors that nothing states, some of them as large as the comparison allows.

    Errors that the scatter of the worse of two cameras hides cannot show, and are not tried.

    Args:
        count: Number of cameras.
        ratio: Scatter of the other cameras relative to that of the first.
        share: Unstated error of each, in `UNSTATED_ERROR`.
    """
    rng, truth, values = np.random.default_rng(5), HERE, []
    for _ in range(150):
        seen = {}
        for name in "abc"[:count]:
            root = rng.normal(size=(6, 6)) / np.sqrt(6.0) + 0.5 * np.eye(6)
            root *= 0.02 * UNSTATED_ERROR[:, None] * (ratio if name != "a" else 1.0)
            error = root @ rng.normal(size=6) + share * UNSTATED_ERROR * rng.normal(size=6)
            rotation = matrix_from_rotation_vector(error[3:]) @ truth.rotation
            pose = Pose(truth.position + error[:3], rotation)
            seen[name] = PoseMeasurement(0.0, pose, root @ root.T, (301,), 0.1, "tracked")
        found = fuse_poses(seen)
        if isinstance(found, PoseMeasurement):
            error = error_of(found, truth)
            values.append(error @ np.linalg.solve(found.covariance + found.shared, error))
    assert len(values) > 120
    assert 2.5 < np.mean(values) < 8.5


def test_of_two_that_disagree_there_is_no_pose() -> None:
    a, b = measured([0.0, 0.0, 0.4], [1e-4] * 3), measured([0.01, 0.0, 0.4], [1e-4] * 3)
    found = fuse_poses({"front": a, "side": b})
    assert isinstance(found, NoPose)
    assert found.reason == "cameras front and side disagree by 10.0 mm"


@pytest.mark.parametrize("exchange", [True, False])
def test_two_that_agree_once_exchanged_are_not_to_be_calibrated_again(
    rig: Rig, camera: Camera, exchange: bool
) -> None:
    pair = (camera, other_side(camera))
    true = [camera.world_from_camera.inverse().compose(HERE) for camera in pair]
    seen = [true[1], true[0]] if exchange else [true[0], moved(true[1], np.full(6, 0.1))]
    streams = {
        one.name: iter([logged(replace(measured([0.0] * 3, [1e-4] * 3), pose=pose))])
        for one, view in zip(pair, seen, strict=True)
        for pose in [one.world_from_camera.compose(view)]
    }
    tracked = track_cameras(replace(rig, cameras=pair), streams, 0.05, MultiCameraCount())
    with pytest.raises(NoPlatformSeen, match="front and side disagree") as caught:
        list(tracked)
    assert ("exchange the sources" in caught.value.next_step) is exchange
    assert ("calibrate the cameras' poses again" in caught.value.next_step) is not exchange


@pytest.mark.parametrize("agreed", [0, 1])
def test_images_without_partner_do_not_hide_that_cameras_disagree(
    rig: Rig, camera: Camera, agreed: int
) -> None:
    """Live cameras begin and end at different times."""
    count, names = MultiCameraCount(), ("front", "side")

    def stream(name: str) -> Iterator[LoggedImage]:
        for k in range(6):
            x = 0.03 if name == "side" and k >= 1 + agreed else 0.0
            if not (k == 0 and name == "side"):
                yield logged(replace(measured([x, 0.0, 0.4], [1e-4] * 3), time=0.1 * k))

    streams = {name: stream(name) for name in names}
    tracked = track_cameras(rig, streams, 0.04, count)
    if agreed:
        assert len(list(tracked)) == 6
        assert "cameras disagreed at 4 of 6 times" in count.remarks
        return
    with pytest.raises(NoPlatformSeen, match=r"front and side disagree by 30\.0 mm"):
        list(tracked)


def test_a_camera_that_gave_no_pose_is_named_though_another_gave_some(rig: Rig) -> None:
    def dark() -> Iterator[LoggedImage]:
        yield LoggedImage("0.png", NoPose(0.0, "no tag found"))
        raise NoPlatformSeen("none of 1 image gives a pose of the platform: no tag found")

    count = MultiCameraCount()
    seen = logged(measured([0.0, 0.0, 0.4], [1e-4] * 3))
    assert len(list(track_cameras(rig, {"front": iter([seen]), "side": dark()}, 0.05, count))) == 1
    (remark,) = count.remarks
    assert remark.startswith("camera side: none of 1 image gives a pose")


def test_of_three_the_one_that_disagrees_is_left_out() -> None:
    good = [measured([0.0, 0.0, 0.4], [1e-4] * 3), measured([1e-4, 0.0, 0.4], [1e-4] * 3)]
    wrong = measured([0.03, 0.0, 0.4], [1e-4] * 3)
    found = fuse_poses({"a": good[0], "wrong": wrong, "b": good[1]})
    assert isinstance(found, PoseMeasurement)
    assert found.pose.distance_to(Pose.level([5e-5, 0.0, 0.4])) < 1e-9


@given(
    speed=st.tuples(*[st.floats(-0.3, 0.3)] * 3),
    late=st.floats(0.0, 0.049),
    period=st.floats(0.06, 0.4),
)
def test_cameras_slightly_apart_in_time_agree_on_a_moving_platform(
    speed: tuple[float, float, float], late: float, period: float
) -> None:
    def seen(time: float, deviation: float) -> PoseMeasurement:
        covariance = np.diag([deviation**2] * 6)
        pose = Pose.level(np.array([0.0, 0.0, 0.4]) + time * np.array(speed))
        return PoseMeasurement(time, pose, covariance, (301,), 0.1, "tracked")

    common = MultiCameraFusion(0.05)
    for k in range(3):
        now = k * period
        found = common.of({"front": seen(now, 1e-4), "side": seen(now + late, 2e-4)})
    assert isinstance(found, PoseMeasurement)
    assert found.time == pytest.approx(now + late)
    assert found.pose.distance_to(seen(now + late, 1e-4).pose) < 1e-9
    assert (found.position_deviation <= 2e-4 + 1e-12).all()


CORNERS = np.array([[-0.2, -0.1, 0.3], [0.2, 0.1, 0.3], [0.1, -0.1, 0.5], [-0.2, 0.2, 0.4]])


def there_and_at_rest(time: float) -> Array:
    """A path from corner to corner, 4 s each with a rest of 1 s, mostly at 80 to 110 mm/s."""
    leg = min(int(time // 5.0), 2)
    share = min(max((time - 5.0 * leg) / 4.0, 0.0), 1.0)
    share = share**2 * (3.0 - 2.0 * share)
    return np.asarray(CORNERS[leg] + share * (CORNERS[leg + 1] - CORNERS[leg]))


def always_forward(time: float) -> Array:
    """A straight line at 80 mm/s."""
    return np.array([-0.1 + 0.08 * time, 0.02, 0.4])


def clock_remarks(
    path: Callable[[float], Array],
    duration: float,
    late: float,
    rng: np.random.Generator,
    tilt: float,
    apart: float = 0.0,
    rate: float = 10.0,
) -> list[str]:
    """Remarks on two cameras.

    Args:
        path: Position at a time [s], [m].
        duration: [s].
        late: By how much the second camera's images are taken later than their time, [s].
        rng: Generator.
        tilt: Standard deviation of each camera's rotation about a point 1.5 m away, [rad].
        apart: Difference of the times of a frame set, [s].
        rate: Images per second.
    """
    eyes = [np.array([1.1, 0.0, 1.4]), np.array([0.0, -1.1, 1.4])]
    tilts = [matrix_from_rotation_vector(rng.normal(size=3) * tilt) for _ in eyes]
    common = MultiCameraFusion(0.05)
    for time in np.arange(0.0, duration, 1.0 / rate).tolist():
        seen = {}
        for name, eye, turn, own in zip(("a", "b"), eyes, tilts, (0.0, apart), strict=True):
            true = path(time + own + (late if name == "b" else 0.0))
            position = eye + turn @ (true - eye) + rng.normal(size=3) * 1e-4
            covariance = np.diag([1e-8] * 3 + [1e-8] * 3)
            pose = Pose.level(position)
            seen[name] = PoseMeasurement(time + own, pose, covariance, (301,), 0.1, "tracked")
        common.of(seen)
    return common.clock_remarks()


@pytest.mark.parametrize("apart", [0.0, 0.03])
@pytest.mark.parametrize("late", [-0.08, -0.02, 0.02, 0.08])
def test_an_offset_between_clocks_is_measured_beside_errors_of_the_cameras_poses(
    late: float, apart: float
) -> None:
    """The poses disagree by 3 mm at rest already, on average."""
    for seed in range(2):
        rng = np.random.default_rng(seed)
        (text,) = clock_remarks(there_and_at_rest, 15.0, late, rng, 1e-3, apart)
        stated = re.search(r": images of (\w) are taken (\d+) ± (\d+) ms", text)
        assert stated, text
        assert stated[1] == ("b" if late > 0.0 else "a")
        assert int(stated[3]) <= 3
        assert float(stated[2]) == pytest.approx(abs(late) * 1e3, abs=4.0)
        assert text.endswith("compare their clocks and latency_ms")


def swinging(time: float) -> Array:
    """A closed curve at about 60 mm/s."""
    return np.array(
        [0.06 * np.sin(time), 0.04 * np.sin(0.8 * time), 0.4 + 0.03 * np.sin(0.7 * time)]
    )


@pytest.mark.parametrize("path", [there_and_at_rest, swinging])
@pytest.mark.parametrize("late", [0.08, -0.12])
@pytest.mark.parametrize("rate", [4.0, 30.0])
def test_the_interval_contains_the_offset_at_any_number_of_images_per_second(
    path: Callable[[float], Array], late: float, rate: float
) -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        (text,) = clock_remarks(path, 15.0, late, rng, 1e-3, rate=rate)
        stated = re.search(r": images of (\w) are taken (\d+) ± (\d+) ms", text)
        assert stated, text
        assert stated[1] == ("b" if late > 0.0 else "a")
        assert abs(int(stated[2]) - abs(late) * 1e3) <= int(stated[3]) <= 8


@pytest.mark.parametrize("apart", [0.0, 0.03])
@pytest.mark.parametrize("tilt", [0.0, 1e-3, 3e-3])
def test_wrong_poses_of_cameras_are_not_blamed_on_their_clocks(tilt: float, apart: float) -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        assert clock_remarks(there_and_at_rest, 15.0, 0.0, rng, tilt, apart) == []


def test_what_a_constant_velocity_does_not_separate_is_left_open() -> None:
    (text,) = clock_remarks(always_forward, 2.0, 0.04, np.random.default_rng(3), 0.0)
    stated = re.search(r"disagree by (\S+) mm along the motion at 80 mm/s", text)
    assert stated
    assert float(stated[1]) == pytest.approx(3.2, abs=0.5)
    assert "perhaps images of b are taken" in text
    assert "their poses at rest" in text
    assert clock_remarks(always_forward, 2.0, 0.0, np.random.default_rng(3), 0.0) == []
    assert clock_remarks(lambda _: CORNERS[0], 20.0, 0.04, np.random.default_rng(3), 3e-3) == []


def test_the_covariance_includes_the_extrapolation() -> None:
    """From many noisy pairs: the extrapolated pose scatters as its covariance states."""
    rng, errors = np.random.default_rng(3), []
    for _ in range(400):
        noise = rng.normal(0.0, 1e-4, (2, 3))
        one, two = (
            replace(measured((np.array([0, 0, 0.4]) + n).tolist(), [1e-4] * 3), time=time)
            for n, time in zip(noise, (0.0, 0.1), strict=True)
        )
        later = extrapolate(two, one, 0.15)
        assert later is not None
        error = later.pose.position - [0, 0, 0.4]
        errors.append(error @ np.linalg.solve(later.covariance[:3, :3], error))
    low, high = chdtri(3 * len(errors), [0.9995, 0.0005]) / len(errors)
    assert low < np.mean(errors) < high


def test_pictures_too_far_apart_in_time_are_not_taken_together() -> None:
    front = measured([0.0, 0.0, 0.4], [1e-4] * 3)
    side = replace(measured([0.02, 0.0, 0.4], [1e-4] * 3), time=0.11)
    common = MultiCameraFusion(0.05)
    assert common.of({"front": front, "side": side}) is side
    assert common.of({"side": side, "front": front}) is side
    assert common.apart == 2


@pytest.mark.parametrize("first", ["late", "a"])
def test_the_camera_that_is_named_first_does_not_decide_which_pictures_count(first: str) -> None:
    good = [measured([0.0, 0.0, 0.4], [1e-4] * 3), measured([1e-4, 0.0, 0.4], [1e-4] * 3)]
    late = replace(measured([0.02, 0.0, 0.4], [1e-4] * 3), time=0.09)
    seen = {"late": late, "a": good[0], "b": good[1]}
    common = MultiCameraFusion(0.05)
    found = common.of({first: seen[first], **seen})
    assert isinstance(found, PoseMeasurement)
    assert found.pose.distance_to(Pose.level([5e-5, 0.0, 0.4])) < 1e-9
    assert common.apart == 1


@pytest.mark.parametrize("late", [0.0, 0.07, 0.099])
def test_cameras_that_run_free_at_the_same_rate_are_taken_together(late: float) -> None:
    """Triggered every 0.1 s, each returns an image of its own time: up to a period apart."""
    front, common = measured([0.0, 0.0, 0.4], [1e-4] * 3), MultiCameraFusion(0.05)
    for now in (0.0, 0.1):
        seen = {"front": replace(front, time=now), "side": replace(front, time=now + late)}
        found = common.of({**seen, "dark": NoPose(5.0, "dark")})
    assert isinstance(found, PoseMeasurement)
    assert found.time == 0.1 + late
    share = late / 0.1
    information = 1.0 + 1.0 / ((1.0 + share) ** 2 + share**2)
    assert found.position_deviation == pytest.approx(np.full(3, 1e-4 / np.sqrt(information)))
    assert common.apart == 0


@given(speed=st.floats(-0.3, 0.3), late=st.floats(0.001, 0.09), pause=st.floats(0.51, 5.0))
def test_a_pose_is_of_the_time_it_states_though_no_speed_is_known(
    speed: float, late: float, pause: float
) -> None:
    """First images, and those after a long gap: the later, worse camera counts."""

    def seen(time: float, deviation: float) -> PoseMeasurement:
        one = measured([speed * time, 0.0, 0.4], [deviation] * 3)
        return replace(one, time=time)

    common = MultiCameraFusion(0.05)
    for now in (0.0, pause):
        found = common.of({"front": seen(now, 2e-5), "side": seen(now + late, 1e-4)})
        assert isinstance(found, PoseMeasurement)
        assert found.time == now + late
        assert found.pose.distance_to(seen(found.time, 1.0).pose) < 1e-12
        assert found.position_deviation == pytest.approx(np.full(3, 1e-4))
    assert (common.without_speed, common.apart) == (2, 0)


def test_one_that_sees_nothing_leaves_it_to_the_others() -> None:
    good = measured([0.0, 0.0, 0.4], [1e-4] * 3)
    assert fuse_poses({"a": NoPose(0.0, "dark"), "b": good}) is good
    none = fuse_poses({"a": NoPose(0.0, "dark", (7,)), "b": NoPose(0.0, "covered")})
    assert isinstance(none, NoPose)
    assert none.reason == "a: dark; b: covered"
    assert none.seen == (7,)
