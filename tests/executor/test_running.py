"""Stopping from elsewhere: every announced run is reached, and nothing else is touched."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from cdpr.errors import Refused
from executor.running import STOP_SIGNALS, announced, stop_all, stop_requests

#: A run as the command line makes one: tells that it is announced, ends when it was asked to.
RUN = """
import signal, sys
from executor.running import announced, stop_requests
with stop_requests() as requested, announced():
    print("announced", flush=True)
    while not requested():
        signal.sigtimedwait([], 0.01)
print("stopped", flush=True)
"""
ENDS_WITHIN_S = 30
ROOT = Path(__file__).parents[2]


@pytest.fixture
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """The two folders of this user: the run-time one and the one below the temporary folder."""
    for name in ("runtime", "temporary"):
        (tmp_path / name).mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "runtime"))
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return tmp_path / "runtime" / "cdpr", tmp_path / "temporary" / f"cdpr-{os.getuid()}"


@contextmanager
def _run() -> Iterator[subprocess.Popen[str]]:
    """A run in its own process, announced."""
    command = [sys.executable, "-c", RUN]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    deadline = threading.Timer(ENDS_WITHIN_S, process.kill)
    deadline.start()
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == "announced\n"
        yield process
    finally:
        deadline.cancel()
        deadline.join()
        process.kill()
        process.wait()
        process.stdout.close()


def _end(process: subprocess.Popen[str]) -> tuple[str, int]:
    """What it said last, and its exit code; it is killed when it does not end in time."""
    assert process.stdout is not None
    return process.stdout.read(), process.wait()


@pytest.mark.parametrize("without", ["", "XDG_RUNTIME_DIR"])
def test_stop_reaches_a_run_also_from_a_terminal_without_a_run_time_folder(
    folders, monkeypatch, without
):
    with _run() as process:
        if without:
            monkeypatch.delenv(without)
        assert stop_all() == [process.pid]
        assert _end(process) == ("stopped\n", 0)
    assert stop_all() == []


def test_stop_reaches_every_run(folders):
    with _run() as one, _run() as other:
        assert stop_all() == sorted([one.pid, other.pid])
        assert _end(one) == _end(other) == ("stopped\n", 0)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_ctrl_c_a_signal_and_a_closed_terminal_are_requests_not_ends(folders, number):
    with _run() as process:
        process.send_signal(number)
        assert _end(process) == ("stopped\n", 0)


def test_a_run_that_was_killed_leaves_nothing_that_is_stopped(folders):
    """Its number may be another process's by now."""
    with _run() as process:
        process.kill()
        process.wait()
        assert [list(folder.iterdir()) for folder in folders] != [[], []]
        assert stop_all() == []
    assert [list(folder.iterdir()) for folder in folders] == [[], []]


def test_an_announcement_ends_with_its_block(folders):
    with announced():
        names = [[path.name for path in folder.iterdir()] for folder in folders]
        assert names == [[f"{os.getpid()}.run"]] * 2
    assert [list(folder.iterdir()) for folder in folders] == [[], []]


def test_an_announcement_ends_also_when_its_block_breaks(folders):
    with pytest.raises(KeyError), announced():
        raise KeyError
    assert [list(folder.iterdir()) for folder in folders] == [[], []]


def test_nothing_runs_where_nothing_was_announced(folders):
    assert stop_all() == []
    assert not any(folder.exists() for folder in folders), "asking makes no folders"


@pytest.mark.parametrize("name", ["notes.txt", "abc.run", "-5.run", "12x.run", ".run"])
def test_other_files_are_left_alone(folders, name):
    for folder in folders:
        folder.mkdir(mode=0o700)
        (folder / name).write_text("mine")
    assert stop_all() == []
    assert [(folder / name).read_text() for folder in folders] == ["mine", "mine"]


def test_a_new_file_is_closed_to_others(folders):
    with announced():
        for folder in folders:
            (file,) = folder.iterdir()
            assert folder.stat().st_mode & 0o777 == 0o700
            assert file.stat().st_mode & 0o077 == 0


def test_a_link_in_place_of_the_file_is_not_followed(folders, tmp_path):
    """Who could write to the folder before it was closed could have had any file emptied."""
    precious = tmp_path / "precious"
    precious.write_text("mine")
    folders[0].mkdir(mode=0o700)
    (folders[0] / f"{os.getpid()}.run").symlink_to(precious)
    with pytest.raises(OSError, match="symbolic link"), announced():
        pass
    assert precious.read_text() == "mine"
    assert stop_all() == []
    assert precious.read_text() == "mine"


