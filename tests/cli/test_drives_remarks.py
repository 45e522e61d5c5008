"""What drives cannot do is told to the operator when they are armed."""

from __future__ import annotations

import pytest

from cdpr.cli.drives import open_drives
from cdpr.rig import load_rig
from simulation import drive_objects
from tests.cli.plans import GOAL_MM, RIG, START_MM, free_scene


def test_drives_with_too_few_heartbeat_entries_are_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = drive_objects._defaults

    def three_entries(node: int) -> list[tuple[tuple[int, int], str, int, bool]]:
        return [
            (key, form, 3 if key == (0x1016, 0) else value, writable)
            for key, form, value, writable in whole(node)
        ]

    monkeypatch.setattr(drive_objects, "_defaults", three_entries)
    rig = load_rig(RIG)
    with open_drives(rig, rig.home, free_scene(START_MM, GOAL_MM).load):
        said = capsys.readouterr().err
    assert "remark" in said
    assert "drive 1, 2, 3, 4, 5, 6, 7, 8: 1016h has 3 heartbeat entries" in said
    assert "2 of 7 other drives" in said
