"""The homing reference: for which rig it is valid, and when it is lost."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn

import numpy as np
import pytest

from drivers.can_errors import BusDown
from drivers.cia402.group import Cia402Group
from drivers.drive_group import DriveSnapshot
from drivers.odrive.messages import AxisState, status_word
from drivers.plausibility import require_within_limits
from drivers.setup_refusals import TorqueLost
from executor import drives
from executor.control import path_runs
from executor.control.preconditions import require_still_referenced
from executor.control.standstill import release_drives
from executor.control.winch_motion import move_winches
from executor.drives import open_drives
from executor.homing import reference_at, use_rig_file_counts
from executor.interlock import locks as state_folder
from executor.interlock.interlock import MotionInterlock, reference_status
from executor.interlock.reference import HomingReference, as_in_the_file
from executor.proposals import Proposal
from executor.realtime.child import Armed, Ended, Records
from executor.realtime.process import RealTimeProcess
from executor.state_machine import State
from model.errors import BadInput, Refused, StoppedByOperator
from model.rig import Rig, load_rig, rig_from_document
from model.scene import empty_scene
from tests.cli.plans import RIG
from tests.drivers.odrive_bench import odrive_rig

CHANNEL = "239.74.163.99"


@pytest.fixture(autouse=True)
def own_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


def rig_with(encoder: str, **winch: object) -> Rig:
    document = load_rig(RIG).document
    winches = [w.model_copy(update={"encoder": encoder, **winch}) for w in document.winches]
    bus = document.bus.model_copy(update={"interface": "udp_multicast", "channel": CHANNEL})
    return rig_from_document(document.model_copy(update={"winches": winches, "bus": bus}))


def reference_of(rig: Rig, shift: int = 1000) -> HomingReference:
    counts = np.full(rig.cable_count, float(shift))
    return reference_at(rig, rig.home, counts, np.full(rig.cable_count, 20.0), "stated", 0.0)


def test_it_replaces_the_rig_files_counts() -> None:
    rig = rig_with("incremental")
    document = reference_of(rig)
    MotionInterlock(rig).file.write(document)
    found = MotionInterlock(rig).referenced_rig()
    assert [w.home_counts for w in found.winches] == document.home_counts
    assert found.plan_hash == rig.plan_hash
    # Stretched by 20 N instead of the working tensions at home, micrometres apart.
    off = np.array(document.home_counts) - 1000
    assert np.abs(off / [w.counts_per_metre for w in rig.winches]).max() < 3e-5


def test_without_one_only_absolute_encoders_move() -> None:
    assert MotionInterlock(rig_with("absolute")).reference() is None
    MotionInterlock(rig_with("absolute")).require_ready()
    for ask in (MotionInterlock(rig_with("incremental")).reference, MotionInterlock(
        rig_with("incremental")).require_ready):  # fmt: skip
        with pytest.raises(Refused, match=r"homed: cable 1 \(drive 1\), cable 2 ") as caught:
            ask()
        assert "cdpr home" in caught.value.next_step


def test_the_next_step_without_one_names_the_ways_to_state_the_pose() -> None:
    rig = rig_with("incremental")
    with pytest.raises(Refused) as unhomed:
        MotionInterlock(rig).reference()
    with pytest.raises(Refused) as moved:
        require_still_referenced(rig, reference_of(rig), (1,), seen_at(rig))
    with pytest.raises(Refused) as beyond:
        require_within_limits(rig, dict.fromkeys(range(8), 2**31 - 1), "unchanged")
    for caught in (unhomed, moved, beyond):
        wanted = "`cdpr home RIG` with --at-home, --pose-mm X Y Z or --camera SOURCE, in Python"
        assert f"{wanted} cdpr.home() with at_home=True, pose= or camera=;" in (
            caught.value.next_step
        )


def test_a_reference_is_not_announced_as_discarded_where_none_will_be() -> None:
    asked: list[str] = []

    def confirm(proposal: Proposal) -> bool:
        asked.append(proposal.title)
        return True

    with pytest.raises(Refused, match="never homed"):
        use_rig_file_counts(rig_with("incremental"), confirm=confirm)
    assert asked == []
    rig = rig_with("absolute")
    use_rig_file_counts(rig, confirm=confirm)
    MotionInterlock(rig).file.write(reference_of(rig))
    use_rig_file_counts(rig, confirm=confirm)
    none, one = asked
    assert none == "homing reference: none: the drives count as in the rig file"
    assert one.startswith("the present homing reference, which would be discarded: valid, made")
    assert MotionInterlock(rig).kept_reference() is None


@pytest.mark.parametrize("answer", ["no", "yes", 1, 0, None, [], np.array([True])])
def test_an_answer_that_is_neither_true_nor_false_confirms_nothing(answer: Any) -> None:
    rig = rig_with("absolute")
    MotionInterlock(rig).file.write(reference_of(rig))
    with pytest.raises(BadInput, match="confirm must return True or False, it returned"):
        use_rig_file_counts(rig, confirm=lambda _: answer)
    assert MotionInterlock(rig).kept_reference() is not None


def test_a_confirmation_may_be_of_numpy_and_must_be_a_function() -> None:
    rig = rig_with("absolute")
    MotionInterlock(rig).file.write(reference_of(rig))
    with pytest.raises(StoppedByOperator):
        use_rig_file_counts(rig, confirm=lambda _: np.bool_(False))  # type: ignore[arg-type,return-value]
    with pytest.raises(BadInput, match="confirm must be a function"):
        use_rig_file_counts(rig, confirm=True)  # type: ignore[arg-type]
    assert MotionInterlock(rig).kept_reference() is not None
    use_rig_file_counts(rig, confirm=lambda _: np.bool_(True))  # type: ignore[arg-type,return-value]
    assert MotionInterlock(rig).kept_reference() is None


def test_it_counts_for_its_rig_file_alone() -> None:
    rig = rig_with("incremental")
    MotionInterlock(rig).file.write(reference_of(rig))
    with pytest.raises(Refused, match="another rig file"):
        MotionInterlock(rig_with("incremental", drum_mm_per_rev=200.0)).reference()
    with pytest.raises(Refused, match="different homing reference"):
        MotionInterlock(rig).require_ready()
    MotionInterlock(MotionInterlock(rig).referenced_rig()).require_ready()


@pytest.mark.parametrize("encoder", ["absolute", "incremental"])
def test_it_is_lost_where_a_cable_was_released(encoder: str) -> None:
    rig = rig_with(encoder)
    if encoder == "incremental":
        MotionInterlock(rig).file.write(reference_of(rig))
    interlock = MotionInterlock(rig)
    interlock.begin(Path("run"), None)
    interlock.end(State.LATCHED, "emergency stop", Path("run"), holding=False, positions=range(8))
    interlock.cancel()  # as a reset releases the latch
    for ask in (interlock.reference, interlock.require_ready):
        with pytest.raises(Refused, match="homing reference is lost") as caught:
            ask()
        assert "emergency stop" in caught.value.why
    MotionInterlock(rig).file.write(reference_of(rig))
    assert interlock.reference() is not None


def test_every_motion_that_counts_from_it_notes_the_drive_positions() -> None:
    rig = rig_with("incremental")
    interlock, homed = MotionInterlock(rig), reference_of(rig)
    interlock.file.write(homed)
    interlock.begin(Path("run"), homed)
    interlock.end(State.FINISHED, "", Path("run"), holding=True, positions=range(8))
    kept = interlock.kept_reference()
    assert kept is not None
    assert kept.stands_at == list(range(8))
    interlock.begin(Path("run"), kept)
    interlock.end(State.LATCHED, "killed", Path("run"), holding=True, positions=None)
    assert interlock.kept_reference() == kept, "the drives' state is unknown"


def test_a_motion_from_elsewhere_does_not_make_a_reference_good_again() -> None:
    """`jog --cable` needs no reference; it must not write the evidence over either."""
    rig = rig_with("incremental")
    interlock, left = MotionInterlock(rig), reference_of(rig)
    interlock.file.write(left)
    moved = [*left.stands_at[:-1], left.stands_at[-1] + 10**6]
    assert interlock.still_counts(left.stands_at) == left
    assert interlock.still_counts(moved) is None
    interlock.begin(Path("run"), interlock.still_counts(moved))
    interlock.end(State.FINISHED, "", Path("run"), holding=True, positions=moved)
    assert interlock.kept_reference() == left
    absolute = MotionInterlock(rig_with("absolute"))
    assert absolute.still_counts(moved) == left, "it cannot lose count"


def test_drives_that_are_found_switched_on_lose_it_for_good() -> None:
    """Configuration erases the evidence, so that the next opening would not detect it."""
    rig = rig_with("incremental")
    interlock = MotionInterlock(rig)
    interlock.file.write(reference_of(rig))
    interlock.found_restarted(())
    assert interlock.reference() is not None
    interlock.found_restarted((4,))
    for ask in (interlock.reference, interlock.reference, interlock.require_ready):
        with pytest.raises(Refused, match="homing reference is lost") as caught:
            ask()
        assert "cable 4 (drive 4): power-cycled" in caught.value.why
    found = interlock.kept_reference()
    assert found is not None
    assert interlock.still_counts(found.stands_at) is None
    interlock.begin(Path("run"), None)
    interlock.end(State.FINISHED, "", Path("run"), holding=True, positions=range(8))
    interlock.confirm_at_rest(range(8), held=True)
    assert interlock.kept_reference() == found, "no motion and no reset brings it back"
    absolute = MotionInterlock(rig_with("absolute"))
    left = reference_of(rig)
    absolute.file.write(left)
    absolute.found_restarted((4,))
    assert absolute.kept_reference() == left.model_copy(update={"released": [4]})


@pytest.mark.parametrize("encoder", ["incremental", "absolute"])
@pytest.mark.parametrize("homed", [True, False])
def test_a_set_up_that_releases_a_cable_loses_it(
    monkeypatch: pytest.MonkeyPatch, encoder: str, homed: bool
) -> None:
    """The platform dropped during the set-up, and the run passed with its old reference."""

    def releases(*_: object, **__: object) -> NoReturn:
        raise TorqueLost(3, "switch on disabled")

    rig = rig_with(encoder)
    interlock = MotionInterlock(rig)
    if homed:
        interlock.file.write(reference_of(rig))
    monkeypatch.setattr(Cia402Group, "configure", releases)
    with pytest.raises(TorqueLost), open_drives(rig, rig.home, empty_scene(rig).load):
        pass
    with pytest.raises(Refused, match="homing reference is lost") as caught:
        interlock.require_ready()
    assert "drive 3 held its cable before the set-up" in caught.value.why


@pytest.mark.parametrize("ended", [State.STOPPED, State.LATCHED])
def test_homing_that_does_not_come_to_its_end_leaves_no_reference(ended: State) -> None:
    rig = rig_with("incremental")
    interlock = MotionInterlock(rig)
    reference = reference_of(rig)
    interlock.file.write(reference)
    interlock.begin(Path("run"), reference, rehome=True)
    interlock.end(ended, "stopped", Path("run"), holding=True, positions=range(8))
    interlock.cancel()
    with pytest.raises(Refused, match="homing reference is lost") as caught:
        interlock.reference()
    assert "did not finish" in caught.value.why


def test_an_end_that_cannot_be_kept_leaves_the_bus_latched(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = rig_with("incremental")
    interlock = MotionInterlock(rig)
    reference = reference_of(rig)
    interlock.file.write(reference)
    interlock.begin(Path("run"), reference)

    def full(_reference: object) -> None:
        raise Refused("the homing reference cannot be written")

    monkeypatch.setattr(interlock.file, "write", full)
    with pytest.raises(Refused, match="cannot be written"):
        interlock.end(State.FINISHED, "", Path("run"), holding=True, positions=range(8))
    with pytest.raises(Refused, match=r"latched.*cannot be written"):
        interlock.require_free()


def test_drives_that_held_after_a_killed_program_still_count() -> None:
    rig = rig_with("incremental")
    interlock = MotionInterlock(rig)
    interlock.file.write(reference_of(rig))
    interlock.confirm_at_rest(range(8), held=True)
    kept = interlock.kept_reference()
    assert kept is not None
    assert (kept.stands_at, kept.lost) == (list(range(8)), "")


@pytest.mark.parametrize("content", ["", "{}", "[]", '{"schema_version": 2}', "\x00"])
def test_a_file_that_cannot_be_read_is_not_ignored(content: str) -> None:
    rig = rig_with("absolute")
    interlock = MotionInterlock(rig)
    interlock.file.write(reference_of(rig))
    interlock.file.path.write_text(content)
    with pytest.raises(Refused, match="cannot be read"):
        interlock.reference()
    # Homing replaces it; an earlier motion must not prevent that.
    interlock.found_restarted((1,))
    interlock.begin(Path("run"), interlock.still_counts(range(8)), rehome=True)
    interlock.end(State.FINISHED, "", Path("run"), holding=True, positions=range(8))
    assert interlock.file.path.read_text() == content
    interlock.file.write(reference_of(rig))
    assert interlock.reference() is not None


HOLDING, DISABLED = 0x0217, 0x0250


def seen_at(rig: Rig, off_mm: float = 0.0, words: Mapping[int, int] = {}) -> DriveSnapshot:
    """Drives that hold, except for those with other ``words``, by node."""
    positions = np.full(rig.cable_count, 1000, dtype=np.int64)
    positions[3] += round(off_mm / 1000.0 * rig.winches[3].counts_per_metre)
    states = np.array([words.get(w.node_id, HOLDING) for w in rig.winches], dtype=np.int64)
    return DriveSnapshot(positions, np.zeros_like(positions), states, (), ())


def test_a_drive_that_was_switched_on_again_or_moved_by_hand_is_found_out() -> None:
    rig = rig_with("incremental")
    reference = reference_of(rig)
    require_still_referenced(rig, reference, (), seen_at(rig, 0.9))
    with pytest.raises(Refused, match=r"cable 4 \(drive 4\) is lost: it is 1\.1 mm"):
        require_still_referenced(rig, reference, (), seen_at(rig, 1.1))
    with pytest.raises(Refused, match=r"cable 4 \(drive 4\) is lost: it was power-cycled"):
        require_still_referenced(rig, reference, (4,), seen_at(rig))
    absolute = rig_with("absolute")
    require_still_referenced(absolute, reference, (4,), seen_at(absolute, 50.0))
    require_still_referenced(rig, None, (4,), seen_at(rig, 50.0))


ALL = tuple(range(1, 9))


@pytest.mark.parametrize("encoder", ["absolute", "incremental"])
@pytest.mark.parametrize("brake", [True, False])
@pytest.mark.parametrize("word", [DISABLED, 0x0218, 0x0231, 0x0233])
def test_a_drive_that_lost_its_torque_since_it_held_has_released_its_cable(
    encoder: str, brake: bool, word: int
) -> None:
    """As after an emergency stop between two motions, at unchanged positions."""
    rig = rig_with(encoder, brake=brake)
    require_still_referenced(rig, reference_of(rig), (), seen_at(rig))
    for nodes in ((4,), ALL):
        with pytest.raises(Refused, match=r"lost: .*cable 4 \(drive 4\).*without torque") as caught:
            require_still_referenced(
                rig, reference_of(rig), (), seen_at(rig, words=dict.fromkeys(nodes, word))
            )
        assert "cdpr home" in caught.value.next_step


def _end(interlock: MotionInterlock, **how: Any) -> None:
    interlock.end(State.FINISHED, "", Path("run"), **{"holding": True, "positions": [0] * 8} | how)


@pytest.mark.parametrize("homed", [True, False])
def test_absolute_encoders_may_be_power_cycled_but_not_dropped(homed: bool) -> None:
    rig = described = rig_with("absolute")
    if homed:
        MotionInterlock(rig).file.write(reference_of(rig))
        rig = MotionInterlock(rig).referenced_rig()
    dropped = seen_at(rig, words=dict.fromkeys(ALL, DISABLED))

    def ready() -> HomingReference | None:
        return MotionInterlock(rig).require_ready()

    if not homed:  # after the first power-up and a reset
        require_still_referenced(rig, ready(), (), dropped)
    interlock = MotionInterlock(rig)
    interlock.begin(Path("run"), ready())
    _end(interlock)
    require_still_referenced(rig, ready(), (), seen_at(rig))
    with pytest.raises(Refused, match="without torque"):
        require_still_referenced(rig, ready(), (), dropped)
    require_still_referenced(rig, ready(), ALL, dropped)
    MotionInterlock(rig).found_restarted(ALL)  # this motion did not begin: they are configured now
    require_still_referenced(rig, ready(), (), dropped)
    assert MotionInterlock(described).why_unreferenced([0] * 8) == ""


@pytest.mark.parametrize("homed", [True, False])
@pytest.mark.parametrize("begins", [True, False])
def test_a_drive_found_power_cycled_by_the_set_up_holds_once_the_motion_begins(
    homed: bool, begins: bool
) -> None:
    """A run reads the reference first; then its set-up finds a drive that was power-cycled.

    The program is killed while it moves, and the drive is dropped by an emergency stop.
    """
    rig = rig_with("absolute")
    if homed:
        MotionInterlock(rig).file.write(reference_of(rig))
        rig = MotionInterlock(rig).referenced_rig()
    else:
        first = MotionInterlock(rig)
        first.begin(Path("run"), first.require_ready())
        _end(first)
    killed = MotionInterlock(rig)
    reference = killed.require_ready()
    MotionInterlock(rig).found_restarted((4,))
    killed.begin(Path("run"), reference)
    if not begins:
        killed.cancel()
    later = MotionInterlock(rig)
    assert bool(later.why_released((), (4,))) is begins
    assert later.why_released((), (5,))


def test_no_motion_begins_with_a_reference_that_was_replaced_meanwhile() -> None:
    rig = rig_with("absolute")
    first, second = reference_of(rig), reference_of(rig, shift=1500)
    MotionInterlock(rig).file.write(first)
    interlock = MotionInterlock(MotionInterlock(rig).referenced_rig())
    held = interlock.require_ready()
    replaced = [
        second.model_copy(update={"made": first.made}),
        first.model_copy(update={"made": "2020-01-01T00:00:00+00:00"}),
        first.model_copy(update={"lost": "cable 1 (drive 1): power-cycled"}),
        None,
    ]
    for on_file in replaced:
        MotionInterlock(rig).file.remove()
        if on_file is not None:
            MotionInterlock(rig).file.write(on_file)
        with pytest.raises(Refused, match=r"homing reference (is lost|changed)") as caught:
            interlock.begin(Path("run"), held)
        assert "nothing was moved" in caught.value.next_step
        interlock.require_free()
        assert interlock.kept_reference() == on_file
    MotionInterlock(rig).file.write(first)
    interlock.begin(Path("run"), held)
    _end(interlock)


def test_a_motion_of_drives_never_homed_does_not_begin_once_they_are() -> None:
    rig = rig_with("absolute")
    interlock = MotionInterlock(rig)
    never_homed = interlock.require_ready()
    MotionInterlock(rig).file.write(reference_of(rig))
    with pytest.raises(Refused, match="homing reference changed"):
        interlock.begin(Path("run"), never_homed)


def test_drives_released_behind_their_brakes_need_not_hold_until_they_are_enabled_again() -> None:
    rig = rig_with("incremental", brake=True)
    MotionInterlock(rig).file.write(reference_of(rig))
    rig = MotionInterlock(rig).referenced_rig()
    interlock = MotionInterlock(rig)
    released = seen_at(rig, words=dict.fromkeys(ALL, 0x0231))

    def still_referenced() -> None:
        require_still_referenced(rig, interlock.require_ready(), (), released)

    interlock.begin(Path("release"), interlock.require_ready())
    _end(interlock, released=ALL, positions=released.positions.tolist())
    still_referenced()
    interlock.begin(Path("run"), interlock.require_ready())
    interlock.cancel()  # as when the operator does not confirm
    still_referenced()
    interlock.begin(Path("run"), interlock.require_ready())
    _end(interlock, released=ALL, positions=released.positions.tolist())  # never enabled
    still_referenced()
    interlock.begin(Path("run"), interlock.require_ready())  # killed: they may have been enabled
    MotionInterlock(rig).found_at_rest((), (), ALL)  # as a reset finds them
    with pytest.raises(Refused, match=r"reference is lost") as caught:
        MotionInterlock(rig).reference()
    assert "without torque" in caught.value.why


@pytest.mark.parametrize(("brake", "lost"), [(True, ""), (False, "released by the operator")])
def test_a_release_whose_end_cannot_be_read_is_latched_with_its_cause_and_braked_drives_count(
    brake: bool, lost: str
) -> None:
    """As where the adapter is unplugged just after all drives were released."""
    rig = rig_with("incremental", brake=brake)
    reference = reference_of(rig)
    interlock = MotionInterlock(rig)
    interlock.file.write(reference)

    class Unplugged(RealTimeProcess):
        def __init__(self) -> None:
            pass

        def arm(self, records: Records) -> Armed:
            return Armed("", tuple(reference.stands_at))

        def run(self) -> Ended:
            return Ended(State.FINISHED, "", holding=False, true_pose=None)

        def read_status(self) -> NoReturn:
            raise BusDown("the interface is down", "can0")

    with pytest.raises(BusDown, match="interface is down"):
        release_drives(rig, interlock, Unplugged(), lambda _denied: None, lambda: None)
    with pytest.raises(Refused, match=r"while releasing the drives: .*interface is down"):
        interlock.require_free()
    MotionInterlock(rig).found_at_rest((), (), ALL)  # as a reset finds them
    why = MotionInterlock(rig).why_unreferenced(reference.stands_at)
    assert lost in why
    assert bool(lost) is bool(why)


class Unmoved:
    """Drives of which one falls silent before the first cycle."""

    def __init__(self, armed: Armed) -> None:
        self.armed = armed

    def arm(self, _records: object) -> Armed:
        return self.armed

    def run(self) -> Ended:
        return Ended(State.LATCHED, "drive 3 stopped answering", holding=True, true_pose=None)

    def read_status(self) -> NoReturn:
        raise AssertionError("it did not finish")


@pytest.mark.parametrize("path", [True, False])
def test_braked_drives_that_were_not_enabled_after_all_need_not_have_held(
    path: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = rig_with("incremental", brake=True)
    reference = reference_of(rig)
    MotionInterlock(rig).file.write(reference.model_copy(update={"released": [*ALL]}))
    mover: Any = Unmoved(Armed("", tuple(reference.stands_at), released=ALL))
    folder = SimpleNamespace(path=tmp_path)
    records: Any = SimpleNamespace(folder=folder, take_event=print, pose_every=0)
    if path:
        records.log = SimpleNamespace(last=None)
        motion = SimpleNamespace(of=lambda *_args, **_more: None)
        monkeypatch.setattr(path_runs, "PathMotion", motion)
        monkeypatch.setattr(path_runs, "checked_setpoints_of", id)
        monkeypatch.setattr(path_runs, "load_changes", lambda *_: None)
        table = SimpleNamespace(table=SimpleNamespace(dwells=()))
        prepared: Any = SimpleNamespace(
            rig=MotionInterlock(rig).referenced_rig(), scene=None, checked=table
        )
        path_runs.run_along_path(
            prepared,
            lambda _motion: nullcontext(mover),
            records,
            before_motion=lambda _denied: None,
        )
    else:
        move_winches(
            mover,
            rig,
            MotionInterlock(rig),
            records,
            record=tmp_path,
            rehome=False,
            at_rest=lambda _result, _pose: None,
        )
    with pytest.raises(Refused, match="drive 3 stopped answering"):
        MotionInterlock(rig).require_free()
    MotionInterlock(rig).found_at_rest((), (), ALL)  # as a reset finds them
    assert MotionInterlock(rig).why_unreferenced(reference.stands_at) == ""


@pytest.mark.parametrize("word", [0x0231, 0x0218])
def test_abandoned_drives_must_hold_unless_they_were_never_enabled(
    monkeypatch: pytest.MonkeyPatch, word: int
) -> None:
    rig = rig_with("incremental", brake=True)
    seen = seen_at(rig, words={2: word, 4: word})
    monkeypatch.setattr(drives, "read_snapshot", lambda *_: seen)
    monkeypatch.setattr(drives, "time_to_stop_alone", lambda _rig: 0.0)
    assert drives.abandoned_drives_fault(rig.document, (2, 4)) == ""
    found = drives.abandoned_drives_fault(rig.document, (2,))
    assert "cable 4 (drive 4) is in" in found
    assert "drive 2" not in found


@pytest.mark.parametrize(("watchdog_ms", "waits"), [(100, 1.0), (1000, 1.05)])
def test_abandoned_odrives_that_no_watchdog_has_disarmed_do_not_hold(
    monkeypatch: pytest.MonkeyPatch, watchdog_ms: float, waits: float
) -> None:
    """They follow their last set-point; brakes close only when they are idle."""
    rig = odrive_rig(watchdog_ms=watchdog_ms, heartbeat_ms=50).with_bus("udp_multicast", CHANNEL)
    words = dict.fromkeys(rig.drive_names, status_word(AxisState.IDLE, 0))
    words[3] = status_word(AxisState.IDLE, 0x2000)
    waited: list[float] = []
    monkeypatch.setattr(drives.time, "sleep", waited.append)
    monkeypatch.setattr(drives, "read_snapshot", lambda *_: seen_at(rig, words=words))
    assert drives.abandoned_drives_fault(rig.document, ()) == ""
    words[4] = status_word(AxisState.CLOSED_LOOP_CONTROL, 0)
    found = drives.abandoned_drives_fault(rig.document, ())
    text = "drives do not hold on their own: cable 4 (drive 4) is in closed loop control"
    assert found == text
    assert waited == [waits, waits]


def _notices_power_cycle(interlock: MotionInterlock) -> None:
    interlock.found_restarted((3,))


def _homes_in_part(interlock: MotionInterlock) -> None:
    interlock.begin(Path("home"), None, rehome=True)
    interlock.end(State.STOPPED, "", Path("home"), holding=True, positions=[0] * 8)


@pytest.mark.parametrize("does", [_notices_power_cycle, _homes_in_part])
def test_what_another_user_notes_of_drives_that_only_this_one_homed_counts(
    share: Callable[[], Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    does: Callable[[MotionInterlock], None],
) -> None:
    """The other one's set-up leaves no other trace; drives power-cycled at home count from 0."""
    rig = rig_with("incremental")
    MotionInterlock(rig).file.write(reference_of(rig))
    share()
    with monkeypatch.context() as other:
        other.setenv("XDG_STATE_HOME", str(tmp_path / "other"))
        does(MotionInterlock(rig))
    with pytest.raises(Refused, match="reference is lost"):
        MotionInterlock(rig).reference()
    MotionInterlock(rig).file.write(reference_of(rig))  # homed
    assert MotionInterlock(rig).reference() is not None


