"""Missing functions of drives are reported to the operator when arming."""

from __future__ import annotations

import pytest

from cdpr.cli.output import Terminal
from executor.drives import open_drives
from model.files.rig_file import Cia402Document
from model.rig import load_rig, rig_from_document
from tests.cli.plans import GOAL_MM, RIG, START_MM, free_scene


def test_drives_with_too_few_heartbeat_entries_are_named(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """As Nanotec's, which have one."""
    drives = Cia402Document(type="cia402", profile="nanotec-c5e")
    document = load_rig(RIG).document.model_copy(update={"drives": drives})
    rig = rig_from_document(document)
    with open_drives(rig, rig.home, free_scene(START_MM, GOAL_MM).load, listener=Terminal()):
        said = capsys.readouterr().err
    assert "remark" in said
    assert "drive 1, 2, 3, 4, 5, 6, 7, 8: 1016h has 1 heartbeat entry" in said
    assert "0 of 7 other drives" in said
