"""The record of a run on disk during the run: it never lacks more than the last second."""

from __future__ import annotations

import resource
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from executor.recording.recorder import BEHIND, Recorder, RecordWriter
from executor.recording.run_folder import RunEvent, RunFolder
from executor.remote.status import RunStatus
from executor.state_machine import CycleRecord, LoopEvent, State
from executor.supervision import LocalRequests
from executor.trajectory.dwell import Dwell
from model.errors import CdprError, Fault
from model.files.scene_file import SceneDocument
from model.rig import load_rig
from model.scene import scene_from_document

CYCLE = 0.01
CONFIGS = Path(__file__).parents[2] / "configs"


class Log:
    """Cycles that are their own numbers; a substitute for `RunLog`."""

    def __init__(self) -> None:
        self.count = 0

    def __len__(self) -> int:
        return self.count

    def table(self, first: int, end: int) -> Any:
        return Rows(first, end)


class Rows:
    def __init__(self, first: int, end: int) -> None:
        self.numbers = range(first, end)

    def csv_header(self) -> str:
        return "cycle\n"

    def csv_rows(self) -> str:
        return "".join(f"{number}\n" for number in self.numbers)


def recorded(folder: RunFolder) -> list[int]:
    path = folder.path / "cycles.csv"
    return [int(line) for line in path.read_text().split("\n")[1:-1]] if path.is_file() else []


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return RunFolder.create(tmp_path / "run")


@pytest.mark.parametrize("cycle", [0.001, 0.01, 0.3, 2.0])
def test_after_every_cycle_the_file_lacks_less_than_a_second(
    folder: RunFolder, cycle: float
) -> None:
    log: Any = Log()
    writer = RecordWriter(folder, log, own_thread=False)
    for number in range(60 if cycle > 0.1 else 1500):
        log.count += 1
        writer.take_cycles(5.0 + number * cycle)
        rows = recorded(folder) if number % 97 == 0 or cycle > 0.1 else [number]
        assert (number - rows[-1]) * cycle < 1.0
    writer.close()
    assert recorded(folder) == list(range(log.count))


