"""Cables at point exits and swivelling pulleys: geometry, limits and rates."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.kinematics import NoCable, cable_lengths, cables_at, cables_to, structure_matrix
from model.pose import Pose, matrix_from_rotation_vector
from model.rig import Rig
from tests.model.rig_builds import hall_rig, paper_rig, paper_rig_with_pulleys, poses_of

PAPER, PULLEYS, HALL = paper_rig(), paper_rig_with_pulleys(13.0), hall_rig()
RIGS = {"point exits": PAPER, "13 mm pulleys": PULLEYS, "ten cables": HALL}
poses_of_any = st.sampled_from(list(RIGS.values())).flatmap(
    lambda rig: st.tuples(st.just(rig), poses_of(rig))
)


@given(poses_of_any)
def test_directions_are_unit_and_lead_from_anchor_to_exit(case: tuple[Rig, Pose]) -> None:
    rig, pose = case
    cables = cables_at(rig, pose)
    np.testing.assert_allclose(cables.anchors, pose.apply(rig.anchors), atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(cables.directions, axis=1), 1.0, atol=1e-12)
    straight = np.linalg.norm(cables.exits - cables.anchors, axis=1)
    reached = cables.anchors + straight[:, None] * cables.directions
    np.testing.assert_allclose(reached, cables.exits, atol=1e-12)


@given(poses_of(PULLEYS))
def test_a_cable_leaves_its_pulley_on_the_rim_and_along_the_tangent(pose: Pose) -> None:
    """The pulley is rebuilt here from outlet, feed and anchor: its plane holds all three."""
    rig, cables = PULLEYS, cables_at(PULLEYS, pose)
    for i in range(rig.cable_count):
        k, outlet = rig.feed_directions[i], rig.outlets[i]
        normal = np.cross(k, cables.anchors[i] - outlet)
        normal /= np.linalg.norm(normal)
        swivel = np.cross(normal, k)
        centre = outlet + rig.pulley_radius * swivel
        spoke = cables.exits[i] - centre
        assert np.linalg.norm(spoke) == pytest.approx(rig.pulley_radius, abs=1e-12)
        assert abs(spoke @ cables.directions[i]) < 1e-12  # tangent
        assert abs(spoke @ normal) < 1e-12  # in the pulley's plane
        # Travel along the rim continues in the sense in which the cable came in: at the outlet the
        # spoke is −swivel and the travel k; at the exit the travel is toward the anchor.
        entering = np.cross(-swivel, k)
        leaving = np.cross(spoke, -cables.directions[i])
        assert entering @ leaving > 0.0


@given(poses_of(PULLEYS))
def test_length_is_the_straight_part_and_the_arc_from_outlet_to_exit(pose: Pose) -> None:
    """The arc is measured here by walking the rim in steps from the outlet to the exit."""
    rig, cables = PULLEYS, cables_at(PULLEYS, pose)
    for i in range(rig.cable_count):
        k, outlet = rig.feed_directions[i], rig.outlets[i]
        along = cables.anchors[i] - outlet
        swivel = along - (along @ k) * k
        swivel /= np.linalg.norm(swivel)
        angles = np.linspace(0.0, 2.0 * np.pi, 20001)
        rim = outlet + rig.pulley_radius * (
            (1.0 - np.cos(angles))[:, None] * swivel + np.sin(angles)[:, None] * k
        )
        walked = angles[np.argmin(np.linalg.norm(rim - cables.exits[i], axis=1))]
        straight = np.linalg.norm(cables.exits[i] - cables.anchors[i])
        expected = rig.pulley_radius * walked + straight
        assert cables.lengths[i] == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(
    ("anchor", "wrapped_deg"),
    [
        ([1.013, 0.0, -1.0], None),
        ([0.026, 0.0, -1.0], 180.0),  # straight back down on the far side: half a turn
        ([1.0, 0.0, 0.013], 90.0),  # straight out, level with the top of the rim: a quarter
        ([1e-9, 0.0, 1.0], 0.0),  # straight on: the pulley is hardly touched
    ],
)
def test_wrap_angles_follow_the_geometry(anchor: list[float], wrapped_deg: float | None) -> None:
    """One pulley of 13 mm at the origin, fed upwards."""
    rig = paper_rig_with_pulleys(13.0, feed=[0, 0, 1])
    anchors = rig.outlets + np.array(anchor)
    cables = cables_to(rig, anchors)
    straight = np.linalg.norm(cables.exits - anchors, axis=1)
    wrapped = np.degrees((cables.lengths - straight) / rig.pulley_radius)
    if wrapped_deg is None:
        assert np.all((wrapped > 90.0) & (wrapped < 180.0))
    else:
        np.testing.assert_allclose(wrapped, wrapped_deg, atol=1e-4)


@given(st.floats(0.02, 3.0), st.floats(-2.9, 1.4))
def test_the_wrapped_length_is_continuous(distance: float, elevation: float) -> None:
    """Around the pulley at any distance, a small step of the anchor is a small step of length."""
    rig = paper_rig_with_pulleys(5.0, feed=[0, 0, 1])
    step = 1e-6

    def length(angle: float) -> float:
        offset = [0.005 + distance * np.cos(angle), 0.0, distance * np.sin(angle)]
        if offset[0] <= 1e-4:  # behind the swivel axis the pulley itself turns round
            return np.nan
        return float(cables_to(rig, rig.outlets + np.array(offset)).lengths[0])

    before, after = length(elevation), length(elevation + step)
    assert np.isnan(before) or np.isnan(after) or abs(after - before) <= 1.01 * distance * step


@given(poses_of(PAPER))
def test_small_pulleys_become_point_exits(pose: Pose) -> None:
    at_points = cables_at(PAPER, pose)
    over_pulleys = cables_at(paper_rig_with_pulleys(1e-6), pose)
    np.testing.assert_allclose(over_pulleys.lengths, at_points.lengths, atol=1e-8)
    np.testing.assert_allclose(over_pulleys.exits, at_points.exits, atol=1e-8)
    np.testing.assert_allclose(over_pulleys.directions, at_points.directions, atol=1e-7)


@settings(max_examples=60)
@given(poses_of_any, st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6))
def test_lengths_change_at_minus_the_transposed_structure_matrix(
    case: tuple[Rig, Pose], twist: list[float]
) -> None:
    """Central differences; the pulleys swivel and wrap along."""
    (rig, pose), rate, h = case, np.array(twist), 1e-5

    def moved(time: float) -> Pose:
        turn = matrix_from_rotation_vector(time * rate[3:])
        return Pose(pose.position + time * rate[:3], turn @ pose.rotation)

    difference = (cable_lengths(rig, moved(h)) - cable_lengths(rig, moved(-h))) / (2.0 * h)
    np.testing.assert_allclose(difference, -structure_matrix(rig, pose).T @ rate, atol=2e-7)


@given(poses_of_any, st.lists(st.floats(0.0, 100.0), min_size=10, max_size=10))
def test_wrench_of_tensions_is_the_sum_of_forces_and_moments(
    case: tuple[Rig, Pose], given_tensions: list[float]
) -> None:
    rig, pose = case
    tensions = np.array(given_tensions[: rig.cable_count])
    cables = cables_at(rig, pose)
    force, moment = np.zeros(3), np.zeros(3)
    for t, u, b in zip(tensions, cables.directions, cables.anchors, strict=True):
        force += t * u
        moment += np.cross(b - pose.position, t * u)
    expected = np.concatenate([force, moment])
    np.testing.assert_allclose(structure_matrix(rig, pose) @ tensions, expected, atol=1e-9)


@pytest.mark.parametrize("name", RIGS)
def test_many_poses_at_once_are_the_same_as_one_by_one(name: str) -> None:
    rig = RIGS[name]
    rng = np.random.default_rng(5)
    poses = [
        Pose(
            rng.uniform(rig.workspace_lower, rig.workspace_upper),
            matrix_from_rotation_vector(0.2 * rng.normal(size=3)),
        )
        for _ in range(7)
    ]
    together = cables_to(rig, np.array([pose.apply(rig.anchors) for pose in poses]))
    for number, pose in enumerate(poses):
        alone = cables_at(rig, pose)
        for part in ("exits", "anchors", "directions", "lengths"):
            got = getattr(together, part)[number]
            np.testing.assert_allclose(got, getattr(alone, part), atol=1e-14)


@pytest.mark.parametrize(
    ("rig", "offset", "why"),
    [
        (PAPER, [0.0, 0.0, 0.0], "at its outlet"),
        (PULLEYS, [0.0, 0.0, 0.1], "swivel axis"),
        (PULLEYS, [0.013, 0.0, 0.005], "inside its pulley"),
        (PAPER, [np.nan, 0.0, 0.0], "cable 3"),
        (PULLEYS, [np.nan, 0.0, 0.0], "cable 3"),
    ],
)
def test_an_impossible_cable_is_refused_by_number(rig: Rig, offset: list[float], why: str) -> None:
    """Never a NaN direction, which would pass every comparison."""
    anchors = rig.home.apply(rig.anchors)
    anchors[2] = rig.outlets[2] + np.array(offset)
    with pytest.raises(NoCable, match=why) as caught:
        cables_to(rig, anchors)
    assert caught.value.values == {"cable": 3}
    assert caught.value.exit_code == 2
