"""SDO requests to many drives during cyclic operation, one per drive at a time. No bus, no clock.

`drivers.cia402.sdo` waits for every answer, which a loop that sends SYNC cannot do. Values of up to
four bytes only; source: CiA 301, 7.2.4.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import dataclass

from drivers.cia402.pdo import SDO_REQUEST_BASE
from drivers.cia402.profile import rpdo_parameters
from drivers.cia402.state_machine import MAY_FOLLOW, ControlWord, state_of

ASKED_AGAIN_AFTER = 0.5
"""Time without an answer after which a request is repeated, [s]; double answers are harmless."""

MODE_WAIT = 0.5
"""Time for an enabled drive to show its mode, in addition to the SDO answer, [s]."""

CSP_MODE = 8
"""Cyclic synchronous position."""

_DOWNLOADED, _ABORTED = 0x60, 0x80
_UPLOADED = frozenset({0x4F, 0x4B, 0x47, 0x43, 0x42})
"""Answers with 1 to 4 bytes, and one that does not state their number."""
_SEGMENTS_FOLLOW = frozenset({0x40, 0x41})
_ASK_FOR_SEGMENT = bytes((0x60, *bytes(7)))
_LENGTH = 8

#: Abort codes: object does not exist; sub-index does not exist.
OBJECT_DOES_NOT_EXIST = frozenset({0x06020000, 0x06090011})


@dataclass(frozen=True, slots=True)
class SdoRequest:
    """One object to write, or to read if there is no data.

    Attributes:
        index: Object index.
        sub: Sub-index.
        data: 1 to 4 bytes to write; empty to read.
        size: Size of a read value if the answer does not state it, [bytes].
    """

    index: int
    sub: int
    data: bytes = b""
    size: int = 4

    def frame(self) -> bytes:
        """Data of the request frame."""
        command = 0x23 | (4 - len(self.data)) << 2 if self.data else 0x40
        head = bytes((command, self.index & 0xFF, self.index >> 8, self.sub))
        return head + self.data.ljust(4, b"\0")


def parse_value(data: bytes | bytearray, size: int) -> bytes:
    """Value in an answer of one frame; of ``size`` [bytes] if the answer does not state it."""
    stated = 4 - (data[0] >> 2 & 3) if data[0] & 1 else size
    return bytes(data[4 : 4 + stated])


#: State of a drive: status word, position [counts] and torque [per mille].
STATE_REQUESTS = (
    SdoRequest(0x6041, 0, size=2),
    SdoRequest(0x6064, 0),
    SdoRequest(0x6077, 0, size=2),
)

#: Code of the last error, and the newest entry of the error history, whose lower half is the code.
#: Source: CiA 402-2, object 603Fh; CiA 301, 7.5.2.4.
ERROR_REQUESTS = (SdoRequest(0x603F, 0, size=2), SdoRequest(0x1003, 1))


def answer_cycles(timeout: float, cycle: float) -> int:
    """Cycles until the answer to an SDO request at most: it is awaited to the end of a cycle.

    Args:
        timeout: Time of one SDO answer, [s].
        cycle: [s].
    """
    return max(1, math.ceil(timeout / cycle - 1e-9))


def cycles_to_end(heartbeats: Iterable[int], most: int, answer: int) -> int:
    """Largest number of cycles to end all monitoring.

    Args:
        heartbeats: As for `monitoring_off`, one number per drive.
        most: Requests per cycle.
        answer: From `answer_cycles`.
    """
    jobs = [len(_STOP) + len(monitoring_off(count)) for count in heartbeats]
    # In each cycle as many requests are sent as may be, or every drive waits for an answer.
    return sum(jobs) // most + max(jobs) * answer


def monitoring_off(heartbeats: int, rpdo: int = 1) -> tuple[SdoRequest, ...]:
    """Requests that end all monitoring by a drive: heartbeats, set-points, and SYNC last.

    Peers' heartbeats too: a peer that became silent later would remove the torque of all.

    Args:
        heartbeats: Number of entries of 1016h written at configuration, the master's first.
        rpdo: Number of the RPDO for the set-points.
    """
    return (
        *(SdoRequest(0x1016, sub, bytes(4)) for sub in range(1, heartbeats + 1)),
        SdoRequest(rpdo_parameters(rpdo), 5, bytes(2)),
        SdoRequest(0x1006, 0, bytes(4)),
    )


_STOP = SdoRequest(0x6040, 0, ControlWord.QUICK_STOP.to_bytes(2, "little")), STATE_REQUESTS[0]
"""Stops a drive that takes no process data, as in NMT *pre-operational*, and reads its state."""

MODE_DISPLAY = SdoRequest(0x6061, 0, size=1)


class SdoJobs:
    """Queued requests, the open one of each drive, and the answers.

    Attributes:
        values: Values read, by node and job.
        failed: Abort codes, by node and job.
    """

    def __init__(
        self,
        jobs: Mapping[int, Iterable[SdoRequest]],
        again_after: int,
        *,
        endless: bool = False,
    ) -> None:
        """Sends nothing yet.

        Args:
            jobs: Requests of each node, in the order of sending.
            again_after: Turns without an answer after which a request is repeated, as frames may
                be lost.
            endless: An answered request is queued again.
        """
        self._again_after, self._endless = again_after, endless
        self._turns: dict[int, int] = {}
        self._waiting = {node: deque(of_node) for node, of_node in jobs.items()}
        self._order = deque(self._waiting)
        self._asked: dict[int, SdoRequest] = {}
        self._frames: dict[int, bytes] = {}
        self.values: dict[tuple[int, SdoRequest], int] = {}
        self.failed: dict[tuple[int, SdoRequest], int] = {}

    def unfinished(self) -> set[int]:
        """Nodes with open or queued requests."""
        return {node for node, waiting in self._waiting.items() if waiting} | set(self._asked)

    def refused(self) -> set[int]:
        """Nodes that refused a request, except for absent objects."""
        return {
            node for (node, _), code in self.failed.items() if code not in OBJECT_DOES_NOT_EXIST
        }

    @property
    def is_asking(self) -> bool:
        """Whether an answer is awaited."""
        return bool(self._asked)

    def next_requests(self, most: int) -> list[tuple[int, bytes]]:
        """Identifier and data of the requests to send in this turn, at most one per drive.

        All drives get their first request before any gets its second.

        Args:
            most: Largest number of requests.
        """
        for node in self._asked:
            self._turns[node] += 1
        requests: list[tuple[int, bytes]] = []
        for _ in range(len(self._order)):
            if len(requests) == most:
                break
            node = self._order[0]
            self._order.rotate(-1)
            if node not in self._asked and self._waiting[node]:
                self._asked[node] = self._waiting[node].popleft()
                self._frames[node] = self._asked[node].frame()
            elif self._turns.get(node, 0) < self._again_after or node not in self._asked:
                continue
            self._turns[node] = 0
            requests.append((SDO_REQUEST_BASE + node, self._frames[node]))
        return requests

    def take(self, node: int, data: bytes | bytearray) -> None:
        """Processes an answer; late answers and those to other requests are ignored."""
        job = self._asked.get(node)
        if job is None or len(data) != _LENGTH:
            return
        if self._frames[node] == _ASK_FOR_SEGMENT and not data[0] & 0xF0:
            # A segment holds up to seven bytes, so the first one is the last.
            self.values[node, job] = int.from_bytes(data[1 : 8 - (data[0] >> 1 & 7)], "little")
            self._finish(node)
        elif int.from_bytes(data[1:3], "little") == job.index and data[3] == job.sub:
            self._take_answer(node, job, data)

    def _take_answer(self, node: int, job: SdoRequest, data: bytes | bytearray) -> None:
        """Processes an answer that names the object."""
        if data[0] == _ABORTED:
            self.failed[node, job] = int.from_bytes(data[4:8], "little")
        elif job.data and data[0] == _DOWNLOADED:
            pass
        elif not job.data and data[0] in _UPLOADED:
            self.values[node, job] = int.from_bytes(parse_value(data, job.size), "little")
        elif not job.data and data[0] in _SEGMENTS_FOLLOW:
            self._frames[node], self._turns[node] = _ASK_FOR_SEGMENT, self._again_after
            return
        else:
            return
        self._finish(node)

    def _finish(self, node: int) -> None:
        job = self._asked.pop(node)
        if self._endless:
            self._waiting[node].append(job)


class StateReading(SdoJobs):
    """Reads the state of every drive once."""

    def __init__(
        self, nodes: Iterable[int], again_after: int, answer: int, *, silent: set[int]
    ) -> None:
        """Sends nothing yet.

        Args:
            again_after: As for `SdoJobs`.
            answer: Turns until an answer at most, from `answer_cycles`.
            silent: Nodes that missed the last cycle; lost without any answer in this time.
        """
        super().__init__(dict.fromkeys(nodes, STATE_REQUESTS), again_after)
        self._turn, self._answer, self._silent = 0, answer, silent

    def next_requests(self, most: int) -> list[tuple[int, bytes]]:
        """Requests of one turn; see `SdoJobs.next_requests`."""
        self._turn += 1
        return super().next_requests(most)

    @property
    def waits(self) -> bool:
        """Whether another turn may bring an answer."""
        waited_for = self.unfinished()
        if self._turn >= self._answer:
            waited_for -= self._silent - {node for node, _ in self.values}
        return bool(waited_for) and self._turn < len(STATE_REQUESTS) * self._answer


class MonitoringEnd(SdoJobs):
    """Ends the monitoring of this master, except by drives that may still be enabled.

    Only this monitoring stops an enabled drive that takes no commands.
    """

    def __init__(
        self, heartbeats: Mapping[int, int], rpdo: int, again_after: int, *, stopped: Container[int]
    ) -> None:
        """Sends nothing yet.

        Args:
            heartbeats: As for `monitoring_off`, by node.
            rpdo: As for `monitoring_off`.
            again_after: As for `SdoJobs`.
            stopped: Nodes that reported in this cycle that they are not enabled. The others are
                stopped by SDO first.
        """
        first = {node: () if node in stopped else _STOP for node in heartbeats}
        off = {node: monitoring_off(count, rpdo) for node, count in heartbeats.items()}
        super().__init__({node: (*first[node], *off[node]) for node in off}, again_after)
        self._kept: set[int] = set()

    def refused(self) -> set[int]:
        """Nodes that still monitor: they refused a request, or did not stop."""
        return super().refused() | self._kept

    def _finish(self, node: int) -> None:
        job = self._asked[node]
        super()._finish(node)
        if job == _STOP[-1] and state_of(self.values.get((node, job), 0)) in MAY_FOLLOW:
            self._waiting[node].clear()
            self._kept.add(node)


class AnswerListener:
    """A `drivers.cyclic_group.ReplyListener` until every open request is answered."""

    def __init__(self, take: Callable[..., None], jobs: SdoJobs) -> None:
        """Passes frames to ``take``."""
        self._jobs, self.take = jobs, take

    @property
    def complete(self) -> bool:
        """Whether no answer is awaited."""
        return not self._jobs.is_asking


def mode_text(name: str, mode: int | None) -> str:
    """Message about the wrong mode of an enabled drive; None for no answer."""
    if mode is None:
        return f"{name} does not report its mode once enabled (6061h)"
    return f"{name} is in mode {mode} (6061h) once enabled, not in 8 (CSP)"


class ModeCheck:
    """Reads the mode of enabled drives until all are in CSP or time is up.

    For drives that show the mode only once enabled; until then they hold the targets at which they
    were enabled.
    """

    def __init__(self, nodes: Iterable[int], cycles: int, again_after: int) -> None:
        """Sends nothing yet.

        Args:
            cycles: Largest number of cycles.
            again_after: As for `SdoJobs`.
        """
        self._modes: dict[int, int | None] = dict.fromkeys(nodes)
        self._left, self._again_after = cycles, again_after
        self._jobs = SdoJobs({}, again_after)

    def next_requests(self, most: int) -> list[tuple[int, bytes]]:
        """Requests of one cycle; see `SdoJobs.next_requests`."""
        self._left -= 1
        if not self._jobs.unfinished():
            asked = {node: (MODE_DISPLAY,) for node in self.wrong()}
            self._jobs = SdoJobs(asked, self._again_after)
        return self._jobs.next_requests(most)

    def take(self, node: int, data: bytes | bytearray) -> None:
        """Processes an answer; see `SdoJobs.take`."""
        self._jobs.take(node, data)
        self._modes |= {node: mode for (node, _), mode in self._jobs.values.items()}

    def wrong(self) -> dict[int, int | None]:
        """Nodes that are in another mode, or have not answered (None)."""
        return {node: mode for node, mode in self._modes.items() if mode != CSP_MODE}

    @property
    def is_overdue(self) -> bool:
        """Whether time is up."""
        return self._left <= 0


class StatePoll:
    """Reads the status words of enabled drives in turn, as they are between two replies.

    Replies alone do not show a drive that stops after each of them, as at a limit switch: the next
    set-point enables it again (transition 16), and it may fill in its reply after that.
    """

    def __init__(self, nodes: Iterable[int], again_after: int) -> None:
        """Sends nothing yet; arguments as for `ModeCheck`."""
        jobs = {node: STATE_REQUESTS[:1] for node in nodes}
        self._jobs = SdoJobs(jobs, again_after, endless=True)
        self._heard: set[int] = set()
        self._words: dict[int, int] = {}

    def next_requests(self, most: int) -> list[tuple[int, bytes]]:
        """Requests of one cycle; see `SdoJobs.next_requests`."""
        return self._jobs.next_requests(most)

    def take(self, node: int, data: bytes | bytearray) -> None:
        """Processes an answer; the first one of a drive may be late, from an earlier motion."""
        self._jobs.take(node, data)
        word = self._jobs.values.pop((node, STATE_REQUESTS[0]), None)
        if word is not None and node in self._heard:
            self._words[node] = word
        elif word is not None:
            self._heard.add(node)

    def new_words(self) -> dict[int, int]:
        """Status words since the last call, by node."""
        words, self._words = self._words, {}
        return words
