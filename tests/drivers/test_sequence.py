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
    SentWords,
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
    st.lists(
        st.tuples(st.sampled_from(Goal), st.lists(STATES, min_size=3, max_size=3)),
        min_size=1,
        max_size=12,
    )
)
def test_only_a_drive_that_showed_no_torque_and_was_not_enabled_since_keeps_its_word(
    cycles: list[tuple[Goal, list[DriveState]]],
) -> None:
    """Any states in any order, such as no drive shows: denied unless all replies prove it."""
    sent = SentWords(3)
    history: list[tuple[list[DriveState], tuple[ControlWord, ...]]] = []
    for goal, states in cycles:
        former = sent.words
        words = sent.next_words(goal, states)
        plain = next_words(goal, states, stops_commanded(history, states))
        unknown = [state is DriveState.NOT_READY for state in states]
        stops = set(plain) == {ControlWord.QUICK_STOP} and goal is not Goal.ENABLE
        for drive, word in enumerate(words):
            if unknown[drive]:
                assert word is not ControlWord.ENABLE_OPERATION
                if has_no_torque(history, drive) and not stops and FAULTED.isdisjoint(states):
                    stopped = former[drive] is ControlWord.QUICK_STOP
                    assert word is (plain if stopped else former)[drive]
                elif not has_no_torque(history, drive):
                    assert word is plain[drive]
        if goal is Goal.STOP or (goal is Goal.ENABLE and not FAULTED.isdisjoint(states)):
            assert set(words) == {ControlWord.QUICK_STOP}
        if any(unknown):
            assert ControlWord.ENABLE_OPERATION not in words
        else:
            assert words == plain
        sent.note(states, words)
        history.append((states, words))


def has_no_torque(
    history: list[tuple[list[DriveState], tuple[ControlWord, ...]]], drive: int
) -> bool:
    """Whether a reply showed it, to another word than 0Fh, and 0Fh has not been sent since."""
    replied_to = [ControlWord.QUICK_STOP, *(words[drive] for _, words in history)]
    proven = False
    for (states, words), before in zip(history, replied_to, strict=False):
        if ControlWord.ENABLE_OPERATION in (before, words[drive]):
            proven = False
        elif states[drive] not in (DriveState.NOT_READY, DriveState.SWITCHED_ON):
            proven = states[drive] in WITHOUT_TORQUE
    return proven


def stops_commanded(
    history: list[tuple[list[DriveState], tuple[ControlWord, ...]]], states: list[DriveState]
) -> list[bool]:
    """Drives that were sent 02h in an unbroken row of replies with *quick stop active*."""
    commanded = [False] * len(states)
    for shown, words in history:
        commanded = [
            state is DriveState.QUICK_STOP_ACTIVE and (was or word is ControlWord.QUICK_STOP)
            for state, word, was in zip(shown, words, commanded, strict=True)
        ]
    return commanded


@given(
    drives=st.lists(
        st.tuples(
            st.sampled_from(
                [
                    DriveState.SWITCH_ON_DISABLED,
                    DriveState.READY_TO_SWITCH_ON,
                    DriveState.QUICK_STOP_ACTIVE,
                ]
            ),
            st.integers(0, 4),
            st.integers(0, 2),
        ),
        min_size=1,
        max_size=6,
    )
)
def test_drives_that_show_unknown_codes_on_the_way_are_enabled_and_released(
    drives: list[tuple[DriveState, int, int]],
) -> None:
    """Each shows them for some replies after each change of its state, and some change it later."""
    sent = SentWords(len(drives))
    states = [state for state, _, _ in drives]
    hidden, waited = [0] * len(drives), [0] * len(drives)

    def step(goal: Goal) -> list[DriveState]:
        shown = [DriveState.NOT_READY if h else s for h, s in zip(hidden, states, strict=True)]
        words = sent.next_words(goal, shown)
        for drive, (word, (_, passing, delay)) in enumerate(zip(words, drives, strict=True)):
            hidden[drive] = max(0, hidden[drive] - 1)
            new = after(states[drive], word)
            waited[drive] = waited[drive] + 1 if new is not states[drive] else 0
            if waited[drive] > delay:
                hidden[drive] = passing if new in WITHOUT_TORQUE else 0
                states[drive], waited[drive] = new, 0
        sent.note(shown, words)
        return shown

    def run(goal: Goal, wanted: DriveState) -> None:
        for _ in range(100):
            if set(step(goal)) == {wanted}:
                return
        pytest.fail(f"not {wanted} but {states}")

    for _ in range(2):  # all have been known once
        step(Goal.IDLE)
    run(Goal.ENABLE, DriveState.OPERATION_ENABLED)
    run(Goal.STOP, DriveState.QUICK_STOP_ACTIVE)
    run(Goal.RELEASE, DriveState.READY_TO_SWITCH_ON)
    run(Goal.ENABLE, DriveState.OPERATION_ENABLED)


