"""The fault latch: who holds it, what a second program sees, and write failures."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import stat
from multiprocessing import current_process
from pathlib import Path

import pytest

from drivers.can_bus import BusSettings
from executor import service
from executor.interlock import fault_latch, locks
from executor.interlock.fault_latch import FaultLatch
from executor.state_machine import State
from model.errors import BadInput, Fault, HardwareMissing, Refused, StoppedByOperator
from model.rig import load_rig
from tests.cli.plans import RIG

BUS = BusSettings("udp_multicast", "239.74.163.62")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(locks, "SHARED", tmp_path / "absent")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setattr(fault_latch, "LOCK_TIMEOUT", 0.02)
    return tmp_path / "cdpr"


def two() -> tuple[FaultLatch, FaultLatch]:
    """The latches of two programs; locks of two open files also conflict in one process."""
    return FaultLatch(BUS), FaultLatch(BUS)


def test_the_state_folder_is_the_users_own(folder: Path) -> None:
    FaultLatch(BUS).engage("a rig", folder)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


def test_nothing_is_latched_at_first() -> None:
    mine, _ = two()
    assert mine.read() is None
    mine.require_disengaged()
    mine.require_no_run()
    assert not mine.held_by_another()


def test_while_a_motion_is_active_others_are_refused_by_its_process(folder: Path) -> None:
    mine, other = two()
    mine.engage("a rig", folder)
    assert not mine.held_by_another(), "it is held by this one"
    assert other.held_by_another()
    mine.require_no_run()
    for refused in (other.require_no_run, other.require_disengaged):
        with pytest.raises(Refused, match=f"in progress.*|process {os.getpid()}"):
            refused()
    with pytest.raises(Refused):
        other.engage("a rig", folder)
    assert mine.read() is not None


def test_an_engaged_latch_is_not_engaged_again(folder: Path) -> None:
    mine, other = two()
    mine.engage("a rig", folder)
    mine.settle("a rig", State.LATCHED, "a drive failed", folder)
    for latch in (mine, other):
        with pytest.raises(Refused, match="a drive failed"):
            latch.engage("a rig", folder)
        assert not latch.held_by_another(), "a refusal holds nothing"
    latched = other.read()
    assert latched is not None
    assert (latched.rig, latched.cause, latched.process) == ("a rig", "a drive failed", os.getpid())
    other.require_no_run()


@pytest.mark.parametrize("state", [State.FINISHED, State.STOPPED])
def test_a_good_end_disengages_and_releases_the_lock(folder: Path, state: State) -> None:
    mine, other = two()
    mine.engage("a rig", folder)
    mine.settle("a rig", state, "", folder)
    assert other.read() is None
    other.engage("a rig", folder)
    other.disengage()
    other.disengage()  # again does no harm


def test_a_reset_keeps_runs_off_the_bus_and_ends_disengaged(folder: Path) -> None:
    mine, other = two()
    mine.engage("a rig", folder)
    mine.settle("a rig", State.LATCHED, "a drive failed", folder)
    with mine.held_for_reset("a rig", mine.read()):
        assert other.held_by_another()
        assert other.read() is not None, "latched to its end"
    assert other.read() is None
    assert not other.held_by_another()


@pytest.mark.parametrize("same_process", [False, True])
def test_during_a_reset_the_fault_stays_and_the_process_is_that_of_the_reset(
    folder: Path, same_process: bool
) -> None:
    """It was that of the run, which may be long gone, and no fault was latched.

    A script may run and reset; or two have the same number, as in a container.
    """
    mine, other = two()
    mine.engage("gachon_8_6", folder)
    assert other.read_in_motion() == (None, os.getpid()), "its fault is latched if it ends badly"
    mine.settle("gachon_8_6", State.LATCHED, "a drive failed", folder)
    latched = mine.read()
    assert latched is not None
    gone = dataclasses.replace(latched, process=2**22 + 1)
    mine.path.write_text(json.dumps(dataclasses.asdict(gone)))
    assert other.read_in_motion() == (gone, None)
    rig = load_rig(RIG).with_bus(BUS.interface, BUS.channel)
    if same_process:
        mine.path.write_text(json.dumps(dataclasses.asdict(latched)))
        gone = latched
    with mine.held_for_reset("gachon_8_6", gone):
        assert other.read_in_motion() == (gone, os.getpid())
        with pytest.raises(Refused, match=rf"\(process {os.getpid()}\) is in progress"):
            other.require_no_run()
        seen = service.status(rig)
        assert (seen.latched, seen.run, seen.drives) == ("a drive failed", os.getpid(), None)
        assert f"a drive failed; process {os.getpid()} is" in dict(seen.facts())["latched fault"]


def test_a_reset_in_a_process_that_cannot_start_others_latches_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As a worker of `multiprocessing.Pool`; Python's AssertionError left the bus latched."""
    monkeypatch.setitem(current_process()._config, "daemon", True)  # type: ignore[attr-defined]
    with pytest.raises(BadInput, match="cannot start others, for drives in real time"):
        service.reset(load_rig(RIG).with_bus(BUS.interface, BUS.channel))
    FaultLatch(BUS).require_disengaged()


