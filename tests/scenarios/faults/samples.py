"""All states of simulated drives, and the invariants of each."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import can
import numpy as np

from drivers.cia402.pdo import EMCY_BASE, RPDO1_BASE, parse_emergency
from drivers.cia402.state_machine import TORQUE_ON, DriveState
from executor.trajectory.setpoints import PreparedRun
from model.pose import Array, Pose
from model.rig import Rig
from model.scene import Load
from simulation.drives.behaviour import STRICT, DriveBehaviour
from simulation.drives.cia402 import Frame
from simulation.drives.cia402_rig import SimulatedCia402Rig
from tests.drivers.drive_bench import parse_set_point

ENABLED = DriveState.OPERATION_ENABLED
DISABLE_VOLTAGE, FAULT_RESET = 0x02, 0x80


@dataclass(frozen=True, slots=True)
class Sample:
    """All drives at one time.

    Attributes:
        time: Of the drives, [s].
        syncs: SYNCs so far.
        states: One per drive.
        targets: Of each drive, [counts].
        positions: Of each drive, [counts].
    """

    time: float
    syncs: int
    states: tuple[DriveState, ...]
    targets: tuple[float, ...]
    positions: tuple[float, ...]


class WatchedRehearsal(SimulatedCia402Rig):
    """Keeps a sample at every time step or SYNC of a drive.

    Attributes:
        samples: In order.
        words: Every control word that reached a drive: time, node, word.
        emergencies: Every EMCY that a drive sent: time, node, error code.
        on_cycle: Called at every SYNC, before the drives hear it.
        deaf: Drives that do not hear the next SYNC (set from outside).
    """

    def __init__(
        self,
        rig: Rig,
        bus: can.BusABC,
        start_pose: Pose,
        load: Load | None,
        *,
        behaviour: DriveBehaviour = STRICT,
        eds: Path | None = None,
    ) -> None:
        self.samples: list[Sample] = []
        self.words: list[tuple[float, int, int]] = []
        self.emergencies: list[tuple[float, int, int]] = []
        self.on_cycle: Callable[[], None] = lambda: None
        self.deaf: set[int] = set()
        self.passed = 0.0
        self.real = False
        super().__init__(rig, bus, start_pose, load, behaviour=behaviour, eds=eds)

    @property
    def now(self) -> float:
        """The time of samples, [s]."""
        return time.monotonic() if self.real else self.passed

    def serve_until(self, over: threading.Event) -> None:
        """In real time."""
        self.real = True
        self.serve(over.is_set)

    def _handle(self, message: can.Message) -> None:
        node = message.arbitration_id - RPDO1_BASE
        if 1 <= node <= 127 and (set_point := parse_set_point(message.data)) is not None:
            self.words.append((self.now, node, set_point[0]))
        super()._handle(message)

    def _send(self, can_id: int, data: Frame) -> None:
        if (
            EMCY_BASE < can_id < EMCY_BASE + 128
            and (emergency := parse_emergency(data)) is not None
        ):
            self.emergencies.append((self.now, can_id - EMCY_BASE, emergency.code))
        super()._send(can_id, data)

    def _advance(self, elapsed: float) -> None:
        super()._advance(elapsed)
        self.passed += elapsed
        self._keep(self.now)

    def _on_sync(self, data: Frame) -> None:
        # Drives act at the SYNC; the computation time does not count.
        came = self.now
        self.on_cycle()
        heard = {i: self.drives[i] for i in self.deaf}
        was = {i: drive.silent for i, drive in heard.items()}
        for drive in heard.values():
            drive.silent = True
        super()._on_sync(data)
        for i, drive in heard.items():
            drive.silent = was[i]
        self.deaf = set()
        self._keep(came)

    def _keep(self, at: float) -> None:
        drives = self.drives
        state = (
            tuple(drive.state for drive in drives),
            tuple(drive._target for drive in drives),
            tuple(drive.motor.position for drive in drives),
        )
        last = self.samples[-1] if self.samples else None
        if last is None or state != (last.states, last.targets, last.positions):
            self.samples.append(Sample(at, self.cycles, *state))


@dataclass(frozen=True)
class Limits:
    """Limits for one rig and run.

    Attributes:
        steps: Largest change of a target, one a drive, [counts].
        table: Set-points of the run, shape (n, m), [counts].
        mixed: Longest time in which some drives are enabled and others are not, [s].
        rows: Of the table, that targets of drives may lie apart from a common one.
    """

    steps: Array
    table: Array
    mixed: float
    rows: float

    @classmethod
    def of(cls, prepared: PreparedRun, mixed_cycles: float, rows: float) -> Limits:
        cycle = prepared.checked.table.cycle
        winches = prepared.rig.winches
        steps = [w.max_speed * cycle * abs(w.counts_per_metre) + 1.0 for w in winches]
        table = prepared.checked.table.setpoints.astype(np.float64)
        return cls(np.array(steps), table, mixed_cycles * cycle + 1e-6, rows)


def violations(
    rehearsal: WatchedRehearsal,
    limits: Limits,
    *,
    lost: frozenset[int] = frozenset(),
    missed_start: bool = False,
) -> list[str]:
    """Violations at any sample.

    Args:
        rehearsal: After the run.
        limits: See `Limits`.
        lost: Drives, from 0, that were broken on purpose; they keep no limits.
        missed_start: The frame that enables was taken from a drive on purpose.
    """
    samples = rehearsal.samples
    kept = [i for i in range(len(rehearsal.drives)) if i not in lost]
    return [
        *_step_violations(samples, limits, kept),
        *_index_violations(samples, limits, kept, rehearsal.behaviour.position_noise),
        *_mixture_violations(samples, limits, kept, missed_start),
        *_torque_violations(samples, kept),
        *_word_violations(rehearsal),
        *_return_violations(samples, kept),
    ]


def _step_violations(samples: list[Sample], limits: Limits, kept: list[int]) -> list[str]:
    found = []
    for before, after in pairwise(samples):
        for i in kept:
            if before.states[i] is after.states[i] is ENABLED:
                step = abs(after.targets[i] - before.targets[i])
                if step > limits.steps[i]:
                    found.append(f"{after.time:.3f} s: target of drive {i + 1} jumps by {step:.0f}")
    return found


def _index_violations(
    samples: list[Sample], limits: Limits, kept: list[int], noise: float
) -> list[str]:
    """All targets are at a common table index, within a row; from the first row on.

    A drive begins from a position that it reported with noise, [counts]: 4 standard deviations.
    """
    moving = [s for s in samples if all(s.states[i] is ENABLED for i in kept)]
    if not moving or not kept:
        return []
    targets = np.array([s.targets for s in moving])[:, kept]
    table = limits.table[:, kept]
    most = int(np.argmax(np.abs(table[-1] - table[0])))
    rows = np.arange(len(table), dtype=np.float64)
    sign = np.sign(table[-1, most] - table[0, most]) or 1.0
    rising = np.maximum.accumulate(sign * table[:, most])
    index = np.interp(sign * targets[:, most], rising, rows)
    begun = index > 0.0
    blur = 1.0 / np.maximum(np.interp(index, rows, np.abs(np.gradient(table[:, most]))), 1e-9)
    reach = limits.rows + np.minimum(blur, len(table))
    low, high = np.full(targets.shape, np.inf), np.full(targets.shape, -np.inf)
    for share in np.linspace(-1.0, 1.0, 9):
        common_index = np.clip(index + share * reach, 0.0, len(table) - 1.0)
        there = np.column_stack([np.interp(common_index, rows, column) for column in table.T])
        low, high = np.minimum(low, there), np.maximum(high, there)
    off = np.maximum(low - targets, targets - high) - 1.5 - 4.0 * noise
    return [
        f"{moving[k].time:.3f} s: drive {kept[j] + 1} is {off[k, j]:.1f} counts off row"
        f" {index[k]:.1f}"
        for k, j in np.argwhere((off > 0.0) & begun[:, None])
    ]


def _mixture_violations(
    samples: list[Sample], limits: Limits, kept: list[int], missed_start: bool
) -> list[str]:
    """Drives become enabled together, and are not enabled without each other for long."""
    found, since = [], None
    for before, after in pairwise(samples):
        enabled = [after.states[i] is ENABLED for i in kept]
        new = [e and before.states[i] is not ENABLED for i, e in zip(kept, enabled, strict=True)]
        if any(new) and not all(new) and not missed_start:
            found.append(f"{after.time:.3f} s: some drives are enabled, others are not")
        if any(enabled) and not all(enabled):
            since = after.time if since is None else since
            if after.time - since > limits.mixed:
                found.append(f"{after.time:.3f} s: some drives go on while others have stopped")
        else:
            since = None
    return found


def _torque_violations(samples: list[Sample], kept: list[int]) -> list[str]:
    """No drive releases once it holds by torque; without torque the brake holds the drum."""
    found = []
    for before, after in pairwise(samples):
        for i in kept:
            if before.states[i] in TORQUE_ON and after.states[i] not in TORQUE_ON:
                found.append(f"{after.time:.3f} s: drive {i + 1} takes its torque off")
            loose = before.states[i] not in TORQUE_ON and after.states[i] not in TORQUE_ON
            if loose and before.positions[i] != after.positions[i]:
                found.append(f"{after.time:.3f} s: drum {i + 1} turns without torque")
    return found


def _word_violations(rehearsal: WatchedRehearsal) -> list[str]:
    return [
        f"{at:.3f} s: control word {word:02X}h to node {node}"
        for at, node, word in rehearsal.words
        if not word & DISABLE_VOLTAGE or word & FAULT_RESET
    ]


def emergencies(
    rehearsal: WatchedRehearsal, until: float = float("inf"), allowed: int = 0
) -> list[str]:
    """EMCY of any drive before a time [s]; no action of a master may cause one.

    Args:
        rehearsal: After the run.
        until: Of the drives' time.
        allowed: A code that the drives send by themselves.
    """
    return [
        f"{at:.3f} s: EMCY {code:04X}h from node {node}"
        for at, node, code in rehearsal.emergencies
        if at < until and code not in (0, allowed)
    ]


def left_holding(rehearsal: WatchedRehearsal, but: Collection[int] = ()) -> list[str]:
    """Drives, from 0, that do not hold on their own after the program ended, with exceptions."""
    return [
        f"drive {number} is in {drive.state.value} after the end"
        for number, drive in enumerate(rehearsal.drives, start=1)
        if drive.state is not DriveState.QUICK_STOP_ACTIVE and number - 1 not in but
    ]


def _return_violations(samples: list[Sample], kept: list[int]) -> list[str]:
    """A drive that was enabled and stopped is not enabled again in the same run."""
    found = []
    over: set[int] = set()
    for before, after in pairwise(samples):
        for i in kept:
            if before.states[i] is ENABLED and after.states[i] is not ENABLED:
                over.add(i)
            elif i in over and after.states[i] is ENABLED:
                found.append(f"{after.time:.3f} s: drive {i + 1} is enabled again")
    return found


@dataclass(frozen=True, slots=True)
class Stopped:
    """The stop of the drives after a fault.

    Attributes:
        time: Until the last of them no longer followed set-points, [s].
        spread: From the first to the last of them, [s].
        worst_step: Largest change of a target in the whole run, [m of cable].
        travel: Largest travel of a drum after the fault, [m of cable].
    """

    time: float
    spread: float
    worst_step: float
    travel: float


def stopped(
    rehearsal: WatchedRehearsal, rig: Rig, since: float, lost: frozenset[int] = frozenset()
) -> Stopped:
    """The stop after a fault at a time, [s], of the drives that could stop."""
    samples = rehearsal.samples
    kept = [i for i in range(len(rehearsal.drives)) if i not in lost]
    per_metre = np.abs([w.counts_per_metre for w in rig.winches])[kept]
    ends = []
    for i in kept:
        enabled = [k for k, s in enumerate(samples) if s.states[i] is ENABLED]
        after = enabled[-1] + 1 if enabled else 0
        ends.append(samples[after].time if after < len(samples) else float("inf"))
    steps = [
        np.abs(np.array(b.targets) - a.targets)[kept] / per_metre
        for a, b in pairwise(samples)
        if all(a.states[i] is b.states[i] is ENABLED for i in kept)
    ]
    where = [s.positions for s in samples if s.time >= since - 1e-9]
    travel = np.abs(np.array(where) - where[0])[:, kept] / per_metre if where else np.zeros(1)
    return Stopped(
        time=max(ends) - since,
        spread=max(ends) - min(ends),
        worst_step=float(np.max(steps)) if steps else 0.0,
        travel=float(travel.max()),
    )
