"""Reads a trace that candump wrote, and decodes it with the EDS file of the drives."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import canopen

import simulation
from drivers.cia402.pdo import SDO_REQUEST_BASE

EDS = Path(simulation.__file__).parent / "drives" / "eds" / "cia402.eds"
_LINE = re.compile(r"\((\d+\.\d+)\) \S+ ([0-9A-F]{3})#([0-9A-F]*)( [RT])?$")
_DOWNLOADS = {0x2F: 1, 0x2B: 2, 0x23: 4}  # expedited SDO download: bytes


@dataclass(frozen=True, slots=True)
class Frame:
    """One line of the trace; the time is the kernel's, [s]."""

    time: float
    can_id: int
    data: bytes


def read_trace(path: Path) -> list[Frame]:
    """Every data frame of a `candump -L` file, in order."""
    frames = []
    for line in path.read_text().splitlines():
        parts = _LINE.match(line)
        assert parts is not None, line
        frames.append(Frame(float(parts[1]), int(parts[2], 16), bytes.fromhex(parts[3])))
    return frames


class Decoder:
    """Names what is in the process data, as a bus analyser with the EDS file does.

    The mapping is the file's until an SDO write in the trace changes it.
    """

    def __init__(self, nodes: range) -> None:
        self._drives = {node: canopen.import_od(str(EDS), node) for node in nodes}

    def decode(self, frames: list[Frame]) -> Iterator[tuple[Frame, dict[str, int]]]:
        """Every set-point (200h) and reply (180h) with its values by name."""
        for frame in frames:
            node = frame.can_id & 0x7F
            if node not in self._drives:
                continue
            if frame.can_id - node == SDO_REQUEST_BASE:
                self._follow(node, frame.data)
            elif frame.can_id - node == 0x200:
                yield frame, self._values(node, 0x1600, frame.data)
            elif frame.can_id - node == 0x180:
                yield frame, self._values(node, 0x1A00, frame.data)

    def _follow(self, node: int, request: bytes) -> None:
        size = _DOWNLOADS.get(request[0])
        index, sub = int.from_bytes(request[1:3], "little"), request[3]
        if size and index in (0x1600, 0x1A00):
            value = int.from_bytes(request[4 : 4 + size], "little")
            self._drives[node][index][sub].default = value

    def _values(self, node: int, mapping: int, data: bytes) -> dict[str, int]:
        drive, values, at = self._drives[node], {}, 0
        for sub in range(1, drive[mapping][0].default + 1):
            entry = drive[mapping][sub].default
            index, object_sub, size = entry >> 16, entry >> 8 & 0xFF, (entry & 0xFF) // 8
            assert object_sub == 0
            variable = drive[index]
            values[variable.name] = variable.decode_raw(data[at : at + size])
            at += size
        assert at == len(data), "the mapping in the trace and the frame do not agree"
        return values