def test_a_thread_writes_all_in_order_and_ends_with_the_block(folder: RunFolder) -> None:
    log: Any = Log()
    events = [RunEvent(k * CYCLE, "speed", f"Nr. {k} – über") for k in range(0, 300, 50)]
    with RecordWriter(folder, log, own_thread=True) as writer:
        for number in range(300):
            log.count += 1
            if number % 50 == 0:
                writer.take_event(events[number // 50])
            writer.take_cycles(number * CYCLE)
    assert recorded(folder) == list(range(300))
    assert folder.events() == events


def test_a_disk_that_hangs_holds_nothing_up_and_is_a_fault_when_it_is_far_behind(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    goes_on, log = threading.Event(), Log()
    append = RunFolder.append_cycles

    def hangs(self: RunFolder, lines: str, *, fsync: bool) -> None:
        goes_on.wait()
        append(self, lines, fsync=fsync)

    monkeypatch.setattr(RunFolder, "append_cycles", hangs)
    at = 0.0
    with RecordWriter(folder, log, own_thread=True) as writer:  # type: ignore[arg-type]
        try:
            for _ in range(round(BEHIND / CYCLE)):
                log.count, at = log.count + 1, at + CYCLE
                writer.take_cycles(at)
            log.count += 100
            with pytest.raises(Fault, match=r"6\.\d s behind the run"):
                writer.take_cycles(at + 1.0)
            with pytest.raises(Fault, match="behind the run"):
                writer.take_event(RunEvent(at, "stop", "stop requested"))
        finally:
            goes_on.set()


def test_a_suspended_program_is_not_a_slow_disk(folder: RunFolder) -> None:
    """Nothing waits for the disk in the 6 s without a cycle."""
    log: Any = Log()
    written = threading.Event()
    with RecordWriter(folder, log, own_thread=True) as writer:
        log.count = 1
        writer.take_cycles(5.0)
        writer.take_file(written.set)
        assert written.wait(60.0)
        log.count = 2
        writer.take_cycles(5.0 + BEHIND + 1.0)
        writer.take_event(RunEvent(6.0, "late", "a cycle began late"))
    assert recorded(folder) == [0, 1]


def test_a_program_suspended_during_a_write_counts_only_the_rest_as_a_delay(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk, log, at = Disk(monkeypatch), Log(), 5.0
    with RecordWriter(folder, log, own_thread=True) as writer:  # type: ignore[arg-type]
        try:
            log.count = 1
            writer.take_cycles(at)
            assert disk.begins.wait(60.0)
            at += BEHIND + 1.0
            for number in range(round(BEHIND / CYCLE)):
                log.count += 1
                writer.take_cycles(at + number * CYCLE)
            log.count += 1
            with pytest.raises(Fault, match=r"5\.\d s behind the run"):
                writer.take_cycles(at + BEHIND + 0.5)
        finally:
            disk.goes_on.set()


class Disk:
    """Keeps the first write until it is let go."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.begins, self.goes_on = threading.Event(), threading.Event()
        self.writes = 0
        append = RunFolder.append_cycles

        def writes(folder: RunFolder, lines: str, *, fsync: bool) -> None:
            self.begins.set()
            self.goes_on.wait()
            self.writes += 1
            append(folder, lines, fsync=fsync)

        monkeypatch.setattr(RunFolder, "append_cycles", writes)

    def record(self, folder: RunFolder, cycles: int) -> RecordWriter:
        """Records cycles, all of which but the first wait for it."""
        log: Any = Log()
        with RecordWriter(folder, log, own_thread=True) as writer:
            try:
                for number in range(cycles):
                    log.count += 1
                    writer.take_cycles(5.0 + number * CYCLE)
                    assert self.begins.wait(60.0)
            finally:
                self.goes_on.set()
        return writer


def test_cycles_that_waited_for_the_disk_are_written_together(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One by one, a disk that takes longer for each write than they are apart falls behind."""
    disk = Disk(monkeypatch)
    disk.record(folder, 401)
    assert recorded(folder) == list(range(401))
    assert disk.writes <= 3, "the first cycle, those that waited, and the rest at the end"


def full_at(size: int, folder: RunFolder) -> RecordWriter:
    """A writer with a file size limit from the cycle 110 on: part of the last write still fits."""
    log: Any = Log()
    written = threading.Event()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        with RecordWriter(folder, log, own_thread=True) as writer:
            for number in range(450):
                if number == 110:
                    writer.take_file(written.set)
                    assert written.wait(60.0)
                    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
                log.count += 1
                writer.take_cycles(number * CYCLE)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    return writer


def test_a_full_disk_is_a_fault_and_leaves_whole_lines(folder: RunFolder) -> None:
    writer = full_at(1003, folder)
    with pytest.raises(CdprError, match="cannot be written"):
        writer.take_event(RunEvent(4.5, "stop", "stop requested"))
    rows = recorded(folder)
    assert rows == list(range(len(rows)))
    assert 100 < rows[-1] < 400


@pytest.mark.parametrize("own_thread", [False, True])
def test_a_file_is_written_behind_all_cycles_and_also_after_a_failure(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch, own_thread: bool
) -> None:
    log, seen, fails = Log(), list[list[int]](), threading.Event()
    with RecordWriter(folder, log, own_thread=own_thread) as writer:  # type: ignore[arg-type]
        for number in range(75):
            log.count += 1
            writer.take_cycles(5.0 + number * CYCLE)
        writer.take_file(lambda: seen.append(recorded(folder)))
        writer.take_file(lambda: monkeypatch.setattr(RunFolder, "append_cycles", _full))
        writer.take_file(fails.set)
        assert fails.wait(60.0)
        log.count += 1
        writer.take_file(lambda: seen.append(recorded(folder)))
    assert seen == [list(range(75))] * 2


def _full(*_: object, **__: object) -> None:
    raise Fault("No space left on device")


def test_a_folder_that_is_gone_is_a_fault(folder: RunFolder) -> None:
    log: Any = Log()
    writer = RecordWriter(folder, log, own_thread=False)
    folder.discard()
    log.count = 1
    with pytest.raises(Fault, match="cannot be written"):
        writer.take_cycles(0.0)


def test_what_is_not_a_fault_of_the_disk_is_one_of_the_record(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_memory(*_: object, **__: object) -> None:
        raise MemoryError

    monkeypatch.setattr(Rows, "csv_rows", no_memory)
    log: Any = Log()
    with RecordWriter(folder, log, own_thread=True) as writer:
        log.count = 1
        writer.take_cycles(0.0)
    with pytest.raises(Fault, match="MemoryError"):
        writer.take_event(RunEvent(0.0, "stop", "stop requested"))


def recorder_of(
    folder: RunFolder,
    done: list[str],
    monkeypatch: pytest.MonkeyPatch,
    every: int = 1,
    trigger: Callable[..., None] | None = None,
) -> Recorder:
    """A recorder that writes no cycles; ``done`` receives what it calls."""
    rig = load_rig(CONFIGS / "gachon_8_6.yaml")
    goal = {"position_mm": [0, 0, 445]}
    stops = [{"name": name, "dwell_s": 0.0, **goal} for name in ("one", "two")]
    data = {"schema_version": 1, "name": "s", "start": goal, "goal": goal, "stops": stops}
    scene = scene_from_document(SceneDocument.model_validate(data))
    dwells = (Dwell(0, 0), Dwell(0, 0))
    table = SimpleNamespace(dwells=dwells, cycle=0.01, pose=lambda _row: rig.home)
    prepared: Any = SimpleNamespace(rig=rig, scene=scene, checked=SimpleNamespace(table=table))
    recorder = Recorder(
        prepared,
        folder,
        RunStatus(prepared, folder.path, LocalRequests(), simulated_time=True),
        trigger=trigger or (lambda *_: done.append("image")),
        every=every,
        progress=lambda _row: done.append("progress"),
        announce=lambda _text: done.append("announced"),
    )
    monkeypatch.setattr(recorder.log, "encoder_pose", lambda _record: None)
    monkeypatch.setattr(recorder.writer, "take_cycles", lambda _at: done.append("cycle"))
    return recorder


def cycle_at(at: float, state: State) -> CycleRecord:
    rig = load_rig(CONFIGS / "gachon_8_6.yaml")
    counts = tuple(winch.home_counts for winch in rig.winches)
    zeros = (0,) * rig.cable_count
    return CycleRecord(
        0, at, state, 0.0, 1.0, counts, counts, zeros, zeros, 0, 0, 0, 0.0, 0.0, (True,) * 8,
    )  # fmt: skip


def test_a_full_disk_hides_nothing_else_of_a_cycle(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two events are due in it; the first fault lost the second, and the image."""

    def full(_folder: RunFolder, event: RunEvent) -> None:
        raise Fault(f"{event.code} cannot be written: No space left on device")

    done: list[str] = []
    recorder = recorder_of(folder, done, monkeypatch)
    monkeypatch.setattr(RunFolder, "append_event", full)
    with pytest.raises(Fault, match="pass cannot be written"):
        recorder.take_cycle(cycle_at(5.0, State.MOVING), None)
    assert [event.code for event in recorder.log.events] == ["pass", "pass"]
    assert done == ["announced", "announced", "progress", "image", "cycle"]


def test_an_event_from_before_the_first_cycle_is_at_its_time(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Events of the real-time process are taken after the cycles of the same interval."""
    recorder = recorder_of(folder, [], monkeypatch)
    recorder.take_cycle(cycle_at(36_123.4, State.ENABLING), None)
    for at in (0.0, 36_123.3, 36_123.5):
        recorder.take_event(LoopEvent(0, at, "simulated", "the drives are simulated"))
    assert [event.time_s for event in folder.events()] == [0.0, 0.0, 0.1]


@pytest.mark.parametrize(
    ("every", "pose_every"), [(1, 1), (10, 10), (20, 10), (50, 10), (33, 3), (7, 7), (13, 1)]
)
def test_poses_come_at_least_ten_times_a_second_and_with_every_image(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch, every: int, pose_every: int
) -> None:
    """Of 10 ms; a camera may take an image only once a second."""
    due: list[bool] = []
    recorder = recorder_of(folder, [], monkeypatch, every, lambda *given: due.append(given[1]))
    record = cycle_at(0.0, State.READY)
    assert recorder.pose_every == pose_every
    for k in range(2 * every + 1):
        recorder.take_cycle(replace(record, cycle=k, at=0.01 * k), None)
    assert len(due) == 2 * every // pose_every + 1
    assert due == [k * pose_every % every == 0 for k in range(len(due))]
