"""A script runs a robot with one call, without the command line."""

from __future__ import annotations

import asyncio
import hashlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from multiprocessing import current_process
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from executor import jogging, runner
from executor.cameras.multi_camera import CameraNews, CameraRecords, RunCameras
from executor.homing import home
from executor.interlock.interlock import MotionInterlock
from executor.proposals import Proposal
from executor.recording import tables
from executor.recording.run_folder import RunEvent, RunFolder
from executor.run_result import load_run
from model.errors import BadInput, StoppedByOperator
from model.plan import Plan, load_plan
from model.progress import Advance, Listener
from model.rig import Rig, load_rig
from tests.cli.plans import RIG

ROOT = Path(__file__).parents[2]


@pytest.fixture
def rig() -> Rig:
    return load_rig(RIG)


@pytest.fixture
def plan(short_plan: Path) -> Plan:
    return load_plan(short_plan)


def test_a_run_whose_record_could_not_be_read_does_not_begin(
    plan: Plan, rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Proposal] = []
    monkeypatch.setattr(tables, "TABLE_LIMIT", 100_000)
    with pytest.raises(BadInput, match="split the plan") as caught:
        runner.run(
            *(plan, rig),
            folder=tmp_path / "run",
            cameras=(),
            realtime=False,
            confirm=lambda proposal: bool(asked.append(proposal)),
        )
    assert "MB are read" in caught.value.what
    assert not asked
    assert not (tmp_path / "run").exists()


def test_a_run_gives_its_verdict_its_tables_and_its_events(
    plan: Plan, rig: Rig, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    events: list[RunEvent] = []
    result = runner.run(
        plan, rig, folder=tmp_path / "run", cameras=(), realtime=False, on_event=events.append
    )
    assert (result.verdict, result.passed, result.exit_code) == ("PASSED", True, 0)
    assert result.report == tmp_path / "run" / "report.html"
    assert not result.missing
    assert len(result.cycles["time_s"]) == result.summary["cycles"]
    assert np.all(np.diff(result.cycles["time_s"]) > 0.0)
    assert {len(column) for column in result.cycles.values()} == {result.summary["cycles"]}
    assert len(result.poses["frame"]) == 0
    assert events == RunFolder.open(tmp_path / "run").events()
    assert capfd.readouterr() == ("", "")


def test_a_no_before_the_motion_leaves_nothing(plan: Plan, rig: Rig, tmp_path: Path) -> None:
    asked: list[str] = []

    def refuse(proposal: Proposal) -> bool:
        asked.append(proposal.question)
        return False

    with pytest.raises(StoppedByOperator, match="nothing was moved"):
        runner.run(plan, rig, folder=tmp_path / "run", cameras=(), realtime=False, confirm=refuse)
    assert asked == ["Move the platform now?"]
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("realtime", "coroutine"), [(False, False), (True, False), (False, True), (True, True)]
)
def test_ctrl_c_in_a_script_ends_in_a_coordinated_stop_that_is_on_record(
    plan: Plan, slow_rig: Path, tmp_path: Path, realtime: bool, coroutine: bool
) -> None:
    def press(event: RunEvent) -> None:
        if event.code == "moving":
            os.kill(os.getpid(), signal.SIGINT)

    def move() -> None:
        runner.run(
            plan, rig, folder=tmp_path / "run", cameras=(), realtime=realtime, on_event=press
        )

    async def main() -> None:
        move()

    rig = load_rig(slow_rig)
    with pytest.raises(KeyboardInterrupt):
        asyncio.run(main()) if coroutine else move()
    folder = RunFolder.open(tmp_path / "run")
    assert folder.summary()["verdict"] == "STOPPED"
    assert folder.report.is_file()
    MotionInterlock(rig).require_free()


