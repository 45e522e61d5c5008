"""The guard of tests/conftest.py against threads and processes that outlive their test."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

CONFTEST = Path(__file__).parents[1] / "conftest.py"

CLEAN = """
import subprocess, sys, threading

def test_ends_what_it_starts():
    thread = threading.Thread(target=print)
    thread.start()
    thread.join()
    subprocess.run([sys.executable, "-c", ""], check=True)
"""

THREAD = """
import threading

release = threading.Event()

def test_leaves_a_thread():
    threading.Thread(target=release.wait, name="forgotten", daemon=True).start()

def test_is_not_blamed_for_it():
    release.set()
"""

# The child reads from a pipe of the test process and so ends with it.
PROCESS = """
import subprocess, sys

children = []

def test_leaves_a_process():
    children.append(subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE))

def test_is_not_blamed_for_it():
    children[0].communicate(b"end\\n")
"""


def suite(folder: Path, **modules: str) -> subprocess.CompletedProcess[str]:
    """Runs a suite of its own under the same conftest, with only a short grace."""
    conftest = CONFTEST.read_text().replace("GRACE_S = 2.0", "GRACE_S = 0.05")
    (folder / "conftest.py").write_text(conftest)
    for name, text in modules.items():
        (folder / f"{name}.py").write_text(text)
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-q", "--rootdir", "."]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_a_leak_fails_the_test_that_made_it_and_no_other(tmp_path: Path) -> None:
    run = suite(tmp_path, test_clean=CLEAN, test_thread=THREAD, test_process=PROCESS)
    assert run.returncode == 1, run.stdout
    assert "5 passed, 2 errors" in run.stdout
    found = re.findall(r"ERROR at teardown of (\w+) _+\s+the test left running: (.*)", run.stdout)
    left = dict(found)
    assert left.keys() == {"test_leaves_a_thread", "test_leaves_a_process"}, run.stdout
    assert left["test_leaves_a_thread"] == "thread 'forgotten'"
    assert re.match(r"process \d+ \(", left["test_leaves_a_process"])
