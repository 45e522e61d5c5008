"""Values written to a drive on which the stop rules depend."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.cia402.object_dictionary import heartbeat_consumers, settings_for
from drivers.cia402.profile import interpolation_time
from drivers.plausibility import position_limits
from model.errors import BadInput
from model.kinematics import cable_lengths
from model.pose import Pose, matrix_from_rotation_vector
from model.rig import Rig
from model.winches import WinchMap


def final_values(rig: Rig, drive: int) -> dict[tuple[int, int], int]:
    return {(s.index, s.sub): s.value for s in settings_for(rig, drive, WinchMap(rig))}


def test_stops_end_in_holding_and_time_outs_are_armed(rig: Rig) -> None:
    values = final_values(rig, 2)
    assert values[0x6007, 0] == 3  # bus lost: quick stop
    assert values[0x605C, 0] == 1  # disable operation: ramp, then torque off
    assert values[0x605A, 0] == 6  # quick stop: ramp, then hold
    assert values[0x6060, 0] == 8  # cyclic synchronous position
    assert (values[0x60C2, 1], values[0x60C2, 2]) == (10, -3)
    assert values[0x1006, 0] == 10_000
    assert values[0x1400, 5] == 0, "off: it would stop a drive that the next frame enables again"
    assert 0 < values[0x1017, 0] <= 30
    assert values[0x6072, 0] == 1200  # 100 N at rated torque, 100 N allowed, a fifth in reserve
    window_mm = values[0x6065, 0] / rig.winches[2].counts_per_metre * 1000.0
    assert window_mm == pytest.approx(rig.document.motion.following_error_mm, abs=0.01)


def test_set_points_are_six_bytes_and_replies_eight_at_each_sync(rig: Rig) -> None:
    values = final_values(rig, 2)
    for parameters, mapping, identifier, size in (
        (0x1400, 0x1600, 0x203, 48),
        (0x1800, 0x1A00, 0x183, 64),
    ):
        assert values[parameters, 1] & 0xBFFFFFFF == identifier
        assert values[parameters, 2] == 1
        count = values[mapping, 0]
        assert sum(values[mapping, sub] & 0xFF for sub in range(1, count + 1)) == size
    assert values[0x1800, 3] == 0  # no inhibit time


def test_master_is_watched_first_then_the_peers_as_far_as_there_is_room(rig: Rig) -> None:
    *cleared, _, _, _, _, _, _, _, _ = all_entries = heartbeat_consumers(rig, 0, 8)
    assert [(s.sub, s.value) for s in cleared] == [(sub, 0) for sub in range(1, 9)]
    nodes = [setting.value >> 16 for setting in all_entries[8:]]
    assert nodes == [127, 2, 3, 4, 5, 6, 7, 8]
    assert {setting.value & 0xFFFF for setting in all_entries[8:]} == {100}
    assert [s.value >> 16 for s in heartbeat_consumers(rig, 0, 1)] == [0, 127]
    more = heartbeat_consumers(rig, 0, 10)
    assert [(s.sub, s.transient) for s in more if s.value == 0][-2:] == [(9, False), (10, False)]


@given(value=st.integers(1, 255), exponent=st.integers(-6, -3))
def test_interpolation_time_is_the_cycle(value: int, exponent: int) -> None:
    cycle = value * 10.0**exponent
    found, power = interpolation_time(cycle)
    assert found * 10.0**power == pytest.approx(cycle, rel=1e-9)
    assert 0 < found <= 255


def test_a_cycle_that_60c2_cannot_hold_is_refused() -> None:
    with pytest.raises(BadInput, match="interpolate"):
        interpolation_time(1.0 / 300.0)


@given(
    fraction=st.tuples(*[st.floats(0, 1)] * 3),
    turn=st.tuples(*[st.floats(-0.5, 0.5)] * 3),
    pulleys=st.booleans(),
)
def test_software_limits_hold_every_pose_of_the_workspace(
    rig: Rig, pulley_rig: Rig, fraction: tuple[float, ...], turn: tuple[float, ...], pulleys: bool
) -> None:
    robot = pulley_rig if pulleys else rig
    span = robot.workspace_upper - robot.workspace_lower
    pose = Pose(
        robot.workspace_lower + np.array(fraction) * span, matrix_from_rotation_vector(turn)
    )
    winch_map = WinchMap(robot)
    counts = winch_map.counts(winch_map.unstrained(cable_lengths(robot, pose), robot.max_tension))
    for drive in (0, robot.cable_count - 1):
        low, high = position_limits(robot, drive, winch_map)
        assert low <= counts[drive] <= high
        assert -(2**31) <= low < high < 2**31
