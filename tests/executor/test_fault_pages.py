"""Every fault code in the source has a page, every page a code, and reports name it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.bus_faults import BusFault
from executor.fault_pages import ORDINARY, page_of, pages_of

ROOT = Path(__file__).parents[2]
PAGES = ROOT / "docs" / "faults"
HEADINGS = ["## What it means", "## Likely cause", "## State of the machine", "## Next step"]
#: Which argument of a call is the code of an event.
PLACES = {
    "CameraNews": 0,
    "Finding": 1,
    "LoopEvent": 2,
    "RunEvent": 1,
    "StopReason": 0,
    "_stop": 2,
    "_fault": 0,
    "_tell": 0,
    "_tell_cause": 0,
    "tell": 0,
}


def codes_in_the_source() -> Iterator[str]:
    """Codes that are written where events are made; and those of faults of the bus."""
    for path in [*(ROOT / "executor").rglob("*.py"), *(ROOT / "cdpr").rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call):
                continue
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            place = PLACES.get(name)
            if place is not None and len(node.args) > place:
                code = node.args[place]
                if isinstance(code, ast.Constant) and isinstance(code.value, str):
                    yield code.value
    yield from ("recorder", "supervisor_lost")  # told in a loop, by name
    yield from (kind.code for kind in (BusFault, *BusFault.__subclasses__()))


CODES = sorted(set(codes_in_the_source()) - ORDINARY)


def test_codes_are_found_in_the_source() -> None:
    assert len(CODES) >= 31
    assert {
        "camera",
        "pictures_dropped",
        "slack",
        "late",
        "gate_denied",
        "drive_stuck",
        "bus_off",
        "no_real_time",
    } <= set(CODES)


@pytest.mark.parametrize("code", CODES)
def test_a_code_has_a_page_with_everything_in_it(code: str) -> None:
    text = (PAGES / f"{code}.md").read_text()
    assert [line for line in text.splitlines() if line.startswith("## ")] == HEADINGS
    assert f"Event `{code}`." in text
    assert f"faults/{code}.md" in (ROOT / "mkdocs.yml").read_text()
    assert f"[`{code}`]({code}.md)" in (PAGES / "index.md").read_text()
    assert page_of(code) == f"docs/faults/{code}.md"


def test_there_is_no_page_about_nothing() -> None:
    assert sorted(path.stem for path in PAGES.glob("*.md") if path.stem != "index") == CODES


def test_pages_are_named_once_and_only_for_faults() -> None:
    codes = ["enabled", "moving", "slack", "late", "slack", "held"]
    assert pages_of(codes) == ["docs/faults/slack.md", "docs/faults/late.md"]
