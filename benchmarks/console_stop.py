"""How soon a platform slows down after STOP in the console, in a real browser.

    python benchmarks/console_stop.py [--presses 1000] [--seed 1]

An operator jogs the platform, drives are simulated over UDP in real time, and alternately another
page's STOP is clicked or a program sends the same command on its own socket. A listener on the bus
records the kernel's time stamp of the first SYNC with a set-point slower than the jog. Where root
runs it, the browser is denied what root's browser does, and an operator's cannot: to raise its own
priority over all other programs. The times are measured from the click (the browser's event time
stamp) and from just before the command is sent, an upper bound for the server's side of the socket.
Each press ends a session, and the next one enables the drives again: a press takes seconds.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import random
import sys
import threading
import time
from collections import deque
from contextlib import ExitStack
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import can  # noqa: E402
import numpy as np  # noqa: E402
from alone import alone  # noqa: E402
from playwright.sync_api import Page, expect  # noqa: E402
from websockets.sync.client import ClientConnection  # noqa: E402

from drivers.cia402.pdo import RPDO1_BASE, SYNC_ID  # noqa: E402
from tests.cli.plans import RIG  # noqa: E402
from tests.console.browsing import browser_at, chromium  # noqa: E402
from tests.drivers.drive_bench import parse_set_point  # noqa: E402
from tests.scenarios.test_console import Operator, console, drives, operator, page_at  # noqa: E402

#: Length of the listener's buffer, [frames]: some seconds.
KEPT = 10_000
#: Delay of a press of STOP after the platform began to move, [s].
EARLIEST, LATEST = 0.4, 1.2
#: Cycles without a change of set-points, after which a platform stood, [cycles].
STOOD_CYCLES = 20
#: Programs left over by the benchmark are ended after this, [s].
ENDS_WITHIN_S = 6.0 * 3600.0
WATCH = """() => addEventListener("pointerdown", (event) => {
  globalThis.pressed = performance.timeOrigin + event.timeStamp;
}, { capture: true })"""


class Listener:
    """The newest SYNC and set-points of one drive on the bus, with the kernel's time stamps."""

    def __init__(self, options: tuple[str, ...]) -> None:
        """Opens the bus given by command-line options."""
        group, _, port = options[-1].partition(":")
        filters: Any = [
            {"can_id": number, "can_mask": 0x7FF} for number in (SYNC_ID, RPDO1_BASE + 1)
        ]
        self._bus = can.Bus(
            interface="udp_multicast", channel=group, port=int(port), can_filters=filters
        )
        self._frames: deque[tuple[float, int | None]] = deque(maxlen=KEPT)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._hear)

    def __enter__(self) -> Listener:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        self._bus.shutdown()

    def sync_after(self, target: int) -> float:
        """Time of the SYNC with which drive 1 last received a set-point [counts]."""
        found, sync = 0.0, 0.0
        for at, count in reversed(self._frames):
            if count is None:
                sync = at
            elif count == target:
                found = sync
            elif found:
                break
        assert found, "the slower set-point was not heard"
        return found

    def _hear(self) -> None:
        while not self._over.is_set():
            frame = self._bus.recv(timeout=0.2)
            if frame is None or frame.is_error_frame:
                continue
            if frame.arbitration_id == SYNC_ID:
                self._frames.append((frame.timestamp, None))
            elif (pair := parse_set_point(frame.data)) is not None:
                self._frames.append((frame.timestamp, pair[1]))


class Holder(threading.Thread):
    """Holds a jog control, towards the middle of the workspace, until the session ends."""

    def __init__(self, me: Operator) -> None:
        super().__init__()
        self._me = me
        self.moving, self.error = threading.Event(), ""

    def run(self) -> None:
        """Holds until the session slows down or an error occurs."""
        me = self._me
        me.press()
        x = me.state["platform"]["position_mm"][0]
        direction = [1.0 if x < 0.0 else -1.0, 0.0, 0.0]

        def over(state: dict[str, Any]) -> bool:
            if state["motion"] is None or state["motion"]["state"] not in ("moving", "enabling"):
                return True
            me.held(direction)
            if state["jog"]["moving"]:
                self.moving.set()
            return False

        try:
            me.until(over)
        except Exception as error:  # reported by the main thread
            self.error = repr(error)
        self.moving.set()


