"""Rigs, scenes and plans as objects of a script or a notebook."""

from __future__ import annotations

import copy
import math
import pickle
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
import yaml

import calibration
import cdpr
from executor.cameras.sources import choose_camera
from executor.doctor import check_rig
from executor.homing import use_rig_file_counts
from executor.jogging import jog_cable
from model.files.documents import PoseDocument
from model.files.scene_file import StopDocument
from model.kinematics import cable_lengths, forward_kinematics
from model.rig import rig_from_document
from model.statics.gravity import weight_wrench

CONFIGS = Path(__file__).parents[2] / "configs"


@pytest.fixture(scope="module")
def rig() -> cdpr.Rig:
    return cdpr.load_rig(str(CONFIGS / "gachon_8_6.yaml"))


@pytest.fixture(scope="module")
def scene() -> cdpr.Scene:
    return cdpr.load_scene(CONFIGS / "environment_1.yaml")


@pytest.fixture(scope="module")
def plan(rig: cdpr.Rig, scene: cdpr.Scene) -> cdpr.Plan:
    return cdpr.plan(rig, scene, rounds=12, seed=3)


def test_a_rig_at_a_pose_balances_its_weight(rig: cdpr.Rig) -> None:
    posed = rig.at(rig.home)
    np.testing.assert_array_equal(posed.lengths, cable_lengths(rig, rig.home))
    residual = posed.structure_matrix @ posed.tensions + weight_wrench(rig, rig.home)
    assert np.abs(residual).max() < 1e-6
    assert posed.is_wrench_feasible
    assert 0.0 < posed.dexterity < 1.0
    assert not posed.tensions.flags.writeable


def arrays_in(thing: object, seen: set[int]) -> Iterator[np.ndarray]:
    """Every array that an object holds, at any depth."""
    if id(thing) in seen:
        return
    seen.add(id(thing))
    if isinstance(thing, np.ndarray):
        yield thing
    parts = list(thing) if isinstance(thing, tuple | list) else []
    if is_dataclass(thing):
        parts = [getattr(thing, one.name) for one in fields(thing)]
    for part in parts:
        yield from arrays_in(part, seen)


@pytest.mark.parametrize(
    "copied",
    [copy.copy, copy.deepcopy, lambda thing: pickle.loads(pickle.dumps(thing))],
    ids=["copy", "deepcopy", "pickle"],
)
def test_no_array_of_a_copy_can_be_written_to(
    plan: cdpr.Plan, copied: Callable[[Any], Any]
) -> None:
    hashes = plan.rig.plan_hash, plan.rig.hash, plan.scene.hash
    hall = cdpr.load_scene(CONFIGS / "hall_pillar.yaml")
    for thing in (plan, plan.rig, hall, plan.waypoints[0], plan.rig.at(plan.rig.home)):
        arrays = list(arrays_in(copied(thing), set()))
        assert len(arrays) >= 2
        assert not any(array.flags.writeable for array in arrays)
    again = copied(plan)
    assert (again.rig.plan_hash, again.rig.hash, again.scene.hash) == hashes
    assert again.waypoints == plan.waypoints
    assert cdpr.check(again).passed


@pytest.mark.parametrize(
    "change",
    [
        lambda document: document.outlets_mm[0].__setitem__(0, 9999.0),
        lambda document: document.outlets_mm.append([0.0, 0.0, 0.0]),
        lambda document: document.winches.sort(),
        lambda document: document.platform.size_mm.__imul__(2),
        lambda document: copy.deepcopy(document).anchors_mm.pop(),
        lambda document: pickle.loads(pickle.dumps(document)).anchors_mm.reverse(),
        lambda document: document.model_copy(
            update={"outlets_mm": [list(p) for p in document.outlets_mm]}
        ).outlets_mm[0].clear(),
    ],
)  # fmt: skip
def test_the_document_of_a_rig_cannot_be_changed_behind_its_hash(
    rig: cdpr.Rig, change: Callable[[Any], object]
) -> None:
    fresh = rig.with_bus()
    with pytest.raises(TypeError, match="cannot be changed"):
        change(fresh.document)
    assert fresh.plan_hash == rig.plan_hash


@pytest.mark.parametrize("name", [path.name for path in CONFIGS.glob("*.yaml")])
def test_a_rig_or_scene_is_made_again_from_its_own_keys(name: str) -> None:
    kind, load = (cdpr.Rig, cdpr.load_rig) if "winches" in (CONFIGS / name).read_text() else (
        cdpr.Scene, cdpr.load_scene
    )  # fmt: skip
    loaded: Any = load(CONFIGS / name)
    assert kind.from_dict(loaded.as_dict()).hash == loaded.hash
    in_file = yaml.safe_load((CONFIGS / name).read_text())
    assert kind.from_dict(in_file).hash == loaded.hash


@pytest.fixture(scope="module")
def bent(rig: cdpr.Rig, scene: cdpr.Scene) -> cdpr.Plan:
    """A plan of three waypoints, made without a search."""
    ends = np.add(scene.start.position, [(0.0, 0.0, 0.0), (0.0, 0.0, 0.01), (0.01, 0.0, 0.02)])
    waypoints = [cdpr.Pose.level(position) for position in ends]
    return cdpr.plan_from_waypoints(rig, scene.changed(goal=waypoints[-1]), waypoints)


