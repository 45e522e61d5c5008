"""Every command that a message or a help text prints is run here, or it is said why it cannot be.

A command counts as printed with its verb and options; what it names is filled in, and options that
spare time or hardware may be added.
"""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from model.files.new_rig import CSV_COLUMNS
from model.rig import load_rig
from tests.cli.plans import CONFIGS
from tests.cli.program import call
from tests.repository.test_commands_in_messages import all_commands

GROUPS = ("calibrate", "bench")
CHARUCO = "--columns 7 --rows 5 --square-mm 35 --marker-mm 26 --paper a3"
NEAR = "--goal-mm 150 180 310"
FEW = "--slice z=445 --no-volume --step-mm 125 --workers 1"

# In the order of a newcomer's first day, each with its exit code; what one makes, the next uses.
STEPS = (
    (0, "examples"),
    (0, "examples --all"),
    (0, "examples gachon_8_6 environment_1 -o my_robot"),
    (0, "new my_rig.yaml"),
    (0, "new on_can.yaml --from cables.csv --mass-kg 2.5 --interface socketcan --channel can0"),
    (0, "doctor"),
    (0, "doctor my_rig.yaml"),
    (0, "doctor my_rig.yaml --drives"),
    (0, "explain"),
    (0, "explain drive_silent"),
    (0, "plan configs/gachon_8_6.yaml configs/environment_1.yaml -o plan.json NEAR"),
    (0, "plan configs/gachon_8_6.yaml SCENE -o here.json --start-mm 180 180 310"),
    (0, "check plan.json"),
    (0, "check plan.json --rig configs/gachon_8_6.yaml --json"),
    (0, "run plan.json --fast --no-camera"),
    (0, "run plan.json --rig configs/gachon_8_6.yaml -o runs/first --fast --no-camera"),
    (0, "report runs/first"),
    (0, "plan configs/gachon_8_6.yaml SCENE -o back.json --from-run runs/first --goal-mm 0 0 445"),
    (0, "home configs/gachon_8_6.yaml --at-home --fast"),
    (0, "home configs/gachon_8_6.yaml --camera synthetic --fast --pictures 5"),
    (0, "jog --help"),
    (0, "plan --help"),
    (0, "jog configs/gachon_8_6.yaml --by-mm 0 0 10 --scene SCENE --fast"),
    (0, "jog configs/gachon_8_6.yaml --to-home --scene SCENE --fast"),
    (1, "jog configs/gachon_8_6.yaml --cable 3 --mm -5 --fast"),  # it is taut, and says so
    (0, "track configs/gachon_8_6.yaml synthetic --plan plan.json -o poses.csv --pictures 3"),
    (0, "track REHEARSAL examples/rig_session/pictures -o seen.csv"),
    (0, "sim RIG --drive-behaviour list"),
    (0, "calibrate print board.pdf --columns 9 --rows 6 --square-mm 25"),
    (0, f"calibrate print charuco.pdf --board charuco {CHARUCO}"),
    (0, "calibrate export configs/gachon_8_6.yaml -o front.yaml --to ros"),
    (0, "calibrate print tags.pdf --rig configs/gachon_8_6.yaml"),
    (0, "calibrate poses REHEARSAL SCENE -o measure.json --count 10 --candidates 100"),
    (0, "calibrate rig REHEARSAL examples/rig_session/places.csv -o results"),
    (3, "calibrate rig REHEARSAL LENGTHS --without-poses --known drum_scale"),
    (0, f"workspace configs/gachon_8_6.yaml --scene SCENE -o maps {FEW}"),
)
NOT_RUN = {
    "bench": "takes hours",
    "bench paper": "takes hours",
    "calibrate": "a group of verbs",
    "calibrate apply": "a result's name has its date: tests/cli/test_calibration_option.py",
    "calibrate camera": "needs photographs: tests/cli/test_calibrate_camera.py",
    "calibrate diff": "needs two cameras' results: tests/calibration/test_comparison.py",
    "calibrate export": "needs a result of a calibration: tests/calibration/test_lens_models.py",
    "calibrate import": "needs another program's file: tests/calibration/test_lens_models.py",
    "calibrate extrinsics": "needs photographs: tests/cli/test_calibrate_extrinsics.py",
    "calibrate readout": "needs a moving tag: tests/calibration/test_readout.py",
    "calibrate tags": "needs photographs: tests/cli/test_calibrate_tags.py",
    "console": "serves until Ctrl-C: tests/scenarios/test_console.py",
    "demo": "tools/run_docs.py runs it",
    "hold": "needs a run in progress: tests/scenarios/test_hold_and_speed.py",
    "monitor": "needs a run in progress: tests/cli/test_monitor.py",
    "release": "needs drives on a bus: tests/scenarios/test_release.py",
    "reset": "needs drives on a bus: tests/scenarios/test_latch.py",
    "resume": "needs a run in progress: tests/scenarios/test_hold_and_speed.py",
    "speed": "needs a run in progress: tests/scenarios/test_hold_and_speed.py",
    "status": "needs drives on a bus: tests/scenarios/test_status.py",
    "stop": "needs a run in progress: tests/scenarios/test_operator_stop.py",
}
NOT_RUN_WITH = {
    ("doctor", "--camera"): "needs a camera",
    ("home", "--as-rig-file"): "needs drives on a bus: tests/executor/test_reference.py",
    ("run", "--camera"): "needs a camera",
    ("run", "--interface"): "needs drives on a bus: tests/scenarios/test_processes.py",
    ("sim", "--eds"): "needs a manufacturer's file",
    ("sim", "--interface"): "runs until Ctrl-C: tests/scenarios/test_processes.py",
    ("track", "--pictures"): "needs a camera",
}


