"""The SYNC master: when 0Fh may be sent, what it waits for, and how it leaves the drives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivers.drive_group import GroupCommand
from executor.control.sync_master import (
    GIVEN_UP_AFTER,
    ReplyTimeout,
    SyncMaster,
    changed_states,
    hold_timeout_text,
    late_fault,
    lost_states,
)
from executor.safety.sync_timeout import USUAL_TIMEOUT
from model.errors import Fault, HardwareMissing
from model.rig import load_rig
from tests.cli.plans import RIG

THE_RIG = load_rig(RIG)
CYCLE = THE_RIG.document.bus.cycle_ms / 1000.0
TARGETS = list(range(8))


class Clock:
    """Each cycle takes time; a cycle may begin late."""

    def __init__(self) -> None:
        self.now, self.late, self.cycles = 5.0, 0.0, 0

    @property
    def time(self) -> float:
        return self.now

    def next_cycle(self) -> float:
        self.cycles += 1
        self.now += CYCLE * (1.0 + self.late)
        return self.late

    def time_left(self) -> float:
        return 0.004

    def wait_to_decide(self) -> None:
        pass


class Group:
    """Drives with scripted answers."""

    def __init__(self, sync_timeout: float | None = 3.0, monitored_for: float = 0) -> None:
        self.capabilities = SimpleNamespace(
            sync_timeout=sync_timeout, master_timeout=0.101, unmonitored_within=3.0
        )
        self.targets = np.array(TARGETS)
        self.sent: list[tuple[tuple[int, ...], bool]] = []
        self.commands: list[object] = []
        self.missing = [False] * 8
        self.paced: list[float] = []
        self.monitored_for, self.asked = monitored_for, 0
        self.left = 0.0

    def send_cycle(self, targets: Sequence[int], may_send: Callable[[bool], bool]) -> None:
        self.sent.append((tuple(targets), may_send(True)))

    def receive(self, left: float) -> Any:
        self.left = left
        return SimpleNamespace(missing=np.array(self.missing), number=len(self.sent))

    def read_positions(self, pace: Callable[[], float]) -> str:
        self.paced = [pace(), pace()]
        return "read"

    def read_state(self, pace: Callable[[], float]) -> str:
        self.paced = [pace()]
        return "looked"

    def quick_stop_now(self) -> None:
        self.commands.append("stop")

    def command(self, command: GroupCommand) -> None:
        self.commands.append(command)

    @property
    def ending(self) -> frozenset[int]:
        self.asked += 1
        return frozenset({2} if self.asked <= self.monitored_for else ())

    @property
    def is_monitored(self) -> bool:
        return self.asked <= self.monitored_for


def made(**group: Any) -> tuple[SyncMaster, Any, Clock]:
    clock, drives = Clock(), Group(**group)
    return SyncMaster(THE_RIG, drives, clock), drives, clock  # type: ignore[arg-type]


@pytest.mark.parametrize(("given", "kept"), [(3.0, 3.0), (1.5, 1.5), (None, USUAL_TIMEOUT)])
def test_the_rule_is_that_of_the_drives(given: float | None, kept: float) -> None:
    assert made(sync_timeout=given)[0].rule.timeout == kept


def test_a_cycle_is_sent_and_its_replies_are_the_status() -> None:
    master, group, _ = made()
    assert (master.status, master.overdue) == (None, 0.0)
    assert master.begin() == 0.0
    status = master.exchange([3] * 8)
    assert master.status is status
    assert group.sent == [((3,) * 8, True)]
    assert group.left == 0.004


@pytest.mark.parametrize(
    ("late", "may"), [(0.0, True), (1.49, True), (1.51, False), (2.0, False), (9.0, False)]
)
def test_drives_are_not_enabled_when_the_last_sync_is_too_old(late: float, may: bool) -> None:
    master, group, clock = made()
    assert master.age == 0.0
    master.begin()
    master.exchange(TARGETS)
    assert (group.sent[-1][1], master.overdue) == (True, 0.0)
    clock.late = late
    assert master.begin() == late
    assert master.age == pytest.approx(1.0 + late)
    master.exchange(TARGETS)
    assert group.sent[-1][1] is may
    assert master.overdue == (0.0 if may else pytest.approx(1.0 + late))
    clock.late = 0.0
    master.begin()
    master.exchange(TARGETS)
    assert (group.sent[-1][1], master.overdue) == (True, 0.0), "that SYNC was the last one"


def test_a_stop_counts_as_a_sync() -> None:
    master, group, clock = made()
    master.begin()
    master.exchange(TARGETS)
    clock.now += 7.0 * CYCLE
    master.stop_now()
    assert group.commands == ["stop"]
    assert master.age == 0.0


def test_positions_are_read_in_cycles_that_count() -> None:
    master, group, clock = made()
    assert master.read_positions() == "read"
    assert master.status == "read"
    assert (clock.cycles, group.paced) == (2, [0.004, 0.004])
    clock.now += CYCLE
    assert master.age == pytest.approx(1.0)


def test_the_cycle_continues_until_the_message_arrives() -> None:
    master, group, clock = made()
    words: list[int | None] = [None, None, None, 0]
    assert master.cycle_until(lambda: words.pop(0)) == 0
    assert clock.cycles == 3
    assert group.sent == [(tuple(TARGETS), True)] * 3


def test_a_drive_that_falls_silent_before_the_word_is_named() -> None:
    master, group, _ = made()
    group.missing[4] = True
    with pytest.raises(HardwareMissing, match=r"cable 5 \(drive 5\) stopped answering") as caught:
        master.cycle_until(lambda: None)
    assert len(group.sent) == 2
    assert caught.value.where == "arming"
    assert "nothing was enabled" in caught.value.next_step


def test_drives_that_fall_silent_all_at_once_have_one_cause() -> None:
    master, group, _ = made()
    group.missing = [True] * len(group.missing)
    with pytest.raises(HardwareMissing, match=r"all 8 drives stopped .*: bus or supply"):
        master.cycle_until(lambda: None)


def test_it_leaves_as_soon_as_no_drive_watches_it() -> None:
    master, group, clock = made(monitored_for=3)
    cycles: list[None] = []
    assert master.leave(lambda: cycles.append(None) is None) == "looked"
    assert group.commands == [GroupCommand.END_MONITORING]
    assert len(cycles) == 3
    assert clock.cycles == 1, "only the reading: no time-out of a drive is waited for"
    assert master.status == "looked"
    assert master.age == 0.0


def test_a_monitoring_that_stays_on_is_waited_for_in_silence() -> None:
    """For the longest end; then the drives' own time-out must be over."""
    master, group, clock = made(monitored_for=10_000)
    cycles: list[None] = []
    master.leave(lambda: cycles.append(None) is None)
    assert len(cycles) == 300
    assert clock.cycles == 12 + 1
    assert clock.now - 5.0 > group.capabilities.master_timeout + CYCLE