def altered_copies(rig: cdpr.Rig, scene: cdpr.Scene, bent: cdpr.Plan) -> dict[str, Any]:
    """Copies with other values than their documents, by the field that was changed."""
    beside = cdpr.Pose.level(np.add(bent.waypoints[1].position, (0.0, 0.0, 0.005)))
    return {
        "anchors": replace(rig, anchors=1.6 * rig.anchors),
        "mass": replace(rig, mass=3.0 * rig.mass),
        "motion.speed": replace(rig, motion=replace(rig.motion, speed=1.0)),
        "winches[2].home_counts": replace(
            rig,
            winches=(*rig.winches[:2], replace(rig.winches[2], home_counts=7), *rig.winches[3:]),
        ),
        "obstacle_clearance": replace(scene, obstacle_clearance=0.05),
        "obstacles": replace(scene, obstacles=()),
        "goal.position": replace(scene, goal=scene.start),
        "waypoints[1].position": replace(
            bent, waypoints=(bent.waypoints[0], beside, *bent.waypoints[2:])
        ),
        "stops": replace(bent, stops=(1,)),
        "rig.mass": replace(bent, rig=replace(rig, mass=3.0 * rig.mass)),
    }


@pytest.mark.parametrize(
    "field",
    [
        *("anchors", "mass", "motion.speed", "winches[2].home_counts", "obstacle_clearance"),
        *("obstacles", "goal.position", "waypoints[1].position", "stops", "rig.mass"),
    ],
)
def test_a_copy_with_other_values_is_refused_with_how_to_make_one(
    rig: cdpr.Rig, scene: cdpr.Scene, bent: cdpr.Plan, field: str, tmp_path: Path
) -> None:
    """It had passed the check, and another path was saved, or another rig moved."""
    other, refused = altered_copies(rig, scene, bent)[field], tmp_path / "refused"
    ends = [scene.start, scene.goal]
    calls: list[Callable[[], object]]
    if isinstance(other, cdpr.Rig):
        calls = [
            lambda: cdpr.plan(other, scene, rounds=1),
            lambda: cdpr.plan_from_waypoints(other, scene, ends),
            lambda: cdpr.check(bent, other),
            lambda: cdpr.run(bent, other, folder=refused, cameras=[], realtime=False),
            lambda: cdpr.home(other, at_home=True, realtime=False),
            lambda: cdpr.jog(other, None, to_home=True, realtime=False),
            lambda: jog_cable(other, 1, 0.001, realtime=False),
            lambda: cdpr.workspace_map(other, workers=1),
            lambda: cdpr.measurement_poses(other, scene),
            lambda: cdpr.track(other, "absent"),
            lambda: cdpr.calibrate_rig(other, "absent"),
            lambda: cdpr.locate_camera(other, "absent"),
            lambda: cdpr.locate_tags(other, "absent"),
            lambda: other.with_bus("virtual", "other"),
            lambda: other.with_tag_detector("apriltag"),
            lambda: other.with_calibration(),
        ]
        step = "cdpr.Rig.from_dict({**rig.as_dict(), ...}), rig.with_bus or rig.with_calibration"
    elif isinstance(other, cdpr.Scene):
        calls = [
            lambda: cdpr.plan(rig, other, rounds=1),
            lambda: cdpr.plan_from_waypoints(rig, other, ends),
            lambda: cdpr.jog(rig, other, to_home=True, realtime=False),
            lambda: cdpr.workspace_map(rig, other, workers=1),
            lambda: cdpr.measurement_poses(rig, other),
            other.changed,
        ]
        step = "scene.changed(...), or cdpr.Scene.from_dict({**scene.as_dict(), ...})"
    else:
        calls = [
            lambda: cdpr.check(other),
            lambda: cdpr.run(other, rig, folder=refused, cameras=[], realtime=False),
            lambda: other.save(refused),
        ]
        step = "cdpr.plan_from_waypoints"
    for call in calls:
        kind = type(other).__name__
        with pytest.raises(cdpr.BadInput, match=re.escape(f"`{field}` of a {kind} is")) as caught:
            call()
        assert step in caught.value.next_step
    assert not refused.exists()


def test_a_copy_with_the_same_values_is_used(
    rig: cdpr.Rig, scene: cdpr.Scene, bent: cdpr.Plan
) -> None:
    same = replace(rig, anchors=rig.anchors.copy(), document=rig.document.model_copy(deep=True))
    assert cdpr.check(replace(bent, rig=same), same).passed
    assert same.with_bus().plan_hash == rig.plan_hash
    assert pickle.loads(pickle.dumps(scene)).changed().hash == scene.hash


def test_a_rig_is_varied_in_memory_and_checked_like_a_file(rig: cdpr.Rig) -> None:
    data = rig.as_dict()
    wider = np.array(data["outlets_mm"]) * [1.1, 1.1, 1.0]
    varied = cdpr.Rig.from_dict(
        {**data, "outlets_mm": wider, "anchors_mm": tuple(map(tuple, data["anchors_mm"]))}
    )
    np.testing.assert_allclose(varied.outlets, rig.outlets * [1.1, 1.1, 1.0])
    assert varied.plan_hash != rig.plan_hash
    data["outlets_mm"][0][0] = 1e4  # its own lists, which changes no rig
    assert rig.as_dict()["outlets_mm"] != data["outlets_mm"]
    data.update(platfrom={}, anchors_mm=data["anchors_mm"][:-1])
    data["cables"]["min_tension_n"] = np.nan
    with pytest.raises(cdpr.BadInput) as refused:
        cdpr.Rig.from_dict(data)
    for word in ("Rig.from_dict: platfrom:", "'platform'", "cables.min_tension_n", "finite"):
        assert word in str(refused.value)
    for wrong in (None, [1], "rig.yaml", {3: 4}, {}):
        with pytest.raises(cdpr.BadInput):
            cdpr.Rig.from_dict(wrong)  # type: ignore[arg-type]
    with pytest.raises(cdpr.BadInput, match="this is a rig file, not a scene file"):
        cdpr.Scene.from_dict(rig.as_dict())
    for version in (2, True):
        with pytest.raises(cdpr.BadInput, match=f"schema version {version}"):
            cdpr.Rig.from_dict({**rig.as_dict(), "schema_version": version})
    data = rig.as_dict()
    data["itself"] = data
    with pytest.raises(cdpr.BadInput, match="contains itself"):
        cdpr.Rig.from_dict(data)


