"""Answers on the command socket of a run, in a thread of its own: in every phase of the run."""

from __future__ import annotations

import contextlib
import os
import selectors
import socket
import struct
import threading
from collections.abc import Iterator, Sequence

from executor.remote.protocol import Presses, Told, answer_to, word_of
from executor.supervision import RequestBoard

#: A question is a line no longer than this, [bytes].
LONGEST_QUESTION = 1024
#: Connections at a time; a further one takes the place of the oldest.
MOST_CLIENTS = 16


@contextlib.contextmanager
def serving(
    listeners: Sequence[socket.socket],
    board: RequestBoard,
    status: Told,
    presses: Presses | None = None,
) -> Iterator[None]:
    """Answers every question on the sockets while the block runs.

    Args:
        listeners: Listening; they stay the caller's.
        board: Where wishes are put up.
        status: What is reported.
        presses: Of a session of jogs; None for any other motion.
    """
    waker, woken = socket.socketpair()
    server = _Server(listeners, woken, board, status, presses)
    thread = threading.Thread(target=server.run, name="cdpr-commands", daemon=True)
    thread.start()
    try:
        yield
    finally:
        waker.close()
        thread.join()
        woken.close()


class _Server:
    def __init__(
        self,
        listeners: Sequence[socket.socket],
        woken: socket.socket,
        board: RequestBoard,
        status: Told,
        presses: Presses | None,
    ) -> None:
        self._board, self._status, self._woken = board, status, woken
        self._presses = presses
        self._selector = selectors.DefaultSelector()
        self._selector.register(woken, selectors.EVENT_READ)
        self._begun: dict[socket.socket, bytes] = {}
        for listener in listeners:
            listener.setblocking(False)
            self._selector.register(listener, selectors.EVENT_READ, "listener")

    def run(self) -> None:
        """Until the other end of ``woken`` is closed.

        A run that could not be stopped from elsewhere any more is stopped.
        """
        try:
            while self._serve_the_ready():
                pass
            self._say_the_last_word()
        except BaseException:
            self._board.ask_stop()
            raise
        finally:
            for client in list(self._begun):
                self._let_go(client)
            self._selector.close()

    def _say_the_last_word(self) -> None:
        """How the run ended, to those who watch it and may have looked just before."""
        for client in self._begun:
            with contextlib.suppress(OSError):  # it went away, or does not read
                client.sendall(word_of(self._status))

    def _serve_the_ready(self) -> bool:
        """Waits for those that want something, and serves them; False when all is over."""
        ready = [(key.fileobj, key.data) for key, _ in self._selector.select()]
        for place, kind in ready:
            if place is self._woken:
                return False
            assert isinstance(place, socket.socket)
            if kind == "listener":
                self._welcome(place)
            else:
                self._listen(place)
        return True

    def _welcome(self, listener: socket.socket) -> None:
        try:
            client, _ = listener.accept()
        except OSError:  # it went away again
            return
        if not _is_ours(client):
            client.close()
            return
        if len(self._begun) >= MOST_CLIENTS:
            self._let_go(next(iter(self._begun)))
        client.setblocking(False)  # who does not take an answer must not keep others from a stop
        self._begun[client] = b""
        self._selector.register(client, selectors.EVENT_READ, "client")

    def _listen(self, client: socket.socket) -> None:
        """Takes what there is; answers each whole line."""
        if client not in self._begun:  # it was let go meanwhile
            return
        try:
            got = client.recv(LONGEST_QUESTION)
            *lines, rest = (self._begun[client] + got).split(b"\n")
            for line in lines:
                client.sendall(answer_to(line, self._board, self._status, self._presses))
        except OSError:  # it went away, or does not read
            got, rest = b"", b""
        if not got or len(rest) > LONGEST_QUESTION:
            self._let_go(client)
        else:
            self._begun[client] = rest

    def _let_go(self, client: socket.socket) -> None:
        del self._begun[client]
        self._selector.unregister(client)
        client.close()


def _is_ours(client: socket.socket) -> bool:
    """The folder admits no other user; the system confirms who it is."""
    credentials = client.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    _, user, _ = struct.unpack("3i", credentials)
    return user in (os.getuid(), 0)
