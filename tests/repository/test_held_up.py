"""Tests in real time are repeated only where this computer held them up."""

from __future__ import annotations

import ctypes

from tests.held_up import LIMIT_S, HoldUp


def test_a_thread_that_is_not_woken_is_a_hold_up() -> None:
    watch = HoldUp()
    ctypes.PyDLL(None).usleep(100_000)  # no other thread of this process runs meanwhile
    watch.end()
    assert watch.worst_s > LIMIT_S
