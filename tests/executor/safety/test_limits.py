"""Limits of gate and monitors, against values computed by hand from the rig file."""

from __future__ import annotations

import math

import numpy as np
import pytest

from executor.safety.limits import gate_limits, monitor_limits, stuck_limits, tension_limits
from executor.safety.monitor import Monitor, Observation
from executor.safety.stall import StuckLimits
from executor.safety.sync_timeout import SyncAge
from model.rig import load_rig, rig_from_document
from tests.cli.plans import CONFIGS, HALL, RIG

ODRIVE_RIG = CONFIGS / "gachon_8_6_odrive.yaml"

PER_MM = 131072 / 206.06
"""Counts a millimetre of cable of the paper's rig."""


def test_tensions_of_the_papers_rig():
    assert tension_limits(load_rig(RIG)) == pytest.approx((2.5, 102.0))


def test_the_watch_judges_by_the_rig_file():
    rig = load_rig(RIG)
    limits = monitor_limits(rig, SyncAge())
    assert limits.following_error == rig.motion.following_error == pytest.approx(0.002)
    assert (limits.min_tension, limits.max_tension) == tension_limits(rig)
    assert limits.no_tension == pytest.approx(0.5)


@pytest.mark.parametrize(("timeout", "gone"), [(3.0, 1.5), (1.5, 0.25), (2.0, 0.5), (5.0, 3.5)])
def test_lateness_counts_from_one_period_after_the_last_sync(timeout, gone):
    """A cycle that begins L periods late finds a SYNC that is 1 + L periods old."""
    assert monitor_limits(load_rig(RIG), SyncAge(timeout)).gone_periods == pytest.approx(gone)


def test_where_cables_may_hang_slack_the_watch_says_nothing_of_it():
    rig = load_rig(RIG)
    limits = monitor_limits(rig, SyncAge(), slack_counts=False)
    assert limits.max_tension == tension_limits(rig)[1]
    watch = Monitor.fresh(limits, ["a", "b"])

    def found(tension: float) -> set[str]:
        now = watch
        for _ in range(10):
            seen = Observation(True, [0.0] * 2, [tension, 20.0], [False] * 2, [], 0.0)
            now, alarms = now.update(seen)
        return {alarm.code for alarm in alarms}

    assert found(0.0) == found(-1.0) == set()
    assert found(103.0) == {"over_tension"}
    assert "cable_loose" in found(float("nan"))


def test_how_long_a_drive_may_stall_is_in_the_rig_file():
    rig = load_rig(RIG)
    assert math.ceil(0.07 * PER_MM) == 45
    assert stuck_limits(rig, 0.01) == (StuckLimits(pytest.approx(0.02 * PER_MM), travel=45),) * 8
    assert stuck_limits(rig, 0.02) == (StuckLimits(pytest.approx(0.04 * PER_MM), travel=45),) * 8
    motion = rig.document.motion.model_copy(
        update={"stuck_travel_mm": 0.43, "stuck_speed_mm_s": 3.0}
    )
    noisy = rig_from_document(rig.document.model_copy(update={"motion": motion}))
    assert stuck_limits(noisy, 0.01) == (StuckLimits(pytest.approx(0.03 * PER_MM), travel=274),) * 8


def test_only_odrives_disarm_before_they_report_it():
    assert monitor_limits(load_rig(ODRIVE_RIG), SyncAge()).may_disarm
    assert not monitor_limits(load_rig(RIG), SyncAge()).may_disarm


@pytest.mark.parametrize(
    ("estimates_ms", "period"), [(1, 1), (10, 1), (19, 1), (29.98, 2), (30, 3), (50, 5)]
)
def test_a_stalled_odrive_is_judged_from_position_to_position(estimates_ms, period):
    """Slower set-points than 2 mm/s are not judged, whatever time lies between two of them."""
    rig = load_rig(ODRIVE_RIG)
    drives = rig.document.drives.model_copy(update={"estimates_ms": estimates_ms})
    rare = rig_from_document(rig.document.model_copy(update={"drives": drives}))
    least = pytest.approx(7.95, abs=0.01)
    assert stuck_limits(rare, 0.01) == (StuckLimits(least, 28, period),) * 8


def test_counts_that_fall_when_cable_is_paid_out_have_the_same_limits():
    rig = load_rig(RIG)
    winches = [w.model_copy(update={"direction": -w.direction}) for w in rig.document.winches]
    mirrored = rig_from_document(rig.document.model_copy(update={"winches": winches}))
    rows = np.array([[0] * 8, [1000] * 8], dtype=np.int32)
    assert stuck_limits(mirrored, 0.01) == stuck_limits(rig, 0.01)
    assert gate_limits(mirrored, rows, 0.01) == gate_limits(rig, rows, 0.01)


def test_rounding_to_counts_is_never_a_stalled_drive():
    rig = load_rig(RIG)
    coarse = rig.document.model_copy(
        update={
            "winches": [w.model_copy(update={"counts_per_rev": 100}) for w in rig.document.winches]
        }
    )
    assert stuck_limits(rig_from_document(coarse), 0.01) == (StuckLimits(2, 3),) * 8


def test_the_gate_of_the_papers_rig():
    rig = load_rig(RIG)
    rows = np.array([[0] * 8, [1000] * 8, [-500] * 8], dtype=np.int32)
    rows[1, 3] = 2000
    limits = gate_limits(rig, rows, 0.01)
    margin = int(np.ceil(1000.0 * rig.motion.start_tolerance * PER_MM))
    step = int(1.0 * PER_MM) + 1  # 100 mm/s for 10 ms
    assert limits.lowest == (-500 - margin,) * 8
    assert limits.highest == (*[1000 + margin] * 3, 2000 + margin, *[1000 + margin] * 4)
    assert limits.largest_step == (step,) * 8
    assert limits.largest_lag == (int(2.0 * PER_MM) + 2 * step,) * 8


def test_rows_at_the_ends_of_32_bits_do_not_wrap():
    rows = np.array([[2**31 - 1] * 8, [-(2**31)] * 8], dtype=np.int32)
    limits = gate_limits(load_rig(RIG), rows, 0.01)
    assert min(limits.highest) > 2**31 - 1
    assert max(limits.lowest) < -(2**31)


def test_every_drive_has_limits_of_its_own_winch():
    rig = load_rig(HALL)
    assert len(stuck_limits(rig, 0.01)) == len(rig.winches) == 10
