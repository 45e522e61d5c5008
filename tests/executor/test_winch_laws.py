"""What winches are told without a path: bounded, in one direction, never more than can be seen."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from executor.control.winch_laws import CableStep, PretensionLaw, wind_in_speed
from executor.safety.monitor import StopReaction
from model.rig import load_rig
from tests.cli.plans import HALL, RIG

RIGS = [load_rig(RIG), load_rig(HALL)]


def per_metre(rig):
    return np.array([winch.counts_per_metre for winch in rig.winches])


@settings(max_examples=40, deadline=None)
@given(
    rig=st.sampled_from(RIGS),
    seed=st.integers(0, 10**6),
    paces=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=60),
)
def test_winding_in_never_pays_out_and_stays_in_its_reach(rig, seed, paces):
    random = np.random.default_rng(seed)
    begin = random.integers(-(10**6), 10**6, rig.cable_count).tolist()
    target, limit = 2.0 * rig.min_tension, 0.5 * rig.max_tension
    law = PretensionLaw(rig, begin, target=target, limit=limit, reach=1e-4, speed=0.002)
    most = wind_in_speed(rig, target, limit, 0.002) * 0.01
    before = np.array(begin, dtype=np.float64)
    for pace in paces:
        tensions = random.uniform(0.0, limit, rig.cable_count)
        targets, _ = law.next(pace, tensions.tolist())
        wound = -(np.array(targets) - before) / per_metre(rig)
        slop = 1.0 / np.abs(per_metre(rig))
        assert (wound >= -1e-12).all()
        assert (wound <= most + slop).all()
        total = -(np.array(targets) - begin) / per_metre(rig)
        assert (total <= 1e-4 + slop).all()
        before = np.array(targets, dtype=np.float64)


def test_a_taut_cable_is_wound_in_no_further_and_all_must_stay_taut():
    rig = RIGS[0]
    law = PretensionLaw(rig, [0] * 8, target=10.0, limit=60.0, reach=0.01, speed=0.002)
    slack = [12.0] * 8
    slack[3] = 0.0
    first, _ = law.next(1.0, slack)
    moved = [i for i, t in enumerate(first) if t]
    assert moved == [3]
    for _ in range(19):
        law.next(1.0, [12.0] * 8)
    assert not law.done
    law.next(1.0, [12.0] * 7 + [7.0])
    assert not law.done, "one went slack again"
    for _ in range(20):
        law.next(1.0, [12.0] * 8)
    assert law.done


def test_a_step_raises_no_tension_beyond_what_is_left_before_it_is_seen():
    for rig in RIGS:
        target, limit = 2.0 * rig.min_tension, 0.5 * rig.max_tension
        from model.winches import WinchMap

        stiffness = rig.cable_stiffness / WinchMap(rig).home_unstrained
        step = wind_in_speed(rig, target, limit, 1.0) * 0.01
        assert (2.0 * 2.0 * step * stiffness <= limit - target + 1e-9).all()


@pytest.mark.parametrize("wrong", [61.0, float("nan")])
def test_beyond_the_limit_no_winch_goes_on(wrong):
    rig = RIGS[0]
    for law in (
        PretensionLaw(rig, [0] * 8, target=10.0, limit=60.0, reach=0.05, speed=0.002),
        CableStep(rig, [0] * 8, cable=1, way=-0.02, limit=60.0, speed=0.005),
    ):
        for _ in range(200):
            begun, found = law.next(1.0, [0.0] * 8)
        assert found == ()
        assert any(begun)
        for _ in range(4):
            targets, found = law.next(1.0, [0.0] * 7 + [wrong])
            assert (targets, found) == (begun, ())
        targets, found = law.next(1.0, [0.0] * 7 + [wrong])
        assert targets == begun
        assert [(f.code, f.drive, f.reaction) for f in found] == [
            ("over_tension", 8, StopReaction.PATH_STOP)
        ]


def test_near_the_limit_all_go_on_more_slowly():
    rig, ways = RIGS[0], []
    for tension in (10.0, 35.0, 59.9):
        law = PretensionLaw(rig, [0] * 8, target=10.0, limit=60.0, reach=0.05, speed=0.002)
        targets, _ = law.next(1.0, [0.0] * 7 + [tension])
        for _ in range(99):
            targets, _ = law.next(1.0, [0.0] * 7 + [tension])
        ways.append(abs(targets[0]))
    assert ways[1] == pytest.approx(0.5 * ways[0], rel=0.01)
    assert ways[2] == pytest.approx(0.05 * ways[0], rel=0.05)


def test_a_cable_that_stays_slack_is_told():
    rig = RIGS[0]
    law = PretensionLaw(rig, [0] * 8, target=10.0, limit=60.0, reach=1e-5, speed=0.002)
    found = ()
    for _ in range(10):
        _, found = law.next(1.0, [12.0] * 7 + [0.3])
    (finding,) = found
    assert (finding.code, finding.reaction, finding.drive) == (
        "not_taut",
        StopReaction.PATH_STOP,
        8,
    )
    assert "0.3 N" in finding.text


@settings(max_examples=40, deadline=None)
@given(way=st.floats(-0.05, 0.05).filter(lambda w: abs(w) > 1e-4), speed=st.floats(1e-3, 0.02))
def test_one_cable_goes_its_way_smoothly_and_the_others_stand(way, speed):
    rig = RIGS[0]
    law = CableStep(rig, [7] * 8, cable=2, way=way, limit=60.0, speed=speed)
    sent = []
    while not law.done:
        targets, found = law.next(1.0, [0.0] * 8)
        sent.append(targets)
        assert found == ()
    rows = np.array(sent)
    assert (np.delete(rows, 2, axis=1) == 7).all()
    assert rows[-1, 2] == 7 + round(way * rig.winches[2].counts_per_metre)
    steps = np.abs(np.diff(rows[:, 2])) / per_metre(rig)[2]
    assert steps.max(initial=0.0) <= speed * 0.01 * 1.001 + 1.0 / per_metre(rig)[2]


def test_a_taut_cable_is_moved_as_carefully_as_it_would_be_wound_in():
    rig = RIGS[0]
    slow = CableStep(rig, [0] * 8, cable=2, way=-0.01, limit=60.0, speed=0.02)
    quick = CableStep(rig, [0] * 8, cable=2, way=-0.01, limit=60.0, speed=0.02)
    for _ in range(20):
        slow.next(1.0, [20.0] * 8)
        quick.next(1.0, [0.0] * 8)
    assert slow.progress < 0.1 * quick.progress


@pytest.mark.parametrize("was", [20.0, 0.0])
def test_only_a_cable_that_was_taut_may_not_go_slack(was):
    rig = RIGS[0]
    law = CableStep(rig, [0] * 8, cable=2, way=0.01, limit=60.0, speed=0.005)
    law.next(1.0, [20.0] * 5 + [was] + [20.0] * 2)
    codes = []
    for _ in range(6):
        _, found = law.next(1.0, [20.0] * 2 + [0.0] + [20.0] * 2 + [0.1] + [20.0] * 2)
        codes.append([finding.code for finding in found])
    assert codes[:4] == [[]] * 4
    assert codes[4] == (["went_slack"] if was else [])
