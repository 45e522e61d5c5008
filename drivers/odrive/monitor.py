"""State reported by ODrives with its age, and the resulting group faults. No bus, no clock."""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Mapping, Sequence
from typing import Literal

from drivers.can_load import HEARTBEATS_WAITED
from drivers.odrive.messages import (
    AxisError,
    AxisState,
    Layout,
    Layouts,
    can_id,
    error_text,
    status_word,
)
from drivers.plausibility import ReplyCheck
from drivers.setup_refusals import SETTING_UP, in_fault, moved_by_another
from model.errors import HardwareMissing, Refused
from model.files.rig_file import OdriveDocument
from model.rig import Rig

SPARE_CYCLES = 1
"""Cycles that a message may be late, as the drives' clocks are not synchronized."""

MISSED_TORQUES = 3
"""Further cycles without a torque that are a fault; `executor.safety.monitor` judges missing
positions."""

TORQUE_AFTER = 2
"""Cycles after which a torque is younger than the heartbeat that showed its drive under torque, or
than the opening of its brake: the drive measures and sends it by its own clock, and a cycle may end
between two of its messages."""

NEVER = 10**6

Report = Literal["heartbeat", "position", "torque"]

_SILENT = (
    "a drive has no power, is not on the bus, or its message periods are longer than in the rig"
    " file",
    "check power, wiring and the message periods",
)
NO_REPORT: dict[Report, tuple[str, str]] = {
    "heartbeat": _SILENT,
    "position": _SILENT,
    "torque": (
        "it is not sent, or less often than in the rig file; without it no tension is measured",
        "set torques_msg_rate_ms of every drive to drives.torques_ms",
    ),
}
NO_NUMBER: dict[Report, tuple[str, str]] = {
    "position": (
        "its encoder is not read, or has no absolute reference (absolute_setpoints)",
        "check the encoder with odrivetool",
    ),
    "torque": ("its motor currents are not measured", "check the motor with odrivetool"),
}
"""Cause and next step."""


