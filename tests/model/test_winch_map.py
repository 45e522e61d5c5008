"""From cable lengths to drive counts: home, directions, stretch, and back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.kinematics import cable_lengths, structure_matrix
from model.pose import Pose
from model.rig import Rig
from model.statics.gravity import weight_wrench, working_tensions
from model.winches import WinchMap
from tests.model.rig_builds import hall_data, paper_data, poses_of, rig_of


def with_home_counts() -> Rig:
    data = paper_data()
    for number, winch in enumerate(data["winches"]):
        winch["home_counts"] = 1000 * number - 3500
        winch["direction"] = -1 if number % 2 else 1
    return rig_of(data)


def with_other_cables() -> Rig:
    data = paper_data()
    for number, winch in enumerate(data["winches"][1:], start=1):
        winch["cable_stiffness_n"] = 5000.0 * number
    return rig_of(data)


RIGS = {
    "paper": with_home_counts(),
    "ten cables": rig_of(hall_data()),
    "cables that differ": with_other_cables(),
}
MAPS = {name: WinchMap(rig) for name, rig in RIGS.items()}
each = pytest.mark.parametrize("name", RIGS)


@each
def test_at_home_under_working_tensions_each_drive_is_at_its_home_counts(name: str) -> None:
    rig, winches = RIGS[name], MAPS[name]
    tensions = working_tensions(rig, rig.home).tensions
    unstrained = winches.unstrained(cable_lengths(rig, rig.home), tensions)
    expected = [w.home_counts for w in rig.winches]
    np.testing.assert_allclose(winches.counts(unstrained), expected, atol=1e-6)


@each
@settings(max_examples=40)
@given(data=st.data())
def test_lengths_and_tensions_come_back_from_rounded_counts(name: str, data: st.DataObject) -> None:
    """To half a count of the drive."""
    rig, winches = RIGS[name], MAPS[name]
    pose = data.draw(poses_of(rig, 5.0))
    share = np.array(data.draw(st.lists(st.floats(0, 1), min_size=10, max_size=10)))
    tensions = share[: rig.cable_count] * rig.max_tension
    lengths = cable_lengths(rig, pose)
    counts = np.round(winches.counts(winches.unstrained(lengths, tensions)))
    back = winches.strained(winches.unstrained_from_counts(counts), tensions)
    half = 0.51 * (1.0 + rig.max_tension / rig.cable_stiffness)
    half_count = half / np.abs([w.counts_per_metre for w in rig.winches])
    assert np.all(np.abs(back - lengths) <= half_count)


def test_each_winch_may_have_its_own_cable_stiffness() -> None:
    found, of_all = RIGS["cables that differ"].cable_stiffness, RIGS["paper"].cable_stiffness
    assert found.tolist() == [of_all[0], *(5000.0 * np.arange(1, len(found)))]


@each
def test_more_tension_means_less_cable_paid_out(name: str) -> None:
    """A stretched cable of the same length has less material; `direction` gives the sign."""
    rig, winches = RIGS[name], MAPS[name]
    lengths = cable_lengths(rig, rig.home)
    slack = winches.unstrained(lengths, np.full(rig.cable_count, rig.min_tension))
    taut = winches.unstrained(lengths, np.full(rig.cable_count, rig.max_tension))
    assert np.all(taut < slack)
    moved = winches.counts(taut) - winches.counts(slack)
    assert np.all(moved * np.sign([w.counts_per_metre for w in rig.winches]) < 0.0)


@each
def test_the_stretch_is_hookes(name: str) -> None:
    """ΔL = t L0 / EA, over the cable behind the outlet too."""
    rig, winches = RIGS[name], MAPS[name]
    behind = np.array([w.drum_to_outlet for w in rig.winches])
    unstrained = np.linspace(1.0, 3.0, rig.cable_count) + behind
    tensions = np.linspace(rig.min_tension, rig.max_tension, rig.cable_count)
    stretch = winches.strained(unstrained, tensions) - (unstrained - behind)
    np.testing.assert_allclose(stretch, tensions * unstrained / rig.cable_stiffness, rtol=1e-9)


def twelve_soft_cables() -> Rig:
    """A small platform, so that lengths fit poses of almost any orientation about as well."""
    rng, data = np.random.default_rng(1), hall_data()
    corners = np.array([[sx, sy] for sx in (-1.0, 1.0) for sy in (-1.0, 1.0)])
    outlets = [[2000 * x, 1500 * y, z] for z in (2600, 100, 1300) for x, y in corners]
    anchors = [[*(100 * corner), z] for z in (-50, 50, 0) for corner in corners]
    data["outlets_mm"] = (np.array(outlets) + rng.uniform(-50, 50, (12, 3))).tolist()
    data["anchors_mm"] = (np.array(anchors) + rng.uniform(-33, 33, (12, 3))).tolist()
    data["winches"] = [data["winches"][0] | {"node_id": number} for number in range(1, 13)]
    data["cables"] |= {"stiffness_n": 2e4, "max_tension_n": 3000}
    del data["pulleys"]
    return rig_of(data)


def test_counts_of_soft_cables_give_the_pose_back_over_the_whole_workspace() -> None:
    """Stretched as at home their lengths contradict each other by millimetres."""
    rig = twelve_soft_cables()
    winches, rng = WinchMap(rig), np.random.default_rng(1)
    span = rig.workspace_upper - rig.workspace_lower
    for share in rng.uniform(0.05, 0.95, (8, 3)):
        pose = Pose.level(rig.workspace_lower + share * span)
        found = winches.equilibrium(winches.unstrained_from_counts(winches.counts_at(pose)))
        assert found.distance_to(pose) < 1e-5


@each
def test_a_turn_of_the_drum_pays_out_its_circumference(name: str) -> None:
    rig, winches = RIGS[name], MAPS[name]
    for number, winch in enumerate(rig.document.winches):
        one_turn = np.zeros(rig.cable_count)
        one_turn[number] = winch.direction * winch.counts_per_rev * winch.gear_ratio
        counts = np.array([w.home_counts for w in rig.winches]) + one_turn
        paid = winches.unstrained_from_counts(counts) - winches.home_unstrained
        expected = np.zeros(rig.cable_count)
        expected[number] = winch.drum_mm_per_rev / 1000.0
        np.testing.assert_allclose(paid, expected, atol=1e-12)


@each
def test_whole_trajectories_map_like_single_poses(name: str) -> None:
    rig, winches = RIGS[name], MAPS[name]
    lengths = cable_lengths(rig, rig.home) + np.array([[0.0], [0.1], [-0.1]])
    tensions = np.full_like(lengths, rig.min_tension)
    together = winches.counts(winches.unstrained(lengths, tensions))
    for row, length, tension in zip(together, lengths, tensions, strict=True):
        expected = winches.counts(winches.unstrained(length, tension))
        np.testing.assert_allclose(row, expected, rtol=1e-14)


@each
@settings(max_examples=25)
@given(data=st.data())
def test_working_tensions_hold_the_weight_within_the_limits(name: str, data: st.DataObject) -> None:
    rig = RIGS[name]
    pose = data.draw(poses_of(rig, 0.0))
    tensions = working_tensions(rig, pose).tensions
    balance = structure_matrix(rig, pose) @ tensions + weight_wrench(rig, pose)
    np.testing.assert_allclose(balance, 0.0, atol=1e-6)
    assert np.all(tensions >= rig.min_tension - 1e-9)
    assert np.all(tensions <= rig.max_tension + 1e-9)


def test_the_weight_of_a_payload_off_centre_rotates_the_platform() -> None:
    """A payload on +x pulls down: a moment about +y, whatever the position."""
    from model.scene import Load

    rig = RIGS["paper"]
    load = Load(2.0, np.array([0.1, 0.0, 0.0]), np.zeros(3), np.zeros(3))
    wrench = weight_wrench(rig, Pose.level([0.1, 0.1, 0.4]), load)
    np.testing.assert_allclose(wrench[:3], [0.0, 0.0, -(0.4 + 2.0) * 9.80665])
    np.testing.assert_allclose(wrench[3:], [0.0, 0.1 * 2.0 * 9.80665, 0.0], atol=1e-12)