@pytest.mark.parametrize("code", ["enabled", "moving"])
@pytest.mark.parametrize("error", [SystemExit(3), TimeoutError("too long")])
def test_what_another_signal_handler_raises_stops_the_run_and_keeps_its_record(
    plan: Plan, slow_rig: Path, tmp_path: Path, error: BaseException, code: str
) -> None:
    """Also one that `except Exception` would catch, and where a second signal follows."""

    def leave(number: int, _frame: object) -> None:
        raise error if number == signal.SIGALRM else KeyboardInterrupt

    def press(event: RunEvent) -> None:
        main = threading.main_thread().ident or 0
        if event.code == code:
            signal.pthread_kill(main, signal.SIGALRM)
        elif event.code == "stop":
            signal.pthread_kill(main, signal.SIGTERM)

    rig, run = load_rig(slow_rig), tmp_path / "run"
    before = {n: signal.signal(n, leave) for n in (signal.SIGALRM, signal.SIGTERM)}
    try:
        with pytest.raises(type(error)) as caught:
            runner.run(plan, rig, folder=run, cameras=(), realtime=False, on_event=press)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert caught.value is error
    folder = RunFolder.open(run)
    assert folder.summary()["verdict"] == "STOPPED"
    assert folder.report.is_file()
    for line in (run / "SHA256SUMS").read_text().splitlines():
        digest, name = line.split()
        assert hashlib.sha256((run / name).read_bytes()).hexdigest() == digest
    MotionInterlock(rig).require_free()


@pytest.mark.parametrize("code", ["enabled", "moving", "held"])
def test_an_exception_of_a_callback_fails_the_run_and_is_named(
    plan: Plan, rig: Rig, tmp_path: Path, code: str
) -> None:
    """At any event, the last one included, after which nothing is left to stop."""

    def fail(event: RunEvent) -> None:
        if event.code == code:
            raise ValueError("boom")

    result = runner.run(
        plan, rig, folder=tmp_path / "run", cameras=(), realtime=False, on_event=fail
    )
    assert any("on_event raised ValueError: boom" in line for line in result.details())
    assert "recording failed" not in " ".join(result.details())
    assert result.verdict == "FAILED"
    assert result.report.is_file()


@pytest.mark.parametrize(
    ("error", "code", "realtime"),
    [
        (KeyboardInterrupt, "enabled", False),
        (KeyboardInterrupt, "moving", False),
        (SystemExit, "enabled", False),
        (SystemExit, "moving", True),
    ],
)
def test_leaving_the_program_in_a_callback_stops_the_run_and_keeps_its_record(
    plan: Plan,
    slow_rig: Path,
    tmp_path: Path,
    error: type[BaseException],
    code: str,
    realtime: bool,
) -> None:
    def leave(event: RunEvent) -> None:
        if event.code == code:
            raise error(7)

    rig = load_rig(slow_rig)
    with pytest.raises(error, match="7"):
        runner.run(
            plan, rig, folder=tmp_path / "run", cameras=(), realtime=realtime, on_event=leave
        )
    folder = RunFolder.open(tmp_path / "run")
    assert folder.summary()["verdict"] == "STOPPED"
    assert folder.report.is_file()
    MotionInterlock(rig).require_free()


class FailingListener(Listener):
    def note(self, text: str) -> None:
        raise RuntimeError(text)

    def progress(self, text: str, total: float | None) -> AbstractContextManager[Advance]:
        def fail(value: float, note: str = "", text: str = "") -> None:
            raise RuntimeError("no terminal")

        return nullcontext(fail)


def test_a_failing_listener_is_named_too(plan: Plan, rig: Rig, tmp_path: Path) -> None:
    result = runner.run(
        *(plan, rig),
        folder=tmp_path / "run",
        cameras=(),
        realtime=False,
        listener=FailingListener(),
    )
    assert result.verdict == "FAILED"
    text = " ".join(result.details())
    assert "listener.progress raised RuntimeError: no terminal" in text
    assert "recording failed" not in text


#: Reports after the platform has moved, and whether they come before the verdict.
LATE_REPORTS = {
    "end of preparing, row": True,
    "waiting for the last images": True,
    "remark": True,
    "evaluating the run": True,
    "end of evaluating the run": False,
    "writing the run folder and report": False,
    "end of writing the run folder and report": False,
}


