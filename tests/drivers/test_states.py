"""Status words against the table of CiA 402-2, and the safety of the control words sent."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.cia402.state_machine import (
    FAULTED,
    HOLDS,
    TORQUE_ON,
    ControlWord,
    DriveState,
    Goal,
    late_drives,
    next_words,
    state_of,
)
from drivers.factory import drive_flags, unready_remarks
from drivers.odrive.messages import AxisState, status_word
from model.files.rig_file import RigDocument
from model.rig import Rig, load_rig, rig_from_document
from tests.drivers.odrive_bench import ODRIVE_RIG, odrive_rig

# Bits 6..0 as the standard prints them; x is any.
STANDARD = {
    "0x?0000": DriveState.NOT_READY,
    "1x?0000": DriveState.SWITCH_ON_DISABLED,
    "0100001": DriveState.READY_TO_SWITCH_ON,
    "01x0001": DriveState.READY_TO_SWITCH_ON,
    "01x0011": DriveState.SWITCHED_ON,
    "01x0111": DriveState.OPERATION_ENABLED,
    "00x0111": DriveState.QUICK_STOP_ACTIVE,
    "0xx1111": DriveState.FAULT_REACTION_ACTIVE,
    "0xx1000": DriveState.FAULT,
}


def standard_state(word: int) -> DriveState | None:
    bits = f"{word & 0x7F:07b}"
    for pattern, state in STANDARD.items():
        if re.fullmatch(re.sub("[x?]", ".", pattern), bits):
            return state
    return None


def test_every_status_word_means_what_the_standard_says() -> None:
    expected = [standard_state(word) or DriveState.NOT_READY for word in range(0x80)]
    for word in range(0x10000):
        assert state_of(word) is expected[word & 0x7F], hex(word)


@pytest.mark.parametrize(
    ("word", "state"),
    [
        (0x1237, DriveState.OPERATION_ENABLED),
        (0x0217, DriveState.QUICK_STOP_ACTIVE),
        (0x0231, DriveState.READY_TO_SWITCH_ON),
        (0x0250, DriveState.SWITCH_ON_DISABLED),
        (0x0218, DriveState.FAULT),
    ],
)
def test_status_words_seen_on_drives(word: int, state: DriveState) -> None:
    assert state_of(word) is state


def test_control_words_are_those_of_the_standard() -> None:
    """CiA 402-2, table "command coding", written out."""
    assert {word.name: int(word) for word in ControlWord} == {
        "SHUTDOWN": 0x06,
        "SWITCH_ON": 0x07,
        "ENABLE_OPERATION": 0x0F,
        "QUICK_STOP": 0x02,
        "RESET_FAULT": 0x86,
    }


def test_which_states_hold_a_cable_and_which_are_a_fault() -> None:
    names = {"OPERATION_ENABLED", "QUICK_STOP_ACTIVE", "FAULT_REACTION_ACTIVE"}
    assert {state.name for state in TORQUE_ON} == names
    assert {state.name for state in FAULTED} == {"FAULT_REACTION_ACTIVE", "FAULT"}


def test_no_control_word_is_disable_voltage() -> None:
    assert all(word & 0x02 for word in ControlWord)


@pytest.mark.parametrize(
    ("word", "said"),
    [
        (0x0240, "voltage enabled"),
        (0x0221, "voltage enabled"),
        (0x0050, "remote"),
        (0x0250, "enable input"),
        (0x0217, "transition 16"),
        (0x0218, ""),
    ],
)
def test_a_drive_that_is_not_enabled_in_time_says_what_keeps_it(word: int, said: str) -> None:
    commanded = (ControlWord.ENABLE_OPERATION,) * 2
    names = {4: "cable 1", 5: "cable 2"}
    (found,) = late_drives(names, (word, 0x0237), commanded, Goal.ENABLE, 1.0)
    assert found[0] == 4
    assert found[1].startswith(f"cable 1 is in {state_of(word).value} instead of operation")
    assert said in found[1]
    assert (";" in found[1]) == bool(said)
    assert ("bit 9" in found[1]) == (said == "remote")


@pytest.mark.parametrize("word", [0x0740, 0x0721, 0x0540])
def test_bits_that_a_make_uses_otherwise_are_no_reason(word: int) -> None:
    """A maxon EPOS2 is enabled from there; it was said to have no mains power."""
    commanded = (ControlWord.ENABLE_OPERATION,) * 2
    ((_, text),) = late_drives({4: "a", 5: "b"}, (word, 0x0237), commanded, Goal.ENABLE, 1.0, 0)
    assert "bit" not in text
    assert text.endswith("; check mains power, safe torque off (STO) and the enable input")


def test_the_bits_of_drives_at_rest_are_read_as_the_profile_says(rig: Rig, tmp_path: Path) -> None:
    assert len(unready_remarks(rig, (0x0721,) * 8)) == 1
    path = tmp_path / "own.yaml"
    path.write_text("name: other\nsources: [its manual]\npower_bits: false\n")
    document = rig.document.model_dump()
    document["drives"]["profile"] = str(path)
    theirs = rig_from_document(RigDocument.model_validate(document))
    assert unready_remarks(theirs, (0x0721,) * 8) == []
    assert unready_remarks(theirs, (0x0540,) * 8) == []


def test_drives_at_rest_that_cannot_be_enabled_are_named_together(rig: Rig) -> None:
    words = (0x0240, 0x0250, 0x0221, 0x0050, 0x0217, 0x0207, 0x0208, 0x0040)
    voltage, remote = sorted(unready_remarks(rig, words))
    assert voltage.startswith("cable 1 (drive 1), cable 3 (drive 3), cable 8 (drive 8): its bit 4")
    assert remote.startswith("cable 4 (drive 4), cable 8 (drive 8): its bit 9 (remote)")


QUICK_STOPPED, NO_POWER, READY, ON, ENABLED = 0x0217, 0x0240, 0x0231, 0x0233, 0x0237


@pytest.mark.parametrize(
    ("goal", "healthy", "late", "said"),
    [
        (Goal.ENABLE, QUICK_STOPPED, NO_POWER, "voltage enabled"),
        (Goal.ENABLE, READY, NO_POWER, "voltage enabled"),
        (Goal.ENABLE, ON, 0x0221, "voltage enabled"),
        (Goal.ENABLE, ENABLED, QUICK_STOPPED, "transition 16"),
        (Goal.RELEASE, NO_POWER, QUICK_STOPPED, "transition 16"),
        (Goal.RELEASE, ENABLED, QUICK_STOPPED, "transition 16"),
        (Goal.RELEASE, ON, ENABLED, "instead of ready to switch on"),
        (Goal.RELEASE, READY, ON, "instead of ready to switch on"),
    ],
)
def test_drives_that_wait_for_a_late_one_are_not_named(
    goal: Goal, healthy: int, late: int, said: str
) -> None:
    """Seven that stopped were said to need a power cycle because the eighth had no power."""
    names = {node: f"cable {node}" for node in range(1, 9)}
    words = (healthy,) * 7 + (late,)
    states = [state_of(word) for word in words]
    commanded = next_words(goal, states, [True] * 8)
    ((node, text),) = late_drives(names, words, commanded, goal, 1.0)
    assert node == 8
    assert said in text


@given(
    goal=st.sampled_from([Goal.ENABLE, Goal.RELEASE]),
    words=st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=8),
)
def test_a_group_short_of_its_goal_has_a_late_drive(goal: Goal, words: list[int]) -> None:
    states = [state_of(word) for word in words]
    commanded = next_words(goal, states, [True] * len(words))
    found = late_drives({n: f"drive {n}" for n in range(len(words))}, words, commanded, goal, 1.0)
    reached = {
        Goal.ENABLE: {DriveState.OPERATION_ENABLED},
        Goal.RELEASE: {DriveState.SWITCH_ON_DISABLED, DriveState.READY_TO_SWITCH_ON},
    }[goal]
    assert bool(found) == (not set(states) <= reached)
    assert not any(states[node] in reached for node, _ in found)
    for node, text in found:
        assert commanded[node] is ControlWord.ENABLE_OPERATION or "0Fh" not in text


def test_only_a_drive_with_torque_and_no_fault_holds() -> None:
    assert {DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE} == HOLDS


@given(st.lists(st.tuples(st.sampled_from(DriveState), st.booleans()), min_size=1, max_size=8))
def test_a_stop_commands_every_drive_to_stop_whatever_it_reported(
    drives: list[tuple[DriveState, bool]],
) -> None:
    states, commanded = zip(*drives, strict=True)
    assert next_words(Goal.STOP, states, commanded) == (ControlWord.QUICK_STOP,) * len(states)


def test_the_flags_of_a_state_do_not_depend_on_the_protocol() -> None:
    """Pages and programs need no protocol's names of states."""
    cia402 = load_rig(ODRIVE_RIG.with_name("gachon_8_6.yaml"))
    flags = drive_flags(cia402, [0x0237, 0x0217, 0x021F, 0x0218, 0x0250, 0x0231, 0x0233, 0x0200])
    assert [one.torque for one in flags] == ["enabled", "holding", "holding"] + ["none"] * 5
    assert [one.in_fault for one in flags] == [False, False, True, True] + [False] * 4
    idle, armed = AxisState.IDLE, AxisState.CLOSED_LOOP_CONTROL
    words = [status_word(armed, 0), status_word(idle, 0), status_word(idle, 1), status_word(3, 0)]
    flags = drive_flags(odrive_rig(), words)
    assert [one.torque for one in flags] == ["enabled", "none", "none", "none"]
    assert [one.in_fault for one in flags] == [False, False, True, False]
