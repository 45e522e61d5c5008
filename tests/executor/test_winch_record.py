"""The record of a motion without a path: every cycle and event, and no folder without either."""

from __future__ import annotations

import csv
import errno
import json
import os
import re
import threading
from concurrent.futures import wait
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from executor.control.winch_motion import WinchResult, recording
from executor.state_machine import CycleRecord, LoopEvent, State
from executor.supervision import Callbacks
from executor.winch_runs import record_folder, supervised
from model.errors import BadInput, Fault, Refused
from tests.configs import GACHON


def record(cycle: int) -> CycleRecord:
    state, nothing = State.MOVING, float("nan")
    return CycleRecord(
        cycle, 100.0 + cycle / 100.0, state, 0.0, 1.0, (10, 20), (11, -21), (30, 40), (0, 0), 0,
        0, 0, nothing, 0.0, (False, False),
    )  # fmt: skip


@pytest.mark.parametrize("interface", ["virtual", "socketcan"])
def test_a_fault_leads_out_by_the_status_of_the_drives(interface: str) -> None:
    """A reset alone is refused while a drive is in fault and the others hold the platform."""
    nothing = np.full(8, np.nan)
    result = WinchResult(State.LATCHED, "cable 2 is in fault", nothing, nothing, nothing)
    supervisor = SimpleNamespace(during=lambda _board, move: move())
    commands: Any = SimpleNamespace(supervisor=supervisor, board=None, require_no_stop=lambda: None)
    rig = GACHON if interface == "virtual" else GACHON.with_bus(interface, "can0")
    with pytest.raises(Fault, match="cable 2 is in fault") as caught:
        supervised(rig, commands, lambda: result, Callbacks(lambda: None))
    named = re.findall(r"`cdpr (\w+)", caught.value.next_step)
    assert named == ([] if interface == "virtual" else ["status", "release", "reset"])


def test_every_cycle_and_event_is_there(tmp_path: Path) -> None:
    with recording(tmp_path / "home") as kept:
        kept.take_event(LoopEvent(0, 100.0, "enabled", "all drives hold"))
        for cycle in range(3):
            kept.take_cycle(record(cycle))
        # On disk at once: a program that is killed writes nothing any more.
        (line,) = (tmp_path / "home/events.jsonl").read_text().splitlines()
        assert json.loads(line) == {"time_s": 0.0, "code": "enabled", "text": "all drives hold"}
    with (tmp_path / "home/winches.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["cycle"], row["time_s"]) for row in rows] == [
        ("0", "0.000000"), ("1", "0.010000"), ("2", "0.020000")
    ]  # fmt: skip
    assert rows[2]["state"] == "moving"
    numbers = {key: rows[2][key] for key in rows[2] if key.endswith(("_1", "_2"))}
    assert numbers == {
        "set_counts_1": "10", "set_counts_2": "20", "counts_1": "11", "counts_2": "-21",
        "torque_per_mille_1": "30", "torque_per_mille_2": "40",
    }  # fmt: skip


def full_from_the_start(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """The file of this name is on a disk without space."""
    opened, synced = Path.open, os.fsync

    def opens(path: Path, *arguments: Any, **options: Any) -> Any:
        return opened(Path("/dev/full") if path.name == name else path, *arguments, **options)

    def fsync(handle: int) -> None:
        if os.readlink(f"/proc/self/fd/{handle}") == "/dev/full":  # the device itself says EINVAL
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        synced(handle)

    monkeypatch.setattr(Path, "open", opens)
    monkeypatch.setattr(os, "fsync", fsync)


def full_disk(full: str, name: str) -> AbstractContextManager[object]:
    """Writing to this file is refused if it is the full one."""
    if full != name:
        return nullcontext()
    return pytest.raises(Fault, match=f"{name} cannot be written: No space left on device")


@pytest.mark.parametrize("name", ["winches.csv", "events.jsonl"])
def test_a_full_disk_is_reported_and_changes_nothing_of_how_the_motion_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """Closing the files raised again, instead of returning the result of the motion."""
    full_from_the_start(monkeypatch, name)
    event = LoopEvent(0, 100.0, "stop", "stop requested")
    with recording(tmp_path / "home") as kept:
        for _ in range(2):
            with full_disk(name, "winches.csv"):
                kept.take_cycle(record(0))
            with full_disk(name, "events.jsonl"):
                kept.take_event(event)


def test_what_was_written_is_forced_to_disk_once_a_second_at_most(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    forced: list[str] = []
    monkeypatch.setattr(
        os, "fsync", lambda handle: forced.append(os.readlink(f"/proc/self/fd/{handle}"))
    )
    with recording(tmp_path / "home") as kept:
        for cycle in range(300):  # 3 s
            kept.take_cycle(record(cycle))
            wait([kept._flushing])
    assert [Path(file).name for file in forced] == ["winches.csv", "events.jsonl"] * 3


def test_a_disk_that_hangs_holds_no_cycle_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hangs = threading.Event()
    forced: list[int] = []

    def fsync(handle: int) -> None:
        forced.append(handle)
        hangs.wait(10.0)

    monkeypatch.setattr(os, "fsync", fsync)
    with recording(tmp_path / "home") as kept:
        for cycle in range(500):
            kept.take_cycle(record(cycle))
        assert len((tmp_path / "home/winches.csv").read_text().splitlines()) == 501
        assert len(forced) <= 1, "none waits behind another"
        hangs.set()


def test_only_drives_on_a_bus_leave_a_record_that_was_not_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    on_bus = GACHON.with_bus("socketcan", "can0")
    assert record_folder(GACHON, None, "home") is None
    names = record_folder(on_bus, None, "home")
    assert names is not None
    for wanted in ("runs/home", "runs/home-2"):
        assert names() == Path(wanted)
        names().mkdir(parents=True)
    for rig in (GACHON, on_bus):
        given = record_folder(rig, "mine", "home")
        assert given is not None
        assert given() == Path("mine")
        with pytest.raises(BadInput, match="exists already"):
            record_folder(rig, "runs/home", "home")


def test_nothing_is_left_of_what_was_refused(tmp_path: Path) -> None:
    with pytest.raises(Refused), recording(tmp_path / "home"):
        raise Refused("the bus is latched")
    assert not (tmp_path / "home").exists()
    (tmp_path / "home").mkdir()
    with pytest.raises(BadInput, match="cannot be written"), recording(tmp_path / "home"):
        pytest.fail("it would write into another's folder")
    assert (tmp_path / "home").exists()


def test_an_event_that_could_not_be_written_keeps_its_folder_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full_from_the_start(monkeypatch, "events.jsonl")
    with pytest.raises(Fault), recording(tmp_path / "home") as kept:
        kept.take_event(LoopEvent(0, 1.0, "drive_silent", "cable 4 (drive 4): no answer"))
    assert (tmp_path / "home").exists()
