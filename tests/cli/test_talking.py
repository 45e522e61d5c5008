"""Output of the program: help with examples, JSON for programs, plain text outside terminals."""

from __future__ import annotations

import json
import math
import os
import pty
import re
import subprocess
import sys
from pathlib import Path
from typing import Any, NoReturn

import pytest

from cdpr.cli.app import VERBS, LazyGroup
from executor.remote.client import no_run
from model import jit as machine_code
from tests.cli.plans import CONFIGS, RIG
from tests.cli.program import Answer, call

ROOT = Path(__file__).parents[2]
COLOUR = re.compile(r"\x1b\[[0-9;]*m")
NAMES = [verb.name for verb in VERBS if not verb.verbs]


def no_number(name: str) -> NoReturn:
    raise AssertionError(f"{name} is no JSON")


def document(answer: Answer) -> Any:
    """Standard output as strict JSON."""
    return json.loads(answer.out, parse_constant=no_number)


@pytest.mark.parametrize("verb", NAMES)
def test_help_of_every_verb_has_an_example(verb: str) -> None:
    answer = call(verb, "--help")
    assert answer.code == 0
    assert "Example" in answer.out
    assert f"cdpr {verb}" in answer.out.split("Example", 1)[1]
    assert "\x1b" not in answer.out
    assert answer.err == ""


def test_the_table_of_verbs_says_what_their_own_help_begins_with() -> None:
    """The first help text is made without importing the verbs."""
    for group in (LazyGroup(), *(LazyGroup().loaded(verb.name) for verb in VERBS if verb.verbs)):
        assert isinstance(group, LazyGroup)
        for verb in group.verbs:
            text = (group.loaded(verb.name).help or "").split("\n\n")[0]
            assert " ".join(text.split()) == verb.help


def test_help_lists_every_verb_and_the_exit_codes() -> None:
    answer = call("--help")
    assert answer.code == 0
    assert all(f" {verb} " in answer.out for verb in NAMES)
    assert "3 refused by a safety check" in answer.said


