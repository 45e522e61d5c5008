"""The end of a run: first the verdict and exit code, then the files."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import executor.evaluation
import executor.recording.summary
import executor.runner
from executor.recording.run_folder import RunFolder
from executor.recording.table_files import Table
from executor.supervision import LocalRequests, OperatorRequests
from model.errors import BadInput
from tests.cli.plans import RIG
from tests.cli.program import Answer, call

ROOT = Path(__file__).parents[2]
#: How the run ends, with its verdict and exit code.
ENDS = {"goal": ("PASSED", 0), "stop": ("STOPPED", 130), "fault": ("FAILED", 1)}
MIDDLE_S = 1.5


@pytest.fixture
def run(
    request: pytest.FixtureRequest,
    short_plan: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[..., Answer]:
    """Runs in simulated time to one of `ENDS`."""

    def do(end: str, *more: str) -> Answer:
        if end == "stop":
            stopping(monkeypatch)
        if end == "fault":
            gone_in_the_middle(monkeypatch)
        return call(
            "run", short_plan, "--rig", RIG, "-o", tmp_path / "run", "--fast", "--no-camera", *more
        )

    return do


def stopping(monkeypatch: pytest.MonkeyPatch) -> None:
    """The operator requests a stop after a number of reads of the board."""
    looks = iter(range(10**6))
    monkeypatch.setattr(
        LocalRequests, "read", lambda _self: OperatorRequests(next(looks) > 150, False, 1.0)
    )


def gone_in_the_middle(monkeypatch: pytest.MonkeyPatch) -> None:
    """The run folder is removed while the platform moves."""
    append = RunFolder.append_cycles

    def removing(self: RunFolder, lines: str, *, fsync: bool) -> None:
        if float(lines.splitlines()[-1].split(",")[1]) > MIDDLE_S:
            shutil.rmtree(self.path, ignore_errors=True)
        append(self, lines, fsync=fsync)

    monkeypatch.setattr(RunFolder, "append_cycles", removing)


def assert_verdict(answer: Answer, end: str) -> None:
    """The verdict is the first word on standard output after the facts, with its exit code."""
    word, code = ENDS[end]
    assert answer.code == code, answer
    assert f"\n{word} " in answer.out, answer
    assert "nothing was" not in answer.said
    assert "Traceback" not in answer.said


@pytest.mark.parametrize("end", ["goal", "stop"])
def test_a_full_disk_at_the_end_changes_neither_verdict_nor_exit_code(
    run: Callable[..., Answer], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, end: str
) -> None:
    said_first: list[bool] = []

    def full(path: Path, _text: str) -> None:
        output: Any = sys.stdout
        said_first.append(f"\n{ENDS[end][0]} " in output.getvalue())
        raise BadInput("the file cannot be written", where=str(path), why="No space left on device")

    write = executor.runner.write_end

    def write_end(*arguments: object, **options: object) -> object:
        monkeypatch.setattr("executor.recording.run_folder.write_atomic", full)
        monkeypatch.setattr("executor.recording.table_files.write_atomic", full)
        monkeypatch.setattr("executor.report.write_atomic", full)
        monkeypatch.setattr("executor.recording.record_files.write_atomic", full)
        return write(*arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(executor.runner, "write_end", write_end)
    answer = run(end)
    assert_verdict(answer, end)
    assert said_first
    assert all(said_first)
    assert "No space left on device" in answer.err
    assert "cycles.csv" in answer.err
    assert "report:" not in answer.out
    monkeypatch.undo()
    # With free space again the report is made from the remaining files; the end was recorded.
    again = call("report", tmp_path / "run", "--json")
    assert again.code == 0, again
    summary = json.loads(again.out)
    assert summary["verdict"] == ENDS[end][0]
    assert summary["cycles"] == len(RunFolder.open(tmp_path / "run").cycles())


def test_a_run_folder_that_is_removed_meanwhile_is_a_fault_of_the_record_with_a_verdict(
    run: Callable[..., Answer], tmp_path: Path
) -> None:
    answer = run("fault")
    assert_verdict(answer, "fault")
    assert "recording failed" in answer.out
    assert "No such file or directory" in answer.err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("end", "error"),
    [("goal", MemoryError()), ("stop", ImportError("no module 'x'")), ("fault", MemoryError())],
)
def test_a_run_that_cannot_be_evaluated_has_a_verdict_that_reports_it(
    run: Callable[..., Answer], monkeypatch: pytest.MonkeyPatch, error: Exception, end: str
) -> None:
    def fails(*_: object) -> None:
        raise error

    monkeypatch.setattr(executor.evaluation, "summarize", fails)
    answer = run(end, "--json")
    assert answer.code == 1, answer
    summary = json.loads(answer.out)
    assert summary["verdict"] == "FAILED"
    assert f"could not be evaluated: {type(error).__name__}" in " ".join(summary["reasons"])
    assert summary["final_state"] == {"goal": "finished", "stop": "stopped"}.get(end, "latched")


def test_a_page_that_cannot_be_made_leaves_all_other_files(
    run: Callable[..., Answer], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_memory(_folder: RunFolder) -> Path:
        raise MemoryError

    monkeypatch.setattr(executor.evaluation, "build_report", no_memory)
    answer = run("goal")
    assert_verdict(answer, "goal")
    assert "report.html: MemoryError" in answer.err
    assert RunFolder.open(tmp_path / "run").summary()["verdict"] == "PASSED"


def test_what_the_end_needs_is_loaded_before_anything_moves(tmp_path: Path) -> None:
    """Once the platform has moved, a module may be missing, or memory for it."""
    code = f"""
