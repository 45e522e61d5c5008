"""The command socket of a run, for `cdpr stop` and similar verbs from any terminal.

A run listens on a socket named after its process in the user's run-time folders: ``123.sock``, and
``123-2.sock`` for a second one of the same process. A socket without a listening process was left
by one that ended. It is advertised in every folder that another
terminal may search, and only in folders that no other user can write to: a folder in /tmp of
another user could contain links to this user's files, or sockets of other users. Root reaches the
runs of all users, each in a folder private to that user.

Requests are answered in a separate thread, in every phase of the run.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import selectors
import socket
import stat
import struct
import tempfile
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from executor.realtime.scheduling import prompt_threads, take_short_turns
from executor.remote.protocol import Presses, StatusSource, answer_to, status_answer
from executor.supervision import RequestBoard
from model.errors import Refused

_ENDING = ".sock"
_NAME = re.compile(r"([0-9]+)(-[0-9]+)?\.sock")

#: Names of this process's sockets: several threads may each run a robot.
_named: set[str] = set()
_naming = threading.Lock()


@dataclass(frozen=True, slots=True)
class _Folder:
    """An open folder that only one user can write to."""

    descriptor: int
    owner: int


def _own_folders() -> list[Path]:
    """The user's run-time folder, if the system has one, and one in the temporary folder."""
    base = os.environ.get("XDG_RUNTIME_DIR")
    folders = [Path(base) / "cdpr"] if base else []
    return [*folders, Path(tempfile.gettempdir()) / f"cdpr-{os.getuid()}"]


def _reachable_folders() -> list[Path]:
    """Folders to search for runs; for root those of all users."""
    own = _own_folders()
    if os.getuid() != 0:
        return own
    others = [*Path("/run/user").glob("*/cdpr"), *Path(tempfile.gettempdir()).glob("cdpr-*")]
    return [*own, *sorted(path for path in others if path not in own)]


def _open_private(path: Path) -> _Folder | None:
    """Opens a folder private to its owner: this user, or any user for root."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:  # missing, a link, or not readable
        return None
    status = os.fstat(descriptor)
    is_ours = os.getuid() in (0, status.st_uid)
    if not is_ours or stat.S_IMODE(status.st_mode) & 0o077:
        os.close(descriptor)
        return None
    return _Folder(descriptor, status.st_uid)


@contextlib.contextmanager
def _open_folders(paths: Sequence[Path]) -> Iterator[list[_Folder]]:
    """Opens all usable ones of these folders."""
    opened = [folder for path in paths if (folder := _open_private(path)) is not None]
    try:
        yield opened
    finally:
        for folder in opened:
            os.close(folder.descriptor)


@contextlib.contextmanager
def advertised() -> Iterator[list[socket.socket]]:
    """Listens in every usable folder while the block runs.

    Yields:
        The listening sockets, one per folder.

    Raises:
        Refused: No folder is writable only by this user.
    """
    paths = _own_folders()
    for path in paths:
        with contextlib.suppress(OSError):  # exists, or its parent is read-only
            path.mkdir(mode=0o700)
    with _open_folders(paths) as opened, contextlib.ExitStack() as stack:
        folders = [folder.descriptor for folder in opened if folder.owner == os.getuid()]
        if not folders:
            raise Refused(
                "`cdpr stop` would not reach this run",
                where=" or ".join(map(str, paths)),
                why="no such folder belongs to this user alone; another user may have created it",
                next_step="remove it or restrict it (chmod 700), or set XDG_RUNTIME_DIR",
            )
        name = stack.enter_context(_own_name())
        listeners = []
        for folder in folders:
            listeners.append(stack.enter_context(_listen_in(folder, name)))
            stack.callback(_try_remove, folder, name)
        yield listeners


@contextlib.contextmanager
def _own_name() -> Iterator[str]:
    """A name that no other run of this process has while the block runs."""
    numbers = ("" if k == 1 else f"-{k}" for k in itertools.count(1))
    with _naming:
        names = (f"{os.getpid()}{number}{_ENDING}" for number in numbers)
        name = next(name for name in names if name not in _named)
        _named.add(name)
    try:
        yield name
    finally:
        _named.discard(name)


def _listen_in(folder: int, name: str) -> socket.socket:
    """A socket in a folder that is listening as soon as its name appears."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        os.fchmod(listener.fileno(), 0o600)
        _remove(folder, name + ".new")
        listener.bind(_path_in(folder, name + ".new"))
        listener.listen()
        os.rename(name + ".new", name, src_dir_fd=folder, dst_dir_fd=folder)
    except BaseException:
        listener.close()
        raise
    return listener