class OdriveMonitor:
    """The last heartbeat, estimate and torque of every drive.

    Attributes:
        states: Axis states.
        errors: Axis errors.
        results: Procedure results.
        positions: [counts].
        torques: As the drives report them, [N·m].
    """

    def __init__(
        self, rig: Rig, document: OdriveDocument, layouts: Layouts, max_steps: Sequence[float]
    ) -> None:
        """Takes the largest motion of each drive in a cycle, [counts]."""
        count, cycle_ms = rig.cable_count, rig.document.bus.cycle_ms
        self.nodes = tuple(winch.node_id for winch in rig.winches)
        self.states, self.errors, self.results = [0] * count, [0] * count, [0] * count
        self.positions, self.torques = [0] * count, [0.0] * count
        self._names = rig.drive_names
        self._per_turn = [winch.counts_per_turn for winch in rig.winches]
        self._check = ReplyCheck(rig.drive_names, max_steps)
        self._fresh = [False] * count
        self._layouts = layouts
        # Limits of the cycles since the last message of each kind, and these cycles.
        self._most: dict[Report, int] = {
            "heartbeat": math.ceil(HEARTBEATS_WAITED * document.heartbeat_ms / cycle_ms),
            "position": math.ceil(document.estimates_ms / cycle_ms) + SPARE_CYCLES,
            "torque": math.ceil(document.torques_ms / cycle_ms) + SPARE_CYCLES,
        }
        self._ages = {report: [NEVER] * count for report in self._most}
        self._under_torque = [0] * count  # cycles since each drive was seen so
        opening = document.brake_opens_ms if any(winch.brake for winch in rig.winches) else 0.0
        self._torque_after = TORQUE_AFTER + math.ceil(opening / cycle_ms)
        self._not_numbers: set[tuple[Report, int]] = set()
        self._routes: dict[int, tuple[int, Layout, Callable[[int, tuple[float, ...]], None]]] = {}
        for drive, node in enumerate(self.nodes):
            for layout, note in (
                (layouts.heartbeat, self._heartbeat),
                (layouts.get_encoder_estimates, self._estimate),
                (layouts.get_torques, self._torque),
            ):
                self._routes[can_id(node, layout.command)] = drive, layout, note

    @property
    def window(self) -> int:
        """Number of last set-points to which the newest position may belong."""
        return self._most["position"] + 1

    @property
    def rejected(self) -> int:
        """Number of frames rejected for wrong length or implausible content."""
        return self._check.rejected

    @property
    def complete(self) -> bool:
        """Whether all reported a position in this cycle, and their states and torques are known."""
        return all(self._fresh) and self.heard("heartbeat", "torque")

    @property
    def missing(self) -> list[bool]:
        """True for drives whose last position is too old."""
        return self.overdue("position")

    @property
    def renewed(self) -> list[bool]:
        """True for drives that reported a position in the cycle that has just ended."""
        return [age == 1 for age in self._ages["position"]]

    @property
    def measures_tensions(self) -> bool:
        """Whether every axis is under torque, and has sent one since its brake must be open.

        An axis counts as armed as soon as its brake begins to open; until then the brake carries
        the cable, not the motor.
        """
        ages = zip(self._ages["torque"], self._under_torque, strict=True)
        return all(age + self._torque_after <= cycles for age, cycles in ages)

    @property
    def status_words(self) -> list[int]:
        """The state of each axis as one number (`status_word`)."""
        return [status_word(s, e) for s, e in zip(self.states, self.errors, strict=True)]

    def begin_cycle(self) -> None:
        """Starts a new cycle of messages."""
        self._check.begin_cycle()
        self._fresh = [False] * len(self.nodes)

    def end_cycle(self) -> None:
        """Ends a cycle: ages all messages by one cycle."""
        self._check.end_cycle()
        for ages in self._ages.values():
            ages[:] = [age + 1 for age in ages]
        for drive, state in enumerate(self.states):
            enabled = state == AxisState.CLOSED_LOOP_CONTROL
            self._under_torque[drive] = self._under_torque[drive] + 1 if enabled else 0

    def forget(self, report: Report) -> None:
        """Ignores the reports so far; any next position counts, as the drives may have moved."""
        if report == "position":
            self._check.forget_positions()
        self._ages[report] = [NEVER] * len(self.nodes)
        self._not_numbers -= {(report, drive) for drive in range(len(self.nodes))}

    def overdue(self, report: Report) -> list[bool]:
        """True for drives whose last report is too old, or that sent none since `forget`."""
        return [age > self._most[report] for age in self._ages[report]]

    def heard(self, *reports: Report) -> bool:
        """Whether none of these reports of any drive is overdue."""
        return not any(any(self.overdue(report)) for report in reports)

    def unheard(self, where: str, *reports: Report) -> HardwareMissing:
        """Error about the first overdue report, with the drives that send none, or no number."""
        report = next((each for each in reports if not self.heard(each)), reports[0])
        overdue = [drive for drive, late in enumerate(self.overdue(report)) if late]
        silent = [drive for drive in overdue if (report, drive) not in self._not_numbers]
        names = ", ".join(
            str(self.nodes[drive]) for drive in silent or overdue or range(len(self.nodes))
        )
        no_number = ": it is not a number" if overdue and not silent else ""
        why, next_step = NO_NUMBER[report] if no_number else NO_REPORT[report]
        return HardwareMissing(
            f"no {report} from drives {names}{no_number}",
            where=where,
            why=why,
            next_step=next_step,
            values={"nodes": names},
        )

    def take(self, can_id: int, data: bytes | bytearray, *, stale: bool = False) -> None:
        """Processes one frame; drives send asynchronously, so the newest always counts."""
        route = self._routes.get(can_id)
        if route is None:
            return
        drive, layout, note = route
        values = layout.unpack(data)
        if values is None:
            if data:  # without data it is a request of another program
                self._check.reject(drive, f"its {layout.name} has {len(data)} bytes instead of 8")
        else:
            note(drive, values)

    def in_state(self, state: AxisState) -> bool:
        """Whether every axis is in a state."""
        return all(known == state for known in self.states)

    def any_enabled(self) -> bool:
        """Whether an axis follows set-points."""
        return AxisState.CLOSED_LOOP_CONTROL in self.states

    def take_expired(self, drives: Container[int]) -> list[int]:
        """The drives whose only error is their watchdog; forgets it until reported again."""
        expired = [
            drive
            for drive, errors in enumerate(self.errors)
            if drive in drives and errors == AxisError.WATCHDOG_TIMER_EXPIRED
        ]
        for drive in expired:
            self.errors[drive] = 0
        return expired

    def faults(
        self, *, powered: bool, enabled: bool, at_rest: Container[int] = ()
    ) -> list[tuple[int, str]]:
        """Present faults of the drives, by node.

        Args:
            powered: The group is under power or being enabled, so that silence is a fault.
            enabled: Every axis must be enabled.
            at_rest: Drives, by index, whose axis was not armed. Their brakes hold, so an expired
                watchdog is no fault; `take_expired` finds those to clear before arming.
        """
        found = []
        for drive, (node, errors) in enumerate(zip(self.nodes, self.errors, strict=True)):
            excused = AxisError.WATCHDOG_TIMER_EXPIRED if drive in at_rest else 0
            if errors & ~excused:
                found.append((node, f"{self._names[node]}: {error_text(errors)}"))
        if enabled:
            found += [
                (
                    node,
                    f"{self._names[node]} disarmed itself; its brake holds (axis state {state})",
                )
                for node, state in zip(self.nodes, self.states, strict=True)
                if state != AxisState.CLOSED_LOOP_CONTROL
            ]
        return found + (self._silent() + self._check.faults() if powered else [])

    def _silent(self) -> list[tuple[int, str]]:
        found: list[tuple[int, str]] = []
        for drive, node in enumerate(self.nodes):
            late = {kind: self._ages[kind][drive] - self._most[kind] for kind in self._most}
            if late["heartbeat"] > 0:
                found.append((node, f"{self._names[node]}: heartbeat missing"))
            if late["torque"] > MISSED_TORQUES:
                found.append((node, f"{self._names[node]} does not report its torque"))
        return found

    def _heartbeat(self, drive: int, values: tuple[float, ...]) -> None:
        errors, state, result = values
        self.errors[drive], self.states[drive] = int(errors), int(state)
        self.results[drive] = int(result)
        self._ages["heartbeat"][drive] = 0

    def _estimate(self, drive: int, values: tuple[float, ...]) -> None:
        turns, _ = values
        if not self._is_number("position", drive, turns):
            return
        position = round(turns * self._per_turn[drive])
        if self._check.accept(drive, position):
            self.positions[drive] = position
            self._ages["position"][drive] = 0
            self._fresh[drive] = True

    def _torque(self, drive: int, values: tuple[float, ...]) -> None:
        _, torque = values
        if self._is_number("torque", drive, torque):
            self.torques[drive] = torque
            self._ages["torque"][drive] = 0

    def _is_number(self, report: Report, drive: int, value: float) -> bool:
        if math.isfinite(value):
            self._not_numbers.discard((report, drive))
            return True
        self._not_numbers.add((report, drive))
        self._check.reject(drive, f"its {report} is not a number")
        return False