class LateFailingListener(Listener):
    """Raises at one of `LATE_REPORTS`."""

    def __init__(self, at: str, error: BaseException) -> None:
        self.at, self.error, self.warnings = at, error, list[str]()

    def fail_at(self, report: str) -> None:
        if report == self.at:
            raise self.error

    def remark(self, text: str) -> None:
        self.fail_at("remark" if "images" in text else "")

    def warning(self, text: str) -> None:
        self.warnings.append(text)

    @contextmanager
    def waiting(self, text: str) -> Iterator[None]:
        self.fail_at(text)
        yield
        self.fail_at(f"end of {text}")

    @contextmanager
    def progress(self, text: str, total: float | None) -> Iterator[Advance]:
        yield lambda value, note="", text="": None
        self.fail_at(f"end of {text}")


@pytest.mark.parametrize(("report", "before_verdict"), LATE_REPORTS.items())
def test_a_listener_that_fails_after_the_motion_loses_no_result(
    plan: Plan, rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, report: str,
    before_verdict: bool,
) -> None:  # fmt: skip
    """Verdict, measurements and files; it had left the folder without a summary."""
    finish = RunCameras.finish

    def finish_with_news(self: RunCameras, stopped: Callable[[], bool]) -> CameraRecords:
        self._news.append(CameraNews("remark", "images were late"))
        return finish(self, stopped)

    monkeypatch.setattr(RunCameras, "finish", finish_with_news)
    listener = LateFailingListener(report, RuntimeError("no terminal"))
    folder, images = tmp_path / "run", "images" in report or report == "remark"
    result = runner.run(
        *(plan, rig),
        folder=folder,
        cameras=None if images else (),
        realtime=False,
        listener=listener,
    )
    assert result.verdict == ("FAILED" if before_verdict else "PASSED")
    said = result.details() if before_verdict else listener.warnings
    assert sum("listener" in text and "raised RuntimeError: no ter" in text for text in said) == 1
    assert not result.missing
    assert load_run(folder).verdict == result.verdict
    assert np.isfinite(result.poses["x_mm"]).any() == images


def test_leaving_the_program_in_a_late_report_keeps_the_record(
    plan: Plan, rig: Rig, tmp_path: Path
) -> None:
    for k, report in enumerate(("evaluating the run", "writing the run folder and report")):
        listener = LateFailingListener(report, SystemExit(7))
        folder = tmp_path / str(k)
        with pytest.raises(SystemExit, match="7"):
            runner.run(plan, rig, folder=folder, cameras=(), realtime=False, listener=listener)
        assert load_run(folder).passed


@pytest.mark.parametrize("name", ["confirm", "on_event"])
def test_a_callback_that_cannot_be_called_is_refused_before_anything_else(
    plan: Plan, rig: Rig, tmp_path: Path, name: str
) -> None:
    arguments: dict[str, Any] = {name: 3}
    with pytest.raises(BadInput, match=f"{name} must be a function"):
        runner.run(plan, rig, folder=tmp_path / "run", realtime=False, **arguments)
    with pytest.raises(BadInput, match=f"{name} must be a function"):
        jogging.jog(rig, None, to_home=True, folder=tmp_path / "run", realtime=False, **arguments)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("answer", ["no", "yes", 1, None, np.array([True])])
def test_only_true_moves(plan: Plan, rig: Rig, tmp_path: Path, answer: Any) -> None:
    with pytest.raises(BadInput, match="confirm must return True or False"):
        runner.run(
            *(plan, rig),
            folder=tmp_path / "run",
            cameras=(),
            realtime=False,
            confirm=lambda _: answer,
        )
    assert not (tmp_path / "run").exists()


