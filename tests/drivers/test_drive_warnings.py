"""Emergencies of drives: those listed as warnings are remarks, any other stops all at once."""

from __future__ import annotations

import pytest

from drivers.cia402.monitor import DriveMonitor
from drivers.cia402.pdo import EMCY_BASE, TPDO1_BASE, NmtCommand, make_emergency
from drivers.cia402.state_machine import DriveState, Goal
from drivers.drive_group import GroupState
from model.files.drive_profile_file import ProfileDocument
from simulation.drives.cia402 import SimulatedDrive
from tests.drivers.drive_bench import Bench, make_reply

NAMES = {3: "cable 1 (drive 3)", 5: "cable 2 (drive 5)"}
ENABLED, FAULT = 0x0237, 0x0218
HOT, MILD = 0x4310, 0x4390


def watch_of(*words: int) -> DriveMonitor:
    """After a cycle in which the drives had these status words; 43 9x are mere warnings."""
    watch = DriveMonitor(NAMES, [1e9] * 2, lambda code: code & 0xFFF0 == 0x4390)
    cycle(watch, *words)
    return watch


def cycle(watch: DriveMonitor, *words: int) -> None:
    watch.begin_cycle()
    for node, word in zip(NAMES, words, strict=True):
        watch.take(TPDO1_BASE + node, make_reply(word, 0, 0))
    watch.end_cycle()


def own_changes(watch: DriveMonitor) -> list[tuple[int, str]]:
    return watch.changes_on_their_own(Goal.ENABLE, enables=True)


def test_a_listed_warning_is_reported_in_its_cycle() -> None:
    watch = watch_of(ENABLED, ENABLED)
    watch.take(EMCY_BASE + 5, make_emergency(MILD, 1))
    (warning,) = watch.warnings()
    assert warning.node == 5
    assert f"{MILD:04X}h" in warning.text
    assert watch.warnings() == ()
    cycle(watch, ENABLED, ENABLED)
    assert not watch.news()
    assert not own_changes(watch)
    assert not watch.state_faults((), powered=True)


@pytest.mark.parametrize("before", [ENABLED, 0x0233])
def test_any_other_emergency_counts_before_the_reply_that_may_never_come(before: int) -> None:
    watch = watch_of(before, ENABLED)
    watch.take(EMCY_BASE + 3, make_emergency(HOT, 1))
    ((node, text),) = watch.news()
    assert node == 3
    assert f"{HOT:04X}h" in text
    assert watch.warnings() == ()


def test_a_listed_warning_of_a_drive_that_stops_is_the_cause_of_its_fault() -> None:
    watch = watch_of(ENABLED, ENABLED)
    watch.take(EMCY_BASE + 5, make_emergency(MILD, 1))
    cycle(watch, ENABLED, FAULT)
    assert not own_changes(watch), "a fault has its own message"
    ((node, text),) = watch.state_faults((), powered=True)
    assert node == 5
    assert f"{MILD:04X}h" in text


def test_a_listed_warning_is_none_other_while_a_drive_is_being_enabled() -> None:
    watch = watch_of(0x0233, ENABLED)
    watch.take(EMCY_BASE + 3, make_emergency(MILD, 1))
    assert not watch.news()
    assert [warning.node for warning in watch.warnings()] == [3]


LIMITED = 0x0800


def test_a_limit_that_a_drive_reaches_while_it_is_enabled_is_a_warning() -> None:
    watch = watch_of(ENABLED, ENABLED)
    cycle(watch, ENABLED | LIMITED, ENABLED)
    (warning,) = watch.warnings()
    assert warning.node == 3
    assert "internal limit is active (bit 11 of 6041h)" in warning.text
    cycle(watch, ENABLED | LIMITED, ENABLED)
    assert watch.warnings() == ()
    assert not own_changes(watch)


@pytest.mark.parametrize("before", [0x0233, 0x0217])
def test_a_bit_that_is_set_from_the_start_warns_of_nothing(before: int) -> None:
    """Some makers set it always, others as soon as the drive is enabled."""
    watch = watch_of(before, before)
    cycle(watch, ENABLED | LIMITED, before | LIMITED)
    cycle(watch, ENABLED | LIMITED, before)
    assert watch.warnings() == ()


@pytest.mark.parametrize(
    ("word", "said"),
    [
        (0x0240, "voltage enabled) is 0: mains power is off, safe torque off (STO) is active, or"),
        (0x0221, "voltage enabled) is 0"),
        (0x0050, "bit 9 (remote) is 0"),
        (0x0250, "switch on disabled"),
        (0x0207, "quick stop active"),
    ],
)
def test_a_drive_that_loses_its_power_says_so(word: int, said: str) -> None:
    """It "stopped on its own: switch on disabled", whether its mains failed or its STO was open."""
    watch = watch_of(ENABLED, ENABLED)
    own_changes(watch)
    cycle(watch, ENABLED, word)
    ((node, text),) = own_changes(watch)
    assert node == 5
    assert text.startswith("cable 2 (drive 5) stopped on its own: ")
    assert said in text
    assert (";" in text) == ("bit" in said or "voltage" in said)


