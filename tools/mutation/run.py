"""Mutation tests of the safety code: makes every small change and counts what the tests notice.

    python tools/mutation/run.py                       # everything: takes a while
    python tools/mutation/run.py executor/safety       # files below a path
    python tools/mutation/run.py --changed [BASE]      # lines changed since BASE (HEAD~1), < 60 s

Each survivor is printed with file, line and change. The exit code is 1 if less than 99 % of the
changes below `executor/safety` were noticed, or none could be tried; 2 if tests fail without any
change, if a process ends before it has tried its changes in time, or if git does not know BASE.
`targets.toml` assigns tests to files; `equivalent.toml` lists changes without effect, with the
reason. Every change runs in a separate process, forked from one that has loaded all modules except
the changed one and those that import it.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import importlib.util
import multiprocessing
import os
import random
import re
import resource
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from types import CodeType
from typing import NoReturn

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"

from mutants import (  # noqa: E402
    Mutant,
    mutants,
)

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
SAFETY, WANTED = "executor/safety/", 0.99
BUDGET_S = 50.0
"""Time budget of --changed; the rest of a minute is for the tests still running."""
GRACE_S = 3.0
"""Time after the budget for which running tests are awaited."""
LEAST_PATIENCE_S = 20.0
MEMORY = 8 << 30
NO_TESTS = 5
SEED = 20260
MOST = 40
"""Number of changes that --changed tries, always the same, spread evenly over the files."""


@dataclass(frozen=True)
class Target:
    """A file and the tests that must notice its changes."""

    path: str
    tests: tuple[str, ...]
    only: tuple[str, ...]

    @property
    def module(self) -> str:
        """Import name."""
        return self.path.removesuffix(".py").replace("/", ".")


@dataclass(frozen=True)
class Trial:
    """One change to try; the number is its index in `mutants`."""

    target: Target
    number: int
    mutant: Mutant


@dataclass(frozen=True)
class Score:
    """Result of a file."""

    tried: int
    survivors: tuple[Trial, ...]


def targets() -> list[Target]:
    """The targets in the data file."""
    rows = tomllib.loads((HERE / "targets.toml").read_text("utf-8"))["target"]
    return [
        Target(path, tuple(row["tests"]), tuple(row.get("only", ())))
        for row in rows
        for path in row["files"]
    ]


def trials(target: Target) -> list[Trial]:
    """All changes of a file, except equivalent ones."""
    listed = tomllib.loads((HERE / "equivalent.toml").read_text("utf-8")).get("equivalent", [])
    equivalent = {(e["file"], e["scope"], e["was"], e["now"]) for e in listed}
    source = (ROOT / target.path).read_text("utf-8")
    return [
        Trial(target, number, mutant)
        for number, mutant in enumerate(mutants(source, target.path))
        if (target.path, mutant.scope, mutant.was, mutant.now) not in equivalent
    ]


def changed_lines(base: str) -> dict[str, set[int]]:
    """Lines of each file added or changed since a commit, including the working tree."""
    command = ["git", "diff", "--unified=0", "--no-color", "--no-ext-diff", base, "--", "*.py"]
    text = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    lines: dict[str, set[int]] = {}
    path = ""
    for line in text.splitlines():
        if line.startswith("+++ "):
            path = line.removeprefix("+++ b/")
        elif found := re.match(r"@@ -\S+ \+(\d+)(?:,(\d+))? @@", line):
            first, count = int(found[1]), int(found[2] or 1)
            lines.setdefault(path, set()).update(range(first, first + count))
    return lines


def project_modules() -> dict[str, set[str]]:
    """Imports of each loaded module of this repository."""
    found: dict[str, set[str]] = {}
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        path = Path(file) if file else None
        if path is None or ROOT not in path.parents or ".venv" in path.parts:
            continue
        found[name] = set()
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Import):
                found[name].update(alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module:
                found[name].add(node.module)
                found[name].update(f"{node.module}.{alias.name}" for alias in node.names)
    return found


def forget(module: str) -> None:
    """Unloads a module, all modules that import it directly or indirectly, and the tests."""
    imports = project_modules()
    stale = {module, *(name for name in imports if name.startswith("tests"))}
    while more := {name for name, used in imports.items() if used & stale} - stale:
        stale |= more
    for name in stale & set(imports):
        package, _, last = name.rpartition(".")
        parent = sys.modules.get(package)
        if parent is not None and vars(parent).get(last) is sys.modules[name]:
            delattr(parent, last)  # `from package import last` would find it
        del sys.modules[name]


def put(module: str, code: CodeType) -> None:
    """Loads a module with other code."""
    spec = importlib.util.find_spec(module)
    assert spec is not None
    made = importlib.util.module_from_spec(spec)
    sys.modules[module] = made
    package, _, name = module.rpartition(".")
    setattr(importlib.import_module(package), name, made)
    exec(code, made.__dict__)


def tests_fail(target: Target, code: CodeType | None, patience: float, until: float) -> bool | None:
    """Whether a test fails or times out with other code (None: the file's own).

    Args:
        target: The file.
        code: Changed code.
        patience: Time-out, [s].
        until: Time on the monotonic clock at which None is returned.
    """
    left = max(until - time.monotonic(), 0.01)
    child = os.fork()
    if child == 0:
        status = 1
        try:
            status = _in_child(target, code, min(patience, left))
        finally:
            os._exit(status)
    _, ended = os.waitpid(child, 0)
    if os.WIFEXITED(ended) and os.WEXITSTATUS(ended) == NO_TESTS:
        raise SystemExit(f"{target.path}: {', '.join(target.tests)} hold no test")
    if os.WIFSIGNALED(ended) and os.WTERMSIG(ended) == signal.SIGALRM and left < patience:
        return None
    return ended != 0


def _in_child(target: Target, code: CodeType | None, patience: float) -> int:
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, patience)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nothing, stream)
    if code is not None:
        put(target.module, code)
    import pytest

    options = ["-x", "-q", "--assert=plain", "-p", "no:cacheprovider", "-p", "no:xdist"]
    return int(pytest.main([*options, *target.only, *target.tests]))


def serve(target: Target, share: Sequence[Trial], until: float, link: Connection) -> None:
    """Tries changes of one file; sends the number of each and whether it was noticed."""
    os.chdir(ROOT)
    sys.path.insert(0, str(ROOT))
    for test in target.tests:
        importlib.import_module(test.removesuffix(".py").replace("/", "."))
    importlib.import_module(target.module)
    forget(target.module)
    began = time.monotonic()
    if failed := tests_fail(target, None, 600.0, until):
        link.send((-1, False))
    if failed is not False:
        return
    patience = max(LEAST_PATIENCE_S, 10.0 * (time.monotonic() - began))
    for trial in share:
        result = tests_fail(target, trial.mutant.code, patience, until)
        if result is None:
            break
        link.send((trial.number, result))


def tried(asked: Sequence[Trial], jobs: int, until: float) -> dict[Trial, bool]:
    """Tries changes in parallel; returns whether each was noticed, for those tried in time."""
    context = multiprocessing.get_context("fork")
    waiting: list[tuple[Target, list[Trial]]] = []
    for target in dict.fromkeys(trial.target for trial in asked):
        own = [trial for trial in asked if trial.target == target]
        shares = jobs if len(own) > 20 else 1
        waiting += [(target, own[k::shares]) for k in range(shares)]
    running: dict[Connection, tuple[Target, list[Trial]]] = {}
    noticed: dict[Trial, bool] = {}
    while waiting or running:
        while waiting and len(running) < jobs:
            target, share = waiting.pop(0)
            if time.monotonic() > until:
                continue
            link, far_end = context.Pipe()
            context.Process(target=serve, args=(target, share, until, far_end), daemon=True).start()
            far_end.close()
            running[link] = (target, share)
        left = None if until == float("inf") else max(until + GRACE_S - time.monotonic(), 0.0)
        came = wait(list(running), left)
        if not came:  # still loading modules; daemons end with this program
            break
        for ready in came:
            assert isinstance(ready, Connection)
            target, share = running[ready]
            try:
                number, result = ready.recv()
            except EOFError:
                del running[ready]
                if time.monotonic() < until and not noticed.keys() >= set(share):
                    fail(f"{target.path}: a process ended before it had tried all its changes")
                continue
            if number < 0:
                fail(f"{target.path}: {', '.join(target.tests)} fail without any change")
            (trial,) = (t for t in share if t.number == number)
            noticed[trial] = result
            if not result:
                show(trial)
    return noticed


def fail(why: str) -> NoReturn:
    """Ends the program without a result."""
    print(why, file=sys.stderr)
    sys.exit(2)


def show(trial: Trial) -> None:
    """Prints a survivor."""
    mutant = trial.mutant
    scope = f" in {mutant.scope}" if mutant.scope else ""
    print(f"{trial.target.path}:{mutant.line}{scope}", flush=True)
    print(f"  - {mutant.was}\n  + {mutant.now}", flush=True)


def show_table(asked: Sequence[Trial], noticed: dict[Trial, bool]) -> float:
    """Prints one line per file; returns the share noticed in executor/safety, 1 if none tried."""
    print("| file | changes | tried | noticed | |\n|---|---|---|---|---|")
    safe = all_safe = 0
    for path in dict.fromkeys(trial.target.path for trial in asked):
        results = [result for trial, result in noticed.items() if trial.target.path == path]
        count = sum(trial.target.path == path for trial in asked)
        hit = sum(results)
        share = f"{hit / len(results):.1%}" if results else ""
        print(f"| {path} | {count} | {len(results)} | {hit} | {share} |")
        if path.startswith(SAFETY):
            safe, all_safe = safe + hit, all_safe + len(results)
    return safe / all_safe if all_safe else 1.0


def asked_for(paths: Iterable[str], base: str | None) -> list[Trial]:
    """Changes of files below some paths, or on lines changed since a commit."""
    chosen = [t for t in targets() if any(t.path.startswith(path) for path in paths or [""])]
    lines = changed_lines(base) if base is not None else None
    found = [
        trial
        for target in chosen
        if lines is None or target.path in lines
        for trial in trials(target)
        if lines is None or trial.mutant.line in lines[target.path]
    ]
    return found if base is None else sample(found)


def sample(found: Sequence[Trial]) -> list[Trial]:
    """At most `MOST` changes, always the same, executor/safety first."""
    shuffled = random.Random(SEED).sample(list(found), len(found))
    turn: dict[str, int] = {}
    turns = []
    for trial in shuffled:
        path = trial.target.path
        turn[path] = turn.get(path, 0) + 1
        turns.append((turn[path], trial))
    chosen = [trial for _, trial in sorted(turns, key=lambda each: each[0])[:MOST]]
    return sorted(chosen, key=lambda trial: not trial.target.path.startswith(SAFETY))


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("paths", nargs="*", help="only files below these")
    parser.add_argument("--changed", nargs="?", const="HEAD~1", metavar="BASE")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    options = parser.parse_args()
    began = time.monotonic()
    try:
        asked = asked_for(options.paths, options.changed)
    except subprocess.CalledProcessError:
        fail(f"git does not know {options.changed}: cannot determine the changed lines")
    if not asked:
        print("no file listed in `tools/mutation/targets.toml` was changed")
        return 0
    until = began + BUDGET_S if options.changed is not None else float("inf")
    noticed = tried(asked, options.jobs, until)
    if not noticed:
        print("no change could be tried in time: this computer is too busy, or the tests too slow")
    share = show_table(asked, noticed)
    print(f"{share:.1%} noticed in {SAFETY} (wanted {WANTED:.0%})", end="")
    print(f"; {len(noticed)} of {len(asked)} tried in {time.monotonic() - began:.0f} s")
    return int(share < WANTED or not noticed)


if __name__ == "__main__":
    sys.exit(main())