@pytest.mark.parametrize("as_rows", [False, True])
def test_masked_values_are_not_used_as_numbers(rig: cdpr.Rig, as_rows: bool) -> None:
    def masked(values: Any) -> Any:
        array = np.ma.array(values, mask=np.zeros(np.shape(values), dtype=bool))
        array[(0,) * array.ndim] = np.ma.masked
        return list(array) if as_rows else array

    home, camera = rig.home, rig.camera()
    image = masked(np.zeros((camera.height, camera.width), np.uint8))
    for call in (
        lambda: cdpr.Pose.level(masked(home.position)),
        lambda: cdpr.Pose(home.position, masked(home.rotation)),
        lambda: cdpr.Pose.from_quaternion(home.position, masked(home.quaternion)),
        lambda: home.apply(masked(rig.anchors)),
        lambda: rig.tensions_by(masked(np.full(8, 10.0))),
        lambda: rig.torques_by(masked(np.full(8, 10.0))),
        lambda: forward_kinematics(rig, masked(cable_lengths(rig, home))),
        lambda: cdpr.jog(rig, None, by=masked([0.001, 0.0, 0.0]), realtime=False),
        lambda: cdpr.workspace_map(rig, lower=masked(rig.workspace_lower)),
        lambda: cdpr.workspace_map(rig, rotation=masked(home.rotation)),
        *(() if as_rows else (lambda: cdpr.Tracker(rig, camera).observe(image, 0.0),)),
    ):
        with pytest.raises(cdpr.BadInput, match="masked values"):
            call()
    data = {**rig.as_dict(), "outlets_mm": masked(rig.outlets * 1e3)}
    with pytest.raises(cdpr.BadInput, match="outlets_mm"):
        cdpr.Rig.from_dict(data)
    bare = np.ma.array(home.position, mask=[False, False, False])
    assert cdpr.Pose.level(bare).position.tolist() == home.position.tolist()


@pytest.mark.parametrize("masked", [np.ma.masked, *(np.ma.array(x, mask=True) for x in (1.0, 1))])
@pytest.mark.parametrize(
    "name",
    [
        *("plan " + name for name in ("budget", "rounds", "seed", "longest", "clearance")),
        *("plan weights", "workspace_map slices", "workspace_map step", "workspace_map workers"),
        *("workspace_map characteristic_length", "jog_cable cable", "jog_cable length"),
        *("calibrate_rig wanted", "calibrate_rig tilt", "locate_tags wanted", "track pictures"),
        *("home " + name for name in ("tension", "limit", "reach", "speed", "pictures")),
        *("jog speed", "measurement_poses dwell", "plan free_rotation", "changed clearance"),
    ],
)
def test_a_masked_scalar_is_not_the_number_behind_its_mask(
    rig: cdpr.Rig, scene: cdpr.Scene, name: str, masked: Any
) -> None:
    """``np.ma.masked`` as a clearance had planned with 0 mm."""
    inside = {"plan weights": {"length": masked}, "workspace_map slices": [("z", masked)]}
    with pytest.raises(cdpr.BadInput, match=r"must be .*, it is (masked|--)"):
        calls_with_a_wrong_argument(name)(rig, scene, inside.get(name, masked))


def test_a_pose_that_cannot_be_held_says_so_and_has_no_tensions(rig: cdpr.Rig) -> None:
    above = cdpr.Pose.level(rig.outlets.max(axis=0) + 0.2)
    posed = rig.at(above)
    assert not posed.is_wrench_feasible
    assert np.isnan(posed.tensions).all()
    assert "not feasible" in repr(posed)


def test_another_bus_changes_nothing_that_a_plan_rests_on(rig: cdpr.Rig) -> None:
    other = rig.with_bus("socketcan", "can0")
    bus = other.document.bus
    assert (bus.interface, bus.channel) == ("socketcan", "can0")
    assert other.plan_hash == rig.plan_hash
    assert rig.document.bus.interface == "virtual"


@pytest.mark.parametrize("wrong", [1, 1.5, b"can0", [], True, "x" * 201])
def test_a_bus_that_cannot_be_is_refused_when_it_is_named(rig: cdpr.Rig, wrong: Any) -> None:
    """``with_bus("virtual", 1)`` had failed later, in whatever used the rig."""
    with pytest.raises(cdpr.BadInput, match=r"Rig\.with_bus: channel: "):
        rig.with_bus("virtual", wrong)
    with pytest.raises(cdpr.BadInput, match=r"Rig\.with_bus: interface: "):
        rig.with_bus("" if wrong == "x" * 201 else wrong)


def test_a_camera_is_found_by_its_name_or_refused_with_the_names_that_exist(rig: cdpr.Rig) -> None:
    assert rig.camera().name == rig.camera("front").name == "front"
    with pytest.raises(cdpr.BadInput, match="name one of: front"):
        rig.camera("rear")


def test_the_same_rounds_and_seed_give_the_same_path(
    rig: cdpr.Rig, scene: cdpr.Scene, plan: cdpr.Plan
) -> None:
    again = cdpr.plan(rig, scene, rounds=[12], seed=3)
    assert again.document.waypoints == plan.document.waypoints


