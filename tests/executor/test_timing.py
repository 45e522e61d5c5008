"""The time law: fast, within every limit in space, at rest where it must be, never backwards."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from executor.trajectory.path import Path as Curve
from executor.trajectory.path import rounded
from executor.trajectory.time_scaling import (
    TimeLaw,
    length_to_change,
    s_curve,
    smooth_step,
    smooth_step_duration,
    time_law,
)
from model.errors import Fault
from model.pose import Pose
from model.rig import Motion, load_rig
from model.scene import Load
from model.statics.gravity import RATE_CHANGES, inertial_wrench
from model.statics.wrench_sets import rms_anchor_radius
from tests.executor.routes import GACHON, HALL, WEIGHT, always, at_mm, polyline, random_route

NO_LOAD = Load(0.0, np.zeros(3), np.zeros(3), np.zeros(3))
seeds = st.integers(0, 2**32 - 1)
motions = st.sampled_from([GACHON, HALL, replace(GACHON, jerk=0.05), replace(HALL, jerk=300.0)])


def _sampled(path: Curve, law: TimeLaw, count: int = 3000) -> tuple[np.ndarray, np.ndarray]:
    times = np.linspace(0.0, law.duration, count)
    return times, np.array([law.at(float(t)) for t in times])


def _largest(values: np.ndarray, order: int, step: float) -> float:
    """Largest derivative of positions by time, by differences."""
    return float(np.linalg.norm(np.diff(values, order, axis=0), axis=1).max()) / step**order


def _route(seed: int, motion: Motion, rotated: bool) -> tuple[Curve, TimeLaw]:
    path = rounded(random_route(seed, rotated), motion.blend_tolerance, WEIGHT, always)
    return path, time_law(path, motion)


@given(seed=seeds, motion=motions, rotated=st.booleans())
@settings(max_examples=25)
def test_speed_acceleration_and_jerk_in_space_keep_their_limits(seed, motion, rotated):
    """Differences of the executed positions, which include curvature, not only path speed."""
    path, law = _route(seed, motion, rotated)
    step = law.duration / 4000
    times = np.linspace(0.0, law.duration, 4001)
    positions, _ = path.at(np.array([law.at(float(t))[0] for t in times]))
    assert _largest(positions, 1, step) <= motion.speed * (1.0 + 1e-6)
    assert _largest(positions, 2, step) <= motion.acceleration * 1.001
    # Third differences of a curve that is cubic piece by piece: 3 %.
    rounding = 1e-15 / step**3
    assert _largest(positions, 3, step) <= motion.jerk * 1.03 + rounding


@given(seed=seeds, motion=motions, rotated=st.booleans())
@settings(max_examples=25)
def test_platform_and_payload_need_no_larger_wrench_than_the_check_asks_for(seed, motion, rotated):
    """Differences of point masses' executed positions, without the share of a feed hold."""
    path, law = _route(seed, motion, rotated)
    rng = np.random.default_rng(seed)
    rig = load_rig(Path(__file__).parents[2] / "configs" / "gachon_8_6.yaml")
    anchors = rig.anchors * WEIGHT / rms_anchor_radius(rig.anchors)
    rig = replace(rig, motion=motion, mass=5.0, anchors=anchors)
    corners = rig.platform_corners
    shares = rng.dirichlet(np.ones(len(corners)))
    rig = replace(rig, centre_of_mass=shares @ corners)
    load = replace(NO_LOAD, payload_mass=3.0, payload_centre=rng.uniform(-0.2, 0.2, 3))
    step = law.duration / 4000
    poses = path.at(np.array([law.at(float(t))[0] for t in np.linspace(0.0, law.duration, 4001)]))
    points = np.vstack([corners, load.payload_centre])
    arms = np.einsum("nij,kj->nki", poses[1], points)
    forces = np.append(5.0 * shares, 3.0)[:, None] * np.diff(arms + poses[0][:, None], 2, axis=0)
    moments = np.cross(arms[1:-1], forces).sum(axis=1) / WEIGHT
    wrenches = np.hstack([forces.sum(axis=1), moments]) / step**2
    needed = float(np.linalg.norm(wrenches, axis=1).max())
    assert needed <= 1.001 * inertial_wrench(rig, load, turns=rotated) / RATE_CHANGES


