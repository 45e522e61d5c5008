"""The requests of a run after the real-time process is closed."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection
from types import SimpleNamespace
from typing import Any

import pytest

from drivers.can_errors import BusDown
from executor.realtime import process as real_time_process
from executor.realtime.child import Armed, Ended, Failed
from executor.realtime.shared_memory import SharedRequests
from executor.state_machine import LoopEvent, State
from model.errors import Fault, HardwareMissing


class Still:
    """A motion that does nothing."""

    cables, cycle = 8, 0.004

    def close(self) -> None:
        pass


def arms_and_ends(_job: Any, link: Connection, _supervisor: int) -> None:
    link.send(Armed("", None))  # type: ignore[arg-type]  # nobody asks where
    try:
        link.recv()
    except EOFError:
        return
    link.send(Ended(State.FINISHED, "", holding=True, true_pose=None))


SILENT = "all 8 drives stopped answering before the motion began"


def falls_silent(_job: Any, link: Connection, _supervisor: int) -> None:
    link.send(Armed("", None))  # type: ignore[arg-type]
    link.send(Failed(HardwareMissing(SILENT)))


def loses_the_bus(_job: Any, link: Connection, _supervisor: int) -> None:
    link.send(Armed("", None))  # type: ignore[arg-type]
    link.send(Failed(BusDown("the interface is down", "bus can0")))


def breaks(_job: Any, link: Connection, _supervisor: int) -> None:
    link.send(Armed("", None))  # type: ignore[arg-type]
    link.send(Failed(Fault("the real-time process failed: ValueError: 3")))


def dies(_job: Any, link: Connection, _supervisor: int) -> None:
    link.send(Armed("", None))  # type: ignore[arg-type]


def is_killed(_job: Any, _link: Connection, _supervisor: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_process_killed_before_it_was_ready_moved_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(real_time_process, "serve", is_killed)
    motion_on_board: Any = (Still(), print, board := SharedRequests())
    try:
        with (
            pytest.raises(Fault, match=r"killed by signal 9\); nothing moved") as caught,
            real_time_process.real_time_process(
                *motion_on_board, need_real_time=False, check_drives=lambda _released: ""
            ) as process,
        ):
            process.arm(SimpleNamespace())
    finally:
        board.close()
    assert "out of memory" in caught.value.why
    assert "__main__" not in str(caught.value)


@pytest.mark.parametrize(
    ("serve", "code"),
    [
        (falls_silent, "drive_silent"),
        (loses_the_bus, "bus_down"),
        (breaks, "broken"),
        (dies, "real_time_lost"),
    ],
)
def test_a_motion_that_did_not_begin_is_recorded_with_its_own_cause(
    monkeypatch: pytest.MonkeyPatch, serve: Callable[..., None], code: str
) -> None:
    monkeypatch.setattr(real_time_process, "serve", serve)
    board, events = SharedRequests(), list[LoopEvent]()
    records: Any = SimpleNamespace(take_event=events.append)
    motion_on_board: Any = (Still(), print, board)
    try:
        with real_time_process.real_time_process(
            *motion_on_board,
            need_real_time=False,
            check_drives=lambda _released: "drive 3 is in fault",
        ) as process:
            process.arm(records)
            ended = process.run()
    finally:
        board.close()
    assert [event.code for event in events] == [code, "not_held"]
    assert (ended.state, ended.holding) == (State.LATCHED, False)
    assert events[0].text in ended.cause


def falls_silent_behind_its_brakes(_job: Any, link: Connection, _supervisor: int) -> None:
    link.send(Armed("", (0,) * 8, released=(1, 2, 3)))
    link.send(Failed(HardwareMissing(SILENT)))


@pytest.mark.parametrize(("lets_go", "holding"), [(2, True), (4, False)])
def test_a_drive_that_never_held_is_no_doubt_about_a_motion_that_did_not_begin(
    monkeypatch: pytest.MonkeyPatch, lets_go: int, holding: bool
) -> None:
    monkeypatch.setattr(real_time_process, "serve", falls_silent_behind_its_brakes)
    board = SharedRequests()
    motion_on_board: Any = (Still(), print, board)
    try:
        with real_time_process.real_time_process(
            *motion_on_board,
            need_real_time=False,
            check_drives=lambda released: "" if lets_go in released else f"drive {lets_go} let go",
        ) as process:
            process.arm(SimpleNamespace(take_event=lambda _event: None))  # type: ignore[arg-type]
            ended = process.run()
    finally:
        board.close()
    assert (ended.state, ended.holding) == (State.LATCHED, holding)


@pytest.mark.parametrize("goes", [True, False])
def test_a_motion_that_is_over_leaves_no_stop_behind_on_the_board(
    monkeypatch: pytest.MonkeyPatch, goes: bool
) -> None:
    """The last images are then waited for, briefly only if the operator stopped."""
    monkeypatch.setattr(real_time_process, "serve", arms_and_ends)
    board, nobody_listens = SharedRequests(), SimpleNamespace()
    motion_on_board: Any = (Still(), print, board)
    try:
        with real_time_process.real_time_process(
            *motion_on_board, need_real_time=False, check_drives=lambda _released: ""
        ) as process:
            process.arm(nobody_listens)  # type: ignore[arg-type]
            if goes:
                assert process.run().state is State.FINISHED
        assert board.read().stop is not goes
    finally:
        board.close()