def test_a_motion_from_released_drives_does_not_make_the_reference_good_again() -> None:
    rig = rig_with("incremental")
    interlock, left = MotionInterlock(rig), reference_of(rig)
    interlock.file.write(left)
    interlock.found_at_rest((), (), ())
    assert interlock.kept_reference() == left
    interlock.found_at_rest((), (), ALL)
    interlock.begin(Path("run"), interlock.still_counts(left.stands_at))
    _end(interlock, positions=left.stands_at)
    interlock.confirm_at_rest(left.stands_at, held=True)
    assert "without torque" in MotionInterlock(rig).why_unreferenced()


@pytest.mark.parametrize("rehome", [True, False])
def test_drives_that_a_motion_found_without_torque_and_did_not_enable_never_held(
    rehome: bool,
) -> None:
    """Absolute encoders never homed, as where STO is open."""
    rig = rig_with("absolute")
    interlock = MotionInterlock(rig)
    interlock.found_at_rest((), (), ALL)
    interlock.begin(Path("home"), interlock.still_counts([0] * 8), rehome=rehome)
    assert interlock.why_released((), ALL), "expected to hold, even if this program is killed"
    interlock.end(State.LATCHED, "STO", Path("home"), holding=True, positions=[0] * 8, released=ALL)
    MotionInterlock(rig).found_at_rest((), (), ALL)
    assert interlock.why_unreferenced() == ""


