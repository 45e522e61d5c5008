"""Emergencies of drives that stay enabled: a remark or a path stop, and never a quick stop."""

from __future__ import annotations

import pytest

from drivers.cia402.monitor import DriveMonitor
from drivers.cia402.pdo import EMCY_BASE, TPDO1_BASE, make_emergency, make_reply
from drivers.cia402.state_machine import Goal
from drivers.drive_group import GroupState
from tests.drivers.drive_bench import Bench

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


@pytest.mark.parametrize(("code", "stops"), [(MILD, False), (HOT, True)])
def test_a_drive_that_stays_enabled_warns_one_cycle_later(code: int, stops: bool) -> None:
    watch = watch_of(ENABLED, ENABLED)
    watch.take(EMCY_BASE + 5, make_emergency(code, 1))
    assert watch.warnings() == (), "the drive may be about to stop"
    cycle(watch, ENABLED, ENABLED)
    (warning,) = watch.warnings()
    assert (warning.node, warning.stops) == (5, stops)
    assert f"{code:04X}h" in warning.text
    assert watch.warnings() == ()
    assert not watch.news()
    assert not own_changes(watch)
    assert not watch.state_faults((), powered=True)


@pytest.mark.parametrize("code", [MILD, HOT])
def test_a_drive_that_leaves_the_state_is_a_fault_with_its_reason(code: int) -> None:
    watch = watch_of(ENABLED, ENABLED)
    watch.take(EMCY_BASE + 5, make_emergency(code, 1))
    cycle(watch, ENABLED, FAULT)
    assert watch.warnings() == ()
    assert not own_changes(watch), "a fault has its own message"
    ((node, text),) = watch.state_faults((), powered=True)
    assert node == 5
    assert f"{code:04X}h" in text


def test_a_mere_warning_is_none_other_while_a_drive_is_being_enabled() -> None:
    watch = watch_of(0x0233, ENABLED)
    watch.take(EMCY_BASE + 3, make_emergency(MILD, 1))
    assert not watch.news()
    cycle(watch, ENABLED, ENABLED)
    ((node, stops),) = [(warning.node, warning.stops) for warning in watch.warnings()]
    assert (node, stops) == (3, False)


def test_an_emergency_of_a_drive_that_is_not_enabled_is_news() -> None:
    watch = watch_of(0x0233, ENABLED)
    watch.take(EMCY_BASE + 3, make_emergency(HOT, 1))
    assert [node for node, _ in watch.news()] == [3]


def test_a_reason_that_is_over_is_reported_as_such() -> None:
    watch = watch_of(ENABLED, ENABLED)
    watch.take(EMCY_BASE + 5, make_emergency(HOT, 1))
    watch.take(EMCY_BASE + 5, make_emergency(0, 0))
    cycle(watch, ENABLED, FAULT)
    ((_, text),) = watch.state_faults((), powered=True)
    assert "4310h" in text
    assert text.endswith("reported as over since")


def test_the_group_goes_on_while_its_drive_does(bench: Bench) -> None:
    bench.enable()
    bench.drives[2]._emergency(HOT)
    statuses = [bench.cycle() for _ in range(3)]
    assert all(status.state is GroupState.ENABLED and not status.faults for status in statuses)
    assert [warning.stops for status in statuses for warning in status.warnings] == [True]
