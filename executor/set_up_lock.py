"""Who sets the drives of a bus up, or asks them for objects, does so alone.

A drive answers one such request at a time and does not say to whom: the answer to somebody else's
would be taken for one's own. On a bus of this process alone (``virtual``) there is nobody else.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from cdpr.errors import Refused
from drivers.bus import IN_PROCESS, BusSettings
from executor.file_lock import locked_within
from executor.state_folder import state_file

#: Who only asks how the drives stand is done within this, unless one does not answer, [s].
ASKED_WITHIN = 5.0


class SetUpLock:
    """Of one bus."""

    def __init__(self, settings: BusSettings) -> None:
        """Looks at nothing yet."""
        self._bus, self._is_shared = str(settings), settings.interface != IN_PROCESS
        self._path = state_file("set-up", settings).with_suffix(".lock")

    @contextmanager
    def held(self) -> Iterator[None]:
        """For who sets the drives up, until they are done with; waits for those who only ask.

        Raises:
            Refused: Somebody else has it, or the lock cannot be made.
        """
        if not self._is_shared:
            yield
            return
        try:
            self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            lock = os.open(self._path, os.O_RDONLY | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise Refused(
                "it cannot be made sure that nobody else sets these drives up",
                where=str(self._path),
                why=error.strerror or str(error),
                next_step="make the folder writable for those who run the rig",
            ) from None
        try:
            if not locked_within(lock, ASKED_WITHIN):
                raise Refused(
                    "another program sets these drives up or asks them how they stand",
                    where=f"bus {self._bus}",
                    next_step="wait until it is done; `cdpr monitor` shows motions."
                    " Nothing was moved",
                )
            yield
        finally:
            os.close(lock)

    @contextmanager
    def tried(self) -> Iterator[bool]:
        """For who only asks: whether nobody else has it; then it is held. Makes no file."""
        try:
            lock = os.open(self._path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError:  # nobody set these drives up from here so far
            yield True
            return
        try:
            yield locked_within(lock, 0.0)
        finally:
            os.close(lock)