def test_the_folder_of_the_documentation_is_shown_letter_for_letter(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("cdpr.cli.app.EPILOG", "Documentation: /a [z] [red]/docs")
    assert "Documentation: /a [z] [red]/docs" in call("--help").said


def test_nothing_asked_shows_the_help() -> None:
    answer = call()
    assert answer.code == 2
    assert " demo " in answer.said


def test_version_is_shown() -> None:
    answer = call("--version")
    assert answer.code == 0
    assert re.fullmatch(r"cdpr \d+\.\d+\.\d+\S*\n", answer.out)


def test_json_of_plan_and_check(tmp_path: Path) -> None:
    """In a room without obstacles the obstacle clearance is unknown: null, never NaN."""
    scene = tmp_path / "scene.yaml"
    scene.write_text(
        "schema_version: 1\nname: empty\nclearance: {obstacle_mm: 10, self_mm: 5}\n"
        "start: {position_mm: [0, 0, 445]}\ngoal: {position_mm: [0, 0, 505]}\nobstacles: []\n"
    )
    plan = tmp_path / "plan.json"
    planned = call("plan", RIG, scene, "-o", plan, "--json")
    assert (planned.code, planned.err) == (0, "")
    assert document(planned)["quality"]["length_mm"] == pytest.approx(60.0)
    assert document(planned)["plan"] == str(plan)
    checked = call("check", plan, "--json", "--rig", RIG)
    assert (checked.code, checked.err) == (0, "")
    assert document(checked)["passed"] is True
    assert document(checked)["hash"] == document(planned)["hash"]


def test_compiling_is_reported_without_disturbing_json(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    noted: list[str] = []
    monkeypatch.setattr(machine_code, "is_compiled", lambda task: False)
    monkeypatch.setattr(machine_code, "note_compiled", lambda task: noted.append(task.name))
    scene = CONFIGS / "environment_1.yaml"
    planned = call("plan", RIG, scene, "-o", tmp_path / "plan.json", "--json")
    assert document(planned)["plan"] == str(tmp_path / "plan.json")
    assert "compiling the planner for this machine (once" in planned.said
    assert noted == ["optimal"]
    monkeypatch.setattr(machine_code, "can_be_cached", lambda task: False)
    again = call("plan", RIG, scene, "-o", tmp_path / "second.json", "--json")
    assert "on every start" in again.said
    assert "NUMBA_CACHE_DIR" in again.said


def test_json_of_report_doctor_and_stop(finished_run: Path) -> None:
    summary = document(call("report", finished_run, "--json"))
    assert summary == json.loads((finished_run / "summary.json").read_text())
    assert all(
        set(one) == {"name", "good", "text", "fix"} for one in document(call("doctor", "--json"))
    )


@pytest.mark.parametrize(
    "verb", [("hold",), ("resume",), ("speed", "50"), ("monitor",), ("monitor", "--once", "--json")]
)
def test_a_wish_that_reaches_no_run_is_no_success(verb: tuple[str, ...]) -> None:
    reply = call(*verb)
    assert reply.code == 1
    assert "no active run found" in reply.err
    assert "emergency stop" in reply.err


@pytest.mark.parametrize("verb", ["hold", "resume", "speed", "monitor", "stop"])
def test_a_run_of_another_user_is_stopped_by_stop_whatever_was_asked(
    monkeypatch: pytest.MonkeyPatch, verb: str
) -> None:
    """`sudo cdpr resume`, which was named as the stop, would set a held platform in motion."""
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    error = no_run(verb)
    assert "stopped by that user, or with `sudo cdpr stop`" in error.next_step
    assert "for this user" in error.what
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    error = no_run(verb)
    assert error.what == "no active run found"
    assert error.next_step == "press the emergency stop if the robot moves"
    assert "another user" not in error.why


@pytest.mark.parametrize("percent", ["0", "101", "-5", "fast"])
def test_a_speed_that_is_none_is_bad_input(percent: str) -> None:
    assert call("speed", percent).code == 2


def test_a_stop_that_stops_nothing_is_no_success() -> None:
    """An operator who stops while something moves must not read that all is well."""
    reply = call("stop")
    assert reply.code == 1
    assert "no active run found" in reply.err
    assert "emergency stop" in reply.err
    nobody = {"stopped_processes": [], "silent_processes": []}
    assert document(call("stop", "--json")) == nobody
    assert call("stop", "--json").code == 1


def test_json_of_track(tmp_path: Path, short_plan: Path) -> None:
    poses = tmp_path / "poses.csv"
    answer = call(
        *("track", RIG, "synthetic", "--plan", short_plan, "-o", poses, "--pictures", "2", "--json")
    )
    assert answer.code == 0, answer
    facts = document(answer)
    assert (facts["pictures"], facts["poses"]) == (2, 2)
    assert len(poses.read_text().splitlines()) == 3


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["check", "no such plan.json"], 2),
        (["report", "no such folder"], 2),
        (["track", RIG, "no such source", "-o", "poses.csv"], 2),
        (["plan", RIG, CONFIGS / "gachon_8_6.yaml", "-o", "plan.json"], 2),
    ],
)
def test_an_error_is_json_too_when_json_was_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str | Path], code: int
) -> None:
    monkeypatch.chdir(tmp_path)
    answer = call(*arguments, "--json")
    reply = document(answer)
    assert answer.code == code
    assert reply["exit_code"] == code
    assert reply["what"]
    assert reply["next_step"]
    assert "error: " in answer.err


def test_only_the_result_is_on_standard_output_without_escape_codes(
    short_plan: Path, finished_run: Path
) -> None:
    for arguments in (["check", short_plan], ["report", finished_run], ["doctor"]):
        answer = call(*arguments)
        assert answer.code == 0
        assert "\x1b" not in answer.out + answer.err
        assert answer.err.strip() == ""