def test_a_daemonic_process_is_refused_only_where_a_run_needs_another(
    plan: Plan, rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a worker of `multiprocessing.Pool`; it had been an AssertionError of Python."""
    monkeypatch.setitem(current_process()._config, "daemon", True)  # type: ignore[attr-defined]
    folder = tmp_path / "run"
    for realtime, use in ((True, "drives in real time"), (False, "cameras")):
        with pytest.raises(BadInput, match=f"cannot start others, for {use}") as caught:
            runner.run(plan, rig, folder=folder, realtime=realtime)
        assert "ProcessPoolExecutor" in caught.value.next_step
        assert not folder.exists()
    assert runner.run(plan, rig, folder=folder, cameras=(), realtime=False).passed


def test_runs_that_begin_in_one_second_have_a_default_folder_each(
    plan: Plan, rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The name is chosen at the end of the preparation: another run may have taken it meanwhile."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(runner, "dated_name", lambda: "now")

    def meanwhile(_proposal: Proposal) -> bool:
        RunFolder.create(Path("runs/now"))
        create = RunFolder.create.__func__  # type: ignore[attr-defined]

        def create_late(kind: type[RunFolder], path: Path) -> RunFolder:
            if path.name == "now-2" and not path.exists():
                create(kind, path)
            return create(kind, path)  # type: ignore[no-any-return]

        monkeypatch.setattr(RunFolder, "create", classmethod(create_late))
        return True

    result = runner.run(plan, rig, cameras=(), realtime=False, confirm=meanwhile)
    assert result.folder == tmp_path / "runs/now-3"
    assert result.passed
    with pytest.raises(BadInput, match="exists already"):
        runner.run(plan, rig, folder="runs/now", cameras=(), realtime=False)


def test_limits_of_the_verbs_are_those_of_the_library(rig: Rig) -> None:
    with pytest.raises(BadInput, match="speed"):
        home(rig, at_home=True, realtime=False, speed=0.011)
    with pytest.raises(BadInput, match="reach"):
        home(rig, at_home=True, realtime=False, reach=0.201)
    with pytest.raises(BadInput, match="speed"):
        jogging.jog(rig, None, by=np.array([0.0, 0.0, 0.01]), speed=0.021, realtime=False)
    with pytest.raises(BadInput, match="no cable 0"):
        jogging.jog_cable(rig, 0, 0.001, realtime=False)


#: Each child makes the call for which it was started; `CALL` names it.
UNGUARDED = """
import os, sys
import cdpr
def confirm(_proposal):
    print("asked")
    return True
plan, rig = cdpr.load_plan({plan!r}), cdpr.load_rig({rig!r})
calls = {{
    "run": lambda: cdpr.run(plan, rig, cameras=(), confirm=confirm),
    "run with cameras": lambda: cdpr.run(plan, rig, confirm=confirm),
    "home": lambda: cdpr.home(rig, at_home=True, confirm=confirm),
    "jog": lambda: cdpr.jog(rig, None, by=[0, 0, 0.005], confirm=confirm),
}}
for name in [os.environ["CALL"]] if "CALL" in os.environ else {names!r}:
    os.environ["CALL"] = name
    try:
        calls[name]()
    except cdpr.CdprError as error:
        print("PARENT", error, "END", sep="\\n", file=sys.stderr, flush=True)
"""


@pytest.mark.parametrize(
    ("names", "in_file"), [(("run", "run with cameras", "home", "jog"), True), (("run",), False)]
)
def test_a_script_without_the_guard_asks_once_and_is_named_as_the_cause(
    short_plan: Path, tmp_path: Path, names: tuple[str, ...], in_file: bool
) -> None:
    """Its child imports it again; a script from standard input cannot be imported at all."""
    text = UNGUARDED.format(plan=str(short_plan), rig=str(RIG), names=names)
    (tmp_path / "script.py").write_text(text)
    (tmp_path / "empty").mkdir()
    done = subprocess.run(
        [sys.executable, tmp_path / "script.py" if in_file else "-"],
        input=text, cwd=tmp_path / "empty", capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    *parts, rest = done.stderr.split("END\n")
    for name, part in zip(names, parts, strict=True):
        before, _, of_parent = part.partition("PARENT\n")
        of_camera = name == "run with cameras"
        assert ("the process of camera" if of_camera else "the real-time process") in of_parent
        assert "ended before it was ready (exit code 1)" in of_parent
        assert 'if __name__ == "__main__"' in of_parent
        assert "killed" not in of_parent
        assert ("nothing moved" in of_parent) != of_camera
        assert ("does not run it again" in before) == in_file
    assert rest == ""
    assert done.stdout.split() == ["asked"] * len(names)
    assert done.returncode == 0
    assert not [file for file in (tmp_path / "empty").rglob("*") if file.is_file()]
