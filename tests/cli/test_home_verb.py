"""`cdpr home` and `cdpr jog --cable` as typed: ambiguous commands are refused."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
from pathlib import Path

import pytest

from cdpr.cli.options import rig_on_bus
from executor.cameras import process as camera_process
from executor.cameras.process import CameraProcess, FrameRequest
from executor.interlock.interlock import MotionInterlock
from executor.interlock.reference import as_in_the_file
from model.errors import Refused
from tests.cli.plans import RIG
from tests.cli.program import call, one_message


@pytest.fixture(autouse=True)
def own_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


@pytest.mark.parametrize(
    ("options", "code", "part"),
    [
        ((), 2, "state the platform pose"),
        (("--at-home", "--camera", "synthetic"), 2, "state the platform pose"),
        (("--camera", "0"), 2, "--fast needs synthetic cameras"),
        (("--camera", "run.avi"), 2, "'run.avi' is not a live camera source"),
        (("--camera", "side=0"), 2, "unknown camera 'side'"),
        (("--camera", "front=0", "--camera", "front=1"), 2, "2 cameras are given; only one"),
        (("--at-home", "--pose-mm", "0", "0", "445"), 2, "state the platform pose"),
        (("--at-home", "--as-rig-file"), 2, "state the platform pose"),
        (("--as-rig-file", "--tension-n", "7"), 2, "no effect here: --tension-n"),
        (("--as-rig-file", "--pictures", "9", "--fast"), 2, "no effect here: --pictures, --fast"),
        (("--pose-mm", "0", "0", "4450"), 2, "outside the workspace"),
        (("--pose-mm", "0", "0", "nan"), 2, "give a finite number"),
        (("--at-home", "--limit-n", "5"), 3, "limit of 5 N"),
        (("--at-home", "--limit-n", "101"), 3, "limit of 101 N"),
        (("--at-home", "--tension-n", "4"), 3, "pretension of 4 N"),
        (("--at-home", "--tension-n", "50"), 3, "pretension of 50 N"),
        (("--at-home", "--tension-n", "nan"), 2, "give a finite number"),
        (("--at-home", "--limit-n", "nan"), 2, "give a finite number"),
        (("--at-home", "--interface", "udp_multicast"), 2, "--fast"),
    ],
)
def test_what_is_not_clearly_meant_moves_nothing(
    tmp_path: Path, options: tuple[str, ...], code: int, part: str
) -> None:
    one_message(call("home", RIG, "--fast", *options), code, part)
    assert not list(tmp_path.rglob("*.json"))


@pytest.mark.parametrize(
    "words",
    [
        ("home", "--at-home"),
        ("jog", "--cable", "1", "--mm", "1"),
        ("jog", "--by-mm", "0", "0", "1", "--no-scene"),
    ],
)
@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("name: Ours\nsources: [our bench]\n", ("no EDS file for", "cdpr sim RIG --eds FILE")),
        ("name: Ours\nsources: [our bench]\nmonitoring: pigeon\n", ("lab.yaml:3", "heartbeat")),
        (None, ("lab.yaml: no such file", "relative to the current folder")),
    ],
)
def test_drives_that_cannot_be_simulated_are_refused_before_the_proposal(
    tmp_path: Path, words: tuple[str, ...], text: str | None, parts: tuple[str, ...]
) -> None:
    """The cure was an option that only `cdpr sim` has, for a missing profile as well."""
    profile, rig = tmp_path / "lab.yaml", tmp_path / "rig.yaml"
    rig.write_text(f"{RIG.read_text()}drives: {{type: cia402, profile: {profile}}}\n")
    if text is not None:
        profile.write_text(text)
    verb, *options = words
    answer = call(verb, rig, *options, "--fast")
    assert answer.code == 2, answer
    assert "ready to" not in answer.said
    assert all(part in answer.said for part in parts), answer.said


def test_a_no_moves_nothing(tmp_path: Path) -> None:
    bus = ("--interface", "udp_multicast", "--channel", "239.74.163.25:41990")
    assert call("home", RIG, "--at-home", *bus, answers="n\n").code == 130
    assert call("jog", RIG, "--cable", "1", "--mm", "1", *bus, answers="n\n").code == 130
    held = call("jog", RIG, "--hold-to-run", "--one-cable", *bus, answers="n\n")
    assert held.code == 130
    assert "nothing was enabled" in held.said
    assert "stays as it is; a run begins only where drive positions fit a pose" in held.said
    assert not list(tmp_path.rglob("*.json"))


def test_a_session_of_jogs_enables_nothing_when_the_program_that_started_it_is_gone() -> None:
    bus = ("--interface", "udp_multicast", "--channel", "239.74.163.25:41990")
    gone = ("--yes", "--end-with", 2**22 + 1)  # larger than the number of any process
    held = call("jog", RIG, "--hold-to-run", "--one-cable", *bus, *gone)
    assert held.code == 130
    assert "nothing was enabled" in held.said
    one_message(call("jog", RIG, "--by-mm", 0, 0, 1, "--no-scene", *gone), 2, "--hold-to-run")


HELD = ("--hold-to-run", "--no-scene")
AT, AT_WXYZ = ("--simulated-start-mm", 0, 0, 445), ("--simulated-start-wxyz",)


@pytest.mark.parametrize(
    ("options", "part"),
    [
        (AT, "--hold-to-run"),
        ((*HELD, *AT_WXYZ, 1, 0, 0, 0), "without a position"),
        ((*HELD, *AT, *AT_WXYZ, 0, 0, 0, 0), "length"),
        ((*HELD, *AT, "--interface", "udp_multicast"), "start pose can be set only for"),
    ],
)
def test_a_pose_is_stated_for_drives_that_a_session_simulates_only(
    options: tuple[object, ...], part: str
) -> None:
    one_message(call("jog", RIG, *options), 2, part)


def test_every_question_is_preceded_by_what_will_happen(tmp_path: Path) -> None:
    """With --json too: what will happen is on standard error, before the question."""
    bus = ("--interface", "udp_multicast", "--channel", "239.74.163.25:41990", "--json")
    asked = {
        "pretension": ("home", RIG, "--at-home", *bus),
        "cable 1 (drive 1)": ("jog", RIG, "--cable", "1", "--mm", "1", *bus),
        "no fault latched": ("reset", RIG, *bus),
    }
    for title, arguments in asked.items():
        answer = call(*arguments, answers="n\n")
        assert (answer.code, json.loads(answer.out)["error"]) == (130, "stopped")
        assert 0 <= answer.err.index(title) < answer.err.index("[y/N]")
    assert not list(tmp_path.rglob("*.json"))


def test_a_rehearsal_shows_the_reference_and_stores_nothing(tmp_path: Path) -> None:
    answer = call("home", RIG, "--camera", "synthetic", "--pictures", "5", "--fast", "--json")
    assert answer.code == 0, answer
    document = json.loads(answer.out)
    assert (document["file"], document["record"]) == (None, None)
    assert 0.0 < document["uncertainty_mm"] < 0.5
    assert len(document["home_counts"]) == 8
    assert min(document["tensions_n"]) >= 7.5
    assert not list(tmp_path.rglob("*.json"))


def test_a_camera_that_is_not_there_is_found_out_before_anything_moves(
    tmp_path: Path,
) -> None:
    bus = ("--interface", "udp_multicast", "--channel", "239.74.163.25:41992")
    answer = call("home", RIG, "--camera", str(tmp_path / "none"), *bus, answers="y\n")
    assert answer.code in (2, 4)
    assert "Wind the cables in" not in answer.err
    assert "none" in answer.err.replace("\n", "")


def test_a_stop_while_the_camera_looks_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C works although the camera has stopped answering."""
    ask, asked = CameraProcess.ask, []

    def stop_at_second(process: CameraProcess, trigger: FrameRequest) -> None:
        asked.append(trigger.frame)
        if asked == [0, 0, 1]:  # the first before anything moved
            (camera,) = multiprocessing.active_children()
            assert camera.pid is not None
            os.kill(camera.pid, signal.SIGSTOP)
            os.kill(os.getpid(), signal.SIGINT)
        ask(process, trigger)

    monkeypatch.setattr(camera_process, "END_TIMEOUT", 0.1)
    monkeypatch.setattr(CameraProcess, "ask", stop_at_second)
    answer = call("home", RIG, "--camera", "synthetic", "--pictures", "20", "--fast")
    assert answer.code == 130, answer
    assert asked == [0, 0, 1]


