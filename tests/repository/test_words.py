"""The words that went: messages, docstrings and pages use those of `docs/glossary.md`."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = (
    "calibration",
    "cdpr",
    "drivers",
    "executor",
    "model",
    "planner",
    "simulation",
    "tracking",
)
#: Each with what to write instead.
WENT = {
    "tell": "report, show, state",
    "tells": "reports, shows, states",
    "told": "reported, commanded, given",
    "telling": "reporting, showing",
    "tell apart": "distinguish",
    "surely": "the interval's name, such as a 95 % interval",
    "anew": "again, re-",
    "mend": "fix, correct, repair",
    "mended": "fixed, corrected",
    "nobody": "the passive, or name who acts",
    "whoever": "name who acts",
    "reckon": "compute",
    "reckoned": "computed",
    "so many": "this many, a number of",
    "so much": "this much, an amount",
    "stands twice": "appears twice",
    "come to its end": "finish",
    "came to its end": "finished",
    "likewise": "the same for",
    "once more": "again",
    "by itself": "on its own, separately",
    "by themselves": "on their own, separately",
    "by the drives": "from the encoders, that the drives …",
    "by its drives": "from the encoders",
    "look at": "check, inspect, review",
    "looked at": "checked, inspected, reviewed",
    "look who": "check which",
    "go on": "continue, keep",
    "goes on": "continues",
    "going on": "continuing, active",
}
#: Words with a plain meaning, such as "in place", that once stood for twenty others.
MOST_RARE_LINES = 60
_RARE = re.compile(
    r"\b(tells?|told|ways?|places?|placed|stands?|stood|turned|anew|nobody)\b", re.IGNORECASE
)
_WENT = re.compile(rf"\b({'|'.join(sorted(WENT, key=len, reverse=True))})\b", re.IGNORECASE)
_QUOTED = re.compile(r"```.*?```|`[^`\n]*`", re.DOTALL)


def strings_of(source: str) -> Iterator[tuple[int, str]]:
    """Line and text of every string of a module: messages, help texts and docstrings."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value


def refused(text: str) -> list[str]:
    """The words in ``text`` that went; quoted code is left out."""
    return [found.lower() for found in _WENT.findall(_QUOTED.sub("", " ".join(text.split())))]


def pages() -> list[Path]:
    """What users read."""
    return [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")]


@pytest.mark.parametrize("package", PACKAGES)
def test_no_string_of_the_product_uses_a_word_that_went(package: str) -> None:
    assert [
        f"{path.relative_to(ROOT)}:{line}: {word} (write: {WENT[word]})"
        for path in sorted((ROOT / package).rglob("*.py"))
        for line, text in strings_of(path.read_text("utf-8"))
        for word in refused(text)
    ] == []


def test_no_page_uses_a_word_that_went() -> None:
    assert [
        f"{page.relative_to(ROOT)}: {word} (write: {WENT[word]})"
        for page in pages()
        for word in refused(page.read_text("utf-8"))
    ] == []


def test_a_word_that_went_is_found_in_messages_docstrings_and_pages() -> None:
    source = (
        'def f(x):\n    """It Tells."""\n    return f"{x} was\\n told", "so  many of \'em", tell\n'
    )
    found = [(line, word) for line, text in strings_of(source) for word in refused(text)]
    assert sorted(found) == [(2, "tells"), (3, "so many"), (3, "told")]
    assert refused("see `anew` and ```\ntell\n```, retold, mending") == []
    assert refused("begun\nanew") == ["anew"]


def test_words_that_meant_anything_stay_rare() -> None:
    files = [file for package in PACKAGES for file in (ROOT / package).rglob("*.py")]
    lines = [line for file in files for line in file.read_text().splitlines() if _RARE.search(line)]
    assert len(lines) <= MOST_RARE_LINES, "\n".join(lines)