@pytest.mark.parametrize(
    "changes",
    [
        {"rounds": np.int64(12)},
        {"rounds": np.array([12])},
        {"rounds": [np.int32(12)]},
        {"seed": np.int64(3)},
        {"seed": np.uint8(3)},
    ],
)
def test_integers_of_numpy_are_integers(
    rig: cdpr.Rig, scene: cdpr.Scene, plan: cdpr.Plan, changes: dict[str, Any]
) -> None:
    again = cdpr.plan(rig, scene, **{"rounds": 12, "seed": 3, **changes})
    assert again.document.waypoints == plan.document.waypoints
    assert again.document.planner == plan.document.planner


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"seed": 2**63}, "seed"),
        ({"seed": -1}, "seed"),
        ({"seed": 1.5}, "seed"),
        ({"rounds": 2.5}, "rounds"),
        ({"rounds": 2**31}, "rounds"),
        ({"rounds": ["12"]}, "rounds"),
        ({"seed": 2**63, "planner": "adaptive"}, "seed"),
        ({"max_iterations": 10.0, "planner": "adaptive"}, "max_iterations"),
    ],
)
def test_numbers_that_are_not_whole_or_out_of_range_are_refused(
    rig: cdpr.Rig, scene: cdpr.Scene, changes: dict[str, Any], word: str
) -> None:
    with pytest.raises(cdpr.BadInput, match=f"{word} must be a whole number"):
        cdpr.plan(rig, scene, **changes)


def test_the_largest_seed_is_written_to_the_plan_file(
    rig: cdpr.Rig, scene: cdpr.Scene, tmp_path: Path
) -> None:
    plan = cdpr.plan(rig, scene, seed=2**63 - 1, rounds=1)
    again = cdpr.load_plan(plan.save(tmp_path / "plan.json"))
    assert again.document.planner.seed == 2**63 - 1


def test_stops_of_a_path_are_integers_of_any_type(rig: cdpr.Rig, scene: cdpr.Scene) -> None:
    over = cdpr.Pose.level(np.add(scene.start.position, (0.0, 0.0, 0.01)))
    at = StopDocument(name="over", **PoseDocument.of(over).model_dump())
    around = scene.changed(goal=scene.start, stops=[at])
    poses = [scene.start, over, scene.start]
    plan = cdpr.plan_from_waypoints(rig, around, poses, stops=np.flatnonzero([0, 1, 0]))
    assert plan.stops == (1,)
    with pytest.raises(cdpr.BadInput, match="whole number"):
        cdpr.plan_from_waypoints(rig, around, poses, stops=[1.0])  # type: ignore[list-item]


def test_arguments_that_contradict_each_other_are_refused(rig: cdpr.Rig, scene: cdpr.Scene) -> None:
    with pytest.raises(cdpr.BadInput):
        cdpr.plan(rig, scene, budget=0.1, rounds=5)
    with pytest.raises(cdpr.BadInput):
        cdpr.plan(rig, scene, cost="length", weights={"length": 1.0})
    with pytest.raises(cdpr.BadInput, match="objective"):
        cdpr.plan(rig, scene, cost="beauty")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("call", "what", "step"),
    [
        (lambda rig, _: cdpr.run("hp.json", rig), "a Plan, not text", "cdpr.load_plan('hp.json')"),
        (lambda _, scene: cdpr.plan("r.yaml", scene), "a Rig", "cdpr.load_rig('r.yaml')"),
        (lambda rig, _: cdpr.plan(rig, Path("s.yaml")), "a Scene", "cdpr.load_scene('s.yaml')"),
        (lambda rig, scene: cdpr.plan(rig, scene, goal=[0, 0, 1]), "a Pose", "Pose.level("),
        (lambda rig, scene: cdpr.plan(rig, scene.document), "a Scene", "cdpr.load_scene(...)"),
        (lambda *_: cdpr.check("plan.json"), "a Plan, not text", "cdpr.load_plan('plan.json')"),
        (lambda rig, _: rig.at([0, 0, 1]), "a Pose, not list", "cdpr.Pose.level([0, 0, 1])"),
        (
            lambda rig, _: rig.with_calibration("x.yaml"),
            "a CalibrationResult, not text",
            "cdpr.load_calibration('x.yaml')",
        ),
        (
            lambda rig, scene: cdpr.plan_from_waypoints(rig, scene, [[0, 0, 1], [1, 0, 1]]),
            "a Pose, not list",
            "cdpr.Pose.level([0, 0, 1])",
        ),
        (lambda *_: cdpr.home("r.yaml", at_home=True), "a Rig", "cdpr.load_rig('r.yaml')"),
        (lambda *_: cdpr.jog("r.yaml", None, to_home=True), "a Rig", "cdpr.load_rig('r.yaml')"),
        (lambda *_: cdpr.status("r.yaml"), "a Rig, not text", "cdpr.load_rig('r.yaml')"),
        (lambda *_: cdpr.open_camera("r.yaml", 0), "a Rig", "cdpr.load_rig('r.yaml')"),
        (lambda *_: cdpr.track("r.yaml", 0), "a Rig, not text", "cdpr.load_rig('r.yaml')"),
        (lambda *_: cdpr.workspace_map("r.yaml"), "a Rig", "cdpr.load_rig('r.yaml')"),
        (lambda rig, scene: rig.at(rig.home, scene), "a Load, not Scene", "scene.load"),
        (
            lambda rig, _: rig.plot([0, 0, 1]),
            "a Pose, not list",
            "pass cdpr.Pose.level([0, 0, 1]), with the position in metres",
        ),
        (lambda rig, scene: rig.plot(scene), "a Pose, not Scene", "cdpr.Pose.level"),
        (lambda rig, _: rig.clipped([0, 0, 1]), "a Pose, not list", "Pose.level([0, 0, 1])"),
        (lambda _, scene: scene.changed(start=[0, 0, 1]), "a Pose, not list", "Pose.level("),
        (lambda rig, scene: cdpr.plan(rig, scene, listener=print), "a Listener", "subclass"),
        (lambda rig, _: cdpr.run(rig, rig), "a Plan, not Rig", "cdpr.load_plan(...)"),
        (lambda *_: cdpr.calibrate_camera("images", "board"), "a Board, not text", "Chessboard"),
        (lambda *_: cdpr.calibrate_rig("r.yaml", []), "a Rig", "cdpr.load_rig('r.yaml')"),
        (lambda *_: cdpr.locate_camera("r.yaml", 0), "a Rig", "cdpr.load_rig('r.yaml')"),
        (lambda *_: cdpr.locate_tags("r.yaml", 0), "a Rig", "cdpr.load_rig('r.yaml')"),
        (lambda *_: calibration.measure_readout("r.yaml", "v.mp4"), "a Rig", "cdpr.load_rig("),
        (
            lambda *_: calibration.locate_camera_by_another("r.yaml", "a", "b", reference="side"),
            "a Rig",
            "cdpr.load_rig('r.yaml')",
        ),
        (
            lambda *_: calibration.compare("first.yaml", "second.yaml"),
            "a ResultDocument, not text",
            "cdpr.load_calibration('first.yaml')",
        ),
        (lambda rig, _: cdpr.measurement_poses(rig, "s.yaml"), "a Scene", "load_scene('s.yaml')"),
    ],
)
def test_a_path_in_place_of_an_object_is_refused_with_what_loads_it(
    rig: cdpr.Rig, scene: cdpr.Scene, call: Callable[..., object], what: str, step: str
) -> None:
    with pytest.raises(cdpr.BadInput, match=f"expected {what}") as caught:
        call(rig, scene)
    assert step in caught.value.next_step