def _path_in(folder: int, name: str) -> str:
    """A path into an open folder: short enough for a socket, and bound to that folder."""
    return f"/proc/self/fd/{folder}/{name}"


def _remove(folder: int, name: str) -> None:
    with contextlib.suppress(FileNotFoundError):
        os.unlink(name, dir_fd=folder)


def _try_remove(folder: int, name: str) -> None:
    """Removes a socket if possible; one left by an ended run is never connected to."""
    with contextlib.suppress(OSError):
        os.unlink(name, dir_fd=folder)


@dataclass(frozen=True, slots=True)
class RunConnection:
    """A connection to a run.

    Attributes:
        process: Its process ID.
        link: The socket; the owner closes it.
        is_connected: False for a run that accepts no connections, as it is suspended or hangs.
    """

    process: int
    link: socket.socket
    is_connected: bool = True


@contextlib.contextmanager
def find_runs() -> Iterator[list[RunConnection]]:
    """Connects to all active runs, in order of their process IDs; a process may have several.

    Runs of this user; for root of all users.
    """
    runs: dict[tuple[int, str], RunConnection] = {}
    with contextlib.ExitStack() as links:
        with _open_folders(_reachable_folders()) as folders:
            for folder in folders:
                names = os.listdir(folder.descriptor)
                for name in sorted(n for n in names if _NAME.fullmatch(n)):
                    run = _connect(folder.descriptor, name, folder.owner)
                    if run is None:
                        continue
                    links.callback(run.link.close)
                    runs.setdefault((run.process, name), run)
        yield [runs[key] for key in sorted(runs)]


def _connect(folder: int, name: str, owner: int) -> RunConnection | None:
    """Connects to the folder owner's run at a socket; removes a socket without a listener."""
    with contextlib.suppress(FileNotFoundError):
        if not stat.S_ISSOCK(os.stat(name, dir_fd=folder, follow_symlinks=False).st_mode):
            return None
    link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    link.setblocking(False)  # else it waits for a suspended run with many waiting clients
    try:
        link.connect(_path_in(folder, name))
    except ConnectionRefusedError:
        link.close()
        _remove(folder, name)
        return None
    except BlockingIOError:
        return RunConnection(
            int(name.removesuffix(_ENDING).partition("-")[0]), link, is_connected=False
        )
    except OSError:  # gone
        link.close()
        return None
    credentials = link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    process, user, _ = struct.unpack("3i", credentials)
    if user != owner:
        link.close()
        return None
    return RunConnection(process, link)


# Server of the command socket, in a separate thread.


#: Largest length of a request, [bytes].
LONGEST_REQUEST = 1024
#: Largest number of connections; a further one replaces the oldest.
MOST_CLIENTS = 16


@contextlib.contextmanager
def serving(
    listeners: Sequence[socket.socket],
    board: RequestBoard,
    status: StatusSource,
    presses: Presses | None = None,
) -> Iterator[None]:
    """Answers all requests on the sockets while the block runs.

    Args:
        listeners: Listening sockets, which the caller closes.
        board: Takes operator requests.
        status: Reported in answers.
        presses: Of a jog session; None for any other motion.
    """
    waker, woken = socket.socketpair()
    server = _Server(listeners, woken, board, status, presses)
    thread = threading.Thread(target=server.run, name="cdpr-commands", daemon=True)
    thread.start()
    try:
        with prompt_threads():
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
        status: StatusSource,
        presses: Presses | None,
    ) -> None:
        self._board, self._status, self._woken = board, status, woken
        self._presses = presses
        self._selector = selectors.DefaultSelector()
        self._selector.register(woken, selectors.EVENT_READ)
        self._partial: dict[socket.socket, bytes] = {}
        for listener in listeners:
            listener.setblocking(False)
            self._selector.register(listener, selectors.EVENT_READ, "listener")

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
            with contextlib.suppress(OSError):  # disconnected, or does not read
                client.sendall(status_answer(self._status))

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
                client.sendall(answer_to(line, self._board, self._status, self._presses))
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
