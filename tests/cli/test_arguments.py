"""Invalid arguments of any verb are refused first: overwriting, odd paths and numbers."""

from __future__ import annotations

import inspect
import io
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, get_args

import pytest
import yaml

from cdpr.cli import arguments
from cdpr.cli.app import VERBS, LazyGroup
from cdpr.cli.arguments import as_command
from model.errors import BadInput
from tests.cli.plans import CONFIGS, RIG, write_short_plan
from tests.cli.program import call, nothing_written, one_message

SCENE = CONFIGS / "environment_1.yaml"


def check_arguments(given: Mapping[str, object]) -> None:
    arguments.check_arguments(given, {name: f"--{name}" for name in given})


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    folder = tmp_path / "src"
    folder.mkdir()
    (folder / "a.png").write_bytes(b"a picture")
    return folder


@pytest.mark.parametrize("kind", ["same", "symbolic link", "hard link", "in a folder", "missing"])
def test_an_output_that_is_an_input_is_refused_even_with_force(
    tmp_path: Path, pictures: Path, kind: str
) -> None:
    source, output = pictures / "a.png", tmp_path / "out"
    match kind:
        case "same":
            output = source
        case "symbolic link":
            output.symlink_to(source)
        case "hard link":
            output.hardlink_to(source)
        case "in a folder":
            source, output = pictures, pictures / "a.png"
        case "missing":
            source, output = tmp_path / "no", tmp_path / "src" / ".." / "no"
    with pytest.raises(BadInput, match="would overwrite"):
        check_arguments({"source": [str(source), source], "output": output, "force": True})


def test_a_source_of_a_named_camera_is_an_input_too(pictures: Path) -> None:
    with pytest.raises(BadInput, match="--overlay would overwrite"):
        check_arguments({"source": [f"front={pictures}"], "overlay": pictures})


def test_two_outputs_of_one_name_are_refused_before_they_exist(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    outputs = {"output": tmp_path / "a", "mcap": tmp_path / "sub" / ".." / "a"}
    with pytest.raises(BadInput, match="--output and --mcap name the same"):
        check_arguments(outputs)


def test_an_output_beside_its_input_is_fine(tmp_path: Path, pictures: Path) -> None:
    check_arguments({"source": [str(pictures)], "output": pictures / "poses.csv"})
    check_arguments({"rig": RIG, "output": tmp_path / "plan.json", "seed": 2**60, "x": (1.0, 2)})


def test_results_may_go_into_the_folder_that_is_read(pictures: Path) -> None:
    check_arguments({"folder": pictures, "output": pictures})


def test_a_camera_s_own_log_is_an_output_too(tmp_path: Path) -> None:
    data = yaml.safe_load(RIG.read_text())
    data["cameras"].append({**data["cameras"][0], "name": "side"})
    rig, log, own = tmp_path / "rig.yaml", tmp_path / "p.csv", tmp_path / "p-front.csv"
    rig.write_text(yaml.safe_dump(data))
    sources = f"front={RIG}", f"side={SCENE}"
    with nothing_written(tmp_path):
        answer = call("track", rig, *sources, "-o", log, "--mcap", own)
    one_message(answer, 2, "--mcap", "the log of front")


def test_a_device_is_never_replaced_by_a_file() -> None:
    with pytest.raises(BadInput, match="not a regular file"):
        check_arguments({"output": Path("/dev/null"), "force": True})


@pytest.mark.parametrize(
    "given",
    [
        {"dwell_s": float("inf")},
        {"columns": 10**30},
        {"tip_mm": (0.0, 1e308, 0.0)},
        {"seed": 2**64},
        {"workers": 10_000},
        {"size_px": (1280, 99_999)},
        {"name": "x" * 300},
        {"rig": Path("x" * 300)},
        {"source": ["x" * 300]},
    ],
)
def test_a_number_or_name_past_any_machine_is_refused(given: dict[str, object]) -> None:
    with pytest.raises(BadInput) as caught:
        check_arguments(given)
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize(
    ("verb", "words", "option"),
    [
        ("sim", (RIG, "--at-mm", "inf", "0", "0"), "--at-mm is inf"),
        ("calibrate", ("tags", RIG, "images", "--wanted-mm", "inf"), "--wanted-mm is inf"),
        ("workspace", (RIG, "-o", "w", "--characteristic-length-mm", "1e300"), "--characteristic-"),
    ],
)
def test_the_option_is_named_as_it_was_typed(
    verb: str, words: tuple[object, ...], option: str
) -> None:
    one_message(call(verb, *words), 2, option)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        (
            "`budget=` and `rounds=` contradict each other",
            "--budget-ms and --rounds contradict each other",
        ),
        ("leave out `weights=`", "leave out --weight"),
        ("pass `planner='optimal'`", "pass --planner optimal"),
        ("without `free_rotation=True`", "without --free-rotation"),
        ("leave out `realtime=False`", "leave out --fast"),
        ("`start=`: add `tags`", "--start-mm: add `tags`"),
        ("`tension=` is unknown to this verb", "`tension=` is unknown to this verb"),
        ("write front=0", "write front=0"),
        ("pass `clearance=0.00987`", "pass --clearance-mm 9.87"),
        ("pass `budget=0.5`", "pass --budget-ms 500"),
        ("pass `rounds=60`", "pass --rounds 60"),
        ("pass `rounds=1234567`", "pass --rounds 1234567"),
        ("lower `tension_limit=12.5`", "lower --tension-limit-n 12.5"),
    ],
)
def test_arguments_of_the_library_are_shown_as_options(text: str, shown: str) -> None:
    names = ("budget_ms", "rounds", "weight", "planner", "free_rotation", "fast", "start_mm")
    names += ("clearance_mm", "tension_limit_n")
    error = BadInput(text, where=text, why=text, next_step=text)
    options = {name: f"--{name.replace('_', '-')}" for name in names}
    arguments.name_options(error, options)
    assert {error.what, error.where, error.why, error.next_step} == {shown}


