"""Drives that stand still while their set-points go on: one cycle is counted, two in a row stop."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from executor.safety.stuck import StuckWatch
from executor.safety.watch import Finding, Reaction

HERE = (True, (0, 0), (0, 0), (False, False))
NAMES = ("cable 1 (drive 11)", "cable 2 (drive 9)")
NOTE = "{} stood still for 1 cycle while its set-points went on"
STOP = "{} stood still for {} cycles while its set-points went on"


def look(cycles, least=(10, 10)):
    """What is found in the last of some cycles."""
    watch, found = StuckWatch.fresh(least, NAMES), ()
    for cycle in cycles:
        watch, found = watch.look(*cycle)
    return found


def steps(positions, demands, drive=0, missing=(), following=True):
    """One drive at these places; the other one rests."""
    for k, (position, demand) in enumerate(zip(positions, demands, strict=True)):
        places, wanted = [7, 7], [7, 7]
        places[drive], wanted[drive] = position, demand
        lost = [False, False]
        lost[drive] = k in missing
        yield following, places, wanted, lost


@pytest.mark.parametrize("drive", [0, 1])
@pytest.mark.parametrize("sign", [1, -1])
def test_one_cycle_is_noted_and_two_in_a_row_stop(drive, sign):
    demands = [sign * 100 * k for k in range(6)]
    stuck = [sign * p for p in (0, 100, 200, 200, 200, 200)]
    number = drive + 1
    assert look(list(steps(stuck, demands, drive))[:3]) == ()
    assert look(list(steps(stuck, demands, drive))[:4]) == (
        Finding(Reaction.NOTE, "set_point_missed", NOTE.format(NAMES[drive]), number),
    )
    for cycles in (2, 3):
        assert look(list(steps(stuck, demands, drive))[: 3 + cycles]) == (
            Finding(Reaction.QUICK_STOP, "drive_stuck", STOP.format(NAMES[drive], cycles), number),
        )


@pytest.mark.parametrize(("least", "found"), [(100, 1), (101, 0)])
def test_small_steps_of_set_points_say_nothing(least, found):
    cycles = steps([0, 100, 100], [0, 100, 200])
    assert len(look(cycles, (least, least))) == found


def test_a_small_step_ends_the_count():
    assert look(steps([0, 100, 100, 100, 100], [0, 100, 200, 205, 305])) == ()


@pytest.mark.parametrize(("moved", "found"), [(24, 1), (25, 0), (-24, 1), (-25, 0)])
def test_a_quarter_of_the_step_is_not_standing_still(moved, found):
    assert len(look(steps([0, 100, 100 + moved], [0, 100, 200]))) == found


@pytest.mark.parametrize(("moved", "found"), [(49, 0), (50, 1), (-100, 0)])
def test_only_a_drive_that_followed_is_judged(moved, found):
    """At the begin of a motion a servo lags; against friction it may not move at all."""
    assert len(look(steps([0, moved, moved], [0, 100, 200]))) == found
    assert look(steps([0, 0, 0, 0], [0, 100, 200, 300])) == ()


def test_a_drive_that_follows_again_is_forgiven():
    assert look(steps([0, 100, 100, 300], [0, 100, 200, 300])) == ()
    (note,) = look(steps([0, 100, 100, 300, 300], [0, 100, 200, 300, 400]))
    assert note.code == "set_point_missed"


def test_a_drive_that_crawls_on_is_no_longer_judged():
    assert look(steps([0, 100, 130, 130], [0, 100, 200, 300])) == ()


def test_a_reply_that_is_missing_says_nothing_new():
    positions, demands = [0, 100, 100, 100, 100], [0, 100, 200, 300, 400]
    assert look(list(steps(positions, demands, missing={3}))[:4]) == ()
    (stop,) = look(steps(positions, demands, missing={3}))
    assert stop.text == STOP.format(NAMES[0], 2)
    late = [0, 100, 100, 300]
    assert look(steps(late, demands[:4], missing={2})) == (), "two steps in one"


def test_drives_that_follow_nothing_are_not_judged():
    cycles = list(steps([0, 100, 100], [0, 100, 200]))
    resting = list(steps([100], [200], following=False))
    assert look([*cycles[:2], *resting, *cycles[2:]]) == ()
    assert look([*cycles[:2], *resting]) == (), "it would be standing still if it were to follow"


def test_an_entry_is_needed_for_every_drive():
    watch = StuckWatch.fresh((10, 10), NAMES)
    for place in (1, 2, 3):
        short = list(HERE)
        short[place] = short[place][:1]
        with pytest.raises(ValueError, match="zip"):
            watch.look(*short)


@given(st.lists(st.integers(-200, 200), max_size=30))
def test_a_drive_that_does_what_it_is_told_is_never_found(changes):
    places = [sum(changes[:k]) for k in range(len(changes) + 1)]
    watch = StuckWatch.fresh((10,), NAMES[:1])
    for place in places:
        watch, found = watch.look(True, (place,), (place,), (False,))
        assert found == ()
