"""`cdpr hold`, `resume` and `speed`: what is said in each state of a run."""

from __future__ import annotations

import json
from typing import Any

import pytest

from cdpr.cli.operate import requests
from tests.cli.program import call

#: Phases of a run, with whether a request comes too late.
PHASES = {
    **dict.fromkeys(("preparing", "enabling", "moving", "holding"), False),
    **dict.fromkeys(("stopping", "securing", "finished", "stopped", "latched"), True),
}


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("verb", [("hold",), ("resume",), ("speed", "50")])
def test_a_request_is_confirmed_or_too_late(
    monkeypatch: pytest.MonkeyPatch, verb: tuple[str, ...], phase: str
) -> None:
    status: dict[str, Any] = {"process": 7, "state": phase, "wished": {"hold": False}}
    monkeypatch.setattr(requests, "request_run", lambda *_: status)
    answer = call(*verb)
    assert answer.code == int(PHASES[phase]), answer
    assert ("too late" in answer.out) == PHASES[phase]
    assert f" {phase}" in answer.out
    answer = call(*verb, "--json")
    assert (answer.code, json.loads(answer.out)) == (int(PHASES[phase]), status)
