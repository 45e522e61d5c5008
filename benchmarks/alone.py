"""An isolated environment for a benchmark: it sees and stops no run of another program."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import chdir, contextmanager
from pathlib import Path


@contextmanager
def alone() -> Iterator[Path]:
    """A temporary folder for all files of this process and its children, until it ends."""
    with tempfile.TemporaryDirectory() as folder:
        for name in ("TMPDIR", "XDG_RUNTIME_DIR", "XDG_STATE_HOME"):
            os.environ[name] = folder
        tempfile.tempdir = None
        with chdir(folder):
            yield Path(folder)