@pytest.mark.parametrize("words", [(0x06, "SHUTDOWN SHUTDOWN"), (0x07, "SWITCH_ON SWITCH_ON")])
def test_the_others_do_not_return_for_a_drive_in_passing(words: tuple[int, str]) -> None:
    """Two that pass one after the other would never be enabled."""
    states = [DriveState.SWITCHED_ON, DriveState.NOT_READY]
    found = next_words(Goal.ENABLE, states, [False] * 2, {1: ControlWord(words[0])})
    assert " ".join(word.name for word in found) == words[1]


def test_while_one_is_unknown_no_drive_is_enabled_for_a_release() -> None:
    states = [DriveState.QUICK_STOP_ACTIVE, DriveState.NOT_READY]
    found = next_words(Goal.RELEASE, states, [True] * 2, {1: ControlWord.SHUTDOWN})
    assert found == (ControlWord.QUICK_STOP, ControlWord.SHUTDOWN)


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


def test_a_drive_keeps_its_word_only_until_enable_operation_is_sent() -> None:
    """A reply to 0Fh, and *switched on* after it, prove nothing: only a state below it does."""
    unknown, ready, on = DriveState.NOT_READY, DriveState.READY_TO_SWITCH_ON, DriveState.SWITCHED_ON
    sent = SentWords(1)
    assert sent.kept([unknown]) == {}
    steps = [
        (ready, ControlWord.SHUTDOWN, True),
        (ready, ControlWord.SWITCH_ON, True),
        (unknown, ControlWord.SWITCH_ON, True),
        (on, ControlWord.SWITCH_ON, True),
        (on, ControlWord.ENABLE_OPERATION, False),
        (ready, ControlWord.SHUTDOWN, False),
        (on, ControlWord.SHUTDOWN, False),
        (DriveState.OPERATION_ENABLED, ControlWord.SHUTDOWN, False),
        (ready, ControlWord.SHUTDOWN, True),
        (DriveState.FAULT, ControlWord.SHUTDOWN, False),
    ]
    for state, word, is_kept in steps:
        sent.note([state], (word,))
        assert sent.kept([unknown]) == ({0: word} if is_kept else {})
        assert sent.kept([state]) == ({0: word} if is_kept and state is unknown else {})


@pytest.mark.parametrize("state", [DriveState.SWITCHED_ON, DriveState.QUICK_STOP_ACTIVE])
def test_a_stop_counts_only_if_it_was_sent_to_a_drive_that_had_stopped(state: DriveState) -> None:
    stopped, stop, enable = [DriveState.QUICK_STOP_ACTIVE], ControlWord.QUICK_STOP, Goal.ENABLE
    sent = SentWords(1)
    assert sent.next_words(enable, stopped) == (stop,)
    other = ControlWord.SHUTDOWN if state in stopped else stop
    sent.note([state], (other,))
    assert sent.next_words(enable, stopped) == (stop,)
    sent.note(stopped, (stop,))
    assert sent.next_words(enable, stopped) == (ControlWord.ENABLE_OPERATION,)


@pytest.mark.parametrize("state", sorted(WITHOUT_TORQUE - {DriveState.SWITCHED_ON}, key=str))
def test_for_a_release_enabled_drives_are_disabled_first(state: DriveState) -> None:
    states = [DriveState.OPERATION_ENABLED, state]
    found = next_words(Goal.RELEASE, states, [False] * 2)
    assert found == (ControlWord.SWITCH_ON, ControlWord.SHUTDOWN)


@pytest.mark.parametrize("goal", [goal for goal in Goal if goal is not Goal.RESET_FAULT])
def test_no_drive_is_reset_unasked(goal: Goal) -> None:
    assert next_words(goal, [DriveState.FAULT], [False]) != (ControlWord.RESET_FAULT,)


def test_a_stop_is_not_kept_when_a_drive_at_rest_is_to_be_released() -> None:
    sent = SentWords(1)
    sent.note([DriveState.READY_TO_SWITCH_ON], (ControlWord.QUICK_STOP,))
    found = sent.next_words(Goal.RELEASE, [DriveState.NOT_READY])
    assert found == (ControlWord.SHUTDOWN,)
