"""A million hostile requests and messages to the console's server while a robot can be jogged.

    python benchmarks/console_abuse.py [--messages 1000000]

The server is `cdpr console` in its own process, with simulated drives over UDP in real time; an
operator's page has control and has enabled the drives for jogging. One in ten is an HTTP request:
no token, a wrong one, another origin, another host, paths outside the folder, garbage, oversized
headers. The others arrive on sockets of pages without control: broken JSON, wrong types, values out
of range, oversized, binary or deeply nested messages, commands, and replayed messages of the
operator's page. Nothing may move or start, and the server's memory, threads and descriptors must
not grow. Prints the figures; exit code 1 if anything was wrong. It takes half an hour or more.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import sys
import time
from collections import Counter
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from alone import alone
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tests.cli.plans import RIG  # noqa: E402
from tests.console.cut import acknowledgement  # noqa: E402
from tests.scenarios.test_console import Busy, Operator, console, drives, operator  # noqa: E402

#: Messages that are sent before their answers are read; sockets and connections at a time.
BATCH, SOCKETS, CONNECTIONS = 40, 6, 4
#: A command that was not answered within this is sent again, [s].
ANSWERED_WITHIN_S = 0.5
#: Longer than a million messages take, [s].
ENDS_WITHIN_S = 4 * 3600.0
COMMANDS = (
    *("hold", "resume", "home", "reset", "release", "run", "jog_begin", "jog_end"),
    *("take_control", "load_plan", "compare", "plan", "speed", "teach", "teach_at", "rename"),
)


class Attack:
    """Hostile messages and requests, and counts of the answers."""

    def __init__(self, address: str, heard: list[str], seed: int) -> None:
        """Attacks an address with its token; ``heard`` has messages of the page in control."""
        self.host, _, self.token = address.removeprefix("http://").partition("/?token=")
        self._heard, self._random = heard, random.Random(seed)
        self._marks = 1000  # numbers of commands of its own
        self.sent: Counter[str] = Counter()
        self.answers: Counter[str] = Counter()

    def message(self) -> tuple[str, str | bytes]:
        """A random kind and content."""
        pick = self._random.random()
        if pick < 0.0005:
            return "too long", "x" * 5000
        if pick < 0.001:
            return "binary", self._random.randbytes(200)
        if pick < 0.2:
            return "replayed", self._random.choice(self._heard)
        if pick < 0.4:
            return "not in control", json.dumps(self._command())
        if pick < 0.6:
            return "out of range", json.dumps(self._held(1e9 * (self._random.random() - 0.5)))
        if pick < 0.8:
            text = json.dumps(self._held(1.0))
            at = self._random.randrange(len(text))
            return "broken", text[:at] + self._random.choice('{}[]",:\\\0é9') + text[at + 1 :]
        if pick < 0.9:
            return "deep", "[" * self._random.randrange(1, 1500)
        return "other JSON", json.dumps(self._random.choice([None, 1, "x", [], {}, {"kind": 1}]))

    def _command(self) -> dict[str, Any]:
        more = {"file": "../../etc/passwd", "percent": 10**6, "pose": "\0", "to": 2**70, "name": ""}
        extra = {k: v for k, v in more.items() if self._random.random() < 0.3}
        return {"kind": "command", "id": 1, "command": self._random.choice(COMMANDS), **extra}

    def _held(self, value: float) -> dict[str, Any]:
        said: dict[str, Any] = {
            "kind": "held", "hold": 1, "direction": [0.0, 0.0, 1.0], "frame": "world",
            "step_mm": None, "speed_mm_s": 5.0, "seq": 1, "state": 1,
        }  # fmt: skip
        key = self._random.choice(["hold", "direction", "frame", "step_mm", "speed_mm_s"])
        said[key] = [value] * 3 if key == "direction" else value
        return said

    async def sockets(self, count: int) -> None:
        """Sends messages from a page without control."""
        left = count
        while left > 0:
            with suppress(ConnectionClosed, InvalidHandshake, OSError):
                async with self._page() as page:
                    while left > 0:
                        left -= await self._batch(page, min(BATCH, left))

    def _page(self) -> connect:
        address = f"ws://{self.host}/ws?token={self.token}"
        origin: Any = f"http://{self.host}"
        return connect(address, origin=origin, max_queue=256)

    async def _batch(self, page: ClientConnection, size: int) -> int:
        """Sends a batch and reads the answers; returns the number sent."""
        for k in range(size):
            kind, text = self.message()
            self.sent[kind] += 1
            await page.send(text)
            if kind in ("too long", "binary"):  # this ends the socket
                await page.wait_closed()
                return k + 1
        await self._catch_up(page)
        return size

    async def _catch_up(self, page: ClientConnection) -> None:
        """Reads until the server has answered a last command: it drops refusals in a flood."""
        self._marks += 1
        mark = {"kind": "command", "id": self._marks, "command": "hold"}
        while True:
            await page.send(json.dumps(mark))
            again = time.monotonic() + ANSWERED_WITHIN_S
            while time.monotonic() < again:
                said = json.loads(await page.recv())
                if said["kind"] != "answer":
                    await page.send(acknowledgement(said))
                    continue
                self.answers["done" if said["ok"] else "refused"] += 1
                if said["to"] == mark["id"]:
                    return

    async def requests(self, count: int) -> None:
        """Sends HTTP requests."""
        left = count
        while left > 0:
            with suppress(OSError, asyncio.IncompleteReadError, ValueError):
                host, _, port = self.host.rpartition(":")
                reader, writer = await asyncio.open_connection(host, int(port))
                try:
                    while left > 0:
                        left -= 1
                        await self._request(reader, writer)
                finally:
                    writer.close()

    async def _request(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        kind, request = self.request()
        self.sent[f"HTTP {kind}"] += 1
        writer.write(request)
        head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), 30)
        status = head.split(b" ", 2)[1].decode()
        self.answers[f"HTTP {status}"] += 1
        length = [
            line for line in head.split(b"\r\n") if line.lower().startswith(b"content-length")
        ]
        if length:
            await reader.readexactly(int(length[0].split(b":")[1]))
        if b"connection: close" in head.lower() or not length:
            raise ConnectionError

    def request(self) -> tuple[str, bytes]:
        """A random kind and content."""
        path = self._random.choice(["/", "/scene", "/api/files", "/runs/x", "/camera/x", "/ws"])
        token = f"?token={self.token}"
        kinds = {
            "no token": (path, self.host, ""),
            "wrong token": (f"{path}?token={self._random.random()}", self.host, ""),
            "other origin": (path + token, self.host, "Origin: http://evil.example\r\n"),
            "other host": (path + token, "evil.example:80", "Origin: http://evil.example:80\r\n"),
            "outside": (f"/runs/../../{path}%2e%2e/passwd{token}", self.host, ""),
            "long head": (path, self.host, f"X: {'y' * 70_000}\r\n"),
        }
        kind = self._random.choice([*kinds, "garbage"])
        if kind == "garbage":
            return kind, self._random.randbytes(60) + b"\r\n\r\n"
        if kind == "long head" and self._random.random() < 0.98:
            kind = "no token"
        where, host, more = kinds[kind]
        verb = self._random.choice(["GET", "POST", "PUT", "DELETE", "OPTIONS"])
        return kind, f"{verb} {where} HTTP/1.1\r\nHost: {host}\r\n{more}\r\n".encode()


class Watched:
    """Resource use of the server's process."""

    def __init__(self, process: int) -> None:
        """Takes a first sample."""
        self._process = Path(f"/proc/{process}")
        self.samples = [self._sample()]

    def _sample(self) -> tuple[float, int, int]:
        """Memory [MB], threads, descriptors."""
        lines = (self._process / "status").read_text().splitlines()
        values = dict(line.split(":", 1) for line in lines)
        memory = int(values["VmRSS"].split()[0]) / 1024.0
        return memory, int(values["Threads"]), len(os.listdir(self._process / "fd"))

    async def sample(self, every: float) -> None:
        """Samples periodically."""
        while True:
            await asyncio.sleep(every)
            self.samples.append(self._sample())


