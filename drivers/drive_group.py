"""Interface of the drives for the executor, independent of the protocol."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from model.errors import CdprError

Counts = NDArray[np.int64]
Pump = Callable[[], None]
"""Steps drives simulated in this process, which process the waiting frames."""

Pace = Callable[[], float]
"""Waits until a cycle is due; returns the time for its replies, [s]."""

OnRestarted = Callable[[tuple[int, ...]], None]
"""Called with nodes found without this program's configuration; see `DriveGroup.configure`."""


def how_to_reset(*, braked: bool) -> str:
    """How to reset a drive in fault while others hold the platform.

    Args:
        braked: Every winch has a brake.
    """
    release = "run `cdpr release RIG`, which closes all brakes together, or " if braked else ""
    return (
        f"support the platform; {release}press the emergency stop, which removes all torque, and"
        " release it; then run `cdpr reset RIG`"
    )


WHOLE_BUS = 0
"""Used instead of a node for a fault of the whole bus."""


class GroupState(Enum):
    """State of the group; drives are enabled only by a command."""

    OFFLINE = auto()
    """Not configured."""
    CONFIGURED = auto()
    """Configured and verified; positions are valid after the first cycle; no drive is enabled."""
    ENABLING = auto()
    """Changing to ENABLED, with each drive commanded to hold its position. If a drive takes too
    long, the group changes to FAULT."""
    ENABLED = auto()
    """All drives follow the set-points."""
    QUICK_STOP = auto()
    """All drives were commanded to stop and hold under torque."""
    FAULT = auto()
    """As QUICK_STOP, because of a fault; latched until RESET_FAULT."""
    RELEASED = auto()
    """No drive has torque; brakes, if any, are closed."""


class GroupCommand(Enum):
    """Commands to the group."""

    ENABLE = auto()
    QUICK_STOP = auto()
    RELEASE = auto()
    """Close brakes, then remove the torque of all drives together; needs a supported platform."""
    RESET_FAULT = auto()
    END_MONITORING = auto()
    """Drives at rest stop monitoring this master, which is about to leave, in the next cycles until
    `DriveGroup.is_monitored` is false."""


