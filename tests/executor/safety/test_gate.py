"""The gate: deny by default; every limit allowed at its edge and denied one count beyond."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from executor.safety.gate import ALLOWED, GateDecision, Limits, Purpose, Request, examine

LIMITS = Limits(
    lowest=(-1000, 0, 2000),
    highest=(1000, 500, 2400),
    largest_step=(10, 20, 30),
    largest_lag=(50, 60, 70),
)
HERE = (100, 200, 2200)
DRIVES = range(3)
MOVE = Request(
    purpose=Purpose.MOVE,
    targets=HERE,
    previous=HERE,
    actual=HERE,
    armed=True,
    enabled=True,
    latched=False,
)
HOLD = replace(MOVE, purpose=Purpose.HOLD)
FIRST_HOLD = replace(HOLD, previous=None, enabled=False, armed=False)

each_drive = pytest.mark.parametrize("drive", DRIVES)
both_signs = pytest.mark.parametrize("sign", [-1, 1])


def _put(values: tuple[int, ...], drive: int, value: object) -> tuple[int, ...]:
    return (*values[:drive], value, *values[drive + 1 :])  # type: ignore[arg-type,return-value]


def _allowed(request: Request) -> bool:
    verdict = examine(LIMITS, request)
    assert verdict.allowed is (verdict.reason == "")
    return verdict.allowed


def _denied(request: Request) -> str:
    verdict = examine(LIMITS, request)
    assert verdict.allowed is False
    return verdict.reason


def test_a_move_that_keeps_everything_is_allowed():
    assert examine(LIMITS, MOVE) == ALLOWED == GateDecision(True, "")


@each_drive
@both_signs
def test_a_step_may_be_the_limit_and_not_a_count_more(drive, sign):
    limit = LIMITS.largest_step[drive]
    for previous in (HERE, (0, 250, 2300)):
        at, beyond = (_put(previous, drive, previous[drive] + sign * s) for s in (limit, limit + 1))
        good = replace(MOVE, previous=previous, targets=at, actual=previous)
        assert _allowed(good)
        reason = _denied(replace(good, targets=beyond))
        assert reason == f"cable {drive + 1}: step of {limit + 1} counts, limit {limit}"


@each_drive
@pytest.mark.parametrize(("side", "sign"), [("lowest", -1), ("highest", 1)])
def test_a_target_may_be_the_end_of_its_range_and_not_a_count_more(drive, side, sign):
    end = getattr(LIMITS, side)[drive]
    at, beyond = _put(HERE, drive, end), _put(HERE, drive, end + sign)
    inside = replace(MOVE, targets=at, previous=at, actual=at)
    assert _allowed(inside)
    reason = _denied(replace(inside, targets=beyond))
    assert reason == (
        f"cable {drive + 1}: target {end + sign} outside"
        f" [{LIMITS.lowest[drive]}, {LIMITS.highest[drive]}] counts"
    )


@each_drive
@both_signs
@pytest.mark.parametrize("request_", [MOVE, FIRST_HOLD], ids=["move", "hold"])
def test_a_target_may_lag_by_the_limit_and_not_a_count_more(drive, sign, request_):
    limit = LIMITS.largest_lag[drive]
    at, beyond = (_put(HERE, drive, HERE[drive] + sign * lag) for lag in (limit, limit + 1))
    assert _allowed(replace(request_, actual=at))
    reason = _denied(replace(request_, actual=beyond))
    assert reason == (
        f"cable {drive + 1}: target {limit + 1} counts from the actual position, limit {limit}"
    )


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"armed": False}, "not armed"),
        ({"enabled": False}, "not all drives are enabled"),
        ({"latched": True}, "a fault is latched"),
        ({"previous": None}, "no previous targets"),
        ({"armed": "yes"}, "not armed"),
        ({"armed": None}, "not armed"),
        ({"enabled": 1}, "not all drives are enabled"),
        ({"latched": None}, "a fault is latched"),
        ({"latched": 0}, "a fault is latched"),
        ({"purpose": None}, "unknown purpose"),
        ({"purpose": "move"}, "unknown purpose"),
    ],
)
def test_a_move_needs_every_condition_to_be_known_for_sure(change, reason):
    assert _denied(replace(MOVE, **change)) == reason


@given(
    armed=st.booleans(),
    enabled=st.booleans(),
    latched=st.booleans(),
    known=st.booleans(),
)
def test_a_move_is_allowed_in_one_combination_only(armed, enabled, latched, known):
    previous = HERE if known else None
    request = replace(MOVE, armed=armed, enabled=enabled, latched=latched, previous=previous)
    assert _allowed(request) is (armed and enabled and not latched and known)


@pytest.mark.parametrize("armed", [False, True])
@pytest.mark.parametrize("latched", [False, True])
@pytest.mark.parametrize("enabled", [False, True])
def test_holding_the_targets_of_before_is_always_allowed(armed, latched, enabled):
    """Also far from the actual positions and outside the range: a hold must never be denied."""
    far = (99_999, -99_999, 0)
    request = replace(HOLD, armed=armed, latched=latched, enabled=enabled)
    assert _allowed(replace(request, targets=far, previous=far))
    assert _allowed(replace(request, targets=far, previous=list(far)))


@each_drive
@pytest.mark.parametrize("previous", [None, HERE])
@pytest.mark.parametrize("enabled", [True, 1, None])
def test_a_hold_never_moves_drives_that_follow(drive, previous, enabled):
    targets = _put(HERE, drive, HERE[drive] + 1)
    request = replace(HOLD, targets=targets, previous=previous, enabled=enabled)
    assert _denied(request) == "a hold would change the targets of drives that follow set-points"


def test_drives_that_do_not_follow_may_be_given_their_actual_positions():
    other = tuple(value + 5 for value in HERE)
    assert _allowed(replace(HOLD, targets=other, enabled=False, actual=other))


@pytest.mark.parametrize("field", ["targets", "previous", "actual"])
@pytest.mark.parametrize("values", [(), HERE[:2], (*HERE, 5)])
@pytest.mark.parametrize("request_", [MOVE, HOLD], ids=["move", "hold"])
def test_a_wrong_number_of_entries_is_denied(field, values, request_):
    name = {"targets": "targets", "previous": "previous targets", "actual": "actual positions"}
    reason = _denied(replace(request_, **{field: values}))
    assert reason == f"{len(values)} {name[field]} for 3 drives"


@each_drive
@pytest.mark.parametrize("field", ["targets", "previous", "actual"])
@pytest.mark.parametrize(
    "value", [float("nan"), float("inf"), 200.0, True, None, "200", np.int64(200)]
)
def test_a_non_integer_is_denied_wherever_it_is(drive, field, value):
    """NaN is neither below nor above a limit, so comparing alone would let it pass."""
    for request in (MOVE, HOLD, FIRST_HOLD):
        if getattr(request, field) is None:
            continue
        reason = _denied(replace(request, **{field: _put(HERE, drive, value)}))
        assert reason.endswith("are not all whole numbers")


@given(
    targets=st.tuples(*[st.integers(-3000, 3000)] * 3),
    previous=st.tuples(*[st.integers(-3000, 3000)] * 3),
    actual=st.tuples(*[st.integers(-3000, 3000)] * 3),
)
def test_what_is_allowed_to_move_keeps_every_limit(targets, previous, actual):
    keeps = all(
        low <= target <= high and abs(target - last) <= step and abs(target - now) <= lag
        for low, high, step, lag, target, last, now in zip(
            LIMITS.lowest,
            LIMITS.highest,
            LIMITS.largest_step,
            LIMITS.largest_lag,
            targets,
            previous,
            actual,
            strict=True,
        )
    )
    request = replace(MOVE, targets=targets, previous=previous, actual=actual)
    assert _allowed(request) is keeps


@pytest.mark.parametrize("field", ["lowest", "highest", "largest_step", "largest_lag"])
def test_limits_that_miss_a_drive_cannot_be_made(field):
    with pytest.raises(ValueError, match="one limit of each kind per drive"):
        replace(LIMITS, **{field: getattr(LIMITS, field)[:2]})


def test_limits_for_no_drive_cannot_be_made():
    with pytest.raises(ValueError, match="one limit of each kind per drive"):
        Limits((), (), (), ())


@pytest.mark.parametrize("field", ["lowest", "highest", "largest_step", "largest_lag"])
@pytest.mark.parametrize("value", [float("nan"), 10.0, np.int64(7), True])
def test_limits_that_are_no_whole_numbers_cannot_be_made(field, value):
    with pytest.raises(ValueError, match="whole numbers of counts"):
        replace(LIMITS, **{field: _put(getattr(LIMITS, field), 1, value)})


@each_drive
@pytest.mark.parametrize(
    ("field", "value"), [("largest_step", -1), ("largest_lag", -1), ("highest", -1001)]
)
def test_limits_that_allow_nothing_cannot_be_made(drive, field, value):
    with pytest.raises(ValueError, match="allow nothing"):
        replace(LIMITS, **{field: _put(getattr(LIMITS, field), drive, value)})


@each_drive
def test_limits_of_one_position_and_no_step_can_be_made(drive):
    still = Limits(
        lowest=_put(LIMITS.lowest, drive, HERE[drive]),
        highest=_put(LIMITS.highest, drive, HERE[drive]),
        largest_step=_put(LIMITS.largest_step, drive, 0),
        largest_lag=_put(LIMITS.largest_lag, drive, 0),
    )
    assert examine(still, MOVE) == ALLOWED
    moved = _put(HERE, drive, HERE[drive] + 1)
    assert not examine(still, replace(MOVE, targets=moved)).allowed