PATIENT = round(GIVEN_UP_AFTER / CYCLE)


@pytest.mark.parametrize(
    ("missed", "lasts"),
    [
        ([], 300),
        ([70], 300),
        (range(60, 60 + PATIENT - 1), 300),
        (range(PATIENT), PATIENT),
        (range(60, 200), 60 + PATIENT),
    ],
)
def test_a_drive_is_given_up_only_when_it_was_silent_all_the_while(
    missed: Sequence[int], lasts: int
) -> None:
    """One lost reply cut the end short, while the drives still watched this master."""
    master, group, _ = made(monitored_for=10_000)
    cycles: list[int] = []

    def cycle() -> bool:
        group.missing[2] = len(cycles) in missed
        cycles.append(len(cycles))
        master.begin()
        master.exchange(TARGETS)
        return True

    master.leave(cycle)
    assert len(cycles) == lasts


def test_another_drive_that_is_silent_does_not_end_the_end() -> None:
    master, group, _ = made(monitored_for=100)
    cycles: list[None] = []

    def cycle() -> bool:
        group.missing[5] = True
        cycles.append(None)
        master.begin()
        master.exchange(TARGETS)
        return True

    master.leave(cycle)
    assert len(cycles) == 100


def test_no_further_cycle_is_wanted_when_the_gate_denies_one() -> None:
    master, _group, _ = made(monitored_for=10_000)
    wanted = [True, False]
    master.leave(lambda: wanted.pop(0))
    assert wanted == []


def test_after_the_end_the_age_of_sync_is_forgotten() -> None:
    """Reading without SYNC must not make a later first cycle a stop."""
    master, group, clock = made()
    master.begin()
    master.exchange(TARGETS)
    master.read_state()
    assert group.paced == [0.004]
    clock.now += 100.0 * CYCLE
    assert master.age == 0.0


def test_drives_that_were_never_enabled_are_left_where_they_are() -> None:
    master, group, clock = made(monitored_for=2)
    master.leave_disabled()
    assert group.sent == [(tuple(TARGETS), True)] * 2
    assert clock.cycles == 3
    assert master.status == "looked"