def test_a_reason_that_is_over_is_reported_as_such() -> None:
    watch = watch_of(ENABLED, ENABLED)
    watch.take(EMCY_BASE + 5, make_emergency(HOT, 1))
    watch.take(EMCY_BASE + 5, make_emergency(0, 0))
    cycle(watch, ENABLED, FAULT)
    ((_, text),) = watch.state_faults((), powered=True)
    assert "4310h" in text
    assert text.endswith("reported as over since")


def answers_after_its_set_points(drive: SimulatedDrive) -> None:
    """It fills in the status word after it took the control word; no standard forbids it."""
    on_sync = drive.on_sync

    def answer() -> None:
        waiting, drive._waiting = drive._waiting, {}
        for received, values in waiting.values():
            drive._take(received, values)
        on_sync()

    drive.on_sync = answer  # type: ignore[method-assign]


def enabled_again(bench: Bench) -> list[int]:
    """Nodes of drives that are enabled after they stopped themselves, as it happens."""
    found: list[int] = []

    def counts(drive: SimulatedDrive) -> None:
        enable = drive._command_enable

        def command_enable() -> None:
            found.append(drive.node)
            enable()

        drive._command_enable = command_enable  # type: ignore[method-assign]

    for drive in bench.drives:
        counts(drive)
    return found


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("code", [0x8612, HOT, 0xFF00])
def test_a_drive_that_stopped_itself_is_not_enabled_again(
    bench: Bench, code: int, late: bool
) -> None:
    """Transition 16 is by level: 0Fh and a new target followed an emergency that had come."""
    bench.enable()
    drive, again = bench.drives[2], enabled_again(bench)
    if late:
        answers_after_its_set_points(drive)
    drive._emergency(code)
    drive._quick_stop()
    bench.control_words()
    for _ in range(5):
        bench.cycle(bench.lifted(0.0005))
    assert set(bench.control_words()) == {0x02}
    assert again == []
    assert {d.state for d in bench.drives} == {DriveState.QUICK_STOP_ACTIVE}
    assert bench.status is not None
    ((node, text),) = bench.status.faults
    assert (node, text.startswith("cable 3 (drive 3): ")) == (3, True)
    assert f"{code:04X}h" in text


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("node", [1, 3, 8])
def test_drives_that_miss_a_heartbeat_stay_stopped_and_the_silent_one_is_named(
    bench: Bench, node: int, late: bool
) -> None:
    """Seven stopped, were enabled again, and were blamed; the one at fault was not named."""
    bench.enable()
    again = enabled_again(bench)
    if late:
        for drive in bench.drives:
            answers_after_its_set_points(drive)
    silent = bench.drives[node - 1]
    last = silent._own_heartbeat_due - silent._heartbeat_period
    silent._heartbeat_period = 0.0
    while silent._now < last + 0.085:
        bench.cycle()
    bench.rehearsal.advance(0.02)  # they stop between two cycles, after 100 ms
    assert again == []
    bench.control_words()
    for _ in range(3):
        bench.cycle()
    assert set(bench.control_words()) == {0x02}
    assert again == []
    assert {d.state for d in bench.drives} == {DriveState.QUICK_STOP_ACTIVE}
    culprit, *others = bench.status.faults
    assert culprit == (node, f"cable {node} (drive {node}) sends no heartbeat")
    assert sorted(number for number, _ in others) == [n for n in range(1, 9) if n != node]
    assert all("8130h" in text for _, text in others)


def test_a_heartbeat_of_the_master_that_is_missed_blames_no_drive(bench: Bench) -> None:
    bench.enable()
    bench.drives[4]._emergency(0x8130)
    for _ in range(3):
        bench.cycle()
    assert bench.status is not None
    assert [node for node, _ in bench.status.faults] == [5]


@pytest.mark.parametrize("operational", [True, False])
def test_the_cause_is_kept_of_a_drive_in_fault_that_falls_silent(
    bench: Bench, operational: bool
) -> None:
    """It "did not answer for 2 cycles", or "left NMT operational": 3210h was nowhere."""
    bench.enable()
    drive = bench.drives[2]
    drive.fail(0x3210)
    if operational:
        drive.silent = True
    else:
        drive.on_nmt(NmtCommand.PRE_OPERATIONAL, 3)
    bench.control_words()
    bench.cycle(bench.lifted(0.0005))
    assert set(bench.control_words()) == {0x02}
    assert bench.status is not None
    assert bench.status.faults[0][0] == 3
    assert "DC link over-voltage (error 3210h)" in bench.status.faults[0][1]


def test_a_listed_warning_stops_nothing(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ProfileDocument, "is_warning", lambda _profile, code: code == MILD)
    bench.enable()
    bench.drives[2]._emergency(MILD)
    statuses = [bench.cycle() for _ in range(3)]
    assert all(status.state is GroupState.ENABLED and not status.faults for status in statuses)
    assert [w.node for status in statuses for w in status.warnings] == [3]
