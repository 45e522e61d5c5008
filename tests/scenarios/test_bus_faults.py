"""A bus that fails during a run: stopped, latched, recorded with its cause."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import can
import pytest

from drivers.cia402.state_machine import DriveState
from executor.state_machine import State
from executor.trajectory.setpoints import PreparedRun
from tests.scenarios.stage import CRUISING, Stage, at, staged


def comes(can_id: int, data: bytes = b"", *, error: bool = False) -> Callable[[Stage], None]:
    """A frame of another node on the drives' bus."""
    message = can.Message(
        arbitration_id=can_id, data=data, is_extended_id=False, is_error_frame=error
    )
    return lambda stage: stage.rehearsal._bus.send(message)


def for_cycles(count: int, happens: Callable[[Stage], None]) -> Callable[[Stage], None]:
    def script(stage: Stage) -> None:
        if CRUISING <= stage.cycle < CRUISING + count:
            happens(stage)

    return script


BUS_OFF = comes(0x040, bytes(8), error=True)
PASSIVE = comes(0x004, b"\0\x20" + bytes(6), error=True)
LOST_BY_CONTROLLER = comes(0x004, b"\0\x01" + bytes(6), error=True)
PROTOCOL_ERROR = comes(0x008, bytes(8), error=True)


@pytest.mark.parametrize(
    ("script", "words"),
    [
        (at(CRUISING, BUS_OFF), "went bus-off"),
        (at(CRUISING, PASSIVE), "error-passive"),
        (at(CRUISING, LOST_BY_CONTROLLER), "lost received frames"),
        (for_cycles(20, PROTOCOL_ERROR), "error frames in 10 cycles in a row"),
        (at(CRUISING, comes(0x080)), "another program sends SYNC"),
        (at(CRUISING, comes(0x204, bytes(8))), "another program sends set-points to drive 4"),
    ],
)
def test_it_ends_in_a_stop_with_its_name(
    prepared: PreparedRun, tmp_path: Path, script: Callable[[Stage], None], words: str
) -> None:
    with staged(prepared, tmp_path / "run", script) as stage:
        outcome = stage.run()
        assert outcome.state is State.LATCHED
        assert words in outcome.cause
        assert any(words in event.text for event in stage.events())
        assert {drive.state for drive in stage.drives} == {DriveState.QUICK_STOP_ACTIVE}
        # After the stop everything was still recorded: the bus works, its content was wrong.
        assert outcome.log.table().missing[-1] == 0


def test_single_error_frames_do_not_end_a_run(prepared: PreparedRun, tmp_path: Path) -> None:
    with staged(prepared, tmp_path / "run", for_cycles(9, PROTOCOL_ERROR)) as stage:
        outcome = stage.run()
        assert outcome.state is State.FINISHED, outcome.cause