def shape(command: str) -> tuple[str, frozenset[str]]:
    """The verb and the options of a command."""
    words = command.split(", then ")[0].split()
    verb = words.pop(0)
    if verb in GROUPS and words and re.fullmatch(r"[a-z]+", words[0]):
        verb = f"{verb} {words.pop(0)}"
    options = {re.split(r"[=.,:)]", word)[0] for word in words if re.match(r"--?[a-z]", word)}
    return verb, frozenset(options)


def printed() -> set[tuple[str, frozenset[str]]]:
    """Shapes of the commands in messages and help texts."""
    return {shape(command) for where, command in all_commands() if where.endswith(".py")}


RUN = [shape(step) for _, step in STEPS]


def is_run(verb: str, options: frozenset[str]) -> bool:
    return any(verb == run and options <= with_these for run, with_these in RUN)


def is_excused(verb: str, options: frozenset[str]) -> bool:
    return verb in NOT_RUN or any((verb, option) in NOT_RUN_WITH for option in options)


def test_every_printed_command_is_run_or_it_is_said_why_not() -> None:
    assert len(printed()) > 40
    missing = [p for p in printed() if not is_run(*p) and not is_excused(*p)]
    assert sorted((verb, sorted(options)) for verb, options in missing) == []


def test_no_excuse_outlives_its_command() -> None:
    verbs = {verb for verb, _ in printed()}
    assert set(NOT_RUN) <= verbs
    assert {verb for verb, _ in NOT_RUN_WITH} <= verbs


def _tables(folder: Path) -> None:
    document = load_rig(CONFIGS / "gachon_8_6.yaml").document
    ends = zip(document.outlets_mm, document.anchors_mm, strict=True)
    lines = [",".join(CSV_COLUMNS), *(",".join(map(str, [*o, *a])) for o, a in ends)]
    (folder / "cables.csv").write_text("\n".join(lines) + "\n")


@pytest.mark.slow
def test_printed_commands_work_in_a_newcomers_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    # matplotlib takes longer than all else; tests/planner/workspace has it draw.
    monkeypatch.setattr("planner.workspace.files.write_figures", lambda *_: None)
    _tables(tmp_path)
    names = {
        "RIG": "configs/gachon_8_6.yaml",
        "SCENE": "configs/environment_1.yaml",
        "REHEARSAL": "configs/gachon_8_6_rehearsal.yaml",
        "LENGTHS": "examples/rig_session/places.csv",
    }
    wrong = []
    for code, step in STEPS:
        words = [names.get(word, word) for word in shlex.split(step.replace("NEAR", NEAR))]
        answer = call(*words, answers="\n" * 50)
        if answer.code != code:
            wrong.append(f"cdpr {step}: exit code {answer.code}\n{answer.err}")
    assert wrong == [], "\n".join(wrong)