@given(seed=seeds, motion=motions)
@settings(max_examples=25)
def test_it_goes_forward_from_rest_to_rest_and_tells_its_speed(seed, motion):
    path, law = _route(seed, motion, rotated=True)
    times, (travelled, speed, acceleration) = (lambda t, v: (t, v.T))(*_sampled(path, law))
    assert (np.diff(travelled) >= 0.0).all()
    assert travelled[[0, -1]] == pytest.approx([0.0, path.length], abs=1e-12)
    assert speed[[0, -1]] == pytest.approx([0.0, 0.0], abs=1e-9)
    assert (speed >= 0.0).all()
    assert np.abs(acceleration).max() <= motion.acceleration * (1.0 + 1e-9)
    middle = np.diff(travelled) / np.diff(times)
    assert middle == pytest.approx((speed[:-1] + speed[1:]) / 2, abs=0.01 * motion.speed)


@given(length=st.floats(1e-6, 0.1), motion=motions)
@settings(max_examples=30)
def test_a_smooth_step_keeps_all_limits_and_reaches_one_of_them(length, motion):
    count = 4000
    step = smooth_step_duration(length, motion) / count
    travelled = length * np.array([[smooth_step(n / count)] for n in range(count + 1)])
    limits = (motion.speed, motion.acceleration, motion.jerk)
    used = [_largest(travelled, n, step) / limit for n, limit in enumerate(limits, start=1)]
    assert 0.995 <= max(used) <= 1.0 + 1e-6, "differences average the peaks"


def test_it_is_at_rest_outside_its_time():
    path = polyline([at_mm(0, 0, 0), at_mm(30, 0, 0)], WEIGHT)
    law = time_law(path, GACHON)
    assert law.at(-1.0) == (0.0, 0.0, 0.0)
    assert law.at(law.duration + 1.0) == (path.length, 0.0, 0.0)


def test_a_straight_path_takes_the_textbook_time():
    """At v = 20 mm/s, a = 100 mm/s², j = 1000 mm/s³: length/v + v/a + a/j."""
    law = time_law(polyline([at_mm(0, 0, 0), at_mm(0, 300, 0)], WEIGHT), GACHON)
    assert law.duration == pytest.approx(0.3 / 0.02 + 0.02 / 0.1 + 0.1 / 1.0, rel=1e-9)


def test_a_path_too_short_for_its_speed_takes_the_textbook_time():
    """Jerk-limited throughout: four equal times t with length = 2 j t³."""
    law = time_law(polyline([at_mm(0, 0, 0), at_mm(0.01, 0, 0)], WEIGHT), GACHON)
    assert law.duration == pytest.approx(4.0 * (1e-5 / 2.0 / 1.0) ** (1 / 3), rel=1e-9)


def test_it_stops_at_a_sharp_corner_and_only_there():
    waypoints = [at_mm(0, 0, 0), at_mm(50, 0, 0), at_mm(50, 50, 0), at_mm(100, 50, 0)]

    def not_the_first(poses: list[Pose]) -> bool:
        return poses[0].distance_to(waypoints[1]) > 0.02

    path = rounded(waypoints, 0.001, WEIGHT, not_the_first)
    law = time_law(path, GACHON)
    assert [s.straight for s in path.segments] == [True, True, False, True]
    assert law.at(float(law.starts[1]))[1:] == pytest.approx((0.0, 0.0), abs=1e-6)
    assert law.at(float(law.starts[2]))[1] > 0.005


@given(seed=seeds)
@settings(max_examples=30)
def test_a_corner_is_passed_at_one_speed_as_high_as_its_bend_allows(seed):
    waypoints = random_route(seed, count=3, sharpest_deg=100.0)
    path = rounded(waypoints, 0.001, WEIGHT, always)
    law = time_law(path, GACHON)
    inside = np.linspace(law.starts[1], law.starts[2], 9)
    speeds = np.array([law.at(float(t))[1] for t in inside])
    assert speeds == pytest.approx(np.full(9, speeds[0]), rel=1e-6)
    bend, change = path.segments[1].bends
    shorter = min(path.segments[0].length, path.segments[2].length)
    needed = length_to_change(0.0, speeds[0], GACHON) / shorter
    shares = [speeds[0] / 0.02, speeds[0] ** 2 * bend / 0.1, speeds[0] ** 3 * change, needed]
    assert max(shares) == pytest.approx(1.0, rel=1e-6)