def test_a_bus_that_fails_then_is_left_as_it_is() -> None:
    master, group, _ = made(monitored_for=2)

    def fails(*_frames: object) -> None:
        raise Fault("bus-off")

    group.send_cycle = fails
    master.leave_disabled()
    assert master.status is None


def test_lateness_counts_from_when_the_cycle_was_due() -> None:
    error = late_fault(2.6)
    assert error.what == "a cycle began 1.6 cycles late"
    assert "cdpr reset" in error.next_step


def test_a_frame_that_goes_out_too_late_after_all_is_a_stop_at_once() -> None:
    """This process may be suspended between its decision and SYNC."""
    master, group, clock = made()
    master.begin()
    master.exchange(TARGETS)
    send = group.send_cycle

    def suspended(targets: Sequence[int], may_send: Callable[[bool], bool]) -> None:
        send(targets, may_send)
        clock.now += held_up * CYCLE

    group.send_cycle = suspended
    held_up = 1.4
    master.begin()
    master.exchange(TARGETS)
    assert (master.overdue, group.commands) == (0.0, [])
    clock.now -= held_up * CYCLE
    held_up = 1.6
    master.begin()
    master.exchange(TARGETS)
    assert group.sent[-1][1] is True
    assert group.commands == ["stop"]
    assert master.overdue == pytest.approx(2.6)


def test_what_enables_nothing_is_sent_however_late() -> None:
    master, group, clock = made()
    group.send_cycle = lambda _targets, may_send: group.sent.append(may_send(False))
    for _ in range(2):
        clock.now += 50.0 * CYCLE
        master.begin()
        master.exchange(TARGETS)
    assert group.sent == [True, True]
    assert (master.overdue, group.commands) == (0.0, [])


@pytest.mark.parametrize(("age", "cycles"), [(0.0, 0), (0.9, 0), (1.0, 1), (1.7, 1)])
def test_a_cycle_is_kept_where_the_last_one_is_over(age: float, cycles: int) -> None:
    master, group, clock = made()
    clock.now = 0.0
    master.stop_now()
    clock.now = age * CYCLE
    master.refresh()
    assert len(group.sent) == cycles


@pytest.mark.parametrize(
    ("missed", "silent"),
    [([], False), ([0], False), ([0, 2, 4], False), ([3, 4], True), ([0, 1], True)],
)
def test_silence_counts_in_a_row_and_stays(missed: list[int], silent: bool) -> None:
    timeout = ReplyTimeout(THE_RIG)
    for cycle in range(6):
        missing = np.zeros(8, dtype=bool)
        missing[6] = cycle in missed
        timeout.take(SimpleNamespace(missing=missing))  # type: ignore[arg-type]
    words = {"where": "here", "why": "so", "next_step": "look"}
    if silent:
        with pytest.raises(HardwareMissing, match=r"^here: cable 7 \(drive 7\) stopped answering"):
            timeout.require_none("meanwhile", **words)
    else:
        timeout.require_none("meanwhile", **words)


HELD, FAILED, ENABLED = 0x0607, 0x0218, 0x0627


def reported(words: Sequence[int], silent: Sequence[int] = (), faults: Sequence[str] = ()) -> Any:
    missing = np.array([drive in silent for drive in range(8)])
    of_the_last = [(8, text) for text in faults]
    return SimpleNamespace(status_words=np.array(words), missing=missing, faults=of_the_last)


@pytest.mark.parametrize(
    ("words", "silent", "but", "expected"),
    [
        ([HELD] * 8, [], [], ""),
        ([HELD] * 7 + [FAILED], [], [], "cable 8 (drive 8) went from quick stop active to fault"),
        ([HELD] * 8, [1], [], "cable 2 (drive 2) does not answer"),
        ([HELD] * 7 + [FAILED], [1], [7], "cable 2 (drive 2) does not answer"),
        ([HELD] * 7 + [FAILED], [1], [1, 7], ""),
        ([FAILED] + [HELD] * 7, [0], [], "cable 1 (drive 1) does not answer"),
    ],
)
def test_drives_that_are_not_as_they_were_left_are_named(
    words: list[int], silent: list[int], but: list[int], expected: str
) -> None:
    said = changed_states(THE_RIG, reported([HELD] * 8), reported(words, silent), but)
    assert said == (f"drives left the state they held in: {expected}" if expected else "")


