"""Tests in real time are repeated only where this computer held them up."""

from __future__ import annotations

import ctypes

from drivers.cia402.error_codes import emergency_text
from executor.control.sync_master import late_fault
from executor.safety.fault_messages import late
from tests.held_up import LIMIT_S, HoldUp, reports_late_cycles


def test_a_thread_that_is_not_woken_is_a_hold_up() -> None:
    watch = HoldUp()
    ctypes.PyDLL(None).usleep(100_000)  # no other thread of this process runs meanwhile
    watch.end()
    assert watch.worst_s > LIMIT_S


def test_a_failure_with_the_message_of_a_run_that_ended_for_late_cycles_is_a_hold_up() -> None:
    ended = f"FAILED after 1.4 s: {late(2.0, too_late=True).text}; quick stop of all drives"
    assert reports_late_cycles(ended)
    assert reports_late_cycles(str(late_fault(3.0)))
    assert reports_late_cycles(f"drive 1: {emergency_text(0x8700)}; quick stop of all drives")
    assert not reports_late_cycles("assert 'a cycle began' in 'drive 3 (cable 3) does not answer'")
