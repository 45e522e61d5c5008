"""Where results go: looked at before the work, as a result that cannot be written would be lost."""

from __future__ import annotations

import os
from pathlib import Path

from model.errors import AlreadyExists, BadInput


def require_new_file(path: Path, replace: bool = False) -> None:
    """Refuses a file that cannot be written.

    Args:
        path: The file.
        replace: It may exist.

    Raises:
        BadInput: The file exists, or its folder does not or is read-only.
    """
    if path.is_dir():
        raise BadInput("this is a folder", where=str(path), next_step="name a file")
    if path.exists() and not replace:
        raise AlreadyExists("the file exists already", str(path))
    folder, what = path.parent, "the file cannot be written"
    if not folder.is_dir():
        why = f"{folder} is not a folder" if folder.exists() else f"there is no folder {folder}"
        raise BadInput(
            what, where=str(path), why=why, next_step="make the folder, or name another file"
        )
    if not os.access(folder, os.W_OK):
        raise BadInput(
            what,
            where=str(path),
            why=f"the folder {folder} is read-only",
            next_step="choose a folder with write permission",
        )


def make_folder(folder: Path, force: bool = False) -> None:
    """Makes a folder for results; one that holds something only with ``force``.

    Raises:
        BadInput: The folder holds something and ``force`` is not set, or cannot be made.
    """
    make_place(folder)
    if any(folder.iterdir()) and not force:
        raise AlreadyExists("the folder is not empty", str(folder))


def make_place(folder: Path) -> None:
    """Makes a folder where there is none; one that holds something will do.

    Raises:
        BadInput: It cannot be made or written to.
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