def test_the_end_of_homing_keeps_the_reference_that_it_made() -> None:
    rig = rig_with("absolute")
    interlock, made = MotionInterlock(rig), reference_of(rig)
    interlock.begin(Path("home"), interlock.still_counts([0] * 8), rehome=True)
    interlock.take(made)
    _end(interlock)
    assert interlock.kept_reference() == made


@pytest.mark.parametrize("encoder", ["absolute", "incremental"])
def test_drives_that_were_never_homed_are_not_said_to_have_been(encoder: str) -> None:
    interlock = MotionInterlock(rig_with(encoder))
    interlock.begin(Path("run"), None)
    interlock.end(State.LATCHED, "emergency stop", Path("run"), holding=False, positions=None)
    assert reference_status(interlock).made is None
    why = interlock.why_unreferenced()
    assert why.endswith("(emergency stop); the drives were never homed")


def test_drives_that_were_never_homed_count_as_in_the_rig_file_whatever_it_was_before() -> None:
    interlock = MotionInterlock(rig_with("absolute"))
    interlock.begin(Path("run"), interlock.require_ready())
    _end(interlock)
    changed = MotionInterlock(rig_with("absolute", drum_mm_per_rev=200.0, home_counts=77))
    assert changed.reference() is None
    found = changed.require_ready()
    assert found is not None
    assert found.home_counts == [77] * 8
    assert str(reference_status(changed)) == "none: the drives count as in the rig file"
    relative = MotionInterlock(rig_with("incremental"))
    for ask in (relative.reference, relative.require_ready):
        with pytest.raises(Refused, match="never homed"):
            ask()


