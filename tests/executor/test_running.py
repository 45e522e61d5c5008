"""Connecting to runs: every advertised run is found, and nothing else is touched."""

from __future__ import annotations

import asyncio
import errno
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st

from cdpr.cli.operate.monitor import _show_end
from cdpr.cli.operate.supervision import STOP_SIGNALS, stop_requests
from executor import homing, jogging, runner, service
from executor.hold_to_run import session
from executor.remote import command_socket
from executor.remote.client import StopResult, ask_all, final_status, stop_runs
from executor.remote.command_server import commands_from_start
from executor.remote.command_socket import find_runs, is_stopped_since, record_stop
from executor.remote.status import WinchStatus
from executor.supervision import LocalRequests, OperatorRequests, Supervisor
from model.errors import Refused, StoppedByOperator
from model.rig import load_rig
from tests.executor import fake_run
from tests.executor.sockets import advertised

#: A run as made by the command line: prints that it is advertised, ends on request.
RUN = """
import signal
from cdpr.cli.operate.supervision import stop_requests
from tests.executor.sockets import advertised
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
    monkeypatch.setattr(command_socket, "FIXED", tmp_path / "temporary")
    return tmp_path / "runtime" / "cdpr", tmp_path / "temporary" / f"cdpr-{os.getuid()}"


@contextmanager
def _run() -> Iterator[subprocess.Popen[str]]:
    """A run in its own process, advertised."""
    command = [sys.executable, "-c", RUN]
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, cwd=ROOT)
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
        process.communicate()


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


@pytest.mark.parametrize("base", ["", "default", "apart", "relative"])
def test_a_run_is_reached_from_a_terminal_with_another_temporary_folder(
    tmp_path, monkeypatch, base
):
    """Only a run-time folder of another name keeps runs apart; a relative one is ignored."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(command_socket, "FIXED", tmp_path / "fixed")
    default = tmp_path / "default"
    monkeypatch.setattr(command_socket, "_default_run_time_folder", lambda: default)
    value = str(tmp_path / base) if base in ("default", "apart") else base
    monkeypatch.setenv("XDG_RUNTIME_DIR", value)
    for name in ("fixed", "here", "there", *([base] if base else [])):
        (tmp_path / name).mkdir()

    def in_terminal(name: str) -> None:
        monkeypatch.setenv("TMPDIR", str(tmp_path / name))
        monkeypatch.setattr(tempfile, "tempdir", None)

    in_terminal("here")
    with advertised():
        in_terminal("there")
        assert _reached() == [os.getpid()]
        monkeypatch.delenv("XDG_RUNTIME_DIR")
        assert _reached() == ([] if base == "apart" else [os.getpid()])
        assert is_stopped_since(0.0) is False
        record_stop()
        in_terminal("here")
        assert is_stopped_since(0.0) is True


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
        with find_runs(ahead=True) as runs:
            assert runs == []
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
            names = [path.name for path in folders[0].glob("*[0-9].sock")]
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
        monkeypatch.setattr(command_socket, "FIXED", Path(folder))
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
            assert folder.stat().st_mode & 0o777 == 0o700
            assert [file.stat().st_mode & 0o077 for file in folder.iterdir()] == [0, 0]


READ_ONLY = OSError(errno.EROFS, "Read-only file system")


def _refuse_in(monkeypatch: pytest.MonkeyPatch, *refusing: Path) -> None:
    """Folders in which no socket can be created, as on a failing disk."""
    for path in refusing:
        path.mkdir(mode=0o700)
    inodes, listen = [path.stat().st_ino for path in refusing], command_socket._listen_in

    def listen_in(folder: int, name: str) -> socket.socket:
        if os.fstat(folder).st_ino in inodes:
            raise READ_ONLY
        return listen(folder, name)

    monkeypatch.setattr(command_socket, "_listen_in", listen_in)


@pytest.mark.parametrize("k", [0, 1])
def test_a_folder_in_which_no_socket_can_be_made_is_not_used_while_there_is_another(
    folders, monkeypatch, k
):
    _refuse_in(monkeypatch, folders[k])
    with advertised() as listeners:
        assert (len(listeners), _reached()) == (1, [os.getpid()])
        assert list(folders[k].iterdir()) == []
    assert list(folders[1 - k].iterdir()) == []
    with commands_from_start("run", RIG, Supervisor(), realtime=False):
        assert stop_runs().stopped == (os.getpid(),)


