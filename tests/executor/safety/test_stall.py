"""Drives that stall while their set-points advance, distinguished from noise."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from executor.safety.fault_messages import Alarm, StopReaction
from executor.safety.stall import Drive, StuckLimits, StuckWatch

HERE = (True, (0, 0), (0, 0), (False, False))
NAMES = ("cable 1 (drive 11)", "cable 2 (drive 9)")
NOTE = "{} did not move for 1 cycle while its set-points advanced"
STOP = "{} did not move for {} cycles while its set-points advanced"
LIMITS = StuckLimits(least=10, travel=100)


def look(cycles, limits=LIMITS):
    """Alarms in the last of some cycles."""
    watch, found = StuckWatch.fresh((limits, limits), NAMES), ()
    for cycle in cycles:
        watch, found = watch.update(*cycle)
    return found


def steps(positions, demands, drive=0, missing=(), following=True):
    """One drive at these positions; the other one rests."""
    for k, (position, demand) in enumerate(zip(positions, demands, strict=True)):
        row, wanted = [7, 7], [7, 7]
        row[drive], wanted[drive] = position, demand
        lost = [False, False]
        lost[drive] = k in missing
        yield following, row, wanted, lost


def first_found(positions, demands, limits=LIMITS):
    """Cycle and text of the first stop; None without one."""
    watch = StuckWatch.fresh((limits,), NAMES[:1])
    for k, (position, demand) in enumerate(zip(positions, demands, strict=True)):
        watch, found = watch.update(True, (position,), (demand,), (False,))
        if any(each.code == "drive_stuck" for each in found):
            return k
    return None


@pytest.mark.parametrize("drive", [0, 1])
@pytest.mark.parametrize("sign", [1, -1])
def test_one_cycle_is_noted_and_two_in_a_row_stop(drive, sign):
    demands = [sign * 100 * k for k in range(6)]
    stuck = [sign * p for p in (0, 100, 200, 200, 200, 200)]
    number = drive + 1
    assert look(list(steps(stuck, demands, drive))[:3]) == ()
    assert look(list(steps(stuck, demands, drive))[:4]) == (
        Alarm(StopReaction.NOTE, "set_point_missed", NOTE.format(NAMES[drive]), number),
    )
    for cycles in (2, 3):
        assert look(list(steps(stuck, demands, drive))[: 3 + cycles]) == (
            Alarm(StopReaction.QUICK_STOP, "drive_stuck", STOP.format(NAMES[drive], 2), number),
        )


def test_a_slow_drive_is_judged_over_the_whole_travel():
    """Ten cycles of ten counts; it is found when its set-points went on by 100 without it."""
    demands = [10 * k for k in range(40)]
    positions = [min(demand, 200) for demand in demands]
    # A window of which less than a quarter was travelled: 80 of 100 counts without motion.
    assert first_found(positions, demands) == 28
    assert look(list(steps(positions, demands))[:29])[0].text == STOP.format(NAMES[0], 10)


@pytest.mark.parametrize(("travel", "found"), [(200, 4), (201, 5), (300, 5), (301, 6)])
def test_the_travel_decides_how_long_a_drive_may_stall(travel, found):
    demands = [100 * k for k in range(10)]
    positions = [0, 100, 200, 300, 400, *[400] * 5]
    at = first_found(positions, demands, StuckLimits(10, travel))
    assert at == found + 2


@pytest.mark.parametrize(("travel", "noted"), [(100, 1), (101, 0)])
def test_a_single_step_is_noted_only_where_it_is_larger_than_noise(travel, noted):
    cycles = steps([0, 100, 200, 300, 300], [0, 100, 200, 300, 400])
    assert len(look(cycles, StuckLimits(10, travel))) == noted


@pytest.mark.parametrize(("least", "found"), [(100, 1), (101, 0)])
def test_slow_set_points_are_not_judged(least, found):
    cycles = steps([0, 100, 200, 200], [0, 100, 200, 300])
    assert len(look(cycles, StuckLimits(least, 100))) == found


def test_a_slow_step_ends_the_stretch():
    slow = [0, 100, 200, 200, 200, 200, 200, 200]
    assert look(steps(slow, [0, 100, 200, 300, 309, 409, 509, 609])) == ()
    assert look(steps(slow, [0, 100, 200, 300, 310, 410, 510, 610])) != ()


def test_set_points_that_turn_round_end_the_stretch():
    """They return to the drive's position; whether it follows in this direction is unknown."""
    assert look(steps([0, 100, 200, 200, 200, 200], [0, 100, 200, 300, 200, 100])) == ()
    reversed_path = [0, 100, 200, 300, 200, 100, 100, 100]
    (stop,) = look(steps(reversed_path, [0, 100, 200, 300, 200, 100, 0, -100]))
    assert stop.code == "drive_stuck"