@given(seed=seeds)
@settings(max_examples=40)
def test_rounding_never_costs_more_than_stopping_and_comes_near_the_least_time(seed):
    """Between length / speed, the lower bound, and the time of the sharp path."""
    waypoints = random_route(seed, count=5)
    path = rounded(waypoints, 0.001, WEIGHT, always)
    duration = time_law(path, GACHON).duration
    stopping = time_law(polyline(waypoints, WEIGHT), GACHON).duration
    # At 105° a rounded corner may take a few hundredths of a second more than a stop.
    assert path.length / 0.02 < duration <= stopping + 0.05
    # Each stop costs v/a + a/j = 0.3 s; so do the ends together, and no corner costs more.
    assert duration <= path.length / 0.02 + 0.3 + 0.4 * (len(waypoints) - 2)


@given(exponent=st.floats(-8.5, -3.0), seed=seeds)
@settings(max_examples=60)
def test_very_short_moves_between_long_ones_have_a_time_law(exponent, seed):
    rng = np.random.default_rng(seed)
    tiny = rng.normal(size=3)
    tiny *= 10.0**exponent / np.linalg.norm(tiny)
    points = [np.zeros(3), np.array([0.1, 0, 0]), np.array([0.1, 0, 0]) + tiny, np.full(3, 0.2)]
    waypoints = [at_mm(*(1000.0 * point)) for point in points]
    path = rounded(waypoints, 0.001, WEIGHT, always)
    law = time_law(path, GACHON)
    _, values = _sampled(path, law, 2000)
    assert (np.diff(values[:, 0]) >= 0.0).all()
    assert law.duration < path.length / 0.02 + 4.0


def test_a_tight_bend_is_passed_slowly_and_within_the_limits():
    waypoints = [at_mm(0, 0, 0), at_mm(50, 0, 0), at_mm(50, 50, 0)]
    path = rounded(waypoints, 1e-6, WEIGHT, always)
    law = time_law(path, GACHON)
    bend, change = path.segments[1].bends
    speed = law.at(float(law.starts[1]))[1]
    assert bend > 1e5
    assert speed**2 * bend <= 0.1 * (1 + 1e-9)
    assert speed**3 * change <= 1.0 * (1 + 1e-9)


def test_a_path_without_length_takes_no_time():
    pose = at_mm(1, 2, 3)
    law = time_law(polyline([pose, pose], WEIGHT), GACHON)
    assert law.duration == 0.0
    assert law.at(0.0) == (0.0, 0.0, 0.0)


@given(
    start=st.floats(0.0, 0.02),
    end=st.floats(0.0, 0.02),
    extra=st.one_of(st.just(0.0), st.floats(0.0, 0.2)),
)
def test_one_move_covers_its_length_forward_also_where_it_just_suffices(start, end, extra):
    """With exactly the length of the change of speed, there is no cruise."""
    slow, fast = min(start, end), max(start, end)
    length = length_to_change(slow, fast, GACHON) + extra
    curve = s_curve(length, (start, end), 0.02, GACHON)
    times = np.linspace(0.0, curve.duration, 400)
    travelled, speed, acceleration = np.array([curve.at(float(t)) for t in times]).T
    assert (np.diff(travelled) >= 0.0).all()
    assert travelled[[0, -1]] == pytest.approx([0.0, length], abs=1e-15)
    assert speed[[0, -1]] == pytest.approx([start, end], abs=1e-9)
    assert speed.max() <= 0.02 * (1 + 1e-9)
    assert np.abs(acceleration).max() <= 0.1 * (1 + 1e-9)
    if length > 1e-9:  # the state at the end is the one that the phases add up to
        before = curve.at(curve.duration * (1.0 - 1e-12))
        assert before == pytest.approx((length, end, 0.0), abs=1e-6)


@given(
    start=st.floats(0.0, 0.02),
    end=st.floats(0.0, 0.02),
    extra=st.floats(1e-6, 0.2),
    cut=st.floats(0.5, 0.999),
)
def test_no_lower_peak_is_faster(start, end, extra, cut):
    """The peak is the largest that fits, so any smaller cap takes at least as long."""
    length = length_to_change(min(start, end), max(start, end), GACHON) + extra
    best = s_curve(length, (start, end), 0.02, GACHON)
    lower = max(start, end, 0.02 * cut)
    assert best.duration <= s_curve(length, (start, end), lower, GACHON).duration + 1e-12


def test_a_length_that_does_not_suffice_is_a_fault_not_a_jump():
    needed = length_to_change(0.0, 0.02, GACHON)
    with pytest.raises(Fault, match="do not suffice"):
        s_curve(0.99 * needed, (0.0, 0.02), 0.02, GACHON)
    with pytest.raises(Fault, match="do not suffice"):
        s_curve(0.001, (0.0, 0.0), 0.0, GACHON)