def test_a_run_is_refused_where_no_socket_can_be_made(folders, monkeypatch):
    _refuse_in(monkeypatch, *folders)
    with pytest.raises(Refused, match="would not reach this run") as caught, advertised():
        pass
    assert caught.value.why == "Read-only file system"
    assert all(str(folder) in caught.value.where for folder in folders)


def test_a_socket_that_cannot_be_removed_keeps_no_stop_from_other_runs(folders, monkeypatch):
    """Left by a program that was killed before its disk failed."""
    folders[0].mkdir(mode=0o700)
    with socket.socket(socket.AF_UNIX) as listener:
        monkeypatch.chdir(folders[0])
        listener.bind("77.sock")
    real = os.unlink

    def unlink(name: Any, **where: Any) -> None:
        if name == "77.sock":
            raise READ_ONLY
        real(name, **where)

    monkeypatch.setattr(os, "unlink", unlink)
    with commands_from_start("run", RIG, Supervisor(), realtime=False):
        assert stop_runs().stopped == (os.getpid(),)


def test_a_link_instead_of_the_socket_is_not_followed(folders, tmp_path):
    """A user with earlier write access to the folder could have had any file replaced."""
    precious = tmp_path / "precious"
    precious.write_text("mine")
    folders[0].mkdir(mode=0o700)
    for ending in ("sock", "preparing.sock", "preparing.sock.new"):
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
        names = [path.name for path in safe.iterdir()]
        assert sorted(names) == [f"{os.getpid()}{ending}.sock" for ending in (".preparing", "")]
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


# Motions in preparation.

RIG = load_rig(ROOT / "configs/gachon_8_6.yaml")
BOOT = Path("/proc/sys/kernel/random/boot_id").read_text().strip()


def _now() -> float:
    return time.clock_gettime(time.CLOCK_BOOTTIME)


@pytest.mark.parametrize("realtime", [False, True])
def test_a_motion_in_preparation_is_found_for_a_stop_alone(folders, realtime):
    supervisor, pid = Supervisor(), os.getpid()
    with commands_from_start("home", RIG, supervisor, realtime=realtime) as commands:
        assert _reached() == []
        with find_runs(ahead=True) as runs:
            assert [(run.process, run.is_ahead) for run in runs] == [(pid, True)]
            (answer,) = ask_all(runs, "status")
            assert answer.status is not None
            assert (answer.status["state"], answer.status["verb"]) == ("preparing", "home")
            assert "takes only a stop" in ask_all(runs, "hold")[0].what
            moving: Any = SimpleNamespace(as_dict=lambda: {"state": "moving"})
            with commands.during_motion(moving):
                assert _reached() == [pid]
                with find_runs(ahead=True) as found:
                    assert [(run.process, run.is_ahead) for run in found] == [(pid, False)]
                assert ask_all(runs, "hold")[0].status == {"state": "moving"}, "the same connection"
                assert commands.board.read() == OperatorRequests(hold=True)
            assert (_reached(), ask_all(runs, "status")[0].ended) == ([], True)
    assert all([path.name for path in folder.iterdir()] == [] for folder in folders)


def test_a_stop_during_the_preparation_stays_and_interrupts_the_program_once(folders):
    interrupted: list[bool] = []
    supervisor = Supervisor()
    supervisor.on_early_stop = lambda: interrupted.append(True)  # type: ignore[method-assign]
    with commands_from_start("run", RIG, supervisor, realtime=False) as commands:
        for _ in range(2):
            assert stop_runs().stopped == (os.getpid(),)
        assert interrupted == [True]
        begun = commands.during_motion(WinchStatus(RIG, commands.board, simulated_time=True))
        with pytest.raises(StoppedByOperator, match="before anything moved"):
            begun.__enter__()


ERRORS = [StoppedByOperator("stopped before anything moved"), Refused("a drive is in fault")]


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
@pytest.mark.parametrize("is_begun", [False, True])
def test_what_ends_before_it_began_is_not_reported_as_latched(folders, error, is_begun):
    """A release that was stopped while its drives were opened; nothing was latched."""
    with ExitStack() as follow:
        with (
            suppress(type(error)),
            commands_from_start("release", RIG, Supervisor(), realtime=False) as commands,
        ):
            status = WinchStatus(RIG, commands.board, simulated_time=False)
            with commands.during_motion(status):
                (run,) = follow.enter_context(find_runs())
                assert ask_all([run], "status")[0].status is not None
                if is_begun:
                    status.take_release()
                raise error
        last = final_status(run)
    assert last is not None
    assert last["cause"] == error.what
    ended = "latched" if is_begun else "stopped" if error is ERRORS[0] else "preparing"
    assert last["state"] == ended
    with pytest.raises(typer.Exit) as code:
        _show_end(last, as_json=False)
    assert code.value.exit_code == (130 if ended == "stopped" else 1)


