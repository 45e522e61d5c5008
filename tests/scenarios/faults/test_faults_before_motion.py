"""F14–F16, F24: faults before anything is enabled are refused with location and cause."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.cia402.configure import configure_drives
from drivers.cia402.object_dictionary import settings_for
from drivers.cia402.state_machine import DriveState
from executor.state_machine import State
from executor.trajectory.setpoints import PreparedRun
from model.errors import HardwareMissing, Refused
from model.files.rig_file import Cia402Document
from model.rig import rig_from_document
from simulation.drives.behaviour import behaviour_named
from tests.scenarios.faults.bench import SimulatedBench, simulated

ENABLED = DriveState.OPERATION_ENABLED
SWITCHED_ON, DISABLED = DriveState.SWITCHED_ON, DriveState.SWITCH_ON_DISABLED
READY, HOLDING = DriveState.READY_TO_SWITCH_ON, DriveState.QUICK_STOP_ACTIVE


def nothing(_bench: object) -> None:
    pass


def configure(bench: SimulatedBench) -> None:
    near = bench.stage.group._bus  # type: ignore[attr-defined]
    configure_drives(
        bench.prepared.rig,
        near,
        bench.rehearsal.pump,
        max_tension=None,
        to_reset=False,
        on_restarted=lambda _nodes: None,
    )


def test_f14_an_object_that_is_never_answered_is_named(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    """Each object in turn; aborts and values that are not kept: tests/drivers/test_group.py."""
    with simulated(prepared, tmp_path / "run", nothing) as bench:
        drive = bench.drives[5]
        settings = settings_for(prepared.rig, 5, bench.rehearsal.plant.winch_map)
        answers = type(drive).on_sdo
        for key in dict.fromkeys((s.index, s.sub) for s in settings):

            def deaf(data: bytes, key: tuple[int, int] = key) -> None:
                if (int.from_bytes(data[1:3], "little"), data[3]) != key:
                    answers(drive, data)

            bench.rehearsal._handlers[0x600 + drive.node] = deaf
            with pytest.raises(HardwareMissing, match="drive 6 does not answer") as caught:
                configure(bench)
            assert f"drive 6, object {key[0]:04X}h:{key[1]:02X}" in caught.value.where
        assert all(d.state is not ENABLED for d in bench.drives)


@pytest.mark.parametrize(
    ("key", "value"),
    [((0x605A, 0), 2), ((0x6007, 0), 1), ((0x6072, 0), 65535), ((0x60C2, 1), 1)],
)
def test_f15_a_drive_that_keeps_another_value_is_not_armed(
    prepared: PreparedRun, tmp_path: Path, key: tuple[int, int], value: int
) -> None:
    with simulated(prepared, tmp_path / "run", nothing) as bench:
        bench.drives[2].objects.stuck.add(key)
        bench.drives[2].objects[key] = value
        with pytest.raises(Refused, match=f"has {value};") as caught:
            configure(bench)
        assert f"drive 3, object {key[0]:04X}h:{key[1]:02X}" in caught.value.where


@pytest.mark.parametrize(("key", "sub"), [("vendor_id", 1), ("product_code", 2)])
def test_f15_a_drive_of_another_maker_is_not_armed(
    prepared: PreparedRun, tmp_path: Path, key: str, sub: int
) -> None:
    named = Cia402Document(type="cia402", **{key: 0x2E3})
    rig = rig_from_document(prepared.rig.document.model_copy(update={"drives": named}))
    with simulated(prepared, tmp_path / "run", nothing) as bench:
        bench.prepared = replace(prepared, rig=rig)
        for drive in bench.drives:
            drive.objects[0x1018, sub] = 0x2E3
        configure(bench)
        bench.drives[6].objects[0x1018, sub] = 0x2E4
        with pytest.raises(Refused, match="has 2E4h; 2E3h is required") as caught:
            configure(bench)
        assert f"drive 7, object 1018h:0{sub}" in caught.value.where


@pytest.mark.parametrize(
    "states",
    [
        {0: SWITCHED_ON},
        {0: READY, 1: SWITCHED_ON},
        {6: HOLDING},
        {0: HOLDING, 1: SWITCHED_ON, 2: READY},
        dict.fromkeys(range(8), HOLDING),
    ],
)
def test_f16_from_any_mixture_of_states_all_are_enabled_at_one_sync(
    prepared: PreparedRun, tmp_path: Path, states: dict[int, DriveState]
) -> None:
    with simulated(prepared, tmp_path / "run", nothing) as bench:
        for drive, state in states.items():
            bench.drives[drive].state = state
        assert bench.run() is State.FINISHED, bench.cause
        assert bench.violations() == []


def test_f16_a_drive_in_fault_keeps_all_others_without_power(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    with simulated(prepared, tmp_path / "run", nothing) as bench:
        bench.drives[4].fail(0x3210)
        with pytest.raises(Refused) as caught:
            bench.run()
        assert (
            caught.value.what == "cable 5 (drive 5) is in fault: DC link over-voltage (error 3210h)"
        )
        assert all(ENABLED not in sample.states for sample in bench.rehearsal.samples)
        assert bench.violations() == []


def test_f16_a_drive_that_loses_its_mode_is_not_armed(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    with simulated(prepared, tmp_path / "run", nothing) as bench:
        bench.drives[1].objects.measured(0x6061, 0, lambda: 1)
        with pytest.raises(Refused) as caught:
            configure(bench)
        assert "drive 2, object 6061h" in caught.value.where


@pytest.mark.parametrize("change", [1, -1, 4000])
def test_f24_set_points_that_were_changed_after_their_check_are_not_armed(
    prepared: PreparedRun, tmp_path: Path, change: int
) -> None:
    """NaN, jumps, speeds and limits are refused by the check: tests/executor/test_setpoints.py."""
    setpoints = prepared.checked.table.setpoints
    setpoints.setflags(write=True)
    setpoints[200, 3] += change
    try:
        with simulated(prepared, tmp_path / "run", nothing) as bench:
            with pytest.raises(Refused, match="differ from those that were checked"):
                bench.run()
            assert all(ENABLED not in sample.states for sample in bench.rehearsal.samples)
    finally:
        setpoints[200, 3] -= change
        setpoints.setflags(write=False)
    assert np.array_equal(setpoints, np.rint(prepared.checked.table.counts))


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("absent=6007", "6007h:00"),
        ("absent=6085/06010000", "6085h:00"),
        ("range=60C2:02/-6..-4", "60C2h:02"),
        ("mode-when-enabled", "6061h:00"),
        ("sdo-twice=0", "twice"),
        ("sdo-delay=5000", "do not answer"),
        ("sdo-lost=1", "do not answer"),
        ("boot-late=60000", "do not answer"),
    ],
)
def test_f14_drives_that_cannot_do_it_are_refused_and_sent_no_set_point(
    prepared: PreparedRun, tmp_path: Path, name: str, expected: str
) -> None:
    """Each is a named behaviour of the simulated drives; tolerated ones: drive_cases."""
    bench = simulated(prepared, tmp_path / "run", nothing, behaviour=behaviour_named([name]))
    with pytest.raises((Refused, HardwareMissing)) as caught, bench:
        pass
    assert expected in str(caught.value)
