"""The camera's process alone."""

from __future__ import annotations

import multiprocessing
from typing import Any

import pytest

from executor.cameras.process import _serve


class _Camera:
    """A worker that detects nothing, and may fail."""

    def __enter__(self) -> _Camera:
        return self

    def __exit__(self, *_: object) -> None:
        pass


def _broken() -> Any:
    raise RuntimeError("no such camera")


@pytest.mark.parametrize("make", [_Camera, _broken])
@pytest.mark.parametrize("closed", ["ours", "both ends"])
def test_it_ends_without_a_word_when_its_parent_is_gone(make: Any, closed: str) -> None:
    parent, child = multiprocessing.Pipe()
    parent.close()
    if closed == "both ends":
        child.close()
    _serve(make, child)
    child.close()
