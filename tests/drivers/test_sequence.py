"""The group's steps: never disable voltage, all enabled or none, and it arrives."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.cia402.state_machine import (
    FAULTED,
    TORQUE_ON,
    ControlWord,
    DriveState,
    Goal,
    change_on_its_own,
    next_words,
)

STATES = st.sampled_from(DriveState)
READY = {
    DriveState.SWITCHED_ON,
    DriveState.QUICK_STOP_ACTIVE,
    DriveState.OPERATION_ENABLED,
}


WITHOUT_TORQUE = {
    DriveState.SWITCH_ON_DISABLED,
    DriveState.READY_TO_SWITCH_ON,
    DriveState.SWITCHED_ON,
}


def after(state: DriveState, word: ControlWord) -> DriveState:
    """What a drive of CiA 402 does with a word (605Ah = 6)."""
    match word, state:
        case ControlWord.QUICK_STOP, DriveState.OPERATION_ENABLED:
            return DriveState.QUICK_STOP_ACTIVE
        case ControlWord.QUICK_STOP, DriveState.READY_TO_SWITCH_ON | DriveState.SWITCHED_ON:
            return DriveState.SWITCH_ON_DISABLED
        case ControlWord.SHUTDOWN, (
            DriveState.SWITCH_ON_DISABLED | DriveState.SWITCHED_ON | DriveState.OPERATION_ENABLED
        ):
            return DriveState.READY_TO_SWITCH_ON
        case ControlWord.SWITCH_ON, (DriveState.READY_TO_SWITCH_ON | DriveState.OPERATION_ENABLED):
            return DriveState.SWITCHED_ON
        case ControlWord.ENABLE_OPERATION, (DriveState.SWITCHED_ON | DriveState.QUICK_STOP_ACTIVE):
            return DriveState.OPERATION_ENABLED
    return state


@given(
    goal=st.sampled_from(Goal),
    drives=st.lists(st.tuples(STATES, st.booleans()), min_size=1, max_size=10),
)
def test_words_never_free_a_cable_and_enable_all_or_none(
    goal: Goal, drives: list[tuple[DriveState, bool]]
) -> None:
    states = [state for state, _ in drives]
    words = next_words(goal, states, [commanded for _, commanded in drives])
    assert len(words) == len(states)
    assert all(word & 0x02 for word in words)
    if ControlWord.ENABLE_OPERATION in words:
        assert goal in (Goal.ENABLE, Goal.RELEASE)
        joined = set(zip(states, words, strict=True))
        if goal is Goal.RELEASE:  # a drive that has no torque gets none
            joined -= {(state, ControlWord.SHUTDOWN) for state in WITHOUT_TORQUE}
        assert {word for _, word in joined} == {ControlWord.ENABLE_OPERATION}
        assert {state for state, _ in joined} <= READY
    for state, word in zip(states, words, strict=True):
        if state is DriveState.QUICK_STOP_ACTIVE:
            # Holding drives are only commanded to keep holding, or to follow again with all others.
            assert word in (ControlWord.QUICK_STOP, ControlWord.ENABLE_OPERATION)
        if state is DriveState.OPERATION_ENABLED and word is ControlWord.SHUTDOWN:
            pytest.fail("shutdown of a drive under torque")


@given(
    st.lists(
        st.sampled_from(
            [
                DriveState.SWITCH_ON_DISABLED,
                DriveState.READY_TO_SWITCH_ON,
                DriveState.SWITCHED_ON,
                DriveState.QUICK_STOP_ACTIVE,
                DriveState.OPERATION_ENABLED,
            ]
        ),
        min_size=1,
        max_size=10,
    )
)
def test_any_mixture_without_fault_is_enabled_and_released(
    states: list[DriveState],
) -> None:
    def run(goal: Goal, states: list[DriveState]) -> list[DriveState]:
        stop_commanded = [False] * len(states)
        for _ in range(8):
            words = next_words(goal, states, stop_commanded)
            stop_commanded = [
                s is DriveState.QUICK_STOP_ACTIVE and (r or w is ControlWord.QUICK_STOP)
                for s, r, w in zip(states, stop_commanded, words, strict=True)
            ]
            states = [after(s, w) for s, w in zip(states, words, strict=True)]
        return states

    enabled = run(Goal.ENABLE, states)
    assert set(enabled) == {DriveState.OPERATION_ENABLED}
    assert set(run(Goal.STOP, enabled)) == {DriveState.QUICK_STOP_ACTIVE}
    assert set(run(Goal.RELEASE, states)) == {DriveState.READY_TO_SWITCH_ON}


@pytest.mark.parametrize("bad", [DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE])
@pytest.mark.parametrize("goal", [Goal.ENABLE, Goal.RELEASE])
def test_a_fault_of_one_stops_all(goal: Goal, bad: DriveState) -> None:
    states = [DriveState.OPERATION_ENABLED] * 7 + [bad]
    assert set(next_words(goal, states, [True] * 8)) == {ControlWord.QUICK_STOP}


def test_a_drive_that_stopped_by_itself_is_first_stop_commanded() -> None:
    """The word that it was already getting must not enable it again."""
    states = [DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE]
    assert next_words(Goal.ENABLE, states, [False, False])[1] is ControlWord.QUICK_STOP
    assert next_words(Goal.ENABLE, states, [False, True])[1] is ControlWord.ENABLE_OPERATION


def test_only_faulted_drives_get_a_reset() -> None:
    states = [DriveState.FAULT, DriveState.SWITCH_ON_DISABLED]
    words = next_words(Goal.RESET_FAULT, states, [False, False])
    assert words == (ControlWord.RESET_FAULT, ControlWord.SHUTDOWN)


def test_unknown_drives_are_stop_commanded() -> None:
    """A drive not heard yet may be holding the platform from an earlier run."""
    assert next_words(Goal.IDLE, [DriveState.NOT_READY], [False]) == (ControlWord.QUICK_STOP,)


@given(
    goal=st.sampled_from(Goal),
    before=STATES,
    word=st.sampled_from(ControlWord),
    enables=st.booleans(),
)
def test_what_was_commanded_is_not_taken_for_a_change_of_its_own(
    goal: Goal, before: DriveState, word: ControlWord, enables: bool
) -> None:
    """Words that a goal sends to a drive in this state: all alike once "enable operation" was."""
    if goal is Goal.ENABLE and enables:
        word = ControlWord.ENABLE_OPERATION
    elif word not in {*next_words(goal, [before], [True]), *next_words(goal, [before], [False])}:
        return
    assert change_on_its_own(goal, enables, before, after(before, word)) is None


@pytest.mark.parametrize("goal", [Goal.ENABLE, Goal.RELEASE])
@pytest.mark.parametrize("before", sorted(READY - {DriveState.QUICK_STOP_ACTIVE}, key=str))
def test_a_quick_stop_after_enable_operation_is_the_drives_own(
    goal: Goal, before: DriveState
) -> None:
    """It was sent 02h, with all healthy drives, and enabled again."""
    found = change_on_its_own(goal, True, before, DriveState.QUICK_STOP_ACTIVE)
    assert found == "stopped on its own: quick stop active"


@given(before=st.sampled_from(sorted(READY, key=str)), state=STATES)
def test_a_drive_that_was_sent_enable_operation_may_only_stay_or_be_enabled(
    before: DriveState, state: DriveState
) -> None:
    allowed = state in (before, DriveState.OPERATION_ENABLED) or state in FAULTED
    assert (change_on_its_own(Goal.ENABLE, True, before, state) is None) == allowed


@given(goal=st.sampled_from(Goal), state=STATES)
def test_a_held_cable_that_loses_its_torque_is_noticed_before_anything_is_enabled(
    goal: Goal, state: DriveState
) -> None:
    found = change_on_its_own(goal, False, DriveState.QUICK_STOP_ACTIVE, state)
    assert (found == f"lost its torque: {state.value}") == (state not in TORQUE_ON | FAULTED)


ENABLING = {
    (DriveState.NOT_READY, DriveState.SWITCHED_ON): "QUICK_STOP SHUTDOWN",
    (DriveState.SWITCH_ON_DISABLED, DriveState.SWITCHED_ON): "SHUTDOWN SHUTDOWN",
    (DriveState.SWITCH_ON_DISABLED, DriveState.READY_TO_SWITCH_ON): "SHUTDOWN SHUTDOWN",
    (DriveState.READY_TO_SWITCH_ON, DriveState.SWITCHED_ON): "SWITCH_ON SWITCH_ON",
    (DriveState.READY_TO_SWITCH_ON, DriveState.OPERATION_ENABLED): "SWITCH_ON QUICK_STOP",
    (DriveState.SWITCHED_ON, DriveState.SWITCHED_ON): "ENABLE_OPERATION ENABLE_OPERATION",
    (DriveState.SWITCHED_ON, DriveState.OPERATION_ENABLED): "ENABLE_OPERATION ENABLE_OPERATION",
}


@pytest.mark.parametrize("states", ENABLING)
def test_each_step_towards_enabled_is_that_of_the_drive_furthest_behind(
    states: tuple[DriveState, ...],
) -> None:
    words = next_words(Goal.ENABLE, states, [False] * len(states))
    assert " ".join(word.name for word in words) == ENABLING[states]
