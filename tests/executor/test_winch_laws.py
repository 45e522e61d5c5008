"""Set-points of winches without a path: bounded, in one direction, limited by the feedback."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from executor.control.winch_laws import (
    LEAST_SHARE,
    CableFeed,
    CableStep,
    PretensionLaw,
    TensionReserve,
    tension_reserve,
    wind_in_speed,
)
from executor.safety.fault_messages import StopReaction
from model.rig import load_rig
from tests.cli.plans import HALL, RIG

RIGS = [load_rig(RIG), load_rig(HALL)]


TAUT = np.full(8, 10.0)


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
    law = PretensionLaw(
        rig, begin, targets=np.full(rig.cable_count, target), limit=limit, reach=1e-4, speed=0.002
    )
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
    law = PretensionLaw(rig, [0] * 8, targets=TAUT, limit=60.0, reach=0.01, speed=0.002)
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


def test_each_cable_is_taut_at_its_own_tension():
    rig = RIGS[0]
    own = np.linspace(10.0, 45.0, 8)
    law = PretensionLaw(rig, [0] * 8, targets=own, limit=60.0, reach=0.01, speed=0.002)
    targets, _ = law.next(1.0, np.where(np.arange(8) % 2, own, 0.95 * own).tolist())
    assert [target != 0 for target in targets] == [True, False] * 4
    for _ in range(20):
        law.next(1.0, own.tolist())
    assert law.done


def test_a_step_raises_no_tension_beyond_what_is_left_before_it_is_seen():
    for rig in RIGS:
        target, limit = 2.0 * rig.min_tension, 0.5 * rig.max_tension
        from model.winches import WinchMap

        stiffness = rig.cable_stiffness / WinchMap(rig).home_unstrained
        step = wind_in_speed(rig, target, limit, 1.0) * 0.01
        assert (2.0 * 2.0 * step * stiffness <= limit - target + 1e-9).all()


@pytest.mark.parametrize("wrong", [61.0, -61.0, float("nan")])
def test_beyond_the_limit_no_winch_continues(wrong):
    rig = RIGS[0]
    for law in (
        PretensionLaw(rig, [0] * 8, targets=TAUT, limit=60.0, reach=0.05, speed=0.002),
        CableStep(rig, [0] * 8, cable=1, length=-0.02, limit=60.0, speed=0.005),
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


def test_near_the_limit_all_continue_more_slowly():
    rig, steps = RIGS[0], []
    for tension in (10.0, 35.0, 59.9):
        law = PretensionLaw(rig, [0] * 8, targets=TAUT, limit=60.0, reach=0.05, speed=0.002)
        targets, _ = law.next(1.0, [0.0] * 7 + [tension])
        for _ in range(99):
            targets, _ = law.next(1.0, [0.0] * 7 + [tension])
        steps.append(abs(targets[0]))
    assert steps[1] == pytest.approx(0.5 * steps[0], rel=0.01)
    assert steps[2] == pytest.approx(0.05 * steps[0], rel=0.05)


def test_a_cable_that_stays_slack_is_reported():
    rig = RIGS[0]
    law = PretensionLaw(rig, [0] * 8, targets=TAUT, limit=60.0, reach=1e-5, speed=0.002)
    found = ()
    for _ in range(10):
        _, found = law.next(1.0, [12.0] * 7 + [0.3])
    (alarm,) = found
    assert (alarm.code, alarm.reaction, alarm.drive) == (
        "not_taut",
        StopReaction.PATH_STOP,
        8,
    )
    assert "0.3 N" in alarm.text


def test_a_soft_cable_is_wound_in_by_its_reach_and_its_stretch():
    """On a cable that stretches by more than its reach it was reported as slack or broken."""
    rig = RIGS[0]
    stretch = np.linspace(0.0, 0.0004, 8)
    law = PretensionLaw(
        rig, [0] * 8, targets=TAUT, limit=60.0, reach=1e-4, speed=0.002, stretch=stretch
    )
    found, wound = (), np.zeros(8)
    while not any(alarm.drive == 8 for alarm in found):
        assert (wound < 1e-4 + stretch - 1e-9)[7]
        targets, found = law.next(1.0, [0.0] * 8)
        wound = -np.array(targets) / per_metre(rig)
    assert wound == pytest.approx(1e-4 + stretch, abs=1.0 / np.abs(per_metre(rig)).min())
    assert -np.array(law.reach[1]) / per_metre(rig) == pytest.approx(wound)
    assert "stretched by 0.4 mm" in found[-1].text


@settings(max_examples=40, deadline=None)
@given(length=st.floats(-0.05, 0.05).filter(lambda w: abs(w) > 1e-4), speed=st.floats(1e-3, 0.02))
def test_one_cable_moves_smoothly_and_the_others_rest(length, speed):
    rig = RIGS[0]
    law = CableStep(rig, [7] * 8, cable=2, length=length, limit=60.0, speed=speed)
    sent = []
    while not law.done:
        targets, found = law.next(1.0, [0.0] * 8)
        sent.append(targets)
        assert found == ()
    rows = np.array(sent)
    assert (np.delete(rows, 2, axis=1) == 7).all()
    assert rows[-1, 2] == 7 + round(length * rig.winches[2].counts_per_metre)
    steps = np.abs(np.diff(rows[:, 2])) / per_metre(rig)[2]
    assert steps.max(initial=0.0) <= speed * 0.01 * 1.001 + 1.0 / per_metre(rig)[2]


def test_a_taut_cable_is_moved_as_carefully_as_it_would_be_wound_in():
    rig = RIGS[0]
    slow = CableStep(rig, [0] * 8, cable=2, length=-0.01, limit=60.0, speed=0.02)
    quick = CableStep(rig, [0] * 8, cable=2, length=-0.01, limit=60.0, speed=0.02)
    for _ in range(20):
        slow.next(1.0, [20.0] * 8)
        quick.next(1.0, [0.0] * 8)
    assert slow.progress < 0.1 * quick.progress


@pytest.mark.parametrize("was", [20.0, 0.0])
def test_only_a_cable_that_was_taut_may_not_go_slack(was):
    rig = RIGS[0]
    law = CableStep(rig, [0] * 8, cable=2, length=0.01, limit=60.0, speed=0.005)
    law.next(1.0, [20.0] * 5 + [was] + [20.0] * 2)
    codes = []
    for _ in range(6):
        _, found = law.next(1.0, [20.0] * 2 + [0.0] + [20.0] * 2 + [0.1] + [20.0] * 2)
        codes.append([alarm.code for alarm in found])
    assert codes[:4] == [[]] * 4
    assert codes[4] == (["went_slack"] if was else [])


# A held jog of one cable: `CableFeed`, and where it comes to rest.


@settings(max_examples=60, deadline=None)
@given(
    rig=st.sampled_from(RIGS),
    length=st.floats(-0.05, 0.05),
    speed=st.floats(1e-3, 0.02),
    paces=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=80),
    seed=st.integers(0, 10**6),
)
def test_a_held_cable_moves_in_one_direction_and_no_farther_than_its_reach(
    rig, length, speed, paces, seed
):
    random = np.random.default_rng(seed)
    law = CableFeed(rig, [7] * 8, cable=2, length=length, limit=60.0, speed=speed)
    counts = rig.winches[2].counts_per_metre
    begin, end = law.reach
    assert begin == (7,) * 8
    assert end[2] == 7 + round(length * counts)
    before, left = 7, law.cycles_left
    for pace in paces:
        targets, _ = law.next(pace, random.uniform(0.0, 80.0, 8).tolist())
        assert (np.delete(targets, 2) == 7).all(), "the others rest"
        ahead = targets[2] - before
        assert ahead * np.sign(length * counts) >= 0
        assert abs(ahead) <= abs(counts) * speed * 0.01 * pace + 1
        assert abs(targets[2] - 7) <= abs(end[2] - 7)
        assert law.cycles_left <= left
        before, left = targets[2], law.cycles_left
    while not law.done:
        law.next(1.0, [0.0] * 8)
    assert law.next(1.0, [0.0] * 8)[0] == end


def test_a_zero_length_is_done_at_once():
    law = CableFeed(RIGS[0], [0] * 8, cable=2, length=0.0, limit=60.0, speed=0.02)
    assert law.done
    assert law.next(1.0, [0.0] * 8) == ((0,) * 8, ())


def test_a_cable_that_goes_slack_speeds_up_without_a_jerk():
    rig = RIGS[0]
    law = CableFeed(rig, [0] * 8, cable=2, length=0.05, limit=60.0, speed=0.02)
    positions = [0]
    for tension in [20.0] * 20 + [0.0] * 60:
        targets, _ = law.next(1.0, [20.0, 20.0, tension] + [20.0] * 5)
        positions.append(abs(targets[2]))
    steps = np.diff(positions) / abs(per_metre(rig)[2])
    most = rig.motion.acceleration / rig.motion.speed * 0.01 * 0.02 * 0.01
    assert np.diff(steps).max() <= most + 2.0 / abs(per_metre(rig)[2])
    assert steps[-1] > 5.0 * steps[10]


SLACK, FLOOR = RIGS[0].min_tension / 2.0, LEAST_SHARE * RIGS[0].min_tension
LIMIT = 62.0
CEILING = LIMIT - tension_reserve(RIGS[0], LIMIT)


def share(now, *, out, before=20.0):
    """Of cable 3 (index 2): from tensions `before` of all to `now`, a number or a list."""
    reserve = TensionReserve(RIGS[0], 2, limit=LIMIT, pays_out=out)
    reserve.share(before if isinstance(before, list) else [before] * 8)
    return reserve.share(now if isinstance(now, list) else [now] * 8)


def one(cable, tension, others=20.0):
    return [others] * cable + [tension] + [others] * (7 - cable)


@pytest.mark.parametrize("cable", [2, 6])
def test_winding_in_rests_from_the_reserve_on_whichever_cable_is_tight(cable):
    assert share(one(cable, CEILING + 0.01), out=False) == 0.0
    assert share(one(cable, CEILING - 0.01), out=False) == pytest.approx(0.05)
    middle = (CEILING + SLACK) / 2.0
    assert share(one(cable, middle), out=False) == pytest.approx(0.5, abs=0.01)
    assert share(SLACK, out=False, before=SLACK) == 1.0


def test_paying_out_continues_as_long_as_no_other_cable_becomes_tighter():
    assert share(one(2, LIMIT + 30.0), out=True) == 1.0, "its own tension falls by it"
    assert share(CEILING + 3.0, out=True, before=CEILING + 3.0) == 1.0
    assert share(one(6, CEILING + 0.01), out=True) == 0.0
    assert 0.0 < share(one(6, CEILING - 1.0), out=True) < 0.1
    noise = 0.2 * tension_reserve(RIGS[0], LIMIT)
    assert share(CEILING + 3.0 + noise, out=True, before=CEILING + 3.0) == 1.0


@pytest.mark.parametrize("out", [True, False])
def test_it_rests_before_another_cable_that_was_taut_is_slack(out):
    assert share(one(6, FLOOR - 0.01), out=out) == 0.0
    assert 0.0 < share(one(6, FLOOR + 0.5), out=out) < 0.1
    assert share(one(2, FLOOR - 0.01), out=out) > 0.2, "its own may go slack"
    hung = one(6, SLACK - 0.5)
    assert share(one(6, 0.0), out=out, before=hung) > 0.2, "a slack cable may stay slack"


@pytest.mark.parametrize("out", [True, False])
@pytest.mark.parametrize("wrong", [float("nan"), float("inf")])
def test_a_tension_that_is_not_a_number_leaves_no_room(out, wrong):
    for cable in (2, 6):
        assert share(one(cable, wrong), out=out) == 0.0
        assert share(20.0, out=out, before=one(cable, wrong)) >= 0.0


@given(limit=st.floats(5.1, 100.0), rig=st.sampled_from(RIGS))
def test_the_reserve_is_some_of_the_room_and_never_all(limit, rig):
    room = limit - rig.min_tension / 2.0
    if room > 0.0:
        assert 0.1 * room - 1e-9 <= tension_reserve(rig, limit) <= 0.5 * room + 1e-9
