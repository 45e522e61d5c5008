"""Simulated drives identify themselves; any others count as real."""

from __future__ import annotations

from typing import Any

import pytest

from drivers.cia402.expected_objects import SIMULATED, are_simulated
from drivers.setup_refusals import DriveRestarted
from model.errors import HardwareMissing, Refused

Answer = bytes | None | Exception


class Network:
    """Drives that answer 1008h as scripted."""

    def __init__(self, answers: list[Answer]) -> None:
        self.answers, self.asked = answers, 0

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
        ([Refused("no", values={"node": 1})] * 8, False, 1),
        ([SIMULATED, HardwareMissing("silent")], False, 2),
    ],
)
def test_only_drives_that_all_say_so_are_simulated(
    answers: list[Answer], simulated: bool, asked: int
) -> None:
    network: Any = Network(answers)
    assert are_simulated(network, range(1, len(answers) + 1)) is simulated
    assert network.asked == asked


@pytest.mark.parametrize("seen", [Refused("another program sends SYNC"), DriveRestarted(2)])
def test_what_ends_a_set_up_is_not_taken_for_a_real_drive(seen: Refused) -> None:
    network: Any = Network([SIMULATED, seen])
    with pytest.raises(type(seen)):
        are_simulated(network, [1, 2])
