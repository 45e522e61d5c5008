"""What the executor sees of the drives, whatever their protocol: one group, commanded together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Counts = NDArray[np.int64]
Pump = Callable[[], None]
"""Lets drives that live in the caller's process work off what the bus holds for them."""

Pace = Callable[[], float]
"""Waits for the moment of a cycle; the time that replies have, [s]."""

OnRestarted = Callable[[tuple[int, ...]], None]
"""Takes note of nodes that were found without this program's set-up; see `DriveGroup.configure`."""


WHOLE_BUS = 0
"""In place of a node: the fault is not one drive's."""


class GroupState(Enum):
    """Where the whole group stands; it never moves towards power without a command."""

    OFFLINE = auto()
    """Not configured."""
    CONFIGURED = auto()
    """Set up and read back; positions are valid after the first cycle; no drive is enabled."""
    ENABLING = auto()
    """On the way to ENABLED; each drive is commanded to hold its position. The group gives up,
    in FAULT, when a drive takes too long."""
    ENABLED = auto()
    """All drives follow the set-points."""
    QUICK_STOP = auto()
    """All drives were commanded to stop and hold under torque."""
    FAULT = auto()
    """As QUICK_STOP, because of a fault; latched until RESET_FAULT."""
    RELEASED = auto()
    """No drive has torque any more; brakes, where there are such, are closed."""


class GroupCommand(Enum):
    """What an operator or the executor may ask of the group."""

    ENABLE = auto()
    QUICK_STOP = auto()
    RELEASE = auto()
    """Brakes close, then the torque goes, of all drives together: for a platform that stands on
    something."""
    RESET_FAULT = auto()
    END_MONITORING = auto()
    """Drives that follow nothing stop watching this master, which is about to leave; one step a
    cycle, until `DriveGroup.is_monitored` is false."""


@dataclass(frozen=True, slots=True)
class Capabilities:
    """What drives do by themselves; arming decides on it.

    Attributes:
        sync: All drives take their set-points at one SYNC.
        holds_on_comm_loss: A drive that loses its master stops and holds under torque.
        holds_on_quick_stop: A quick stop ends in holding under torque.
        has_brake: Every winch has a brake that closes before the torque goes.
        max_hz: Highest tested rate of cycles, [Hz].
        watchdog_ms: A drive without SYNC disarms itself, which closes its brake, after this time
            without a set-point, [ms]; None where there is no such watchdog.
        sync_timeout: Cycles without SYNC after which a drive stops by itself; None where drives
            know no SYNC.
        master_timeout: Longest time after which a drive acts on the loss of this master, [s].
        unmonitored_within: Longest time that drives which answer may take to confirm that they
            monitor this master no more, [s].
        simulated: All drives say that they are simulated; known once they are configured.
    """

    sync: bool
    holds_on_comm_loss: bool
    holds_on_quick_stop: bool
    has_brake: bool
    max_hz: float
    watchdog_ms: float | None
    sync_timeout: float | None
    master_timeout: float
    unmonitored_within: float = 0.0
    simulated: bool = False


@dataclass(frozen=True, slots=True)
class DriveWarning:
    """What a drive reported in a cycle although it stays enabled.

    Attributes:
        node: Of the drive.
        text: What, with cable and drive.
        stops: The path must stop for it; false for a mere warning.
    """

    node: int
    text: str
    stops: bool


