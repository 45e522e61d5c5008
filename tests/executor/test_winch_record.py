"""The record of a motion without a path: what was told, cycle by cycle, and nothing for nothing."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from executor.control.winch_motion import recording
from executor.state_machine import CycleRecord, LoopEvent, State
from model.errors import BadInput


def record(cycle: int) -> CycleRecord:
    state, nothing = State.MOVING, float("nan")
    return CycleRecord(
        cycle, 100.0 + cycle / 100.0, state, 0.0, 1.0, (10, 20), (11, -21), (30, 40), (0, 0), 0,
        0, 0, nothing, 0.0,
    )  # fmt: skip


def test_every_cycle_and_event_is_there(tmp_path: Path) -> None:
    with recording(tmp_path / "home") as kept:
        kept.take_event(LoopEvent(0, 100.0, "enabled", "all drives hold"))
        for cycle in range(3):
            kept.take_cycle(record(cycle))
        # On disk at once: a program that is killed writes nothing any more.
        (line,) = (tmp_path / "home/events.jsonl").read_text().splitlines()
        assert json.loads(line) == {"time_s": 0.0, "code": "enabled", "text": "all drives hold"}
    with (tmp_path / "home/winches.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["cycle"], row["time_s"]) for row in rows] == [
        ("0", "0.000000"), ("1", "0.010000"), ("2", "0.020000")
    ]  # fmt: skip
    assert rows[2]["state"] == "moving"
    told = {key: rows[2][key] for key in rows[2] if key.endswith(("_1", "_2"))}
    assert told == {
        "set_counts_1": "10", "set_counts_2": "20", "counts_1": "11", "counts_2": "-21",
        "torque_per_mille_1": "30", "torque_per_mille_2": "40",
    }  # fmt: skip


def test_nothing_is_left_of_what_did_not_move(tmp_path: Path) -> None:
    with recording(tmp_path / "home") as kept:
        kept.take_event(LoopEvent(0, 1.0, "stop", "stop requested"))
    assert not (tmp_path / "home").exists()
    (tmp_path / "home").mkdir()
    with pytest.raises(BadInput, match="cannot be written"), recording(tmp_path / "home"):
        pytest.fail("it would write into another's folder")
    assert (tmp_path / "home").exists()