class Holder:
    """A page that has control and holds nothing; nothing may move meanwhile.

    A fault is latched where the computer is too busy for a cycle; it is reset.
    """

    def __init__(self, address: str) -> None:
        """Starts unconnected."""
        self.host, _, self.token = address.removeprefix("http://").partition("/?token=")
        self.wrong: list[str] = []
        self.states = self.moments = self.latched = 0
        self._targets: dict[int, list[int]] = {}

    async def watch(self) -> None:
        """Takes control and monitors; starts a session again when it ends without a press."""
        origin: Any = f"http://{self.host}"
        address = f"ws://{self.host}/ws?token={self.token}"
        async with connect(address, origin=origin, max_queue=256) as page:
            await self._say(page, "take_control")
            while True:
                said = json.loads(await page.recv())
                if said["kind"] == "state":
                    await page.send(acknowledgement(said))
                    await self._check(page, said)

    async def _check(self, page: ClientConnection, state: dict[str, Any]) -> None:
        self.states += 1
        if (state["busy"] or {"verb": "jog"})["verb"] not in ("jog", "reset"):
            self.wrong.append(f"`cdpr {state['busy']['verb']}` was started")
        motion = state["motion"]
        if motion is None:
            if state["busy"] is None and self.states % 40 == 0:
                self.latched += state["latched"] is not None
                await self._say(page, "reset" if state["latched"] else "jog_begin")
            return
        if motion["state"] != "moving":
            return
        self.moments += 1
        targets = [drive["set_counts"] for drive in motion["drives"]]
        before = self._targets.setdefault(motion["process"], targets)
        if targets != before and len(self.wrong) < 9:
            self.wrong.append(f"set-points moved: {before} to {targets}")

    async def _say(self, page: ClientConnection, command: str) -> None:
        await page.send(json.dumps({"kind": "command", "id": 1, "command": command}))


