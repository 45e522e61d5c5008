"""A browser and the fake server per module, and a page per test."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser

from tests.console import browsing
from tests.console.browsing import Fake, Visit, visit
from tests.held_up import LATE


@pytest.fixture(scope="module")
def browser(request: pytest.FixtureRequest) -> Iterator[Browser]:
    """With WebGL where the module's ``WEBGL`` says so; elsewhere the page has no scene."""
    webgl = getattr(request.module, "WEBGL", False)
    with browsing.browser_at(browsing.chromium(), webgl) as browser:
        yield browser


@pytest.fixture(scope="module")
def fake(browser: Browser) -> Iterator[Fake]:
    with browsing.fake_server() as fake:
        yield fake


@pytest.fixture
def desk(request: pytest.FixtureRequest, browser: Browser, fake: Fake) -> Iterator[Visit]:
    yield from _visited(request, browser, fake, "desk")


@pytest.fixture
def phone(request: pytest.FixtureRequest, browser: Browser, fake: Fake) -> Iterator[Visit]:
    yield from _visited(request, browser, fake, "phone")


def _visited(
    request: pytest.FixtureRequest, browser: Browser, fake: Fake, size: str
) -> Iterator[Visit]:
    with visit(browser, fake, size) as found:
        yield found
        stash = request.node.stash
        stash[LATE] = stash.get(LATE, False) or found.was_held_up()
