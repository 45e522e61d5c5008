"""The command socket: commands, answers, and clients that do not block others."""

from __future__ import annotations

import json
import os
import socket
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from executor.hold_to_run.presses import CableMove, PlatformMove
from executor.remote.client import ask_all, final_status, no_answer, select_run, stop_runs
from executor.remote.command_server import LONGEST_REQUEST, MOST_CLIENTS, serving
from executor.remote.command_socket import RunConnection, find_runs
from executor.remote.protocol import InvalidCommand, answer_to, make_line, parse_command
from executor.supervision import LocalRequests, OperatorRequests
from model.errors import BadInput, Fault
from tests.executor.sockets import advertised


class _Status:
    """Replaces `RunStatus`, whose content does not matter here."""

    def as_dict(self) -> dict[str, Any]:
        return {"state": "moving"}


STATUS: Any = _Status()


def _answer(line: bytes, board: LocalRequests | None = None) -> dict[str, Any]:
    return json.loads(answer_to(line, board or LocalRequests(), STATUS))


def test_each_command_posts_its_request_and_leaves_the_others():
    board = LocalRequests()
    assert _answer(make_line("status"), board) == {"ok": True, "status": {"state": "moving"}}
    assert board.read() == OperatorRequests()
    for command, percent, requests in (
        ("speed", 40, OperatorRequests(speed=0.4)),
        ("hold", None, OperatorRequests(speed=0.4, hold=True)),
        ("resume", None, OperatorRequests(speed=0.4)),
        ("stop", None, OperatorRequests(speed=0.4, stop=True)),
        ("resume", None, OperatorRequests(speed=0.4, stop=True)),
    ):
        assert _answer(make_line(command, percent=percent), board)["ok"] is True
        assert board.read() == requests


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"stop",
        b"{}",
        b"[]",
        b'{"command": "go"}',
        b'{"command": "stop", "percent": 5}',
        b'{"command": "speed"}',
        b'{"command": "speed", "percent": 0}',
        b'{"command": "speed", "percent": 101}',
        b'{"command": "speed", "percent": "50"}',
        b'{"command": "speed", "percent": 50.5}',
        b'{"command": "speed", "percent": NaN}',
        b"\xff\xfe",
    ],
)
def test_what_is_not_a_command_changes_nothing_and_is_reported(line):
    board = LocalRequests()
    answer = _answer(line, board)
    assert answer["ok"] is False
    assert answer["what"].startswith("not a command: ")
    assert board.read() == OperatorRequests()


@given(line=st.binary(max_size=200))
def test_no_bytes_do_anything_but_a_command(line):
    board = LocalRequests()
    answer = _answer(line, board)
    if not answer["ok"]:
        assert board.read() == OperatorRequests()


@given(percent=st.integers(1, 100))
def test_a_speed_travels_as_given(percent):
    command = parse_command(make_line("speed", percent=percent))
    assert command.percent == percent  # type: ignore[union-attr]


@pytest.mark.parametrize("percent", [0, 101])
def test_a_speed_that_is_invalid_is_not_a_command(percent):
    with pytest.raises(InvalidCommand):
        parse_command(make_line("speed", percent=percent))


