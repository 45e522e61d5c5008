"""The latch of a bus: while it is engaged nothing moves the drives there, in no process.

It is a file in the user's state folder. It is engaged before anything moves and released when the
motion ended well; a fault leaves it engaged with its cause, and a program that died or a computer
that lost power leaves it engaged too. Only `cdpr reset` releases it then.
"""

from __future__ import annotations

import json
import os
import re
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from cdpr.documents import write_atomic
from cdpr.errors import CdprError, Refused
from drivers.bus import BusSettings
from executor.execution import Outcome
from executor.machine import State

_CUT_SHORT = "a run did not come to its end: its program was killed, or the computer stopped"


@dataclass(frozen=True, slots=True)
class Latched:
    """Why a bus is latched.

    Attributes:
        bus: Interface and channel.
        rig: Name of the rig that was run.
        cause: One sentence.
        since: When, ISO 8601, UTC.
        folder: Run folder.
        process: Number of the process that ran it.
    """

    bus: str
    rig: str
    cause: str
    since: str
    folder: str
    process: int


class Latch:
    """Of one bus."""

    def __init__(self, settings: BusSettings) -> None:
        """Looks at nothing yet."""
        self._bus = str(settings)
        name = re.sub(r"[^A-Za-z0-9.]+", "-", self._bus)
        self.path = _state_folder() / f"latched-{name}.json"

    def read(self) -> Latched | None:
        """Why it is engaged; None when it is not. A file that cannot be read counts as engaged."""
        try:
            return Latched(**json.loads(self.path.read_text(encoding="utf-8")))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError) as error:
            cause = f"the latch file cannot be read: {error}"
            return Latched(self._bus, "unknown", cause, "unknown", "unknown", 0)

    def require_released(self) -> None:
        """Nothing may move while it is engaged.

        Raises:
            Refused: With the cause.
        """
        latched = self.read()
        if latched is not None:
            raise self._refusal(latched)

    def engage(self, rig: str, folder: Path) -> None:
        """A run is about to move; if it does not come to its end, this is what tells of it.

        Raises:
            Refused: It is engaged already, or cannot be.
        """
        try:
            self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            os.close(os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600))
        except FileExistsError:
            raise self._refusal(self.read()) from None
        except OSError as error:
            raise self._not_kept(error.strerror or str(error)) from None
        self._write(self._latched(rig, _CUT_SHORT, folder))

    def settle(self, rig: str, outcome: Outcome, folder: Path) -> None:
        """The motion is over: released when it ended well, else engaged with its cause."""
        if outcome.state in (State.FINISHED, State.STOPPED):
            self.release()
        else:
            self._write(self._latched(rig, outcome.cause, folder))

    def release(self) -> None:
        """Drives may be moved again."""
        try:
            self.path.unlink(missing_ok=True)
        except OSError as error:
            raise self._not_kept(error.strerror or str(error)) from None

    def _latched(self, rig: str, cause: str, folder: Path) -> Latched:
        now = datetime.now(UTC).isoformat(timespec="seconds")
        return Latched(self._bus, rig, cause, now, str(folder.resolve()), os.getpid())

    def _write(self, latched: Latched) -> None:
        try:
            write_atomic(self.path, json.dumps(asdict(latched), indent=1) + "\n")
            folder = os.open(self.path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
        except CdprError as error:
            raise self._not_kept(error.why) from None
        except OSError as error:
            raise self._not_kept(error.strerror or str(error)) from None

    def _refusal(self, latched: Latched | None) -> Refused:
        if latched is not None and _runs(latched.process):
            return Refused(
                f"a run (process {latched.process}) is under way on this bus",
                where=f"bus {self._bus}",
                next_step="wait for its end, or stop it with `cdpr stop`",
            )
        cause = latched.cause if latched else "another run is about to move it"
        since = f" since {latched.since}" if latched else ""
        return Refused(
            f"a fault is latched{since}: {cause}",
            where=f"bus {self._bus}",
            why=f"run folder {latched.folder}" if latched else "",
            next_step="find the cause and look at the platform, then `cdpr reset RIG`;"
            " nothing was moved",
        )

    def _not_kept(self, why: str) -> Refused:
        return Refused(
            "the latch cannot be written, so a fault would be forgotten",
            where=str(self.path),
            why=why,
            next_step="make the folder writable, or set XDG_STATE_HOME to one that is",
        )


def _state_folder() -> Path:
    base = os.environ.get("XDG_STATE_HOME")
    return (Path(base) if base else Path.home() / ".local" / "state") / "cdpr"


def _runs(process: int) -> bool:
    """Whether it is a run that can be reached; a number alone may be anybody's by now."""
    from executor.running import reached_runs

    with reached_runs() as runs:
        return any(run.process == process for run in runs)
