"""Valid files, but unusable positions, drives, cameras and folders."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import signal
import socket
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

import can
import pytest
import yaml

from drivers.can_bus import BusSettings, open_bus
from drivers.can_errors import ControllerState
from drivers.cia402 import sdo
from executor.cameras import process as camera_process
from executor.cameras.process import CameraProcess
from executor.recording.run_folder import RunFolder
from model.errors import Fault
from model.plan import save_plan
from model.rig import load_rig
from model.scene import load_scene
from simulation.drives.cia402_rig import SimulatedCia402Rig
from tests.cli.plans import CONFIGS, GOAL_MM, RIG, START_MM, straight_plan
from tests.cli.program import Answer, call, nothing_written, one_message
from tests.drivers.drive_bench import free_udp_channel

SCENE = CONFIGS / "environment_1.yaml"
ROOT = Path(__file__).parents[2]
#: Drops CAP_DAC_OVERRIDE, with which root writes into read-only folders, and becomes the command.
WITHOUT_PRIVILEGE = """
import ctypes, os, sys
PR_CAPBSET_DROP, CAP_DAC_OVERRIDE = 24, 1
ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, CAP_DAC_OVERRIDE, 0, 0, 0)
os.execv(sys.argv[1], sys.argv[1:])
"""


def refused(folder: Path, code: int, *parts: str, **options: object) -> Answer:
    """A run with these options ends with one message; no run folder is left."""
    arguments: list[str] = []
    for name, value in options.items():
        option = f"--{name.replace('_', '-')}"
        values = value if isinstance(value, tuple) else (value,)
        arguments += [option] if value is True else [option, *map(str, values)]
    with nothing_written(folder):
        answer = call("run", folder / "plan.json", "-o", folder / "run", *arguments)
    one_message(answer, code, *parts)
    return answer


@pytest.fixture
def folder(tmp_path: Path, short_plan: Path) -> Path:
    """A folder with the plan in it."""
    shutil.copy(short_plan, tmp_path / "plan.json")
    return tmp_path


# Where the platform should go.


@pytest.mark.parametrize(
    ("option", "position", "parts"),
    [
        ("--start-mm", "-150 0 300", ["start", "obstacle_1", "mm"]),
        ("--goal-mm", "-150 -100 300", ["goal", "obstacle_1", "mm"]),
        ("--goal-mm", "0 0 900", ["goal", "workspace", "650"]),
        ("--start-mm", "0 0 100", ["start", "workspace", "150"]),
    ],
)
def test_an_unusable_start_or_goal_is_reported_with_reason_and_amount(
    tmp_path: Path, option: str, position: str, parts: list[str]
) -> None:
    with nothing_written(tmp_path):
        answer = call("plan", RIG, SCENE, "-o", tmp_path / "plan.json", option, *position.split())
    one_message(answer, 2, *parts)


def test_a_goal_that_is_not_reached_reports_the_closest_distance(tmp_path: Path) -> None:
    hard = CONFIGS / "environment_3.yaml"
    with nothing_written(tmp_path):
        options = ("--planner", "adaptive", "--max-iterations", "5")
        answer = call("plan", RIG, hard, "-o", tmp_path / "plan.json", *options)
    one_message(answer, 1, "5", "mm", "goal")


# Where results should go.


def test_an_existing_plan_is_not_replaced_unless_it_is_asked_for(tmp_path: Path) -> None:
    plan = tmp_path / "plan.json"
    plan.write_text("mine")
    with nothing_written(tmp_path):
        answer = call("plan", RIG, SCENE, "-o", plan)
    one_message(answer, 2, str(plan), "exists already", "--force")


@pytest.mark.parametrize("kind", ["folder", "file"])
def test_an_existing_run_folder_is_not_touched(folder: Path, kind: str) -> None:
    run = folder / "run"
    if kind == "folder":
        run.mkdir()
        (run / "mine.txt").write_text("mine")
    else:
        run.write_text("mine")
    refused(folder, 2, str(run), "exists already", rig=RIG, fast=True, no_camera=True)


def test_a_demo_does_not_write_into_an_existing_folder(tmp_path: Path) -> None:
    with nothing_written(tmp_path):
        one_message(call("demo", "-o", tmp_path), 2, "exists already")


@pytest.mark.parametrize("verb", ["plan", "track"])
def test_a_result_in_a_missing_folder_is_reported_before_the_work(folder: Path, verb: str) -> None:
    missing = folder / "no such folder" / "result"
    rest = {
        "plan": [RIG, SCENE],
        "track": [RIG, "synthetic", "--plan", folder / "plan.json"],
    }[verb]
    with nothing_written(folder):
        one_message(call(verb, *rest, "-o", missing), 2, str(missing))


def test_a_run_folder_below_a_file_is_reported_before_the_work(folder: Path) -> None:
    (folder / "file").touch()
    rest = ("--rig", RIG, "--fast", "--no-camera", "-o", folder / "file" / "above" / "run")
    with nothing_written(folder):
        one_message(call("run", folder / "plan.json", *rest), 2, str(folder / "file"), "-o")


def test_without_a_rig_file_no_bus_is_moved(folder: Path) -> None:
    """A plan may come from anywhere; only this machine's rig file decides which drives move."""
    refused(folder, 2, "--rig", interface="udp_multicast", no_camera=True, yes=True)
    refused(folder, 2, "--rig", channel="can0", no_camera=True, yes=True)