def first_slower(log: Path) -> int | None:
    """Set-point of drive 1 in the first cycle of a session's log that slows down for the stop.

    None where the platform stood already when STOP came: a report of the held control was later
    than 150 ms, and the jog ended before.
    """
    with log.open() as stream:
        rows = list(csv.DictReader(stream))
    for row in rows:
        if row["state"] == "stopping":
            return int(row["set_counts_1"])
    events = (log.parent / "events.jsonl").read_text()
    ends = {row["set_counts_1"] for row in rows[-STOOD_CYCLES:]}
    if len(ends) == 1 and '"code": "held"' in events:
        return None
    sys.stderr.write(events)
    raise SystemExit(f"{log}: no cycle is stopping, set-points at the end: {sorted(ends)}")


def newest_log() -> Path:
    """The newest log of a session."""
    return max(Path("runs").glob("*/winches.csv"), key=lambda path: path.stat().st_mtime)


def by_click(page: Page) -> float:
    """Clicks on STOP; returns the time of the event in the browser, [s]."""
    page.locator("#stop").click()
    return float(page.evaluate("() => globalThis.pressed")) / 1000.0


def by_socket(socket: ClientConnection) -> float:
    """Sends STOP; returns the time just before, [s]."""
    began = time.time()
    socket.send(json.dumps({"kind": "command", "id": 1, "command": "stop"}))
    return began


def of_an_operator(browser: str, folder: Path) -> str:
    """A browser that cannot raise its priority, as that of an ordinary user."""
    if os.geteuid() != 0:
        return browser
    program = folder / "browser"
    program.write_text(f'#!/bin/sh\nexec setpriv --bounding-set=-sys_nice {browser} "$@"\n')
    program.chmod(0o755)
    return str(program)


def main() -> int:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--presses", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    draw = random.Random(options.seed)
    found: dict[str, list[float]] = {"click": [], "socket": []}
    late = stood = 0
    with ExitStack() as stack:
        folder = stack.enter_context(alone())
        bus = stack.enter_context(drives(RIG, 7, within=ENDS_WITHIN_S))
        _, address = stack.enter_context(console(RIG, bus, within=ENDS_WITHIN_S))
        me = stack.enter_context(operator(address))
        me.bears_late_cycles = True
        listener = stack.enter_context(Listener(bus))
        browser = stack.enter_context(browser_at(of_an_operator(chromium(), folder)))
        page = browser.new_page()
        page.add_init_script(f"({WATCH})()")
        page.goto(address)
        expect(page.locator("#stale")).to_be_hidden(timeout=60_000)
        for number in range(options.presses):
            me.until(lambda state: state["motion"] is None and state["busy"] is None)
            if me.state["latched"]:
                print(f"latched, reset: {me.state['latched']}", flush=True)
                assert me.does("reset", cause=me.state["latched"])["ok"]
            assert me.command("jog_begin")["ok"]
            me.until(lambda state: state["jog"]["ready"] or state["outcome"])
            holder = Holder(me)
            holder.start()
            holder.moving.wait()
            time.sleep(draw.uniform(EARLIEST, LATEST))
            if number % 2:
                with page_at(address) as socket:
                    pressed = by_socket(socket)
                    holder.join()
            else:
                pressed = by_click(page)
                holder.join()
            if holder.error:
                raise SystemExit(holder.error)
            me.until(lambda state: state["busy"] is None)
            if me.state["latched"]:
                late += 1  # the computer was too busy for a cycle
                continue
            target = first_slower(newest_log())
            if target is None:
                stood += 1
                continue
            slower = listener.sync_after(target)
            found["socket" if number % 2 else "click"].append(1000.0 * (slower - pressed))
            if number % 50 == 49:
                report(found)
    print("in total:")
    report(found)
    print(f"presses not counted: {late} a cycle was late, {stood} the platform stood already")
    return 0


def report(found: dict[str, list[float]]) -> None:
    """Prints the table so far."""
    for name, values in found.items():
        if values:
            middle, high = np.percentile(values, [50.0, 99.0])
            print(
                f"{name:7} {len(values):4}×: median {middle:5.1f} ms, p99 {high:5.1f},"
                f" most {max(values):5.1f}",
                flush=True,
            )


if __name__ == "__main__":
    sys.exit(main())
