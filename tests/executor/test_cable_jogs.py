"""One cable at a time by hold-to-run, in simulated time: only while held, never too tight."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from executor.control import winch_laws
from executor.control.winch_laws import tension_reserve
from executor.hold_to_run import session as sessions
from executor.hold_to_run.cables import CableLimits, CableTravel
from executor.hold_to_run.presses import TIMEOUT, CableMove, Press, PressBoard, PressState
from executor.hold_to_run.session import cable_session
from executor.jogging import with_speed
from executor.remote.protocol import STEPS_MM
from executor.remote.status import CableStatus
from executor.state_machine import CycleRecord, State
from executor.supervision import LocalRequests
from executor.winch_runs import limit_of
from model.errors import Fault, Refused, StoppedByOperator
from model.pose import Array
from model.rig import Rig, load_rig, rig_from_document
from tests.cli.plans import RIG
from tests.effort import cases

SPEED = 0.020
#: Time from the jog speed to rest, [s].
RAMP = 0.35


@cache
def rig(home_mm: tuple[float, float, float] = (0.0, 0.0, 445.0), soft: float = 1.0) -> Rig:
    """The paper's rig with its simulated platform elsewhere; softer cables move it farther."""
    document = load_rig(RIG).document
    home = document.platform.home.model_copy(update={"position_mm": list(home_mm)})
    platform = document.platform.model_copy(update={"home": home})
    cables = document.cables.model_copy(update={"stiffness_n": document.cables.stiffness_n * soft})
    return rig_from_document(document.model_copy(update={"platform": platform, "cables": cables}))


Say = Callable[[PressBoard], object]


@dataclass
class Script:
    """Holds controls in simulated time, and keeps the records of the loop."""

    holds: list[tuple[float, float, Say]]
    end: float
    records: list[CycleRecord] = field(default_factory=list)
    travel: CableTravel | None = None

    def __call__(self, record: CycleRecord, board: PressBoard, travel: CableTravel) -> None:
        self.records.append(record)
        self.travel = travel
        for begin, until, say in self.holds:
            if begin <= record.at < until:
                say(board)
        if record.at >= self.end:
            board.end()

    def run(self, robot: Rig | None = None, limit: float | None = None) -> list[CycleRecord]:
        cable_session(robot or rig(), limit=limit, speed=SPEED, realtime=False, on_cycle=self)
        return self.records


def hold(number: int, cable: int, out: bool, step: float | None = None, percent: int = 100) -> Say:
    move = CableMove(cable, pays_out=out)
    return lambda board: board.hold(number, move, step=step, percent=percent)


def moved(records: list[CycleRecord], robot: Rig) -> Array:
    """Length paid out since the start, per cycle and cable, shape (n, m), [m]."""
    targets = np.array([record.targets for record in records], dtype=np.float64)
    return (targets - targets[0]) / [winch.counts_per_metre for winch in robot.winches]


def tensions(records: list[CycleRecord], robot: Rig) -> Array:
    return np.array([robot.tensions_by(record.torques) for record in records])


def is_moving(records: list[CycleRecord]) -> list[bool]:
    return [False, *(a.targets != b.targets for a, b in pairwise(records))]


SOFT = 0.002


def test_a_cable_is_paid_out_while_held_and_rests_when_released() -> None:
    robot = rig(soft=SOFT)
    script = Script([(0.5, 1.0, hold(1, 3, out=True))], 2.5)
    records = script.run(robot)
    at = np.array([record.at for record in records])
    out, still = moved(records, robot), np.array(is_moving(records))
    assert out[-1, 2] > 5e-4
    assert (np.delete(out, 2, axis=1) == 0.0).all(), "the others rest"
    assert not still[at < 0.5].any()
    assert not still[at > 1.0 + TIMEOUT + RAMP].any()
    assert (np.diff(out[:, 2]) >= 0.0).all(), "never in the other direction"
    assert records[-1].state is State.SECURING
    assert script.travel is not None
    assert script.travel.cable == 3
    assert script.travel.by_press == pytest.approx(out[-1, 2], abs=1e-9)
    assert script.travel.by_session[2] == pytest.approx(out[-1, 2], abs=1e-9)


