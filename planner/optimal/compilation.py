"""Whether the compiled search waits in the user's cache, or the next plan has to compile it."""

from __future__ import annotations

from pathlib import Path

from planner.exact.compiled import cache_folder

_KERNELS = Path(__file__).parent
_STAMP = "complete"


def is_compiled(kernels: Path = _KERNELS) -> bool:
    """Whether a search of the very kernels in a folder has run before on this machine.

    False too where no folder can be written: then every process compiles for itself.
    """
    folder = cache_folder(kernels)
    return folder is not None and (folder / _STAMP).exists()


def note_compiled(kernels: Path = _KERNELS) -> None:
    """Notes that all kernels of a search were compiled, where that can be noted."""
    folder = cache_folder(kernels)
    if folder is None:
        return
    try:
        (folder / _STAMP).touch()
    except OSError:  # read-only since it was made: the next process looks again
        return
