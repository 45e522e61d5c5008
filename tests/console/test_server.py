"""The console's server: access, control, and refusal of everything else."""

from __future__ import annotations

import errno
import itertools
import json
import math
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from cdpr.cli.operate.run import show
from cdpr.console import server, session, view
from cdpr.console.commands import (
    AWAITED,
    MOST_WAITING,
    Held,
    LetGo,
    PlainCommand,
    Seen,
    parse_message,
)
from cdpr.console.server import MOST_PAGES, ConsoleServer, listening, web_server
from cdpr.console.session import LONGEST_WAIT, Console
from cdpr.console.state import MOST_IN_TRANSIT, StateFlow, StoredState, plans_and_scenes
from cdpr.console.verbs import (
    ConsoleFiles,
    VerbOutcome,
    _outcome,
    _without_commands,
    outcome_state,
)
from cdpr.console.view import RobotReport, preview
from cdpr.console.watch import RobotWatch, RunReport, RunWatch
from drivers.can_bus import BusSettings
from executor.cameras.sources import SYNTHETIC, choose_cameras
from executor.drives import is_simulated
from executor.interlock.fault_latch import FaultLatch
from executor.interlock.locks import SetUpLock
from executor.remote.client import motions_on, stop_runs
from executor.remote.command_server import commands_from_start
from executor.remote.command_server import serving as commands
from executor.remote.status import bus_name, identity
from executor.run_result import RunResult
from executor.state_machine import State
from executor.supervision import LocalRequests, Supervisor
from model.errors import BadInput, Refused
from model.plan import Plan, load_plan, save_plan
from model.pose import Pose
from model.rig import Rig, load_rig, rig_from_document
from model.scene import load_scene
from tests.cli.plans import GOAL_MM, RIG, START_MM, free_scene, straight_plan, write_short_plan
from tests.cli.program import call
from tests.console import fake_server
from tests.console.cut import acknowledgement, receive
from tests.console.sequences import arrived_now
from tests.executor.sockets import advertised


def wanted() -> None:
    """Of a verb that is still to be started."""


class Served:
    """A console of the paper's simulated rig, with its server."""

    def __init__(self, *, read_only: bool = False) -> None:
        rig = load_rig(RIG)
        files = ConsoleFiles(
            RIG, rig, (), (), (), RIG.parent / "environment_1.yaml", True, read_only
        )
        self.console = Console(files)
        self.said: list[tuple[str, dict[str, Any]]] = []
        self.started: list[tuple[str, list[str]]] = []
        self.console.watch.send = self._say  # type: ignore[method-assign]
        self.console.verbs.start = self._start  # type: ignore[method-assign]
        self.server = ConsoleServer(self.console)

    @contextmanager
    def something_moves(self) -> Iterator[None]:
        """A session of jogs is followed."""
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(RunWatch, "number", property(lambda _: 1))
            yield

    def _say(self, command: str, received: float | None = None, **values: Any) -> str:
        assert (received is None) == (command != "held")
        self.said.append((command, values))
        return ""

    def _start(self, verb: str, arguments: Any, require: Callable[[], None]) -> None:
        require()
        self.started.append((verb, list(arguments)))

    def get(self, path: str, *, token: bool = True, **headers: str) -> tuple[int, bytes, Any]:
        address = f"http://{self.host}{path}"
        if token:
            address += f"{'&' if '?' in path else '?'}token={self.server.token}"
        request = urllib.request.Request(address, headers=headers)
        try:
            with urllib.request.urlopen(request, timeout=10) as answer:
                return answer.status, answer.read(), answer.headers
        except urllib.error.HTTPError as error:
            return error.code, error.read(), error.headers

    def page(self, token: str | None = None, origin: str | None = "") -> ClientConnection:
        address = f"ws://{self.host}/ws?token={self.server.token if token is None else token}"
        return connect(address, origin=f"http://{self.host}" if origin == "" else origin)  # type: ignore[arg-type]

    host = ""


@contextmanager
def serving(served: Served) -> Iterator[Served]:
    server = web_server(served.server.app())
    with listening("127.0.0.1", 0) as listener:
        served.host = f"127.0.0.1:{listener.getsockname()[1]}"
        thread = threading.Thread(target=lambda: server.run(sockets=[listener]))
        thread.start()
        try:
            yield served
        finally:
            server.should_exit = True
            thread.join()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("console")
    write_short_plan(folder / "short.json")
    (folder / "secret.txt").write_text("secret")
    (folder / "runs" / "one").mkdir(parents=True)
    (folder / "runs" / "one" / "report.html").write_text("<p>a report")
    return folder


#: States in which no path is left to be held or resumed.
OVER = {State.STOPPING, State.SECURING, State.FINISHED, State.STOPPED, State.LATCHED}


class MovesOn:
    """A minimal `RunStatus` with only the bus of a run, its rig and its state."""

    def __init__(self, bus: str, rig: str, state: str = "moving") -> None:
        self._status = {"bus": bus, "rig": rig, "state": state}

    def as_dict(self) -> dict[str, Any]:
        return self._status


@pytest.fixture(autouse=True)
def own_announcements(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hides the runs of other tests."""
    for name in ("TMPDIR", "XDG_RUNTIME_DIR", "XDG_STATE_HOME"):
        monkeypatch.setenv(name, str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)


@pytest.fixture(autouse=True)
def slow_connections_count(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only where a test is about them: the others' reports name any state."""
    if "slow" not in request.node.name:
        monkeypatch.setattr(server, "BEHIND", math.inf)
        monkeypatch.setattr(server, "UNSEEN", math.inf)


@pytest.fixture
def served(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Served]:
    monkeypatch.chdir(folder)
    with serving(Served()) as served:
        yield served


def state(page: ClientConnection) -> dict[str, Any]:
    """The next state; skips answers."""
    while True:
        message = receive(page)
        if message["kind"] == "state":
            return message


def answer_to(page: ClientConnection, text: str) -> dict[str, Any]:
    """Sends a message and returns its answer."""
    page.send(text)
    while True:
        message = receive(page)
        if message["kind"] == "answer":
            return message


def command(page: ClientConnection, name: str, **values: Any) -> dict[str, Any]:
    return answer_to(page, json.dumps({"kind": "command", "id": 7, "command": name, **values}))


def said(served: Served, page: ClientConnection, names: list[str]) -> bool:
    """Waits for what is told to the run, and makes sure that nothing else follows soon."""
    while len(served.said) < len(names):
        state(page)
    for _ in range(2):
        state(page)
    found = [name for name, _ in served.said]
    assert found == names
    return True


def test_nothing_that_is_sent_waits_for_the_other_side() -> None:
    with listening("127.0.0.1", 0) as listener:
        assert listener.proto == socket.IPPROTO_TCP, "asyncio sets TCP_NODELAY by it"


def test_a_latch_is_shown_together_with_the_end_of_the_verb_that_left_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    console, latched = Served().console, StoredState("cable 4 is slack", False, None)
    monkeypatch.setattr(time, "monotonic", lambda: 1000.0)
    assert console.update()["latched"] is None
    verbs = console.verbs
    verbs.verb, verbs._process = "jog", subprocess.Popen(["sleep", "60"])
    verbs._output = os.memfd_create("output")
    with verbs._process as process:
        assert console.update()["busy"]["verb"] == "jog"
        process.kill()
    monkeypatch.setattr("cdpr.console.session.read_stored", lambda *_, **__: latched)
    state = console.update()
    assert (state["busy"], state["latched"]) == (None, "cable 4 is slack")
    console.close()


@pytest.mark.parametrize("state", State)
def test_hold_and_resume_are_refused_by_a_run_that_is_over(state: State) -> None:
    """Its process may still write the report, and would answer that the request was taken."""
    rig = load_rig(RIG)
    console = Console(ConsoleFiles(RIG, rig, (), (), (), None, True, False))
    run: Any = MovesOn(bus_name(rig), rig.name, state.value)
    with advertised() as listeners, commands(listeners, LocalRequests(), run):
        assert console.watch.update().status is not None
        for request, values in (("hold", {}), ("speed", {"percent": 50}), ("resume", {})):
            why_not = console.watch.send(request, **values)
            if state in OVER:
                assert f"`{request}` has no effect" in why_not
            else:
                assert why_not == ""
    console.close()


def test_a_file_whose_name_is_no_text_is_left_out_of_the_lists_and_named(
    served: Served, folder: Path
) -> None:
    bad = Path(os.fsdecode(os.fsencode(folder) + b"/bad\xff.json"))
    bad.write_text('{"kind": "cdpr-plan"')
    try:
        code, body, _ = served.get("/api/files")
    finally:
        bad.unlink()
    assert code == 200
    listed = json.loads(body)
    assert (listed["plans"], listed["left_out"]) == (["short.json"], ["bad\ufffd.json"])
    assert json.loads(served.get("/api/files")[1])["left_out"] == []


def test_every_plan_and_scene_that_can_be_loaded_is_listed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "compact.json").write_text('{"kind":"cdpr-plan"}')
    (tmp_path / "lab.yml").write_text("start: {}\ngoal: {}\n")
    (tmp_path / "goal-first.yaml").write_text("goal: {}\n")
    (tmp_path / "rig.yaml").write_text("name: a\n")
    found = plans_and_scenes()
    assert (found["plans"], found["scenes"]) == (["compact.json"], ["goal-first.yaml", "lab.yml"])