def test_turning_round_by_a_single_count_ends_the_stretch():
    drive = Drive(StuckLimits(least=1, travel=10)).seen(0, 0).seen(1, 1)
    assert drive.seen(0, 0).replies == ((0, 0),)
    assert drive.seen(2, 2).replies == ((0, 0), (1, 1), (2, 2))


@pytest.mark.parametrize(
    ("ahead", "found"), [(-5000, 6), (0, 6), (100, 6), (200, 7), (250, 7), (350, 8)]
)
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_drive_that_is_behind_is_judged_at_once_and_one_that_is_ahead_once_it_is_passed(
    ahead, found, sign
):
    demands = [sign * 100 * k for k in range(10)]
    assert first_found([demand + sign * ahead for demand in demands], demands) is None
    jammed = [sign * (100 * min(k, 4) + ahead) for k in range(10)]
    assert first_found(jammed, demands) == found


@pytest.mark.parametrize(
    ("limits", "replies"),
    [
        (
            StuckLimits(8, 28, 1),
            "81,0 111,34 134,60 150,80 159,96 165,108 167,118 168,127 169,136",
        ),
        (
            StuckLimits(8, 28, 2),
            "75,0 288,206 448,365 559,477 631,552 668,598 683,626 686,645 689,662",
        ),
    ],
)
def test_a_servo_that_is_ahead_after_slowing_down_waits_and_has_not_stalled(limits, replies):
    """From 100 to 2.2 mm/s in a position loop with lag."""
    positions, demands = zip(*(map(int, each.split(",")) for each in replies.split()), strict=True)
    assert first_found(positions, demands, limits) is None


def test_a_step_is_missed_only_by_a_drive_that_is_behind():
    """Ahead by more than a step, as after set-points that slowed down."""
    demands = [100 * k for k in range(6)]
    assert look(list(steps([d + 250 for d in demands[:5]] + [650], demands))) == ()
    (note,) = look(list(steps([*demands[:5], 400], demands)))
    assert note.code == "set_point_missed"


def test_a_fault_needs_two_cycles_and_one_reply_at_least():
    assert [StuckLimits(10, 100, period).replies for period in (1, 2, 3, 5)] == [2, 1, 1, 1]


def test_one_count_behind_is_behind():
    drive = Drive(StuckLimits(least=1, travel=1, period=2)).seen(0, 0).seen(1, 1)
    assert drive.seen(1, 2).is_stuck


def test_set_points_too_slow_to_be_judged_are_so_whatever_the_gap_between_replies():
    watch = StuckWatch.fresh((StuckLimits(8, 28),), NAMES[:1])
    for cycle in range(100):
        row = (True, (7 * min(cycle, 50),), (7 * cycle,), (cycle % 2 == 1,))
        watch, found = watch.update(*row)
        assert found == ()


@pytest.mark.parametrize("gaps", [(1, 2), (2, 1, 1), (2, 3), (1,)])
def test_a_jam_is_found_also_where_gaps_between_replies_vary(gaps):
    """At 2.5 mm/s, of which 2 are judged."""
    watch = StuckWatch.fresh((StuckLimits(8, 28),), NAMES[:1])
    replies = set(itertools.accumulate(itertools.islice(itertools.cycle(gaps), 200)))
    stuck = []
    for cycle in range(120):
        row = (True, (10 * min(cycle, 60),), (10 * cycle,), (cycle not in replies,))
        watch, found = watch.update(*row)
        stuck += [cycle for alarm in found if alarm.code == "drive_stuck"]
    assert stuck
    assert 60 < stuck[0] <= 60 + 3 + 2 * max(gaps)


