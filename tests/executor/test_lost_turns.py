"""Absolute encoders that lost whole motor turns with their power: the reference is lost."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivers.can_bus import BusSettings
from drivers.drive_group import DriveSnapshot
from executor import homing
from executor.control.preconditions import require_still_referenced
from executor.control.standstill import reset_drives
from executor.homing import reference_at, use_rig_file_counts
from executor.interlock import reference as references
from executor.interlock.fault_latch import FaultLatch
from executor.interlock.interlock import MotionInterlock, reference_status
from executor.interlock.reference import HomingReference, why_turns_lost
from executor.realtime.child import Armed, Ended
from executor.state_machine import State
from model.errors import HardwareMissing, Refused
from model.rig import Rig, load_rig, rig_from_document
from tests.cli.plans import RIG

ALL = tuple(range(1, 9))
LAST = "than at the last known position"


@pytest.fixture(autouse=True)
def own_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


def rig_with(encoder: str = "absolute", *, brake: bool = True, **winch: object) -> Rig:
    """A turn of the motor is 16384 counts, and 20.6 mm of cable."""
    changes = {"encoder": encoder, "brake": brake, "counts_per_rev": 16384, "gear_ratio": 10.0}
    document = load_rig(RIG).document
    winches = [w.model_copy(update=changes | winch) for w in document.winches]
    bus = document.bus.model_copy(update={"interface": "udp_multicast", "channel": "239.74.163.98"})
    return rig_from_document(document.model_copy(update={"winches": winches, "bus": bus}))


def homed(rig: Rig) -> HomingReference:
    """On file, with all drives at 1000 counts."""
    counts, tensions = np.full(rig.cable_count, 1000.0), np.full(rig.cable_count, 20.0)
    reference = reference_at(rig, rig.home, counts, tensions, "stated", 0.0)
    MotionInterlock(rig).file.write(reference)
    return reference


def at(turns: float, drives: Sequence[int] = ALL, more: int = 0) -> list[int]:
    """Positions with some drives away from 1000 counts."""
    return [1000 + (round(turns * 16384) + more if drive in drives else 0) for drive in ALL]


def seen(positions: Sequence[int]) -> DriveSnapshot:
    """Drives that hold."""
    words = np.full(len(positions), 0x0217)
    counts = np.array(positions)
    return DriveSnapshot(counts, np.zeros_like(counts), words, (), ())


@pytest.mark.parametrize(
    ("positions", "text"),
    [
        (at(-1, [1]), f"cable 1 (drive 1) counts 1 whole turn less {LAST}"),
        (at(3, [2]), f"cable 2 (drive 2) counts 3 whole turns more {LAST}"),
        (
            at(-2, [1, 8]),
            f"cable 1 (drive 1), cable 8 (drive 8) count 2 whole turns less {LAST}",
        ),
        (
            [*at(1, [1])[:7], 1000 - 16384],
            f"cable 1 (drive 1) counts 1 whole turn more {LAST};"
            f" cable 8 (drive 8) counts 1 whole turn less {LAST}",
        ),
    ],
)
def test_encoders_that_lost_whole_turns_lose_the_reference(positions: list[int], text: str) -> None:
    """An ODrive without `absolute_setpoints` at one power-up: the platform was 17 mm off, moved."""
    rig = rig_with()
    reference = homed(rig)
    interlock = MotionInterlock(rig)
    assert interlock.why_unreferenced(positions) == text
    assert interlock.still_counts(positions) is None
    with pytest.raises(Refused, match="homing reference is lost") as caught:
        require_still_referenced(rig, reference, (), seen(positions))
    assert caught.value.what == f"the homing reference is lost: {text}"
    assert "absolute over the whole travel" in caught.value.next_step
    assert "--as-rig-file" not in caught.value.next_step
    status = reference_status(interlock, positions, held=True)
    assert str(status) == f"not valid: {text}"
    assert not status.valid_after_reset, "a reset must not store these positions"


@pytest.mark.parametrize(
    ("rig", "positions"),
    [
        (rig_with(), at(0)),
        (rig_with(), at(0, more=700)),
        (rig_with(), at(0.5)),
        (rig_with(), at(-3.25, [4])),
        (rig_with(), [*at(1)[:7], 1000 + 17500]),
        (rig_with(), [1000 + 900, *at(2)[1:]]),
        (rig_with(brake=False), at(1)),
    ],
    ids=[
        "at rest",
        "settled in the brake",
        "turned by hand",
        "one turned",
        "moved by another program, the last by 1.07 turns",
        "moved, the first by 1.1 mm",
        "no brake held them",
    ],
)
def test_drums_that_were_turned_keep_the_reference(rig: Rig, positions: list[int]) -> None:
    reference = homed(rig)
    interlock = MotionInterlock(rig)
    assert interlock.why_unreferenced(positions) == ""
    assert interlock.still_counts(positions) == reference
    require_still_referenced(rig, reference, (), seen(positions))
    interlock.found_at_rest(positions, (), ())
    assert interlock.why_unreferenced(positions) == ""


def _rig_of(*winches: dict[str, object]) -> Rig:
    """With these changes of its first winches."""
    document = rig_with().document
    changed = [w.model_copy(update=c) for w, c in zip(document.winches, winches, strict=False)]
    changed += document.winches[len(changed) :]
    return rig_from_document(document.model_copy(update={"winches": changed}))


@pytest.mark.parametrize("other", [{"brake": False}, {"encoder": "incremental"}])
def test_only_absolute_encoders_with_a_brake_are_compared(other: dict[str, object]) -> None:
    """Any other drum may be at any angle, also while the others lose turns."""
    rig = _rig_of(other)
    reference = homed(rig)
    for elsewhere in (at(0.3, [1]), at(1, [1])):
        assert why_turns_lost(rig, reference, elsewhere) == ""
        lost = why_turns_lost(rig, reference, [elsewhere[0], *at(1, [2])[1:]])
        assert lost == f"cable 2 (drive 2) counts 1 whole turn more {LAST}"
    assert why_turns_lost(rig, reference, [5000, *[0] * 7]) == references.SWITCHED_ON


def test_encoders_that_count_from_where_they_were_switched_on_lose_the_reference() -> None:
    """ODrives without `absolute_setpoints`: 71 % of the poses passed, 200 mm from the true one."""
    rig = rig_with()
    MotionInterlock(rig).file.write(homed(rig).model_copy(update={"stands_at": at(3.3, [2])}))
    interlock = MotionInterlock(rig)
    zero = [0, 5, -5, 100, 0, 0, 0, 0]
    assert interlock.why_unreferenced(zero) == references.SWITCHED_ON
    assert "absolute_setpoints" in references.SWITCHED_ON
    assert interlock.still_counts(zero) is None
    kept = interlock.kept_reference()
    with pytest.raises(Refused, match="absolute_setpoints") as caught:
        require_still_referenced(rig, kept, (), seen(zero))
    assert "absolute over the whole travel" in caught.value.next_step
    assert not reference_status(interlock, zero, held=True).valid_after_reset
    reset(rig, zero)
    assert references.SWITCHED_ON in MotionInterlock(rig).why_unreferenced()
    with pytest.raises(Refused, match="reference is lost") as caught:
        use_rig_file_counts(rig)
    assert caught.value.next_step == references.OVER_THE_TRAVEL


def test_all_encoders_at_0_are_within_a_brake_and_were_not_there() -> None:
    rig = rig_with()
    most = int(rig.motion.start_tolerance * abs(rig.winches[0].counts_per_metre))
    at_0 = homed(rig).model_copy(update={"stands_at": [0] * 8})
    one_off = at_0.model_copy(update={"stands_at": [0] * 7 + [most + 1]})
    near = at_0.model_copy(update={"stands_at": [0] * 7 + [most]})
    for now in ([0] * 8, [most] * 7 + [0], [-most] * 8):
        assert why_turns_lost(rig, one_off, now) == references.SWITCHED_ON
        assert why_turns_lost(rig, near, now) == why_turns_lost(rig, at_0, now) == ""
    settled = [0] * 7 + [1]
    for now in (settled, [most + 1] + [0] * 7, [0] * 7 + [-most - 1]):
        assert why_turns_lost(rig, one_off, now) == ""


def test_incremental_encoders_are_elsewhere_by_any_distance() -> None:
    rig = rig_with("incremental")
    homed(rig)
    assert "20.6 mm of cable from its last known" in MotionInterlock(rig).why_unreferenced(at(1))


def test_a_brake_holds_within_the_start_tolerance() -> None:
    rig = rig_with()
    reference, winch = homed(rig), rig.winches[0]
    most = int(rig.motion.start_tolerance * abs(winch.counts_per_metre))
    assert most < references.HELD_TURN * winch.counts_per_turn
    for off in (most, -most):
        assert why_turns_lost(rig, reference, at(1, [1], off))
    for off in (most + 1, -most - 1):
        assert why_turns_lost(rig, reference, at(1, [1], off)) == ""
        assert why_turns_lost(rig, reference, [1000 + off, *at(1, [8])[1:]]) == ""


def test_with_a_high_gear_a_brake_holds_within_a_tenth_of_a_turn() -> None:
    """Else every motion by hand would count as whole turns."""
    rig = rig_with(gear_ratio=200.0)
    reference, winch = homed(rig), rig.winches[0]
    most = int(references.HELD_TURN * winch.counts_per_turn)
    assert most < rig.motion.start_tolerance * abs(winch.counts_per_metre)
    for off in (most, -most):
        assert why_turns_lost(rig, reference, at(1, [1], off))
    for off in (most + 1, -most - 1):
        assert why_turns_lost(rig, reference, at(1, [1], off)) == ""


def test_drives_that_were_never_homed_have_a_position_after_their_first_motion() -> None:
    rig = rig_with()
    interlock = MotionInterlock(rig)
    assert interlock.why_unreferenced(at(1)) == "", "where they are was never stored"
    reference = interlock.require_ready()
    require_still_referenced(rig, reference, (), seen(at(1)))
    interlock.begin(Path("run"), reference)
    interlock.end(State.FINISHED, "", Path("run"), holding=True, positions=at(0), released=ALL)
    assert interlock.why_unreferenced(at(0.5)) == ""
    assert "1 whole turn more" in interlock.why_unreferenced(at(1))
    with pytest.raises(Refused, match="1 whole turn more"):
        require_still_referenced(rig, MotionInterlock(rig).require_ready(), (), seen(at(1)))
    assert "1 whole turn more" in str(reference_status(interlock, at(1)))


def test_positions_of_another_rig_file_are_not_compared() -> None:
    """Counts of another resolution, or a rig with another number of drives on this bus."""
    rig = rig_with()
    interlock = MotionInterlock(rig)
    interlock.begin(Path("run"), interlock.require_ready())
    interlock.end(State.FINISHED, "", Path("run"), holding=True, positions=at(0))
    other = MotionInterlock(rig_with(counts_per_rev=4096))
    assert other.why_unreferenced(at(1)) == ""
    assert other.still_counts(at(1)) is not None
    kept = interlock.kept_reference()
    assert kept is not None
    assert why_turns_lost(rig, kept, at(1)[:7]) == ""


class Resetting:
    """Drives at these positions, for `reset_drives`."""

    def __init__(self, positions: Sequence[int], armed: Armed, *, holding: bool) -> None:
        self._positions, self._armed, self._holding = positions, armed, holding

    def arm(self, _records: object) -> Armed:
        return self._armed

    def run(self) -> Ended:
        return Ended(State.FINISHED, "", holding=self._holding, true_pose=None)

    def read_status(self) -> SimpleNamespace:
        return SimpleNamespace(positions=np.array(self._positions))


def reset(rig: Rig, positions: Sequence[int], *, holding: bool = True, **armed: Any) -> None:
    """As `cdpr reset`."""
    latch = FaultLatch(BusSettings.of(rig), rig.drive_names)
    with latch.held_for_reset(rig.name, latch.read()):
        process: Any = Resetting(positions, Armed("", tuple(positions), **armed), holding=holding)
        reset_drives(MotionInterlock(rig), process)


def test_a_reset_does_not_make_lost_turns_valid() -> None:
    """A motion of one cable by part of a turn hid them from then on."""
    rig = rig_with()
    homed(rig)
    reset(rig, at(-1))
    interlock = MotionInterlock(rig)
    for positions in (None, at(-1), at(0), at(-0.5)):
        assert "drive 8) count 1 whole turn less than" in interlock.why_unreferenced(positions)
    with pytest.raises(Refused, match="reference is lost") as caught:
        interlock.require_ready()
    assert "absolute over the whole travel" in caught.value.next_step
    assert "--as-rig-file" not in caught.value.next_step


@pytest.mark.parametrize("restarted", [(), ALL], ids=["only the program", "the cabinet too"])
@pytest.mark.parametrize("made", [True, False], ids=["homed", "never homed"])
def test_a_motion_whose_program_was_killed_went_any_distance(
    restarted: tuple[int, ...], made: bool
) -> None:
    """Until a reset stores where it ended; then encoders must keep these positions."""
    rig = rig_with()
    if made:
        homed(rig)
    killed = MotionInterlock(rig)
    killed.begin(Path("run"), killed.still_counts(at(0)))
    del killed
    interlock = MotionInterlock(rig)
    assert interlock.why_unreferenced(at(3)) == ""
    reset(rig, at(3), restarted=restarted)
    for positions in (None, at(3), at(0.5)):
        assert MotionInterlock(rig).why_unreferenced(positions) == ""
    assert "3 whole turns less" in MotionInterlock(rig).why_unreferenced(at(0))


def test_a_fault_that_ended_a_motion_stored_where() -> None:
    rig = rig_with()
    homed(rig)
    interlock = MotionInterlock(rig)
    interlock.begin(Path("run"), interlock.still_counts(at(0)))
    interlock.end(State.LATCHED, "a jam", Path("run"), holding=True, positions=at(2))
    del interlock
    assert MotionInterlock(rig).why_unreferenced(at(2)) == ""
    reset(rig, at(0))
    assert "2 whole turns less" in MotionInterlock(rig).why_unreferenced()


def test_a_reset_stores_only_absolute_positions_of_drives_that_did_not_hold() -> None:
    document = rig_with("incremental").document
    winches = [
        document.winches[0].model_copy(update={"encoder": "absolute"}),
        *document.winches[1:],
    ]
    rig = rig_from_document(document.model_copy(update={"winches": winches}))
    MotionInterlock(rig).file.write(homed(rig).model_copy(update={"released": [1]}))
    reset(rig, at(0.5), holding=False)
    kept = MotionInterlock(rig).kept_reference()
    assert kept is not None
    assert (kept.stands_at, kept.released) == (at(0.5, [1]), [1])
    reset(rig, at(0.5, [1]))
    kept = MotionInterlock(rig).kept_reference()
    assert kept is not None
    assert (kept.stands_at, kept.released) == (at(0.5, [1]), [])


def test_counts_of_the_rig_file_need_encoders_that_lost_no_turns(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = rig_with()
    homed(rig)

    def found(positions: Sequence[int]) -> None:
        monkeypatch.setattr(homing, "read_snapshot", lambda *_: seen(positions))

    def silent(*_: object) -> None:
        raise HardwareMissing("no answer", where="bus")

    def refused(match: str) -> None:
        with pytest.raises((Refused, HardwareMissing), match=match):
            use_rig_file_counts(rig)
        assert MotionInterlock(rig).kept_reference() is not None

    found(at(1))
    refused("counts? 1 whole turn more")
    monkeypatch.setattr(homing, "read_snapshot", silent)
    refused("no answer")
    found(at(0))  # with `absolute_setpoints` they count as before
    use_rig_file_counts(rig)
    assert MotionInterlock(rig).kept_reference() is None
    monkeypatch.setattr(homing, "read_snapshot", silent)
    use_rig_file_counts(rig)


@pytest.mark.parametrize("made", [True, False], ids=["homed", "never homed"])
@pytest.mark.parametrize("rehome", [True, False], ids=["homing", "jog of a cable"])
def test_a_motion_after_lost_turns_does_not_make_them_count_as_in_the_rig_file(
    rehome: bool, made: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Homing that was stopped moved the drums by part of a turn: `--as-rig-file` was accepted."""
    rig = rig_with()
    reference = homed(rig) if made else references.as_in_the_file(rig)
    MotionInterlock(rig).file.write(reference.model_copy(update={"stands_at": at(0)}))
    interlock = MotionInterlock(rig)
    interlock.found_at_rest(at(-1), (), ())
    interlock.begin(Path("run"), interlock.still_counts(at(-1)), rehome=rehome)
    moved = at(-1, more=2500)
    interlock.end(State.STOPPED, "stopped", Path("run"), holding=True, positions=moved)
    for positions in (moved, at(-1), at(0)):
        monkeypatch.setattr(homing, "read_snapshot", lambda *_, now=positions: seen(now))
        with pytest.raises(Refused, match="count 1 whole turn less") as caught:
            use_rig_file_counts(rig)
        assert caught.value.next_step == references.OVER_THE_TRAVEL
        assert MotionInterlock(rig).kept_reference() is not None
    other = rig_with(counts_per_rev=4096)
    with pytest.raises(Refused, match="count 1 whole turn less"):
        use_rig_file_counts(other)
    MotionInterlock(rig).file.write(homed(rig))
    use_rig_file_counts(rig)


def test_after_a_release_of_cables_positions_are_not_compared(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = rig_with()
    MotionInterlock(rig).file.write(homed(rig).model_copy(update={"lost": "released"}))
    monkeypatch.setattr(homing, "read_snapshot", lambda *_: seen(at(1)))
    assert MotionInterlock(rig).why_turns_lost(at(1)) == ""
    use_rig_file_counts(rig)
    assert MotionInterlock(rig).kept_reference() is None


def test_drives_in_this_process_keep_no_positions() -> None:
    assert MotionInterlock(load_rig(RIG)).why_unreferenced(at(1)) == ""