def test_a_loss_of_drives_never_homed_names_the_way_out_for_absolute_encoders() -> None:
    """The rig file said at first that they count from where they are switched on."""
    MotionInterlock(rig_with("incremental")).found_restarted(load_rig(RIG).drive_names)
    for encoder in ("incremental", "absolute"):
        interlock = MotionInterlock(rig_with(encoder))
        with pytest.raises(Refused, match="is lost") as refused:
            interlock.reference()
        way = "`cdpr home RIG --as-rig-file` instead, in Python executor.use_rig_file_counts()"
        assert (way in refused.value.next_step) is (encoder == "absolute")
    interlock.use_rig_file_counts()
    assert interlock.reference() is None


@pytest.fixture
def share(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], Path]:
    """Creates the folder for all users, as `docs/commissioning.md` advises it."""
    shared = tmp_path / "shared"
    monkeypatch.setattr(state_folder, "SHARED", shared)

    def create() -> Path:
        shared.mkdir()
        return shared

    return create


@pytest.mark.parametrize("encoder", ["absolute", "incremental"])
@pytest.mark.parametrize("lost", ["", "a cable was released"])
def test_it_outlives_the_change_to_a_folder_for_all_users(
    share: Callable[[], Path], encoder: str, lost: str
) -> None:
    """Absolute encoders would count as in the rig file without a word, metres from the truth."""
    rig = rig_with(encoder)
    before = reference_of(rig).model_copy(update={"lost": lost})
    MotionInterlock(rig).file.write(before)
    own = MotionInterlock(rig).file.path
    shared = share()
    interlock = MotionInterlock(rig)
    assert interlock.kept_reference() == before
    status = reference_status(interlock)
    assert (status.counts, status.file) == (not lost, str(own))
    if lost:
        with pytest.raises(Refused, match="reference is lost") as caught:
            interlock.reference()
        assert str(own) in caught.value.where
    else:
        assert [w.home_counts for w in interlock.referenced_rig().winches] == before.home_counts
    interlock.lost_torque("drive 3 let go")
    after = MotionInterlock(rig).kept_reference()
    assert after is not None
    assert after.lost == (lost or "drive 3 let go")
    assert (own.exists(), interlock.file.path.parent) == (False, shared)
    interlock.take(reference_of(rig))
    assert MotionInterlock(rig).reference() is not None