def test_no_sentence_is_broken_where_a_program_reads_it(
    finished_run: Path, tmp_path: Path, short_plan: Path
) -> None:
    run = tmp_path / "a run whose folder has quite a long name so that its line must be long"
    answer = call("run", short_plan, "--rig", RIG, "-o", run, "--fast", "--no-camera")
    assert answer.code == 0
    lines = answer.out.splitlines()
    assert f"report: {run / 'report.html'}" in lines
    summary = json.loads((run / "summary.json").read_text())
    assert [line.strip() for line in lines if line.startswith("  The ")] == [
        reason for reason in summary["reasons"] if reason.startswith("The ")
    ]
    assert answer.err == "", "no progress where nobody looks"


def in_terminal(*arguments: str | Path, **variables: str) -> str:
    """Output of the program when its standard output is a terminal."""
    main_end, far_end = pty.openpty()
    program = f"import sys; sys.path.insert(0, {str(ROOT)!r}); from cdpr.cli import main; main()"
    environment = {"PATH": os.environ["PATH"], "TERM": "xterm-256color", **variables}
    process = subprocess.Popen(
        [sys.executable, "-c", program, *map(str, arguments)],
        stdout=far_end,
        stderr=far_end,
        stdin=subprocess.DEVNULL,
        env=environment,
    )
    os.close(far_end)
    text = b""
    while True:
        try:
            piece = os.read(main_end, 4096)
        except OSError:  # Linux says EIO when the last one closed the far end
            break
        if not piece:
            break
        text += piece
    os.close(main_end)
    assert process.wait(timeout=60) == 0
    return text.decode()


def test_no_color_is_heeded_in_a_terminal() -> None:
    plainly = in_terminal("doctor")
    assert COLOUR.search(plainly)
    coloured = re.compile(r"\x1b\[(?:[0-9;]*;)?(?:3[0-8]|4[0-8]|9[0-7])(?:;[0-9;]*)?m")
    assert coloured.search(plainly)
    assert not coloured.search(in_terminal("doctor", NO_COLOR="1"))
    assert not coloured.search(in_terminal("--help", NO_COLOR="1"))


def test_numbers_that_are_not_known_are_null(finished_run: Path) -> None:
    def numbers(value: Any) -> list[float]:
        if isinstance(value, dict):
            return [n for part in value.values() for n in numbers(part)]
        if isinstance(value, list):
            return [n for part in value for n in numbers(part)]
        return [value] if isinstance(value, float) else []

    summary = document(call("report", finished_run, "--json"))
    assert all(math.isfinite(number) for number in numbers(summary))
    assert summary["tag_error_mm"] is None
    assert summary["lateness_ms"] is None


def test_the_radius_that_divides_moments_is_stated_to_be_the_root_mean_square() -> None:
    page = (ROOT / "docs" / "workspace.md").read_text()
    shown = " ".join(re.sub("[│╭╮╰╯─]", " ", call("workspace", "--help").out).split())
    for text in (page, shown):
        assert "RMS radius" in text
        assert "mean radius" not in text


def test_every_verb_and_option_is_documented() -> None:
    """Except of `workspace`, whose page is its help."""
    page = (ROOT / "docs" / "command-line.md").read_text()
    for verb in NAMES:
        section = page.split(f"\n## {verb}\n")[1].split("\n## ")[0]
        assert f"cdpr {verb}" in section
        table = call(verb, "--help").out.split("╭", 1)[1]
        options = set(re.findall(r"--[a-z][a-z-]+", table)) - {"--help"}
        if verb != "workspace":
            assert not {option for option in options if f"`{option}" not in section}, verb


def test_every_example_of_the_help_names_options_that_exist() -> None:
    for verb in NAMES:
        text = call(verb, "--help").out
        examples, tables = text.split("Example", 1)[1].split("╭", 1)
        for line in re.split(r"\n\s*\n", examples):
            named = re.match(r"\s*cdpr (\w+)", line)
            if named is not None:
                known = tables if named[1] == verb else call(named[1], "--help").out
                assert all(option in known for option in re.findall(r"--[a-z][a-z-]+", line))
