"""How soon the console's page reports stale data, in a real browser.

    python benchmarks/console_stale.py [--times 10]

The server is stopped (SIGSTOP), a session of jogs is stopped, or the connection falls silent, in
turn; drives are simulated over UDP in real time. The time is measured from the signal, or from the
start of the silence, to the page's frame with the banner. Not a test: it takes minutes.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from alone import alone  # noqa: E402
from playwright.sync_api import Page, expect  # noqa: E402

from executor.remote.command_socket import find_runs  # noqa: E402
from tests.cli.plans import RIG  # noqa: E402
from tests.console.browsing import browser_at, chromium  # noqa: E402
from tests.console.cut import CutConnection  # noqa: E402
from tests.scenarios.test_console import console, drives  # noqa: E402

#: Records when the banner was shown, in wall-clock time.
WATCH = """() => {
  globalThis.shown = null;
  addEventListener("DOMContentLoaded", () => {
    const banner = document.getElementById("stale");
    new MutationObserver(() => {
      if (banner.hidden) shown = null;
      else requestAnimationFrame(() => (shown ??= performance.timeOrigin + performance.now()));
    }).observe(banner, { attributes: true, attributeFilter: ["hidden"] });
  });
}"""


def once(page: Page, silence: Callable[[], None], end: Callable[[], None]) -> float:
    """From the silence to the banner, [ms]."""
    expect(page.locator("#stale")).to_be_hidden(timeout=60_000)
    page.wait_for_timeout(1000)
    began = time.time()
    silence()
    try:
        page.wait_for_function("() => shown !== null", timeout=20_000, polling=20)
        return float(page.evaluate("() => shown")) - 1000.0 * began
    finally:
        end()


def main() -> int:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--times", type=int, default=10)
    options = parser.parse_args()
    found: dict[str, list[float]] = {"server": [], "connection": [], "session": []}
    with ExitStack() as stack:
        stack.enter_context(alone())
        bus = stack.enter_context(drives(RIG, 8))
        server, address = stack.enter_context(console(RIG, bus))
        host, _, rest = address.removeprefix("http://").partition("/")
        cut = stack.enter_context(CutConnection(int(host.rpartition(":")[2])))
        page = stack.enter_context(browser_at(chromium())).new_page()
        page.add_init_script(f"({WATCH})()")
        page.goto(f"http://127.0.0.1:{cut.port}/{rest}")
        for _ in range(options.times):
            found["server"].append(once(page, *stopped(server.pid)))
            found["connection"].append(once(page, cut.pause, cut.resume))
        page.locator("#take-control").click()
        page.locator("#tab-jog").click()
        page.locator("#jog-begin").click()
        expect(page.locator("#jog-state")).to_contain_text("Ready", timeout=90_000)
        with find_runs() as runs:
            (session,) = [run.process for run in runs]
        # A supervisor that is silent for 2 s ends the session: it continues before that.
        for _ in range(options.times):
            found["session"].append(once(page, *stopped(session)))
        time.sleep(1.0)
    for name, values in found.items():
        ordered = sorted(values)
        middle, most = ordered[len(ordered) // 2], ordered[-1]
        print(
            f"{name:11} silent: banner after {middle:.0f} ms, at most {most:.0f} ({len(values)}×)"
        )
    return 0


def stopped(process: int) -> tuple[Callable[[], None], Callable[[], None]]:
    """Functions that stop and continue a process."""
    return (
        lambda: os.kill(process, signal.SIGSTOP),
        lambda: os.kill(process, signal.SIGCONT),
    )


if __name__ == "__main__":
    sys.exit(main())
