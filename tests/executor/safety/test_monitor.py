"""The monitor: silent within the limits, an alarm one step beyond, robust to NaN and gaps."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from executor.safety.fault_messages import Alarm, StopReaction
from executor.safety.monitor import (
    LOST_REPLIES,
    REPLY_WINDOW,
    Monitor,
    MonitorLimits,
    Observation,
    ReplyCounts,
)

NAN = float("nan")
LIMITS = MonitorLimits(following_error=0.002, min_tension=5.0, max_tension=100.0, no_tension=0.5)
FINE = Observation(
    following=True,
    following_errors=(0.0, 0.0, 0.0),
    tensions=(20.0, 20.0, 20.0),
    missing=(False, False, False),
    faults=(),
    lateness=0.0,
)
NAMES = ("cable 1 (drive 11)", "cable 2 (drive 9)", "cable 3 (drive 12)")
each_drive = pytest.mark.parametrize("drive", range(3))


def _put(values: tuple[object, ...], drive: int, value: object) -> tuple[object, ...]:
    return (*values[:drive], value, *values[drive + 1 :])


def _look(*cycles: Observation) -> tuple[Alarm, ...]:
    """Alarms in the last of some cycles."""
    watch, found = Monitor.fresh(LIMITS, NAMES), ()
    for seen in cycles:
        watch, found = watch.update(seen)
    return found


def _codes(*cycles: Observation) -> list[tuple[str, StopReaction]]:
    return [(alarm.code, alarm.reaction) for alarm in _look(*cycles)]


def _with(field: str, drive: int, value: object) -> Observation:
    return replace(FINE, **{field: _put(getattr(FINE, field), drive, value)})


def test_nothing_is_found_while_all_is_well():
    assert _look(*[FINE] * 20) == ()


def test_the_larger_reaction_has_the_larger_number():
    assert [StopReaction.NOTE, StopReaction.PATH_STOP, StopReaction.QUICK_STOP] == [0, 1, 2]


def test_limits_have_the_values_of_the_stop_rules():
    assert (LIMITS.slack_cycles, LIMITS.missing_cycles, LIMITS.late_periods) == (5, 2, 1.0)
    assert LIMITS.gone_periods == 1.5
    assert LIMITS.loose_cycles == 3
    assert (LIMITS.lost_replies, REPLY_WINDOW) == (LOST_REPLIES, 50) == (10, 50)


def test_one_lost_reply_is_noted_and_two_in_a_row_stop():
    lost = _with("missing", 1, True)
    (note,) = _look(lost)
    assert note == Alarm(
        StopReaction.NOTE, "reply_lost", f"{NAMES[1]} did not answer for 1 cycle", 2
    )
    (stop,) = _look(lost, lost)
    assert stop == Alarm(
        StopReaction.QUICK_STOP, "drive_silent", f"{NAMES[1]} did not answer for 2 cycles", 2
    )
    assert _codes(lost, FINE, lost) == [("reply_lost", StopReaction.NOTE)]
    assert _codes(lost, FINE) == []
    assert "3 cycles" in _look(lost, lost, lost)[0].text


@each_drive
def test_replies_are_counted_for_each_drive_alone(drive):
    others = [d for d in range(3) if d != drive]
    assert _codes(_with("missing", others[0], True), _with("missing", drive, True)) == [
        ("reply_lost", StopReaction.NOTE)
    ]
    assert f"{NAMES[drive]} " in _look(_with("missing", drive, True))[0].text


def test_a_watch_may_be_set_to_wait_longer_for_replies():
    patient = replace(LIMITS, missing_cycles=4)
    watch, lost = Monitor.fresh(patient, NAMES), _with("missing", 0, True)
    found = []
    for _ in range(5):
        watch, (alarm,) = watch.update(lost)
        found.append(alarm)
    assert [f.reaction for f in found] == [StopReaction.NOTE] * 3 + [StopReaction.QUICK_STOP] * 2
    assert [f.text.split(" for ")[1] for f in found[:2]] == ["1 cycle", "2 cycles"]


def losing(drive: int, *gaps: int) -> list[Observation]:
    """Each gap is a number of cycles with all replies, before one without that of a drive."""
    lost = _with("missing", drive, True)
    return [seen for gap in gaps for seen in (*[FINE] * gap, lost)]


@each_drive
def test_every_tenth_lost_reply_of_fifty_stops_along_the_path(drive: int) -> None:
    nine, ten = losing(drive, *[1] * 9), losing(drive, *[1] * 10)
    assert _codes(*nine) == [("reply_lost", StopReaction.NOTE)]
    assert _codes(*nine, *[FINE] * 60) == []
    text = f"{NAMES[drive]} did not answer in 10 of the last 20 cycles"
    stop = Alarm(StopReaction.PATH_STOP, "drive_silent", text, drive + 1)
    assert _look(*ten) == (stop,)
    (later,) = _look(*ten, *[FINE] * 30)
    assert later.text.endswith("10 of the last 50 cycles"), "also in cycles with its reply"
    assert _look(*ten, *[FINE] * 31) == (later,)
    assert _look(*ten, *[FINE] * 32) == ()


def test_lost_replies_count_in_a_window_of_fifty_cycles() -> None:
    assert _codes(*losing(0, 0, *[1] * 8, 32)) == [("drive_silent", StopReaction.PATH_STOP)]
    assert _codes(*losing(0, 0, *[1] * 8, 33)) == [("reply_lost", StopReaction.NOTE)]


def test_lost_replies_of_two_drives_do_not_add_up() -> None:
    cycles = [seen for _ in range(9) for seen in (*losing(0, 1), *losing(1, 1))]
    assert [code for code, _ in _codes(*cycles)] == ["reply_lost"]


def test_replies_lost_in_a_row_remain_a_quick_stop_after_many_lost_ones() -> None:
    lost = _with("missing", 1, True)
    assert _codes(*losing(1, *[1] * 10), lost) == [("drive_silent", StopReaction.QUICK_STOP)]


def test_a_watch_may_be_set_to_allow_more_lost_replies() -> None:
    watch, found = Monitor.fresh(replace(LIMITS, lost_replies=12), NAMES), []
    for seen in losing(2, *[1] * 12):
        watch, alarms = watch.update(seen)
        found += [alarm.reaction for alarm in alarms]
    assert found == [StopReaction.NOTE] * 11 + [StopReaction.PATH_STOP]


def counted(*cycles: tuple[bool, ...]) -> ReplyCounts:
    counts = ReplyCounts(0, (0, 0, 0), (0, 0, 0))
    for missing in cycles:
        counts = counts.seen(missing)
    return counts


def test_the_drive_with_the_largest_share_of_lost_replies_is_named() -> None:
    first, second = (True, False, False), (False, True, False)
    begin = "largest share of lost replies: "
    assert counted().largest_share(NAMES) == ""
    assert counted((False,) * 3).largest_share(NAMES) == ""
    assert counted(first, second, second).largest_share(NAMES) == f"{begin}{NAMES[1]}, 2 of 3"
    both = f"{begin}{NAMES[0]}, {NAMES[1]}, 1 of 2 each"
    assert counted(first, second).largest_share(NAMES) == both
    assert counted((True,) * 3).largest_share(NAMES) == f"{begin}all 3 drives, 1 of 1 each"


@given(st.lists(st.tuples(st.booleans(), st.booleans(), st.booleans()), max_size=120))
def test_lost_replies_are_counted_in_all_and_in_the_last_cycles(
    cycles: list[tuple[bool, bool, bool]],
) -> None:
    counts = counted(*cycles)
    assert counts.cycles == len(cycles)
    assert counts.lost == tuple(sum(row[d] for row in cycles) for d in range(3))
    assert counts.lost_lately == tuple(sum(row[d] for row in cycles[-50:]) for d in range(3))


def test_counts_of_another_number_of_drives_are_an_error() -> None:
    with pytest.raises(ValueError, match="zip"):
        counted((True, False))


def test_every_fault_that_drives_report_stops_at_once():
    seen = replace(FINE, following=False, faults=((3, "over-current"), (0, "bus-off")))
    assert _look(seen) == (
        Alarm(StopReaction.QUICK_STOP, "drive_fault", "over-current", 3),
        Alarm(StopReaction.QUICK_STOP, "drive_fault", "bus-off", 0),
    )


@each_drive
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_following_error_may_be_the_limit_and_not_more(drive, sign):
    assert _look(_with("following_errors", drive, sign * 0.002)) == ()
    (found,) = _look(_with("following_errors", drive, sign * 0.00201))
    assert (found.reaction, found.code) == (StopReaction.QUICK_STOP, "following_error")
    assert found.text == (
        f"cable {drive + 1} is {sign * 2.01:.2f} mm from its set-point, limit 2.00 mm"
    )


def test_a_following_error_is_reported_in_millimetres():
    wide = Monitor.fresh(replace(LIMITS, following_error=0.5), NAMES)
    (found,) = wide.update(_with("following_errors", 0, 2.5))[1]
    assert found.text == "cable 1 is 2500.00 mm from its set-point, limit 500.00 mm"


@each_drive
@pytest.mark.parametrize("value", [NAN, float("inf"), -float("inf")])
def test_a_following_error_that_is_not_a_number_stops(drive, value):
    assert _codes(_with("following_errors", drive, value)) == [
        ("following_error", StopReaction.QUICK_STOP)
    ]


@each_drive
def test_a_drive_that_did_not_answer_is_not_judged_by_its_old_position(drive):
    """One lost reply is a note; the other drives are still judged."""
    seen = _with("missing", drive, True)
    old = replace(seen, following_errors=_put(FINE.following_errors, drive, NAN))
    assert _codes(old) == [("reply_lost", StopReaction.NOTE)]
    other = (drive + 1) % 3
    both = replace(old, following_errors=_put(old.following_errors, other, 0.1))
    assert _codes(both)[1] == ("following_error", StopReaction.QUICK_STOP)


@each_drive
@pytest.mark.parametrize(
    ("tension", "code"),
    [(4.99, "slack"), (0.5, "slack"), (100.01, "over_tension")],
)
def test_five_cycles_of_wrong_tension_in_a_row_stop_along_the_path(drive, tension, code):
    wrong = _with("tensions", drive, tension)
    assert _codes(*[wrong] * 4) == []
    assert _codes(*[wrong] * 5) == [(code, StopReaction.PATH_STOP)]
    assert _codes(*[wrong] * 6) == [(code, StopReaction.PATH_STOP)]
    assert _codes(*[wrong] * 4, FINE, *[wrong] * 4) == []
    (found,) = _look(*[wrong] * 5)
    assert found.drive == drive + 1
    assert found.text.startswith(f"cable {drive + 1} carries {tension:.1f} N, ")
    ending = {
        "slack": "less than 5.0 N: it may be slack",
        "over_tension": "more than 100.0 N",
    }
    assert found.text.endswith(ending[code])


@each_drive
@pytest.mark.parametrize("tension", [0.49, 0.0, -3.0])
def test_three_cycles_without_tension_in_a_row_are_a_quick_stop(drive, tension):
    none = _with("tensions", drive, tension)
    assert _codes(*[none] * 2) == []
    assert _codes(*[none] * 3) == [("cable_loose", StopReaction.QUICK_STOP)]
    assert _codes(*[none] * 9) == [("cable_loose", StopReaction.QUICK_STOP)]
    assert _codes(*[none] * 2, FINE, *[none] * 2) == []
    (found,) = _look(*[none] * 3)
    assert found.drive == drive + 1
    assert found.text == (
        f"cable {drive + 1} carries {tension:.1f} N, no tension: it is broken or slack"
    )


@pytest.mark.parametrize("may_disarm", [True, False])
def test_loose_cables_may_be_those_of_drives_that_disarm_before_they_report_it(may_disarm):
    def texts(*tensions: float) -> list[tuple[str, int]]:
        watch = Monitor.fresh(replace(LIMITS, may_disarm=may_disarm), NAMES)
        for _ in range(3):
            watch, found = watch.update(replace(FINE, tensions=tensions))
        assert {(each.code, each.reaction) for each in found} == {
            ("cable_loose", StopReaction.QUICK_STOP)
        }
        return [(each.text, each.drive) for each in found]

    none = "carries 0.0 N, no tension: it is broken or slack"
    none += ", or its drive is disarmed" * may_disarm
    assert texts(0.0, 20.0, 0.0) == [(f"cable 1 {none}", 1), (f"cable 3 {none}", 3)]
    every = "all 3 cables carry no tension: they are broken or slack, or their drives are disarmed"
    each = [(f"cable {n} {none}", n) for n in (1, 2, 3)]
    assert texts(0.0, 0.0, 0.0) == ([(every, 0)] if may_disarm else each)


@each_drive
def test_all_cables_are_loose_as_soon_as_the_first_is_and_the_others_have_no_tension(drive):
    def drives_of(*seen: Observation) -> list[int]:
        watch, found = Monitor.fresh(replace(LIMITS, may_disarm=True), NAMES), ()
        for each in seen:
            watch, found = watch.update(each)
        return [alarm.drive for alarm in found]

    none = replace(FINE, tensions=(0.0, 0.0, 0.0))
    assert drives_of(*[none] * 2) == []
    later = replace(none, tensions=_put(none.tensions, drive, 20.0))
    assert drives_of(later, none, none) == [0]
    assert len(drives_of(none, none, later)) == 2


@each_drive
@pytest.mark.parametrize("tension", [5.0, 100.0])
def test_the_limits_of_tension_themselves_are_allowed(drive, tension):
    assert _look(*[_with("tensions", drive, tension)] * 9) == ()


@each_drive
def test_a_tension_that_of_nan_counts_as_none_and_too_much(drive):
    assert _codes(*[_with("tensions", drive, NAN)] * 5) == [
        ("cable_loose", StopReaction.QUICK_STOP),
        ("over_tension", StopReaction.PATH_STOP),
    ]


@each_drive
def test_wrong_tensions_of_different_cables_do_not_add_up(drive):
    others = [d for d in range(3) if d != drive]
    cycles = [_with("tensions", d, 0.0) for d in (drive, *others, drive, *others)]
    assert _look(*cycles) == ()


def test_slack_and_over_tension_are_counted_apart():
    low, high = _with("tensions", 0, 2.0), _with("tensions", 0, 200.0)
    assert _look(*[low, high] * 5) == ()


def test_a_silent_drive_neither_resets_nor_adds_to_its_count_of_slack():
    low = _with("tensions", 1, 2.0)
    silent_low = replace(low, missing=(False, True, False))
    silent_fine = replace(FINE, missing=(False, True, False))
    assert [c for c, _ in _codes(*[low] * 4, silent_low)] == ["reply_lost"]
    assert [c for c, _ in _codes(*[low] * 4, silent_fine)] == ["reply_lost"]
    assert _codes(*[low] * 4, silent_fine, low) == [("slack", StopReaction.PATH_STOP)]
    high = _with("tensions", 1, 200.0)
    assert _codes(*[high] * 4, silent_fine, high) == [("over_tension", StopReaction.PATH_STOP)]
    none = _with("tensions", 1, 0.0)
    assert [c for c, _ in _codes(*[none] * 2, silent_fine)] == ["reply_lost"]
    assert _codes(*[none] * 2, silent_fine, none) == [("cable_loose", StopReaction.QUICK_STOP)]


@pytest.mark.parametrize("field", ["following_errors", "tensions"])
def test_drives_that_do_not_follow_are_not_judged_by_errors_and_tensions(field):
    seen = replace(_with(field, 0, NAN), following=False)
    assert _look(*[seen] * 9) == ()
    assert [c for c, _ in _codes(*[seen] * 9, replace(seen, faults=((0, "x"),)))] == ["drive_fault"]
    lost = replace(seen, missing=(True, False, False))
    assert _codes(lost, lost) == [("drive_silent", StopReaction.QUICK_STOP)]


def test_slack_before_the_drives_follow_does_not_count():
    low, none = _with("tensions", 0, 2.0), _with("tensions", 0, 0.0)
    assert _look(*[low] * 4, replace(low, following=False), *[low] * 4) == ()
    assert _look(*[none] * 2, replace(none, following=False), *[none] * 2) == ()


@pytest.mark.parametrize(
    ("lateness", "reaction"),
    [
        (0.0, None),
        (0.999, None),
        (1.0, StopReaction.PATH_STOP),
        (1.499, StopReaction.PATH_STOP),
        (1.5, StopReaction.QUICK_STOP),
        (1e9, StopReaction.QUICK_STOP),
        (NAN, StopReaction.QUICK_STOP),
    ],
)
def test_a_late_cycle_stops_along_the_path_and_a_very_late_one_at_once(lateness, reaction):
    found = _look(replace(FINE, lateness=lateness))
    if reaction is None:
        assert found == ()
        return
    assert found == (Alarm(reaction, "late", f"a cycle began {lateness:.1f} cycles late", 0),)
    assert found[0].drive == 0, "all of them"


def test_a_lateness_before_its_time_is_nothing():
    assert _look(replace(FINE, lateness=-0.5)) == ()


def test_everything_is_reported_at_once_gravest_first():
    seen = Observation(
        following=True,
        following_errors=(0.0, 0.1, 0.0),
        tensions=(20.0, 20.0, 2.0),
        missing=(True, False, False),
        faults=((1, "hot"),),
        lateness=3.0,
    )
    low = _with("tensions", 2, 2.0)
    assert [code for code, _ in _codes(*[low] * 4, seen)] == [
        "drive_fault",
        "reply_lost",
        "following_error",
        "slack",
        "late",
    ]


@pytest.mark.parametrize("field", ["following_errors", "tensions", "missing"])
@pytest.mark.parametrize("count", [0, 2, 4])
def test_an_observation_of_another_number_of_drives_is_an_error(field, count):
    """A row that is too short would hide the last drive."""
    values = (getattr(FINE, field) * 2)[:count]
    with pytest.raises(ValueError, match="entries for 3 drives"):
        Monitor.fresh(LIMITS, NAMES).update(replace(FINE, **{field: values}))


@given(
    cycles=st.lists(
        st.tuples(st.booleans(), st.sampled_from([0.0, 2.0, 20.0, 200.0]), st.booleans()),
        max_size=30,
    )
)
def test_counts_are_runs_of_what_was_seen(cycles):
    """Against counting by hand, for one drive."""
    watch = Monitor.fresh(LIMITS, NAMES[:1])
    missing = slack = loose = over = lost_ones = 0
    for following, tension, lost in cycles:
        seen = Observation(following, (0.0,), (tension,), (lost,), (), 0.0)
        watch, found = watch.update(seen)
        missing = missing + 1 if lost else 0
        lost_ones += lost
        if not lost:
            slack = slack + 1 if following and tension < 5.0 else 0
            loose = loose + 1 if following and tension < 0.5 else 0
            over = over + 1 if following and tension > 100.0 else 0
        assert (watch.missing, watch.slack) == ((missing,), (slack,))
        assert (watch.loose, watch.over) == ((loose,), (over,))
        wanted = {
            "drive_silent": missing >= 2 or lost_ones >= 10,
            "reply_lost": missing == 1 and lost_ones < 10,
            "slack": slack >= 5 and loose < 3,
            "cable_loose": loose >= 3,
            "over_tension": over >= 5,
        }
        assert {f.code for f in found} == {code for code, due in wanted.items() if due}


def test_looking_leaves_the_watch_before_unchanged():
    watch = Monitor.fresh(LIMITS, NAMES)
    watch.update(_with("missing", 0, True))
    assert watch == Monitor.fresh(LIMITS, NAMES)


def test_a_warning_stops_nothing() -> None:
    seen = replace(FINE, warnings=[(3, "mild")])
    _, alarms = Monitor.fresh(LIMITS, ("one", "two", "three")).update(seen)
    assert alarms == (Alarm(StopReaction.NOTE, "drive_warning", "mild", 3),)