@pytest.mark.parametrize("out", [True, False])
@pytest.mark.parametrize("length", [step / 1000.0 for step in STEPS_MM])
def test_a_step_ends_where_it_should(length: float, out: bool) -> None:
    robot = rig(soft=0.0002)  # so soft that 10 mm are far from any limit
    script = Script([(0.5, 4.0, hold(1, 3, out=out, step=length))], 4.2)
    travel = moved(script.run(robot), robot)[-1, 2]
    assert travel == pytest.approx(length if out else -length, abs=2e-6)


def test_a_step_that_is_released_ends_early() -> None:
    robot = rig(soft=SOFT)
    out = moved(Script([(0.5, 0.7, hold(1, 3, out=True, step=0.010))], 2.0).run(robot), robot)
    assert 0.0 < out[-1, 2] < 0.009


@pytest.mark.parametrize("step", [None, 0.001])
def test_winding_in_comes_to_rest_before_the_limit_and_ends_well(step: float | None) -> None:
    """Steel cables on a taut platform: some hundredths of a millimetre. No fault is latched."""
    limit = limit_of(rig(), None)
    script = Script([(0.5, 6.0, hold(1, 3, out=False, step=step))], 7.0)
    records = script.run()
    pull = tensions(records, rig())
    ceiling = limit - tension_reserve(rig(), limit)
    assert pull.max() < limit
    if step is None:  # a step begins so slowly that it is let go before it is there
        assert pull.max() > ceiling - 2.0, "it is not stopped far before it"
    assert moved(records, rig())[-1, 2] < 0.0
    assert records[-1].state is State.SECURING
    assert script.travel is not None
    assert ("near the limit" in script.travel.limit) == (pull[-1].max() > ceiling - 3.0)


def test_what_was_wound_in_can_be_paid_out_again() -> None:
    holds = [(0.5, 4.0, hold(1, 3, out=False)), (4.5, 4.8, hold(2, 3, out=True))]
    records = Script(holds, 6.0).run()
    pull = tensions(records, rig())
    assert pull[-20:].max() < pull.max() - 5.0
    assert moved(records, rig())[-1, 2] > moved(records, rig())[:, 2].min()


def test_a_press_moves_a_cable_by_no_more_than_its_longest_travel(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sessions, "LONGEST_MM", 8.0)
    robot = rig(soft=SOFT)
    script = Script([(0.5, 6.0, hold(1, 3, out=True))], 6.5)
    travel = moved(script.run(robot), robot)[-1, 2]
    assert 0.004 < travel <= 0.008


COMMANDS = st.lists(
    st.tuples(
        st.integers(1, 8),
        st.booleans(),
        st.sampled_from([None, None, 0.0001, 0.001, 0.010]),
        st.integers(1, 16),
        st.booleans(),
    ),
    min_size=1,
    max_size=4,
)
HOMES = st.tuples(st.integers(-15, 15), st.integers(-15, 15), st.integers(25, 55)).map(
    lambda cm: tuple(10.0 * v for v in cm)
)


