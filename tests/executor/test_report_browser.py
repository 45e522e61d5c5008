"""The page of a run in a real browser: lines that can be told apart, and texts that can be read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Page

from executor.recording.run_folder import RunFolder
from executor.report import build_report
from executor.report.figures import length_figure
from model.pages.charts import Chart, ChartLine, Span, charts
from model.pages.page import page as html_page
from tests.console import browsing
from tests.executor import fake_run

pytestmark = [pytest.mark.browser, pytest.mark.slow]
CABLES = 24
AUDITS = browsing.AUDITS.split("*/", 1)[1].strip()
#: Colour and dashes of each element that a selector finds.
STYLES = """(all) => all.map((e) => [getComputedStyle(e).stroke,
getComputedStyle(e).strokeDasharray].join())"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with browsing.browser_at(browsing.chromium(), webgl=False) as browser:
        yield browser


@pytest.fixture
def lengths(tmp_path: Path) -> Path:
    """A page with the chart of the lengths of as many cables as a rig can have."""
    time = np.linspace(0.0, 10.0, 50)
    columns = 1.0 + 0.1 * np.sin(time[:, None] + np.arange(CABLES))
    cycles = SimpleNamespace(time=time, lengths=columns, cable_count=CABLES)
    run: Any = SimpleNamespace(cycles=cycles)
    path = tmp_path / "page.html"
    path.write_text(html_page("Lengths", length_figure(run), scripts=("charts.js",)))
    return path


@contextmanager
def opened(browser: Browser, path: Path, **more: Any) -> Iterator[Page]:
    context = browser.new_context(**more)
    page = context.new_page()
    page.goto(path.as_uri())
    yield page
    context.close()


def test_each_cable_has_a_line_of_its_own_style_in_the_chart_and_under_the_pointer(
    browser: Browser, lengths: Path
) -> None:
    """Cables 1 and 9 had the same."""
    with opened(browser, lengths) as page:
        drawn = page.locator(".lines path").evaluate_all(STYLES)
        assert len(set(drawn)) == CABLES
        page.locator(".plot svg[role=img]").hover()
        assert page.locator(".readout path").evaluate_all(STYLES) == drawn


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_texts_of_a_report_have_the_contrast_of_wcag_aa(
    browser: Browser, tmp_path: Path, scheme: Any
) -> None:
    """The names of the cables had that of their lines, 2.9 for cable 6."""
    folder = fake_run.write(fake_run.make(rate_hz=2.0, every=20), tmp_path / "run")
    report = build_report(RunFolder.open(folder.path))
    with opened(browser, report, color_scheme=scheme) as page:
        assert page.evaluate(f"() => ({AUDITS}).weak()") == []
        names = page.locator(".names text")
        assert names.all_text_contents() == [f"cable {k + 1}" for k in range(8)]


@pytest.mark.parametrize(
    "name",
    ["A long name of a stop at the west side of the hall, in English", "停" * 60],
    ids=["words", "ideographs"],
)
def test_a_long_name_of_a_stop_ends_within_its_chart(
    browser: Browser, tmp_path: Path, name: str
) -> None:
    """It ran into the next chart; the table of stops has it whole."""
    time, path = np.array([0.0, 10.0]), tmp_path / "page.html"
    spans = (Span(2.0, 2.0, name), Span(5.0, 5.0, "short"))
    line = ChartLine("x", time, time, "encoder")
    chart = Chart("x", "x", "x", "mm", (line,), (0.0, 10.0), spans=spans, height=150)
    path.write_text(html_page("Stops", charts(chart), scripts=("charts.js",)))
    with opened(browser, path) as page:
        names, area = page.locator("text.span"), page.locator(".area").bounding_box()
        assert area is not None
        for _ in range(2):
            box = names.first.bounding_box()
            assert box is not None
            assert area["y"] < box["y"] + 100.0 < box["y"] + box["height"] < area["y"] + 150.0
            first, short = names.all_text_contents()
            assert first == f"{name[: len(first) - 1]}…"
            assert short == "short"
            page.locator(".plot svg[role=img]").press("+")  # the script draws it again


def test_a_name_at_the_end_of_a_line_has_a_piece_of_that_line(
    browser: Browser, lengths: Path
) -> None:
    with opened(browser, lengths) as page:
        drawn = page.locator(".lines path").evaluate_all(STYLES)
        assert page.locator(".names path").evaluate_all(STYLES) == drawn
