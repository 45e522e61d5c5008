"""What the drives told, and what of it is a fault of the group. No bus, no clock."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence

from drivers.cia402.frames import (
    EMCY_BASE,
    HEARTBEAT_BASE,
    TPDO1_BASE,
    NmtState,
    Reply,
    parse_emergency,
    parse_heartbeat,
    parse_reply,
)
from drivers.cia402.states import FAULTED, DriveState, state_of
from drivers.cia402.texts import emergency_text
from drivers.reply_check import ReplyCheck


class DriveWatch:
    """The last word of every drive: replies, emergencies, heartbeats."""

    def __init__(self, names: Mapping[int, str], max_steps: Sequence[float]) -> None:
        """Takes names by node id, and the farthest each drive can turn in a cycle, [counts]."""
        count, nodes = len(names), tuple(names)
        self.nodes = nodes
        self._names = dict(names)
        self.status_words = [0] * count
        self.positions = [0] * count
        self.torques = [0] * count
        self.states = [DriveState.NOT_READY] * count
        self.answered = [False] * count
        self.restarted: set[int] = set()
        self._wrong_lengths = 0
        self._check = ReplyCheck(names, max_steps)
        self._news: list[tuple[int, str]] = []
        self._dropped: list[tuple[int, str]] = []
        self._emergencies: dict[int, str] = {}
        self._replies = {TPDO1_BASE + node: i for i, node in enumerate(nodes)}
        self._others = {EMCY_BASE + node: self._emergency for node in nodes}
        self._others |= {HEARTBEAT_BASE + node: self._heartbeat for node in nodes}

    def begin_cycle(self) -> None:
        """From now on replies count for a new cycle."""
        self._check.begin_cycle()
        self.answered = [False] * len(self.nodes)

    def end_cycle(self) -> None:
        """Counts the replies that did not come, or could not be believed."""
        self._check.end_cycle()

    def forget_positions(self) -> None:
        """The drives may have been moved since: their next positions are believed as they come."""
        self._check.forget_positions()

    @property
    def rejected(self) -> int:
        """Frames thrown away because their length or their content could not be true."""
        return self._check.rejected + self._wrong_lengths

    @property
    def complete(self) -> bool:
        """Every drive has answered in this cycle."""
        return all(self.answered)

    def take(self, can_id: int, data: bytes | bytearray, *, stale: bool = False) -> None:
        """Takes in one frame.

        Args:
            can_id: Its identifier.
            data: Its data.
            stale: A reply in it belongs to a cycle that is over and is thrown away.
        """
        drive = self._replies.get(can_id)
        if drive is None:
            other = self._others.get(can_id)
            if other is not None:
                other(can_id & 0x7F, data)
            return
        self._check.hear(drive)
        if stale or self.answered[drive]:
            return
        reply = parse_reply(data)
        if reply is None:
            self._check.reject(drive, f"its reply has {len(data)} bytes instead of 8")
        elif self._check.believed(drive, reply.position):
            self._note(drive, reply)

    def _note(self, drive: int, reply: Reply) -> None:
        self.status_words[drive], self.positions[drive], self.torques[drive] = reply
        self.answered[drive] = True
        state, before = state_of(reply.status_word), self.states[drive]
        self.states[drive] = state
        if before is DriveState.OPERATION_ENABLED and state is not before:
            node = self.nodes[drive]
            self._dropped.append((node, f"{self._names[node]} stopped by itself: {state.value}"))

    def news(self) -> list[tuple[int, str]]:
        """Emergencies, restarts and NMT states told since the last call, by node."""
        news, self._news = self._news, []
        return news

    def dropped(self) -> list[tuple[int, str]]:
        """Drives that left OPERATION ENABLED since the last call, by node."""
        dropped, self._dropped = self._dropped, []
        return dropped

    def state_faults(self, told: Container[str], *, powered: bool) -> list[tuple[int, str]]:
        """What is wrong with the drives as they stand, by node.

        How often a drive may be silent is the executor's to say (`executor.safety.watch`).

        Args:
            told: Faults known already; a drive whose emergency is among them is not told again.
            powered: The group is under power or on its way there; replies that cannot be believed
                are a fault then.
        """
        found: list[tuple[int, str]] = []
        for node, state in zip(self.nodes, self.states, strict=True):
            if state not in FAULTED:
                continue
            name, cause = self._names[node], self._emergencies.get(node, "it sent no reason")
            if f"{name}: {cause}" not in told:
                found.append((node, f"{name} is in {state.value}: {cause}"))
        return found + (self._check.faults() if powered else [])

    def forget_emergencies(self) -> None:
        """After a reset by the operator."""
        self._emergencies.clear()
        self._news.clear()

    def _emergency(self, node: int, data: bytes | bytearray) -> None:
        message = parse_emergency(data)
        if message is None:
            self._wrong_lengths += 1
        elif message.code & 0xFF00:
            text = emergency_text(message.code)
            self._emergencies[node] = text
            self._news.append((node, f"{self._names[node]}: {text}"))

    def _heartbeat(self, node: int, data: bytes | bytearray) -> None:
        state = parse_heartbeat(data)
        if state is None:
            self._wrong_lengths += 1
        elif state == NmtState.BOOT_UP:
            self.restarted.add(node)
            self._news.append(
                (node, f"{self._names[node]} restarted: its set-up and its position are lost")
            )
        elif state != NmtState.OPERATIONAL:
            self._news.append((node, f"{self._names[node]} left the NMT state operational"))
