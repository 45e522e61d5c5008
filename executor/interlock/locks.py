"""State folder with the latch and reference of each bus, and locks on its files.

One folder for all users if an administrator created it, else one per user: a fault of one user's
run is then unknown to others. Files are named after the canonical name of the bus, those of a
serial adapter after itself: the number of its device changes when it is plugged in again.
"""

from __future__ import annotations

import fcntl
import os
import re
import stat
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from drivers.can_bus import IN_PROCESS, BusSettings
from model.errors import HardwareMissing, Refused
from model.files.reading import docs_page

#: Used by all users if it exists: ``sudo install -d -m 2775 -g GROUP /var/lib/cdpr``.
SHARED = Path("/var/lib/cdpr")
#: Serial devices of this computer, and what they belong to. Source: Linux, sysfs-class-tty.
DEVICES = Path("/sys/class/tty")
#: Shorter serial numbers are those of a maker who gives all adapters the same, [characters].
#: Source: Silicon Labs, CP2102 data sheet: "0001".
SHORTEST_SERIAL = 5
#: What to do if a file of the state folder cannot be written.
WRITABLE = (
    "make the folder writable for the operators of the rig; if its file system is the cause, keep"
    f" it on a local disk ({docs_page('commissioning.md')})"
)
#: A latch, or a reference of many cables, has a few kilobytes.
LARGEST_FILE = 65_536

