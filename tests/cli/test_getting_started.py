"""The commands of the first page are the program's; `make docs-run` runs them."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

from tests.cli.program import call

PAGE = Path(__file__).parents[2] / "docs" / "getting-started.md"


def commands(heading: str) -> list[list[str]]:
    """The `cdpr` commands below a heading of the page."""
    section = PAGE.read_text().split(f"\n## {heading}\n")[1].split("\n## ")[0]
    blocks = re.findall(r"```sh\n(.*?)```", section, re.DOTALL)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    return [shlex.split(line)[1:] for line in lines if line.startswith("cdpr ")]


def test_every_command_of_the_page_is_one_of_the_program_with_options_it_knows() -> None:
    found = [
        step
        for heading in (
            "The same, step by step",
            "Stop it",
            "Drives in another process, in real time",
        )
        for step in commands(heading)
    ]
    verbs = {"plan", "check", "run", "monitor", "hold", "resume", "speed", "stop", "sim"}
    assert {step[0] for step in found} == verbs
    for verb, *rest in found:
        known = call(verb, "--help").out
        assert all(option in known for option in rest if option.startswith("--"))
