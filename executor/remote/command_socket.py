"""The command socket of a run, for `cdpr stop` and similar verbs from any terminal.

A run listens on a socket named after its process in the user's run-time folders: ``123.sock``, and
``123-2.sock`` for a second one of the same process. A socket without a listening process was left
by one that ended. It is advertised in every folder that another terminal may search, and only in
folders that no other user can write to: a folder in /tmp of another user could contain links to
this user's files, or sockets of other users. Root reaches the runs of all users, each in a folder
private to that user. A motion in preparation has a name of its own: it can be stopped, and takes no
other command.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import re
import socket
import stat
import struct
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from model.errors import Refused

_ENDING = ".sock"
#: Of a motion that is still being prepared.
_ENDING_AHEAD = ".preparing.sock"
_STEM = re.compile(r"([0-9]+)(-[0-9]+)?")
#: Temporary folder that does not depend on a terminal's ``TMPDIR``.
FIXED = Path("/tmp")
#: Name of the record of the last stop.
_STOPPED = "stopped"

#: Names of this process's sockets, without endings: several threads may each run a robot.
_named: set[str] = set()
_naming = threading.Lock()


@dataclass(frozen=True, slots=True)
class _Folder:
    """An open folder that only one user can write to."""

    descriptor: int
    owner: int


def _own_folders() -> list[Path]:
    """The user's run-time folder, if the system has one, and those in temporary folders.

    A terminal with another ``TMPDIR``, or without ``XDG_RUNTIME_DIR``, searches some of them, too;
    only a run-time folder of another name keeps runs apart, such as those of tests.
    """
    return [_run_time_folder() / "cdpr", *(f / f"cdpr-{os.getuid()}" for f in _temporary_folders())]


def _default_run_time_folder() -> Path:
    return Path(f"/run/user/{os.getuid()}")


def _run_time_folder() -> Path:
    base = os.environ.get("XDG_RUNTIME_DIR", "")
    return Path(base) if os.path.isabs(base) else _default_run_time_folder()


def _temporary_folders() -> list[Path]:
    own = Path(tempfile.gettempdir())
    is_apart = own == FIXED or _run_time_folder() != _default_run_time_folder()
    return [own] if is_apart else [own, FIXED]


def _reachable_folders() -> list[Path]:
    """Folders to search for runs; for root those of all users."""
    own = _own_folders()
    if os.getuid() != 0:
        return own
    temporary = [path for folder in _temporary_folders() for path in folder.glob("cdpr-*")]
    others = [*Path("/run/user").glob("*/cdpr"), *temporary]
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


@dataclass(frozen=True, slots=True)
class AdvertisedSockets:
    """Listening sockets of this process.

    Attributes:
        listeners: The sockets, one per folder.
        folders: Descriptors of the folders.
        stem: Name of the sockets, without ending.
    """

    listeners: list[socket.socket]
    folders: list[int]
    stem: str

    def advertise(self) -> None:
        """Gives the sockets of a motion in preparation the names of a run, too."""
        ahead, name = (f"{self.stem}{ending}" for ending in (_ENDING_AHEAD, _ENDING))
        for folder in self.folders:
            with contextlib.suppress(OSError):  # the folder was removed
                _remove(folder, name)
                os.link(ahead, name, src_dir_fd=folder, dst_dir_fd=folder)


@contextlib.contextmanager
def advertised_ahead() -> Iterator[AdvertisedSockets]:
    """Listens in every usable folder while the block runs, for a motion in preparation.

    Raises:
        Refused: No folder is writable, and only by this user.
    """
    paths = _made_folders()
    why = "no such folder belongs to this user alone; another user may have created it"
    next_step = "remove it or restrict it (chmod 700), or set XDG_RUNTIME_DIR"
    with _open_folders(paths) as opened, contextlib.ExitStack() as stack:
        stem = stack.enter_context(_own_stem())
        listeners, folders = [], []
        for folder in (one.descriptor for one in opened if one.owner == os.getuid()):
            try:
                listener = stack.enter_context(_listen_in(folder, f"{stem}{_ENDING_AHEAD}"))
            except OSError as error:  # such as a file system that is full or read-only
                why = error.strerror or str(error)
                next_step = "remove the cause, or set XDG_RUNTIME_DIR to a folder without it"
                continue
            listeners.append(listener)
            folders.append(folder)
            for ending in (_ENDING_AHEAD, _ENDING):
                stack.callback(_try_remove, folder, f"{stem}{ending}")
        if not listeners:
            raise Refused(
                "`cdpr stop` would not reach this run",
                where=" or ".join(map(str, paths)),
                why=why,
                next_step=next_step,
            )
        yield AdvertisedSockets(listeners, folders, stem)


def _made_folders() -> list[Path]:
    """This user's folders, after creating them where possible."""
    paths = _own_folders()
    for path in paths:
        with contextlib.suppress(OSError):  # exists, or its parent is read-only
            path.mkdir(mode=0o700)
    return paths