def test_track_never_draws_into_its_source_pictures(tmp_path: Path) -> None:
    source = tmp_path / "src"
    shutil.copytree(CONFIGS.parent / "examples/rig_session/pictures", source)
    rig = CONFIGS / "gachon_8_6_rehearsal.yaml"
    with nothing_written(tmp_path):
        log = tmp_path / "p.csv"
        answer = call("track", rig, source, "-o", log, "--overlay", source, "--force")
    one_message(answer, 2, "--overlay", str(source))


@pytest.mark.parametrize("name", ["/dev/zero", "loop", "pipe", "x" * 300])
def test_a_rig_file_that_is_none_ends_in_one_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    Path("loop").symlink_to("loop")
    answer = call("plan", name, SCENE, "-o", "plan.json")
    one_message(answer, 2)


@pytest.mark.parametrize(
    "options",
    [
        ("--columns", "1" + "0" * 30, "--rows", "5", "--square-mm", "20"),
        ("--columns", "8", "--rows", "5", "--square-mm", "inf"),
    ],
)
def test_a_board_past_any_machine_is_refused(tmp_path: Path, options: tuple[str, ...]) -> None:
    answer = call("calibrate", "print", tmp_path / "board.pdf", *options)
    one_message(answer, 2)
    assert not (tmp_path / "board.pdf").exists()


