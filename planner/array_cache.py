"""Arrays that depend on rig and load alone, kept between runs beside the kernels that made them.

The folder is named after the content of the kernels, so a change of theirs forgets what they made.
Where no folder can be written, arrays are recomputed.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from model.files.documents import content_hash
from model.jit import cache_folder
from planner.kernels.jit import KERNELS

Kind = TypeVar("Kind", bound=np.generic)

_MOST_FILES = 200
"""Kept of one name; the oldest go."""


def stored(
    name: str, key: Any, shape: tuple[int, ...], compute: Callable[[], NDArray[Kind]]
) -> NDArray[Kind]:
    """An array from the user's cache, or computed and kept there.

    Args:
        name: What it is, for its file.
        key: Everything it depends on, JSON-like.
        shape: That it must have to be believed.
        compute: Makes it.
    """
    folder = cache_folder(*KERNELS)
    if folder is None:
        return compute()
    path = folder / f"{name}-{content_hash(key).removeprefix('sha256:')[:24]}.npy"
    try:
        found = np.load(path, allow_pickle=False)
        if found.shape == shape:
            return found  # type: ignore[no-any-return]
    except (OSError, ValueError, EOFError):  # not there yet, or cut off: recomputed below
        pass
    made = compute()
    _keep(path, made)
    _forget_oldest(folder, name)
    return made


def _forget_oldest(folder: Path, name: str) -> None:
    try:
        files = sorted(folder.glob(f"{name}-*.npy"), key=lambda file: file.stat().st_mtime)
        for file in files[:-_MOST_FILES]:
            file.unlink()
    except OSError:  # another process was faster, or it is not ours to remove
        return


def _keep(path: Path, array: NDArray[Any]) -> None:
    """Writes a file whole or not at all; a cache that cannot be written is left as it is."""
    temporary = ""
    try:
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
            temporary = file.name
            np.save(file, array)
        os.replace(temporary, path)
    except OSError:
        if temporary:
            Path(temporary).unlink(missing_ok=True)
