"""`cdpr sim` in one process and `cdpr run` in another, from end to end over a kernel CAN bus."""

from __future__ import annotations

import os
import signal
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from drivers.cia402.pdo import RPDO1_BASE, SYNC_ID, TPDO1_BASE
from drivers.cia402.state_machine import DriveState, state_of
from executor.recording.run_folder import RunFolder
from tests.hil.conftest import NODES
from tests.hil.trace import Decoder, Frame, read_trace

Tell = Callable[[str], None]

pytestmark = pytest.mark.hil


def assert_nothing_was_lost(frames: list[Frame], cycles: int) -> None:
    """On the wire: for each SYNC one set-point and one reply of every drive."""
    counts = Counter(frame.can_id for frame in frames)
    assert counts[SYNC_ID] >= cycles
    for node in NODES:
        assert counts[RPDO1_BASE + node] == counts[SYNC_ID]
        assert counts[TPDO1_BASE + node] == counts[SYNC_ID]


def assert_commanded_together(frames: list[Frame]) -> None:
    """From one SYNC to the next every drive gets one set-point, and all the same control word."""
    words: dict[int, bytes] = {}
    for frame in frames:
        node = frame.can_id - RPDO1_BASE
        if node in NODES:
            assert node not in words
            words[node] = frame.data[:2]
        elif frame.can_id == SYNC_ID:
            assert sorted(words) == list(NODES)
            assert len(set(words.values())) == 1, words
            words = {}


def assert_decodes(frames: list[Frame], folder: Path) -> None:
    """Names and values by the EDS file are those of the run's own record."""
    targets: dict[int, list[int]] = {node: [] for node in NODES}
    last: dict[int, dict[str, int]] = {}
    for frame, values in Decoder(NODES).decode(frames):
        node = frame.can_id & 0x7F
        if frame.can_id - node == RPDO1_BASE:
            assert set(values) == {"Controlword", "Target position"}
            targets[node].append(values["Target position"])
        else:
            assert set(values) == {"Statusword", "Position actual value", "Torque actual value"}
            last[node] = values
    cycles = RunFolder.open(folder).cycles()
    for drive, node in enumerate(NODES):
        recorded = cycles.set_counts[:, drive].tolist()
        assert targets[node][-len(recorded) :] == recorded
        assert last[node]["Position actual value"] == cycles.actual_counts[-1, drive]
        assert state_of(last[node]["Statusword"]) is DriveState.QUICK_STOP_ACTIVE


def whole_run(
    drives_at: Callable[[Path], Any], plan: Path, trace: Path, tell: Tell, stopped: bool = False
) -> None:
    """From `cdpr run` to its record; one that the operator stops is stopped on the path."""
    with drives_at(plan) as rig:
        running = rig.run()
        if stopped:
            rig.wait_for_motion(running)
            rig.wait_for_cycles(50, running)
            running.send(signal.SIGINT)
        code = running.ended()
        assert code == (130 if stopped else 0), running.said.read_text()
        summary = rig.summary()
        assert rig.states() == {DriveState.QUICK_STOP_ACTIVE}
    tell(f"{summary['cycles']} cycles, lateness in ms: {summary['lateness_ms']}")
    assert summary["verdict"] == ("STOPPED" if stopped else "PASSED")
    assert summary["simulated"] is True, "the drives say so themselves"
    assert summary["lost_replies"] == 0
    frames = read_trace(trace)
    assert_nothing_was_lost(frames, summary["cycles"])
    assert_commanded_together(frames)
    assert_decodes(frames, rig.folder / "run")


def test_ctrl_c_stops_all_drives_together_along_the_path(
    drives_at: Callable[[Path], Any], short_plan: Path, trace: Path, figures: Tell
) -> None:
    whole_run(drives_at, short_plan, trace, figures, stopped=True)


@pytest.mark.slow
def test_a_short_path(
    drives_at: Callable[[Path], Any], short_plan: Path, trace: Path, figures: Tell
) -> None:
    whole_run(drives_at, short_plan, trace, figures)


@pytest.mark.slow
def test_environment_3(drives_at: Callable[[Path], Any], trace: Path, figures: Tell) -> None:
    """The plan is made before, by `make hil`: the search would take long in the machine."""
    plan = os.environ.get("CDPR_HIL_PLAN")
    if not plan:
        pytest.fail(
            "no plan of environment 3; next: run these tests with `make hil`", pytrace=False
        )
    whole_run(drives_at, Path(plan), trace, figures)
