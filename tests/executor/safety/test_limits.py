"""The limits that gate and watches judge by, against numbers computed by hand from the rig file."""

from __future__ import annotations

import numpy as np
import pytest

from cdpr.rig import load_rig
from executor.safety.limits import gate_limits, least_steps, tension_limits, watch_limits
from executor.safety.watch import Observation, Watch
from tests.cli.plans import HALL, RIG

PER_MM = 131072 / 206.06
"""Counts a millimetre of cable of the paper's rig."""


def test_tensions_of_the_papers_rig():
    assert tension_limits(load_rig(RIG)) == pytest.approx((2.5, 102.0))


def test_the_watch_judges_by_the_rig_file():
    rig = load_rig(RIG)
    limits = watch_limits(rig)
    assert limits.following_error == rig.motion.following_error == pytest.approx(0.002)
    assert (limits.min_tension, limits.max_tension) == tension_limits(rig)
    assert limits.no_tension == pytest.approx(0.5)


def test_where_cables_may_hang_slack_the_watch_says_nothing_of_it():
    rig = load_rig(RIG)
    limits = watch_limits(rig, slack_counts=False)
    assert limits.max_tension == tension_limits(rig)[1]
    watch = Watch.fresh(limits, ["a", "b"])

    def found(tension: float) -> set[str]:
        now = watch
        for _ in range(10):
            seen = Observation(True, [0.0] * 2, [tension, 20.0], [False] * 2, [], 0.0)
            now, findings = now.look(seen)
        return {finding.code for finding in findings}

    assert found(0.0) == found(-1.0) == set()
    assert found(103.0) == {"over_tension"}
    assert "cable_loose" in found(float("nan"))


def test_a_step_that_counts_is_a_hundredth_of_the_following_error():
    assert least_steps(load_rig(RIG)) == (13,) * 8
    assert np.ceil(0.02 * PER_MM) == 13


def test_one_count_is_never_a_step():
    rig = load_rig(RIG)
    coarse = rig.document.model_copy(
        update={
            "winches": [w.model_copy(update={"counts_per_rev": 100}) for w in rig.document.winches]
        }
    )
    from cdpr.rig import rig_from_document

    assert least_steps(rig_from_document(coarse)) == (2,) * 8


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
    assert len(least_steps(rig)) == len(rig.winches) == 10