@pytest.mark.parametrize(("moved", "found"), [(49, 1), (50, 0), (0, 1), (-25, 1), (-200, 1)])
def test_a_quarter_of_the_travel_is_not_standing_still(moved, found):
    cycles = [*steps([0, 100, 200, 200 + moved // 2, 200 + moved], [0, 100, 200, 300, 400])]
    assert [f.code for f in look(cycles)] == ["drive_stuck"] * found


@pytest.mark.parametrize(("moved", "noted"), [(24, 1), (25, 0), (-24, 1)])
def test_a_quarter_of_a_step_is_not_missing_it(moved, noted):
    cycles = steps([0, 100, 200, 300, 300 + moved], [0, 100, 200, 300, 400])
    assert len(look(cycles)) == noted


@pytest.mark.parametrize(("moved", "found"), [(49, 0), (50, 1), (-100, 0)])
def test_only_a_drive_that_followed_is_judged(moved, found):
    """At the start of a motion a servo lags; against friction it may not move at all."""
    begun = [0, moved, 2 * moved, 2 * moved, 2 * moved]
    assert len(look(steps(begun, [0, 100, 200, 300, 400]))) == found
    assert look(steps([0, 0, 0, 0, 0], [0, 100, 200, 300, 400])) == ()


def test_one_step_alone_does_not_show_that_a_drive_follows():
    assert look(steps([0, 100, 100, 100], [0, 100, 200, 300])) == (
        Alarm(StopReaction.QUICK_STOP, "drive_stuck", STOP.format(NAMES[0], 2), 1),
    )
    assert look(steps([0, 99, 99, 99], [0, 100, 200, 300])) == ()


def test_before_the_whole_travel_it_is_not_known_whether_a_drive_follows():
    drive = Drive(StuckLimits(least=1, travel=100))
    for position in range(0, 100, 10):
        drive = drive.seen(position, position)
        assert (drive.followed, drive.stalled) == (False, 0)
    assert drive.seen(100, 100).followed


def test_a_drive_that_follows_again_is_forgiven():
    assert look(steps([0, 100, 200, 200, 400], [0, 100, 200, 300, 400])) == ()
    (note,) = look(steps([0, 100, 200, 200, 400, 400], [0, 100, 200, 300, 400, 500]))
    assert note.code == "set_point_missed"


def test_a_drive_that_crawls_and_then_stalls_is_found():
    crawling = [0, 100, 200, 230, 260, 260, 260]
    assert first_found(crawling, [0, 100, 200, 300, 400, 500, 600]) == 5


def test_a_missing_reply_gives_no_information():
    positions, demands = [0, 100, 200, 200, 200, 200], [0, 100, 200, 300, 400, 500]
    assert look(list(steps(positions, demands, missing={4}))[:5]) == ()
    (stop,) = look(steps(positions, demands, missing={4}))
    assert stop.text == STOP.format(NAMES[0], 2)
    late = [0, 100, 200, 200, 400]
    assert look(steps(late, demands[:5], missing={3})) == (), "two steps in one"


def test_drives_that_follow_nothing_are_not_judged():
    cycles = list(steps([0, 100, 200, 200], [0, 100, 200, 300]))
    resting = list(steps([200], [300], following=False))
    assert look([*cycles[:3], *resting, *cycles[3:]]) == ()
    assert look([*cycles[:3], *resting]) == (), "it would be stalled still if it were to follow"
    assert Drive(LIMITS, ((0, 0), (1, 1)), True, 3).forgotten() == Drive(LIMITS)


@pytest.mark.parametrize(("period", "replies"), [(1, 2), (2, 1), (3, 1), (5, 1)])
def test_a_reply_in_every_few_cycles_is_judged_by_the_cycles_it_covers(period, replies):
    limits = StuckLimits(10, 100, period)
    demands = [100 * period * k for k in range(8)]
    positions = [min(demand, demands[4]) for demand in demands]
    assert first_found(positions, demands, limits) == 4 + replies
    (stop,) = look(list(steps(positions, demands))[: 5 + replies], limits)
    assert stop.text == STOP.format(NAMES[0], max(2, period))
    half = [demand // 2 for demand in demands]
    assert first_found(half, demands, limits) is None
    slow = [30 * k for k in range(20)]
    held = [min(demand, slow[12]) for demand in slow]
    assert first_found(held, slow, limits) == 16, "120 counts without motion"


@given(
    st.integers(1, 5),
    st.floats(0.2, 5.0),
    st.floats(0.0, 1.0),
    st.randoms(use_true_random=False),
)
def test_a_drive_that_reports_at_its_own_moments_is_not_stalled(period, turn, rest, dice):
    """To and fro with rests, 20 mm/s, positions up to a cycle old and in some cycles late."""
    per_mm = 80.0
    limits = StuckLimits(0.02 * per_mm, round(0.07 * per_mm), period)
    speeds = np.sin(np.arange(0, 400) * 0.01 / turn * 2 * np.pi)
    speeds[np.abs(speeds) < rest * 0.5] = 0.0
    demands = np.cumsum(np.concatenate(([0.0] * 5, 0.2 * per_mm * speeds, [0.0] * 20)))
    seen = range(3, len(demands), period)
    asked = [round(demands[k]) for k in seen]
    told = [round(np.interp(k - dice.random(), np.arange(len(demands)), demands)) for k in seen]
    assert first_found(told, asked, limits) is None


def test_a_drive_that_may_disarm_itself_may_not_be_jammed():
    watch = StuckWatch.fresh((LIMITS,), NAMES[:1], may_disarm=True)
    texts = []
    for k in range(5):
        watch, found = watch.update(True, (min(100 * k, 200),), (100 * k,), (False,))
        texts += [alarm.text for alarm in found]
    stop = STOP.format(NAMES[0], 2)
    assert texts == [NOTE.format(NAMES[0]), f"{stop}: it may be jammed or disarmed"]


def test_an_entry_is_needed_for_every_drive():
    watch = StuckWatch.fresh((LIMITS, LIMITS), NAMES)
    for position in (1, 2, 3):
        short = list(HERE)
        short[position] = short[position][:1]
        with pytest.raises(ValueError, match="zip"):
            watch.update(*short)


def test_no_more_replies_are_kept_than_are_needed():
    drive = Drive(StuckLimits(least=1, travel=10))
    for position in range(100):
        drive = drive.seen(position, position)
    assert len(drive.replies) == 11
    fast = Drive(StuckLimits(least=1, travel=10))
    for position in range(0, 1000, 50):
        fast = fast.seen(position, position)
    assert fast.replies == ((850, 850), (900, 900), (950, 950))


NOISE_SHARE = 3 / 8
runs = st.lists(st.tuples(st.integers(-300, 300), st.integers(1, 12)), max_size=6)
demanded = runs.map(lambda found: [step for step, count in found for _ in range(count)])
"""Steps of set-points that advance for a while."""


@given(demanded, st.randoms(use_true_random=False), st.integers(3, 400))
def test_noise_within_three_eighths_of_the_travel_is_never_a_stalled_drive(changes, dice, travel):
    """For any set-points and any noise."""
    noise = int(NOISE_SHARE * travel)
    demands = [sum(changes[:k]) for k in range(len(changes) + 1)]
    positions = [demand + dice.choice((-noise, noise)) for demand in demands]
    assert first_found(positions, demands, StuckLimits(2, travel)) is None


@given(
    st.integers(2, 300),
    st.integers(3, 400),
    st.sampled_from([-1, 1]),
    st.randoms(use_true_random=False),
    st.integers(0, 30),
)
def test_a_drive_that_jams_is_found_within_the_travel_whatever_the_noise(
    step, travel, sign, dice, more
):
    """Noise below an eighth of the travel; by the first reply that shows travel and two cycles."""
    noise = (travel - 1) // 8
    patience = max(2, -(-travel // step))
    jammed = patience + 2 + more
    demands = [sign * step * k for k in range(jammed + patience + 1)]
    positions = [
        sign * step * min(k, jammed) + dice.choice((-noise, 0, noise)) for k in range(len(demands))
    ]
    found = first_found(positions, demands, StuckLimits(2, travel))
    assert found is not None
    assert jammed < found <= jammed + patience
