"""The page with the real server: it reports which part has become silent.

How soon is measured by `python benchmarks/console_stale.py`.
"""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from executor.remote.command_socket import find_runs
from tests.console.browsing import browser_at, chromium
from tests.console.cut import CutConnection
from tests.scenarios.test_console import console, drives

pytestmark = [pytest.mark.browser, pytest.mark.slow]
FIGURES = "#value-x"


@pytest.fixture
def browser() -> Iterator[Browser]:
    with browser_at(chromium(), webgl=False) as browser:
        yield browser


@contextmanager
def frozen(process: int) -> Iterator[None]:
    """A process that is stopped, and continued afterwards."""
    os.kill(process, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(process, signal.SIGCONT)


@contextmanager
def open_page(browser: Browser, address: str) -> Iterator[Page]:
    context = browser.new_context(viewport={"width": 1400, "height": 900})
    page = context.new_page()
    page.goto(address)
    expect(page.locator(FIGURES)).to_contain_text(".", timeout=30_000)
    expect(page.locator("#stale")).to_be_hidden()
    yield page
    context.close()


def silent(page: Page, who: str) -> None:
    """The banner is there, it says who is silent, and nothing but STOP can be used."""
    expect(page.locator("#stale")).to_be_visible()
    expect(page.locator("#stale-text")).to_contain_text(re.compile(who))
    assert page.evaluate("() => document.getElementById('main').inert")


def test_a_silent_part_is_named_and_figures_count_again_afterwards(
    browser: Browser, slow_rig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with drives(slow_rig, 9) as bus, console(slow_rig, bus) as (server, address):
        host, _, rest = address.removeprefix("http://").partition("/")
        with CutConnection(int(host.rpartition(":")[2])) as cut:
            through = f"http://127.0.0.1:{cut.port}/{rest}"
            with open_page(browser, through) as page:
                with frozen(server.pid):
                    silent(page, "the console’s server")
                expect(page.locator("#stale")).to_be_hidden()
                with cut.silent():
                    silent(page, "the console’s server")
                expect(page.locator("#stale")).to_be_hidden()
                cut.hang_up()
                silent(page, "Connection lost|No data")
                expect(page.locator("#stale")).to_be_hidden()
        with open_page(browser, address) as page:
            page.locator("#take-control").click()
            expect(page.locator("#lamp-control")).to_have_text("You have control")
            page.locator("#tab-jog").click()
            page.locator("#jog-begin").click()
            expect(page.locator("#jog-state")).to_contain_text("Ready", timeout=90_000)
            with find_runs() as runs:
                (session,) = [run.process for run in runs]
            with frozen(session):
                silent(page, "the run")
            expect(page.locator("#stale")).to_be_hidden(timeout=30_000)
