"""Shared by the page's tests: a browser on the console's page, served by the fake server."""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import subprocess
import sys
import tempfile
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import cv2
import numpy as np
import pytest
from playwright.sync_api import (
    Browser,
    ConsoleMessage,
    Error,
    FloatRect,
    Mouse,
    Page,
    TimeoutError,
    expect,
    sync_playwright,
)

ROOT = Path(__file__).parents[2]
ARGUMENTS = [
    "--headless",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
#: WebGL without a graphics card, as on a computer that has none: only the scene is drawn by it.
WEBGL = (
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-watchdog",
    "--disable-gpu-compositing",
)
VIEWS = ("live", "operate", "jog", "teach", "events", "service")
AUDITS = (Path(__file__).parent / "audits.js").read_text(encoding="utf-8")
SIZES = {"phone": (390, 844), "tablet": (1024, 768), "desk": (1400, 900)}

#: Notes on the page how often its data became stale from now on.
NOTE_STALE = """() => {
  const stale = document.getElementById("stale");
  window.wentStale = 0;
  const note = new MutationObserver(() => { window.wentStale += !stale.hidden; });
  note.observe(stale, { attributeFilter: ["hidden"] });
}"""

#: The page of each browser that the next visit has, by whether it takes touches.
_KEPT: WeakKeyDictionary[Browser, dict[bool, Page]] = WeakKeyDictionary()

#: What makes data stale, if the fake server is told so.
_SILENCING = ("silent", "behind_ms", "hang_up", "refuse")
PATIENCE_S = 30.0  # on a busy computer; what comes is waited for no longer than it takes
expect.set_options(timeout=1000.0 * PATIENCE_S)


@dataclass
class Fake:
    """Client of the fake server.

    Attributes:
        silenced: Whether it was told since this was set to send nothing for a while.
    """

    address: str
    silenced: bool = False

    @property
    def origin(self) -> str:
        return self.address.split("/?")[0]

    def ask(self, **hooks: Any) -> dict[str, Any]:
        """Messages received so far, after ``hooks`` were set."""
        asked = {**hooks, **hooks.get("set", {})}
        self.silenced |= any(asked.get(name) for name in _SILENCING)
        data = json.dumps(hooks).encode() if hooks else None
        with urllib.request.urlopen(f"{self.origin}/fake", data=data, timeout=10) as answer:
            found = json.load(answer)
        assert isinstance(found, dict)
        return found

    def received(self, kind: str) -> list[dict[str, Any]]:
        """Messages of a kind, or commands of a name."""
        return [m for m in self.ask()["received"] if kind in (m["kind"], m.get("command"))]

    def wait(self, page: Page, holds: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """What it has once that holds; fails after `PATIENCE_S` of the page's time."""
        for _ in range(round(PATIENCE_S / 0.05)):
            found = self.ask()
            if holds(found):
                return found
            page.wait_for_timeout(50)
        raise AssertionError(f"did not come: {found['received'][-5:]}")

    def let_pass(self, page: Page, ticks: int = 8) -> dict[str, Any]:
        """Waits for a number of periods of the server, 50 ms each."""
        until = self.ask()["ticks"] + ticks
        return self.wait(page, lambda found: bool(found["ticks"] >= until))


@dataclass
class Visit:
    """A page, its server, and the page's errors."""

    page: Page
    fake: Fake
    errors: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)

    def audit(self, name: str, of: str = "") -> list[str]:
        """Findings of one of `audits.js` on the page."""
        script = AUDITS[AUDITS.index("({") :].rstrip()
        found = self.page.evaluate(f"() => [({script}).{name}({of})].flat()")
        assert isinstance(found, list)
        return found

    def was_held_up(self) -> bool:
        """Whether data were stale, though the server was not told to be silent."""
        return not self.fake.silenced and self._was_stale()

    def _was_stale(self) -> bool:
        with contextlib.suppress(Error):  # the page may be closed
            return bool(self.page.evaluate("() => window.wentStale"))
        return False

    def view(self, name: str) -> None:
        """Selects a view, if it is not shown already."""
        tab = self.page.locator(f"#tab-{name}")
        if tab.is_visible():
            tab.click()

    @contextlib.contextmanager
    def stale(self) -> Iterator[None]:
        """The data are stale while the block runs, and current afterwards."""
        self.fake.ask(silent=True)
        expect(self.page.locator("#stale")).to_be_visible()
        yield
        self.fake.ask(silent=False)
        expect(self.page.locator("#stale")).to_be_hidden()

    def blink(self) -> None:
        """The data are stale for a moment."""
        with self.stale():
            self.fake.let_pass(self.page, 2)

    def move_to(self, button: str) -> Mouse:
        """Moves the pointer to a button; returns the mouse."""
        box = self.page.locator(button).bounding_box()
        assert box
        self.page.mouse.move(box["x"] + 9, box["y"] + 9)
        return self.page.mouse

    def send(self, command: str, *buttons: str) -> None:
        """Clicks buttons in turn, until the server has received the command.

        On a busy computer data can be stale for a moment. What is clicked then is not done, as the
        page's notice says: it begins again with the first button.
        """
        notice = self.page.locator("#notice")
        refused = self.page.locator("#notice", has_text=re.compile(r"\S"))
        for _ in range(5):
            before = _count(self.fake.ask(), command)
            notice.evaluate("(notice) => (notice.textContent = '')")
            try:
                for button in map(self.page.locator, buttons):
                    expect(button.or_(refused).first).to_be_attached()
                    if not refused.count():
                        button.click(timeout=1000.0 * PATIENCE_S / 5.0)
            except TimeoutError:  # of a question that was withdrawn
                continue
            found = self.fake.wait(
                self.page,
                lambda f, n=before: _count(f, command) > n or refused.count() > 0,  # type: ignore[misc]
            )
            if _count(found, command) > before:
                return
        raise AssertionError(f"{command} is not sent: {notice.text_content()}")

    def choose(self, group: str, value: str) -> None:
        """Selects a radio button, by its label."""
        choice = self.page.locator(f"input[name={group}][value='{value}']")
        for _ in range(5):
            self.page.locator("label", has=choice).click()
            if choice.is_checked():
                return
        raise AssertionError(f"{value} cannot be selected")

    def take_control(self) -> None:
        self.view("operate")
        self.send("take_control", "#take-control")
        expect(self.page.locator("#lamp-control")).to_have_text("You have control")

    def taught(self, *names: str) -> None:
        """The current pose is stored under each name."""
        for name in names:
            self.page.locator("#teach-name").fill(name)
            self.send("teach", "#teach")
            expect(self.page.locator("#poses li").last.locator("input")).to_have_value(name)

    def pick(self) -> None:
        """Clicks about the middle of the scene until a goal in the workspace is picked.

        A click before the first frame is drawn picks nothing, nor does one while data are stale.
        """
        bar, canvas = self.page.locator("#pick-bar"), self.page.locator("#scene-canvas")
        for k in range(100):
            if not bar.is_visible():
                self.page.locator("#pick").click()
            box = canvas.bounding_box()
            assert box
            share = (0.45, 0.5, 0.4, 0.55, 0.35)[k % 5]  # the middle may be outside at some heights
            canvas.click(position={"x": 0.5 * box["width"], "y": share * box["height"]})
            self.fake.let_pass(self.page, 2)
            if self.page.locator("#pick-text").inner_text().endswith(" mm"):
                return
        raise AssertionError("nothing is picked in the scene")

    def load(self, name: str = "plans/circle.json") -> None:
        self.view("operate")
        self.choose("plan-file", name)
        self.send("load_plan", "#load-plan")
        expect(self.page.locator("#plan-name")).to_have_text(name)

    def run(self) -> None:
        self.send("run", "#run", ".confirm")
        expect(self.page.locator("#motion-state")).to_contain_text("Moving")

    def ready_to_jog(self) -> None:
        self.take_control()
        self.view("jog")
        self.send("jog_begin", "#jog-begin")
        expect(self.page.locator("#jog-state")).to_contain_text("Ready")

    def ready_to_jog_cables(self) -> None:
        self.take_control()
        self.view("service")
        self.send("service_begin", "#service-begin", ".confirm")
        expect(self.page.locator("#lamp-control")).to_have_text("Service mode")
        self.send("cable_begin", "#cable-begin", ".confirm")
        expect(self.page.locator("#cable-state")).to_contain_text("Ready")

    def hold(self, name: str = "+x") -> int:
        """Presses a jog button by mouse; the number of the press."""
        self.move_to(f'[data-jog="{name}"]')
        mouse = self.page.mouse
        return int(self.press(mouse.down, mouse.up)["hold"])

    def hold_key(self, pad: str, key: str) -> dict[str, Any]:
        """Presses a key on a pad that is given the focus; a message of the press."""

        def down() -> None:
            self.page.locator(pad).focus()
            self.page.keyboard.down(key)

        return self.press(down, lambda: self.page.keyboard.up(key))

    def press(self, down: Callable[[], Any], up: Callable[[], Any]) -> dict[str, Any]:
        """Calls ``down``; a message of the press that it begins.

        A busy computer may hold the page up for so long that it refuses the press or ends it
        itself, as it must: where the page says so, it is forgotten, and after ``up`` pressed again.
        """
        for _ in range(5):
            first = self.fake.ask()
            down()
            found = self.fake.wait(self.page, lambda f, first=first: _pressed(f, first))  # type: ignore[misc]
            said = found["received"][len(first["received"]) :]
            if len(said) >= 2 and all(message["kind"] == "held" for message in said):
                one = said[-1]
                assert isinstance(one, dict)
                return one
            why = " ".join(self.page.locator("#jog-said, #cable-said").all_text_contents())
            assert self._was_stale() or "page was delayed" in why, f"{said}: {why}"
            up()
            self.fake.let_pass(self.page, 4)
            self.fake.ask(set={"received": first["received"]})
        raise AssertionError("the page is held up again and again")


def _pressed(found: dict[str, Any], before: dict[str, Any]) -> bool:
    """Whether two messages came since ``before``, or for so long not that they will not."""
    more = len(found["received"]) - len(before["received"])
    return more >= 2 or found["ticks"] >= before["ticks"] + 40


def _count(found: dict[str, Any], kind: str) -> int:
    """Messages of a kind, or commands of a name."""
    return sum(kind in (m["kind"], m.get("command")) for m in found["received"])


COLOUR = "role => getComputedStyle(document.documentElement).getPropertyValue(`--${role}`)"
NO_WEBGL = """const known = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
  return kind.startsWith("webgl") ? null : known.call(this, kind, ...more);
};"""


def painted(page: Page, role: str, clip: FloatRect | None = None) -> int:
    """Pixels of the scene, or of a part of the page, in about the colour of a role."""
    box = clip or page.locator("#scene-canvas").bounding_box()
    assert box
    shot = np.frombuffer(page.screenshot(clip=box), np.uint8)
    picture = cv2.imdecode(shot, cv2.IMREAD_COLOR)
    assert picture is not None
    red_green_blue = picture[:, :, ::-1].astype(int)
    colour = list(bytes.fromhex(page.evaluate(COLOUR, role).strip().lstrip("#")))
    return int((abs(red_green_blue - colour) < 30).all(axis=2).sum())


def chromium() -> str:
    """The path of the system's Chromium, best without a window's parts; skips without one."""
    for name in ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome"):
        if found := shutil.which(name):
            return found
    pytest.skip("NOT TESTED: the console's page needs a browser, and no Chromium is on PATH")


@contextlib.contextmanager
def browser_at(path: str, webgl: bool = True) -> Iterator[Browser]:
    with sync_playwright() as playwright:
        arguments = [*ARGUMENTS, *(WEBGL if webgl else ("--disable-gpu", "--disable-3d-apis"))]
        browser = playwright.chromium.launch(executable_path=path, args=arguments)
        yield browser
        browser.close()


@contextlib.contextmanager
def fake_server() -> Iterator[Fake]:
    """The fake server in a separate process."""
    command = [sys.executable, "-m", "tests.console.fake_server"]
    with tempfile.TemporaryFile("w+") as errors:
        server = subprocess.Popen(
            command, cwd=ROOT, stdout=subprocess.PIPE, stderr=errors, text=True
        )
        try:
            assert server.stdout
            address = server.stdout.readline().strip()
            errors.seek(0)
            assert address, errors.read()
            yield Fake(address)
        finally:
            server.terminate()
            server.wait(10)
            assert server.stdout
            server.stdout.close()


@contextlib.contextmanager
def visit(browser: Browser, fake: Fake, size: str = "desk", script: str = "") -> Iterator[Visit]:
    """A page at a server that is new; fails when the page logged an error.

    `script` runs before the page's own. Without one, a browser's next visit has the same page, with
    nothing left of this one: a new profile takes as long as most tests.
    """
    width, height = SIZES[size]
    fake.ask(renew=True)
    fake.silenced = False
    kept = _KEPT.setdefault(browser, {})
    touch = size != "desk"
    page = None if script else kept.pop(touch, None)
    if page is None:
        context = browser.new_context(has_touch=touch)
        context.add_init_script(script)
        page = context.new_page()
    page.set_viewport_size({"width": width, "height": height})
    page.emulate_media(color_scheme="light")
    found = Visit(page, fake)
    with contextlib.ExitStack() as whole:
        whole.callback(page.context.close)
        with _listening(found):
            page.goto(fake.address)
            expect(page.locator("#value-x")).to_contain_text(".")
            expect(page.locator("#layers label")).not_to_have_count(0)  # the scene is there
            page.evaluate("() => new Promise((done) => requestAnimationFrame(done))")
            page.evaluate(NOTE_STALE)
            yield found
        if not script:
            for button in ("left", "right"):
                page.mouse.up(button=button)  # else it is still pressed on the next page
            page.unroute_all()
            page.evaluate("() => sessionStorage.clear()")
            page.goto("about:blank")
            kept[touch] = page
            whole.pop_all()
    unexpected = [text for text in found.errors if "WebSocket" not in text]
    assert unexpected == [], unexpected


@contextlib.contextmanager
def _listening(to: Visit) -> Iterator[None]:
    """Collects a page's errors and requests."""

    def said(message: ConsoleMessage) -> None:
        if message.type == "error":
            to.errors.append(message.text)

    listeners: dict[Any, Callable[[Any], None]] = {
        "pageerror": lambda error: to.errors.append(str(error)),
        "console": said,
        "request": lambda request: to.asked.append(request.url),
    }
    for event, listener in listeners.items():
        to.page.on(event, listener)
    try:
        yield
    finally:
        for event, listener in listeners.items():
            to.page.remove_listener(event, listener)
