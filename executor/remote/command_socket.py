"""The command socket of a run: found by `cdpr stop` and its like from any terminal, and answered.

A run listens on a socket named after its process in the user's run-time folders; a socket on which
no process listens was left by one that ended. It is advertised in every folder that another
terminal may look into, and only in folders that no other user can write to: a folder in /tmp that
another user made could hold links to this user's files, or sockets of somebody else. Root reaches
the runs of all users, each in a folder that is that user's alone.

Questions are answered in a thread of its own, in every phase of the run.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import socket
import stat
import struct
import tempfile
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from executor.remote.protocol import Presses, Told, answer_to, word_of
from executor.supervision import RequestBoard
from model.errors import Refused

_ENDING = ".sock"


@dataclass(frozen=True, slots=True)
class _Folder:
    """An open folder that only one user can write to."""

    descriptor: int
    owner: int


def _own_places() -> list[Path]:
    """The user's run-time folder, where the system has one, and one below the temporary folder."""
    base = os.environ.get("XDG_RUNTIME_DIR")
    folders = [Path(base) / "cdpr"] if base else []
    return [*folders, Path(tempfile.gettempdir()) / f"cdpr-{os.getuid()}"]


def _reached_places() -> list[Path]:
    """Where runs are looked for: root, who may stop whatever runs here, looks at all users'."""
    own = _own_places()
    if os.getuid() != 0:
        return own
    others = [*Path("/run/user").glob("*/cdpr"), *Path(tempfile.gettempdir()).glob("cdpr-*")]
    return [*own, *sorted(path for path in others if path not in own)]


def _opened(path: Path) -> _Folder | None:
    """The folder if it is there and closed to all but its owner: this user, or for root anybody."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:  # not there, a link, or not ours to read
        return None
    status = os.fstat(descriptor)
    is_ours = os.getuid() in (0, status.st_uid)
    if not is_ours or stat.S_IMODE(status.st_mode) & 0o077:
        os.close(descriptor)
        return None
    return _Folder(descriptor, status.st_uid)


@contextlib.contextmanager
def _open_folders(paths: Sequence[Path]) -> Iterator[list[_Folder]]:
    """All usable ones of these folders."""
    opened = [folder for path in paths if (folder := _opened(path)) is not None]
    try:
        yield opened
    finally:
        for folder in opened:
            os.close(folder.descriptor)


@contextlib.contextmanager
def advertised() -> Iterator[list[socket.socket]]:
    """Listens for the operator for as long as the block runs, in every usable folder.

    Yields:
        The listening sockets, one a folder.

    Raises:
        Refused: There is no folder for it that only this user can write to.
    """
    places = _own_places()
    for place in places:
        with contextlib.suppress(OSError):  # there already, or its parent is read-only
            place.mkdir(mode=0o700)
    with _open_folders(places) as opened, contextlib.ExitStack() as stop_events:
        folders = [folder.descriptor for folder in opened if folder.owner == os.getuid()]
        if not folders:
            raise Refused(
                "`cdpr stop` would not reach this run",
                where=" or ".join(map(str, places)),
                why="no such folder belongs to this user alone; another user may have created it",
                next_step="remove it or restrict it (chmod 700), or set XDG_RUNTIME_DIR",
            )
        name = f"{os.getpid()}{_ENDING}"
        listeners = []
        for folder in folders:
            listeners.append(stop_events.enter_context(_listening(folder, name)))
            stop_events.callback(_left, folder, name)
        yield listeners


def _listening(folder: int, name: str) -> socket.socket:
    """A socket that listens under a name of the folder, from the moment the name is there on."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        os.fchmod(listener.fileno(), 0o600)
        _removed(folder, name + ".new")
        listener.bind(_place(folder, name + ".new"))
        listener.listen()
        os.rename(name + ".new", name, src_dir_fd=folder, dst_dir_fd=folder)
    except BaseException:
        listener.close()
        raise
    return listener


def _place(folder: int, name: str) -> str:
    """A path to what is in an open folder; short enough for a socket, and of that very folder."""
    return f"/proc/self/fd/{folder}/{name}"


def _removed(folder: int, name: str) -> None:
    with contextlib.suppress(FileNotFoundError):
        os.unlink(name, dir_fd=folder)


def _left(folder: int, name: str) -> None:
    """What cannot be removed is left: a socket of a run that ended is not connected to."""
    with contextlib.suppress(OSError):
        os.unlink(name, dir_fd=folder)


@dataclass(frozen=True, slots=True)
class Reached:
    """A run that listens.

    Attributes:
        process: Its number.
        link: Connected to it; the owner closes it.
    """

    process: int
    link: socket.socket


@contextlib.contextmanager
def find_runs() -> Iterator[list[Reached]]:
    """Connections to all runs that are under way, in the order of their numbers.

    Those of this user; for root those of all users.
    """
    runs: dict[int, Reached] = {}
    with contextlib.ExitStack() as links:
        with _open_folders(_reached_places()) as folders:
            for folder in folders:
                names = os.listdir(folder.descriptor)
                for name in sorted(n for n in names if n.endswith(_ENDING)):
                    run = _reached(folder.descriptor, name, folder.owner)
                    if run is None:
                        continue
                    links.callback(run.link.close)
                    runs.setdefault(run.process, run)
        yield [runs[number] for number in sorted(runs)]


def _reached(folder: int, name: str, owner: int) -> Reached | None:
    """The folder owner's run behind a name; a name behind which no process listens is removed."""
    with contextlib.suppress(FileNotFoundError):
        if not stat.S_ISSOCK(os.stat(name, dir_fd=folder, follow_symlinks=False).st_mode):
            return None
    link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        link.connect(_place(folder, name))
    except ConnectionRefusedError:
        link.close()
        _removed(folder, name)
        return None
    except OSError:  # gone meanwhile
        link.close()
        return None
    credentials = link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    process, user, _ = struct.unpack("3i", credentials)
    if user != owner:
        link.close()
        return None
    return Reached(process, link)


# Answers on the command socket of a run, in a thread of its own: in every phase of the run.


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
        board: Where requests are put up.
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