import sys
sys.path.insert(0, {str(ROOT)!r})
from pathlib import Path
from executor.runner import _preload_results
from executor.recording.run_folder import RunFolder
from tests.executor import fake_run
run = fake_run.make(1.0, 50)
_preload_results()
before = set(sys.modules)
folder = fake_run.write(run, Path({str(tmp_path / "run")!r}))
from executor.report import build_report
build_report(folder)
ours = ("cdpr", "executor", "matplotlib", "mcap", "tracking", "planner", "scipy", "cv2")
print([name for name in set(sys.modules) - before if name.split(".")[0] in ours])
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.stdout.strip() == "[]", (result.stdout, result.stderr)


class Left(BaseException):
    """Represents the end of the process."""


@pytest.mark.parametrize("end", ENDS)
def test_ctrl_c_while_the_report_is_made_ends_with_the_verdict_of_the_run(
    run: Callable[..., Answer],
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    end: str,
) -> None:
    """Only answered before the verdict; then it leaves out the files; then it ends the program."""
    summarize = executor.recording.summary.summarize

    def pressed_before(*arguments: object) -> object:
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
        return summarize(*arguments)  # type: ignore[arg-type]

    write_table = RunFolder.write_table

    def pressed(folder: RunFolder, name: str, table: Table) -> None:
        if name == "poses.csv":
            os.kill(os.getpid(), signal.SIGINT)
        else:
            write_table(folder, name, table)

    monkeypatch.setattr(executor.evaluation, "summarize", pressed_before)
    monkeypatch.setattr(RunFolder, "write_table", pressed)
    answer = run(end)
    assert_verdict(answer, end)
    assert "fused.csv, run.mcap, report.html: interrupted" in answer.err
    said = capfd.readouterr().err
    assert said.count("is being evaluated, please wait for its verdict") == 2
    assert said.index("skipping the files") > said.rindex("its verdict")


def test_ctrl_c_again_leaves_at_once_with_the_exit_code_of_the_run(
    run: Callable[..., Answer], monkeypatch: pytest.MonkeyPatch
) -> None:
    codes: list[int] = []

    def left(code: int) -> None:
        codes.append(code)
        raise Left

    def pressed(_folder: RunFolder, name: str, _table: object) -> None:
        if name == "poses.csv":
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(os, "_exit", left)
    monkeypatch.setattr(RunFolder, "write_table", pressed)
    with pytest.raises(Left):
        run("stop")
    assert codes == [130]


def test_standard_output_that_is_full_leaves_the_verdict_on_the_other(
    run: Callable[..., Answer], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("cdpr.cli.operate.supervision.show_proposal", lambda *_, **__: None)
    monkeypatch.setattr("cdpr.cli.operate.run.out.print", full)
    answer = run("stop")
    assert answer.code == 130, answer
    assert "STOPPED " in answer.err