def test_a_loss_noted_in_either_folder_counts_until_the_drives_are_homed(
    share: Callable[[], Path],
) -> None:
    rig = rig_with("absolute")
    mine = reference_of(rig).model_copy(update={"lost": "a cable was released"})
    MotionInterlock(rig).file.write(mine)
    own, text = MotionInterlock(rig).file.path, mine.model_dump_json()
    share()
    MotionInterlock(rig).file.write(reference_of(rig))  # another user's, who does not see mine
    own.write_text(text)
    with pytest.raises(Refused, match="reference is lost") as caught:
        MotionInterlock(rig).require_ready()
    assert "a cable was released" in caught.value.why
    MotionInterlock(rig).take(reference_of(rig))
    assert MotionInterlock(rig).reference() is not None


@pytest.mark.parametrize("change", [{"home_counts": [7] * 8}, {"made": ""}, {"rig_hash": "other"}])
def test_two_different_references_are_none(
    share: Callable[[], Path], change: Mapping[str, Any]
) -> None:
    rig = rig_with("absolute")
    MotionInterlock(rig).file.write(reference_of(rig))
    own = MotionInterlock(rig).file.path
    shared = share()
    old = own.read_text()
    MotionInterlock(rig).file.write(reference_of(rig).model_copy(update=change))
    own.write_text(old)
    for ask in (MotionInterlock(rig).reference, MotionInterlock(rig).require_ready):
        with pytest.raises(Refused, match="reference is lost") as caught:
            ask()
        assert str(own) in caught.value.why
        assert str(shared) in caught.value.why
    MotionInterlock(rig).confirm_at_rest([0] * 8, held=True)
    assert not reference_status(MotionInterlock(rig)).counts, "no reset makes it valid"
    own.write_text("{")
    with pytest.raises(Refused, match="cannot be read") as caught:
        MotionInterlock(rig).reference()
    assert caught.value.where == str(own)
    use_rig_file_counts(rig)
    assert MotionInterlock(rig).kept_reference() is None


