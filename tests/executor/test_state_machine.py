"""The state machine: every pair of state and event is either listed here or forbidden."""

from __future__ import annotations

from contextlib import suppress
from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from executor.state_machine import Event, ForbiddenTransition, Machine, State

#: The shortest sequence of events to every state.
EVENTS_TO = {
    State.READY: (),
    State.ENABLING: (Event.ENABLE,),
    State.APPROACHING: (Event.ENABLE, Event.ENABLED),
    State.MOVING: (Event.ENABLE, Event.ENABLED, Event.AT_START),
    State.HOLDING: (Event.ENABLE, Event.ENABLED, Event.AT_START, Event.HOLD),
    State.STOPPING: (Event.ENABLE, Event.ENABLED, Event.AT_START, Event.STOP),
    State.SECURING: (Event.ENABLE, Event.ENABLED, Event.AT_START, Event.AT_REST),
    State.FINISHED: (Event.ENABLE, Event.ENABLED, Event.AT_START, Event.AT_REST, Event.HELD),
    State.STOPPED: (Event.ENABLE, Event.STOP, Event.HELD),
    State.LATCHED: (Event.FAULT,),
}
FORESEEN = {
    (State.READY, Event.ENABLE): State.ENABLING,
    (State.ENABLING, Event.ENABLED): State.APPROACHING,
    (State.ENABLING, Event.STOP): State.SECURING,
    (State.APPROACHING, Event.AT_START): State.MOVING,
    (State.APPROACHING, Event.STOP): State.SECURING,
    (State.MOVING, Event.HOLD): State.HOLDING,
    (State.HOLDING, Event.RESUME): State.MOVING,
    (State.HOLDING, Event.STOP): State.STOPPING,
    (State.HOLDING, Event.PATH_FAULT): State.STOPPING,
    (State.MOVING, Event.STOP): State.STOPPING,
    (State.MOVING, Event.PATH_FAULT): State.STOPPING,
    (State.MOVING, Event.AT_REST): State.SECURING,
    (State.STOPPING, Event.STOP): State.STOPPING,
    (State.STOPPING, Event.PATH_FAULT): State.STOPPING,
    (State.STOPPING, Event.AT_REST): State.SECURING,
    (State.SECURING, Event.PATH_FAULT): State.SECURING,
    (State.SECURING, Event.HELD): State.FINISHED,
    **{(state, Event.FAULT): State.LATCHED for state in State},
}
ENDS = {State.FINISHED, State.STOPPED, State.LATCHED}


def _after(*events: Event) -> Machine:
    machine = Machine()
    for event in events:
        machine.on(event)
    return machine


@pytest.mark.parametrize("state", list(State))
def test_every_state_can_be_reached(state):
    assert _after(*EVENTS_TO[state]).state is state


@pytest.mark.parametrize(("state", "event"), list(product(State, Event)))
def test_every_event_in_every_state_is_listed_or_forbidden(state, event):
    machine = _after(*EVENTS_TO[state])
    if (state, event) in FORESEEN:
        wanted = FORESEEN[state, event]
        assert machine.on(event) is wanted
        assert machine.state is wanted
    else:
        with pytest.raises(ForbiddenTransition, match=f"{event.value} in state {state.value}"):
            machine.on(event)
        assert machine.state is state


@pytest.mark.parametrize("event", list(Event))
def test_nothing_leads_out_of_latched(event):
    machine = _after(*EVENTS_TO[State.MOVING], Event.FAULT)
    if event is not Event.FAULT:
        with pytest.raises(ForbiddenTransition):
            machine.on(event)
    else:
        machine.on(event)
    assert machine.state is State.LATCHED


def test_nothing_but_events_changes_the_state():
    with pytest.raises(AttributeError):
        Machine().state = State.MOVING  # type: ignore[misc]


@pytest.mark.parametrize(
    ("events", "end"),
    [
        ((Event.AT_REST,), State.FINISHED),
        ((Event.STOP, Event.AT_REST), State.STOPPED),
        ((Event.STOP, Event.STOP, Event.AT_REST), State.STOPPED),
        ((Event.PATH_FAULT, Event.AT_REST), State.LATCHED),
        ((Event.PATH_FAULT, Event.STOP, Event.AT_REST), State.LATCHED),
        ((Event.STOP, Event.PATH_FAULT, Event.AT_REST), State.LATCHED),
    ],
)
def test_the_end_tells_how_it_came_to_it_and_a_fault_outweighs_a_stop(events, end):
    machine = _after(*EVENTS_TO[State.MOVING], *events)
    assert machine.state is State.SECURING
    assert machine.on(Event.HELD) is end


@pytest.mark.parametrize("state", [State.ENABLING, State.APPROACHING])
def test_a_stop_before_the_motion_ends_stopped(state):
    assert _after(*EVENTS_TO[state], Event.STOP, Event.HELD).state is State.STOPPED


@given(events=st.lists(st.sampled_from(list(Event)), max_size=25))
def test_no_sequence_of_events_leaves_an_end_or_unlatches(events):
    machine, ended = Machine(), None
    for event in events:
        with suppress(ForbiddenTransition):
            machine.on(event)
        if ended is not None:
            assert machine.state in {ended, State.LATCHED}
        ended = machine.state if machine.state in ENDS else None


@given(events=st.lists(st.sampled_from(list(Event)), max_size=25))
def test_a_fault_on_the_path_never_ends_as_finished_or_stopped(events):
    machine, faulted = Machine(), False
    for event in events:
        try:
            machine.on(event)
        except ForbiddenTransition:
            continue
        faulted |= event in {Event.FAULT, Event.PATH_FAULT}
    if faulted:
        assert machine.state not in {State.FINISHED, State.STOPPED}
