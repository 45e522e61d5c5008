"""Tab in a shell completes verbs and options."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

COMPLETE = "import sys; sys.argv = ['cdpr']; from cdpr.cli import main; main()"


@pytest.mark.parametrize(
    ("words", "found"),
    [("cdpr wor", {"workspace"}), ("cdpr plan --clear", {"--clearance-mm"})],
)
def test_the_shell_gets_what_the_words_may_become(words: str, found: set[str]) -> None:
    settings = {
        "_CDPR_COMPLETE": "complete_bash",
        "COMP_WORDS": words,
        "COMP_CWORD": str(len(words.split()) - 1),
    }
    command = [sys.executable, "-c", COMPLETE]
    environment = os.environ | settings
    shown = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=False
    ).stdout
    assert set(shown.split()) == found