REFUSED = [Refused("other drives hold"), BadInput("no rig"), StoppedByOperator("stopped")]
FAILED = [
    Fault("drive 3 stays in fault"),
    HardwareMissing("drive 3 is silent"),
    ZeroDivisionError(),
]


def failed_reset(latch: FaultLatch, error: BaseException) -> None:
    reset = latch.held_for_reset("a rig", latch.read())
    reset.__enter__()
    assert FaultLatch(BUS).held_by_another()
    assert not reset.__exit__(type(error), error, None), "it is raised on"
    assert not FaultLatch(BUS).held_by_another()


@pytest.mark.parametrize("error", REFUSED + FAILED, ids=lambda error: type(error).__name__)
def test_a_reset_that_fails_leaves_the_latch_as_it_was(folder: Path, error: Exception) -> None:
    mine, other = two()
    mine.engage("a rig", folder)
    mine.settle("a rig", State.LATCHED, "a drive failed", folder)
    shown = mine.read()
    failed_reset(mine, error)
    assert other.read() == shown


@pytest.mark.parametrize("error", REFUSED, ids=lambda error: type(error).__name__)
def test_a_reset_that_is_refused_latches_nothing(error: Exception) -> None:
    mine, other = two()
    failed_reset(mine, error)
    other.require_disengaged()


@pytest.mark.parametrize("error", FAILED, ids=lambda error: type(error).__name__)
def test_a_reset_that_fails_is_latched_where_nothing_was(error: Exception) -> None:
    """Drives that stopped holding, or are silent; messages say that the latch stays engaged."""
    mine, other = two()
    failed_reset(mine, error)
    latched = other.read()
    assert latched is not None
    assert latched.rig == "a rig"
    assert latched.cause == (getattr(error, "what", "") or "a reset did not finish")


def test_a_latch_that_changed_since_it_was_shown_is_not_reset(folder: Path) -> None:
    mine, other = two()
    mine.engage("a rig", folder)
    mine.settle("a rig", State.LATCHED, "a drive failed", folder)
    shown = mine.read()
    assert shown is not None
    before = dataclasses.replace(shown, cause="another one")
    with pytest.raises(Refused, match="changed"), other.held_for_reset("a rig", before):
        pytest.fail("drives would be reset")
    assert other.read() == shown
    assert not mine.held_by_another()


def test_a_file_that_is_not_a_latch_counts_as_engaged(folder: Path) -> None:
    mine, _ = two()
    folder.mkdir()
    mine.path.write_text("[]")
    latched = mine.read()
    assert latched is not None
    assert latched.process == 0
    with pytest.raises(Refused, match="cannot be read"):
        mine.require_disengaged()


def test_a_state_folder_that_cannot_be_made_engages_nothing(folder: Path) -> None:
    folder.write_text("a file")
    mine, _ = two()
    with pytest.raises(Refused, match=r"Not a directory|File exists"):
        mine.engage("a rig", folder)


