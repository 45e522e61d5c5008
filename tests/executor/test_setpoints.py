"""Set-points: correct counts for both example rigs, and no violation passes the check."""

from __future__ import annotations

import re
from dataclasses import FrozenInstanceError, replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from executor.trajectory.dwell import Dwell
from executor.trajectory.path import rounded
from executor.trajectory.setpoints import (
    CheckedTrajectory,
    Trajectory,
    build_table,
    check_table,
    prepare_plan,
)
from executor.trajectory.time_scaling import time_law
from model.errors import Refused
from model.pose import Pose
from model.rig import Rig, load_rig
from model.scene import Scene, load_scene
from model.statics.gravity import working_tensions
from model.winches import WinchMap
from planner.check_report import CheckReport
from planner.planning import plan_from_waypoints
from tests.executor.routes import WEIGHT, always

CONFIGS = Path(__file__).parents[2] / "configs"
RIGS = {
    "gachon_8_6": ("environment_1", ([180, 180, 300], [170, 185, 305], [170, 195, 310])),
    "hall_10_6": ("hall_pillar", ([700, 0, 900], [690, 20, 910], [690, 40, 930])),
}
names = pytest.mark.parametrize("name", list(RIGS))


@lru_cache(maxsize=4)
def _made(name: str) -> tuple[Rig, Scene, Trajectory]:
    """A short path with one corner, its ends the scene's."""
    scene_name, corners = RIGS[name]
    rig = load_rig(CONFIGS / f"{name}.yaml")
    waypoints = [Pose.level(np.array(corner) / 1000.0) for corner in corners]
    loaded = load_scene(CONFIGS / f"{scene_name}.yaml")
    scene = loaded.changed(start=waypoints[0], goal=waypoints[-1])
    path = rounded(waypoints, rig.motion.blend_tolerance, WEIGHT, always)
    cycle = rig.document.bus.cycle_ms / 1000.0
    return rig, scene, build_table(rig, scene, [(path, time_law(path, rig.motion))], cycle)


def _over_a_pulley(rig: Rig, cable: int, anchor: np.ndarray) -> float:
    """Wrapped arc and straight part; the wrap is where the straight part leaves tangentially."""
    radius, feed = rig.pulley_radius, rig.feed_directions[cable]
    offset = anchor - rig.outlets[cable]
    outward = offset - (offset @ feed) * feed
    side = outward / np.linalg.norm(outward)
    centre = rig.outlets[cable] + radius * side

    def spoke(wrap: float) -> np.ndarray:
        return -np.cos(wrap) * side + np.sin(wrap) * feed

    def ahead(wrap: float) -> float:
        return float((anchor - centre) @ spoke(wrap)) - radius

    wraps = np.linspace(0.0, np.pi * 1.5, 400)
    leaving = [
        (low, high)
        for low, high in pairwise(wraps)
        if ahead(low) > 0.0 >= ahead(high) or ahead(low) < 0.0 <= ahead(high)
    ]
    for low, high in leaving:
        wrap = brentq(ahead, low, high, xtol=1e-15)
        travel = np.sin(wrap) * side + np.cos(wrap) * feed
        straight = anchor - centre - radius * spoke(wrap)
        if straight @ travel > 0.0:
            return float(radius * wrap + np.linalg.norm(straight))
    raise AssertionError("no tangent")


def _length(rig: Rig, cable: int, pose: Pose) -> float:
    anchor = pose.position + pose.rotation @ rig.anchors[cable]
    if rig.pulley_radius:
        return _over_a_pulley(rig, cable, anchor)
    return float(np.linalg.norm(rig.outlets[cable] - anchor))


