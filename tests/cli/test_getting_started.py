"""The commands of the first page do what the page says."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from tests.cli.plans import CONFIGS
from tests.cli.program import call

PAGE = Path(__file__).parents[2] / "docs" / "getting-started.md"


def commands(heading: str) -> list[list[str]]:
    """The `cdpr` commands below a heading of the page."""
    section = PAGE.read_text().split(f"\n## {heading}\n")[1].split("\n## ")[0]
    blocks = re.findall(r"```sh\n(.*?)```", section, re.DOTALL)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    return [shlex.split(line)[1:] for line in lines if line.startswith("cdpr ")]


@pytest.mark.slow
@pytest.mark.real_time
def test_the_steps_of_the_first_page_lead_to_a_run_that_passed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "configs").symlink_to(CONFIGS)
    steps = commands("The same, step by step")
    assert [step[0] for step in steps] == ["plan", "check", "run"]
    for step in steps:
        answer = call(*step)
        assert answer.code == 0, answer
    (run,) = (tmp_path / "runs").iterdir()
    assert (run / "report.html").is_file()
    refused = commands("Stop it")[-1]
    answer = call(*refused)
    assert answer.code == 3, answer
    assert "not at the start of the plan" in answer.err
    assert list((tmp_path / "runs").iterdir()) == [run]


def test_every_command_of_the_page_is_one_of_the_program_with_options_it_knows() -> None:
    found = [
        step
        for heading in ("Stop it", "Drives in another process, in real time")
        for step in commands(heading)
    ]
    verbs = {"run", "monitor", "hold", "resume", "speed", "stop", "sim"}
    assert {step[0] for step in found} == verbs
    for verb, *rest in found:
        known = call(verb, "--help").out
        assert all(option in known for option in rest if option.startswith("--"))