def test_ctrl_c_by_a_stop_is_a_stop_and_ctrl_c_alone_is_ctrl_c(folders):
    def interrupted(stops: bool) -> None:
        with commands_from_start("run", RIG, Supervisor(), realtime=False):
            if stops:
                stop_runs()
            raise KeyboardInterrupt

    with pytest.raises(StoppedByOperator):
        interrupted(True)
    with pytest.raises(KeyboardInterrupt):
        interrupted(False)


@pytest.mark.parametrize("umask", [0o022, 0o027, 0o077])
def test_the_record_of_a_stop_by_root_can_be_read_by_users(folders, umask):
    before = os.umask(umask)
    try:
        record_stop()
    finally:
        os.umask(before)
    assert [(folder / "stopped").stat().st_mode & 0o777 for folder in folders] == [0o644] * 2


@pytest.mark.parametrize("is_later", [True, False])
def test_a_stop_reaches_a_program_that_was_started_before_it_and_answers_later(folders, is_later):
    """Such as one that is still loading: it has no socket yet."""
    supervisor = Supervisor()
    supervisor.began = _now()
    if is_later:
        assert stop_runs() == StopResult((), ())
    else:
        stop_runs()
        supervisor.began = _now() + 0.001
    begun = commands_from_start("run", RIG, supervisor, realtime=False)
    with pytest.raises(StoppedByOperator) if is_later else nullcontext(), begun:
        pass


def test_a_stop_does_not_reach_what_a_script_calls_after_it(folders):
    stop_runs()
    with commands_from_start("run", RIG, Supervisor(), realtime=False) as commands:
        assert not commands.board.read().stop


@given(began=st.floats(0.0, 1e9), at=st.floats(0.0, 1e9), boot=st.sampled_from([BOOT, "another"]))
def test_a_recorded_stop_counts_since_then_and_since_the_computer_began(began, at, boot):
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        own = Path(folder) / "cdpr"
        own.mkdir(mode=0o700)
        patch.setattr("executor.remote.command_socket._own_folders", lambda: [own])
        (own / "stopped").write_text(f"{boot} {at!r}\n")
        assert is_stopped_since(began) == (at >= began and boot == BOOT)


@pytest.mark.parametrize("text", ["", "x", f"{BOOT}", f"{BOOT} soon", f"{BOOT} nan", "\xff " * 200])
def test_a_record_of_a_stop_that_is_none_stops_nothing(folders, text):
    folders[0].mkdir(mode=0o700)
    (folders[0] / "stopped").write_text(text)
    assert not is_stopped_since(0.0)


def test_the_record_of_a_stop_follows_no_link(folders, tmp_path):
    precious = tmp_path / "precious"
    precious.write_text("mine")
    folders[0].mkdir(mode=0o700)
    (folders[0] / "stopped").symlink_to(precious)
    record_stop()
    assert precious.read_text() == "mine"
    assert is_stopped_since(0.0)


VIRTUAL = RIG.with_bus("virtual")
VERBS: dict[str, Callable[..., Any]] = {
    "home": partial(homing.home, VIRTUAL, at_home=True, realtime=False),
    "jog_cable": partial(jogging.jog_cable, VIRTUAL, 1, 0.001, realtime=False),
    "jog_session": partial(session.jog_session, VIRTUAL, None, realtime=False),
    "cable_session": partial(session.cable_session, VIRTUAL, realtime=False),
    "release": partial(service.release, RIG.with_bus("udp_multicast", "239.74.9.9")),
}


