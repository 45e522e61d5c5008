"""Effect of console viewers on a run: lateness of cycles with and without them.

    python benchmarks/console_viewers.py [--viewers 20] [--phases 6] [--seconds 40]

A plan is run slowly over UDP in real time. In every second phase an operator has the page open in a
browser, which draws as fast as it can, and viewers receive every state on their own sockets; in the
other phases the console is suspended. Prints the lateness of cycles in both, over all phases of one
run, and the number of lost replies of the simulated drives. Not a test.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402
from alone import alone  # noqa: E402
from playwright.sync_api import Browser, expect  # noqa: E402

from executor.remote.client import request_run  # noqa: E402
from model.errors import Fault  # noqa: E402
from tests.cli.plans import RIG, write_short_plan  # noqa: E402
from tests.console.browsing import browser_at, chromium  # noqa: E402
from tests.console.cut import receive  # noqa: E402
from tests.scenarios.test_console import console, drives, page_at  # noqa: E402
from tests.scenarios.test_processes import program  # noqa: E402

#: Settling time after a change, [s]: a page loads, the console catches up.
SETTLES = 5.0
WITHIN_S = 3600.0
FRAMES = """() => {
  globalThis.frames_drawn = 0;
  const count = () => { frames_drawn++; requestAnimationFrame(count); };
  requestAnimationFrame(count);
}"""


@contextmanager
def viewers(address: str, count: int) -> Iterator[list[int]]:
    """Sockets that receive every state; yields how many each received."""
    taken, over = [0] * count, threading.Event()

    def view(number: int) -> None:
        with page_at(address) as page:
            while not over.is_set():
                receive(page, timeout=10)
                taken[number] += 1

    threads = [threading.Thread(target=view, args=(number,)) for number in range(count)]
    for thread in threads:
        thread.start()
    try:
        yield taken
    finally:
        over.set()
        for thread in threads:
            thread.join()


def watched(browser: Browser, address: str, count: int, seconds: float) -> str:
    """Runs one phase with viewers; returns rates of frames and states."""
    page = browser.new_page()
    try:
        page.goto(address)
        expect(page.locator("#stale")).to_be_hidden(timeout=60_000)
        page.evaluate(f"({FRAMES})()")
        with viewers(address, count) as taken:
            time.sleep(seconds)
        frames = page.evaluate("() => globalThis.frames_drawn")
        return f"{frames / seconds:.0f} frames/s, {min(taken) / seconds:.1f} states/s and viewer"
    finally:
        page.close()


def seconds_now() -> float:
    """Elapsed time of the run, [s]."""
    return float(request_run("status")["elapsed_s"])


def main() -> int:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--viewers", type=int, default=20)
    parser.add_argument("--phases", type=int, default=6)
    parser.add_argument("--seconds", type=float, default=40.0)
    options = parser.parse_args()
    phases: list[tuple[bool, float, float]] = []
    with ExitStack() as stack:
        folder = stack.enter_context(alone())
        plan = write_short_plan(folder / "plan.json")
        bus = stack.enter_context(drives(RIG, 6, within=WITHIN_S))
        server, address = stack.enter_context(console(RIG, bus, within=WITHIN_S))
        browser = stack.enter_context(browser_at(chromium()))
        start = ("--no-camera", "--yes", "--without-real-time", "-o", folder / "run")
        run = stack.enter_context(program("run", plan, "--rig", RIG, *bus, *start, within=WITHIN_S))
        until_it_moves()
        request_run("speed", percent=1)
        for number in range(options.phases):
            if number % 2:
                os.kill(server.pid, signal.SIGCONT)
                time.sleep(SETTLES)
                began = seconds_now()
                print(watched(browser, address, options.viewers, options.seconds), flush=True)
                phases.append((True, began, seconds_now()))
            else:
                os.kill(server.pid, signal.SIGSTOP)
                time.sleep(SETTLES)
                began = seconds_now()
                time.sleep(options.seconds)
                phases.append((False, began, seconds_now()))
        os.kill(server.pid, signal.SIGCONT)
        request_run("stop")
        run.communicate()
        report(folder / "run", phases)
    return 0


def until_it_moves() -> None:
    """Waits until the run moves."""
    for _ in range(600):
        time.sleep(0.1)
        try:
            if request_run("status")["state"] == "moving":
                return
        except Fault:
            continue
    raise SystemExit("the run does not begin")


def report(folder: Path, phases: list[tuple[bool, float, float]]) -> None:
    """Prints the table."""
    with (folder / "cycles.csv").open() as stream:
        rows = [(float(row["time_s"]), float(row["lateness_ms"])) for row in csv.DictReader(stream)]
    cycles = np.array(rows)
    for is_watched in (False, True):
        late = np.concatenate(
            [
                cycles[(cycles[:, 0] >= began) & (cycles[:, 0] < ended), 1]
                for of, began, ended in phases
                if of is is_watched
            ]
        )
        middle, high, most = np.percentile(late, [50.0, 99.9, 100.0])
        print(
            f"{'with' if is_watched else 'without'} viewers: {len(late)} cycles,"
            f" late {middle:.2f} ms (median), {high:.2f} (p99.9), {most:.2f} (most)"
        )
    summary = json.loads((folder / "summary.json").read_text())
    print(f"replies lost: {summary['lost_replies']}")


if __name__ == "__main__":
    sys.exit(main())
