"""Connecting to runs: every advertised run is found, and nothing else is touched."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from cdpr.cli.operate.supervision import STOP_SIGNALS, stop_requests
from executor.remote.command_socket import advertised, find_runs
from executor.supervision import LocalRequests
from model.errors import Refused

#: A run as made by the command line: prints that it is advertised, ends on request.
RUN = """
import signal
from cdpr.cli.operate.supervision import stop_requests
from executor.remote.command_socket import advertised
from executor.supervision import LocalRequests
board = LocalRequests()
with stop_requests(board), advertised() as listeners:
    print("advertised", flush=True)
    while not board.read().stop:
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
    """A run in its own process, advertised."""
    command = [sys.executable, "-c", RUN]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    deadline = threading.Timer(ENDS_WITHIN_S, process.kill)
    deadline.start()
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == "advertised\n"
        yield process
    finally:
        deadline.cancel()
        deadline.join()
        process.kill()
        process.wait()
        process.stdout.close()


def _reached() -> list[int]:
    with find_runs() as runs:
        return [run.process for run in runs]


@pytest.mark.parametrize("without", ["", "XDG_RUNTIME_DIR"])
def test_a_run_is_reached_also_from_a_terminal_without_a_run_time_folder(
    folders, monkeypatch, without
):
    with _run() as process:
        if without:
            monkeypatch.delenv(without)
        assert _reached() == [process.pid]
        process.terminate()
        process.wait()
        assert _reached() == []


def test_every_run_is_reached(folders):
    with _run() as one, _run() as other:
        assert _reached() == sorted([one.pid, other.pid])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_ctrl_c_a_signal_and_a_closed_terminal_are_requests_not_ends(folders, number):
    with _run() as process:
        process.send_signal(number)
        assert process.stdout is not None
        assert (process.stdout.read(), process.wait()) == ("stopped\n", 0)


def test_a_run_that_was_killed_is_not_reached_and_its_name_is_cleared_away(folders):
    with _run() as process:
        process.kill()
        process.wait()
        assert all(list(folder.iterdir()) for folder in folders)
        assert _reached() == []
        assert not any(list(folder.iterdir()) for folder in folders)


def test_a_run_that_ended_leaves_nothing(folders):
    with advertised():
        assert _reached() == [os.getpid()]
    assert not any(list(folder.iterdir()) for folder in folders)
    assert _reached() == []


def test_several_runs_of_one_process_are_reached_each_until_its_own_end(folders):
    """Each in a thread of a script: a second one had taken the name of the first."""
    pid = os.getpid()
    with ExitStack() as second, ExitStack() as third:
        with advertised():
            second.enter_context(advertised())
            third.enter_context(advertised())
            assert _reached() == [pid] * 3
            second.close()
            assert _reached() == [pid] * 2
            second.enter_context(advertised())
            names = [path.name for path in folders[0].iterdir()]
            assert sorted(names) == [f"{pid}-2.sock", f"{pid}-3.sock", f"{pid}.sock"]
        assert _reached() == [pid] * 2
    assert _reached() == []
    assert not any(list(folder.iterdir()) for folder in folders)


NOBODY = 65534
#: Like `RUN`, as another user from the point where all modules are loaded.
FOREIGN = RUN.replace("board = ", f"import os\nos.setgid({NOBODY})\nos.setuid({NOBODY})\nboard = ")


@pytest.mark.root
def test_root_reaches_the_runs_of_other_users(monkeypatch):
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setattr(sys.modules[__name__], "RUN", FOREIGN)
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        Path(folder).chmod(0o777)
        monkeypatch.setenv("TMPDIR", folder)
        monkeypatch.setattr(tempfile, "tempdir", None)
        with _run() as process:
            assert _reached() == [process.pid]


@pytest.mark.root
def test_a_user_is_not_reached_through_a_folder_of_another(folders):
    with advertised():
        for folder in folders:
            os.chown(folder, NOBODY, NOBODY)
        assert _reached() == []


def test_names_of_other_things_are_left_alone(folders):
    folders[0].mkdir(mode=0o700)
    for name in ("12.sock", "notes.txt", "x.sock"):
        (folders[0] / name).write_text("mine")
    assert _reached() == []
    assert len(list(folders[0].iterdir())) == 3


def test_folder_and_socket_are_closed_to_others(folders):
    with advertised():
        for folder in folders:
            (file,) = folder.iterdir()
            assert folder.stat().st_mode & 0o777 == 0o700
            assert file.stat().st_mode & 0o077 == 0


def test_a_link_instead_of_the_socket_is_not_followed(folders, tmp_path):
    """A user with earlier write access to the folder could have had any file replaced."""
    precious = tmp_path / "precious"
    precious.write_text("mine")
    folders[0].mkdir(mode=0o700)
    for ending in ("sock", "sock.new"):
        (folders[0] / f"{os.getpid()}.{ending}").symlink_to(precious)
    with advertised():
        assert _reached() == [os.getpid()]
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
    with advertised():
        assert [path.name for path in safe.iterdir()] == [f"{os.getpid()}.sock"]
        assert list(doubtful.iterdir()) == []


@spoilt
def test_a_run_that_no_stop_could_reach_is_refused(folders, tmp_path, monkeypatch, how):
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    _spoil(folders[1], how, tmp_path, monkeypatch)
    with pytest.raises(Refused, match="would not reach this run") as caught, advertised():
        pass
    assert str(folders[1]) in caught.value.where


@spoilt
def test_no_connection_is_made_in_a_folder_that_others_control(folders, tmp_path, monkeypatch, how):
    """A stop sent to another user's socket would stop nothing."""
    with socket.socket(socket.AF_UNIX) as listener:
        _spoil(folders[1], how, tmp_path, monkeypatch)
        monkeypatch.chdir(folders[1])
        listener.bind("77.sock")
        listener.listen()
        assert _reached() == []
        assert (folders[1] / "77.sock").exists()


def test_a_listener_of_another_user_is_not_spoken_to(folders, monkeypatch):
    with advertised():
        real = os.getuid()
        other = os.stat(folders[0]).st_uid
        assert other == real
        monkeypatch.setattr(
            "executor.remote.command_socket.struct.unpack", lambda *_: (1, real + 1, 0)
        )
        assert _reached() == []


def test_handlers_are_put_back(folders):
    before = [signal.getsignal(number) for number in STOP_SIGNALS]
    board = LocalRequests()
    with stop_requests(board):
        assert board.read().stop is False
        os.kill(os.getpid(), signal.SIGINT)
        assert board.read().stop is True
    assert [signal.getsignal(number) for number in STOP_SIGNALS] == before


def test_a_run_under_nohup_outlives_its_terminal():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    board = LocalRequests()
    try:
        with stop_requests(board):
            os.kill(os.getpid(), signal.SIGHUP)
            assert board.read().stop is False
            os.kill(os.getpid(), signal.SIGTERM)
            assert board.read().stop is True
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
