"""The master dies, hangs or loses its bus while the drives of another process move."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.cia402.pdo import EMCY_BASE, RPDO1_BASE, SYNC_ID, TPDO1_BASE, parse_reply
from drivers.cia402.state_machine import ControlWord, DriveState
from executor.recording.run_folder import RunFolder
from model.rig import load_rig
from tests.cli.plans import RIG
from tests.hil.conftest import NODES, Program, Rig
from tests.hil.trace import Frame, read_trace

pytestmark = pytest.mark.hil

SETTLED_S = 0.3
STOPPED_WITHIN_S = 0.050
SPREAD_S = 0.010
TRAVEL_M = 0.001
SYNC_OR_SET_POINT_OVERDUE = (0x8700, 0x8250)
PER_METRE = np.array([w.counts_per_metre for w in load_rig(RIG).winches])


def cable_mm(counts: np.ndarray) -> float:
    """The largest change of a cable."""
    return float(np.abs(counts / PER_METRE).max() * 1000.0)


def moving(rig: Rig) -> Program:
    """A run that has been on its path for half a second."""
    running = rig.run()
    rig.wait_for_motion(running)
    rig.wait_for_cycles(50, running)
    return running


def last_sync(frames: list[Frame]) -> float:
    return max(frame.time for frame in frames if frame.can_id == SYNC_ID)


def stop_times(frames: list[Frame]) -> np.ndarray:
    """When each drive told that it stops by itself, for want of SYNC or set-points."""
    first: dict[int, float] = {}
    for frame in frames:
        code = int.from_bytes(frame.data[:2], "little")
        if frame.can_id - EMCY_BASE in NODES and code in SYNC_OR_SET_POINT_OVERDUE:
            first.setdefault(frame.can_id - EMCY_BASE, frame.time)
    assert sorted(first) == list(NODES)
    return np.array([first[node] for node in NODES])


def last_replies(frames: list[Frame]) -> np.ndarray:
    """Where the drives were at the last SYNC."""
    positions = dict.fromkeys(NODES, 0)
    for frame in frames:
        reply = parse_reply(frame.data) if frame.can_id - TPDO1_BASE in NODES else None
        if reply is not None:
            positions[frame.can_id - TPDO1_BASE] = reply.position
    return np.array([positions[node] for node in NODES])


def assert_all_stopped_themselves(rig: Rig, trace: Path, tell: Callable[[str], None]) -> None:
    """All eight hold in quick stop, soon, together, near where they were."""
    signal.sigtimedwait([], SETTLED_S)
    assert rig.states() == {DriveState.QUICK_STOP_ACTIVE}
    frames = read_trace(trace)
    stopped = stop_times(frames) - last_sync(frames)
    travel = cable_mm(np.array(rig.positions()) - last_replies(frames))
    tell(
        f"stopped {1e3 * stopped.min():.1f} to {1e3 * stopped.max():.1f} ms after the last SYNC,"
        f" {travel:.3f} mm of travel"
    )
    assert stopped.max() <= STOPPED_WITHIN_S
    assert np.ptp(stopped) <= SPREAD_S
    assert travel <= 1000.0 * TRAVEL_M


def enabling_words(frames: list[Frame], since: float) -> int:
    """Set-points that tell a drive to follow."""
    return sum(
        frame.can_id - RPDO1_BASE in NODES
        and frame.time > since
        and int.from_bytes(frame.data[:2], "little") == ControlWord.ENABLE_OPERATION
        for frame in frames
    )


def assert_restart_moves_nothing(rig: Rig, trace: Path) -> None:
    """The fault is latched: a new run is refused, and no drive is commanded to follow anything."""
    held, before = rig.positions(), last_sync(read_trace(trace))
    again = rig.run("again")
    assert again.ended() == 3, again.said.read_text()
    assert "a fault is latched" in again.said.read_text()
    assert rig.positions() == held
    assert rig.states() == {DriveState.QUICK_STOP_ACTIVE}
    assert enabling_words(read_trace(trace), before) == 0


def test_kill_9_of_the_master(
    drives_at: Callable[[Path], Any], short_plan: Path, trace: Path, figures: Callable[[str], None]
) -> None:
    with drives_at(short_plan) as rig:
        running = moving(rig)
        running.send(signal.SIGKILL)
        assert_all_stopped_themselves(rig, trace, figures)
        assert_restart_moves_nothing(rig, trace)


@pytest.mark.slow
def test_a_master_that_hangs_and_goes_on_later_enables_nothing(
    drives_at: Callable[[Path], Any], short_plan: Path, trace: Path, figures: Callable[[str], None]
) -> None:
    with drives_at(short_plan) as rig:
        running = moving(rig)
        running.send(signal.SIGSTOP)
        assert_all_stopped_themselves(rig, trace, figures)
        held = rig.positions()
        running.send(signal.SIGCONT)
        assert running.ended() == 1, running.said.read_text()
        assert rig.positions() == held
        assert rig.states() == {DriveState.QUICK_STOP_ACTIVE}
        assert rig.summary()["verdict"] == "FAILED"


@pytest.mark.slow
def test_the_interface_goes_down_and_comes_up_again(
    drives_at: Callable[[Path], Any], short_plan: Path, trace: Path, channel: str
) -> None:
    with drives_at(short_plan) as rig:
        running = moving(rig)
        subprocess.run(["ip", "link", "set", channel, "down"], check=True)
        assert running.ended() == 1, running.said.read_text()
        texts = [event.text for event in RunFolder.open(rig.folder / "run").events()]
        assert any("Network is down" in text for text in texts), texts
        subprocess.run(["ip", "link", "set", channel, "up"], check=True)
        assert rig.states() == {DriveState.QUICK_STOP_ACTIVE}
        travel = cable_mm(np.array(rig.positions()) - last_replies(read_trace(trace)))
        assert travel <= 1000.0 * TRAVEL_M
        assert_restart_moves_nothing(rig, trace)