@pytest.mark.parametrize("what", ["lock", "latch"])
def test_what_cannot_be_written_is_refused_with_its_reason(folder: Path, what: str) -> None:
    mine, other = two()
    folder.mkdir()
    (mine.path.with_suffix(".lock") if what == "lock" else mine.path).mkdir()
    with pytest.raises(Refused, match=r"directory|regular file"):
        mine.engage("a rig", folder)
    if what == "latch":
        assert not other.held_by_another()
    else:
        with pytest.raises(Refused, match=r"directory|regular file"):
            other.held_by_another()


def test_a_latch_that_cannot_be_removed_is_reported_and_stays_held(folder: Path) -> None:
    mine, other = two()
    mine.engage("a rig", folder)
    mine.path.unlink()
    mine.path.mkdir()
    with pytest.raises(Refused, match="directory"):
        mine.disengage()
    assert other.held_by_another()


def fails(*_: object, **__: object) -> None:
    raise OSError(errno.EROFS, os.strerror(errno.EROFS))


def cannot_be_kept(*_: object, **__: object) -> None:
    raise BadInput("the file cannot be written", where="somewhere", why="Read-only file system")


def test_nothing_moves_when_the_latch_cannot_be_written(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine, other = two()
    monkeypatch.setattr(fault_latch, "write_atomic", cannot_be_kept)
    with pytest.raises(Refused, match=r"fault latch cannot be written.*\n.*Read-only file system"):
        mine.engage("a rig", folder)
    assert mine.read() is None
    assert not other.held_by_another(), "a refusal holds nothing"


def test_nothing_moves_where_a_power_failure_may_lose_the_latch(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine, _ = two()
    fsync = os.fsync

    def of_files(handle: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        fsync(handle)

    monkeypatch.setattr(os, "fsync", of_files)
    with pytest.raises(Refused, match="file system cannot sync folders") as caught:
        mine.engage("a rig", folder)
    assert "on a local disk" in caught.value.next_step
    assert mine.read() is None


def test_nothing_moves_when_the_lock_or_its_folder_cannot_be_made(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine, other = two()
    with monkeypatch.context() as patched:
        patched.setattr(Path, "mkdir", fails)
        with pytest.raises(Refused, match="Read-only file system"):
            mine.engage("a rig", folder)
    folder.mkdir()
    with monkeypatch.context() as patched:
        patched.setattr(fault_latch, "open_lock", fails)
        with pytest.raises(Refused, match="Read-only file system"):
            mine.engage("a rig", folder)
    assert mine.read() is None
    assert not other.held_by_another()


def test_a_motion_that_engages_between_two_reads_keeps_the_other_out(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first check is without the lock: changes since then count."""
    mine, other = two()
    hold = FaultLatch._hold

    def late(latch: FaultLatch) -> None:
        monkeypatch.setattr(FaultLatch, "_hold", hold)
        other.engage("a rig", folder)
        other.settle("a rig", State.LATCHED, "a drive failed", folder)
        hold(latch)

    monkeypatch.setattr(FaultLatch, "_hold", late)
    with pytest.raises(Refused, match="a drive failed"):
        mine.engage("a rig", folder)
    assert not other.held_by_another()
    latched = mine.read()
    assert latched is not None
    assert latched.cause == "a drive failed"


def test_reads_and_refusals_leave_no_file_open(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine, other = two()
    mine.engage("a rig", folder)
    opened, closed = [], []
    really_open, really_close = fault_latch.open_lock, os.close

    def opens(path: Path, *, create: bool = False) -> int:
        opened.append(really_open(path, create=create))
        return opened[-1]

    def closes(handle: int) -> None:
        closed.append(handle)
        really_close(handle)

    monkeypatch.setattr(fault_latch, "open_lock", opens)
    monkeypatch.setattr(os, "close", closes)
    for _ in range(3):
        assert other.held_by_another()
        with pytest.raises(Refused):
            other._hold()
    assert len(opened) == 9  # a refusal looks once more
    assert sorted(closed) == sorted(opened)