def _count(rig: Rig, scene: Scene, cable: int, pose: Pose) -> float:
    """From the rig file's own numbers: drum, gear, counts, direction, stretch."""
    winch, stiffness = rig.document.winches[cable], rig.document.cables.stiffness_n
    wound = []
    for at, load in ((pose, scene.load), (rig.home, None)):
        whole = _length(rig, cable, at) + winch.drum_to_outlet_mm / 1000.0
        wound.append(whole / (1.0 + working_tensions(rig, at, load).tensions[cable] / stiffness))
    turns = (wound[0] - wound[1]) * 1000.0 / winch.drum_mm_per_rev * winch.gear_ratio
    return winch.home_counts + winch.direction * turns * winch.counts_per_rev


@names
def test_counts_are_those_of_an_independent_computation(name):
    rig, scene, table = _made(name)
    for row in (0, len(table) // 2, len(table) - 1):
        pose = table.poses()[row]
        wanted = [_count(rig, scene, cable, pose) for cable in range(rig.cable_count)]
        assert table.counts[row] == pytest.approx(wanted, abs=0.01)
        assert table.setpoints[row] == pytest.approx(np.round(wanted), abs=1)


def test_a_longer_cable_is_more_counts_where_the_direction_is_positive():
    """The hall's winches alternate; paying out one cable must not wind it up."""
    rig, _, table = _made("hall_10_6")
    paid_out = table.lengths[-1] - table.lengths[0]
    moved = table.setpoints[-1] - table.setpoints[0]
    directions = np.array([winch.direction for winch in rig.document.winches])
    assert set(directions) == {1, -1}
    assert (np.sign(moved) == directions * np.sign(paid_out)).all()


@names
def test_stretch_is_fed_forward_by_paying_out_less(name):
    """A taut cable is longer than its unstrained length, so less must be paid out."""
    rig, scene, table = _made(name)
    per_metre = np.array([winch.counts_per_metre for winch in rig.winches])
    behind = np.array([winch.drum_to_outlet for winch in rig.winches])
    home = working_tensions(rig, rig.home).tensions
    stretch = (table.lengths[0] + behind) * table.tensions[0] / rig.cable_stiffness
    at_home = np.array([_length(rig, c, rig.home) for c in range(rig.cable_count)]) + behind
    without = (
        table.lengths[0] + behind - at_home + at_home * home / rig.cable_stiffness
    ) * per_metre
    assert without - table.counts[0] == pytest.approx(stretch * per_metre, rel=1e-3)
    assert (stretch > 0).all()
    heavier = replace(scene.load, payload_mass=scene.load.payload_mass + 2.0)
    assert not np.allclose(
        working_tensions(rig, table.poses()[0], heavier).tensions, table.tensions[0]
    )


@names
def test_rows_are_the_path_at_every_cycle_from_rest_to_rest(name):
    rig, scene, table = _made(name)
    assert table.cycle == pytest.approx(rig.document.bus.cycle_ms / 1000.0)
    steps = np.linalg.norm(np.diff(table.positions, axis=0), axis=1)
    assert steps.max() <= rig.motion.speed * table.cycle * (1 + 1e-6)
    assert max(steps[0], steps[-1]) < 0.02 * steps.max()
    assert table.poses()[0].distance_to(scene.start) < 1e-9
    assert table.poses()[-1].distance_to(scene.goal) < 1e-9


@names
def test_a_good_table_passes_and_carries_its_proof(name):
    rig, scene, table = _made(name)
    checked = check_table(rig, scene, table)
    assert checked.table is table
    assert checked.hash == table.hash
    assert checked.report.passed


@pytest.mark.parametrize("proof", [None, object(), True])
def test_a_table_that_was_not_checked_cannot_be_called_checked(proof: object) -> None:
    rig, _, table = _made("gachon_8_6")
    report, winches = CheckReport.__new__(CheckReport), WinchMap(rig)
    with pytest.raises(TypeError, match="comes only from"):
        CheckedTrajectory(table, rig, table.hash, report, winches, proof)


def test_a_checked_table_of_another_path_needs_a_check_of_its_own() -> None:
    """Even checked data must not be changed afterwards without the proof object."""
    rig, scene, table = _made("gachon_8_6")
    checked = check_table(rig, scene, table)
    with pytest.raises(TypeError, match="comes only from"):
        replace(checked, proof=None)
    with pytest.raises(FrozenInstanceError):
        checked.table = table  # type: ignore[misc]


@names
def test_arrays_cannot_be_written_to(name):
    table = _made(name)[2]
    arrays = (table.travelled, table.positions, table.rotations, table.lengths, table.tensions)
    for array in (*arrays, table.counts, table.setpoints):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_a_table_keeps_its_own_copy_of_what_it_is_given():
    table = _made("gachon_8_6")[2]
    counts = table.counts.copy()
    copied = replace(table, counts=counts)
    counts[0] = 0.0
    assert (copied.counts[0] == table.counts[0]).all()


def test_the_hash_tells_a_changed_set_point_and_a_changed_cycle():
    table = _made("gachon_8_6")[2]
    counts = table.counts.copy()
    counts[5, 3] += 1.0
    assert replace(table).hash == table.hash
    assert replace(table, counts=counts).hash != table.hash
    assert replace(table, cycle=0.02).hash != table.hash


def test_the_hash_is_recomputed_so_that_it_shows_a_change_in_memory():
    table = replace(_made("gachon_8_6")[2])
    before = table.hash
    table.setpoints.setflags(write=True)
    table.setpoints[7, 2] += 1
    assert table.hash != before


def _spoilt(name: str, field: str, row: int, column: int, value: float) -> Trajectory:
    table = _made(name)[2]
    values = getattr(table, field).copy()
    values.reshape(len(table), -1)[row, column] += value
    return replace(table, **{field: values})


def _refused(name: str, table: Trajectory) -> str:
    rig, scene, _ = _made(name)
    with pytest.raises(Refused) as caught:
        check_table(rig, scene, table)
    assert "nothing was armed" in caught.value.next_step
    return caught.value.what


def _said(name: str, table: Trajectory) -> str:
    """Why it is refused; empty if it is not."""
    rig, scene, _ = _made(name)
    try:
        check_table(rig, scene, table)
    except Refused as refused:
        return refused.what
    return ""


@names
@pytest.mark.parametrize(
    "field", ["travelled", "positions", "rotations", "lengths", "tensions", "counts"]
)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_not_a_number_is_refused_wherever_it_is(name, field, value):
    assert f"row 3 has {field}" in _refused(name, _spoilt(name, field, 3, 0, value))


@names
@pytest.mark.parametrize("value", [2.0**31, -(2.0**31) - 1e6, 1e300])
def test_counts_beyond_32_bits_are_refused_not_wrapped(name, value):
    table = _made(name)[2]
    what = _refused(name, replace(table, counts=table.counts + value))
    assert "32 bits" in what


@names
def test_counts_just_within_32_bits_are_not_refused_for_that(name):
    table = _made(name)[2]
    room = 2**31 - 2 - table.counts.max()
    assert "32 bits" not in _refused(name, replace(table, counts=table.counts + room))


@names
@pytest.mark.parametrize(("share", "wrong"), [(0.98, False), (1.2, True)])
def test_a_winch_that_would_run_too_fast_is_refused_by_name(name, share, wrong):
    rig, _, table = _made(name)
    winch = rig.winches[2]
    step = share * abs(winch.counts_per_metre) * winch.max_speed * table.cycle
    here = table.counts[20, 2] - table.counts[19, 2]
    counts = table.counts.copy()
    counts[20:, 2] += np.copysign(step, here) - here
    what = _refused(name, replace(table, counts=counts))
    assert ("cable 3 would move at" in what) is wrong


@names
def test_a_jump_that_no_winch_limit_forbids_is_refused(name):
    """A slow drift from the pose: the curve's check sees poses, the drives would get this."""
    assert "row 40" in _refused(name, _spoilt(name, "counts", 40, 1, 3.0))


@names
@pytest.mark.parametrize("row", [0, -1])
def test_ends_that_are_not_the_scenes_are_refused(name, row):
    spoilt = _spoilt(name, "positions", row, 0, 2e-6)
    what = _refused(name, spoilt)
    assert ("the start of the table" if row == 0 else "the goal of the table") in what


@names
def test_a_rotated_end_is_refused(name):
    table = _made(name)[2]
    rotations = table.rotations.copy()
    rotations[-1] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    assert "90.0000° off" in _refused(name, replace(table, rotations=rotations))


@names
def test_tensions_outside_the_rigs_limits_are_refused(name):
    rig = _made(name)[0]
    table = _made(name)[2]
    for bound in (rig.min_tension - 0.01, rig.max_tension + 0.01):
        tensions = table.tensions.copy()
        tensions[4, 1] = bound
        assert "planned tensions range" in _refused(name, replace(table, tensions=tensions))


def test_a_table_of_another_shape_is_refused():
    table = _made("gachon_8_6")[2]
    assert "shape" in _refused("gachon_8_6", replace(table, counts=table.counts[:, :7]))
    empty = {name: getattr(table, name)[:0] for name in ("travelled", "positions", "rotations")}
    empty |= {name: getattr(table, name)[:0] for name in ("lengths", "tensions", "counts")}
    assert "shape" in _refused("gachon_8_6", replace(table, **empty))


def test_everything_that_is_wrong_is_reported_at_once():
    table = _spoilt("gachon_8_6", "positions", 0, 0, 1e-4)
    tensions = table.tensions.copy()
    tensions[0, 0] = 200.0
    what = _refused("gachon_8_6", replace(table, tensions=tensions))
    assert "the start of the table" in what
    assert "planned tensions range" in what


def test_a_curve_that_fails_the_independent_check_is_refused():
    rig, scene, table = _made("gachon_8_6")
    with pytest.raises(Refused, match="obstacle"):
        check_table(rig, scene.changed(clearance=0.1), table)


# Each limit from both sides, and its message.


@pytest.mark.parametrize("factor", [0.5, 1.001, 2.0])
def test_a_table_for_another_cycle_is_refused(factor: float) -> None:
    rig, _, table = _made("gachon_8_6")
    what = _refused("gachon_8_6", replace(table, cycle=rig.cycle * factor))
    assert what == f"the table is for a cycle of {rig.cycle * factor} s, the bus has {rig.cycle} s"


def test_dwells_that_the_scene_has_not_are_refused() -> None:
    table = _made("gachon_8_6")[2]
    said = "the table rests at 1 stops, the scene has 0"
    assert _refused("gachon_8_6", replace(table, dwells=(Dwell(3, 5),))) == said


@names
@pytest.mark.parametrize(("turn", "wrong"), [(0.5e-6, False), (3e-6, True)])
def test_a_slightly_rotated_end_is_refused_beyond_the_accuracy(
    name: str, turn: float, wrong: bool
) -> None:
    table = _made(name)[2]
    rotations = table.rotations.copy()
    rotations[-1] = rotations[-1] @ [[1, -turn, 0], [turn, 1, 0], [0, 0, 1]]
    assert (
        "the goal of the table is 0.0000 mm and 0.0002° off"
        in _said(name, replace(table, rotations=rotations))
    ) is wrong


@names
def test_how_far_an_end_is_off_is_reported_in_millimetres(name: str) -> None:
    assert "is 0.2500 mm and" in _refused(name, _spoilt(name, "positions", 0, 0, 0.25e-3))


@names
def test_counts_beyond_32_bits_are_reported_by_row_and_cable(name: str) -> None:
    what = _refused(name, _spoilt(name, "counts", 7, 1, -(2.0**40)))
    assert re.fullmatch(r"row 7, cable 2: -1\d{12} counts exceed 32 bits", what)


@names
@pytest.mark.parametrize(("counts", "wrong"), [(-0.45, False), (0.45, False), (1.6, True)])
def test_a_set_point_is_less_than_a_count_off_its_pose(
    name: str, counts: float, wrong: bool
) -> None:
    rig, scene, table = _made(name)
    moved = _spoilt(name, "counts", 40, 1, counts)
    if not wrong:
        assert check_table(rig, scene, moved).report.passed
        return
    off = abs(moved.setpoints[40, 1] - table.counts[40, 1]) / abs(rig.winches[1].counts_per_metre)
    said = re.fullmatch(
        r"row 40: the set-point of cable 2 is (.*) mm off its pose", _refused(name, moved)
    )
    assert said is not None
    assert float(said[1]) == pytest.approx(off * 1000, abs=1e-4)


@names
@pytest.mark.parametrize(("more", "wrong"), [(0, False), (1, False), (2, True)])
def test_a_winch_may_be_faster_than_its_limit_by_the_rounding_of_a_count(
    name: str, more: int, wrong: bool
) -> None:
    rig, _, table = _made(name)
    winch = rig.winches[2]
    per_cycle = abs(winch.counts_per_metre) * winch.max_speed * table.cycle
    step = int(np.ceil(per_cycle)) - 1 + more
    assert abs(per_cycle - round(per_cycle)) > 1e-6
    counts = table.setpoints.astype(float)
    counts[20:, 2] += step - (counts[20, 2] - counts[19, 2])
    what = _refused(name, replace(table, counts=counts))
    assert ("cable 3 would move at" in what) is wrong
    if wrong:
        speed = step / abs(winch.counts_per_metre) / table.cycle * 1000
        allowed = winch.max_speed * 1000
        said = f"cable 3 would move at {speed:.1f} mm/s, its winch allows {allowed:.1f} mm/s"
        assert said in what


@names
@pytest.mark.parametrize(("beyond", "wrong"), [(-1e-7, False), (0.5e-6, False), (2e-6, True)])
def test_tensions_are_within_their_limits_but_for_the_accuracy_of_solving(
    name: str, beyond: float, wrong: bool
) -> None:
    rig, _, table = _made(name)
    for bound in (rig.min_tension - beyond, rig.max_tension + beyond):
        tensions = table.tensions.copy()
        tensions[4, 1] = bound
        what = _refused(name, replace(table, tensions=tensions))
        assert ("planned tensions range" in what) is wrong


@pytest.mark.parametrize(("angle", "passes"), [(0.0, True), (1e-12, True), (0.1, False)])
def test_room_to_stop_without_the_master_counts_the_rotation(angle: float, passes: bool) -> None:
    """20 mm above a ball: enough for 10.5 mm and 5.4 mm by inertia, not for a corner's 26.6 mm."""
    document = load_rig(CONFIGS / "hall_10_6.yaml").as_dict()
    document["drives"]["profile"] = "akd"
    rig = Rig.from_dict(document)
    start = rig.home
    turned = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix() @ start.rotation
    aside, below = np.array([0.0, 0.02, 0.0]), rig.half_size[2] + 0.020 + 0.1
    goal = Pose(start.position + (0.0 if angle > 1e-6 else aside), turned)
    under = start.position - np.array([0.0, 0.0, below])
    ball = {"name": "ball", "sphere": {"radius_mm": 100}, "position_mm": (under * 1e3).tolist()}
    hall = load_scene(CONFIGS / "hall_pillar.yaml").as_dict()
    hall |= {"obstacles": [ball], "clearance": {"obstacle_mm": 5, "self_mm": 15}}
    scene = Scene.from_dict(hall).changed(start=start, goal=goal)
    plan = plan_from_waypoints(rig, scene, [start, goal])
    if passes:
        prepare_plan(plan, rig)
    else:
        with pytest.raises(Refused, match=r"without its master .* 26[.]6 mm") as refused:
            prepare_plan(plan, rig)
        assert "mm/s along a path that rotates the platform; its inertia" in refused.value.why