async def attacked(attack: Attack, count: int, watched: Watched, holder: Holder) -> None:
    """The whole attack; memory must not grow after the first eighth."""
    looking = asyncio.create_task(watched.sample(5.0))
    holding = asyncio.create_task(holder.watch())
    attacking = asyncio.create_task(_attack_in_two_parts(attack, count, watched, holder))
    await asyncio.wait({attacking, looking, holding}, return_when=asyncio.FIRST_COMPLETED)
    if holding.done():
        holder.wrong.append(f"the page in control was lost: {holding.exception()}")
    if looking.done():
        holder.wrong.append(f"the server ended: {looking.exception()}")
    elif attacking.done():
        attacking.result()
    for task in (attacking, looking, holding):
        task.cancel()


async def _attack_in_two_parts(
    attack: Attack, count: int, watched: Watched, holder: Holder
) -> None:
    while not holder.moments:
        await asyncio.sleep(0.1)
    for part in (count // 8, count - count // 8):
        web = part // 10
        each, pages = web // CONNECTIONS, (part - web) // SOCKETS
        rest = [attack.requests(each) for _ in range(CONNECTIONS)]
        await asyncio.gather(*rest, *(attack.sockets(pages) for _ in range(SOCKETS)))
        watched.samples.append(watched._sample())
        if part == count // 8:
            watched.samples = watched.samples[-1:]


def enabled(me: Operator) -> list[str]:
    """Enables the drives and jogs briefly; returns the page's messages."""
    heard: list[str] = []
    send = me._page.send
    me._page.send = lambda text: (heard.append(text), send(text))[1]  # type: ignore[method-assign]
    assert me.command("jog_begin")["ok"]
    me.until(lambda state: state["jog"]["ready"])
    me.jog(2, 2.0)
    me._page.send = send  # type: ignore[method-assign]
    # STOP is accepted from every page, so it is not an attack.
    return [text for text in heard if "held" in text or "let_go" in text]


def main() -> int:
    """Prints the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--messages", type=int, default=1_000_000)
    options = parser.parse_args()
    wrong = []
    with ExitStack() as stack:
        stack.enter_context(alone())
        bus = stack.enter_context(drives(RIG, 7, within=ENDS_WITHIN_S))
        process, address = stack.enter_context(console(RIG, bus, within=ENDS_WITHIN_S))
        with operator(address) as me:
            attack = Attack(address, enabled(me), 1)
        watched, holder, began = Watched(process.pid), Holder(address), time.monotonic()
        asyncio.run(attacked(attack, options.messages, watched, holder))
        seconds = time.monotonic() - began
        wrong += holder.wrong
        if process.poll() is not None:
            wrong.append("the server ended")
        else:
            try:
                with operator(address) as me:
                    me.command("stop")
                    me.until(lambda state: state["busy"] is None)
            except Busy:  # latched
                holder.latched += 1
            except (TimeoutError, OSError, InvalidHandshake) as error:
                wrong.append(f"the server does not answer: {error}")
                process.kill()
    total = sum(attack.sent.values())
    print(f"{total} in {seconds:.0f} s: {dict(sorted(attack.sent.items()))}")
    print(f"the drives were at rest in all of {holder.moments} states with a session enabled")
    print(f"latched {holder.latched} times, as the computer was too busy for a cycle")
    print(f"answered: {dict(sorted(attack.answers.items()))}")
    first, last = watched.samples[0], watched.samples[-1]
    for name, a, b in zip(("memory [MB]", "threads", "descriptors"), first, last, strict=True):
        print(f"{name:12} {a:.0f} after an eighth, {b:.0f} at the end")
    print(f"memory between {min(watched.samples)[0]:.1f} and {max(watched.samples)[0]:.1f} MB")
    wrong += [] if last[0] < 1.1 * first[0] + 5.0 else ["memory grew"]
    wrong += [] if last[2] <= first[2] + 8 else ["descriptors are left"]
    wrong += [] if not attack.answers["done"] else [f"{attack.answers['done']} were obeyed"]
    print("\n".join(["wrong: nothing"] if not wrong else ["wrong:", *wrong]))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