@dataclass(frozen=True, slots=True)
class Capabilities:
    """Autonomous functions of the drives, on which arming depends.

    Attributes:
        sync: All drives apply their set-points at the same SYNC.
        holds_on_comm_loss: A drive that loses its master stops and holds under torque.
        holds_on_quick_stop: A quick stop ends in holding under torque.
        has_brake: Every winch has a brake that closes before the torque is removed.
        max_hz: Highest tested cycle rate, [Hz].
        watchdog_ms: A drive without SYNC disarms itself, which closes its brake, after this time
            without a set-point, [ms]; None without such a watchdog.
        sync_timeout: Cycles without SYNC after which a drive stops itself; None without SYNC.
        master_timeout: Longest time until a drive reacts to the loss of this master, [s].
        released_within: Longest time until all drives are without torque, brakes closed, [s].
        unmonitored_within: Longest time until answering drives confirm that they no longer monitor
            this master, [s].
        simulated: All drives identify themselves as simulated; known once configured.
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
    released_within: float = 3.0
    simulated: bool = False


@dataclass(frozen=True, slots=True)
class DriveWarning:
    """An emergency that only warns.

    Attributes:
        node: Of the drive.
        text: Message with cable and drive.
    """

    node: int
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class CycleStatus:
    """Replies of the drives in one cycle; arrays are read-only, in the order of the winches.

    Attributes:
        positions: Actual positions at the cycle's SYNC, or as reported in it, shape (m,), [counts];
            the last known one for a missing drive.
        demands: Commanded positions at the time of `positions`, shape (m,), [counts]: at a SYNC the
            targets of the previous cycle. `positions - demands` is the following error.
        set_points: Set-points by which a stalled drive is detected, shape (m,), [counts]: `demands`
            or, where these are chosen by `positions`, the last ones sent.
        renewed: True for drives whose position is new in this cycle, shape (m,).
        torques: Actual torques, positive when winding in, shape (m,), [per mille of
            rated torque]. Tension at rest is torque / 1000 times the winch's `torque_constant`.
        status_words: State of each drive in the code of its protocol, shape (m,); see
            `drive_states`.
        missing: True for drives whose reply of this cycle is overdue, shape (m,).
        faults: Node and text of every fault since the last reset, oldest first; the text names
            cable and drive, and the node is `WHOLE_BUS` for a fault of the bus.
        state: State of the group.
        holding: Whether every cable is held, by its drive under torque or by its closed brake.
        stopped: Whether every drive follows no set-points, as it last reported: a missing one did
            so in an earlier cycle.
        rejected: Number of frames rejected since `configure` for wrong length or implausible
            content.
        error_frames: Number of error frames since `configure`.
        warnings: Of drives in this cycle; not latched.
    """

    positions: Counts
    demands: Counts
    set_points: Counts
    renewed: NDArray[np.bool_]
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

    @property
    def all_stopped(self) -> bool:
        """Whether every drive reported in this cycle that it follows no set-points."""
        return self.stopped and not self.missing.any()


@dataclass(frozen=True, slots=True, eq=False)
class DriveSnapshot:
    """State of the n drives that answered, read without configuring them, in order of the winches.

    Attributes:
        positions: Shape (n,), [counts].
        torques: Positive when winding in, shape (n,), [per mille of rated torque].
        status_words: Shape (n,); see `drive_states`.
        restarted: Nodes without this program's configuration: power-cycled, or never configured.
        errors: The error that each drive in fault stores, or why one at rest cannot be enabled, as
            text; empty without one, and for drives that show it in their state.
        silent: Nodes that did not answer; only of a partial reading.
        silence: The error that names them.
    """

    positions: Counts
    torques: Counts
    status_words: Counts
    restarted: tuple[int, ...]
    errors: tuple[str, ...]
    silent: tuple[int, ...] = ()
    silence: CdprError | None = None


class DriveGroup(Protocol):
    """All drives of a rig, which are enabled, moved and stopped together."""

    @property
    def capabilities(self) -> Capabilities:
        """Autonomous functions of the drives."""

    @property
    def state(self) -> GroupState:
        """State of the group."""

    @property
    def restarted(self) -> tuple[int, ...]:
        """Nodes that `configure` found without this program's configuration.

        They were power-cycled since, or never configured.
        """

    @property
    def stopping(self) -> bool:
        """Whether a stop needs more cycles, as the drives do not finish it themselves."""

    @property
    def targets(self) -> Counts:
        """Last targets sent, shape (m,), [counts]; motion after ENABLING starts from them."""

    def configure(
        self, *, to_reset: bool = False, on_restarted: OnRestarted | None = None
    ) -> tuple[str, ...]:
        """Configures every drive and reads every setting back.

        Args:
            to_reset: Accepts drives in fault too, which will be reset.
            on_restarted: Called with `restarted` before the first setting is written, as writing
                erases the evidence. An exception leaves the drives unchanged.

        Returns:
            Remarks for the operator on functions that drives lack although a run would use them.

        Raises:
            HardwareMissing: A drive does not answer.
            Refused: A drive refuses or changes a setting, or another program moves it.
        """

    def read_positions(self, pace: Pace | None = None) -> CycleStatus:
        """Waits until every drive has reported its position; changes no state.

        Args:
            pace: Called before each cycle: waits until it is due and returns the time for replies,
                [s] (default: no wait between cycles).

        Raises:
            HardwareMissing: A drive does not answer.
            Fault: The bus failed.
        """

    def send_cycle(
        self, targets: Sequence[int], may_send: Callable[[bool], bool] = lambda _enables: True
    ) -> None:
        """Sends one cycle: all set-points, then SYNC where the protocol has it.

        Args:
            targets: One position per drive, [counts]. They apply in state ENABLED; in every other
                state each drive is commanded to hold its position.
            may_send: Called immediately before SYNC with whether a set-point enables a drive. If
                it returns False, the cycle becomes a permanent quick stop of all drives.

        Raises:
            Fault: The bus did not accept a frame.
        """

    def receive(self, timeout_s: float) -> CycleStatus:
        """Receives the replies of this cycle until all have arrived or the time is over.

        Args:
            timeout_s: [s]; 0 processes only waiting frames.

        Raises:
            Fault: The bus failed.
        """

    def command(self, command: GroupCommand) -> None:
        """Sets the goal of the group, reached in steps of one cycle by all drives together.

        Raises:
            Refused: The command would make the platform less safe.
        """

    def require_releasable(self) -> None:
        """Checks whether RELEASE may be commanded at the present positions.

        Raises:
            Refused: It would make the platform less safe.
        """

    def quick_stop_now(self) -> None:
        """Sends the stop to all drives in one batch, without waiting.

        Raises:
            Fault: The bus did not accept a frame; the others were still sent.
        """

    @property
    def ending(self) -> frozenset[int]:
        """Indices of drives that have not confirmed the end of their monitoring."""

    @property
    def is_monitored(self) -> bool:
        """Whether drives still monitor this master, until all have confirmed the end."""

    def read_state(self, pace: Pace) -> CycleStatus:
        """Reads the state of every drive after the last cycle, without sending another.

        A drive without an answer is missing; one that missed the last cycle gets the time of one
        answer.

        Args:
            pace: Called before each request, as for `read_positions`.

        Raises:
            Fault: The bus failed.
        """

    def close(self) -> None:
        """Detaches from the bus, which the caller owns, without sending anything."""
