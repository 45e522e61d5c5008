"""Fault latch of a bus: while it is engaged, no process moves the drives.

It is a file in this computer's state folder (`executor.interlock.locks`). It is engaged before
anything moves and disengaged when the motion ended well; a fault leaves it engaged with its cause,
and a program that died or a computer that lost power leaves it engaged too. Only `cdpr reset`
disengages it then.

A program that moves or resets the drives also holds a file lock, which the system releases when
that program ends in any manner; this distinguishes an active run from the latch of an earlier one.
The locked file contains the program's process ID, and whether a fault was latched before.
"""

from __future__ import annotations

import fcntl
import json
import os
import weakref
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from drivers.can_bus import BusSettings
from executor.interlock.locks import (
    WRITABLE,
    locked_within,
    open_lock,
    read_state_file,
    state_files,
)
from executor.state_machine import State
from model.errors import BadInput, CdprError, Refused, StoppedByOperator
from model.files.documents import write_atomic

#: Readers of the lock release it within this time, [s].
LOCK_TIMEOUT = 0.5

#: Next step after a fault. A drive in fault is not reset while others hold the platform.
AFTER_A_FAULT = (
    "find the cause and check the platform; `cdpr status RIG` shows whether to run"
    " `cdpr release RIG` or to press the emergency stop before `cdpr reset RIG`"
)

_UNKNOWN = "unknown"
#: In the lock after the process ID.
_DURING_FAULT = " during a latched fault"
_CUT_SHORT = "a run did not finish: its program was killed, or the computer stopped"


@dataclass(frozen=True, slots=True)
class LatchedFault:
    """Why a bus is latched.

    Attributes:
        bus: Interface and channel.
        rig: Name of the rig.
        cause: One sentence.
        since: Time, ISO 8601, UTC.
        folder: Run folder.
        process: ID of the process that ran it.
        nodes: Node IDs of the rig's drives; empty if unknown.
    """

    bus: str
    rig: str
    cause: str
    since: str
    folder: str
    process: int
    nodes: tuple[int, ...]


