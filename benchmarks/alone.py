"""A place of its own for a benchmark: it sees no run of another program, and stops none."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import chdir, contextmanager
from pathlib import Path


@contextmanager
def alone() -> Iterator[Path]:
    """A temporary folder for all that this process and its children keep, to the end."""
    with tempfile.TemporaryDirectory() as place:
        for name in ("TMPDIR", "XDG_RUNTIME_DIR", "XDG_STATE_HOME"):
            os.environ[name] = place
        tempfile.tempdir = None
        with chdir(place):
            yield Path(place)