def _program(*arguments: str | Path, **how: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", "from cdpr.cli import main; main()", *map(str, arguments)]
    return subprocess.run(  # type: ignore[call-overload, no-any-return]
        command, stderr=subprocess.PIPE, text=True, check=False, timeout=60, **how
    )


@pytest.mark.parametrize("words", [("--version",), ("check", "PLAN", "--json")])
def test_a_full_disk_behind_standard_output_is_reported(
    tmp_path: Path, words: tuple[str, ...]
) -> None:
    plan = write_short_plan(tmp_path / "plan.json")
    with open("/dev/full", "w") as full:
        done = _program(*(plan if word == "PLAN" else word for word in words), stdout=full)
    assert done.returncode == 1
    assert "could not write all its output" in done.stderr
    assert "defect" not in done.stderr
    assert "Exception ignored" not in done.stderr


def _with_closed(closed: str, *words: str | Path) -> None:
    """Calls the program with closed streams, as some service managers do; it must succeed."""
    program = "from cdpr.cli import main; main()"
    done = subprocess.run(
        ["sh", "-c", f'exec "$0" "$@" {closed}', sys.executable, "-c", program, *map(str, words)],
        cwd=CONFIGS.parent,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("closed", [">&-", "2>&-"])
def test_a_stream_that_was_closed_before_the_start_ends_no_check(
    tmp_path: Path, closed: str
) -> None:
    _with_closed(closed, "check", write_short_plan(tmp_path / "plan.json"))


def test_streams_that_were_closed_before_the_start_end_no_run(tmp_path: Path) -> None:
    plan = write_short_plan(tmp_path / "plan.json")
    options = ("--rig", RIG, "--fast", "--no-camera", "-o", tmp_path / "run")
    _with_closed(">&- 2>&-", "run", plan, *options)
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["verdict"] == "PASSED"
    assert (tmp_path / "run" / "report.html").is_file()


def test_a_terminal_of_ascii_only_shows_what_it_can(monkeypatch: pytest.MonkeyPatch) -> None:
    """Streams as a terminal of the C locale has them."""
    out = io.TextIOWrapper(io.BytesIO(), encoding="ascii", errors="strict")
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "stderr", out)
    monkeypatch.setattr(sys, "argv", ["cdpr", "check", "é→.json"])
    from cdpr.cli import main

    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    out.flush()
    assert b"\\xe9\\u2192.json: no such file" in out.buffer.getvalue()  # type: ignore[attr-defined]


def _parts(kind: Any) -> set[Any]:
    """The types in an annotation, such as that of a list or of a value that may be left out."""
    return {kind}.union(*(_parts(one) for one in get_args(kind)))


def words_with_one_empty() -> list[tuple[str, tuple[str, ...]]]:
    """For each path and text of each verb: how it is typed, and a command in which it is empty."""
    found = []
    for group in (LazyGroup(), *(LazyGroup().loaded(v.name) for v in VERBS if v.verbs)):
        assert isinstance(group, LazyGroup)
        before = () if group.name in (None, "cdpr") else (group.name,)
        for verb in (verb for verb in group.verbs if not verb.verbs):
            command: Any = group.loaded(verb.name)
            module, _, function = verb.target.partition(":")
            declared = as_command(getattr(import_module(f"cdpr.cli.{module}"), function))
            kinds = {
                name: get_args(one.annotation)[0]
                for name, one in inspect.signature(declared).parameters.items()
            }
            for empty in command.params:
                if not {Path, str} & _parts(kinds.get(empty.name)):
                    continue
                typed = max(empty.opts, key=len)
                words = [*before, verb.name]
                for one in command.params:
                    if one is empty or one.required:
                        words += [max(one.opts, key=len)] if one.opts[0].startswith("-") else []
                        words += [""] if one is empty else ["1"] * abs(one.nargs)
                found.append((typed, tuple(words)))
    return found


def test_an_empty_value_of_any_verb_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As from an unset variable of the shell; `Path("")` would be the current folder."""
    monkeypatch.chdir(tmp_path)
    commands = words_with_one_empty()
    assert len(commands) > 90
    for typed, words in commands:
        with nothing_written(tmp_path):
            one_message(call(*words), 2, f"{typed} is empty")


@pytest.mark.parametrize("words", [("track", "RIG", "", "-o", "t.csv"), ("track", "RIG", "front=")])
def test_an_empty_source_is_not_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    folder = tmp_path / "here"
    shutil.copytree(CONFIGS.parent / "examples/rig_session/pictures", folder)
    monkeypatch.chdir(folder)
    rig = CONFIGS / "gachon_8_6_rehearsal.yaml"
    with nothing_written(folder):
        answer = call(*(rig if word == "RIG" else word for word in words), "-o", "t.csv")
    one_message(answer, 2)


@pytest.mark.parametrize("beside", ["side", "side=", "front", "=side"])
def test_another_camera_without_a_source_is_not_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, beside: str
) -> None:
    document = yaml.safe_load(RIG.read_text())
    document["cameras"].append({**document["cameras"][0], "name": "side"})
    (tmp_path / "two.yaml").write_text(yaml.safe_dump(document))
    folder = tmp_path / "here"
    shutil.copytree(CONFIGS.parent / "examples/rig_session/pictures", folder)
    monkeypatch.chdir(folder)
    words = ("calibrate", "extrinsics", "../two.yaml", folder, "--camera", "front")
    with nothing_written(folder):
        answer = call(*words, "--beside", beside)
    one_message(answer, 2)
    assert "source" in answer.said or "unknown camera ''" in answer.said


SECRET = "s3cret"
ADDRESS = f"rtsp://user:{SECRET}@127.0.0.1:9/stream"


@pytest.mark.parametrize(
    "words",
    [
        ("track", RIG, ADDRESS, "-o", "t.csv"),
        ("track", RIG, f"nobody={ADDRESS}", "-o", "t.csv"),
        ("track", RIG, "0", "-o", "t.csv", "--scene", ADDRESS),
        ("track", RIG, ADDRESS, ADDRESS, "-o", "t.csv"),
        ("track", RIG, "-o", "t.csv", "--pictures", ADDRESS, "0"),
        ("doctor", RIG, "--camera", ADDRESS),
        ("doctor", RIG, ADDRESS),
        ("calibrate", "extrinsics", RIG, ADDRESS),
        ("calibrate", "extrinsics", RIG, "0", "--beside", ADDRESS),
        ("run", "plan.json", "--rig", RIG, "--yes", "-o", "run", "--camera", ADDRESS),
        ("run", "plan.json", "--rig", RIG, "--fast", "-o", "run", "--camera", ADDRESS),
        ("home", RIG, "--camera", ADDRESS, "--yes"),
    ],
)
def test_the_password_of_a_camera_is_never_printed(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    words: tuple[str | Path, ...],
) -> None:
    monkeypatch.chdir(tmp_path)
    write_short_plan(tmp_path / "plan.json")
    answer = call(*words)
    assert answer.code != 0
    native = capfd.readouterr()  # of OpenCV and FFmpeg
    assert SECRET not in answer.out + answer.err + native.out + native.err
    written = (path for path in tmp_path.rglob("*") if path.is_file())
    assert not any(SECRET.encode() in path.read_bytes() for path in written)


STANDARD = """
import json, os, subprocess, sys
from cdpr.cli.app import _replace_closed_streams
_replace_closed_streams()
child = "import os; [os.fstat(number) for number in range(3)]"
code = subprocess.run([sys.executable, "-c", child]).returncode
files = [stream.fileno() for stream in (sys.stdin, sys.stdout, sys.stderr)]
os.write(int(sys.argv[1]), json.dumps([code, files, open(os.devnull).fileno()]).encode())
"""


@pytest.mark.parametrize("closed", ["", "<&-", ">&-", "2>&-", "<&- 2>&-", "<&- >&- 2>&-"])
def test_no_file_takes_the_number_of_a_closed_stream(tmp_path: Path, closed: str) -> None:
    """What is meant for the terminal would go to it, such as the set-points of a bus."""
    reading, writing = os.pipe()
    subprocess.run(
        ["sh", "-c", f'exec "$0" "$@" {closed}', sys.executable, "-c", STANDARD, str(writing)],
        pass_fds=[writing],
        cwd=CONFIGS.parent,
        check=True,
    )
    os.close(writing)
    with open(reading) as answer:
        code, files, other = json.load(answer)
    assert (code, files) == (0, [0, 1, 2])
    assert other > 2


def test_without_standard_input_a_question_has_no_answer(tmp_path: Path) -> None:
    program = f"import sys; sys.path.insert(0, {str(CONFIGS.parent)!r})"
    program += "; from cdpr.cli import main; main()"
    done = subprocess.run(
        ["sh", "-c", 'exec "$0" -c "$1" new x.yaml <&-', sys.executable, program],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2, done
    assert "no answer to the question" in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("option", [("--slack-mm", "3"), ("--on-a-stand",)])
def test_a_power_loss_is_not_described_without_one(option: tuple[str, ...]) -> None:
    bus = ("--interface", "udp_multicast", "--channel", "239.74.163.9")
    answer = call("sim", RIG, *bus, "--eds", "missing.eds", *option)
    one_message(answer, 2, option[0], "--power-lost SEED")
