"""Several drives with one cause are one message, and the verdict does not contradict it."""

from __future__ import annotations

from executor.recording.summary import summarize
from executor.safety.fault_messages import (
    NOTE_EVENTS,
    Alarm,
    AlarmHistory,
    StopReaction,
    drive_warning,
    not_taut,
    over_tension,
    replies_missing,
    shared_causes,
    slack,
    stuck,
    went_slack,
)
from executor.safety.monitor import Monitor, MonitorLimits, Observation
from tests.executor import fake_run

NAMES = [f"cable {k} (drive {k + 10})" for k in range(1, 9)]


def silent(*drives: int, cycles: int = 2) -> tuple[Alarm, ...]:
    """Alarms when these drives do not answer for a number of cycles."""
    watch = Monitor.fresh(MonitorLimits(1e-3, 2.0, 50.0, 0.5), NAMES)
    found: tuple[Alarm, ...] = ()
    missing = [drive in drives for drive in range(1, 9)]
    for _ in range(cycles):
        watch, found = watch.update(Observation(True, [0.0] * 8, [9.0] * 8, missing, [], 0.0))
    return found


def test_all_drives_that_fall_silent_at_once_are_one_cause() -> None:
    (alarm,) = shared_causes(silent(*range(1, 9)), NAMES)
    assert alarm.text == "all 8 drives did not answer for 2 cycles: bus or supply"
    assert (alarm.code, alarm.reaction, alarm.drive) == (
        "drive_silent",
        StopReaction.QUICK_STOP,
        0,
    )
    (note,) = shared_causes(silent(*range(1, 9), cycles=1), NAMES)
    assert note.text == "all 8 drives did not answer for 1 cycle: bus or supply"


def test_drives_that_often_do_not_answer_are_one_cause_too() -> None:
    missed = [replies_missing(k, NAMES[k - 1], 10, 50) for k in range(1, 9)]
    (alarm,) = shared_causes(missed, NAMES)
    assert alarm.text == "all 8 drives did not answer in 10 of the last 50 cycles: bus or supply"
    assert (alarm.code, alarm.reaction) == ("drive_silent", StopReaction.PATH_STOP)


def test_only_alarms_of_one_code_and_one_text_are_merged() -> None:
    """The reaction goes with the code, the number of cycles with the text."""
    often, in_a_row = replies_missing(1, NAMES[0], 10, 50), silent(2)
    assert shared_causes([often, *in_a_row], NAMES) == (often, *in_a_row)
    note = Alarm(StopReaction.NOTE, "reply_lost", f"{NAMES[0]} did not answer", 1)
    stop = Alarm(StopReaction.QUICK_STOP, "drive_silent", f"{NAMES[1]} did not answer", 2)
    assert shared_causes([note, stop], NAMES) == (note, stop)


def test_some_drives_are_named_and_one_keeps_its_own_text() -> None:
    (alarm,) = shared_causes(silent(2, 5), NAMES)
    assert alarm.text == ("cable 2 (drive 12), cable 5 (drive 15) did not answer for 2 cycles")
    assert shared_causes(silent(3), NAMES) == silent(3)


def test_other_findings_keep_their_order_and_their_texts() -> None:
    late = Alarm(StopReaction.PATH_STOP, "late", "a cycle began 2.0 cycles late")
    slack = [Alarm(StopReaction.PATH_STOP, "slack", f"cable {k} carries 1.0 N", k) for k in (1, 2)]
    both = shared_causes([slack[0], *silent(1, 2), slack[1], late], NAMES)
    assert [alarm.code for alarm in both] == ["slack", "drive_silent", "slack", "late"]
    apart = shared_causes([silent(1, 2)[0], late, silent(1, 2)[1]], NAMES)
    assert [alarm.code for alarm in apart] == ["drive_silent", "late"], "where the first one was"
    assert shared_causes([*slack, late], NAMES) == (*slack, late)
    faults = tuple(
        Alarm(StopReaction.QUICK_STOP, "drive_fault", f"{NAMES[k - 1]} is in fault", k)
        for k in (1, 2)
    )
    assert shared_causes(faults, NAMES) == faults, "drives rarely fail for one cause"


