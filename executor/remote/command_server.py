"""Answers on the command sockets of a verb, from its start to the end of its motion.

Requests are answered in a separate thread. A verb takes them before it checks anything, on the
board that its motion reads later: a stop stays, and nothing moves after it. The sockets have a name
of their own until the motion opens its devices (`executor.remote.command_socket`), as only a stop
applies until then. A stop that was requested before the sockets were there is on record, and counts
since the start of the program.
"""

from __future__ import annotations

import os
import selectors
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from typing import Any

from executor.hold_to_run.presses import PressBoard
from executor.realtime.scheduling import (
    prompt_threads,
    require_imported_script,
    take_short_turns,
)
from executor.realtime.shared_memory import SharedRequests
from executor.remote.command_socket import advertised_ahead, is_stopped_since
from executor.remote.protocol import StatusSource, answer_to, status_answer
from executor.remote.status import NO_PATH, MotionStatus
from executor.supervision import LocalRequests, RequestBoard, Supervisor, ctrl_c_interrupts
from model.errors import CdprError, StoppedByOperator, require_child_processes, require_types
from model.rig import Rig

#: Largest length of a request, [bytes].
LONGEST_REQUEST = 1024
#: Largest number of connections; a further one replaces the oldest.
MOST_CLIENTS = 16


@contextmanager
def serving(
    listeners: Sequence[socket.socket],
    board: RequestBoard,
    status: StatusSource,
    presses: PressBoard | None = None,
    on_early_stop: Callable[[], None] | None = None,
) -> Iterator[CommandServer]:
    """Answers all requests on the sockets while the block runs.

    Args:
        listeners: Listening sockets, which the caller closes.
        status: Reported in answers.
        presses: Of a jog session; None for any other motion.
        on_early_stop: Of a motion that is still being prepared: called after each stop, until
            `CommandServer.answer_for`.
    """
    waker, woken = socket.socketpair()
    answers = _Answers(status, presses, on_early_stop)
    server = CommandServer(listeners, woken, board, answers)
    thread = threading.Thread(target=server.run, name="cdpr-commands", daemon=True)
    thread.start()
    try:
        with prompt_threads():
            yield server
    finally:
        waker.close()
        thread.join()
        woken.close()


@dataclass(frozen=True, slots=True)
class _Answers:
    """See `serving`."""

    status: StatusSource
    presses: PressBoard | None
    on_early_stop: Callable[[], None] | None = None

    def to(self, line: bytes, board: RequestBoard) -> bytes:
        if self.on_early_stop is None:
            return answer_to(line, board, self.status, self.presses)
        before = board.read().stop
        answer = answer_to(line, board, self.status, ahead=True)
        if board.read().stop and not before:
            self.on_early_stop()
        return answer


class CommandServer:
    """Answers requests; see `serving`."""

    def __init__(
        self,
        listeners: Sequence[socket.socket],
        woken: socket.socket,
        board: RequestBoard,
        answers: _Answers,
    ) -> None:
        self._board, self._woken, self._answers = board, woken, answers
        self._selector = selectors.DefaultSelector()
        self._selector.register(woken, selectors.EVENT_READ)
        self._partial: dict[socket.socket, bytes] = {}
        for listener in listeners:
            listener.setblocking(False)
            self._selector.register(listener, selectors.EVENT_READ, "listener")

    def answer_for(self, status: StatusSource, presses: PressBoard | None) -> None:
        """From now on answers for a motion, over the same connections; see `serving`."""
        self._answers = _Answers(status, presses)

    def run(self) -> None:
        """Serves until the other end of ``woken`` is closed.

        If the server fails, the run is stopped, as it could no longer be stopped from outside.
        """
        try:
            take_short_turns()
            while self._serve_ready():
                pass
            self._send_final_status()
        except BaseException:
            self._board.ask_stop()
            raise
        finally:
            for client in list(self._partial):
                self._drop(client)
            self._selector.close()

    def _send_final_status(self) -> None:
        """Sends the final status to all clients."""
        for client in self._partial:
            with suppress(OSError):  # disconnected, or does not read
                client.sendall(status_answer(self._answers.status))

    def _serve_ready(self) -> bool:
        """Waits for sockets that are ready, and serves them; False at the end."""
        ready = [(key.fileobj, key.data) for key, _ in self._selector.select()]
        for ready_socket, kind in ready:
            if ready_socket is self._woken:
                return False
            assert isinstance(ready_socket, socket.socket)
            if kind == "listener":
                self._accept(ready_socket)
            else:
                self._listen(ready_socket)
        return True

    def _accept(self, listener: socket.socket) -> None:
        try:
            client, _ = listener.accept()
        except OSError:  # disconnected
            return
        if not _is_ours(client):
            client.close()
            return
        if len(self._partial) >= MOST_CLIENTS:
            self._drop(next(iter(self._partial)))
        client.setblocking(False)  # a client that does not read must not block a stop by others
        self._partial[client] = b""
        self._selector.register(client, selectors.EVENT_READ, "client")

    def _listen(self, client: socket.socket) -> None:
        """Receives data and answers each complete line."""
        if client not in self._partial:  # dropped meanwhile
            return
        try:
            got = client.recv(LONGEST_REQUEST)
            *lines, rest = (self._partial[client] + got).split(b"\n")
            for line in lines:
                client.sendall(self._answers.to(line, self._board))
        except OSError:  # disconnected, or does not read
            got, rest = b"", b""
        if not got or len(rest) > LONGEST_REQUEST:
            self._drop(client)
        else:
            self._partial[client] = rest

    def _drop(self, client: socket.socket) -> None:
        del self._partial[client]
        self._selector.unregister(client)
        client.close()