NUMBERS_OF_A_FIT = ("wanted", "length_deviation", "swivel_deviation", "imu_deviation", "tilt")


@pytest.mark.parametrize("number", [-1e-3, math.nan, math.inf, 1e300, "1", None])
def test_a_number_that_cannot_be_is_refused_before_anything_is_read(
    rig: cdpr.Rig, scene: cdpr.Scene, number: Any
) -> None:
    """A fit takes minutes, and the result is not written."""
    board = cdpr.Chessboard(9, 6, 0.02)
    calls = {
        f"{name} must be": partial(cdpr.calibrate_rig, rig, "absent", **{name: number})
        for name in NUMBERS_OF_A_FIT
    }
    for text, call in {
        **calls,
        "deviation of outlets must be": partial(
            cdpr.calibrate_rig, rig, "absent", deviations={"outlets": number}
        ),
        "unknown parameter group 'outlet'": partial(
            cdpr.calibrate_rig, rig, "absent", deviations={"outlet": 1e-3}
        ),
        "a pose deviation must be": partial(
            cdpr.calibrate_rig, rig, "absent", pose_deviations=(1e-3, number)
        ),
        "must be two numbers": partial(cdpr.calibrate_rig, rig, "absent", pose_deviations=(1e-3,)),
        "reflector must be": partial(cdpr.calibrate_rig, rig, "absent", reflector=(0, 0, math.nan)),
        "wanted must be": partial(cdpr.calibrate_camera, "absent", board, wanted=number),
        "wanted must": partial(cdpr.locate_camera, rig, "absent", wanted=number),
        "wanted mus": partial(cdpr.locate_tags, rig, "absent", wanted=number),
        "wanted mu": partial(calibration.measure_readout, rig, "absent", wanted=number),
        "wanted m": partial(
            calibration.locate_camera_by_another, rig, "a", "b", reference="side", wanted=number
        ),
        "dwell must be": partial(cdpr.measurement_poses, rig, scene, dwell=number),
        "tilt must b": partial(cdpr.measurement_poses, rig, scene, tilt=number),
    }.items():
        with pytest.raises(cdpr.BadInput, match=text):
            call()


