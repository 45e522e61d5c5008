"""The changes that `make mutation` tries: what decides something is changed, the rest is not."""

from __future__ import annotations

import sys
import tomllib
from itertools import count
from math import inf
from multiprocessing import active_children
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
TOOL = ROOT / "tools" / "mutation"


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(TOOL))
    import run

    yield run
    for process in active_children():
        process.join()
    for name in ("run", "mutants"):
        sys.modules.pop(name, None)


def changes(tool: Any, source: str) -> set[tuple[str, str]]:
    return {(m.was, m.now) for m in tool.mutants(source, "source.py")}


@pytest.mark.parametrize(
    ("was", "now"),
    [
        ("LIMIT = 130", {"LIMIT = 131", "LIMIT = 129"}),
        ("x = a <= b", {"x = a < b", "x = a > b"}),
        ("x = a and b", {"x = a or b", "x = a", "x = b"}),
        ("x = not a", {"x = a"}),
        ("x = a & b", {"x = a | b"}),
        ("x = {a, b}", {"x = {a}", "x = {b}"}),
        ("x = abs(a)", {"x = a"}),
        ("raise Fault", {"pass"}),
        ("stop()", {"pass"}),
    ],
)
def test_what_decides_something_is_changed(tool: Any, was: str, now: set[str]) -> None:
    assert changes(tool, was) == {(was, each) for each in now}


@pytest.mark.parametrize(
    "source",
    [
        '"""A text of 3 lines."""',
        "from a import b",
        "def f(x: Annotated[int, 3]) -> Literal[1]: ...",
        "x = field(frozen=True)",
        "x = 'a text'",
    ],
)
def test_what_decides_nothing_is_left_alone(tool: Any, source: str) -> None:
    assert changes(tool, source) == set()


def test_every_change_is_compiled_alone(tool: Any) -> None:
    """Each is put back before the next one."""
    found: list[dict[str, int]] = []
    for mutant in tool.mutants("a = 1\nb = 2\n", "source.py"):
        names: dict[str, int] = {}
        exec(mutant.code, names)
        found.append({key: names[key] for key in ("a", "b")})
    assert found == [{"a": 2, "b": 2}, {"a": 0, "b": 2}, {"a": 1, "b": 3}, {"a": 1, "b": 1}]


def test_files_and_tests_that_are_named_exist_and_reasons_are_given(tool: Any) -> None:
    paths = set()
    for target in tool.targets():
        paths.add(target.path)
        for path in (target.path, *target.tests):
            assert (ROOT / path).is_file(), path
    safety = {str(p.relative_to(ROOT)) for p in (ROOT / "executor" / "safety").glob("*.py")}
    assert safety - paths <= {"executor/safety/__init__.py"}
    listed = tomllib.loads((TOOL / "equivalent.toml").read_text("utf-8"))
    for each in listed.get("equivalent", []):
        assert each["reason"]
        known = {
            (m.scope, m.was, m.now)
            for m in tool.mutants((ROOT / each["file"]).read_text("utf-8"), each["file"])
        }
        assert (each["scope"], each["was"], each["now"]) in known, each


def test_the_same_few_changes_are_tried_every_time(tool: Any) -> None:
    safe, other = tool.Target("executor/safety/gate.py", (), ()), tool.Target("other.py", (), ())
    made = tool.mutants("x = [" + "1, " * 50 + "]", "source.py")
    found = [tool.Trial(t, k, m) for t in (other, safe) for k, m in enumerate(made)]
    chosen = tool.sample(found)
    assert chosen == tool.sample(found)
    assert len(chosen) == tool.MOST
    assert [trial.target for trial in chosen] == [safe] * 20 + [other] * 20
    assert tool.sample(found[:7]) != []
    assert {trial.number for trial in tool.sample(found[:7])} == set(range(7))


@pytest.mark.parametrize("sent", [[], [(0, True)], [(-1, False)]])
def test_a_process_that_does_not_try_all_its_changes_fails_the_run(
    tool: Any, sent: list[tuple[int, bool]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One is killed for its memory, one finds a test that fails without any change."""
    share = trials(tool)
    send_and_end(tool, monkeypatch, sent)
    with pytest.raises(SystemExit) as failed:
        tool.tried(share, 1, inf)
    assert failed.value.code == 2


def test_a_process_may_end_early_once_the_time_is_up(
    tool: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, *_ = share = trials(tool)
    send_and_end(tool, monkeypatch, [(0, True)])
    monkeypatch.setattr(tool, "time", SimpleNamespace(monotonic=count().__next__))
    assert tool.tried(share, 1, 0.5) == {first: True}


def trials(tool: Any) -> list[Any]:
    target = tool.Target("executor/safety/gate.py", (), ())
    made = tool.mutants("x = [1, 2]", "source.py")
    return [tool.Trial(target, number, mutant) for number, mutant in enumerate(made)]


def send_and_end(
    tool: Any, monkeypatch: pytest.MonkeyPatch, results: list[tuple[int, bool]]
) -> None:
    """Replaces the processes by ones that send these results."""

    def serve(_target: Any, _share: Any, _until: float, link: Any) -> None:
        for result in results:
            link.send(result)

    monkeypatch.setattr(tool, "serve", serve)


def test_lines_changed_since_an_unknown_commit_fail_the_run(
    tool: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["run.py", "--changed", "no-such-commit"])
    with pytest.raises(SystemExit) as failed:
        tool.main()
    assert failed.value.code == 2