@contextlib.contextmanager
def _own_stem() -> Iterator[str]:
    """A name that no other run of this process has while the block runs."""
    first = str(os.getpid())
    with _naming:
        stems = itertools.chain([first], (f"{first}-{k}" for k in itertools.count(2)))
        stem = next(stem for stem in stems if stem not in _named)
        _named.add(stem)
    try:
        yield stem
    finally:
        _named.discard(stem)


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


# A record of the last stop: it also reaches a program that is just being started.


def record_stop() -> None:
    """Records that a stop was requested now, in every folder; to be called before `find_runs`."""
    _made_folders()
    line = f"{_boot()} {time.clock_gettime(time.CLOCK_BOOTTIME)!r}\n".encode()
    name = f"{_STOPPED}-{os.getpid()}-{threading.get_ident()}.new"
    with _open_folders(_reachable_folders()) as folders:
        for folder in (one.descriptor for one in folders):
            with contextlib.suppress(OSError):  # such as a full disk: runs are stopped all the same
                _remove(folder, name)
                flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
                with os.fdopen(os.open(name, flags, 0o644, dir_fd=folder), "wb") as stream:
                    os.fchmod(stream.fileno(), 0o644)  # root's, whatever its umask: users read it
                    stream.write(line)
                os.rename(name, _STOPPED, src_dir_fd=folder, dst_dir_fd=folder)


def is_stopped_since(began: float) -> bool:
    """Whether a stop of this user's runs was requested since then, [s] of `CLOCK_BOOTTIME`."""
    with _open_folders(_own_folders()) as folders:
        return any(_last_stop(folder.descriptor) >= began for folder in folders)


def _last_stop(folder: int) -> float:
    """Time of the last recorded stop, [s]; minus infinity without one since this computer began."""
    flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        with os.fdopen(os.open(_STOPPED, flags, dir_fd=folder), "rb") as stream:
            boot, at = stream.read(100).split()
        return float(at) if boot.decode() == _boot() else -math.inf
    except (OSError, ValueError):
        return -math.inf


def _boot() -> str:
    """Identifies the time since this computer was started."""
    return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()


@dataclass(frozen=True, slots=True)
class RunConnection:
    """A connection to a run.

    Attributes:
        process: Its process ID.
        link: The socket; the owner closes it.
        is_connected: False for a run that accepts no connections, as it is suspended or hangs.
        is_ahead: Its motion was still being prepared when it was found.
    """

    process: int
    link: socket.socket
    is_connected: bool = True
    is_ahead: bool = False


@contextlib.contextmanager
def find_runs(*, ahead: bool = False) -> Iterator[list[RunConnection]]:
    """Connects to all active runs, in order of their process IDs; a process may have several.

    Runs of this user; for root of all users.

    Args:
        ahead: Also to motions that are still being prepared.
    """
    endings = (_ENDING, _ENDING_AHEAD) if ahead else (_ENDING,)
    runs: dict[tuple[str, int], RunConnection] = {}
    with contextlib.ExitStack() as links:
        with _open_folders(_reachable_folders()) as folders:
            for folder in folders:
                names = os.listdir(folder.descriptor)
                for name, stem in _sockets(names, endings):
                    if (stem, folder.owner) in runs:
                        continue
                    run = _connect(folder, name, int(stem.partition("-")[0]))
                    if run is not None:
                        links.callback(run.link.close)
                        runs[stem, folder.owner] = run
        yield [runs[key] for key in sorted(runs, key=lambda key: (runs[key].process, key))]


def _sockets(names: Sequence[str], endings: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Names of sockets, whole and without ending; those of one run in the order of the endings."""
    for ending in endings:
        for name in sorted(names):
            stem = name.removesuffix(ending)
            if stem != name and _STEM.fullmatch(stem):
                yield name, stem


def _connect(folder: _Folder, name: str, process: int) -> RunConnection | None:
    """Connects to the folder owner's run at a socket; removes a socket without a listener."""
    is_ahead = name.endswith(_ENDING_AHEAD)
    with contextlib.suppress(FileNotFoundError):
        found = os.stat(name, dir_fd=folder.descriptor, follow_symlinks=False)
        if not stat.S_ISSOCK(found.st_mode):
            return None
    link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    link.setblocking(False)  # else it waits for a suspended run with many waiting clients
    try:
        link.connect(_path_in(folder.descriptor, name))
    except ConnectionRefusedError:
        link.close()
        _try_remove(folder.descriptor, name)
        return None
    except BlockingIOError:
        return RunConnection(process, link, is_connected=False, is_ahead=is_ahead)
    except OSError:  # gone
        link.close()
        return None
    credentials = link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    process, user, _ = struct.unpack("3i", credentials)
    if user != folder.owner:
        link.close()
        return None
    return RunConnection(process, link, is_ahead=is_ahead)