@pytest.fixture
def read_only(short_plan: Path) -> Iterator[Path]:
    """A folder that its user may read and not write, with a plan in it; removed afterwards."""
    read_only_folder = Path(tempfile.mkdtemp(dir="/tmp", prefix="read only "))
    shutil.copy(short_plan, read_only_folder / "plan.json")
    (read_only_folder / "plan.json").chmod(0o644)
    read_only_folder.chmod(stat.S_IRUSR | stat.S_IXUSR | stat.S_IROTH | stat.S_IXOTH)
    yield read_only_folder
    read_only_folder.chmod(0o700)
    shutil.rmtree(read_only_folder)


@pytest.mark.parametrize("verb", ["plan", "run", "demo"])
def test_a_read_only_folder_is_reported_before_the_work(read_only: Path, verb: str) -> None:
    """In a separate process, without root's permission to write anywhere."""
    rest = {
        "plan": [RIG, SCENE, "-o", "new.json"],
        "run": ["plan.json", "--rig", RIG, "-o", "run", "--fast", "--no-camera"],
        "demo": [],
    }[verb]
    program = f"import sys; sys.path.insert(0, {str(ROOT)!r}); from cdpr.cli import main; main()"
    command = [sys.executable, "-B", "-c", program, verb, *map(str, rest)]
    with nothing_written(read_only):
        done = subprocess.run(
            [sys.executable, "-c", WITHOUT_PRIVILEGE, *command],
            cwd=read_only,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
    one_message(Answer(done.returncode, done.stdout, done.stderr), 2, "write permission")


# The bus and the drives.


def test_an_unknown_bus_lists_those_that_are_known(folder: Path) -> None:
    rig = folder / "rig.yaml"
    rig.write_text(RIG.read_text().replace("interface: virtual", "interface: udp_multicats"))
    parts = ["bus.interface", "udp_multicats", "udp_multicast", "socketcan"]
    refused(folder, 2, *parts, rig=rig, no_camera=True, yes=True)
    one_message(call("sim", rig), 2, *parts)
    doctor = call("doctor", rig)
    assert doctor.code == 4
    assert "udp_multicats" in doctor.said


def test_a_kernel_bus_that_is_not_there_names_the_command_that_brings_it_up(folder: Path) -> None:
    refused(
        folder,
        4,
        "ip link",
        rig=RIG,
        interface="socketcan",
        channel="can77",
        no_camera=True,
        yes=True,
    )


def test_a_platform_at_another_pose_is_not_moved(folder: Path) -> None:
    refused(
        folder,
        3,
        "not at the start of the plan",
        "limit 1.0 mm",
        "nothing was enabled",
        rig=RIG,
        fast=True,
        no_camera=True,
        simulated_start_mm=(0, 0, 455),
    )


def test_a_drive_that_does_not_answer_is_named(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    switch_on = SimulatedCia402Rig.__init__

    def with_a_dead_drive(
        rehearsal: SimulatedCia402Rig, *arguments: object, **more: object
    ) -> None:
        switch_on(rehearsal, *arguments, **more)  # type: ignore[arg-type]
        rehearsal.drives[4].silent = True

    monkeypatch.setattr(SimulatedCia402Rig, "__init__", with_a_dead_drive)
    refused(folder, 4, "drive 5", "answer", "check power", rig=RIG, fast=True, no_camera=True)


def test_a_bus_without_drives_is_reported_before_anything_is_enabled(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sdo, "RESPONSE_TIMEOUT", 0.01)
    refused(
        folder,
        4,
        "drives 1, 2, 3, 4, 5, 6, 7, 8 do not answer",
        "cdpr sim",
        rig=RIG,
        interface="udp_multicast",
        channel="239.74.163.9:43991",
        no_camera=True,
        yes=True,
    )


@pytest.fixture
def unpowered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A rig on a bus where no node acknowledges: the controller becomes error-passive."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    settings = BusSettings("udp_multicast", free_udp_channel())
    bus = open_bus(settings)

    def fail(frame: can.Message) -> None:
        if not frame.is_error_frame:
            passive = bytes([0, ControllerState.TRANSMIT_PASSIVE, *bytes(6)])
            bus.send(can.Message(arbitration_id=4, data=passive, is_error_frame=True))

    notifier = can.Notifier(bus, [fail], timeout=0.05)
    document = yaml.safe_load(RIG.read_text())
    document["bus"] |= {"interface": settings.interface, "channel": settings.channel}
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(document))
    yield tmp_path / "rig.yaml"
    notifier.stop()
    bus.shutdown()


def test_a_bus_that_fails_before_a_motion_counts_as_missing_hardware(unpowered: Path) -> None:
    """As where no drive has power; the record and the message keep the fault's own code."""
    answer = call("status", unpowered, "--json")
    state = json.loads(answer.out)
    assert (answer.code, state["error"], state["exit_code"]) == (4, "bus_passive", 4)
    assert state["silent"] == list(range(1, 9))
    assert (state["drives"], state["reference"]["known"]) == (None, False)
    answer = call("doctor", unpowered, "--drives", "--json")
    found = json.loads(answer.out)
    assert (answer.code, found["error"], found["exit_code"]) == (4, "bus_passive", 4)
    assert found["drives"]["silent"] == list(range(1, 9))
    for verb in (("home", "--at-home", "--without-real-time"), ("reset",)):
        answer = call(*verb, unpowered, "--yes", "--json")
        failed = json.loads(answer.out)
        assert (answer.code, failed["error"], failed["exit_code"]) == (4, "bus_passive", 4), verb
        assert "no drive was enabled" in failed["next_step"]


def test_a_failed_bus_is_named_beside_the_silent_drives(unpowered: Path) -> None:
    for verb in (("status",), ("doctor", "--drives")):
        answer = call(*verb, unpowered)
        assert answer.code == 4
        assert "error-passive" in answer.err
        assert "check the drives' power" in answer.err
        assert "answer" in answer.out


@pytest.mark.parametrize("answers", ["", "n\n", "\n"])
def test_a_real_bus_moves_only_after_a_yes(folder: Path, answers: str) -> None:
    bus = ["--interface", "udp_multicast", "--channel", "239.74.163.9:43992"]
    with nothing_written(folder):
        answer = call(
            *("run", folder / "plan.json", "--rig", RIG, "-o", folder / "run", "--no-camera"),
            *bus,
            "--json",
            answers=answers,
        )
    assert 0 <= answer.err.index("ready to run") < answer.err.index("[y/N]")
    code, part = (2, "--yes") if not answers else (130, "nothing was moved")
    assert answer.code == code, answer
    assert part in answer.said


# The camera.


def test_a_missing_camera_is_reported_before_anything_moves(folder: Path) -> None:
    refused(folder, 4, "camera front (77)", "/dev/video", rig=RIG, camera=77)


def test_ctrl_c_is_heard_while_a_camera_that_hangs_is_opened(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its server accepts the connection and sends nothing."""
    is_ready, asked = CameraProcess.is_ready, []

    def stop_at_first(process: CameraProcess, within: float) -> bool:
        if not asked:
            os.kill(os.getpid(), signal.SIGINT)
        asked.append(process.name)
        return is_ready(process, within)

    monkeypatch.setattr(camera_process, "END_TIMEOUT", 0.1)
    monkeypatch.setattr(CameraProcess, "is_ready", stop_at_first)
    with socket.create_server(("127.0.0.1", 0)) as server:
        source = f"http://127.0.0.1:{server.getsockname()[1]}/stream"
        refused(folder, 130, "stopped before anything moved", rig=RIG, camera=source)
    assert asked == ["front"]


def test_a_rig_without_tags_or_camera_needs_no_camera(folder: Path) -> None:
    rig = folder / "rig.yaml"
    rig.write_text(RIG.read_text().split("\ntags:\n")[0] + "\n")
    refused(folder, 2, "no camera or no tags", "--no-camera", rig=rig, fast=True)


@pytest.mark.parametrize(
    ("options", "parts"),
    [
        ({"camera": "0", "no_camera": True}, ["--camera", "--no-camera"]),
        ({"fast": True, "interface": "udp_multicast", "no_camera": True}, ["--fast", "virtual"]),
        ({"interface": "udp_multicast"}, ["no camera was named"]),
        ({"interface": "udp_multicast", "camera": "synthetic"}, ["synthetic"]),
        ({"camera": "0", "fast": True}, ["--camera 0", "--fast needs synthetic cameras"]),
        (
            {"camera": "plan.json"},
            ["'plan.json' is not a live camera source", "during the motion"],
        ),
        (
            {"camera": "/nowhere/run.avi"},
            ["'/nowhere/run.avi' is not a live camera source", "/dev/video0"],
        ),
        ({"camera": "file:///tmp/run.avi"}, ["is not a live camera source"]),
        ({"camera": "frnt=0"}, ["unknown camera 'frnt'", "name one of: front"]),
        ({"camera": "front"}, ["camera 'front' has no source", "write front=0"]),
        ({"camera": "front="}, ["camera 'front' has no source", "write front=0"]),
        (
            {"interface": "udp_multicast", "no_camera": True, "simulated_start_mm": (0, 0, 445)},
            ["--simulated-start-mm"],
        ),
    ],
)
def test_contradictory_options_are_reported(
    folder: Path, options: dict[str, object], parts: list[str]
) -> None:
    refused(folder, 2, *parts, rig=RIG, **options)


@pytest.mark.parametrize(
    ("source", "code", "part"),
    [
        ("no such thing", 2, "not a folder of images"),
        ("77", 4, "camera front (77)"),
        ("empty", 2, "empty"),
        ("text.mp4", 2, "text.mp4"),
        ("synthetic", 2, "--plan"),
    ],
)
def test_a_source_that_shows_nothing_leaves_no_pose_log(
    tmp_path: Path, source: str, code: int, part: str
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.mp4").write_text("no video")
    opened = source if source.isdigit() or source == "synthetic" else tmp_path / source
    with nothing_written(tmp_path):
        answer = call("track", RIG, opened, "-o", tmp_path / "poses.csv")
    one_message(answer, code, part)


def test_a_camera_that_the_rig_does_not_have_lists_those_it_has(tmp_path: Path) -> None:
    answer = call("track", RIG, tmp_path, "-o", tmp_path / "poses.csv", "--camera", "back")
    one_message(answer, 2, "unknown camera 'back'", "front")


# Runs that were, and options.


def test_a_report_needs_a_whole_run_folder(tmp_path: Path, finished_run: Path) -> None:
    one_message(call("report", tmp_path / "nowhere"), 2, "no such run folder")
    broken = tmp_path / "broken"
    shutil.copytree(finished_run, broken)
    (broken / "cycles.csv").unlink()
    with nothing_written(tmp_path):
        answer = call("report", broken)
    one_message(answer, 2, "cycles.csv (missing)")


@pytest.mark.parametrize("name", ["cycles.csv", "clearance.csv", "poses.csv", "summary.json"])
def test_a_damaged_run_folder_is_reported_by_file(
    tmp_path: Path, finished_run: Path, name: str
) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(finished_run, broken)
    (broken / "report.html").unlink()
    (broken / name).write_text('"nonsense')
    with nothing_written(tmp_path):
        answer = call("report", broken)
    one_message(answer, 2, name)


@pytest.mark.parametrize(
    "arguments",
    [
        ["dance"],
        ["plan", RIG],
        ["plan", RIG, SCENE, "-o", "x.json", "--seed", "-1"],
        ["plan", RIG, SCENE, "-o", "x.json", "--seed", "one"],
        ["plan", RIG, SCENE, "-o", "x.json", "--planner", "adaptiv"],
        ["plan", RIG, SCENE, "-o", "x.json", "--clearance-mm", "nan"],
        ["plan", RIG, SCENE, "-o", "x.json", "--clearance-mm", "inf"],
        ["plan", RIG, SCENE, "-o", "x.json", "--goal-mm", "0", "0", "nan"],
        ["run", "plan.json"],
        ["demo", "--environment", "4"],
        ["check"],
    ],
    ids=lambda arguments: " ".join(str(a) for a in arguments if not isinstance(a, Path)),
)
def test_a_wrong_option_is_bad_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str | Path]
) -> None:
    monkeypatch.chdir(tmp_path)
    with nothing_written(tmp_path):
        answer = call(*arguments)
    assert answer.code == 2, answer
    assert answer.err
    assert answer.out == ""
    assert "Traceback" not in answer.said
    assert "defect" not in answer.said


def test_an_error_that_the_plans_own_rig_lacks_is_stated_in_the_file_that_is_passed(
    tmp_path: Path,
) -> None:
    """The rig file was changed as the message said, but the run used the rig in the plan."""
    text = RIG.read_text(encoding="utf-8")
    line = next(line for line in text.splitlines() if line.strip().startswith("error_mm:"))
    rig, file = tmp_path / "rig.yaml", tmp_path / "plan.json"
    rig.write_text(text.replace(f"{line}\n", ""), encoding="utf-8")
    save_plan(straight_plan(load_rig(rig), load_scene(SCENE), [START_MM, GOAL_MM]), file)
    rig.write_text(text, encoding="utf-8")
    with nothing_written(tmp_path):
        answer = call("run", file, "--fast", "-o", tmp_path / "run")
    one_message(answer, 2, "camera 'front' is unknown", "then plan again, or pass --rig: a plan")
    with nothing_written(tmp_path):
        answer = call("run", file, "--fast", "--rig", rig, "-o", tmp_path / "run")
    assert "is unknown" not in answer.err


@pytest.mark.parametrize("file", ["planner/__init__.py", "drivers.py"])
def test_a_package_that_the_user_hides_is_not_called_a_defect(tmp_path: Path, file: str) -> None:
    """As in the shell of another robot's workspace, which sets PYTHONPATH."""
    hiding = tmp_path / file
    hiding.parent.mkdir(exist_ok=True)
    hiding.touch()
    done = subprocess.run(
        [sys.executable, "-P", "-c", "from cdpr.cli import main; main()", "run", "plan.json"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"},
        capture_output=True,
        text=True,
        check=False,
    )
    answer = Answer(done.returncode, done.stdout, done.stderr)
    package = file.partition("/")[0].removesuffix(".py")
    one_message(answer, 2, f"{hiding}: ", f"hides the package `{package}` of cdpr", "PYTHONPATH")
    assert "defect" not in answer.said


def test_a_run_whose_last_cycles_are_not_on_record_fails_now_and_in_later_reports(
    short_plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    append, write = RunFolder.append_cycles, RunFolder.write_table

    def filling(folder: RunFolder, text: str, *, fsync: bool) -> None:
        if "cycle" not in text and text.count("\n") < 40:  # the rest, after the motion
            raise Fault("the run folder cannot be written", why="No space left on device")
        append(folder, text, fsync=fsync)

    def full(folder: RunFolder, name: str, table: Any) -> None:
        if name == "cycles.csv":
            raise Fault("cannot be written", why="No space left on device")
        write(folder, name, table)

    monkeypatch.setattr(RunFolder, "append_cycles", filling)
    monkeypatch.setattr(RunFolder, "write_table", full)
    run = tmp_path / "run"
    answer = call("run", short_plan, "--fast", "--no-camera", "-o", run)
    assert answer.code == 1
    (lacking,) = re.findall(r"Of \d+ cycles the last \d+ are not on record", answer.out)
    assert "free some disk space" in answer.err
    monkeypatch.undo()
    assert call("report", run).code == 0
    summary = json.loads((run / "summary.json").read_text())
    assert summary["verdict"] == "FAILED"
    assert sum(lacking in reason for reason in summary["reasons"]) == 1
    assert json.loads((run / "run.json").read_text())["troubles"] == [lacking]


@pytest.mark.parametrize(
    ("failing", "verdict"), [(2, "FAILED"), (-1, "PASSED")], ids=["during", "after the motion"]
)
def test_cycles_that_are_written_once_the_disk_has_recovered_are_on_record(
    short_plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: int, verdict: str
) -> None:
    """Only one write fails: during the motion the run stops, after it nothing is lost."""
    append, calls = RunFolder.append_cycles, count(1)

    def recovering(folder: RunFolder, text: str, *, fsync: bool) -> None:
        is_rest = "cycle" not in text and text.count("\n") < 40
        if next(calls) == failing or (failing < 0 and is_rest):
            raise Fault("the run folder cannot be written", why="No space left on device")
        append(folder, text, fsync=fsync)

    monkeypatch.setattr(RunFolder, "append_cycles", recovering)
    run = tmp_path / "run"
    answer = call("run", short_plan, "--fast", "--no-camera", "-o", run)
    assert answer.code == (0 if verdict == "PASSED" else 1)
    assert "not on record" not in answer.said
    course = json.loads((run / "run.json").read_text())
    assert course["troubles"] == []
    assert len(RunFolder.open(run).cycles()) == course["cycles"]
    summaries = [json.loads((run / "summary.json").read_text())]
    (run / "summary.json").unlink()
    assert call("report", run).code == 0
    summaries.append(json.loads((run / "summary.json").read_text()))
    assert [one["verdict"] for one in summaries] == [verdict] * 2
    assert "not on record" not in str(summaries)


def test_a_working_folder_removed_after_the_motion_leaves_the_verdict(
    short_plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)

    def removed(*_: object) -> dict[str, str]:
        shutil.rmtree(gone)
        return {"report.html": "No such file or directory"}

    monkeypatch.setattr("executor.runner.write_end", removed)
    answer = call("run", short_plan, "--fast", "--no-camera", "-o", "run")
    assert answer.code == 0
    assert "PASSED" in answer.out
    assert "the folder was removed during the run" in answer.err


@pytest.mark.parametrize("verb", [("report", "run"), ("examples", "hall_10_6")])
def test_a_working_folder_that_is_gone_is_named(
    verb: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    one_message(call(*verb), 2, "the current folder was removed", "next: change to a folder")


def test_too_few_open_files_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none_left(*_: object) -> None:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr("cdpr.cli.operate.run.RunFolder.open_cut_short", none_left)
    one_message(call("report", tmp_path), 1, "no more open files", "ulimit -n")