@pytest.mark.parametrize("verb", VERBS)
def test_a_stop_before_the_answer_to_its_question_ends_every_verb(
    folders, tmp_path, monkeypatch, verb
):
    """Whatever the answer is: nothing is enabled, and no folder is left."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(service, "faults_to_release_under", lambda _rig: (None, ()))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    asked: list[tuple[int, ...]] = []

    def confirm(_: object) -> bool:
        asked.append(stop_runs().stopped)
        return True

    with pytest.raises(StoppedByOperator, match="before anything moved"):
        VERBS[verb](confirm=confirm)
    assert asked == [(os.getpid(),)]
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("verb", ["run", "jog"])
def test_a_stop_during_the_check_of_a_plan_ends_the_run(folders, tmp_path, monkeypatch, verb):
    monkeypatch.chdir(tmp_path)
    plan = fake_run.make(rate_hz=1.0, every=100, camera=False).context.plan
    stopped: list[tuple[int, ...]] = []

    def compute(*_: object) -> Any:
        stopped.append(stop_runs().stopped)
        return plan.document if verb == "jog" else SimpleNamespace(rig=plan.rig)

    monkeypatch.setattr(runner, "prepare_plan", compute)
    monkeypatch.setattr(jogging, "plan_straight_move", compute)
    begin = {
        "run": partial(runner.run, plan, plan.rig, cameras=[]),
        "jog": partial(jogging.jog, VIRTUAL, None, to_home=True),
    }
    with pytest.raises(StoppedByOperator):
        begin[verb](realtime=False)
    assert stopped == [(os.getpid(),)]
    assert list(tmp_path.glob("runs/*")) == []


@pytest.mark.parametrize("verb", [*VERBS, "reset"])
def test_ctrl_c_at_the_question_of_a_verb_in_a_coroutine_ends_it(
    folders, tmp_path, monkeypatch, verb
):
    """The handler of asyncio would only cancel the coroutine at its next ``await``."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(service, "faults_to_release_under", lambda _rig: (None, ()))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    reset = partial(service.reset, RIG.with_bus("udp_multicast", "239.74.9.9"))

    def confirm(_: object) -> bool:
        signal.raise_signal(signal.SIGINT)
        return False

    async def main() -> None:
        before = signal.getsignal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            (VERBS | {"reset": reset})[verb](confirm=confirm)
        assert signal.getsignal(signal.SIGINT) is before is not signal.default_int_handler

    asyncio.run(main())


@pytest.mark.parametrize("verb", ["run", "jog"])
def test_ctrl_c_during_the_check_of_a_plan_in_a_coroutine_ends_the_run(
    folders, tmp_path, monkeypatch, verb
):
    monkeypatch.chdir(tmp_path)
    plan = fake_run.make(rate_hz=1.0, every=100, camera=False).context.plan

    def compute(*_: object) -> Any:
        signal.raise_signal(signal.SIGINT)
        raise Refused("Ctrl-C had no effect")

    monkeypatch.setattr(runner, "prepare_plan", compute)
    monkeypatch.setattr(jogging, "plan_straight_move", compute)

    async def main() -> None:
        if verb == "run":
            runner.run(plan, plan.rig, cameras=[], realtime=False)
        else:
            jogging.jog(VIRTUAL, None, to_home=True, realtime=False)

    with pytest.raises(KeyboardInterrupt):
        asyncio.run(main())
    assert list(tmp_path.glob("runs/*")) == []


@pytest.mark.parametrize("realtime", [False, True])
def test_ctrl_c_in_a_coroutine_stops_a_motion(folders, realtime):
    supervisor, paused = Supervisor(), threading.Event()

    async def main() -> None:
        with commands_from_start("run", RIG, supervisor, realtime=realtime) as commands:
            status = WinchStatus(RIG, commands.board, simulated_time=not realtime)

            def motion() -> bool:
                with commands.during_motion(status):
                    signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
                    for _ in range(100 * ENDS_WITHIN_S):
                        if commands.board.read().stop:
                            return True
                        paused.wait(0.01)
                return False

            assert supervisor.during(commands.board, motion)
            supervisor.finish()

    with pytest.raises(KeyboardInterrupt):
        asyncio.run(main())
    assert isinstance(supervisor.interruption, KeyboardInterrupt)


#: A program at a question to its operator.
ASKS = """
from pathlib import Path
from cdpr.cli.operate.supervision import SignalSupervisor, has_agreed
from executor.remote.command_server import commands_from_start
from model.errors import StoppedByOperator
from model.rig import load_rig
rig = load_rig(Path("configs/gachon_8_6.yaml"))
try:
    with commands_from_start("run", rig, SignalSupervisor(), realtime=False):
        print("advertised", flush=True)
        has_agreed("Move the platform now?", "nothing was moved")
except StoppedByOperator as error:
    print(error.what, flush=True)
"""


def test_a_stop_ends_the_question_of_the_command_line(folders, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "RUN", ASKS)
    with _run() as process:
        assert stop_runs().stopped == (process.pid,)
        assert process.stdout is not None
        assert process.stdout.readline() == "stopped before anything moved\n"