def test_one_cable_on_a_taut_platform_ends_in_a_reported_stop() -> None:
    answer = call("jog", RIG, "--cable", "3", "--mm", "-5", "--fast")
    assert answer.code == 1
    assert "more than" in answer.err
    assert "stopped, all drives together" in answer.err
    assert "along the path" not in answer.err, "winches have none"
    assert "cdpr reset" not in answer.err, "nothing is latched on simulated drives"
    answer = call("jog", RIG, "--cable", "3", "--mm", "0.01", "--fast", "--json")
    assert answer.code == 0, answer
    assert json.loads(answer.out)["moved_mm"] == pytest.approx(0.01, abs=0.002)


def test_a_motion_of_winches_is_recorded_where_the_user_says(tmp_path: Path) -> None:
    """Also with simulated drives, which leave no record unasked."""
    for verb in (("home", RIG, "--at-home"), ("jog", RIG, "--cable", "3", "--mm", "0.01")):
        folder = tmp_path / "records" / str(verb[0])
        answer = call(*verb, "--fast", "--json", "-o", folder)
        assert answer.code == 0, answer
        assert json.loads(answer.out)["record"] == str(folder)
        assert {"events.jsonl", "winches.csv"} <= {file.name for file in folder.iterdir()}
        one_message(call(*verb, "--fast", "-o", folder), 2, "records")
    unused = call("home", RIG, "--as-rig-file", "-o", tmp_path / "none")
    one_message(unused, 2, "--as-rig-file neither moves nor measures")


def test_a_lost_reference_can_be_dropped_for_what_absolute_encoders_count(tmp_path: Path) -> None:
    bus = ("--interface", "udp_multicast", "--channel", "239.74.163.25:41991")
    rig = rig_on_bus(RIG, *bus[1::2])
    MotionInterlock(rig).file.write(
        as_in_the_file(rig).model_copy(update={"lost": "emergency stop"})
    )
    with pytest.raises(Refused, match="homing reference is lost"):
        MotionInterlock(rig).require_ready()
    asked = call("home", RIG, "--as-rig-file", *bus, answers="n\n")
    assert asked.code == 130
    assert "not valid: the homing reference is lost: emergency stop" in asked.out
    assert MotionInterlock(rig).file.path.is_file()
    assert call("home", RIG, "--as-rig-file", *bus, "--yes").code == 0
    MotionInterlock(rig).require_ready()
    counting = tmp_path / "rig.yaml"
    counting.write_text(RIG.read_text().replace("encoder: absolute, ", ""))
    one_message(call("home", counting, "--as-rig-file", *bus, "--yes"), 3, "never homed")
    simulated = call("home", counting, "--as-rig-file")
    assert simulated.code == 0, simulated
    assert "none: the drives count as in the rig file" in simulated.said
    assert "absolute" not in simulated.said