# Refusals during set-up, by what the drives report.


def no_version(nodes: str) -> HardwareMissing:
    """Refusal of drives that do not answer a request for their version."""
    return HardwareMissing(
        f"drive{'s' if ',' in nodes else ''} {nodes}: heartbeats, but no Get_Version",
        where=SETTING_UP,
        why="firmware 0.5, which every ODrive 3.x has, or an adapter without remote frames",
        next_step="use ODrive Pro, S1 or Micro, as 3.x has no firmware 0.6; if these are in use,"
        " check the adapter",
        values={"nodes": nodes},
    )


def not_idle(node: int, state: int) -> Refused:
    """Refusal of a drive whose axis is in another state."""
    if state == AxisState.CLOSED_LOOP_CONTROL:
        return moved_by_another(node, "already enabled", "Heartbeat")
    return Refused(
        f"drive {node} is in axis state {state}",
        where=f"drive {node}, Heartbeat",
        why="it starts, calibrates or homes by its own settings (axis0.config.startup_*), or"
        " another program asked for it",
        next_step="wait until it is idle, and set all axis0.config.startup_* to False; or end the"
        " other program",
        values={"node": node},
    )


def in_error(node: int, errors: int) -> Refused:
    """Refusal of an idle drive with errors."""
    why = "it disarmed itself; its brake holds the cable"
    if errors & AxisError.DC_BUS_UNDER_VOLTAGE:
        why = "its motor supply is off or too low, or was while it was enabled; its brake holds"
    elif errors & AxisError.INITIALIZING:
        why = "it was switched on or restarted just now, or its electronics failed to start"
    return in_fault(node, f": {error_text(errors)}", "Heartbeat", why)


LISTENED = 20
"""Messages of a kind that a drive sends while its period is checked."""

LEAST_HEARD = 0.6
"""Part of them below which its period is longer; a computer may be late, real or simulating."""


def too_rare(
    nodes: Sequence[int], heard: Mapping[int, int], key: str, setting: str, period_ms: float
) -> HardwareMissing | None:
    """Refusal of drives that sent a message less often than in the rig file; None if none did.

    Args:
        heard: Messages of each while it should have sent `LISTENED`, by node.
        key: Of the period in the rig file.
        setting: Of the period in the drive.
        period_ms: In the rig file, [ms].
    """
    rare = [node for node in nodes if heard.get(node, 0) < LEAST_HEARD * LISTENED]
    if not rare:
        return None
    names = ", ".join(map(str, rare))
    report = "position" if key == "estimates_ms" else "torque"
    least, within = min(heard.get(node, 0) for node in rare), LISTENED * period_ms
    return HardwareMissing(
        f"drive{'s' if rare[1:] else ''} {names}: {report} less often than every {period_ms:g} ms"
        f" (drives.{key}), {least} instead of {LISTENED} in {within:g} ms",
        where=SETTING_UP,
        why="it is sent with another period or not at all, or frames are lost",
        next_step=f"set {setting} of every drive to drives.{key}",
        values={"nodes": names},
    )