def _spoil(folder: Path, how: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes the folder one that another user may write to, or have made."""
    if how == "link":
        (tmp_path / "elsewhere").mkdir(mode=0o700)
        folder.symlink_to(tmp_path / "elsewhere")
        return
    folder.mkdir(mode=0o700)
    if how == "open to all":
        folder.chmod(0o777)
    elif how == "readable":
        folder.chmod(0o755)
    else:
        inode, uid = folder.stat().st_ino, os.getuid()
        real = os.fstat

        def owned_by_another(descriptor: int) -> os.stat_result:
            status = list(real(descriptor))
            if status[1] == inode:
                status[4] = uid + 1
            return os.stat_result(status)

        monkeypatch.setattr(os, "fstat", owned_by_another)


spoilt = pytest.mark.parametrize("how", ["link", "open to all", "readable", "another user's"])


@spoilt
def test_a_folder_that_others_control_is_not_used_while_there_is_another(
    folders, tmp_path, monkeypatch, how
):
    safe, doubtful = folders
    _spoil(doubtful, how, tmp_path, monkeypatch)
    with announced():
        assert [path.name for path in safe.iterdir()] == [f"{os.getpid()}.run"]
        assert list(doubtful.iterdir()) == []


@spoilt
def test_a_run_that_no_stop_could_reach_is_refused(folders, tmp_path, monkeypatch, how):
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    _spoil(folders[1], how, tmp_path, monkeypatch)
    with pytest.raises(Refused, match="could not reach this run") as caught, announced():
        pass
    assert str(folders[1]) in caught.value.where


@spoilt
def test_no_process_is_stopped_on_the_word_of_a_folder_that_others_control(
    folders, tmp_path, monkeypatch, how
):
    with _run() as process:
        name = f"{process.pid}.run"
        (tmp_path / name).hardlink_to(folders[1] / name)  # locked, whatever it is called
        for folder in folders:
            (folder / name).unlink()
            folder.rmdir()
        _spoil(folders[1], how, tmp_path, monkeypatch)
        (folders[1] / name).hardlink_to(tmp_path / name)
        assert stop_all() == []
        assert process.poll() is None


def test_two_stops_at_once_do_not_take_each_other_for_a_run(folders, monkeypatch):
    """One looks at a stale file while the other does; its number may be anybody's."""
    import fcntl

    folders[0].mkdir(mode=0o700)
    stale = folders[0] / f"{os.getpid()}.run"
    stale.touch()
    with stale.open() as other:
        fcntl.flock(other, fcntl.LOCK_SH)
        killed: list[int] = []
        monkeypatch.setattr(os, "kill", lambda number, _signal: killed.append(number))
        assert stop_all() == []
        assert killed == []


def test_a_run_that_ends_while_it_is_asked_to_stop_is_no_error(folders, monkeypatch):
    with _run():

        def gone(_number: int, _signal: int) -> None:
            raise ProcessLookupError

        monkeypatch.setattr(os, "kill", gone)
        assert stop_all() == []
        monkeypatch.undo()


def test_an_announcement_that_was_removed_before_it_was_locked_is_made_again(folders, monkeypatch):
    """A stop at the very beginning of a run takes the file that is not yet locked for stale."""
    import fcntl

    real, removed = fcntl.flock, []

    def flock(file: int, operation: int) -> None:
        if operation == fcntl.LOCK_EX and not removed:
            removed.append(file)
            (folders[0] / f"{os.getpid()}.run").unlink()
        real(file, operation)

    monkeypatch.setattr(fcntl, "flock", flock)
    with announced():
        assert removed
        assert (folders[0] / f"{os.getpid()}.run").exists()


def test_handlers_are_put_back(folders):
    before = [signal.getsignal(number) for number in STOP_SIGNALS]
    with stop_requests() as requested:
        assert requested() is False
        os.kill(os.getpid(), signal.SIGINT)
        assert requested() is True
    assert [signal.getsignal(number) for number in STOP_SIGNALS] == before


def test_a_run_under_nohup_outlives_its_terminal():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stop_requests() as requested:
            os.kill(os.getpid(), signal.SIGHUP)
            assert requested() is False
            os.kill(os.getpid(), signal.SIGTERM)
            assert requested() is True
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
