"""Release and reset: under any fault, no drive is left following set-points."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from drivers.can_bus import BusSettings, open_bus
from drivers.cia402.state_machine import DriveState
from drivers.drive_group import CycleStatus, DriveGroup, DriveSnapshot, GroupState, Pace
from drivers.factory import make_drive_group, read_drives
from drivers.odrive.messages import AxisError
from executor.control.preconditions import configuration_at_rest
from executor.control.standstill import FaultReset, Release, Standstill
from executor.control.sync_master import SyncMaster
from executor.realtime.scheduling import SimulatedClock
from executor.state_machine import CycleRecord, State
from executor.supervision import OperatorRequests
from model.errors import CdprError, Refused, StoppedByOperator
from model.rig import Rig, load_rig, rig_from_document
from simulation.drives.cia402 import SimulatedDrive
from simulation.drives.cia402_rig import SimulatedCia402Rig
from simulation.ground_truth import PowerLoss
from tests.cli.plans import RIG
from tests.drivers.odrive_bench import OdriveBench, odrive_bench

_CHANNELS = itertools.count()
FOLLOWING, HOLDING = DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE


class Held:
    """Drives that hold, unreferenced."""

    def __init__(self, rehearsal: SimulatedCia402Rig, group: DriveGroup) -> None:
        self.drives, self.group = rehearsal.drives, group
        self.clock = SimulatedClock(0.01)

    def do(
        self, kind: type[Standstill], each_cycle: Callable[[int], bool] = lambda _cycle: False
    ) -> Standstill:
        """Runs it; ``each_cycle`` returns whether the operator requests a stop."""
        cycles = itertools.count()

        def requests() -> OperatorRequests:
            return OperatorRequests(stop=each_cycle(next(cycles)))

        rig, records = load_rig(RIG), list[CycleRecord]()
        procedure = kind(rig, SyncMaster(rig, self.group, self.clock), requests, records.append)
        procedure.arm()
        self.ended = procedure.run()
        return procedure

    @property
    def states(self) -> set[DriveState]:
        return {drive.state for drive in self.drives}


def _braked() -> Rig:
    document = load_rig(RIG).document
    winches = [winch.model_copy(update={"brake": True}) for winch in document.winches]
    return rig_from_document(document.model_copy(update={"winches": winches}))


@contextmanager
def held(
    *,
    braked: bool = False,
    in_fault: tuple[int, DriveState] | None = None,
) -> Iterator[Held]:
    rig = _braked() if braked else load_rig(RIG)
    settings = BusSettings("virtual", f"standstill-{next(_CHANNELS)}")
    with open_bus(settings) as near, open_bus(settings) as far:
        rehearsal = SimulatedCia402Rig(rig, far, rig.home)
        loss = PowerLoss.drawn(rig, 3, 0.0, on_a_stand=True)
        loss.apply_to(rig, rehearsal.plant, [drive.motor for drive in rehearsal.drives])
        for drive in rehearsal.drives:
            drive.objects[0x605A, 0] = 6  # else it lets go at the end of its ramp
            drive.state = HOLDING
        if in_fault is not None:
            rehearsal.drives[in_fault[0]].state = in_fault[1]
            rehearsal.drives[in_fault[0]]._move = lambda _elapsed: None  # type: ignore[method-assign]
        seen: DriveSnapshot = read_drives(rig, near, rehearsal.pump)
        rig = configuration_at_rest(rig, seen)[0]
        group = make_drive_group(rig, near, rehearsal.pump)
        group.configure(to_reset=True)
        yield Held(rehearsal, group)


def error_of(procedure: Standstill) -> CdprError:
    assert procedure.error is not None
    return procedure.error


def test_all_lose_their_torque_where_they_are() -> None:
    with held() as bench:
        stood = [drive.motor.position for drive in bench.drives]
        bench.do(Release)
        assert bench.ended is State.FINISHED
        assert bench.group.state is GroupState.RELEASED
        assert bench.states == {DriveState.READY_TO_SWITCH_ON}
        assert [drive.motor.position for drive in bench.drives] == pytest.approx(stood, abs=1)


def test_a_drive_that_cannot_be_enabled_does_not_prevent_the_release() -> None:
    with held() as bench:
        last = bench.drives[7]
        last.state = DriveState.SWITCH_ON_DISABLED
        last._command_shutdown = lambda: None  # type: ignore[method-assign]
        bench.do(Release)
        assert bench.ended is State.FINISHED
        assert bench.states == {DriveState.READY_TO_SWITCH_ON, DriveState.SWITCH_ON_DISABLED}


@pytest.mark.parametrize("kind", [Release, FaultReset])
def test_nobody_is_watched_any_more_when_the_program_leaves(kind: type[Standstill]) -> None:
    with held() as bench:
        bench.do(kind)
        for drive in bench.drives:
            assert drive.objects[0x1006, 0] == 0
            assert drive.objects[0x1400, 5] == 0
            assert drive.objects[0x1016, 1] == 0


@pytest.mark.parametrize("faulted", range(8))
def test_drives_that_hold_are_released_together_beside_one_in_fault_behind_its_brake(
    faulted: int,
) -> None:
    words: list[int] = []
    with held(braked=True, in_fault=(faulted, DriveState.FAULT)) as bench:
        stood = [drive.motor.position for drive in bench.drives]
        takes = bench.drives[faulted]._take_control_word

        def take(word: int) -> None:
            words.append(word)
            takes(word)

        bench.drives[faulted]._take_control_word = take  # type: ignore[method-assign]
        together: list[int] = []

        def count(_cycle: int) -> bool:
            together.append([drive.state for drive in bench.drives].count(FOLLOWING))
            return False

        bench.do(Release, count)
        assert bench.ended is State.FINISHED
        assert bench.drives[faulted].state is DriveState.FAULT
        others = {drive.state for k, drive in enumerate(bench.drives) if k != faulted}
        assert others == {DriveState.READY_TO_SWITCH_ON}
        assert set(together) <= {0, 7}
        assert all(word & 0x02 and not word & 0x80 and word != 0x0F for word in words)
        assert [drive.motor.position for drive in bench.drives] == pytest.approx(stood, abs=1)


@pytest.mark.parametrize(
    ("braked", "state"),
    [(False, DriveState.FAULT), (True, DriveState.FAULT_REACTION_ACTIVE)],
)
def test_without_brakes_or_with_a_drive_still_in_its_fault_reaction_none_is_enabled(
    braked: bool, state: DriveState
) -> None:
    with held(braked=braked, in_fault=(4, state)) as bench:
        with pytest.raises(Refused, match="a fault is latched"):
            bench.do(Release)
        assert FOLLOWING not in bench.states


@pytest.mark.parametrize("state", [DriveState.FAULT, HOLDING])
def test_a_second_drive_that_fails_during_such_a_release_stops_the_others(
    state: DriveState,
) -> None:
    seen: list[int] = []

    def fails(cycle: int) -> bool:
        if FOLLOWING in bench.states:
            seen.append(cycle)
        if len(seen) == 2:
            bench.drives[2].state = state
            seen.append(cycle)
        return False

    with held(braked=True, in_fault=(6, DriveState.FAULT)) as bench:
        error = error_of(bench.do(Release, fails))
        assert "cable 3 (drive 3)" in error.what
        assert bench.ended is State.LATCHED
        assert FOLLOWING not in bench.states
        assert bench.drives[6].state is DriveState.FAULT


def test_drives_beyond_their_limits_are_not_enabled() -> None:
    """One moved after the set-up, which takes the limits around where each is."""
    with held() as bench:
        motor = bench.drives[3].motor
        motor.position, motor.demand = motor.position + 1e8, motor.demand + 1e8
        with pytest.raises(Refused, match="outside its position limits"):
            bench.do(Release)
        assert bench.states == {HOLDING}


@pytest.mark.parametrize("cycle", range(6))
def test_a_stop_at_any_cycle_leaves_none_enabled(cycle: int) -> None:
    with held() as bench:
        error = error_of(bench.do(Release, lambda now: now == cycle))
        assert isinstance(error, StoppedByOperator)
        assert "a fault is latched" in error.what
        assert bench.ended is State.LATCHED
        assert FOLLOWING not in bench.states


def test_an_exception_while_the_drives_are_enabled_stops_them() -> None:
    def interrupt(_cycle: int) -> bool:
        if FOLLOWING in bench.states:
            raise KeyboardInterrupt
        return False

    with held() as bench:
        with pytest.raises(KeyboardInterrupt):
            bench.do(Release, interrupt)
        assert bench.states == {HOLDING}


def test_a_drive_that_falls_silent_stops_the_others() -> None:
    def silence(_cycle: int) -> bool:
        if FOLLOWING in bench.states:
            bench.drives[4].silent = True
        return False

    with held() as bench:
        error = error_of(bench.do(Release, silence))
        assert "cable 5 (drive 5) stopped answering" in error.what
        assert FOLLOWING not in {drive.state for drive in bench.drives if not drive.silent}


def test_a_drive_that_stopped_on_its_own_is_not_enabled_again() -> None:
    enabled: list[int] = []
    after: list[DriveState] = []

    def drop(cycle: int) -> bool:
        if bench.drives[2].state is FOLLOWING:
            enabled.append(cycle)
        if len(enabled) == 2:  # the group has heard that it is enabled
            bench.drives[2]._quick_stop()
            enabled.append(cycle)
        elif len(enabled) > 2:
            after.append(bench.drives[2].state)
        return False

    with held() as bench:
        error = error_of(bench.do(Release, drop))
        assert "cable 3 (drive 3) stopped on its own" in error.what
        assert FOLLOWING not in bench.states
        assert set(after) <= {HOLDING}
        assert bench.drives[2].state is HOLDING


@pytest.mark.parametrize("lateness", [1.5, 2.0, 40.0])
def test_a_late_cycle_while_the_drives_are_enabled_ends_the_release(lateness: float) -> None:
    waits = SimulatedClock.next_cycle

    def late(cycle: int) -> bool:
        hit = FOLLOWING in bench.states
        bench.clock.next_cycle = lambda: waits(bench.clock) + hit * lateness  # type: ignore[method-assign]
        return False

    with held() as bench:
        error = error_of(bench.do(Release, late))
        assert f"{lateness:.1f} cycles late" in error.what
        assert bench.states == {HOLDING}


def test_a_drive_in_fault_is_reset_where_no_other_holds() -> None:
    with held() as bench:
        for drive in bench.drives:
            drive.state = DriveState.SWITCH_ON_DISABLED
        bench.drives[3].state = DriveState.FAULT
        bench.do(FaultReset)
        assert bench.ended is State.FINISHED
        assert DriveState.FAULT not in bench.states


def test_a_drive_in_fault_stays_so_while_others_hold_the_platform() -> None:
    with held() as bench:
        bench.drives[3].state = DriveState.FAULT
        error = error_of(bench.do(FaultReset))
        assert isinstance(error, Refused)
        assert "cannot be reset while other drives hold" in error.what
        assert bench.drives[3].state is DriveState.FAULT


@pytest.mark.parametrize("kind", [Release, FaultReset])
def test_a_drive_that_does_not_stay_as_it_was_left_is_reported(kind: type[Standstill]) -> None:
    """A drive that treats the end of SYNC and heartbeat as a fault despite its settings."""
    with held() as bench:
        bench.drives[5].objects.changed = _fails_unwatched(bench.drives[5])  # type: ignore[method-assign]
        error = error_of(bench.do(kind))
        assert "drives left the state they held in" in error.what
        message = next(each for each in error.what.split(", ") if "cable 6 (drive 6)" in each)
        assert message.endswith("to fault")
        assert bench.ended is State.LATCHED


def _fails_unwatched(drive: SimulatedDrive) -> Callable[[tuple[int, int], int], None]:
    changed = drive.objects.changed

    def fails(key: tuple[int, int], value: int) -> None:
        changed(key, value)
        if key == (0x1006, 0) and value == 0:
            drive.state = DriveState.FAULT

    return fails


def reset_odrives(bench: OdriveBench, clock: SimulatedClock) -> FaultReset:
    """Resets those drives, one of them in error."""
    bench.drives[2].fail(AxisError.ESTOP_REQUESTED)
    bench.group.configure(to_reset=True)
    master, records = SyncMaster(bench.rig, bench.group, clock), list[CycleRecord]()
    procedure = FaultReset(bench.rig, master, OperatorRequests, records.append)
    procedure.arm()
    procedure.run()
    return procedure


def test_a_late_cycle_while_odrives_are_reset_is_no_fault_as_none_is_enabled(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with odrive_bench() as bench:
        clock = SimulatedClock(bench.rig.cycle)
        late = {100: 1.6}
        cycles = itertools.count()
        monkeypatch.setattr(clock, "next_cycle", lambda: late.get(next(cycles), 0.0))
        assert reset_odrives(bench, clock).error is None
        assert next(cycles) > max(late)
        assert {drive.errors for drive in bench.drives} == {0}


@pytest.mark.parametrize(
    ("also", "found"),
    [(0, ""), (AxisError.ESTOP_REQUESTED, "cable 5 (drive 5) went from idle to idle, in error")],
)
def test_a_watchdog_that_expires_at_rest_is_no_change_of_state_but_another_error_is(
    also: int, found: str
) -> None:
    """As in firmware 0.5; no set-point feeds it once the cycles have ended."""
    with odrive_bench() as bench:
        for drive in bench.drives:
            drive.settings.watchdog_at_rest = True
        read = bench.group.read_state

        def late(pace: Pace) -> CycleStatus:
            bench.rehearsal.advance(0.3)
            if also:
                bench.drives[4].fail(also)
            return read(pace)

        bench.group.read_state = late  # type: ignore[method-assign]
        error = reset_odrives(bench, SimulatedClock(bench.rig.cycle)).error
        assert all(drive.errors & AxisError.WATCHDOG_TIMER_EXPIRED for drive in bench.drives)
        assert (error.what.split(": ")[1] if error else "") == found
