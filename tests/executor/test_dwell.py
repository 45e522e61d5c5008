"""Tables of runs with stops: exact dwells, loads by legs, and refusals of violations."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from executor.trajectory.dwell import Dwell, legs_at, load_changes, stop_events
from executor.trajectory.path import rounded
from executor.trajectory.setpoints import Trajectory, build_table, check_table
from executor.trajectory.time_scaling import time_law
from model.errors import Refused
from model.files.scene_file import SceneDocument
from model.kinematics import cables_to
from model.pose import Pose
from model.rig import Rig, load_rig
from model.scene import Load, Scene, scene_from_document
from model.statics.gravity import working_tensions
from tests.executor.routes import WEIGHT, always

CONFIGS = Path(__file__).parents[2] / "configs"
LEGS_MM = (
    ((0, 0, 445), (10, 0, 445), (10, 8, 450)),
    ((10, 8, 450), (10, 8, 460)),
    ((10, 8, 460), (10, 8, 460)),
    ((10, 8, 460), (0, 8, 460), (0, 0, 445)),
)
PICKED = {"kind": "pick", "dwell_s": 0.5, "mass_kg": 2.0, "mass_centre_mm": [0, 20, -50]}


@lru_cache(maxsize=1)
def _made() -> tuple[Rig, Scene, Trajectory]:
    """A pick, a via pose, a put-down at the via pose, and back; the third leg has no length."""
    rig = load_rig(CONFIGS / "gachon_8_6.yaml")
    scene = scene_from_document(
        SceneDocument.model_validate(
            {
                "schema_version": 1,
                "name": "stops",
                "start": {"position_mm": [0, 0, 445]},
                "goal": {"position_mm": [0, 0, 445]},
                "stops": [
                    {"name": "take", "position_mm": [10, 8, 450], **PICKED},
                    {"name": "by", "position_mm": [10, 8, 460]},
                    {
                        "name": "leave",
                        "kind": "place",
                        "position_mm": [10, 8, 460],
                        "dwell_s": 0.203,
                        "mass_kg": 0.5,
                    },
                ],
            }
        )
    )
    legs = []
    for corners in LEGS_MM:
        waypoints = [Pose.level(np.array(corner) / 1000.0) for corner in corners]
        path = rounded(waypoints, rig.motion.blend_tolerance, WEIGHT, always)
        legs.append((path, time_law(path, rig.motion)))
    return rig, scene, build_table(rig, scene, legs, 0.010)


def _refused(table: Trajectory, scene: Scene | None = None) -> str:
    rig, own, _ = _made()
    with pytest.raises(Refused) as caught:
        check_table(rig, scene or own, table)
    return caught.value.what


def test_a_table_with_stops_passes_its_check() -> None:
    rig, scene, table = _made()
    checked = check_table(rig, scene, table)
    assert checked.report.passed
    assert checked.report.length == pytest.approx(table.travelled[-1], abs=1e-5)


def test_the_platform_rests_exactly_at_its_stops_for_the_whole_dwell() -> None:
    _, scene, table = _made()
    take, by, leave = table.dwells
    assert by.first == by.last
    assert take.last - take.first == 50
    assert leave.last - leave.first == 21, "a dwell is never cut to whole cycles"
    for stop, dwell in zip(scene.stops, table.dwells, strict=True):
        there = table.positions[dwell.first : dwell.last + 1]
        np.testing.assert_allclose(there - stop.pose.position, 0.0, atol=1e-9)
    steps = np.linalg.norm(np.diff(table.positions, axis=0), axis=1)
    for dwell in table.dwells:
        around = steps[max(0, dwell.first - 1) : dwell.last + 1]
        assert around.max() < 0.02 * steps.max(), "from rest to rest"


def test_tensions_and_counts_are_those_of_each_legs_load() -> None:
    """The masses and centres are written out here; the centre stays when a part is put down."""
    rig, _, table = _made()
    nothing = np.zeros(3)
    centre = np.array([0.0, 0.020, -0.050])
    take, by, leave = table.dwells
    rows = {0: 0.0, take.first: 0.0, take.last: 2.0, by.first: 2.0, leave.first: 2.0}
    rows |= {leave.last: 1.5, len(table) - 1: 1.5}
    for row, mass in rows.items():
        pose = table.poses()[row]
        wanted = working_tensions(rig, pose, Load(mass, centre, nothing, nothing)).tensions
        np.testing.assert_allclose(table.tensions[row], wanted, atol=1e-6)
        lengths = cables_to(rig, pose.apply(rig.anchors)).lengths
        np.testing.assert_allclose(table.lengths[row], lengths, atol=1e-9)
    stretch = np.abs(table.counts[take.last] - table.counts[take.first])
    assert stretch.max() > 1.0, "less cable is paid out for the heavier load, at the same pose"


def test_during_a_dwell_tensions_go_evenly_from_one_load_to_the_other() -> None:
    _, _, table = _made()
    dwell = table.dwells[0]
    during = table.tensions[dwell.first : dwell.last + 1]
    steps = np.diff(during, axis=0)
    np.testing.assert_allclose(steps, np.tile(steps[0], (len(steps), 1)), atol=1e-9)
    assert np.abs(during[-1] - during[0]).max() > 1.0


def test_legs_are_counted_by_the_stops_that_were_left() -> None:
    dwells = [Dwell(10, 20), Dwell(30, 30)]
    indices = np.array([0.0, 10.0, 19.9, 20.0, 29.5, 30.0, 40.0])
    assert legs_at(dwells, indices).tolist() == [1, 1, 1, 2, 2, 3, 3]
    assert legs_at([], indices).tolist() == [1] * 7


def test_tensions_that_do_not_hold_the_load_are_refused() -> None:
    """Pose, counts and limits are right; only the load differs."""
    _, scene, table = _made()
    heavier = [s.model_copy() for s in scene.document.stops]
    heavier[0] = heavier[0].model_copy(update={"mass_kg": 2.1})
    what = _refused(table, scene.changed(stops=heavier))
    assert "miss the load from stop 'take' to stop 'by' by 0.98" in what
    assert "from start to stop 'take'" not in what


def test_tensions_beside_those_of_either_load_are_refused_during_a_dwell() -> None:
    table = _made()[2]
    dwell = table.dwells[0]
    tensions = table.tensions.copy()
    tensions[dwell.first + 5, 2] += 0.01
    assert f"row {dwell.first + 5}: planned tensions miss the load at stop 'take'" in _refused(
        replace(table, tensions=tensions)
    )


def test_a_dwell_elsewhere_than_its_stop_is_refused() -> None:
    _, scene, table = _made()
    moved = [s.model_copy() for s in scene.document.stops]
    moved[1] = moved[1].model_copy(update={"position_mm": [10.0, 8.0, 460.01]})
    assert "at stop 'by' the table is 0.0100 mm" in _refused(table, scene.changed(stops=moved))


def test_a_dwell_that_is_too_short_is_refused() -> None:
    _, scene, table = _made()
    longer = [s.model_copy() for s in scene.document.stops]
    longer[0] = longer[0].model_copy(update={"dwell_s": 0.52})
    what = _refused(table, scene.changed(stops=longer))
    assert "rests for 0.5 s, required 0.52 s" in what


@pytest.mark.parametrize(
    ("dwells", "words"),
    [
        ((), "rests at 0 stops, the scene has 3"),
        ((Dwell(60, 50), Dwell(90, 90), Dwell(90, 95)), "out of order"),
        ((Dwell(20, 50), Dwell(40, 90), Dwell(90, 95)), "out of order"),
        ((Dwell(20, 50), Dwell(60, 90), Dwell(90, 10**6)), "out of order"),
    ],
)
def test_dwells_that_are_invalid_are_refused(dwells: tuple[Dwell, ...], words: str) -> None:
    assert words in _refused(replace(_made()[2], dwells=dwells))


def test_stops_are_announced_once_when_they_are_reached_and_left() -> None:
    _, scene, table = _made()
    events, take = stop_events(scene, table.dwells), table.dwells[0]
    assert events.due(take.first - 0.5) == []
    text = "at stop 'take', resting for 0.5 s while 2 kg is picked up"
    assert events.due(float(take.first)) == [("pick", text)]
    assert events.due(take.last - 0.5) == []
    codes = [code for code, _ in events.due(float(len(table)))]
    assert codes == ["leaving", "pass", "place", "leaving"]
    assert events.due(float(len(table))) == []


def test_the_load_changes_in_the_middle_of_a_dwell() -> None:
    _, scene, table = _made()
    loads, take = load_changes(scene, table.dwells), table.dwells[0]
    assert loads.due(take.first + 24.5) == []
    assert [load.payload_mass for load in loads.due(take.first + 25.0)] == [2.0]
    assert [load.payload_mass for load in loads.due(float(len(table)))] == [1.5]
