"""The end of a motion in the real-time process: its cause, its requests and its memory."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from multiprocessing.connection import Connection, Pipe
from types import SimpleNamespace
from typing import Any, NoReturn

import numpy as np
import pytest

from drivers.can_errors import BusDown
from executor import winch_runs
from executor.realtime import child
from executor.realtime import process as real_time_process
from executor.realtime.child import CYCLE_SLOTS, Armed, Ended, Failed, Go, Job, ReadyDrives
from executor.realtime.scheduling import ended_at_start
from executor.realtime.shared_memory import CycleRecordCodec, Ring, SharedMemory, SharedRequests
from executor.state_machine import CycleRecord, LoopEvent, State
from model.errors import Fault, HardwareMissing
from tests.configs import GACHON


class Still:
    """A motion that does nothing."""

    cables, cycle = 8, 0.004


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


@pytest.mark.parametrize("code", [1, 255])
def test_a_process_that_could_not_start_is_not_said_to_have_imported_the_script(code: int) -> None:
    """With 255 the interpreter itself could not start, as its files could not be read."""
    ended: Any = SimpleNamespace(exitcode=code)
    fault = ended_at_start("the real-time process", ended)
    assert f"(exit code {code})" in fault.what
    assert fault.why == "it failed while it started; its error, if it printed one, is above"
    for cause in ('`if __name__ == "__main__":`', "an interpreter or package that this user may"):
        assert cause in fault.next_step


def end_of(
    monkeypatch: pytest.MonkeyPatch, serve: Callable[..., None], doubt: str
) -> tuple[Ended, list[LoopEvent]]:
    """The end of a motion in a process that does what is given, and its events."""
    monkeypatch.setattr(real_time_process, "serve", serve)
    board, events = SharedRequests(), list[LoopEvent]()
    records: Any = SimpleNamespace(take_event=events.append)
    motion_on_board: Any = (Still(), print, board)
    try:
        with real_time_process.real_time_process(
            *motion_on_board, need_real_time=False, check_drives=lambda _released: doubt
        ) as process:
            process.arm(records)
            return process.run(), events
    finally:
        board.close()


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
    ended, events = end_of(monkeypatch, serve, "drive 3 is in fault")
    assert [event.code for event in events] == [code, "not_held"]
    assert (ended.state, ended.holding) == (State.LATCHED, False)
    assert events[0].text in ended.cause


@pytest.mark.parametrize(
    ("doubt", "cause"),
    [
        ("drive 3 is in fault", "no set-points reach the drives; drive 3 is in fault"),
        ("", "no set-points reach the drives"),
    ],
)
def test_drives_that_were_not_seen_to_hold_are_not_said_to_hold(
    monkeypatch: pytest.MonkeyPatch, doubt: str, cause: str
) -> None:
    ended, events = end_of(monkeypatch, dies, doubt)
    assert ended.cause.endswith(f"; {cause}")
    assert " hold" not in events[0].text + ended.cause


def falls_silent_behind_its_brakes(_job: Any, link: Connection, _supervisor: int) -> None:
    link.send(Armed("", (0,) * 8, released=(1, 2, 3)))
    link.send(Failed(HardwareMissing(SILENT)))


def end_where(lets_go: int) -> Ended:
    """The end of a motion after which a drive holds no longer, unless it is excused."""
    board = SharedRequests()
    records: Any = SimpleNamespace(take_event=lambda _: None, take_cycle=lambda *_: None)
    motion_on_board: Any = (Still(), print, board)
    try:
        with real_time_process.real_time_process(
            *motion_on_board,
            need_real_time=False,
            check_drives=lambda released: "" if lets_go in released else f"drive {lets_go} let go",
        ) as process:
            process.arm(records)
            return process.run()
    finally:
        board.close()


@pytest.mark.parametrize(("lets_go", "holding"), [(2, True), (4, False)])
def test_a_drive_that_never_held_is_no_doubt_about_a_motion_that_did_not_begin(
    monkeypatch: pytest.MonkeyPatch, lets_go: int, holding: bool
) -> None:
    monkeypatch.setattr(real_time_process, "serve", falls_silent_behind_its_brakes)
    ended = end_where(lets_go)
    assert (ended.state, ended.holding) == (State.LATCHED, holding)


RESTS, READIES, BRAKED, ENABLED, QUICK, FAULT, UNKNOWN = (
    0x0250, 0x0231, 0x0233, 0x0237, 0x0217, 0x0218, 0x0201
)  # fmt: skip


def dies_after(words: list[int], missing: int, job: Any, link: Connection, _pid: int) -> None:
    """Drive 1 holds, the others have brakes; all but drive 2 only approach the last state."""
    nodes, codec = tuple(range(1, 9)), CycleRecordCodec(8)
    ring = Ring(job.cycles, CYCLE_SLOTS)
    rest = (0,) * 8
    for cycle, word in enumerate(words):
        shown = (QUICK, word, *[BRAKED] * 6)
        record = CycleRecord(
            cycle, 0.004 * cycle, State.ENABLING, 0.0, 0.0, rest, rest, rest, shown, missing, 0, 0,
            0.0, 0.0, (False,) * 8,
        )  # fmt: skip
        ring.put(codec.pack(record, None))
    link.send(Armed("", (0,) * 8, released=nodes[1:], nodes=nodes))
    link.recv()


@pytest.mark.parametrize(
    ("words", "missing", "lets_go", "holding"),
    [
        ([RESTS, READIES, BRAKED], 0, 2, True),
        ([RESTS, READIES, BRAKED], 0, 1, False),
        ([BRAKED, ENABLED, RESTS], 0, 2, False),
        ([BRAKED, ENABLED, RESTS], 0, 3, True),
        ([BRAKED, FAULT], 0, 2, False),
        ([BRAKED, UNKNOWN, BRAKED], 0, 2, False),
        ([BRAKED], 1, 2, False),
        ([BRAKED] * (CYCLE_SLOTS + 1), 0, 2, False),
    ],
)
def test_a_process_that_dies_while_enabling_casts_doubt_only_on_drives_that_had_torque(
    monkeypatch: pytest.MonkeyPatch, words: list[int], missing: int, lets_go: int, holding: bool
) -> None:
    """A lost or unknown status word counts as torque, and so does a record that was lost."""
    monkeypatch.setattr(real_time_process, "serve", partial(dies_after, words, missing))
    ended = end_where(lets_go)
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


def test_a_simulation_that_fails_is_the_cause_of_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """The true pose after the motion, which then fails as well, is not needed."""

    def no_equilibrium() -> NoReturn:
        raise Fault("the simulation failed")

    cause, words = "the simulation failed; quick stop of all drives", np.full(8, QUICK)
    loop = SimpleNamespace(
        arm=print, run=lambda: State.LATCHED, positions=(0,) * 8, cause=cause, holding=True,
        error=None,
    )  # fmt: skip
    master = SimpleNamespace(
        status=SimpleNamespace(status_words=words), cycle_until=lambda _poll: Go()
    )
    motion: Any = SimpleNamespace(cables=8, cycle=0.004, loop=lambda *_: loop, require=print)
    group: Any = SimpleNamespace(capabilities=SimpleNamespace(simulated=True))
    drives = ReadyDrives(GACHON, group, no_equilibrium, print, ())
    monkeypatch.setattr(child, "SyncMaster", lambda *_: master)
    monkeypatch.setattr(child, "real_time", lambda: nullcontext(""))
    monkeypatch.setattr(child.signal, "signal", lambda *_: None)
    board, (near, far) = SharedRequests(), Pipe()
    job = Job.of(motion, board.memory, lambda: nullcontext(drives), need_real_time=False)
    try:
        child.serve(job, far, os.getpid())
        armed, ended = near.recv(), near.recv()
    finally:
        job.close()
        board.close()
        near.close()
        far.close()
    assert isinstance(armed, Armed)
    assert isinstance(ended, Ended), ended
    assert (ended.state, ended.cause, ended.holding) == (State.LATCHED, cause, True)


def test_a_motion_whose_preparation_fails_leaves_no_memory_open(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted(*_: object, **_more: object) -> NoReturn:
        raise KeyboardInterrupt

    memory = SharedMemory.sealed(b"set-points")
    task: Any = SimpleNamespace(close=memory.close)
    monkeypatch.setattr(winch_runs, "ready_to_simulate", interrupted)
    board, unused = SharedRequests(), SimpleNamespace()
    opened: Any = (GACHON, task, unused, board, unused)
    try:
        with (
            pytest.raises(KeyboardInterrupt),
            winch_runs.open_mover(*opened, need_real_time_rights=False, listener=unused),
        ):
            pass
    finally:
        board.close()
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(memory.descriptor)