@pytest.mark.parametrize(
    ("before", "silent", "but", "expected"),
    [
        (ENABLED, [], [], "drives still enabled: cable 8 (drive 8)"),
        (ENABLED, [], [7], "drives still enabled: cable 8 (drive 8)"),
        (HELD, [], [7], "drives still enabled: cable 8 (drive 8)"),
        (ENABLED, [7], [7], ""),
        (
            HELD,
            [],
            [],
            "drives left the state they held in: cable 8 (drive 8) went from quick stop active to"
            " operation enabled",
        ),
        (
            ENABLED,
            [1],
            [],
            "drives still enabled: cable 8 (drive 8); drives left the state they held in: cable 2"
            " (drive 2) does not answer",
        ),
    ],
)
def test_a_drive_that_is_still_enabled_is_named_even_if_it_was_so_before(
    before: int, silent: list[int], but: list[int], expected: str
) -> None:
    words = [HELD] * 7
    after = reported([*words, ENABLED], silent)
    assert changed_states(THE_RIG, reported([*words, before]), after, but) == expected


@pytest.mark.parametrize(
    ("before", "silent_before", "silent", "said", "expected"),
    [
        (HELD, [], [7], "", "does not answer"),
        (HELD, [7], [7], "", "does not answer"),
        (HELD, [7], [7], "cable 8 (drive 8) did not answer for 2 cycles", ""),
        (HELD, [7], [7], "all 8 drives did not answer for 2 cycles", ""),
        (HELD, [], [7], "cable 8 (drive 8): hot", "does not answer"),
        (HELD, [7], [7], "cable 7 (drive 7), cable 8 (drive 8) did not answer for 2 cycles", ""),
        (HELD, [7], [7], "cable 8 (drive 8) did not move for 2 cycles", "does not answer"),
        (HELD, [7], [7], "cable 8 (drive 8) did not answer in 10 of the last 50 cycles", "answer"),
        (ENABLED, [], [7], "", "does not answer"),
        (ENABLED, [7], [], "", ""),
        (0x0240, [], [7], "", "does not answer"),
    ],
)
def test_after_a_stop_silent_drives_are_added_that_its_cause_does_not_name_as_silent(
    before: int, silent_before: list[int], silent: list[int], said: str, expected: str
) -> None:
    words = [HELD] * 7
    earlier = reported([*words, before], silent_before)
    after = reported([*words, HELD if before == ENABLED and not silent else before], silent)
    found = lost_states(THE_RIG, earlier, after, range(1, 9), f"hot; {said}; quick stop")
    assert found.endswith(expected) if expected else not found
    assert not lost_states(THE_RIG, earlier, after, range(1, 8), said), "it never held"


OFF = 0x0240
OWN = "cable 8 (drive 8) stopped on its own: quick stop active"
HOT = "cable 8 (drive 8): hot"


@pytest.mark.parametrize(
    ("before", "after", "faults", "cause", "expected"),
    [
        (HELD, HELD, [OWN], "", ""),
        (FAILED, FAILED, [HOT], "", HOT),
        (FAILED, FAILED, [HOT], HOT, ""),
        (FAILED, FAILED, [OWN, HOT], OWN, HOT),
        (
            HELD,
            FAILED,
            [OWN],
            OWN,
            "drives left the state they held in: cable 8 (drive 8) went from quick stop active to"
            " fault",
        ),
        (OFF, OFF, [], "", "cable 8 (drive 8) is in switch on disabled"),
        (ENABLED, ENABLED, [HOT], HOT, "drives still enabled: cable 8 (drive 8)"),
    ],
)
def test_after_a_stop_a_drive_may_not_hold_by_its_state_whatever_was_reported(
    before: int, after: int, faults: list[str], cause: str, expected: str
) -> None:
    words = [HELD] * 7
    found = reported([*words, after], faults=faults)
    earlier = reported([*words, before])
    assert lost_states(THE_RIG, earlier, found, range(1, 9), f"{cause}; quick stop") == expected


def test_a_time_out_names_drives_that_do_not_hold_and_missing_replies() -> None:
    status = reported([*[HELD] * 6, ENABLED, HELD], [2, 3])
    assert hold_timeout_text(THE_RIG, status, 3.0, was_enabled=True) == (
        "the drives did not hold within 3 s; cable 7 (drive 7) is in operation enabled; no reply"
        " from cable 3 (drive 3), cable 4 (drive 4) in the last cycle"
    )
    none = hold_timeout_text(THE_RIG, None, 3.0, was_enabled=True)
    assert none == "the drives did not hold within 3 s"


def test_a_time_out_while_enabling_names_only_drives_that_stay_enabled() -> None:
    status = reported([*[OFF] * 6, ENABLED, 0x0233])
    assert hold_timeout_text(THE_RIG, status, 3.0, was_enabled=False) == (
        "the drives did not hold within 3 s; cable 7 (drive 7) is in operation enabled"
    )
