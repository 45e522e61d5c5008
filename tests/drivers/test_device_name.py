"""Simulated drives identify themselves; any others count as real."""

from __future__ import annotations

from typing import Any

import can
import pytest

from drivers.cia402 import expected_objects
from drivers.cia402.expected_objects import SIMULATED, are_simulated
from model.errors import HardwareMissing, Refused

Answer = bytes | None | Exception


class Network:
    """Drives that answer 1008h as scripted."""

    def __init__(self, answers: list[Answer]) -> None:
        self.answers, self.asked = answers, 0

    def discard_waiting(self) -> None:
        """Nothing waits."""

    def client(self, node: int) -> Any:
        self.asked, answer = self.asked + 1, self.answers[node - 1]

        class Client:
            def read_if_there(self, index: int, sub: int, _name: str) -> bytes | None:
                assert (index, sub) == (0x1008, 0)
                if isinstance(answer, Exception):
                    raise answer
                return answer

        return Client()


@pytest.mark.parametrize(
    ("answers", "simulated", "asked"),
    [
        ([SIMULATED] * 8, True, 8),
        ([SIMULATED] * 7 + [b"EPOS4"], False, 8),
        ([None, *[SIMULATED] * 7], False, 1),
        ([Refused("no")] * 8, False, 1),
        ([SIMULATED, HardwareMissing("silent")], False, 2),
    ],
)
def test_only_drives_that_all_say_so_are_simulated(
    monkeypatch: pytest.MonkeyPatch, answers: list[Answer], simulated: bool, asked: int
) -> None:
    network = Network(answers)
    monkeypatch.setattr(expected_objects, "SetupNetwork", lambda *_: network)
    bus: Any = can.BusABC
    assert are_simulated(bus, None, range(1, len(answers) + 1)) is simulated
    assert network.asked == asked
