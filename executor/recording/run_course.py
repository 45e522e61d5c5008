"""``run.json``: what no table of a run holds, from before it moves, and how it ended.

Keys (``schema_version`` 1): ``started`` (ISO 8601, UTC), ``interface``, ``simulated``, ``fast``,
``final_state``, ``cause`` and ``cycles``. Until the motion is over the last three are empty or 0:
so they stay when the program is killed.
"""

from __future__ import annotations

import json
import os
import platform
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from itertools import count
from pathlib import Path

from executor.recording.record_files import read_course
from model.errors import BadInput
from model.files.documents import write_atomic

#: Of the file, [bytes]: it is written so long at first, so that its end has room on a full disk.
SIZE = 2048


@dataclass(frozen=True, slots=True)
class RunCourse:
    """How a run began and ended.

    Attributes:
        started: When, UTC.
        interface: Of the bus.
        simulated: The drives are simulated in the run's own process.
        fast: Simulated time.
        final_state: Where the motion ended; nothing until then.
        cause: Why it did not finish, if it did not.
        cycles: How many there were; 0 until then.
    """

    started: datetime
    interface: str
    simulated: bool
    fast: bool
    final_state: str = ""
    cause: str = ""
    cycles: int = 0

    @classmethod
    def load(cls, path: Path) -> RunCourse:
        """Reads the file.

        Raises:
            BadInput: It cannot be read.
            InvalidFile: With every key that cannot be used.
        """
        kept = read_course(path)
        return cls(
            datetime.fromisoformat(kept.started),
            kept.interface,
            kept.simulated,
            kept.fast,
            kept.final_state,
            kept.cause,
            kept.cycles,
        )

    def save(self, path: Path) -> None:
        """Writes the whole file or nothing.

        Raises:
            BadInput: The folder cannot be written to.
        """
        write_atomic(path, self._text().ljust(SIZE) + "\n")

    def save_where_it_was(self, path: Path) -> None:
        """As `save`; on a full disk in the room of the file, the cause cut to fit.

        Raises:
            BadInput: The file is gone, or cannot be written to.
        """
        try:
            self.save(path)
        except BadInput:
            if not self._overwritten(path):
                raise

    def _overwritten(self, path: Path) -> bool:
        text = self._text().encode()
        if len(text) > SIZE:
            text = replace(self, cause=self.cause[: SIZE // 8])._text().encode()
        with suppress(OSError), path.open("r+b", buffering=0) as stream:
            stream.write(text.ljust(SIZE) + b"\n")
            os.fsync(stream.fileno())
            return True
        return False

    def _text(self) -> str:
        started = self.started.isoformat(timespec="milliseconds")
        data = {"schema_version": 1, **asdict(self), "started": started}
        return json.dumps(data, indent=1, ensure_ascii=False)


# Which programs took part in a run.


LIBRARIES = (
    "cdpr",
    "numpy",
    "python-can",
    "canopen",
    "opencv-python-headless",
    "python-fcl",
)


@dataclass(frozen=True, slots=True)
class CameraRecord:
    """What became of one camera's images in a run.

    Attributes:
        name: Of the camera in the rig file.
        source: Where its images came from.
        pictures: How many it was asked for.
        poses: How many of them gave a pose.
        dropped: How many were due while it was busy, and not asked for.
        measuring_ms: Median time that measuring one took; None where none was measured.
        failed: Why it gave no images any more, or nothing.
    """

    name: str
    source: str
    pictures: int
    poses: int
    dropped: int
    measuring_ms: float | None
    failed: str


def versions() -> dict[str, str]:
    """Name and version of Python and of the libraries that matter."""
    found = {"python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


# Where runs are kept for which no folder was named.


RUNS = Path("runs")


def free_folder(name: str) -> Path:
    """``runs/NAME``, or with the first free number; the caller makes it."""
    names = (RUNS / (name if n == 1 else f"{name}-{n}") for n in count(1))
    return next(path for path in names if not path.exists())


def dated_folder() -> Path:
    """``runs/`` with date and local time; as `free_folder`."""
    return free_folder(datetime.now().strftime("%Y-%m-%d_%H%M%S"))
