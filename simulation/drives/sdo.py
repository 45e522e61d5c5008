"""The SDO server of a simulated drive; its answers may come late, twice or never.

Source: CiA 301 (4.2), 7.2.4: expedited and segmented transfers, abort codes. It knows no block
transfers, which a server need not.
"""

from __future__ import annotations

import heapq
import struct
from collections.abc import Callable
from itertools import count
from math import inf

from simulation.drives.behaviour import DriveBehaviour
from simulation.drives.object_dictionary import WRONG_LENGTH, Abort, DriveObjects

TOGGLE_NOT_ALTERNATED = 0x05030000
UNKNOWN_COMMAND = 0x05040001
OUT_OF_MEMORY = 0x05040005

LATE_EVERY = 7
LONGEST_DOWNLOAD = 1024

_HEAD = struct.Struct("<BHB")


class SdoServer:
    """Answers requests of 8 bytes.

    Attributes:
        next_due: When the next answer goes out, [s]; infinity while none waits.
    """

    def __init__(
        self, objects: DriveObjects, behaviour: DriveBehaviour, send: Callable[[bytes], None]
    ) -> None:
        """Serves a drive's objects; ``send`` puts an answer on the bus."""
        self._objects, self._behaviour, self._send = objects, behaviour, send
        self._key = 0, 0
        self._upload: bytes | None = None
        self._download: bytearray | None = None
        self._toggle = 0
        self._answers = 0
        self._queue: list[tuple[float, int, bytes]] = []
        self._order = count()
        self.next_due = inf

    def deliver(self, now: float) -> None:
        """Sends the answers that are due by now."""
        while self._queue and self._queue[0][0] <= now + 1e-9:
            self._send(heapq.heappop(self._queue)[2])
        self.next_due = self._queue[0][0] if self._queue else inf

    def on_request(self, data: bytes, now: float) -> None:
        """Works off one request; its answer goes out at once or by `deliver`."""
        try:
            answer = self._answer(data)
        except Abort as abort:
            self._upload = self._download = None
            answer = _HEAD.pack(0x80, *self._key) + abort.code.to_bytes(4, "little")
        if answer is not None:
            self._reply(answer.ljust(8, b"\0"), now)

    def _reply(self, answer: bytes, now: float) -> None:
        """Late, twice or not at all, as the behaviour says."""
        behaviour = self._behaviour
        self._answers += 1
        if behaviour.sdo_lost and self._answers % behaviour.sdo_lost == 0:
            return
        due = now + behaviour.sdo_delay
        if self._answers % LATE_EVERY == 0:
            due += behaviour.sdo_late
        times = [due] if behaviour.sdo_twice is None else [due, due + behaviour.sdo_twice]
        for time in times:
            heapq.heappush(self._queue, (time, next(self._order), answer))
        self.deliver(now)

    def _answer(self, data: bytes) -> bytes | None:
        command = data[0]
        kind = command >> 5
        if kind in (0, 3):  # segments
            return self._take_segment(command, data) if kind == 0 else self._give_segment(command)
        _, index, sub = _HEAD.unpack_from(data)
        self._key = index, sub
        self._upload = self._download = None
        if kind == 1:
            return self._begin_download(command, data)
        if kind == 2:
            return self._begin_upload()
        if kind == 4:  # the client gave up
            return None
        raise Abort(UNKNOWN_COMMAND)

    def _begin_upload(self) -> bytes:
        value = self._objects.get_data(*self._key)
        if 0 < len(value) <= 4:
            return _HEAD.pack(0x43 | (4 - len(value)) << 2, *self._key) + value
        self._upload, self._toggle = value, 0
        return _HEAD.pack(0x41, *self._key) + len(value).to_bytes(4, "little")

    def _give_segment(self, command: int) -> bytes:
        if self._upload is None:
            raise Abort(UNKNOWN_COMMAND)
        self._check_toggle(command)
        part, rest = self._upload[:7], self._upload[7:]
        answer = bytes((self._toggle | (7 - len(part)) << 1 | (not rest),)) + part
        self._upload, self._toggle = rest or None, self._toggle ^ 0x10
        return answer

    def _begin_download(self, command: int, data: bytes) -> bytes:
        if command & 0x02:
            length = 4 - (command >> 2 & 3) if command & 0x01 else 4
            self._objects.set_data(*self._key, bytes(data[4 : 4 + length]))
        else:
            length = int.from_bytes(data[4:8], "little") if command & 0x01 else 0
            if length > LONGEST_DOWNLOAD:
                raise Abort(OUT_OF_MEMORY)
            self._download, self._toggle = bytearray(), 0
        return _HEAD.pack(0x60, *self._key)

    def _take_segment(self, command: int, data: bytes) -> bytes:
        if self._download is None:
            raise Abort(UNKNOWN_COMMAND)
        self._check_toggle(command)
        self._download += data[1 : 8 - (command >> 1 & 7)]
        if len(self._download) > LONGEST_DOWNLOAD:
            raise Abort(WRONG_LENGTH)
        if command & 0x01:
            taken, self._download = bytes(self._download), None
            self._objects.set_data(*self._key, taken)
        answer = bytes((0x20 | self._toggle,))
        self._toggle ^= 0x10
        return answer

    def _check_toggle(self, command: int) -> None:
        if command & 0x10 != self._toggle:
            raise Abort(TOGGLE_NOT_ALTERNATED)
