"""State that the drives report, and the resulting group faults. No bus, no clock."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from math import inf

from drivers.cia402.error_codes import HEARTBEAT_LOST, emergency_text
from drivers.cia402.pdo import (
    EMCY_BASE,
    HEARTBEAT_BASE,
    SDO_REPLY_BASE,
    TPDO1_BASE,
    NmtState,
    Reply,
    parse_emergency,
    parse_heartbeat,
    parse_reply,
)
from drivers.cia402.sdo_jobs import ERROR_REQUESTS, STATE_REQUESTS, SdoRequest
from drivers.cia402.state_machine import (
    FAULTED,
    FOLLOWS,
    INTERNAL_LIMIT,
    MAY_FOLLOW,
    POWER_BITS,
    TORQUE_ON,
    ControlWord,
    DriveState,
    Goal,
    change_on_its_own,
    late_drives,
    state_of,
    without_power,
)
from drivers.drive_group import DriveWarning, how_to_reset
from drivers.plausibility import ReplyCheck
from model.errors import Refused


def blocked(states: Mapping[int, DriveState]) -> list[int]:
    """Nodes in fault that may not be reset, as another drive holds the platform."""
    faulted = [node for node, state in states.items() if state in FAULTED]
    return faulted if any(state in TORQUE_ON for state in states.values()) else []


class DriveMonitor:
    """The last reply, emergency and heartbeat of every drive.

    Attributes:
        on_answer: Called with node and data of SDO answers.
    """

    def __init__(
        self,
        names: Mapping[int, str],
        max_steps: Sequence[float],
        is_warning: Callable[[int], bool] = lambda _code: False,
        heartbeat_cycles: float = inf,
        power_bits: int = POWER_BITS,
    ) -> None:
        """Starts without any reply.

        Args:
            max_steps: Largest motion of each drive in a cycle, [counts].
            is_warning: Whether an EMCY code is only a warning while the drive stays enabled.
            heartbeat_cycles: Cycles without a drive's heartbeat after which its peers may stop.
            power_bits: As ``bits`` of `without_power`.
        """
        count, nodes = len(names), tuple(names)
        self.nodes = nodes
        self._names = dict(names)
        self.status_words = [0] * count
        self.positions = [0] * count
        self.torques = [0] * count
        self.states = [DriveState.NOT_READY] * count
        self.answered = [False] * count
        self.restarted: set[int] = set()
        self._left_in_fault: frozenset[int] = frozenset()
        self._wrong_lengths = 0
        self._check = ReplyCheck(names, max_steps)
        self._is_warning = is_warning
        self._heartbeat_cycles, self._power_bits = heartbeat_cycles, power_bits
        self._cycle, self._heartbeat_at = 0, dict.fromkeys(nodes, 0)  # cycle of the last one
        self._warnings: list[DriveWarning] = []
        self._new_messages: list[tuple[int, str]] = []
        self._changes: list[tuple[int, DriveState, int]] = []  # former state, status word
        self._followed: set[int] = set()
        self._emergencies: dict[int, str] = {}
        self._stored: dict[int, str] = {}  # errors from before a reset, or read from the drives
        self._over: set[int] = set()
        self._replies = {TPDO1_BASE + node: i for i, node in enumerate(nodes)}
        self._others = {EMCY_BASE + node: self._emergency for node in nodes}
        self._others |= {HEARTBEAT_BASE + node: self._heartbeat for node in nodes}
        self._others |= {SDO_REPLY_BASE + node: self._answer for node in nodes}
        self.on_answer: Callable[[int, bytes | bytearray], None] = lambda _node, _data: None

    def begin_cycle(self) -> None:
        """Starts a new cycle of replies."""
        self._check.begin_cycle()
        self._cycle += 1
        self.answered = [False] * len(self.nodes)

    def end_cycle(self) -> None:
        """Counts the replies that were missing or rejected."""
        self._check.end_cycle()

    def forget_positions(self) -> None:
        """Accepts any next positions, as the drives may have been moved."""
        self._check.forget_positions()

    @property
    def rejected(self) -> int:
        """Number of frames rejected for wrong length or implausible content."""
        return self._check.rejected + self._wrong_lengths

    @property
    def complete(self) -> bool:
        """Whether every drive has answered in this cycle."""
        return all(self.answered)

    def stopped(self) -> set[int]:
        """Nodes that reported in this cycle that they follow no set-points."""
        rows = zip(self.nodes, self.answered, self.states, strict=True)
        return {node for node, heard, state in rows if heard and state not in MAY_FOLLOW}

    def take(self, can_id: int, data: bytes | bytearray, *, stale: bool = False) -> None:
        """Processes one frame.

        Args:
            stale: Replies belong to an earlier cycle and are discarded.
        """
        drive = self._replies.get(can_id)
        if drive is None:
            other = self._others.get(can_id)
            if other is not None:
                other(can_id & 0x7F, data)
            return
        self._check.count_reply(drive)
        if stale or self.answered[drive]:
            return
        reply = parse_reply(data)
        if reply is None:
            self._check.reject(drive, f"its reply has {len(data)} bytes instead of 8")
        elif self._check.accept(drive, reply.position):
            self._note(drive, reply)

    def _note(self, drive: int, reply: Reply) -> None:
        word, node = reply.status_word, self.nodes[drive]
        raised = word & ~self.status_words[drive]
        self.status_words[drive], self.positions[drive], self.torques[drive] = reply
        self.answered[drive] = True
        state, before = state_of(word), self.states[drive]
        self.states[drive] = state
        if state is not before:
            self._changes.append((node, before, word))
            self._followed.discard(node)
        elif raised & INTERNAL_LIMIT and state is DriveState.OPERATION_ENABLED:
            text = f"{self._names[node]} reports that an internal limit is active (bit 11 of 6041h)"
            self._warnings.append(DriveWarning(node, text))
        if word & FOLLOWS and state is DriveState.OPERATION_ENABLED:
            self._followed.add(node)

    def ignoring_targets(self) -> list[tuple[int, str]]:
        """Enabled drives whose bit 12 showed that they follow their targets, and no longer does."""
        rows = zip(self.nodes, self.status_words, strict=True)
        return [
            (node, f"{self._names[node]} ceased to follow its target (bit 12 of 6041h is 0 again)")
            for node, word in rows
            if node in self._followed and not word & FOLLOWS
        ]

    def warnings(self) -> tuple[DriveWarning, ...]:
        """Warnings since the last call: some emergencies, and limits reached while enabled.

        An emergency of a drive that stops nevertheless is the cause of its fault
        (`changes_on_their_own`, `state_faults`).
        """
        warnings, self._warnings = tuple(self._warnings), []
        return warnings

    def take_states(self, values: Mapping[tuple[int, SdoRequest], int]) -> None:
        """Takes the answers to `STATE_REQUESTS`; a drive with all of them counts as answered."""
        for drive, node in enumerate(self.nodes):
            if all((node, job) in values for job in STATE_REQUESTS):
                word, position, torque = (values[node, job] for job in STATE_REQUESTS)
                self._note(drive, Reply(word, _signed(position, 32), _signed(torque, 16)))

    def news(self) -> list[tuple[int, str]]:
        """Emergencies, lost heartbeats, restarts and NMT states, since the last call.

        An emergency counts at once: no reply could show before the next frames whether the drive
        has stopped, and "enable operation" in them would enable it again.
        """
        news, self._new_messages = self._new_messages, []
        return news

    def changes_on_their_own(self, goal: Goal, *, enables: bool) -> list[tuple[int, str]]:
        """Drives that changed their state without a command since the last call, by node.

        Arguments as for `drivers.cia402.state_machine.change_on_its_own`.
        """
        changes, self._changes = self._changes, []
        found: list[tuple[int, str]] = []
        for node, before, word in changes:
            what = change_on_its_own(goal, enables, before, state_of(word))
            if what is not None:
                cause = None if node in self._over else self._emergencies.get(node)
                reasons = [*([cause] if cause else []), *without_power(word, self._power_bits)]
                found.append((node, "; ".join([f"{self._names[node]} {what}", *reasons])))
        return found

    def state_faults(self, known: Container[str], *, powered: bool) -> list[tuple[int, str]]:
        """Present faults of the drives, by node.

        The executor judges silence (`executor.safety.monitor`).

        Args:
            known: Known faults; a drive whose emergency is among them is left out.
            powered: The group is under power or being enabled, so that rejected replies are a
                fault.
        """
        found: list[tuple[int, str]] = []
        for node, state in zip(self.nodes, self.states, strict=True):
            if state not in FAULTED or self._is_left(node, state):
                continue
            name = self._names[node]
            stored = self._stored.get(node, "no emergency message received")
            cause = self._emergencies.get(node, stored)
            if f"{name}: {cause}" not in known:
                since = ", reported as over since" if node in self._over else ""
                found.append((node, f"{name} is in {state.value}: {cause}{since}"))
        return found + (self._check.faults() if powered else [])

    def only_in_fault(self, faults: Sequence[tuple[int, str]]) -> frozenset[int]:
        """Nodes in fault, without torque, if these and nothing else are the faults; else none."""
        there = zip(self.nodes, self.states, strict=True)
        faulted = frozenset(node for node, state in there if state is DriveState.FAULT)
        alone = {node for node, _ in faults} == faulted and not self.restarted
        return faulted if alone else frozenset()

    def leave_in_fault(self, faults: Sequence[tuple[int, str]]) -> None:
        """From now on drives `only_in_fault` count as without torque while they stay so.

        Their brakes have closed already; any other fault is still one.
        """
        self._left_in_fault = self.only_in_fault(faults)

    def _is_left(self, node: int, state: DriveState) -> bool:
        return state is DriveState.FAULT and node in self._left_in_fault

    @property
    def states_to_command(self) -> list[DriveState]:
        """The states, where those left in fault count as *switch on disabled*."""
        if not self._left_in_fault:
            return self.states
        rows = zip(self.nodes, self.states, strict=True)
        return [
            DriveState.SWITCH_ON_DISABLED if self._is_left(node, state) else state
            for node, state in rows
        ]

    def late(
        self, commanded: Sequence[ControlWord], goal: Goal, seconds: float
    ) -> list[tuple[int, str]]:
        """`late_drives`, without those left in fault."""
        rows = [
            row
            for row in zip(self._names.items(), self.status_words, commanded, strict=True)
            if not self._is_left(row[0][0], state_of(row[1]))
        ]
        names, words, sent = zip(*rows, strict=True)
        return late_drives(dict(names), words, sent, goal, seconds, self._power_bits)

    def require_resettable(self, *, braked: bool) -> list[int]:
        """Nodes in fault; they may be reset only if no other drive holds the platform.

        Args:
            braked: Every winch has a brake.

        Raises:
            Refused: Another drive holds it, or a drive restarted.
        """
        if self.restarted:
            raise Refused(
                f"{self._names[min(self.restarted)]} restarted: its configuration and position are"
                " lost",
                where="drive group",
                next_step="configure the drives again and check the homing reference",
            )
        states = dict(zip(self.nodes, self.states, strict=True))
        if held_up := blocked(states):
            raise Refused(
                f"{self._names[held_up[0]]} cannot be reset while other drives hold the platform",
                where="drive group",
                why="resetting one drive of a platform under tension moves it",
                next_step=how_to_reset(braked=braked),
            )
        return [node for node, state in states.items() if state in FAULTED]

    def note_errors(self, codes: Mapping[int, int]) -> None:
        """Takes the error codes that drives in fault store, by node; 0 for none."""
        self._stored |= {
            node: f"{emergency_text(code)}, as stored in the drive"
            for node, code in codes.items()
            if code
        }

    def take_errors(self, values: Mapping[tuple[int, SdoRequest], int]) -> None:
        """Takes the answers to `ERROR_REQUESTS`; the first one that states an error counts."""
        for job in reversed(ERROR_REQUESTS):
            self.note_errors({n: v & 0xFFFF for (n, asked), v in values.items() if asked == job})

    def forget_emergencies(self) -> None:
        """Clears all emergencies after a reset by the operator; they explain a fault that stays."""
        self._stored |= {node: f"earlier: {text}" for node, text in self._emergencies.items()}
        self._emergencies.clear()
        self._over.clear()
        self._new_messages.clear()
        self._warnings = []

    def _emergency(self, node: int, data: bytes | bytearray) -> None:
        message = parse_emergency(data)
        if message is None:
            self._wrong_lengths += 1
        elif message.code & 0xFF00:
            text = emergency_text(message.code)
            self._take_emergency(node, message.code, text)
        elif node in self._emergencies:  # ended, but still the best explanation of a fault
            self._over.add(node)

    def _take_emergency(self, node: int, code: int, text: str) -> None:
        self._emergencies[node] = text
        self._over.discard(node)
        message = f"{self._names[node]}: {text}"
        if self._is_warning(code) and self.states[self.nodes.index(node)] not in FAULTED:
            self._warnings.append(DriveWarning(node, f"{message}, a warning"))
            return
        if code == HEARTBEAT_LOST:
            self._name_silent_peers()
        self._new_messages.append((node, message))

    def _name_silent_peers(self) -> None:
        """Names the drives whose heartbeat ceased, before those that miss it."""
        for node, last in self._heartbeat_at.items():
            message = node, f"{self._names[node]} sends no heartbeat"
            lost = self._cycle - last >= self._heartbeat_cycles and node not in self.restarted
            if lost and message not in self._new_messages:
                self._new_messages.append(message)

    def _answer(self, node: int, data: bytes | bytearray) -> None:
        self.on_answer(node, data)

    def _heartbeat(self, node: int, data: bytes | bytearray) -> None:
        self._heartbeat_at[node] = self._cycle
        state = parse_heartbeat(data)
        if state is None:
            self._wrong_lengths += 1
        elif state == NmtState.BOOT_UP:
            self.restarted.add(node)
            self._new_messages.append(
                (node, f"{self._names[node]} restarted: its configuration and position are lost")
            )
        elif state != NmtState.OPERATIONAL:
            self._new_messages.append((node, f"{self._names[node]} left the NMT state operational"))


def _signed(value: int, bits: int) -> int:
    return value - (1 << bits) if value >> (bits - 1) else value