def test_a_torque_that_pays_a_cable_out_names_its_sign() -> None:
    assert over_tension(3, 103.0, 102.0) == Alarm(
        StopReaction.PATH_STOP, "over_tension", "cable 3 carries 103.0 N, more than 102.0 N", 3
    )
    for positive in (0.0, 0.5):
        assert over_tension(3, positive, 102.0).text.startswith("cable 3 carries")
    for negative in (-0.5, -103.0):
        text = over_tension(3, negative, 102.0).text
        assert text.startswith(f"the torque of cable 3 pays it out with {-negative:.1f} N, more")


def test_what_homing_finds_slack_is_told_in_millimetres_and_ends_on_the_path() -> None:
    found = not_taut(4, 1.25, 0.0505, 20.0, 0.0014)
    assert (found.reaction, found.code, found.drive) == (StopReaction.PATH_STOP, "not_taut", 4)
    assert found.text.startswith(
        "cable 4 carries 1.2 N after 50.5 mm were wound in; the target is 20.0 N, at which it is"
        " stretched by 1.4 mm."
    )
    # Four and two digits would hide a factor that is off by a thousandth.
    assert " 6996 mm" in not_taut(4, 1.2, 6.996, 20.0, 0.0).text
    assert " 9.9e+02 mm" in not_taut(4, 1.2, 0.1, 20.0, 0.9945).text
    assert " 1e+03 mm" in not_taut(4, 1.2, 0.1, 20.0, 0.9955).text
    slackened = went_slack(2, 0.4, 2.5, 7)
    assert slackened == Alarm(
        StopReaction.PATH_STOP,
        "went_slack",
        "cable 2 went slack (0.4 N, less than 2.5) while only cable 7 was moved",
        2,
    )


def test_ten_events_of_one_note_are_enough() -> None:
    assert NOTE_EVENTS == 10


def missed(drive: int) -> Alarm:
    return stuck(drive, NAMES[drive - 1], 1, fault=False, may_disarm=False)


def test_a_condition_that_persists_or_returns_is_reported_once_with_its_first_values() -> None:
    history = AlarmHistory()
    texts = [history.new_text(slack(3, 0.1 * cycle, 5.0), cycle) for cycle in (0, 1, 2, 9, 20)]
    assert texts == [slack(3, 0.0, 5.0).text, "", "", "", ""]
    assert history.new_text(slack(4, 2.1, 5.0), 20), "another cable"


def test_a_note_that_returns_is_new_and_one_that_persists_is_not() -> None:
    history = AlarmHistory()
    cycles = [0, 1, 1, 2, 4, 5, 7]
    new = [bool(history.new_text(missed(2), cycle)) for cycle in cycles]
    assert new == [True, False, False, False, True, False, True]
    assert history.new_text(missed(3), 7) == missed(3).text, "another drive"


def test_notes_that_keep_returning_do_not_fill_the_record() -> None:
    history, warning = AlarmHistory(), drive_warning(3, "cable 3 (drive 13) reports 3280h")
    texts = [history.new_text(warning, 2 * n) for n in range(1, NOTE_EVENTS + 5)]
    assert texts[: NOTE_EVENTS - 1] == [warning.text] * (NOTE_EVENTS - 1)
    assert texts[NOTE_EVENTS - 1] == f"{warning.text}; no more are recorded"
    assert set(texts[NOTE_EVENTS:]) == {""}
    other = drive_warning(3, "cable 3 (drive 13) reports 4210h")
    assert history.new_text(other, 2 * NOTE_EVENTS + 10) == other.text, "another warning"


def test_a_run_that_was_stopped_for_silent_drives_did_not_lose_few_replies() -> None:
    from dataclasses import replace

    from executor.recording.run_folder import RunEvent

    run = fake_run.make(rate_hz=1.0, every=100, camera=False)
    cycles = replace(run.cycles, missing=run.cycles.missing + 1)
    event = RunEvent(1.0, "drive_silent", "all 8 drives did not answer for 2 cycles")
    for codes, passed in (((), True), ((event,), False)):
        state = "finished" if passed else "latched"
        changes = {"simulated": False, "events": codes, "final_state": state}
        context = fake_run.changed(run.context, **changes)
        checks = summarize(context, cycles, run.poses, run.clearance)["checks"]
        (check,) = (check for check in checks if check["name"] == "lost_replies")
        assert check["passed"] is passed, check
        assert ("too few to stop" in check["text"]) is passed