@pytest.mark.slow
@settings(max_examples=cases(60), deadline=None)
@given(presses=COMMANDS, home=HOMES, soft=st.sampled_from([1.0, 0.02, 0.002]))
def test_nothing_moves_unless_held_and_no_tension_is_beyond_the_limit(
    presses: list[tuple[int, bool, float | None, int, bool]],
    home: tuple[float, float, float],
    soft: float,
) -> None:
    """Random cables, senses, poses and silences, in the simulated plant."""
    robot = rig(home, soft)
    holds: list[tuple[float, float, Say]] = []
    spans, begin = [], 0.5
    for number, (cable, out, step, length, silent) in enumerate(presses, start=1):
        until = begin + 0.05 * length
        say = hold(number, cable, out, step)
        holds.append((begin, until, say))
        spans.append((begin, until, cable - 1, out))
        if silent:  # reported again after too long a silence: it must stay over
            holds.append((until + 0.25, until + 0.5, say))
            begin = until + 0.6
        else:
            holds.append((until, until + 0.015, lambda board, n=number: board.let_go(n)))
            begin = until + 0.1
    script = Script(holds, begin + 1.0)
    slack = ""
    try:
        script.run(robot)
    except Fault as error:  # the only fault that paying out may end in
        slack = error.what
        assert "went slack" in slack
    records = script.records
    limit = limit_of(with_speed(robot, SPEED), None)
    held_pull = tensions([r for r in records if r.state is State.MOVING], robot)
    assert held_pull.max() <= limit
    out_of = np.diff(moved(records, robot), axis=0)
    for record, travel in zip(records[1:], out_of, strict=True):
        for cable in np.flatnonzero(travel):
            may = [
                (a, b)
                for a, b, which, pays in spans
                if which == cable and pays == (travel[cable] > 0.0)
            ]
            assert any(a <= record.at <= b + TIMEOUT + RAMP for a, b in may)
    fastest = max(np.abs(out_of).max(), 0.0)
    coarsest = 1.0 / min(abs(winch.counts_per_metre) for winch in robot.winches)
    assert fastest <= SPEED * 0.01 + 1.01 * coarsest


def test_it_slows_down_on_release_with_limited_acceleration() -> None:
    robot = rig(soft=0.0002)
    records = Script([(0.5, 1.2, hold(1, 3, out=True))], 3.0).run(robot)
    at = np.array([record.at for record in records])
    rates = np.array([record.rate for record in records])
    motion = with_speed(robot, SPEED).motion
    most = motion.acceleration / motion.speed * 0.01
    assert np.abs(np.diff(rates[at < 2.5])).max() <= most * 1.01
    released = rates[(at > 1.2 + TIMEOUT) & (at < 2.5)]
    assert (np.diff(released) <= 1e-9).all()
    assert released[-1] == 0.0