@pytest.fixture
def board(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[LocalRequests]:
    """The socket of a run that answers."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    board = LocalRequests()
    with advertised() as listeners, serving(listeners, board, STATUS):
        yield board


def test_a_run_hears_and_answers(board):
    with find_runs() as runs:
        (answer,) = ask_all(runs, "speed", 30)
        assert answer.status == {"state": "moving"}
        (answer,) = ask_all(runs, "hold")
        assert answer.status == {"state": "moving"}
    assert board.read() == OperatorRequests(hold=True, speed=0.3)


def _connected() -> socket.socket:
    with find_runs() as runs:
        link = runs[0].link.dup()
    link.settimeout(5.0)
    return link


def test_several_lines_at_once_and_a_line_in_pieces_are_understood(board):
    with _connected() as link, link.makefile("rb") as answers:
        link.sendall(b'{"command": "hold"}\n{"command": "speed", ')
        assert json.loads(answers.readline())["ok"] is True
        link.sendall(b'"percent": 7}\nnonsense\n')
        assert json.loads(answers.readline())["ok"] is True
        assert json.loads(answers.readline())["ok"] is False
    assert board.read() == OperatorRequests(hold=True, speed=0.07)


def test_a_line_without_end_is_cut_off(board):
    with _connected() as link:
        link.sendall(b"x" * (LONGEST_REQUEST + 1))
        with suppress(ConnectionResetError):  # what was not read yet is thrown away
            assert link.recv(10) == b""


def test_a_client_that_never_reads_or_never_speaks_blocks_no_other(board):
    with _connected() as deaf:
        deaf.setblocking(False)
        with suppress(OSError):  # full, or let go
            for _ in range(100_000):
                deaf.send(make_line("status") * 20)
        idle = [_connected() for _ in range(MOST_CLIENTS + 5)]
        try:
            with find_runs() as runs:
                (answer,) = ask_all(runs, "stop")
            assert answer.status is not None
            assert board.read().stop
        finally:
            for link in idle:
                link.close()


def test_a_run_that_ends_is_distinguished_from_one_that_hangs(monkeypatch):
    monkeypatch.setattr("executor.remote.client.ANSWER_TIMEOUT", 0.05)
    ours, theirs = socket.socketpair()
    with ours, theirs:
        (hanging,) = ask_all([RunConnection(7, ours)], "stop")
        assert (hanging.status, hanging.ended) == (None, False)
        assert theirs.recv(100) == make_line("stop")
    ours, theirs = socket.socketpair()
    theirs.close()
    with ours:
        (ended,) = ask_all([RunConnection(7, ours)], "stop")
        assert (ended.status, ended.ended) == (None, True)
    assert "did not answer" in no_answer("stop", [hanging]).what
    assert "ended" in no_answer("stop", [ended]).what


@pytest.mark.parametrize(
    ("said", "what"),
    [
        (b"no json\n", "cannot be read"),
        (b"[]\n", "answer is empty"),
        (b'{"ok": false}\n', "answer is empty"),
        (b'{"ok": false, "what": "not a command: no"}\n', "not a command: no"),
        (b'{"status": 3}\n', "answer is empty"),
    ],
)
def test_a_run_that_refuses_is_quoted(said, what):
    ours, theirs = socket.socketpair()
    with ours, theirs:
        thread = threading.Thread(target=lambda: (theirs.recv(100), theirs.sendall(said)))
        thread.start()
        (answer,) = ask_all([RunConnection(7, ours)], "status")
        thread.join()
    assert (answer.status, answer.ended) == (None, False)
    assert what in answer.what
    assert what in no_answer("hold", [answer]).what


def test_a_command_counts_although_the_run_cannot_report_its_status():
    class Broken:
        def as_dict(self) -> dict[str, Any]:
            raise RuntimeError("half a status")

    board = LocalRequests()
    answer = json.loads(answer_to(make_line("hold"), board, Broken()))
    assert answer["ok"] is False
    assert "half a status" in answer["what"]
    assert board.read() == OperatorRequests(hold=True)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_run_that_could_not_be_stopped_from_elsewhere_any_more_is_stopped(monkeypatch, board):
    def break_down(*_: object) -> None:
        raise RuntimeError("unforeseen")

    monkeypatch.setattr("executor.remote.command_server.answer_to", break_down)
    with find_runs() as runs:
        assert ask_all(runs, "status")[0].ended
    assert board.read().stop


def test_a_run_that_accepts_no_connection_is_silent_and_blocks_nobody(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """As of a suspended run, at which a console has looked many times."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    with advertised(), ExitStack() as waiting:
        for _ in range(300):
            (run,) = waiting.enter_context(find_runs())
            if not run.is_connected:
                break
        assert run.process == os.getpid()
        result = stop_runs()
        assert result.stopped == ()
        assert [(a.process, a.status, a.ended) for a in result.silent] == [
            (os.getpid(), None, False)
        ]
        assert "did not answer" in str(no_answer("stop", result.silent))


def test_which_run_is_meant_must_be_clear():
    ours, theirs = socket.socketpair()
    with ours, theirs:
        one, other = RunConnection(7, ours), RunConnection(8, theirs)
        assert select_run([one], None, "hold") is one
        assert select_run([one, other], 8, "hold") is other
        with pytest.raises(BadInput, match="2 runs"):
            select_run([one, other], None, "hold")
        with pytest.raises(BadInput, match="process 9 is not a run"):
            select_run([one, other], 9, "hold")
        with pytest.raises(Fault, match="no active run"):
            select_run([], None, "hold")
        for process in (None, 7):
            with pytest.raises(BadInput, match="process 7 has 2 runs") as refused:
                select_run([one, RunConnection(7, theirs)], process, "hold")
            assert "a process of its own" in refused.value.next_step


@pytest.mark.parametrize("asked", [0, 1])
def test_a_run_that_ends_sends_its_status_once_more(
    asked: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A monitor that reads a few times per second may have missed the end."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))  # root finds all users' runs there
    monkeypatch.setattr(tempfile, "tempdir", None)
    now = {"state": "moving"}
    status: Any = SimpleNamespace(as_dict=lambda: now)
    with ExitStack() as watching:
        with advertised() as listeners, serving(listeners, LocalRequests(), status):
            runs = watching.enter_context(find_runs())
            for _ in range(1 + asked):
                assert ask_all(runs, "status")[0].status == {"state": "moving"}
            now = {"state": "latched", "cause": "cable 6 is slack"}
        assert ask_all(runs, "status")[0].ended
        assert final_status(runs[0]) == now
        assert final_status(runs[0]) is None


class _Presses:
    """Records its calls; accepts every press except the last."""

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []

    def hold(self, number: int, move: Any, *, step: float | None, percent: int, age: float) -> bool:
        direction = move.direction.tolist()
        self.calls.append((number, direction, move.in_platform, step, percent, age))
        return number < 9

    def let_go(self, number: int) -> None:
        self.calls.append(("let go", number))

    def end(self) -> None:
        self.calls.append(("end",))


def _said(presses: _Presses | None, **question: Any) -> dict[str, Any]:
    line = json.dumps(question).encode()
    answer = json.loads(answer_to(line, LocalRequests(), STATUS, presses))
    assert isinstance(answer, dict)
    return answer


def test_a_session_of_jogs_takes_what_is_reported_of_presses() -> None:
    presses = _Presses()
    held = {"command": "held", "press": 3, "direction": [0, 0.6, 0.8], "frame": "platform"}
    assert _said(presses, **held, step_mm=0.1, percent=25, age_ms=40)["ok"]
    assert _said(presses, command="held", press=4, direction=[1, 1, 0])["ok"]
    assert _said(presses, command="let_go", press=4)["ok"]
    assert _said(presses, command="end")["ok"]
    first, second, *others = presses.calls
    assert first == (3, [0.0, pytest.approx(0.6), pytest.approx(0.8)], True, 0.0001, 25, 0.04)
    assert second == (4, pytest.approx([0.5**0.5, 0.5**0.5, 0.0]), False, None, 100, 0.0)
    assert others == [("let go", 4), ("end",)]
    assert "over" in _said(presses, command="held", press=9, direction=[1, 0, 0])["what"]


@pytest.mark.parametrize("word", [{"command": "hold"}, {"command": "speed", "percent": 10}])
def test_a_session_of_jogs_refuses_what_it_would_ignore(word: dict[str, Any]) -> None:
    """Else somebody who asks for a hold would believe that it holds."""
    answer = _said(_Presses(), **word)
    assert not answer["ok"]
    assert "cdpr stop" in answer["what"]
    assert _said(_Presses(), command="stop")["ok"]
    assert _said(None, **word)["ok"]


@pytest.mark.parametrize(
    "wrong",
    [
        {"press": 0},
        {"press": "1"},
        {"direction": [0, 0, 0]},
        {"direction": [1, 0]},
        {"direction": [2, 0, 0]},
        {"frame": "tool"},
        {"step_mm": 5.0},
        {"percent": 0},
        {"percent": 101},
        {"age_ms": -1},
        {"age_ms": 0.5},
        {"more": 1},
    ],
)
def test_a_press_that_is_invalid_is_refused(wrong: dict[str, Any]) -> None:
    presses = _Presses()
    good = {"command": "held", "press": 1, "direction": [1, 0, 0]}
    assert _said(presses, **good)["ok"]
    presses.calls.clear()
    assert not _said(presses, **{**good, **wrong})["ok"]
    assert not presses.calls


@pytest.mark.parametrize("command", ["held", "let_go", "end"])
def test_any_other_motion_takes_no_jogs(command: str) -> None:
    values = {"held": {"press": 1, "direction": [1, 0, 0]}, "let_go": {"press": 1}, "end": {}}
    assert "takes no jogs" in _said(None, command=command, **values[command])["what"]


class _Noted:
    """Records reports of presses; there is no cable 9."""

    def __init__(self) -> None:
        self.said: list[Any] = []

    def hold(self, number: int, move: Any, **how: Any) -> bool:
        if isinstance(move, PlatformMove):
            move = (move.direction.tolist(), move.in_platform)
        elif move.cable == 9:
            raise ValueError("there is no cable 9")
        self.said.append((number, move, how))
        return number != 13

    def let_go(self, number: int) -> None:
        self.said.append(number)

    def end(self) -> None:
        self.said.append("end")


def _held(**values: Any) -> tuple[dict[str, Any], list[Any]]:
    presses = _Noted()
    line = make_line("held", **values)
    return json.loads(answer_to(line, LocalRequests(), STATUS, presses)), presses.said


def test_a_held_control_moves_the_platform_or_one_cable():
    answer, said = _held(press=1, direction=[0, 0, 2 / 3], frame="platform", step_mm=1.0)
    assert answer["ok"]
    assert said == [(1, ([0, 0, 1], True), {"step": 0.001, "percent": 100, "age": 0.0})]
    answer, said = _held(press=2, cable=3, sense="pay_out", percent=7)
    assert answer["ok"]
    how = {"step": None, "percent": 7, "age": 0.0}
    assert said == [(2, CableMove(3, pays_out=True), how)]
    assert _held(press=2, cable=3, sense="wind_in")[1][0][1] == CableMove(3, pays_out=False)


@pytest.mark.parametrize(
    ("values", "part"),
    [
        ({}, "either a direction, or a cable and its sense"),
        ({"cable": 3}, "either"),
        ({"sense": "wind_in"}, "either"),
        ({"cable": 3, "sense": "wind_in", "direction": [0, 0, 1]}, "either"),
        ({"cable": 3, "sense": "wind_in", "frame": "world"}, "either"),
        ({"direction": [0, 0, 0]}, "direction is zero"),
        ({"cable": 0, "sense": "wind_in"}, "greater than"),
        ({"cable": 3, "sense": "in"}, "wind_in"),
        ({"cable": 3, "sense": "wind_in", "step_mm": 3.0}, "step_mm"),
        ({"cable": 9, "sense": "wind_in"}, "there is no cable 9"),
        ({"press": 13, "cable": 3, "sense": "wind_in"}, "press 13 is over"),
    ],
)
def test_a_held_control_that_moves_neither_is_refused(values, part):
    answer, said = _held(**{"press": 1, **values})
    assert answer["ok"] is False
    assert part in answer["what"]
    assert said == [] or values.get("press") == 13