def _is_ours(client: socket.socket) -> bool:
    """Whether the client is this user or root, in addition to the folder's permissions."""
    credentials = client.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    _, user, _ = struct.unpack("3i", credentials)
    return user in (os.getuid(), 0)


# A verb, from its start.


class PreparationStatus(MotionStatus):
    """Status of a verb whose motion is still being prepared."""

    def __init__(self, rig: Rig, board: LocalRequests | SharedRequests, verb: str) -> None:
        """Before its checks; ``verb`` is its name on the command line."""
        super().__init__(rig, board, simulated_time=False)
        self._verb = verb

    def _position_fields(self) -> dict[str, Any]:
        return {"verb": self._verb, "row": None, "rows": None, **NO_PATH}

    def _event_data(self) -> list[dict[str, Any]]:
        return []


class Commands:
    """Requests to a verb, from its start to the end of its motion.

    Attributes:
        board: Takes the requests; read by the motion.
        supervisor: Of the program; interrupted by a stop.
    """

    def __init__(
        self,
        supervisor: Supervisor,
        board: LocalRequests | SharedRequests,
        server: CommandServer,
        advertise: Callable[[], None],
        end: Callable[[], None],
    ) -> None:
        """Of a verb in preparation; see `commands_from_start`."""
        self.supervisor, self.board = supervisor, board
        self._server, self._advertise, self._end = server, advertise, end
        self.is_motion = False
        """Whether the motion has begun to open its devices."""

    def require_no_stop(self) -> None:
        """Requires that no stop was requested.

        Raises:
            StoppedByOperator: One was.
        """
        if self.board.read().stop:
            raise StoppedByOperator(
                "stopped before anything moved", next_step="run it again when ready"
            )

    @contextmanager
    def during_motion(
        self, status: MotionStatus, presses: PressBoard | None = None
    ) -> Iterator[None]:
        """From the opening of devices to the end of the motion, after which no request is taken.

        Args:
            status: Reported in answers; takes an error of the block.
            presses: Of a jog session; None for any other motion.

        Raises:
            StoppedByOperator: A stop was requested.
        """
        try:
            self.is_motion = True
            self._server.answer_for(status, presses)
            self._advertise()
            self.require_no_stop()
            yield
        except CdprError as error:
            status.take_error(error)
            raise
        finally:
            self._end()


@contextmanager
def commands_from_start(
    verb: str, rig: Rig, supervisor: Supervisor | None, *, realtime: bool
) -> Iterator[Commands]:
    """Takes requests for a verb before it checks anything.

    Args:
        verb: Its name on the command line.
        rig: The robot and its bus.
        supervisor: Of the program; None for what signal handlers raise.
        realtime: Whether the motion has a process of its own, which shares the board.

    Raises:
        Refused: No stop would reach the verb.
        StoppedByOperator: A stop was requested before the motion.
        BadInput: The motion needs a process of its own, which this one cannot start.
        SystemExit: This process still imports the script of another, which lacks the guard.
    """
    require_types(optional=[(supervisor, Supervisor)])
    require_imported_script()
    if realtime:
        require_child_processes("drives in real time")
    began, operator = time.clock_gettime(time.CLOCK_BOOTTIME), supervisor or Supervisor()
    board: LocalRequests | SharedRequests = SharedRequests() if realtime else LocalRequests()
    with ctrl_c_interrupts(), ExitStack() as outer:
        if isinstance(board, SharedRequests):
            outer.callback(board.close)
        stack = outer.enter_context(ExitStack())
        sockets = stack.enter_context(advertised_ahead())
        status = PreparationStatus(rig, board, verb)
        server = stack.enter_context(
            serving(sockets.listeners, board, status, on_early_stop=operator.on_early_stop)
        )
        commands = Commands(operator, board, server, sockets.advertise, stack.close)
        if is_stopped_since(operator.began or began):
            board.ask_stop()
        try:
            commands.require_no_stop()
            yield commands
        except KeyboardInterrupt:
            if not commands.is_motion:
                commands.require_no_stop()
            raise