def test_another_cable_that_goes_slack_anyway_ends_in_a_fault(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As for `cdpr jog --cable`: the platform pose is unknown afterwards."""
    monkeypatch.setattr(winch_laws, "LEAST_SHARE", -100.0)
    script = Script([(0.5, 9.0, hold(1, 1, out=True))], 9.5)
    with pytest.raises(Fault, match="went slack"):
        script.run()
    rest = [r for r in script.records if r.state is State.SECURING]
    assert len({record.targets for record in rest}) == 1


def test_a_stop_ends_the_session() -> None:
    robot = rig(soft=SOFT)
    script = Script([(0.5, 3.0, hold(1, 3, out=True))], 9.0)

    class Stops(sessions.Supervisor):
        def during(self, board, motion):  # type: ignore[no-untyped-def]
            self.board = board
            return motion()

    stops = Stops()

    def on_cycle(record: CycleRecord, board: PressBoard, travel: CableTravel) -> None:
        script(record, board, travel)
        if record.at > 0.8:
            stops.board.ask_stop()

    with pytest.raises(StoppedByOperator):
        cable_session(robot, speed=SPEED, realtime=False, on_cycle=on_cycle, supervisor=stops)
    assert script.records[-1].at < 2.5
    assert np.abs(np.diff([record.rate for record in script.records])).max() < 0.5


def test_a_session_ends_on_its_own_when_nothing_is_held(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sessions, "IDLE", 0.8)
    records = Script([], 99.0).run()
    assert 0.8 < records[-1].at < 2.0
    assert not any(is_moving(records))


def test_a_limit_that_the_rig_does_not_have_is_refused() -> None:
    with pytest.raises(Refused, match="limit of 101 N"):
        cable_session(rig(), limit=101.0, realtime=False)


def test_a_no_enables_nothing() -> None:
    script = Script([], 1.0)
    with pytest.raises(StoppedByOperator, match="nothing was enabled"):
        cable_session(rig(), realtime=False, confirm=lambda _: False, on_cycle=script)
    assert script.records == []


@given(
    st.booleans(),
    st.integers(-(10**6), 10**6),
    st.sampled_from([None, 0.0001, 0.010]),
    st.integers(0, 7),
)
def test_a_press_stays_within_the_positions_of_its_drive(
    out: bool, here: int, step: float | None, cable: int
) -> None:
    robot = rig()
    low, high = -20_000, 30_000
    limits = CableLimits(60.0, SPEED, 0.050, tuple([(low, high)] * 8))
    positions = [0] * 8
    positions[cable] = here
    held = PressState(1, 1.0, False, cable + 1, out, step)
    travel = limits.travel(robot, positions, held)
    assert travel >= 0.0 if out else travel <= 0.0
    assert abs(travel) <= (step or 0.050)
    end = here + travel * robot.winches[cable].counts_per_metre
    if low <= here <= high:
        assert low - 1e-6 <= end <= high + 1e-6
    elif (here > high) == (end > here):
        assert end == here, "not farther from where it may be"


def test_the_status_says_which_cable_and_how_far() -> None:
    robot = rig(soft=SOFT)
    script = Script([(0.5, 1.0, hold(1, 3, out=True, step=0.001))], 2.5)
    script.run(robot)
    assert script.travel is not None
    status = CableStatus(
        with_speed(robot, SPEED), LocalRequests(), script.travel, simulated_time=True
    )
    jog = status.as_dict()["cable_jog"]
    assert (jog["cable"], jog["speed_mm_s"], jog["limit"]) == (3, 20.0, None)
    assert jog["press_mm"] == pytest.approx(1.0, abs=0.01)
    assert jog["session_mm"] == pytest.approx([0, 0, jog["press_mm"], 0, 0, 0, 0, 0])
    assert jog["limit_n"] == pytest.approx(62.0)


def cycle(targets: list[int], tension: list[float], index: float, rate: float) -> CycleRecord:
    """One record of a session that moves."""
    per_newton = 1000.0 / 100.0  # rated torque pulls 100 N
    torques = tuple(int(v) for v in np.rint(per_newton * np.array(tension)))
    zero = (0,) * 8
    return CycleRecord(
        cycle=1, at=1.0, state=State.MOVING, index=index, rate=rate, targets=tuple(targets),
        actual=zero, torques=torques, words=zero, missing=0, rejected=0, error_frames=0,
        following_error=0.0, lateness=0.0, tension_known=(True,) * 8,
    )  # fmt: skip


def test_what_keeps_a_cable_from_continuing_is_reported() -> None:
    travel = CableTravel(rig(), 62.0, 0.050)
    assert (travel.cable, travel.limit, travel.by_session) == (0, "", [0.0] * 8)
    easy, tight, slack = [20.0] * 8, [20.0] * 8, [20.0] * 8
    tight[5], slack[6] = 55.0, 3.0
    press = Press(1, CableMove(3, pays_out=False), None, 0.0)
    travel.take_cycle(cycle([0] * 8, easy, 0.0, 0.0), press)
    assert (travel.cable, travel.limit) == (3, ""), "it is held, and has not moved yet"
    travel.take_cycle(cycle([0, 0, 0, 0, 7, 0, 0, 0], easy, 0.1, 1.0), None)
    assert (travel.cable, travel.by_press) == (5, 0.0001)
    for tension, index, text in (
        (easy, 0.1, ""),
        (tight, 0.1, "cable 6 carries 55.0 N, near the limit of 62 N"),
        (slack, 0.1, "cable 7 carries 3.0 N: it is nearly slack"),
        (easy, -49.0, "a press moves a cable by 50 mm at most"),
    ):
        travel.take_cycle(cycle([0, 0, 0, 0, 7, 0, 0, 0], tension, index, 0.0), None)
        assert travel.limit == text