@pytest.mark.parametrize(
    "call",
    [
        lambda rig: cdpr.track(rig, ""),
        lambda rig: cdpr.track(rig, "synthetic", overlay=""),
        lambda rig: cdpr.open_camera(rig, ""),
        lambda rig: cdpr.locate_tags(rig, ""),
        lambda rig: cdpr.locate_camera(rig, ""),
        lambda rig: cdpr.locate_camera(rig, "absent", poses=""),
        lambda rig: cdpr.calibrate_camera("", cdpr.Chessboard(9, 6, 0.02)),
        lambda rig: cdpr.calibrate_camera(".", cdpr.Chessboard(9, 6, 0.02), output=""),
        lambda rig: calibration.measure_readout(rig, ""),
        lambda _: calibration.calibrate_camera_from_corners("", (1280, 720)),
        lambda rig: cdpr.calibrate_rig(rig, ""),
        lambda rig: cdpr.calibrate_rig(rig, [""]),
        lambda rig: cdpr.home(rig, camera=""),
        lambda _: cdpr.load_rig(""),
        lambda _: cdpr.load_run(""),
        lambda _: cdpr.report(""),
    ],
)
def test_an_empty_path_is_not_the_current_folder(
    rig: cdpr.Rig, call: Callable[..., object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(CONFIGS.parent / "examples/rig_session/pictures", tmp_path / "here")
    monkeypatch.chdir(tmp_path / "here")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(cdpr.BadInput, match="is empty"):
        call(rig)
    assert sorted(tmp_path.rglob("*")) == before


WRONG: list[Any] = [
    *(None, True, 3, -1, 1.5, math.nan, math.inf, 10**30, "x", "", b"x", object(), print),
    *([], [None], ["x"], [[1], [2, 3]], {}, {"x": 1}, {"length": "1"}, {"z": 0.4}, ("z", 0.4)),
    *([("q", 0.4)], [("Z", 0.4)], [("xy", 0.1)], [("", 0.4)], [(2, 0.4)], [("z", "0.4")]),
    *(np.zeros(3), np.zeros((3, 3)), np.ones((3, 3)), np.array([0.01]), np.array(["x"])),
]


def calls_with_a_wrong_argument(name: str) -> Callable[[cdpr.Rig, cdpr.Scene, Any], object]:
    """A quick call of the library with one argument replaced."""
    verb, _, argument = name.partition(" ")
    match verb:
        case "plan":
            return lambda rig, scene, x: cdpr.plan(rig, scene, **{"rounds": 1, argument: x})
        case "waypoints":
            return lambda rig, scene, x: cdpr.plan_from_waypoints(
                rig, scene, **{"waypoints": [scene.start, scene.start], argument: x}
            )
        case "workspace_map":
            quick = {"slices": [("z", 0.4)], "volume": False, "step": 0.2, "workers": 1}
            return lambda rig, scene, x: cdpr.workspace_map(rig, scene, **{**quick, argument: x})
        case "changed":
            return lambda _, scene, x: scene.changed(**{argument: x})
        case "calibrate_rig" | "locate_camera" | "locate_tags" | "track":
            return lambda rig, _, x: getattr(cdpr, verb)(rig, "absent", **{argument: x})
        case "measure_readout":
            return lambda rig, _, x: calibration.measure_readout(
                rig, **{"source": "absent", argument: x}
            )
        case "locate_camera_by_another":
            quick = {"source": "a", "reference_source": "b", "reference": "front"}
            return lambda rig, _, x: calibration.locate_camera_by_another(
                rig, **{**quick, argument: x}
            )
        case "calibrate_camera_from_corners":
            quick = {"corners": "absent", "size": (1280, 720)}
            return lambda *given: calibration.calibrate_camera_from_corners(
                **{**quick, argument: given[-1]}
            )
        case "compare":
            return lambda *given: calibration.compare(given[-1], given[-1])
        case "calibrate_camera":
            board = cdpr.Chessboard(9, 6, 0.02)
            return lambda *given: cdpr.calibrate_camera("absent", board, **{argument: given[-1]})
        case "measurement_poses":
            quick = {"count": 1, "candidates": 1}
            return lambda rig, scene, x: cdpr.measurement_poses(
                rig, scene, **{**quick, argument: x}
            )
        case "home":
            refused = {"confirm": lambda _: False, "at_home": True}
            return lambda rig, _, x: cdpr.home(rig, **{**refused, argument: x})
        case "jog":
            refused = {"confirm": lambda _: False, "by": (0.0, 0.0, 0.001)}
            return lambda rig, _, x: cdpr.jog(rig, None, **{**refused, argument: x})
        case "jog_cable":
            refused = {"confirm": lambda _: False, "cable": 1, "length": 0.001}
            return lambda rig, _, x: jog_cable(**{"rig": rig, **refused, argument: x})
        case "tracker":
            return lambda rig, _, x: cdpr.Tracker(
                **{"rig": rig, "camera": rig.camera(), argument: x}
            )
        case "observe":
            image = np.zeros((720, 1280), np.uint8)
            quick = {"image": image, "time": 0.0, "by_drives": None}
            return lambda rig, _, x: cdpr.Tracker(rig, rig.camera()).observe(
                **{**quick, argument: x}
            )
        case "chessboard":
            return lambda *given: cdpr.Chessboard(
                **{"columns": 9, "rows": 6, "square": 0.02, argument: given[-1]}
            )
        case "rig":
            return lambda rig, _, x: getattr(rig, argument)(x)
        case _:
            return lambda *given: getattr(cdpr, verb)(given[-1])


@pytest.mark.parametrize(
    "name",
    [
        *("plan " + name for name in ("planner", "cost", "weights", "budget", "rounds", "seed")),
        *("plan " + name for name in ("longest", "free_rotation", "start", "goal", "via")),
        *("plan " + name for name in ("from_run", "clearance", "mode", "max_iterations")),
        *("waypoints waypoints", "waypoints stops", "waypoints author"),
        *("workspace_map " + name for name in ("slices", "step", "rotation", "workers")),
        *("changed " + name for name in ("start", "goal", "clearance", "stops", "payload")),
        *("calibrate_rig " + name for name in (*NUMBERS_OF_A_FIT, "deviations")),
        *("calibrate_rig pose_deviations", "calibrate_rig reflector"),
        *("calibrate_camera " + name for name in ("wanted", "distance", "lens", "name")),
        *("measure_readout " + name for name in ("source", "camera", "rate", "speed", "wanted")),
        *(
            "locate_camera_by_another " + name
            for name in ("source", "camera", "reference", "board")
        ),
        *("calibrate_camera_from_corners " + name for name in ("corners", "size", "name", "lens")),
        "compare",
        *("locate_camera wanted", "locate_tags wanted", "track pictures", "track overlay"),
        *("measurement_poses " + name for name in ("tilt", "turn", "dwell")),
        *("home " + name for name in ("tension", "limit", "reach", "speed", "pictures")),
        *("home simulated_slack", "home camera", "home folder", "jog_cable folder"),
        *("jog speed", "jog by"),
        *("rig at", "rig clipped", "rig with_bus", "workspace_map characteristic_length"),
        *("jog_cable " + name for name in ("rig", "cable", "length", "limit", "speed")),
        *("tracker rig", "tracker camera", "observe image", "observe time", "observe by_drives"),
        *("chessboard " + name for name in ("columns", "rows", "square")),
        *("load_rig", "load_scene", "load_plan", "load_run", "load_calibration", "report"),
    ],
)
def test_only_errors_of_cdpr_come_from_wrong_arguments(
    rig: cdpr.Rig, scene: cdpr.Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    call = calls_with_a_wrong_argument(name)
    for value in WRONG:
        with suppress(cdpr.CdprError):
            call(rig, scene, value)


def test_a_wrong_argument_is_named_with_its_value(
    rig: cdpr.Rig, scene: cdpr.Scene, plan: cdpr.Plan
) -> None:
    on_bus = rig.with_bus("udp_multicast", "239.74.163.77:43999")

    async def coroutine(_event: object) -> None: ...

    for call, text in (
        (lambda: cdpr.plan(rig, scene, budget="1"), "budget must be a number [s], it is '1' (str)"),
        (lambda: cdpr.plan(rig, scene, longest=[1.0]), "longest must be a number [m]"),
        (lambda: cdpr.plan(rig, scene, free_rotation="no"), "free_rotation must be True or False"),
        (lambda: cdpr.plan(rig, scene, via=None), "via must be a list, it is None"),
        (lambda: cdpr.plan(rig, scene, via=rig.home), "via must be a list, it is Pose("),
        (lambda: cdpr.plan(rig, scene, weights="length=1"), "the weights must be a mapping"),
        (lambda: cdpr.Chessboard("9", 6, 0.02), "columns must be a whole number, it is '9' (str)"),
        (lambda: cdpr.Chessboard(9.0, 6.0, 0.02), "columns must be a whole number, it is 9.0"),
        (lambda: cdpr.Tracker(rig, "front"), "expected a Camera, not text"),
        (lambda: cdpr.Tracker(rig, rig.camera()).observe(None, 0.0), "not NoneType"),
        (lambda: cdpr.track(rig, {}), "no image source is given"),
        (lambda: jog_cable(rig, 1.0, 0.001), "cable must be a whole number"),
        (
            lambda: cdpr.workspace_map(rig, characteristic_length="0.1"),
            "characteristic_length must be a number [m], it is '0.1' (str)",
        ),
        (lambda: cdpr.workspace_map(rig, volume="no"), "volume must be True or False"),
        (lambda: cdpr.workspace_map(rig, workers=0), "workers must be a whole number from 1"),
        (lambda: cdpr.plan(rig, scene, rounds=True), "rounds must be a whole number from 1"),
        (lambda: cdpr.plan(rig, scene, seed=False), "the seed must be a whole number from 0"),
        (lambda: cdpr.workspace_map(rig, slices=("z", 0.4)), "'z' is not a slice"),
        (lambda: cdpr.workspace_map(rig, slices=[("xy", 0.1)]), "('xy', 0.1) is not a slice"),
        (lambda: cdpr.workspace_map(rig, rotation=np.ones((3, 3))), "not a rotation"),
        (lambda: cdpr.load_rig(None), "the path must be a str or a pathlib.Path, it is None"),
        (lambda: scene.changed(payload=1.0), "expected a Payload, not float"),
        (lambda: scene.changed(stops=[rig.home]), "expected a StopDocument, not Pose"),
        (lambda: scene.changed(stops=[{"name": "a"}]), "expected a StopDocument, not dict"),
        (lambda: scene.changed(stops="x"), "stops must be a list, it is 'x'"),
        (lambda: cdpr.run(plan, rig, supervisor=3), "expected a Supervisor, not int"),
        (lambda: cdpr.run(plan, rig, on_event=coroutine), "a function, without `async`, it is <f"),
        (lambda: cdpr.run(plan, rig, folder="a\0b"), "without a null character, it is 'a\\x00b'"),
        (lambda: cdpr.reset(on_bus, listener=print), "expected a Listener, not builtin"),
        (lambda: cdpr.release(on_bus, listener=print), "expected a Listener, not builtin"),
        (lambda: check_rig("rig.yaml"), "expected a Rig, not text"),
        (lambda: use_rig_file_counts("rig.yaml"), "expected a Rig, not text"),
        (lambda: use_rig_file_counts(on_bus, confirm="y"), "confirm must be a function"),
        (lambda: jog_cable(rig, "1", 0.001), "it is '1'"),
        (lambda: plan.save(3), "the path must be a str or a pathlib.Path, it is 3 (int)"),
    ):
        with pytest.raises(cdpr.BadInput, match=re.escape(text)):
            call()  # type: ignore[no-untyped-call]


def test_methods_refuse_arguments_of_another_type(rig: cdpr.Rig) -> None:
    image, tracker = np.zeros((720, 1280), np.uint8), cdpr.Tracker(rig, rig.camera())
    for call, text in (
        (lambda: rig.home.distance_to([0, 0, 0]), "expected a Pose, not list"),
        (lambda: rig.home.angle_to(np.eye(3)), "expected a Pose, not ndarray"),
        (lambda: rig.home.compose(3), "expected a Pose, not int"),
        (lambda: rig.tensions_by([1, 2]), "torques must be a number for each of 8 cables"),
        (lambda: rig.torques_by("x"), "tensions must be a number for each of 8 cables"),
        (lambda: rig.torques_by(["1"] * 8), "tensions must be a number for each of 8 cables"),
        *((partial(rig.home.apply, x), "points must be numbers") for x in ([1, 2], None, 1.0, "x")),
        (lambda: cdpr.Pose.level(["1", "2", "3"]), "does not consist of numbers"),
        (lambda: cdpr.Pose.level(np.array(["1", "2", "3"])), "does not consist of numbers"),
        (lambda: cdpr.Pose.level([1.0 + 1.0j, 0.0, 0.0]), "does not consist of numbers"),
        (lambda: cdpr.Pose.level(np.zeros(3, complex)), "does not consist of numbers"),
        (lambda: tracker.observe(image, math.nan), "time must be a finite number [s]"),
        (lambda: tracker.observe(image, math.inf), "time must be a finite number [s]"),
    ):
        with pytest.raises(cdpr.BadInput, match=re.escape(text)):
            call()  # type: ignore[no-untyped-call]
    np.testing.assert_allclose(rig.tensions_by(rig.torques_by(np.full((2, 8), 10.0))), 10.0)


def test_poses_to_pass_come_from_any_iterable(rig: cdpr.Rig, scene: cdpr.Scene) -> None:
    """The poses of an iterator had been left out without a word."""
    between = np.add(scene.start.position, [(0.0, 0.0, 0.01), (0.01, 0.0, 0.02)])
    listed = [cdpr.Pose.level(position) for position in between]
    wanted = cdpr.plan(rig, scene, via=listed, rounds=1)
    assert len(wanted.stops) == 2
    for via in (iter(listed), map(cdpr.Pose.level, between), np.array(listed, dtype=object)):
        found = cdpr.plan(rig, scene, via=via, rounds=1)  # type: ignore[arg-type]
        assert found.document.waypoints == wanted.document.waypoints
        assert found.stops == wanted.stops


def test_messages_of_the_library_name_what_a_script_passes(rig: cdpr.Rig) -> None:
    bare = rig_from_document(rig.document.model_copy(update={"cameras": []}))
    with pytest.raises(cdpr.BadInput, match="no camera or no tags") as without:
        choose_camera(bare, None, False, True)
    with pytest.raises(cdpr.BadInput, match="no camera was named") as unnamed:
        choose_camera(rig, None, False, False)
    with pytest.raises(cdpr.BadInput, match="keeps no state") as virtual:
        cdpr.status(rig)
    with pytest.raises(cdpr.BadInput, match="exactly one") as unknown:
        cdpr.home(rig)
    with pytest.raises(cdpr.Refused, match=r"a jog of 60\.0 mm") as far:
        cdpr.jog(rig, None, by=[0.0, 0.0, 0.06])
    with pytest.raises(cdpr.BadInput, match="no motion given") as unmoved:
        cdpr.jog(rig, None)
    for caught, option, argument in (
        (unmoved, "--help", "in Python pass by= or to_home=True, or use executor.jog_cable()"),
        (without, "--no-camera", "cameras=[]"),
        (unnamed, "--camera INDEX", "cameras=INDEX"),
        (virtual, "--interface", "rig.with_bus"),
        (unknown, "--at-home", "at_home=True"),
        (far, "cdpr plan --start-mm", "cdpr.plan(start=)"),
    ):
        assert option in caught.value.next_step
        assert argument in caught.value.next_step


def test_a_rig_without_a_camera_is_referred_to_the_example(rig: cdpr.Rig) -> None:
    bare = rig_from_document(rig.document.model_copy(update={"cameras": []}))
    with pytest.raises(cdpr.BadInput, match="no camera") as caught:
        bare.camera()
    (page,) = re.findall(r"docs/[a-z-]+\.md", caught.value.next_step)
    (title,) = re.findall(r"\((.+)\)", caught.value.next_step)
    assert f"## {title}\n" in (CONFIGS.parent / page).read_text()


def test_a_saved_plan_is_loaded_and_proved_again(
    rig: cdpr.Rig, plan: cdpr.Plan, tmp_path: Path
) -> None:
    again = cdpr.load_plan(str(plan.save(tmp_path / "plan.json")))
    report = cdpr.check(again, rig)
    assert report.passed
    assert report.proved_obstacle_clearance >= again.scene.obstacle_clearance
    assert report.length == pytest.approx(plan.length)


def test_a_plan_is_not_checked_for_another_rig(plan: cdpr.Plan) -> None:
    with pytest.raises(cdpr.BadInput, match="was made for the rig"):
        cdpr.check(plan, cdpr.load_rig(CONFIGS / "open_frame_8_6.yaml"))


def test_more_clearance_than_the_scene_asks_is_kept(rig: cdpr.Rig, scene: cdpr.Scene) -> None:
    plan = cdpr.plan(rig, scene, rounds=12, clearance=0.015)
    assert cdpr.check(plan).proved_obstacle_clearance >= 0.015


def test_objects_show_themselves_briefly_and_in_a_notebook(
    rig: cdpr.Rig, scene: cdpr.Scene, plan: cdpr.Plan
) -> None:
    for shown in (rig, scene, plan, cdpr.check(plan), rig.at(rig.home)):
        assert len(repr(shown)) < 300
        assert repr(shown).startswith("<")
    for shown in (rig, scene, plan, cdpr.check(plan), rig.at(rig.home)):
        assert shown._repr_html_().count("<tr>") >= 3


def test_names_from_files_are_escaped_in_a_notebook(scene: cdpr.Scene) -> None:
    odd = replace(scene, document=scene.document.model_copy(update={"name": "<script>"}))
    assert "<script>" not in odd._repr_html_()
    assert "&lt;script&gt;" in odd._repr_html_()


def test_figures_show_cables_obstacles_and_path(
    rig: cdpr.Rig, scene: cdpr.Scene, plan: cdpr.Plan
) -> None:
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    alone, among, path = rig.plot(), rig.plot(rig.home, scene), plan.plot()
    lines = [len(figure.axes[0].lines) for figure in (alone, among, path)]
    assert lines[0] >= rig.cable_count
    assert lines[0] < lines[1] < lines[2]
    plt.close("all")


def test_no_label_of_a_figure_is_cut_however_wide_and_low_the_robot_is() -> None:
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    wide = cdpr.load_rig(Path(__file__).parents[2] / "configs/hall_10_6.yaml")
    for scale in (1.0, 3.0):
        outlets = [[scale * x, scale * y, z] for x, y, z in wide.document.outlets_mm]
        document = wide.document.model_copy(update={"outlets_mm": outlets})
        figure = rig_from_document(document).plot()
        figure.canvas.draw()
        label = figure.axes[0].zaxis.label.get_window_extent()  # type: ignore[attr-defined]
        assert label.x1 <= figure.bbox.x1
    plt.close("all")


def test_faces_of_a_cylinder_are_drawn_with_one_number_of_corners(
    rig: cdpr.Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Matplotlib pads shorter faces with uninitialised memory, by which it scales the axes.
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    from model import figures

    drawn: list[list[Any]] = []

    class Kept(figures.Poly3DCollection):
        def __init__(self, faces: list[Any], **style: Any) -> None:
            drawn.append(faces)
            super().__init__(faces, **style)

    monkeypatch.setattr(figures, "Poly3DCollection", Kept)
    rig.plot(scene=cdpr.load_scene(CONFIGS / "hall_pillar.yaml"))
    plt.close("all")
    assert any(len(faces) > 6 for faces in drawn)
    assert all(len({len(face) for face in faces}) == 1 for faces in drawn)
