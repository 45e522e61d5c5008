"""Connections: a page's, without a browser, and a TCP proxy that can go silent or cut it."""

from __future__ import annotations

import json
import selectors
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import TracebackType
from typing import Any

from websockets.sync.client import ClientConnection

_CHUNK = 65536


def acknowledgement(state: dict[str, Any], at_ms: float = 0.0) -> str:
    """What a page sends when a state has reached it: else the server sends no further one."""
    return json.dumps({"kind": "seen", "seq": state["seq"], "at_ms": at_ms})


def receive(page: ClientConnection, timeout: float = 60.0) -> dict[str, Any]:
    """The next message; a state is acknowledged."""
    message = json.loads(page.recv(timeout=timeout))
    assert isinstance(message, dict)
    if message["kind"] == "state":
        page.send(acknowledgement(message))
    return message


class CutConnection:
    """Forwards the data of both sides until paused; a context manager.

    Attributes:
        port: Of this side of it, on the loopback.
    """

    def __init__(self, to: int) -> None:
        """A proxy for a local port."""
        self._to = to
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._waker, self._woken = socket.socketpair()
        self._passing = threading.Event()
        self._passing.set()
        self._hang_up = threading.Event()
        self._other: dict[socket.socket, socket.socket] = {}
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> CutConnection:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._waker.close()
        self._thread.join()
        self._woken.close()
        self._listener.close()

    @contextmanager
    def silent(self) -> Iterator[None]:
        """Forwards nothing and reports nothing, like an unplugged cable."""
        self.pause()
        try:
            yield
        finally:
            self.resume()

    def pause(self) -> None:
        """Stops forwarding."""
        self._passing.clear()

    def resume(self) -> None:
        """Forwards what waited, and continues."""
        self._passing.set()

    def hang_up(self) -> None:
        """Closes both connections."""
        self._hang_up.set()
        self._waker.send(b".")

    def _run(self) -> None:
        with selectors.DefaultSelector() as ready:
            self._ready = ready
            for one in (self._listener, self._woken):
                ready.register(one, selectors.EVENT_READ)
            while self._serve([key.fileobj for key, _ in ready.select(0.02)]):
                pass
            for one in list(self._other):
                self._close(one)

    def _serve(self, ends: list[object]) -> bool:
        for end in ends:
            assert isinstance(end, socket.socket)
            if end is self._woken:
                if not end.recv(_CHUNK):
                    return False
                if self._hang_up.is_set():
                    self._hang_up.clear()
                    for one in list(self._other):
                        self._close(one)
            elif end is self._listener:
                self._join(end)
            elif self._passing.is_set() and end in self._other:
                self._pass_on(end)
        if not self._passing.is_set():
            self._passing.wait(0.02)
        return True

    def _join(self, listener: socket.socket) -> None:
        here, _ = listener.accept()
        try:
            there = socket.create_connection(("127.0.0.1", self._to))
        except OSError:
            here.close()
            return
        for one, other in ((here, there), (there, here)):
            self._other[one] = other
            self._ready.register(one, selectors.EVENT_READ)

    def _pass_on(self, end: socket.socket) -> None:
        try:
            got = end.recv(_CHUNK)
            self._other[end].sendall(got)
        except OSError:
            got = b""
        if not got:
            self._close(end)

    def _close(self, end: socket.socket) -> None:
        for one in (end, self._other.get(end)):
            if one is not None and one in self._other:
                del self._other[one]
                with suppress(KeyError):
                    self._ready.unregister(one)
                one.close()
