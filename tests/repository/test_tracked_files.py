"""What no file of the repository may hold, and what every package must have."""

from __future__ import annotations

import re
from fnmatch import fnmatch
from pathlib import Path

import pytest

from executor.doctor import PACKAGES
from tools.wheel import NoRepository, git

ROOT = Path(__file__).parents[2]

FORBIDDEN = {
    "an index address": r"--(extra-)?index-url|--find-links|--trusted-host|https?://[^\s\"'<>]*/simple\b",
    "a path of one machine": r"(?<![\w.$}/-])/(work|root|home|Users|tmp|var/tmp)/[\w.]",
    "an unfinished note": r"\b(TODO|FIXME|XXX|HACK)\b|(?i:\blorem ipsum\b)",
    "a conflict marker": r"^(<{7}|>{7}) ",
}
NAMES = {"utils", "util", "common", "helpers", "core", "misc"}


def files() -> list[Path]:
    """The tracked files of the repository: others may be a user's own."""
    try:
        listing = git("ls-files", "-z")
    except NoRepository as reason:
        pytest.skip(f"not a git work tree: {reason}")
    found = (ROOT / name for name in listing.split("\0") if name)
    return [path for path in found if path.is_file() and path != Path(__file__)]


@pytest.mark.parametrize("what", FORBIDDEN)
def test_no_file_holds(what: str) -> None:
    """Addresses and paths of one machine break every other; notes to oneself belong in an issue."""
    pattern = re.compile(FORBIDDEN[what], re.MULTILINE)
    found = []
    for path in files():
        data = path.read_bytes()
        if b"\0" in data:
            continue
        text = data.decode()
        found += [
            f"{path.relative_to(ROOT)}:{text.count(chr(10), 0, hit.start()) + 1}: {hit[0]!r}"
            for hit in pattern.finditer(text)
        ]
    assert not found, f"{what}:\n" + "\n".join(found)


@pytest.mark.parametrize(
    ("what", "text"),
    [
        ("an index address", "pip install --extra-index-url x"),
        ("an index address", "https://example.org/simple/"),
        ("a path of one machine", 'open("/home/anna/rig.yaml")'),
        ("a path of one machine", "/work/x"),
        ("an unfinished note", "# TODO: later"),
        ("a conflict marker", "a\n<<<<<<< ours\n"),
    ],
)
def test_the_patterns_see_what_they_are_for(what: str, text: str) -> None:
    """A pattern that matches nothing would keep the test above green for ever."""
    assert re.search(FORBIDDEN[what], text, re.MULTILINE)


def test_no_generated_output_is_tracked() -> None:
    suffixes = {".mcap", ".pyc", ".whl", ".log", ".html"}
    written = {ROOT / "cdpr/console/static/index.html"}
    found = [p for p in files() if p.suffix in suffixes or "__pycache__" in p.parts]
    found = [path for path in found if path not in written]
    assert not found


@pytest.mark.parametrize("file", [".gitignore", ".dockerignore"])
def test_every_environment_that_make_creates_or_advises_is_ignored(file: str) -> None:
    """`make lint` checks what git does not ignore, and `docker build` copies it."""
    ignored = [line.rstrip("/") for line in (ROOT / file).read_text().splitlines()]
    makefile = (ROOT / "Makefile").read_text().replace("$(VENV)", ".venv")
    names = set(re.findall(r"\.venv[\w-]*", makefile))
    assert {".venv", ".venv-cdpr"} <= names
    assert not [name for name in names if not any(fnmatch(name, each) for each in ignored)]


def test_documented_commands_do_not_write_into_the_repository() -> None:
    """A user tries them in a clone: what they write there would be packed into the wheel."""
    tops = {path.relative_to(ROOT).parts[0] for path in files()}
    helps = [path for path in files() if ROOT / "cdpr/cli" in path.parents]
    found = [
        f"{path.relative_to(ROOT)}: {target}"
        for path in [*helps, *(path for path in files() if path.suffix == ".md")]
        for target in re.findall(r" -o ([\w.-]+)", path.read_text())
        if target in tops
    ]
    assert helps
    assert not found


def test_every_package_says_that_it_is_typed() -> None:
    missing = [p for p in PACKAGES if not (ROOT / p / "py.typed").is_file()]
    assert not missing


def test_no_module_has_a_name_that_says_nothing() -> None:
    found = [path for path in files() if {path.stem, path.parent.name} & NAMES]
    assert not found


def test_test_files_have_unique_names() -> None:
    """With pytest's importlib mode a name used twice makes reports ambiguous."""
    names = [path.name for path in files() if path.match("tests/**/test_*.py")]
    assert len(names) == len(set(names)), sorted(n for n in set(names) if names.count(n) > 1)