_KINDS = {
    stat.S_IFLNK: "a symbolic link",
    stat.S_IFIFO: "a FIFO",
    stat.S_IFSOCK: "a socket",
    stat.S_IFDIR: "a folder",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def state_folders() -> tuple[Path, ...]:
    """The state folder, which may not exist yet; then the user's own, where it was before.

    Source: XDG Base Directory Specification, which has relative paths ignored.

    Raises:
        Refused: The user has no home folder, such as one without a name in a container.
    """
    base = os.environ.get("XDG_STATE_HOME", "")
    try:
        own = (Path(base) if os.path.isabs(base) else Path.home() / ".local" / "state") / "cdpr"
    except RuntimeError as error:
        raise Refused(
            "there is no folder for latched faults and homing references",
            where="XDG_STATE_HOME",
            why=str(error),
            next_step="set HOME or XDG_STATE_HOME to a folder of this user that is kept",
        ) from None
    return (SHARED, own) if SHARED.is_dir() else (own,)


def state_files(kind: str, settings: BusSettings) -> tuple[Path, ...]:
    """The file of a kind, such as ``latched``, for a bus; then where it was before, if readable.

    Those of a serial adapter were named after its device: they count for the adapter that is that
    device now.

    Raises:
        HardwareMissing: The bus is that of a serial adapter which is not there, or of one of two
            with the same serial number, so that it is unknown which one it is.
    """
    interface, channel = settings.canonical.split(" ", 1)
    channels = [channel]
    if channel.startswith("/"):  # after its device, where it was before, also with its speed
        _, at, speed = settings.channel.strip().partition("@")
        channels = [_serial_adapter(Path(channel)), channel, f"{channel}{at}{speed}"]
    names = [re.sub(r"[^A-Za-z0-9.]+", "-", f"{interface} {one}") for one in channels]
    first, *earlier = state_folders()
    folders = [first, *(one for one in earlier if os.access(one, os.R_OK | os.X_OK))]
    files = [folder / f"{kind}-{name}.json" for name in names for folder in folders]
    return tuple(dict.fromkeys(files))


def _serial_adapter(device: Path) -> str:
    """A name that an adapter keeps, whatever the number of its device."""
    with suppress(OSError):  # unplugged meanwhile
        if device.exists():
            return _adapter_name(device)
    raise HardwareMissing(
        f"there is no serial adapter {device}",
        where="bus.channel",
        why="it is unplugged, or has another name since it was plugged in again; its latched"
        " fault and homing reference are filed under the adapter, so they are unknown",
        next_step="plug it in, and name it as in `ls /dev/serial/by-id`, which stays the same",
    )


def _adapter_name(device: Path) -> str:
    """See `_serial_adapter`.

    USB adapters are known by their serial number, those without by the port they are plugged into;
    other devices are fixed to the computer. Source: Linux, sysfs-bus-usb.
    """
    unit = (DEVICES / device.name / "device").resolve()
    usb = _usb_device(unit)
    if usb is None:
        return str(device)
    interface = unit.relative_to(usb).parts[0].partition(":")[2]
    unit_of = [interface, *(path.read_text().strip() for path in unit.glob("port_number"))]
    names = _unique_names(usb)
    if not names:
        controller = next(folder.parent for folder in usb.parents if folder.name.startswith("usb"))
        names = [str(controller), usb.name.partition("-")[2]]  # without the number of its bus
    others = {_usb_device(path.resolve()) for path in DEVICES.glob("tty[AU]*/device")} - {None, usb}
    if twin := next((other for other in others if other and _unique_names(other) == names), None):
        raise HardwareMissing(
            f"two serial adapters have the serial number {names[-1]}",
            where="bus.channel",
            why=f"they are plugged into ports {usb.name} and {twin.name}; latched fault and homing"
            " reference are filed under the serial number, so it is unclear to which they belong",
            next_step="unplug one of them, or give it another serial number",
        )
    return " ".join(["usb", *names, *unit_of])


def _usb_device(unit: Path) -> Path | None:
    """The USB device that a serial device belongs to; None if it is not on USB."""
    return next((folder for folder in unit.parents if (folder / "idVendor").exists()), None)


def _unique_names(usb: Path) -> list[str]:
    """Vendor, product and serial number of a USB device; empty without a usable serial number."""
    names = [usb / name for name in ("idVendor", "idProduct", "serial")]
    if not names[-1].exists():
        return []
    texts = [path.read_text().strip() for path in names]
    return texts if len(texts[-1]) >= SHORTEST_SERIAL else []


def state_file(kind: str, settings: BusSettings) -> Path:
    """The file of a kind for a bus."""
    return state_files(kind, settings)[0]


def open_lock(path: Path, *, create: bool = False) -> int:
    """Opens a lock file, which all operators of a shared folder may lock; the caller closes it.

    It is opened for writing where that is allowed, as network file systems require it.

    Args:
        create: Create an empty file if there is none.

    Raises:
        Refused: It is not a regular file.
        OSError: It cannot be opened.
    """
    try:
        lock = open_state_file(path, os.O_RDWR | (os.O_CREAT if create else 0))
    except PermissionError:  # of a user who may only read the folder
        return open_state_file(path)
    if create and os.fstat(lock).st_uid == os.geteuid():
        os.fchmod(lock, 0o664)  # whatever the umask
    return lock


def open_state_file(path: Path, access: int = os.O_RDONLY) -> int:
    """Opens a file of the state folder; the caller closes it.

    The folder may be shared: any user with write access could put a link to another file there, or
    a FIFO that blocks forever. Links are not followed, and FIFOs do not block.

    Args:
        access: Flags of `os.open`.

    Raises:
        Refused: It is not a regular file.
        OSError: It cannot be opened.
    """
    flags = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        handle = os.open(path, flags | access, 0o664)
    except FileNotFoundError:
        raise
    except OSError:
        _require_regular(path, path.lstat().st_mode)
        raise
    try:
        _require_regular(path, os.fstat(handle).st_mode)
    except BaseException:
        os.close(handle)
        raise
    return handle


def read_state_file(path: Path) -> str:
    """The text of a file of the state folder.

    Raises:
        Refused: It is not a regular file, or too large.
        OSError: It cannot be read.
        UnicodeDecodeError: It is not UTF-8.
    """
    with os.fdopen(open_state_file(path), "rb") as stream:
        data = stream.read(LARGEST_FILE + 1)
    if len(data) > LARGEST_FILE:
        raise _refusal(path, f"it is larger than {LARGEST_FILE} bytes")
    return data.decode("utf-8")


def _require_regular(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        kind = _KINDS.get(stat.S_IFMT(mode), "a special file")
        raise _refusal(path, f"it is {kind}, not a regular file")


def _refusal(path: Path, what: str) -> Refused:
    return Refused(
        f"{what}, and is not used",
        where=str(path),
        why="this program did not create it; another user of the folder did",
        next_step=f"find its owner (`ls -l {path}`), then remove it; nothing was moved",
    )


# File locks, which the system releases when a program ends in any manner.


#: Interval of attempts, [s].
_POLL_INTERVAL = 0.01


def locked_within(handle: int, seconds: float, operation: int = fcntl.LOCK_EX) -> bool:
    """Locks an open file; waits up to a time [s]; returns whether it succeeded.

    Raises:
        Refused: The file system has no locks.
    """
    until = time.monotonic() + seconds
    while True:
        try:
            fcntl.flock(handle, operation | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= until:
                return False
            time.sleep(_POLL_INTERVAL)
        except OSError as error:
            raise Refused(
                "files of the state folder cannot be locked, so another program could move the"
                " same drives",
                where=str(state_folders()[0]),
                why=error.strerror or str(error),
                next_step="create /var/lib/cdpr on a local disk"
                f" ({docs_page('commissioning.md')}), or set XDG_STATE_HOME to a folder of one;"
                " nothing was moved",
            ) from None
        else:
            return True


# Only one program at a time configures the drives of a bus or reads their objects.
#
# A drive answers one SDO request at a time without an addressee: a program would take the answer to
# another one's request for its own. The interface ``virtual`` has no other user.


#: Reading the drives' state takes no longer than this, unless one does not answer, [s].
READ_TIMEOUT = 5.0


class SetUpLock:
    """Lock for configuring the drives of one bus."""

    def __init__(self, settings: BusSettings) -> None:
        self._bus, self._is_shared = str(settings), settings.interface != IN_PROCESS
        self._path = state_file("set-up", settings).with_suffix(".lock")

    @contextmanager
    def held(self) -> Iterator[None]:
        """Holds the lock while drives are configured and moved; waits for readers.

        Raises:
            Refused: Another program has it, or the lock cannot be made.
        """
        if not self._is_shared:
            yield
            return
        try:
            self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            lock = open_lock(self._path, create=True)
        except OSError as error:
            raise Refused(
                "exclusive access to the drives cannot be ensured",
                where=str(self._path),
                why=error.strerror or str(error),
                next_step=WRITABLE,
            ) from None
        try:
            if not locked_within(lock, READ_TIMEOUT):
                raise Refused(
                    "another program is configuring or reading these drives",
                    where=f"bus {self._bus}",
                    next_step="wait until it is done (`cdpr monitor` shows motions)."
                    " Nothing was moved",
                )
            yield
        finally:
            os.close(lock)

    @contextmanager
    def tried(self) -> Iterator[bool]:
        """For readers: takes it if free; yields whether it was. Creates no file.

        Raises:
            Refused: The lock is not a regular file.
        """
        try:
            lock = open_lock(self._path)
        except OSError:  # no program on this computer has used these drives
            yield True
            return
        try:
            yield locked_within(lock, 0.0)
        finally:
            os.close(lock)


# Only one console at a time has a page that commands the robot on a bus. The interface ``virtual``
# has no other user.


#: The holder checks this often whether another console asks for control, [s].
POLLED_WITHIN = 1.0
#: Readers release the lock within this time, [s].
_READ_WITHIN = 0.2
_CONTROL, _WISH = "control", "control-wanted"
_LONGEST_NAME = 400


class ControlLock:
    """Lock of the console that has control of one bus.

    Another console asks for it by holding a second lock.
    """

    def __init__(self, settings: BusSettings) -> None:
        """Opens nothing yet.

        Raises:
            Refused: The user has no folder for the locks.
        """
        self._settings, self._is_shared = settings, settings.interface != IN_PROCESS
        if self._is_shared:
            state_folders()
        self._held: int | None = None
        self._lock = threading.Lock()

    def _file(self, kind: str) -> Path:
        """A lock file: where the bus is now, as its adapter may have been plugged in meanwhile."""
        return state_file(kind, self._settings).with_suffix(".lock")

    @property
    def is_held(self) -> bool:
        """Whether this console has it."""
        return self._held is not None or not self._is_shared

    def take(self, name: str, *, force: bool) -> str:
        """Takes it; returns why not, or an empty text.

        Args:
            name: Of the holder, for other consoles.
            force: Ask the holder to give it up, and wait for that.

        Raises:
            Refused: The lock is not a regular file, or the file system has no locks.
            HardwareMissing: The serial adapter of the bus is not there, or not the only one.
        """
        with self._lock, ExitStack() as stack:
            if self.is_held:
                return ""
            path = self._file(_CONTROL)
            try:
                path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                handle = open_lock(path, create=True)
                stack.callback(os.close, handle)
                wish = open_lock(self._file(_WISH), create=True)
                stack.callback(os.close, wish)
                if not locked_within(handle, _READ_WITHIN):
                    holder = f"{_text_of(handle)} has control, and keeps it"
                    if not force:
                        return holder
                    if not locked_within(wish, _READ_WITHIN):
                        return "another console asks for control, too: try again"
                    if not locked_within(handle, POLLED_WITHIN):
                        return f"{holder}: the robot moves, or that console does not answer"
                os.truncate(handle, 0)
                os.pwrite(handle, name.encode()[:_LONGEST_NAME], 0)
            except OSError as error:
                why = error.strerror or str(error)
                return f"exclusive control cannot be ensured: {path}: {why}"
            os.close(wish)
            stack.pop_all()
            self._held = handle
            return ""

    def release(self) -> None:
        """Releases it, if this console has it; does not wait for `take`."""
        if self._held is None:
            return
        with self._lock:
            if self._held is not None:
                os.close(self._held)
                self._held = None

    def is_wanted(self) -> bool:
        """Whether another console asks for it."""
        return self._is_shared and self._text_if_locked(_WISH) is not None

    def holder(self) -> str | None:
        """Name of the holder; None without one."""
        return self._text_if_locked(_CONTROL) if self._is_shared else None

    def _text_if_locked(self, kind: str) -> str | None:
        try:
            handle = open_lock(self._file(kind))
        except (OSError, HardwareMissing):  # no console of this computer has control of the bus
            return None
        try:
            return None if locked_within(handle, 0.0, fcntl.LOCK_SH) else _text_of(handle)
        finally:
            os.close(handle)


def _text_of(handle: int) -> str:
    text = os.pread(handle, _LONGEST_NAME, 0).decode(errors="replace")
    return text if text.isprintable() and text else "another console"
