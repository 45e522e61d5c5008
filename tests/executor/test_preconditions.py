"""Drives are armed by what they do, not by what they are called."""

from __future__ import annotations

from dataclasses import replace

import pytest

from drivers.drive_group import Capabilities
from executor.control.preconditions import require_capabilities
from model.errors import Refused

CYCLE = 0.01
SYNCED = Capabilities(
    sync=True,
    holds_on_comm_loss=True,
    holds_on_quick_stop=True,
    has_brake=False,
    max_hz=250.0,
    watchdog_ms=None,
    sync_timeout=3.0,
    master_timeout=0.1,
)
BRAKED = Capabilities(
    sync=False,
    holds_on_comm_loss=False,
    holds_on_quick_stop=False,
    has_brake=True,
    max_hz=250.0,
    watchdog_ms=100.0,
    sync_timeout=None,
    master_timeout=0.0,
)


@pytest.mark.parametrize("drives", [SYNCED, BRAKED, replace(BRAKED, watchdog_ms=30.0)])
def test_drives_that_stop_together_and_hold_are_armed(drives: Capabilities) -> None:
    require_capabilities(drives, CYCLE)


@pytest.mark.parametrize(
    ("drives", "words"),
    [
        (replace(SYNCED, sync=False), "common SYNC"),
        (replace(SYNCED, holds_on_comm_loss=False), "hold when the master is lost"),
        (replace(SYNCED, holds_on_quick_stop=False), "hold after a quick stop"),
        (replace(SYNCED, max_hz=99.0), "keep up with a cycle of 10 ms"),
        (replace(BRAKED, has_brake=False), "hold after a quick stop"),
        (replace(BRAKED, watchdog_ms=None), "hold when the master is lost"),
        (replace(BRAKED, watchdog_ms=0.0), "stay armed for 3 cycles"),
        (replace(BRAKED, watchdog_ms=29.0), "stay armed for 3 cycles"),
    ],
)
def test_drives_that_would_drop_the_platform_are_refused(drives: Capabilities, words: str) -> None:
    with pytest.raises(Refused, match=words) as caught:
        require_capabilities(drives, CYCLE)
    assert "nothing was enabled" in caught.value.next_step


def test_what_the_rig_file_must_declare_is_named_for_drives_without_sync() -> None:
    with pytest.raises(Refused) as caught:
        require_capabilities(replace(BRAKED, has_brake=False), CYCLE)
    assert "winches[].brake" in caught.value.next_step
    assert "drives.watchdog_ms" in caught.value.next_step