def test_drives_that_were_never_homed_have_no_two_references(share: Callable[[], Path]) -> None:
    """Files of motions by the rig file's own counts, one before the rig file was corrected."""
    rig = rig_with("absolute")
    MotionInterlock(rig).file.write(as_in_the_file(rig).model_copy(update={"rig_hash": "former"}))
    own = MotionInterlock(rig).file.path
    old = own.read_text()
    share()
    MotionInterlock(rig).file.write(as_in_the_file(rig))
    own.write_text(old)
    MotionInterlock(rig).require_ready()


def test_an_interrupted_removal_leaves_the_reference_that_counts(
    share: Callable[[], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = rig_with("absolute")
    MotionInterlock(rig).file.write(reference_of(rig))
    own = MotionInterlock(rig).file.path
    old = own.read_text()
    share()
    later = reference_of(rig).model_copy(update={"home_counts": [7] * 8})
    MotionInterlock(rig).file.write(later)
    own.write_text(old)
    unlink = Path.unlink

    def once(path: Path, missing_ok: bool = False) -> None:
        unlink(path, missing_ok=missing_ok)
        raise OSError("interrupted")

    monkeypatch.setattr(Path, "unlink", once)
    with pytest.raises(Refused, match="cannot be removed"):
        MotionInterlock(rig).file.remove()
    assert MotionInterlock(rig).file.read() == later


def test_positions_noted_in_the_folder_for_all_users_are_the_later_ones(
    share: Callable[[], Path],
) -> None:
    """As after a crash between writing the one file and removing the other."""
    rig = rig_with("incremental")
    before = reference_of(rig)
    MotionInterlock(rig).file.write(before)
    own, text = MotionInterlock(rig).file.path, before.model_dump_json()
    share()
    MotionInterlock(rig).confirm_at_rest([42] * 8, held=True)
    own.write_text(text)
    kept = MotionInterlock(rig).kept_reference()
    assert kept == before.model_copy(update={"stands_at": [42] * 8})