@dataclass(frozen=True, slots=True, eq=False)
class CycleStatus:
    """What the drives reported in one cycle; arrays are read-only and in the order of the winches.

    Attributes:
        positions: Actual positions at the cycle's SYNC, or as reported in it, shape (m,), [counts];
            the last known one where a drive is missing.
        demands: Commanded positions when the drives reported theirs, shape (m,), [counts]:
            at a SYNC the targets of one cycle before. `positions - demands` is the following error.
        torques: Actual torques, positive where they pull the cable in, shape (m,), [per mille of
            rated torque]. Tension at rest is torque / 1000 times the winch's `torque_constant`.
        status_words: The state of each drive in its protocol's code, shape (m,); `drive_states`
            gives their meaning.
        missing: True for drives from which this cycle's answer is overdue, shape (m,).
        faults: Node and text of every fault since the last reset, oldest first; the text names
            cable and drive, and the node is `WHOLE_BUS` where it is the bus that failed.
        state: State of the group.
        holding: Every cable is held: by its drive under torque, or by its closed brake.
        stopped: Every drive reported in this cycle that it follows no set-points.
        rejected: Frames thrown away since `configure` because their length or their content could
            not be true.
        error_frames: Error frames of the bus since `configure`.
        warnings: What drives that stay enabled reported in this cycle; none of it is latched.
    """

    positions: Counts
    demands: Counts
    torques: Counts
    status_words: Counts
    missing: NDArray[np.bool_]
    faults: tuple[tuple[int, str], ...]
    state: GroupState
    holding: bool
    stopped: bool
    rejected: int
    error_frames: int
    warnings: tuple[DriveWarning, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class DriveSnapshot:
    """State of drives that are only read; in the order of the winches, as in `CycleStatus`.

    Attributes:
        positions: Shape (m,), [counts].
        torques: Positive where they pull the cable in, shape (m,), [per mille of rated torque].
        status_words: Shape (m,); `drive_states` gives their meaning.
        restarted: Nodes that do not hold this program's set-up: switched on since, or never set up.
            Of drives that keep their settings without power all whose encoder is not absolute.
    """

    positions: Counts
    torques: Counts
    status_words: Counts
    restarted: tuple[int, ...]


class DriveGroup(Protocol):
    """All drives of a rig, enabled, moved and stopped together."""

    @property
    def capabilities(self) -> Capabilities:
        """What the drives do by themselves."""
        ...

    @property
    def state(self) -> GroupState:
        """Where the group stands."""
        ...

    @property
    def restarted(self) -> tuple[int, ...]:
        """Nodes that `configure` found without this program's set-up.

        They were switched on since they were last set up, or never were.
        """
        ...

    @property
    def stopping(self) -> bool:
        """A stop is under way that needs more cycles: the drives do not finish it by themselves."""
        ...

    @property
    def targets(self) -> Counts:
        """Targets last sent, shape (m,), [counts]; motion after ENABLING starts from them."""
        ...

    def configure(
        self, *, to_reset: bool = False, on_restarted: OnRestarted | None = None
    ) -> tuple[str, ...]:
        """Sets every drive up and reads every setting back.

        Args:
            to_reset: Also takes drives in fault, which are going to be reset.
            on_restarted: Called with `restarted` before the first setting is written: the set-up
                wipes out its evidence. What it raises leaves the drives as they were.

        Returns:
            Remarks for the operator: what drives cannot do although a run would use it.

        Raises:
            HardwareMissing: A drive does not answer.
            Refused: A drive refuses a setting, does not keep it, or is being moved by another.
        """
        ...

    def read_positions(self, pace: Pace | None = None) -> CycleStatus:
        """Waits until every drive has reported its position; changes no drive's state.

        Args:
            pace: Called before each cycle that is sent: waits for its moment and returns the time
                in which replies must come, [s]; left out, cycles follow on each other at once.

        Raises:
            HardwareMissing: A drive does not answer; with its node.
            Fault: The bus failed.
        """
        ...

    def send_cycle(
        self, targets: Sequence[int], may_send: Callable[[bool], bool] = lambda _enables: True
    ) -> None:
        """Sends one cycle: all set-points, and what makes them count together where there is such.

        Args:
            targets: One position a drive, [counts]. They count in state ENABLED; in every other
                state each drive is commanded to stay where it is.
            may_send: Called at the last moment, just before the frame that makes set-points count,
                with whether one of them enables a drive. Where it returns false no drive is
                commanded to follow: such a cycle becomes a quick stop of all drives, for good.

        Raises:
            Fault: The bus did not take a frame.
        """
        ...

    def receive(self, timeout_s: float) -> CycleStatus:
        """Takes the replies of this cycle until all are there or the time is over.

        Args:
            timeout_s: [s]; 0 takes only what has already arrived.

        Raises:
            Fault: The bus failed.
        """
        ...

    def command(self, command: GroupCommand) -> None:
        """Sets where the group goes; the way is one step a cycle, all drives together.

        Raises:
            Refused: The command would leave the platform less safe than it is.
        """
        ...

    def require_releasable(self) -> None:
        """Whether RELEASE may be commanded where the drives are now.

        Raises:
            Refused: It would leave the platform less safe than it is.
        """
        ...

    def quick_stop_now(self) -> None:
        """Sends the stop to all drives in one batch; waits for nothing.

        Raises:
            Fault: The bus did not take a frame; the others were sent all the same.
        """
        ...

    @property
    def ending(self) -> frozenset[int]:
        """Drives, from 0, that have not answered all that ends their monitoring of this master."""
        ...

    @property
    def is_monitored(self) -> bool:
        """Whether drives still watch this master, as far as they have confirmed the contrary."""
        ...

    def look(self, pace: Pace) -> CycleStatus:
        """Asks every drive how it stands without sending a cycle: after the last one.

        A drive that does not answer now is missing; one that did not answer the last cycle is
        waited for no longer than one answer takes.

        Args:
            pace: Called before each question, as for `read_positions`.

        Raises:
            Fault: The bus failed.
        """
        ...

    def close(self) -> None:
        """Lets go of the bus without sending anything; the bus itself is the caller's."""
        ...