class FaultLatch:
    """Fault latch of one bus."""

    def __init__(self, settings: BusSettings, nodes: Iterable[int] = ()) -> None:
        """Reads nothing yet.

        Args:
            nodes: Node IDs of the rig's drives, to engage or reset it.
        """
        self._bus, self._nodes = str(settings), tuple(nodes)
        self.path, *self._earlier = state_files("latched", settings)
        self._lock = self.path.with_suffix(".lock")
        self._held: weakref.finalize[[int], FaultLatch] | None = None

    def read(self) -> LatchedFault | None:
        """The latched fault, or None. A file that cannot be read counts as engaged."""
        for path in (self.path, *self._earlier):
            with suppress(FileNotFoundError):
                return self._read(path)
        return None

    def _read(self, path: Path) -> LatchedFault:
        try:
            latched = LatchedFault(**json.loads(read_state_file(path)))
            return replace(latched, nodes=tuple(map(int, latched.nodes)))
        except FileNotFoundError:
            raise
        except (OSError, ValueError, TypeError, AttributeError, RecursionError, Refused) as error:
            why = f"{error.where}: {error.what}" if isinstance(error, Refused) else error
            cause = f"the latch file cannot be read: {why}"
            return LatchedFault(self._bus, _UNKNOWN, cause, _UNKNOWN, _UNKNOWN, 0, ())

    def read_in_motion(self) -> tuple[LatchedFault | None, int | None]:
        """The latched fault, and the process that moves or resets the drives now, consistently.

        Returns:
            The fault, without that of the active motion, which is latched only if it ends badly,
            and the process ID (0 if unknown); None for each that there is not.
        """
        latched = self.read()
        while True:
            held = self._lock_text()
            again = self.read()
            if again == latched:
                break
            latched = again
        if latched is None or held is None:
            return latched, None
        holder = _process_in(held)
        is_of_motion = _DURING_FAULT not in held and holder in (0, latched.process)
        return (None if is_of_motion else latched), holder or latched.process

    def is_of_unfinished_motion(self) -> bool:
        """Whether a motion is in progress, or its program was killed: where it ended is unknown."""
        latched = self.read()
        return latched is not None and latched.cause == _CUT_SHORT

    def require_disengaged(self) -> None:
        """Requires the latch to be disengaged.

        Raises:
            Refused: It is engaged; with the cause.
        """
        latched = self.read()
        if latched is not None:
            raise self._refusal(latched)

    def require_no_run(self) -> None:
        """Requires that no run is active on this bus.

        Raises:
            Refused: One is.
        """
        latched = self.read()
        if latched is not None and self.held_by_another():
            raise self._refusal(latched)

    def is_of(self, latched: LatchedFault, rig: str) -> bool:
        """Whether a fault is of the rig of this name, and all its drives are known here."""
        return latched.rig == rig and not self._unknown_nodes(latched)

    def _unknown_nodes(self, latched: LatchedFault) -> list[int]:
        return sorted({*latched.nodes} - {*self._nodes})

    def why_not_reset(self, rig: str, latched: LatchedFault) -> Refused | None:
        """Why a fault is not reset with the rig of this name and its drives; None if it may be."""
        if latched.rig not in (rig, _UNKNOWN):
            return Refused(
                f"the latched fault belongs to rig {latched.rig!r}, not to {rig!r}",
                where=f"bus {self._bus}",
                why="its drives are not all known here, and would not be checked",
                next_step=f"run `cdpr reset` with the rig file of {latched.rig!r}; if it was"
                " renamed, write its former name there for the reset",
            )
        if unknown := self._unknown_nodes(latched):
            return Refused(
                f"the latched fault also concerns drives that are not in the rig file: node"
                f" {', '.join(map(str, unknown))}",
                where=f"bus {self._bus}",
                why="they would not be checked",
                next_step="run `cdpr reset` with the rig file it happened with; a drive that was"
                " replaced needs its former node id for the reset",
            )
        return None

    @contextmanager
    def held_for_reset(self, rig: str, shown: LatchedFault | None) -> Iterator[None]:
        """Blocks runs while the block resets the drives, then disengages the latch.

        If the block is refused, the latch stays as it was; if it fails, the latch is engaged.

        Args:
            shown: The fault that the operator confirmed.

        Raises:
            Refused: Another fault is latched now, or one of another rig on this bus, or with
                drives that are not known here.
        """
        if shown is not None and (refusal := self.why_not_reset(rig, shown)):
            raise refusal
        if shown is None:
            self.engage(rig, self.path.parent, "a reset did not finish")
        else:
            self.hold_engaged(shown)
        try:
            yield
        except BaseException as error:
            if shown is None and isinstance(error, Refused | BadInput | StoppedByOperator):
                self.disengage()
            elif shown is None and isinstance(error, CdprError):
                self.settle(rig, State.LATCHED, error.what, self.path.parent)
            self.let_go()
            raise
        self.disengage()

    def hold_engaged(self, shown: LatchedFault) -> None:
        """Blocks runs and resets, with the latch engaged, until `let_go`.

        Args:
            shown: The fault that the operator confirmed.

        Raises:
            Refused: Another fault is latched now, or another program moves or resets the drives.
        """
        self._hold(_DURING_FAULT)
        if self.read() != shown:
            self.let_go()
            raise Refused(
                "the latched fault changed since it was shown",
                where=f"bus {self._bus}",
                why="another user reset this bus, or moved it",
                next_step="run the command again; nothing was changed",
            )

    def engage(self, rig: str, folder: Path, cause: str = _CUT_SHORT) -> None:
        """Engages the latch before a run; it stays if the run does not finish.

        Args:
            folder: Record of the run.

        Raises:
            Refused: It is already engaged, or cannot be written.
        """
        self.require_disengaged()
        try:
            self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        except OSError as error:
            raise self._not_kept(error.strerror) from None
        self._hold()
        try:
            self.require_disengaged()  # no other program engages it from here on
            self._write(self._latched(rig, cause, folder))
        except BaseException:
            self.let_go()
            raise

    def settle(self, rig: str, state: State, cause: str, folder: Path) -> None:
        """Disengages after a motion that ended well, else engages with its cause."""
        if state in (State.FINISHED, State.STOPPED):
            self.disengage()
        else:
            self._write(self._latched(rig, cause, folder))
            self.let_go()

    def disengage(self) -> None:
        """Disengages the latch: drives may be moved again.

        A fault of another rig where it was before stays: its drives were not checked.
        """
        latched = self.read()
        try:
            for path in (*self._earlier, self.path):
                with suppress(FileNotFoundError):
                    if path == self.path or latched is None or self._read(path).rig == latched.rig:
                        path.unlink()
        except OSError as error:
            raise self._not_kept(error.strerror) from None
        self.let_go()

    def _hold(self, state: str = "") -> None:
        """Takes the lock until it is released or this program ends; waits for readers.

        Args:
            state: `_DURING_FAULT` if a fault is latched.
        """
        if self._held is not None:
            return
        try:
            lock = open_lock(self._lock, create=True)
        except OSError as error:
            raise self._not_kept(error.strerror) from None
        try:
            if not locked_within(lock, LOCK_TIMEOUT):
                raise self._refusal(self.read())
            with suppress(OSError):  # another user's file of an earlier version
                os.truncate(lock, 0)
                os.pwrite(lock, f"{os.getpid()}{state}".encode(), 0)
        except BaseException:
            os.close(lock)
            raise
        self._held = weakref.finalize(self, os.close, lock)

    def let_go(self) -> None:
        """Ends the block of other programs; the latch stays as it is."""
        if self._held is not None:
            self._held()
            self._held = None

    def held_by_another(self) -> bool:
        """Whether another program is moving or resetting the drives now."""
        return self.holder() is not None

    def holder(self) -> int | None:
        """Process ID of another program that moves or resets the drives now; 0 if unknown."""
        held = self._lock_text()
        return None if held is None else _process_in(held)

    def _lock_text(self) -> str | None:
        """Content of the lock that another program holds; None if none does."""
        if self._held is not None:
            return None
        try:
            lock = open_lock(self._lock)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise self._not_kept(error.strerror) from None
        try:
            if locked_within(lock, 0.0, fcntl.LOCK_SH):
                return None
            return os.pread(lock, 40, 0).decode("ascii", "replace")
        finally:
            os.close(lock)

    def _latched(self, rig: str, cause: str, folder: Path) -> LatchedFault:
        now = datetime.now(UTC).isoformat(timespec="seconds")
        return LatchedFault(
            self._bus, rig, cause, now, str(folder.resolve()), os.getpid(), self._nodes
        )

    def _write(self, latched: LatchedFault) -> None:
        try:
            write_atomic(self.path, json.dumps(asdict(latched), indent=1) + "\n", durable=True)
        except CdprError as error:
            raise self._not_kept(error.why) from None

    def _refusal(self, latched: LatchedFault | None) -> Refused:
        holder = self.holder()
        if latched is None or holder is not None:
            process = holder or (latched.process if latched else 0)
            who = f" (process {process})" if process else ""
            return Refused(
                f"a motion or a reset{who} is in progress on this bus",
                where=f"bus {self._bus}",
                next_step="wait until it ends, or stop it with `cdpr stop` (`sudo cdpr stop` if it"
                " belongs to another user)",
            )
        return Refused(
            f"a fault is latched since {latched.since}: {latched.cause}",
            where=f"bus {self._bus}",
            why=f"on record in {latched.folder}",
            next_step=f"{AFTER_A_FAULT}; nothing was moved",
        )

    def _not_kept(self, why: str | None) -> Refused:
        return Refused(
            "the fault latch cannot be written",
            where=str(self.path),
            why=why or "the operating system gives no reason",
            next_step=WRITABLE,
        )


def _process_in(lock_text: str) -> int:
    """The process ID in the text of a lock; 0 if unknown."""
    number = lock_text.partition(" ")[0]
    return int(number) if number.isdecimal() else 0
