"""Output paths, checked before the work as a result would be lost, and folders synced after it."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from model.errors import AlreadyExists, BadInput
from model.files.reading import shown, unreadable


def require_new_file(path: Path, replace: bool = False) -> None:
    """Refuses a file that cannot be written.

    Args:
        replace: Whether it may exist.

    Raises:
        BadInput: The file exists, or its folder does not or is read-only.
    """
    # `os.path` answers False where `Path` raises, as for a name that is too long.
    if os.path.isdir(path):
        raise BadInput("this is a folder", where=str(path), next_step="name a file")
    if os.path.exists(path) and not replace:
        raise AlreadyExists("the file exists already", str(path))
    folder, what = path.parent, "the file cannot be written"
    if not os.path.isdir(folder):
        is_there = os.path.exists(folder)
        why = f"{folder} is not a folder" if is_there else f"there is no folder {folder}"
        raise BadInput(
            what, where=str(path), why=why, next_step="create the folder, or choose another file"
        )
    if not os.access(folder, os.W_OK):
        raise BadInput(
            what,
            where=str(path),
            why=f"the folder {folder} is read-only",
            next_step="choose a folder with write permission",
        )


def make_folder(folder: Path, force: bool = False) -> None:
    """Creates a folder for results; one that is not empty is refused without ``force``.

    Raises:
        BadInput: The folder is not empty and ``force`` is not set, or cannot be created.
    """
    make_missing_folder(folder)
    if any(folder.iterdir()) and not force:
        raise AlreadyExists("the folder is not empty", str(folder))


def make_missing_folder(folder: Path) -> None:
    """Creates a folder if it is missing; it need not be empty.

    Raises:
        BadInput: It cannot be created or written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        next(folder.iterdir(), None)
    except OSError as error:
        raise BadInput(
            "the folder cannot be created",
            where=str(folder),
            why=str(error.strerror),
            next_step="name a folder (not a file) where you have write permission",
        ) from error
    if not os.access(folder, os.W_OK):
        raise BadInput(
            "the folder is read-only",
            where=str(folder),
            next_step="name a folder where you have write permission",
        )


Identity = tuple[int, int] | str
"""Device and inode of a file; the real path of one that does not exist yet."""


def refuse_overwriting(outputs: Mapping[str, Path], inputs: Iterable[Path]) -> None:
    """Refuses outputs that are an input, a file in an input folder, or one another.

    Links of both kinds are resolved; paths that do not exist yet are compared by their real path.

    Args:
        outputs: Paths to write, by their option, such as ``--output``.

    Raises:
        BadInput: Writing would destroy something.
    """
    taken: dict[Identity, str] = {}
    for name, path in outputs.items():
        _require_writable_kind(path, name)
        other = taken.setdefault(file_identity(path), name)
        if other != name:
            raise BadInput(
                f"{other} and {name} name the same file",
                where=shown(path),
                why="one would overwrite the other",
                next_step="give each output its own name",
            )
    for source in inputs:
        for identity in _identities(source):
            if identity in taken:
                raise BadInput(
                    f"{taken[identity]} would overwrite an input of this command",
                    where=shown(outputs[taken[identity]]),
                    why=f"it is the same as {shown(source)}, or inside it",
                    next_step="choose another name for the output; --force does not help here",
                )


def _require_writable_kind(path: Path, name: str) -> None:
    if isinstance(file_identity(path), str):
        return
    mode = path.stat().st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise BadInput(
            f"{name} is not a regular file but a device, a pipe or a socket",
            where=shown(path),
            why="writing would replace it with a file",
            next_step="name a file or a folder",
        )


def file_identity(path: Path) -> Identity:
    """Identity shared by all paths of one file; its real path where it does not exist yet.

    Raises:
        BadInput: The path is invalid.
    """
    try:
        found = path.stat()
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        return os.path.realpath(path)
    except (OSError, ValueError) as error:
        raise unreadable(path, error) from None
    return found.st_dev, found.st_ino


def _identities(path: Path) -> Iterator[Identity]:
    """Identities of an input, and of the files in it where it is a folder."""
    yield file_identity(path)
    with suppress(OSError), os.scandir(path) as entries:  # if not a folder, the verb reports it
        for entry in entries:
            if not entry.is_dir():
                with suppress(BadInput):  # a dangling link
                    yield file_identity(Path(entry.path))


def keep_names(folder: Path, *, durable: bool = False) -> None:
    """Syncs a folder to disk, so that new file names survive a power failure.

    Args:
        durable: Refuse a file system that cannot do this, such as a VirtualBox shared folder.

    Raises:
        OSError: The folder is gone, the disk fails, or as above.
    """
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
        if durable:
            why = "its file system cannot sync folders, and may lose the file in a power failure"
            raise OSError(error.errno, why) from None
    finally:
        os.close(handle)