@pytest.mark.parametrize("name", ["%00", "one/%00", "x" * 5000, "one", "../secret.txt", "%ff"])
def test_a_file_of_a_run_that_cannot_be_is_not_found(served: Served, name: str) -> None:
    assert served.get(f"/runs/{name}")[0] == 404


@pytest.mark.parametrize(
    ("host", "shown"),
    [
        ("127.0.0.1", "127.0.0.1"),
        ("::1", "[::1]"),
        ("0.0.0.0", socket.gethostname()),
        ("::", socket.gethostname()),
        ("localhost", "localhost"),
    ],
)
def test_the_printed_address_can_be_opened(
    host: str, shown: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    printed: list[str] = []
    monkeypatch.setattr(server, "web_server", lambda _: SimpleNamespace(run=lambda **_: None))
    server.run_server(Served().console, host, 0, printed.append)
    (address,) = printed
    parts = urlsplit(address)
    assert address.startswith(f"http://{shown}:{parts.port}/?token=")
    assert parts.hostname == shown.strip("[]").lower()


@pytest.mark.parametrize(
    ("host", "where"),
    [("no-such-host.invalid", "--host"), ("192.0.2.1", "--host"), ("x" * 70, "--host"),
     ("2001:db8::1", "--host"), ("127.0.0.1", "--port")],
)  # fmt: skip
def test_an_address_that_cannot_be_used_names_the_option(host: str, where: str) -> None:
    with listening("127.0.0.1", 0) as taken:
        with pytest.raises(BadInput) as caught, listening(host, taken.getsockname()[1]):
            pass
        assert caught.value.where == where


def test_the_output_of_a_verb_needs_no_disk_and_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full disk is the cause of many failures: the page must show it."""
    console = Served().console
    del console.verbs.start
    before = sorted(tmp_path.iterdir())
    monkeypatch.setattr("tempfile.mkstemp", lambda **_: pytest.fail("a file is written"))
    console.verbs.start("run", ["no-such-plan.json"], wanted)
    process = console.verbs._process
    assert process is not None
    assert process.wait() == 2
    outcome = console.update()["outcome"]
    assert "no-such-plan.json" in outcome["text"]
    assert sorted(tmp_path.iterdir()) == before
    console.close()


@pytest.mark.parametrize(("code", "text"), [(1, ""), (4, " \n"), (-9, "")])
def test_a_verb_that_fails_without_a_message_states_its_exit_code(code: int, text: str) -> None:
    assert _outcome("home", code, text).text == (
        f"`cdpr home` ended with exit code {code} and no message."
    )
    assert _outcome("home", 0, "").text == ""
    assert _outcome("home", 1, "why").text == "why"


@pytest.mark.parametrize("cause", ["slack", "drive_fault", "late"])
def test_a_failed_run_links_the_help_page_of_its_cause(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], cause: str
) -> None:
    """What the verb prints is what the console reads; a reply lost before stops no run."""
    events = [{"code": code} for code in ("enabled", "reply_lost", cause, "not_held")]
    ended = {"verdict": "FAILED", "sentence": "the run failed", "reasons": [], "events": events}
    summary = {**ended, "passed": False, "final_state": "latched"}
    show(RunResult(tmp_path, summary), as_json=False)
    shown = outcome_state(_outcome("run", 1, capsys.readouterr().out))
    assert shown is not None
    assert shown["fault_page"] == f"/help/{cause}"


@pytest.mark.parametrize("verb", ["home", "release", "run", "jog"])
def test_stop_ends_a_verb_that_is_still_being_prepared(verb: str) -> None:
    """It reads files and drives for seconds before it can be asked to stop."""
    console = Served().console
    del console.verbs.start
    console.verbs.start(verb, ["--help"], wanted)
    process = console.verbs._process
    assert process is not None
    os.kill(process.pid, signal.SIGSTOP)  # however soon it would end
    assert console.stop() == ""
    os.kill(process.pid, signal.SIGCONT)
    process.wait()
    state = console.update()
    assert (state["busy"], state["outcome"]["stopped"]) == (None, True)
    assert "nothing was moved" in state["outcome"]["text"]
    assert console.stop() == "nothing moves"
    console.close()


@pytest.mark.parametrize("verb", ["home", "release", "run", "jog"])
@pytest.mark.parametrize("state", [None, "preparing"])
def test_a_verb_that_is_still_being_prepared_ends_with_the_console(
    verb: str, state: str | None
) -> None:
    console = Served().console
    del console.verbs.start
    console.watch.send = lambda *_, **__: "nothing moves"  # type: ignore[method-assign]
    console.verbs.start(verb, ["--help"], wanted)
    process = console.verbs._process
    assert process is not None
    os.kill(process.pid, signal.SIGSTOP)
    console.verbs.follow({"process": process.pid + 1, "state": "moving"})  # another's run
    if state is not None:
        console.verbs.follow({"process": process.pid, "state": state})
    console.close()
    os.kill(process.pid, signal.SIGCONT)
    assert process.wait() == -signal.SIGTERM


@pytest.mark.parametrize("name", ["jog_end", "service_end"])
def test_a_session_that_is_being_prepared_ends_when_its_end_is_asked_for(name: str) -> None:
    """Else its drives were enabled afterwards, in service mode those of single cables."""
    console, said = (served := Served()).console, served.said
    del console.verbs.start
    page = console.control.join("here")
    console.control.take(page, moving=False)
    console.control.set_service(page, name == "service_end")
    message = parse_message(json.dumps({"kind": "command", "command": name}))
    assert not isinstance(message, Held | LetGo | Seen)
    for is_under_way in (False, True):
        how = ["--one-cable"] if name == "service_end" else []
        console.verbs.start("jog", [*how, "--help"], wanted)
        process = console.verbs._process
        assert process is not None
        os.kill(process.pid, signal.SIGSTOP)
        if is_under_way:
            status = {"process": process.pid, "state": "moving", "cable_jog": {}}
            console.verbs.follow(status)
            console.watch.last = RunReport(status, 0.0)
        assert console.command(page, message, arrived_now()) == ""
        assert [word for word, _ in said if word == "end"] == ["end"] * is_under_way
        os.kill(process.pid, signal.SIGCONT)
        assert process.wait() == (0 if is_under_way else -signal.SIGTERM)
        console.verbs.update()
    console.close()


def test_leaving_service_mode_ends_no_session_of_the_platform(served: Served) -> None:
    console = served.console
    del console.verbs.start
    console.verbs.start("jog", ["--help"], wanted)
    assert console.verbs._process is not None
    assert console._service(on=False) == ""
    assert console.verbs._process.wait() == 0
    console.verbs.update()


def test_stop_leaves_what_moves_nothing_and_what_writes_its_report_alone() -> None:
    console = Served().console
    del console.verbs.start
    for verb, is_under_way in (("plan", False), ("reset", False), ("run", True)):
        console.verbs.start(verb, ["--help"], wanted)
        process = console.verbs._process
        assert process is not None
        if is_under_way:
            console.verbs.follow({"process": process.pid, "state": "moving"})
        assert console.stop() == "nothing moves"
        assert process.wait() == 0
        console.verbs.update()
    console.close()


def test_a_failure_of_the_computer_is_answered_and_later_commands_are_executed(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_args: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with served.page() as page:
        command(page, "take_control")
        monkeypatch.setattr(served.console.verbs, "start", full)
        refused = command(page, "jog_begin")
        assert (refused["ok"], "No space left" in refused["what"]) == (False, True)
        monkeypatch.setattr(served.console, "update", full)
        assert command(page, "give_control")["ok"]
        monkeypatch.undo()
        before = state(page)["seq"]
        while state(page)["seq"] <= before + 1:
            pass


def test_a_page_that_cannot_be_served_is_disconnected(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else it would show old data for ever; it connects again on its own."""

    def broken(_page: int) -> dict[str, object]:
        raise KeyError(_page)

    with served.page() as page:
        state(page)
        with monkeypatch.context() as patch:
            patch.setattr(served.console.control, "as_dict", broken)
            with pytest.raises(ConnectionClosed):
                list(page)
    with served.page() as page:
        state(page)


def test_messages_are_not_compressed(served: Served) -> None:
    with served.page() as page:
        assert page.protocol.extensions == []


REPORTS = itertools.count(1)


def held(hold: int, newest: int = 1) -> str:
    return json.dumps(
        {
            "kind": "held",
            "hold": hold,
            "direction": [0.0, 0.0, 1.0],
            "frame": "world",
            "step_mm": None,
            "speed_mm_s": 5.0,
            "seq": next(REPORTS),
            "state": newest,
        }
    )


def test_a_plan_that_was_made_here_is_loaded(served: Served) -> None:
    """The page promises it: no one has to look for the file."""
    planned = VerbOutcome("plan", 0, "", None, None)
    with served.page() as page:
        command(page, "take_control")
        for name in ("one", "two"):
            served.console.poses.teach(name, Pose.level([0.0, 0.02, 0.42 + 0.01 * len(name)]))
        served.console.verbs.outcome = planned
        Path("console/taught.plan.json").write_bytes(Path("short.json").read_bytes())
        assert command(page, "plan")["ok"]
        while not (state(page)["preview"] or "").startswith("console/taught.plan.json "):
            pass
        served.console.verbs.outcome = replace(planned, exit_code=3)
        assert command(page, "plan", pose="two")["ok"]
        while state(page)["preview"] is not None:
            pass
        assert [state(page)["preview"] for _ in range(5)] == [None] * 5, "it was not made"
        Path("console/taught.plan.json").write_text("{}")
        served.console.verbs.outcome = planned
        assert command(page, "plan", pose="two")["ok"]
        while state(page)["outcome"]["ok"]:
            pass
        assert "taught.plan.json" in state(page)["outcome"]["text"], "it cannot be read"
    scene = load_scene(Path("console/taught.yaml"))
    assert scene.start.distance_to(served.console.rig.home) < 1e-9
    for name in ("one", "two"):
        served.console.poses.forget(name)


def test_a_scene_is_planned_in_a_folder_in_which_nothing_was_taught(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And a plan that is loaded stays, unless another one is being made."""
    monkeypatch.chdir(tmp_path)
    scene = RIG.parent / "environment_1.yaml"
    Path("scene.yaml").write_bytes(scene.read_bytes())
    Path("short.json").write_bytes((folder / "short.json").read_bytes())
    served = Served()
    console = served.console
    console.plan.load(Path("short.json"))
    page = console.control.join("here")
    console.control.take(page, moving=False)
    text = '{"kind": "command", "command": "plan", "scene": "scene.yaml"}'
    message = parse_message(text)
    assert not isinstance(message, Held | LetGo | Seen)

    def is_busy(*_: object) -> None:
        raise Refused("`cdpr plan` is still running")

    with monkeypatch.context() as patch:
        patch.setattr(console.verbs, "start", is_busy)
        assert "still running" in console.command(page, message, arrived_now())
    assert console.plan.preview is not None
    assert console.command(page, message, arrived_now()) == ""
    ((verb, arguments),) = served.started
    assert verb == "plan"
    assert Path(arguments[arguments.index("-o") + 1]).parent.is_dir(), "`cdpr plan` makes none"
    assert console.plan.preview is None
    console.close()


def test_a_platform_that_is_only_rotated_is_not_said_to_be_0_mm_from_the_start(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    served = Served()
    console = served.console
    console.plan.load(Path("short.json"))
    start, shown = console.plan.start, console.plan.preview
    assert start is not None
    assert shown is not None
    page = console.control.join("here")
    console.control.take(page, moving=False)
    tilted = Pose.from_quaternion(start.position, [math.cos(0.05), math.sin(0.05), 0.0, 0.0])
    monkeypatch.setattr(console.robot, "pose_at_rest", lambda: tilted)
    text = json.dumps({"kind": "command", "command": "run", "plan": shown["hash"]})
    message = parse_message(text)
    assert not isinstance(message, Held | LetGo | Seen)
    why_not = console.command(page, message, arrived_now())
    assert f"0.0 mm and {math.degrees(start.angle_to(tilted)):.1f}° from" in why_not
    assert served.started == []
    console.close()


@pytest.mark.parametrize("code", [0, 130])
def test_simulated_drives_are_at_home_after_homing(
    monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    """They lose power for it, so that their counts fit no pose meanwhile."""
    console = Served().console
    moving: Any = {"folder": "", "drives": [{"tension_n": 0.0, "torque": "none"}]}
    console.verbs.verb = "home"
    monkeypatch.setattr(console.verbs, "update", lambda: "")
    assert console.update()["platform"] is not None
    console.robot.update(moving, is_busy=True)
    assert console.update()["platform"] is None
    console.verbs.verb = None
    console.verbs.outcome = _outcome("home", code, "text")
    console.update()
    home = console.update()["platform"]
    if code:
        assert home is None, "one that was stopped in its preparation found nothing"
    else:
        assert home["position_mm"] == pytest.approx(1e3 * console.rig.home.position, abs=0.01)
    console.close()


def test_simulated_drives_continue_where_the_platform_was_seen(served: Served) -> None:
    served.console.begin_with(Path("short.json"))
    start = load_plan(Path("short.json")).waypoints[0]
    with served.page() as page:
        command(page, "take_control")
        seen = state(page)
        assert seen["plan_start_off_mm"] == 0.0
        assert seen["platform"]["position_mm"] == pytest.approx(1e3 * start.position, abs=0.01)
        assert command(page, "jog_begin")["ok"]
    ((_, arguments),) = served.started
    at = arguments.index("--simulated-start-mm")
    assert [float(v) for v in arguments[at + 1 : at + 4]] == pytest.approx(1e3 * start.position)
    assert arguments[at + 4] == "--simulated-start-wxyz"


def test_the_output_of_a_verb_names_no_commands_for_a_terminal() -> None:
    said = "plan p.json\n  length  3 mm\n"
    todo = "  next    cdpr check p.json, then cdpr run\nnext: cdpr home\n"
    assert _without_commands(said + todo) == said
    assert _without_commands("next: find the cause\n") == "next: find the cause\n"


def test_stop_waits_for_no_other_command_of_any_page(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, slow = threading.Event(), threading.Event()

    def load_slowly(_path: Path) -> None:
        begun.set()
        slow.wait(60)

    monkeypatch.setattr(served.console.plan, "load", load_slowly)
    with ExitStack() as stack:
        stack.callback(slow.set)
        pages = [stack.enter_context(served.page()) for _ in range(MOST_PAGES)]
        me = pages[0]
        assert command(me, "take_control")["ok"]
        load = {"kind": "command", "id": 1, "command": "load_plan", "file": "short.json"}
        me.send(json.dumps(load))
        assert begun.wait(60)
        for page in pages[1:]:  # without control they do not wait
            assert answer_to(page, json.dumps(load))["what"] == "take control first"
        for page in (me, pages[-1]):
            answer = command(page, "stop")
            assert (answer["to"], answer["what"]) == (7, "nothing moves")
        for _ in range(2 * MOST_WAITING):
            me.send(json.dumps(load))
        assert "not finished yet" in command(me, "home")["what"]


@contextmanager
def loading(
    served: Served, page: ClientConnection, monkeypatch: pytest.MonkeyPatch
) -> Iterator[threading.Event]:
    """A plan is being loaded by a page with control, until the event is set."""
    begun, go_on = threading.Event(), threading.Event()

    def check_slowly(path: Path, plan: Plan, rig: Rig) -> dict[str, Any]:
        begun.set()
        go_on.wait(60)
        return preview(path, plan, rig)

    monkeypatch.setattr(view, "preview", check_slowly)
    assert command(page, "take_control")["ok"]
    load = {"kind": "command", "id": 1, "command": "load_plan", "file": "short.json"}
    page.send(json.dumps(load))
    assert begun.wait(60)
    try:
        yield go_on
    finally:
        go_on.set()


def test_a_run_is_held_resumed_and_slowed_down_while_a_plan_is_being_loaded(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run may be that of a terminal; a long plan is checked for minutes."""
    with served.page() as page, loading(served, page, monkeypatch):
        for name, values in (("hold", {}), ("resume", {}), ("speed", {"percent": 30})):
            assert command(page, name, **values)["ok"]
            assert served.said[-1] == (name, values)
        assert state(page)["busy"] == {"verb": "load", "text": "short.json"}


@pytest.mark.parametrize("name", ["home", "release", "jog_begin", "run", "reset", "plan"])
def test_a_command_that_waited_too_long_is_not_begun(
    served: Served, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its page has reported that it got no answer: no one expects a motion any more."""
    values = {"run": {"plan": "hash"}, "reset": {"cause": None}, "plan": {"scene": "s.yaml"}}
    clock = time.clock_gettime
    with served.page() as page, loading(served, page, monkeypatch) as go_on:
        asked = {"kind": "command", "id": 2, "command": name, **values.get(name, {})}
        page.send(json.dumps(asked))
        assert command(page, "hold")["ok"], "by then the command has arrived"
        monkeypatch.setattr(time, "clock_gettime", lambda which: clock(which) + LONGEST_WAIT)
        go_on.set()
        while (answer := receive(page)).get("to") != 2:
            pass
        assert (answer["ok"], "was not begun" in answer["what"]) == (False, True)
        assert served.started == []
        assert state(page)["busy"] is None
        assert command(page, "home")["ok"]
        assert [verb for verb, _ in served.started] == ["home"]


def test_a_run_may_read_its_drives_longer_than_a_command_may_wait(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A serial adapter opens in 2 s, and a silent drive takes a second: no run ever began."""
    monkeypatch.chdir(folder)
    served = Served()
    console, clock = served.console, time.clock_gettime
    page = console.control.join("here")
    console.control.take(page, moving=False)
    console.plan.load(Path("short.json"))
    shown = console.plan.preview
    assert shown is not None

    def read_slowly() -> None:
        monkeypatch.setattr(time, "clock_gettime", lambda which: clock(which) + 10.0 * LONGEST_WAIT)

    monkeypatch.setattr(console.robot, "pose_at_rest", read_slowly)
    message = parse_message(
        json.dumps({"kind": "command", "command": "run", "plan": shown["hash"]})
    )
    assert not isinstance(message, Held | LetGo | Seen)
    assert console.command(page, message, arrived_now()) == ""
    assert [verb for verb, _ in served.started] == ["run"]
    console.close()


def test_a_page_awaits_the_answers_of_the_commands_that_may_begin_late() -> None:
    script = (Path(server.__file__).parent / "static" / "connection.js").read_text()
    awaited = re.search(r"^const LONG = (\[.*\]);$", script, re.MULTILINE)
    assert awaited is not None
    assert set(json.loads(awaited[1])) == AWAITED


def test_a_command_does_not_wait_long_for_one_of_another_thread(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Such as the loading of a plan that was made here, or a reading of the drives."""
    monkeypatch.setattr(session, "LONGEST_WAIT", 0.01)
    served = Served()
    page = served.console.control.join("test")
    served.console.control.take(page, moving=False)
    home = PlainCommand(kind="command", command="home")
    held, go_on = threading.Event(), threading.Event()

    def work() -> None:
        with served.console._one_at_a_time:
            held.set()
            go_on.wait(60)

    other = threading.Thread(target=work)
    other.start()
    assert held.wait(60)
    answer = served.console.command(page, home, arrived_now())
    go_on.set()
    other.join()
    assert (answer, served.started) == ("another command is not finished yet", [])
    served.console.close()


@pytest.mark.parametrize(
    ("name", "stopped_by"),
    [
        *((name, "a page") for name in ("home", "release", "jog_begin", "run", "reset", "plan")),
        ("home", "another terminal"),
    ],
)
def test_a_stop_cancels_commands_that_wait_for_another_one(
    served: Served, name: str, stopped_by: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, slow = threading.Event(), threading.Event()
    load = served.console.plan.load

    def load_slowly(path: Path) -> None:
        begun.set()
        slow.wait(60)
        load(path)

    monkeypatch.setattr(served.console.plan, "load", load_slowly)
    values = {"run": {"plan": "hash"}, "reset": {"cause": None}, "plan": {"scene": "s.yaml"}}
    with served.page() as page, served.page() as other:
        assert command(page, "take_control")["ok"]
        asked = [("load_plan", {"file": "short.json"}), (name, values.get(name, {}))]
        for number, (asks, with_values) in enumerate(asked, 1):
            word = {"kind": "command", "id": number, "command": asks, **with_values}
            page.send(json.dumps(word))
        assert begun.wait(60)
        page.send(json.dumps({"kind": "seen", "seq": 0, "at_ms": 0.0}) + "nonsense")
        while receive(page)["kind"] != "answer":  # by then the commands have arrived
            pass
        if stopped_by == "a page":
            assert command(other, "stop")["to"] == 7
        else:
            stop_runs()
        slow.set()
        while (answer := receive(page)).get("to") != 2:
            pass
        assert (answer["ok"], "STOP was pressed" in answer["what"]) == (False, True)
        assert served.started == []
        assert command(page, "home")["ok"], "who asks after the stop is heard"
        assert [verb for verb, _ in served.started] == ["home"]


@pytest.mark.parametrize("end", ["stop", "leave", "give", "taken", "none"])
def test_a_run_that_waits_for_its_drives_begins_only_if_it_is_still_wanted(
    folder: Path, end: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever happens between the check of who has control and the start."""
    monkeypatch.chdir(folder)
    served = Served()
    console = served.console
    page, other = console.control.join("here"), console.control.join("there")
    console.plan.load(Path("short.json"))
    shown = console.plan.preview
    assert shown is not None

    def asked(name: str, by: int = page, **values: object) -> str:
        message = parse_message(json.dumps({"kind": "command", "command": name, **values}))
        assert not isinstance(message, Held | LetGo | Seen)
        return console.command(by, message, arrived_now())

    ends: dict[str, Callable[[], object]] = {
        "stop": console.stop,
        "leave": lambda: console.leave(page),
        "give": lambda: asked("give_control"),
        "taken": lambda: asked(
            "take_control", other, force=True, held_by=console.control.holder_name()
        ),
        "none": lambda: None,
    }
    assert asked("take_control") == ""

    def read_drives() -> None:
        ends[end]()

    monkeypatch.setattr(console.robot, "pose_at_rest", read_drives)
    why_not = asked("run", plan=shown["hash"])
    if end == "none":
        assert (why_not, len(served.started)) == ("", 1)
    else:
        assert "before this command began" in why_not
        assert served.started == []
    console.close()


@pytest.mark.parametrize("bus", ["virtual", "socketcan"])
@pytest.mark.parametrize("lacks", [{}, {"cameras": []}, {"tags": None}])
def test_a_run_without_a_camera_to_use_is_started_without_one(
    bus: str, lacks: dict[str, Any]
) -> None:
    """`cdpr run` refused every plan of a rig from `cdpr new`, and no button adds the option."""
    rig = rig_from_document(load_rig(RIG).document.model_copy(update=lacks)).with_bus(bus, "can0")
    files = ConsoleFiles(RIG, rig, (), (), (), None, True, False)
    renders = bus == "virtual" and not lacks
    without = "--no-camera" in files.run_arguments("plan.json", "a hash")
    assert without != renders
    cameras = choose_cameras(rig, [], without, is_simulated(rig))
    assert cameras == (dict.fromkeys(rig.cameras, SYNTHETIC) if renders else {})


@pytest.mark.parametrize("change", ["edit", "remove", "calibrate", "touch"])
def test_no_verb_is_started_for_another_robot_than_the_page_shows(
    tmp_path: Path, change: str
) -> None:
    """After an edit of the rig file homing succeeded, and the page said "Not homed" for ever."""
    rig, result = tmp_path / "rig.yaml", tmp_path / "result.yaml"
    rig.write_bytes(RIG.read_bytes())
    result.write_text("the result")
    calibration = ("--calibration", str(result))
    console = Console(ConsoleFiles(rig, load_rig(RIG), (), calibration, (), None, True, False))
    page = console.control.join("here")
    console.control.take(page, moving=False)
    changes: dict[str, Callable[[], object]] = {
        "edit": lambda: rig.write_text(rig.read_text().replace("gachon_8_6", "another")),
        "remove": rig.unlink,
        "calibrate": lambda: result.write_text("another"),
        "touch": rig.touch,
    }
    changes[change]()
    started: list[str] = []
    console.verbs._start = lambda verb, _: started.append(verb)  # type: ignore[method-assign]
    why_not = console.command(page, PlainCommand(kind="command", command="home"), arrived_now())
    if change == "touch":
        assert (why_not, started) == ("", ["home"])
    else:
        name = result if change == "calibrate" else rig
        assert started == []
        assert f"{name} changed since the console began" in why_not
        assert "restart the console" in why_not
    console.close()


def test_a_stop_finds_each_verb_either_started_or_refused() -> None:
    """It waits for a start that has passed the check, and ends what was started."""
    console = Served().console
    del console.verbs.start
    stopping, stopped = threading.Event(), threading.Event()

    def stop() -> None:
        stopping.set()
        console.stop()
        stopped.set()

    stop_now = threading.Thread(target=stop)

    def stop_meanwhile() -> None:
        stop_now.start()
        assert stopping.wait(60)
        assert not stopped.is_set()

    console.verbs.start("run", ["no-such-plan.json"], stop_meanwhile)
    process = console.verbs._process
    assert process is not None
    stop_now.join()
    assert process.wait() == -signal.SIGTERM
    console.close()


def test_no_verb_is_started_while_a_run_may_move_the_robot() -> None:
    served = Served()
    console = served.console
    page = console.control.join("test")

    def asked(name: str) -> str:
        shown = {"cause": None} if name == "reset" else {}
        message = parse_message(json.dumps({"kind": "command", "command": name, **shown}))
        assert not isinstance(message, Held | LetGo)
        return console.command(page, message, arrived_now())

    assert asked("take_control") == ""
    with advertised() as listeners:
        silent = f"process {os.getpid()} moves a robot and does not answer; wait, or stop it"
        assert [asked("reset"), asked("service_begin")] == [silent] * 2
        state = console.update()
        assert state["motion"] is None
        here: Any = MovesOn(state["bus"], state["rig"])
        with commands(listeners, LocalRequests(), here):
            moves = "the robot moves; wait, or stop it"
            assert [asked("reset"), asked("service_begin")] == [moves] * 2
    assert served.started == []
    console.watch.close()
    others: list[Any] = [MovesOn("can can7", state["rig"]), MovesOn(state["bus"], "another")]
    for elsewhere in others:  # drives simulated by another robot's run are on no common bus
        with advertised() as listeners, commands(listeners, LocalRequests(), elsewhere):
            assert [asked("service_begin"), asked("service_end"), asked("reset")] == [""] * 3
    assert [verb for verb, _ in served.started] == ["reset"] * 2
    console.close()


@pytest.mark.parametrize("kind", ["udp_multicast", "slcan"])
def test_a_motion_is_found_however_its_rig_file_spells_the_bus(tmp_path: Path, kind: str) -> None:
    (tmp_path / "ttyACM0").touch()
    (tmp_path / "by-id").symlink_to(tmp_path / "ttyACM0")
    names = {
        "udp_multicast": ("239.74.163.67", "239.74.163.67:43113"),
        "slcan": (str(tmp_path / "by-id"), str(tmp_path / "ttyACM0")),
    }
    here, there = (load_rig(RIG).with_bus(kind, name) for name in names[kind])
    watch = RunWatch(here)
    if kind == "slcan":  # plugged in again, it got another number
        (tmp_path / "ttyACM0").rename(tmp_path / "ttyACM1")
        (tmp_path / "by-id").unlink()
        (tmp_path / "by-id").symlink_to(tmp_path / "ttyACM1")
        there = here.with_bus(kind, str(tmp_path / "ttyACM1"))
    with commands_from_start("run", there, Supervisor(), realtime=False) as ahead:
        assert motions_on(bus_name(here)) == {os.getpid(): "preparing"}
        assert watch.why_busy() == "a motion is being prepared; wait, or stop it"
        moving: Any = SimpleNamespace(as_dict=lambda: {**identity(there, None), "state": "moving"})
        with ahead.during_motion(moving):
            assert watch.update().status is not None
            assert watch.why_busy() == "the robot moves; wait, or stop it"
    watch.close()


def test_a_motion_prepared_elsewhere_is_shown_and_gives_way_to_a_run() -> None:
    console = Served().console
    watch, rig = console.watch, console.rig
    prepared = "a motion is being prepared; wait, or stop it"
    with commands_from_start("run", rig, Supervisor(), realtime=False) as ahead:
        motion = console.update()["motion"]
        assert (motion["state"], motion["verb"], motion["process"]) == (
            "preparing",
            "run",
            os.getpid(),
        )
        assert (watch.number, watch.why_busy()) == (0, prepared), "no press begins"
        assert "takes only a stop" in RunWatch.send(watch, "hold")
        moving: Any = MovesOn(motion["bus"], motion["rig"])
        with ahead.during_motion(moving):
            console.watch.update()
            assert watch.number > 0
            assert watch.why_busy() == "the robot moves; wait, or stop it"
        watch.update()
        assert (watch.number, watch.last.status) == (0, None)
    console.close()


def test_a_run_is_followed_rather_than_a_motion_in_preparation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Such as one that waits at its question while another terminal moves the robot."""
    monkeypatch.setattr("cdpr.console.watch.SEARCH_PERIOD", 0.0)
    console = Served().console
    with commands_from_start("run", console.rig, Supervisor(), realtime=False):
        motion = console.update()["motion"]
        code = RUN_ELSEWHERE.format(bus=motion["bus"], rig=motion["rig"])
        command, pipe = [sys.executable, "-c", code], subprocess.PIPE
        with subprocess.Popen(
            command, stdin=pipe, stdout=pipe, cwd=Path(__file__).parents[2]
        ) as run:
            assert run.stdout is not None
            run.stdout.readline()
            console.watch.update()
            assert console.watch.last.status == {"bus": motion["bus"], "rig": motion["rig"]}
            run.communicate()
    console.close()


RUN_ELSEWHERE = """
from types import SimpleNamespace
from executor.remote.command_server import serving
from tests.executor.sockets import advertised
from executor.supervision import LocalRequests, Supervisor
status = SimpleNamespace(as_dict=lambda: {{"bus": {bus!r}, "rig": {rig!r}}})
with advertised() as listeners, serving(listeners, LocalRequests(), status):
    print("advertised", flush=True)
    input()
"""


def test_one_page_of_all_consoles_of_a_robot_has_control(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cdpr.console.session.read_status", lambda _: pytest.fail("read"))
    rig = load_rig(RIG).with_bus("udp_multicast", "239.74.9.13")
    first, second = Served().console.files, Served().console.files
    one, other = Console(replace(first, rig=rig)), Console(replace(second, rig=rig))
    mine, theirs = one.control.join("here"), other.control.join("there")

    def asked(console: Console, page: int, name: str) -> str:
        shown = {"cause": None} if name == "reset" else {}
        message = parse_message(json.dumps({"kind": "command", "command": name, **shown}))
        assert not isinstance(message, Held | LetGo)
        return console.command(page, message, arrived_now())

    assert asked(one, mine, "take_control") == ""
    name = f"page {mine} on here (console {os.getpid()} of "
    assert asked(other, theirs, "take_control").startswith(name)
    assert asked(other, theirs, "reset") == "take control first"
    other.update()
    assert (other.control.holder_name() or "").startswith(name)
    one.leave(mine)
    one.update()
    assert asked(other, theirs, "take_control") == ""
    for console in (one, other):
        console.close()


def test_a_wall_clock_that_is_set_back_ends_no_press_of_another_console(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As NTP does: the buttons of the other console did nothing until it had caught up."""
    wall = iter([1_800_000_000_000_000_000, 1_799_999_998_000_000_000])
    monkeypatch.setattr(time, "time_ns", lambda: next(wall))
    numbers = list[int]()
    for console in (Served().console, Served().console):
        page = console.control.join("host")
        console.control.take(page, moving=False)
        press = console.control.hold(page, 1, 1, 1)
        assert press is not None
        numbers.append(press)
    assert numbers == sorted(numbers)


def test_a_console_begins_without_its_serial_adapter_and_gives_control_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whose state files, and so the lock of control, are filed under the adapter."""
    monkeypatch.setattr("cdpr.console.session.read_status", lambda _: pytest.fail("read"))
    monkeypatch.setattr(RobotWatch, "update", lambda *_, **__: None)
    device = tmp_path / "ttyACM0"
    rig = load_rig(RIG).with_bus("slcan", str(device))
    console = Console(replace(Served().console.files, rig=rig))
    page = console.control.join("here")
    take = parse_message('{"kind": "command", "command": "take_control"}')
    assert not isinstance(take, Held | LetGo | Seen)
    assert console.update()["reference"]["why_not"] == f"there is no serial adapter {device}"
    assert f"there is no serial adapter {device}" in console.command(page, take, arrived_now())
    assert console.control.holder is None
    device.touch()
    assert console.command(page, take, arrived_now()) == ""
    device.unlink()
    console.update()
    assert console.control.holder == page
    console.close()


def latching_console(monkeypatch: pytest.MonkeyPatch, channel: str) -> tuple[Console, FaultLatch]:
    """A console on a bus between programs whose drives it must not read, and that bus's latch."""
    monkeypatch.setattr("cdpr.console.session.read_status", lambda _: pytest.fail("read"))
    monkeypatch.setattr(RobotWatch, "update", lambda *_, **__: None)
    rig = load_rig(RIG).with_bus("udp_multicast", channel)
    console = Console(replace(Served().console.files, rig=rig))
    return console, FaultLatch(BusSettings.of(rig))


def require_only_latched(console: Console, words: str) -> None:
    """Requires that a fault with these words is shown, no motion, and that STOP finds none."""
    console._stored_for = float("-inf"), None
    state = console.update()
    assert words in state["latched"]
    assert state["moved_by"] is None
    assert console.stop() == NONE_FOUND


def test_a_motion_of_another_user_is_no_fault_and_stop_says_that_it_goes_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    console, latch = latching_console(monkeypatch, "239.74.9.14")

    def kill(process: int, number: int) -> None:
        assert number == 0
        if process == HIDDEN:
            raise PermissionError

    monkeypatch.setattr(os, "kill", kill)
    for process, moved_by in ((HIDDEN, HIDDEN), (os.getpid(), None)):
        with monkeypatch.context() as patch:
            patch.setattr(os, "getpid", lambda process=process: process)
            latch.engage(console.rig.name, Path("runs/theirs"))
        console._stored_for = float("-inf"), None
        state = console.update()
        assert (state["latched"], state["moved_by"]) == (None, moved_by)
        answer = console.stop()
        if moved_by is None:
            assert answer == NONE_FOUND, "a run of this user takes the stop itself"
        else:
            assert f"process {HIDDEN}, is not stopped from here" in answer
            assert "press the emergency stop" in answer
        latch.let_go()  # as if it was killed
        require_only_latched(console, "was killed")
        latch.disengage()
    console.close()


#: Of another user.
HIDDEN = 2**30
NONE_FOUND = "no motion of this user was found: press the emergency stop if the robot moves"


def test_a_stop_that_finds_no_motion_claims_nothing_about_a_robot_on_a_bus(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without a shared state folder another user's run is unknown: it said that nothing moves."""
    console, _ = latching_console(monkeypatch, "239.74.9.16")
    assert console.stop() == NONE_FOUND
    words = "another program sends set-points to drive 1"
    console.robot.now = RobotReport(None, None, why_not=words, in_use=True)
    answer = console.stop()
    assert words in answer
    assert "press the emergency stop" in answer
    console.close()


def test_stop_names_a_program_that_sets_up_the_drives_unless_it_is_this_console(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Another user's run engages the latch only after that."""
    console, _ = latching_console(monkeypatch, "239.74.9.17")
    lock = SetUpLock(BusSettings.of(console.rig))
    with lock.held():
        answer = console.stop()
        assert "another program sets up or reads the drives" in answer
        assert "press the emergency stop" in answer
        with ThreadPoolExecutor(1) as pool, console._one_at_a_time:  # as during a reading
            assert pool.submit(console.stop).result() == NONE_FOUND
        for verb, is_named in (("plan", True), ("reset", False), ("run", False)):
            console.verbs.verb = verb
            assert (console.stop() == answer) == is_named
        console.verbs.verb = None
    assert console.stop() == NONE_FOUND
    console.close()


def test_a_reset_of_this_user_is_no_motion_of_another(monkeypatch: pytest.MonkeyPatch) -> None:
    """It holds the latch of a run whose process has ended."""
    console, latch = latching_console(monkeypatch, "239.74.9.15")
    with monkeypatch.context() as patch:
        patch.setattr(os, "getpid", lambda: 2**30)  # of no process
        latch.engage(console.rig.name, Path("runs/mine"))
    latch.let_go()
    shown = latch.read()
    assert shown is not None
    latch.hold_engaged(shown)
    require_only_latched(console, "did not finish")
    latch.let_go()
    latch.disengage()
    console.close()


@pytest.mark.parametrize("path", ["/", "/scene", "/api/files", "/runs/one/report.html"])
def test_nothing_is_sent_without_the_token(served: Served, path: str) -> None:
    assert served.get(path, token=False)[0] == 403
    assert served.get(f"{path}?token=wrong", token=False)[0] == 403
    assert served.get(path)[0] == 200


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://127.0.0.1:1"])
def test_another_origin_gets_nothing(served: Served, origin: str) -> None:
    assert served.get("/scene", Origin=origin)[0] == 403
    with pytest.raises(InvalidStatus):
        served.page(origin=origin)


def test_a_socket_needs_token_and_origin(served: Served) -> None:
    for token, origin in (("wrong", ""), ("", ""), (None, None)):
        with pytest.raises((InvalidStatus, ConnectionClosed)):
            served.page(token, origin).recv(timeout=10)
    with served.page() as page:
        assert state(page)["rig"] == "gachon_8_6"


def test_the_page_loads_nothing_from_elsewhere(served: Served) -> None:
    status, body, headers = served.get("/")
    assert status == 200
    policy = headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert b"http://" not in body.replace(b"http://www.w3.org", b"")
    assert b"https://" not in body
    assert headers["Cache-Control"] == "no-store"


def test_every_file_that_the_page_names_is_there(served: Served) -> None:
    body = served.get("/")[1].decode()
    names = [part.split('"')[0] for part in body.split('"/static/')[1:]]
    assert len(names) >= 4
    for name in (*names, "vendor/three/three.module.min.js"):  # the last by scene.js
        status, _, headers = served.get(f"/static/{name}", token=False)
        assert status == 200, name
        assert headers["X-Content-Type-Options"] == "nosniff"


@pytest.mark.parametrize(
    "path",
    [
        "/static/../server.py",
        "/static/%2e%2e/server.py",
        "/static//etc/passwd",
        "/static/vendor",
        "/runs/../secret.txt",
        "/runs/%2e%2e/secret.txt",
        "/runs/one",
        "/help/../secret",
        "/help/no_such_code",
        "/nothing",
    ],
)
def test_no_other_file_is_given(served: Served, path: str) -> None:
    status, body, _ = served.get(path)
    assert status == 404
    assert b"secret" not in body
    assert b"root:" not in body


def test_help_is_given_by_code(served: Served) -> None:
    status, body, _ = served.get("/help/drive_silent")
    assert status == 200
    assert b"# " in body


def test_the_fake_server_sends_what_this_one_sends(served: Served) -> None:
    """What the page's own tests rest on; a key that one has and the other lacks is found here."""
    with served.page() as page:
        real = state(page)
    fake = fake_server.Fake().state(None)  # type: ignore[arg-type]
    assert set(real) == set(fake)


def test_no_fault_is_reset_but_the_one_that_was_shown(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    served = Served()
    console, latched = served.console, StoredState("cable 4 is slack", False, None)
    monkeypatch.setattr("cdpr.console.session.read_stored", lambda *_, **__: latched)
    page = console.control.join("here")

    def asked(name: str, **values: object) -> str:
        message = parse_message(json.dumps({"kind": "command", "command": name, **values}))
        assert not isinstance(message, Held | LetGo)
        return console.command(page, message, arrived_now())

    assert asked("take_control") == ""
    for shown in ("drive 3: over-current", None):
        assert "another fault" in asked("reset", cause=shown)
    assert served.started == []
    assert asked("reset", cause="cable 4 is slack") == ""
    assert [verb for verb, _ in served.started] == ["reset"]
    console.close()


def test_one_page_at_a_time_operates(served: Served) -> None:
    with served.page() as first, served.page() as second:
        assert "take control" in command(first, "home")["what"]
        assert command(first, "take_control")["ok"]
        refused = command(second, "take_control")
        assert not refused["ok"]
        assert "127.0.0.1" in refused["what"]
        assert state(second)["control"]["yours"] is False
        assert not command(second, "home")["ok"]
        assert command(first, "home")["ok"]
        assert [verb for verb, _ in served.started] == ["home"]
        late = command(second, "take_control", force=True, held_by="page 9 on elsewhere")
        assert "taken control" in late["what"]
        holder = state(second)["control"]["held_by"]
        assert command(second, "take_control", force=True, held_by=holder)["ok"]
        assert not command(first, "home")["ok"]
        assert command(second, "give_control")["ok"]


def test_control_ends_with_its_page(served: Served) -> None:
    with served.page() as first:
        assert command(first, "take_control")["ok"]
    with served.page() as second:
        while state(second)["control"]["held_by"] is not None:
            pass
        assert command(second, "take_control")["ok"]


def test_everybody_may_stop(served: Served) -> None:
    with served.page() as first, served.page() as second:
        command(first, "take_control")
        for page in (first, second):
            assert command(page, "stop")["what"] == "nothing moves"
    request = urllib.request.Request(f"http://{served.host}/stop", method="POST")
    with urllib.request.urlopen(request, timeout=10) as answer:
        assert json.load(answer) == {"ok": False, "what": "nothing moves"}
    request.add_header("Origin", "http://evil.example")
    with pytest.raises(urllib.error.HTTPError):
        urllib.request.urlopen(request, timeout=10)


def test_a_held_control_is_passed_on_for_who_has_control_only(served: Served) -> None:
    with served.something_moves(), served.page() as first, served.page() as second:
        command(first, "take_control")
        second.send(held(1))
        command(second, "stop")
        again = held(3)
        for number, report in enumerate((again, held(3)), 1):
            first.send(report)
            assert said(served, first, ["held"] * number)
        first.send(again)
        first.send(held(2))
        first.send(json.dumps({"kind": "let_go", "hold": 3}))
        first.send(held(3))
        assert said(served, first, ["held", "held", "let_go"]), "what was let go is over"
        one, other = (values["press"] for name, values in served.said if name == "held")
        assert one == other
        assert served.said[-1] == ("let_go", {"press": one})


def test_release_and_stop_wait_for_no_report_of_a_press(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run may take long to answer: else reports would queue, and prolong what was let go."""
    answers, heard = threading.Event(), served._say

    def say(command: str, received: float | None = None, **values: Any) -> str:
        heard(command, received, **values)
        return "" if command != "held" or answers.wait(60) else "silent"

    monkeypatch.setattr(served.console.watch, "send", say)
    with ExitStack() as stack:
        stack.callback(answers.set)
        stack.enter_context(served.something_moves())
        page = stack.enter_context(served.page())
        command(page, "take_control")
        for _ in range(100):
            page.send(held(1))
        page.send(json.dumps({"kind": "let_go", "hold": 1}))
        assert command(page, "stop")["what"] == "nothing moves"
        assert said(served, page, ["held", "let_go"])
        answers.set()
        page.send(held(2))
        assert said(served, page, ["held", "let_go", "held"])
        assert served.said[0][1]["press"] < served.said[2][1]["press"]


def held_cable(hold: int, **changes: object) -> str:
    word = {"kind": "held", "hold": hold, "cable": 3, "sense": "wind_in", "step_mm": None}
    return json.dumps(word | {"speed_mm_s": 5.0, "seq": next(REPORTS), "state": 1} | changes)


def test_a_press_over_a_slow_connection_is_ended_and_the_page_is_told(served: Served) -> None:
    """What arrives is old, however regularly it arrives: the newest state that it names tells."""
    with served.something_moves(), served.page() as page, served.page() as other:
        command(page, "take_control")
        old = state(page)["seq"]
        while state(other)["seq"] < old + 10:  # half a second
            pass
        page.send(held(1, newest=old))
        while (answer := receive(page))["kind"] != "answer":
            newest = answer["seq"]
        assert "too slow to jog" in answer["what"]
        assert served.said == []
        reached = state(other)["seq"]
        while (newest := state(page)["seq"]) < reached:
            pass
        page.send(held(2, newest=newest))
        assert said(served, page, ["held"])
        page.send(held(2, newest=old))
        assert said(served, page, ["held", "let_go"])
        page.send(held(3, newest=newest + 10**6))
        assert said(served, page, ["held", "let_go", "let_go"]), "no state of this server"


@given(
    made=st.lists(st.floats(0.0, 0.3), min_size=3, max_size=40),
    there=st.lists(st.floats(0.0, 2.0), min_size=40, max_size=40),
    back=st.lists(st.floats(0.0, 2.0), min_size=40, max_size=40),
    ahead=st.floats(0.0, 1e6),
)
@example([0.05] * 40, [0.001] * 40, [0.001] * 40, 0.0)
@example([0.05] * 40, [1.0] * 40, [1.0] * 40, 5.0)
def test_a_page_is_never_shown_a_state_as_younger_than_it_is(
    made: list[float], there: list[float], back: list[float], ahead: float
) -> None:
    """However slow the connection is in either direction, and whatever the page's clock shows."""
    flow, now, ahead_ms = StateFlow(), 0.0, -math.inf
    on_the_way: list[tuple[float, int, float, Any]] = []  # arrival, number, when made, its echo
    acknowledged: list[tuple[float, Seen]] = []
    for seq, period in enumerate(made, start=1):
        now += period
        for at, message in sorted(acknowledged, key=lambda one: one[0]):
            if at <= now:
                flow.take(message, at)
        acknowledged = [one for one in acknowledged if one[0] > now]
        if flow._has_room.is_set():
            flow.send(seq)
            on_the_way.append((now + there[seq - 1], seq, now, flow.echo))
        assert len(flow._sent) <= MOST_IN_TRANSIT
        for arrival, number, begin, echo in [one for one in on_the_way if one[0] <= now]:
            if echo is not None:
                ahead_ms = max(ahead_ms, echo["at_ms"] - echo["received_ms"])
                shown = arrival + ahead - begin - ahead_ms / 1e3
                assert shown >= arrival - begin - 1e-3
                assert shown <= max(there) + max(back) + 1e-3, "the way there and back, at most"
            at_ms = 1e3 * (arrival + ahead)
            acknowledged.append(
                (arrival + back[number - 1], Seen(kind="seen", seq=number, at_ms=at_ms))
            )
        on_the_way = [one for one in on_the_way if one[0] > now]


def test_over_a_slow_connection_the_newest_state_is_sent_and_no_queue_builds_up(
    served: Served,
) -> None:
    with served.page() as page, served.page() as other:
        first = [json.loads(page.recv(timeout=30)) for _ in range(MOST_IN_TRANSIT)]
        assert [one["echo"] for one in first] == [None] * MOST_IN_TRANSIT
        while state(other)["seq"] < first[-1]["seq"] + 5:
            pass
        page.send(acknowledgement(first[-1], at_ms=7.0))
        newest = json.loads(page.recv(timeout=30))
        assert newest["seq"] >= first[-1]["seq"] + 5, "those in between were left out"
        assert newest["echo"]["at_ms"] == 7.0


def test_a_page_that_acknowledges_nothing_loses_its_connection(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as one that a frozen browser holds open; its control is free then."""
    monkeypatch.setattr(server, "UNSEEN", 0.01)
    with served.page() as page, pytest.raises(ConnectionClosed):
        list(page)


def test_a_cable_is_moved_by_a_page_in_service_mode_only(served: Served) -> None:
    with served.page() as page:
        command(page, "take_control")
        assert state(page)["control"]["mode"] == "operate"
        assert "service mode" in command(page, "cable_begin")["what"]
        assert command(page, "service_begin")["ok"]
        assert state(page)["control"]["mode"] == "service"
        assert command(page, "cable_begin")["ok"]
        ((verb, arguments),) = served.started
        assert verb == "jog"
        assert {"--hold-to-run", "--one-cable", "--yes"} <= set(arguments)
        with served.something_moves():
            page.send(held_cable(1))
            assert said(served, page, ["held"])
            ((_, values),) = served.said
            assert (values["cable"], values["sense"], values["step_mm"]) == (3, "wind_in", None)
            assert "direction" not in values
            assert command(page, "service_end")["ok"]
            assert served.said[-1] == ("let_go", {"press": values["press"]})
            page.send(held_cable(1))
            page.send(held_cable(2))
            command(page, "service_begin")
            page.send(held_cable(2))
            page.send(held_cable(3))
            assert said(served, page, ["held", "let_go", "let_go", "held"])
            assert served.said[-1][1]["press"] > values["press"] + 1, "the second was over at once"


def test_service_mode_ends_with_control(served: Served) -> None:
    with served.page() as first, served.page() as second:
        command(first, "take_control")
        command(first, "service_begin")
        assert not command(second, "service_begin")["ok"]
        holder = state(second)["control"]["held_by"]
        assert command(second, "take_control", force=True, held_by=holder)["ok"]
        assert "service mode" in command(second, "cable_begin")["what"]
        command(second, "service_begin")
        command(second, "give_control")
        command(second, "take_control")
        assert "service mode" in command(second, "cable_begin")["what"]
    assert served.started == []


@pytest.mark.parametrize(
    "changes",
    [
        {"cable": 0},
        {"cable": -1},
        {"cable": 1.5},
        {"cable": None},
        {"cable": 256},
        {"sense": "out"},
        {"sense": None},
        {"frame": "world"},
        {"direction": [0.0, 0.0, 1.0]},
        {"step_mm": 2.0},
    ],
)
def test_what_names_no_cable_and_sense_moves_nothing(
    served: Served, changes: dict[str, object]
) -> None:
    with served.something_moves(), served.page() as page:
        command(page, "take_control")
        command(page, "service_begin")
        assert answer_to(page, held_cable(1, **changes))["ok"] is False
        assert served.said == []


def test_what_a_page_held_ends_when_the_page_is_gone(served: Served) -> None:
    with served.something_moves(), served.page() as first:
        command(first, "take_control")
        first.send(held(1))
        assert said(served, first, ["held"])
    with served.page() as second:
        while state(second)["control"]["held_by"] is not None:
            pass
    assert [name for name, _ in served.said] == ["held", "let_go"]


def test_a_press_without_a_session_is_over_before_there_is_one(served: Served) -> None:
    with served.page() as first:
        command(first, "take_control")
        first.send(held(1))
        assert command(first, "stop")
        with served.something_moves():
            first.send(held(1))
            first.send(held(2))
            assert said(served, first, ["held"])


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:8402", "[::1", "127.0.0.1.evil.example", "a b"]
)
def test_another_name_gets_nothing(served: Served, host: str) -> None:
    """Of a site that lets its own name point here: its pages would be of one origin with us."""
    for origin in ({}, {"Origin": f"http://{host}"}):
        assert served.get("/scene", Host=host, **origin)[0] in (400, 403)
        assert served.get("/static/main.js", Host=host, **origin)[0] in (400, 403)


@pytest.mark.parametrize("host", ["localhost:9", "127.0.0.1", "[::1]:8402", "192.168.7.2:1"])
def test_this_machine_s_names_and_addresses_are_ours(served: Served, host: str) -> None:
    """As a tunnel, or another computer where that is allowed, has them."""
    assert served.get("/scene", Host=host)[0] == 200


def test_no_more_pages_than_can_be_served_are_open(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cdpr.console.server.MOST_PAGES", 2)
    with served.page() as first, served.page() as second:
        state(first), state(second)
        with pytest.raises((InvalidStatus, ConnectionClosed)):
            served.page().recv(timeout=10)
    while True:  # until the server has noticed that they are gone
        with suppress(InvalidStatus, ConnectionClosed), served.page() as again:
            state(again)
            return


def test_nothing_runs_that_was_not_seen_to_pass(served: Served) -> None:
    with served.page() as page:
        command(page, "take_control")
        assert "passes" in command(page, "run", plan="")["what"]
        assert not command(page, "load_plan", file="../elsewhere.json")["ok"]
        assert not command(page, "load_plan", file="secret.txt")["ok"]
        assert command(page, "load_plan", file="short.json")["ok"]
        shown = json.loads(served.get("/api/preview")[1])
        # The next state may have been made before.
        assert f"short.json {shown['hash']}" in (state(page)["preview"] for _ in range(3))
        assert shown["passed"]
        assert len(shown["moments"]) == len(shown["curves"]["time_s"])
        assert "a different plan" in command(page, "run", plan="of another tab")["what"]
        assert not served.started
        assert command(page, "run", plan=shown["hash"])["ok"]
        verb, arguments = served.started[-1]
        assert (verb, arguments[0]) == ("run", "short.json")
        assert "--yes" in arguments
        assert "--plan-hash" in arguments


def test_a_plan_that_was_replaced_after_it_was_shown_does_not_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    console = Served().console
    plan = write_short_plan(tmp_path / "plan.json")
    console.plan.load(Path("plan.json"))
    shown = console.plan.preview
    assert shown is not None
    scene = free_scene(START_MM, [GOAL_MM[0], GOAL_MM[1], GOAL_MM[2] - 10.0])
    save_plan(straight_plan(load_rig(RIG), scene, [START_MM, scene.goal.position * 1e3]), plan)
    answer = call("run", plan, "--fast", "--no-camera", "--plan-hash", shown["hash"])
    assert answer.code == 2
    assert "replaced after it was shown" in answer.err
    console.plan.load(Path("plan.json"))
    shown = console.plan.preview
    assert shown is not None
    answer = call("run", plan, "--fast", "--no-camera", "--plan-hash", shown["hash"])
    assert answer.code == 0, answer
    console.close()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_closed_terminal_ends_the_console_as_any_end_does(
    tmp_path: Path, number: signal.Signals
) -> None:
    said = tmp_path / "ended"
    program = (
        "import sys; from pathlib import Path; from cdpr.cli import main;"
        " from cdpr.console.session import Console; end = Console.close;"
        f" Console.close = lambda self: (end(self), Path({str(said)!r}).touch());"
        f" sys.argv = ['cdpr', 'console', {str(RIG)!r}, '--port', '0']; main()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], cwd=tmp_path, stdout=subprocess.PIPE, text=True
    ) as console:
        assert console.stdout is not None
        address = console.stdout.readline().partition("http://")[2].strip()
        with urllib.request.urlopen(f"http://{address}", timeout=60) as page:
            assert page.status == 200
        console.send_signal(number)
        console.wait()
    assert said.exists()


SMALL = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**60), 2**60) | st.floats() | st.text(max_size=20),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.sampled_from(
                ["kind", "command", "id", "hold", "direction", "seq", "file", "percent"]
            ),
            inner,
            max_size=6,
        )
    ),
    max_leaves=8,
)


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(said=SMALL)
def test_nonsense_is_refused_and_nothing_starts(served: Served, said: Any) -> None:
    with served.page() as page:
        answer = answer_to(page, json.dumps(said))
        assert not answer["ok"]
        assert answer["what"]
    assert not served.started
    assert not served.said


def test_a_message_that_is_too_long_ends_the_socket_alone(served: Served) -> None:
    with served.page() as long, served.page() as other:
        long.send("x" * 100_000)
        with pytest.raises(ConnectionClosed):
            list(long)
        assert state(other)["kind"] == "state"


def test_a_console_that_only_shows_does_nothing_but_stop(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    with serving(Served(read_only=True)) as served, served.page() as page:
        assert state(page)["read_only"]
        for name in ("take_control", "home", "jog_begin", "hold", "release"):
            assert "read-only" in command(page, name)["what"]
        assert "read-only" in command(page, "run", plan="")["what"]
        assert "read-only" in command(page, "reset", cause=None)["what"]
        assert command(page, "stop")["what"] == "nothing moves"
        assert not served.started
        assert not served.said
