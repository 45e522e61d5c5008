"""Taught poses: file and list agree after any operation."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from cdpr.console.teach import MOST, TaughtPoses, scene_text
from model.errors import BadInput, CdprError, InvalidFile
from model.pose import Pose, matrix_from_rotation_vector
from model.rig import load_rig
from model.scene import empty_scene, load_scene, scene_from_document
from tests.cli.plans import RIG

STEP = st.tuples(
    st.sampled_from(["teach", "rename", "move", "forget"]), st.integers(0, 5), st.integers(0, 5)
)


def pose(k: int) -> Pose:
    return Pose.level(np.array([0.001 * k, -0.002 * k, 0.4 + 0.001 * k]))


@given(st.lists(STEP, max_size=25))
def test_list_and_file_agree_with_a_plain_list(
    tmp_path_factory: pytest.TempPathFactory, steps: list[tuple[str, int, int]]
) -> None:
    path = tmp_path_factory.mktemp("taught") / "console" / "poses.json"
    taught, names = TaughtPoses(path), list[str]()
    for number, (what, index, other) in enumerate(steps):
        name, new = f"pose {index}", f"pose {other}"
        expected = list(names)
        ok = name in names
        if what == "teach":
            ok = not ok
            expected.append(name)
        elif ok and what == "rename":
            ok = new == name or new not in names
            expected[names.index(name)] = new
        elif ok and what == "move":
            ok = other < len(names)
            expected.remove(name)
            expected.insert(other, name)
        elif ok:
            expected.remove(name)
        try:
            if what == "teach":
                taught.teach(name, pose(number))
            elif what == "rename":
                taught.rename(name, new)
            elif what == "move":
                taught.move(name, other)
            else:
                taught.forget(name)
        except BadInput:
            assert not ok
        else:
            assert ok
            names = expected
        assert [one["name"] for one in taught.as_dicts()] == names
        assert TaughtPoses(path).as_dicts() == taught.as_dicts()


def test_two_consoles_with_one_file_lose_no_pose_of_each_other(tmp_path: Path) -> None:
    first, second = (TaughtPoses(tmp_path / "poses.json") for _ in range(2))
    first.teach("a", pose(1))
    second.teach("b", pose(2))
    first.rename("b", "c")
    with pytest.raises(BadInput, match="no pose 'b'"):
        second.forget("b")
    second.move("c", 0)
    assert [one["name"] for one in TaughtPoses(tmp_path / "poses.json").as_dicts()] == ["c", "a"]


def test_blanks_around_a_name_distinguish_no_poses(tmp_path: Path) -> None:
    """They are not stored: "Go to" would then find the first of two poses of one name."""
    taught = TaughtPoses(tmp_path / "poses.json")
    taught.teach(" A", pose(1))
    taught.teach("B", pose(2))
    with pytest.raises(BadInput, match="there is a pose 'A' already"):
        taught.teach("A ", pose(3))
    with pytest.raises(BadInput, match="there is a pose 'A' already"):
        taught.rename("B", " A")
    taught.rename("A", "A ")
    assert [one["name"] for one in taught.as_dicts()] == ["A", "B"]


@pytest.mark.parametrize("second", ["A", " A"])
def test_a_file_with_two_poses_of_one_name_is_refused(tmp_path: Path, second: str) -> None:
    path = tmp_path / "poses.json"
    poses = [{"name": name, "position_mm": [0.0, 0.0, 400.0]} for name in ("A", "B", second)]
    path.write_text(json.dumps({"schema_version": 1, "poses": poses}))
    with pytest.raises(InvalidFile, match=r"poses\.json: poses: pose name 'A' appears twice"):
        TaughtPoses(path)


def test_they_become_a_scene_that_is_read_again(tmp_path: Path) -> None:
    taught = TaughtPoses(tmp_path / "poses.json")
    for k, name in enumerate(("above", "at the part", "goal")):
        taught.teach(name, pose(k))
    around = load_scene(RIG.parent / "environment_1.yaml")
    path = tmp_path / "taught.yaml"
    path.write_text(scene_text(taught.scene(around, "taught")))
    scene = load_scene(path)
    assert [stop.name for stop in scene.stops] == ["at the part"]
    assert scene.start.distance_to(pose(0)) < 1e-9
    assert scene.goal.distance_to(pose(2)) < 1e-9
    assert [one.name for one in scene.obstacles] == [one.name for one in around.obstacles]
    assert yaml.safe_load(path.read_text())["schema_version"] == 1


def test_orientations_that_differ_by_noise_are_made_equal(tmp_path: Path) -> None:
    """The planner of scenes without free rotation wants the very same orientation."""
    taught = TaughtPoses(tmp_path / "poses.json")
    for k in range(3):
        noise = matrix_from_rotation_vector(np.array([2e-4, -3e-4, 4e-4]) * k)
        taught.teach(f"p{k}", Pose(pose(k).position, noise))
    document = taught.scene(empty_scene(load_rig(RIG)), "taught")
    assert document.rotation_limits is None
    scene = scene_from_document(document)
    assert scene.start.angle_to(scene.goal) == 0.0
    assert scene.start.angle_to(scene.stops[0].pose) == 0.0


def test_rotated_poses_keep_their_orientation(tmp_path: Path) -> None:
    taught = TaughtPoses(tmp_path / "poses.json")
    turn = matrix_from_rotation_vector(np.array([0.0, 0.1, 0.2]))
    taught.teach("level", pose(0))
    taught.teach("turned", Pose(pose(1).position, turn))
    document = taught.scene(empty_scene(load_rig(RIG)), "taught")
    scene = scene_from_document(document)
    assert scene.goal.angle_to(Pose(pose(1).position, turn)) < 1e-6
    limits = scene.rotation_limits
    assert limits is not None
    assert limits.excess(scene.start, scene.goal) is None


def test_a_path_begins_where_the_platform_is(tmp_path: Path) -> None:
    taught = TaughtPoses(tmp_path / "poses.json")
    for k in range(2):
        taught.teach(f"p{k}", pose(k))
    around = empty_scene(load_rig(RIG))
    through = scene_from_document(taught.scene(around, "taught", begin=pose(2)))
    assert [stop.name for stop in through.stops] == ["p0"]
    assert through.start.distance_to(pose(2)) < 1e-9
    assert through.goal.distance_to(pose(1)) < 1e-9
    only = scene_from_document(taught.scene(around, "taught", begin=pose(2), only="p0"))
    assert not only.stops
    assert only.goal.distance_to(pose(0)) < 1e-9
    there = scene_from_document(taught.scene(around, "taught", begin=pose(0)))
    assert not there.stops, "a pose where it is already is no stop"
    for only_one, refusal in (("p1", "there already"), ("p9", "no pose 'p9'")):
        with pytest.raises(BadInput, match=refusal):
            taught.scene(around, "taught", begin=pose(1), only=only_one)


def test_one_pose_is_no_path(tmp_path: Path) -> None:
    taught = TaughtPoses(tmp_path / "poses.json")
    taught.teach("alone", pose(1))
    with pytest.raises(BadInput, match="two poses"):
        taught.scene(empty_scene(load_rig(RIG)), "taught")


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("", "must not be empty"),
        (" ", "must not be empty"),
        ("a\nb", "one line"),
        ("\0", "one line"),
        ("ü" * 55, "100 bytes at most; it has 110"),
    ],
)
def test_a_name_that_is_none_is_refused_with_the_reason(
    tmp_path: Path, name: str, reason: str
) -> None:
    with pytest.raises(BadInput, match=reason):
        TaughtPoses(tmp_path / "poses.json").teach(name, pose(1))


@pytest.mark.parametrize("text", ["", "[]", "{", '{"poses": [{"name": "a"}]}', '{"poses": 3}'])
def test_a_damaged_file_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "poses.json"
    path.write_text(text)
    with pytest.raises(CdprError, match=r"poses\.json"):
        TaughtPoses(path)


def test_there_is_an_end_to_them(tmp_path: Path) -> None:
    path = tmp_path / "poses.json"
    one = {"position_mm": [0.0, 0.0, 400.0], "rotation_wxyz": [1.0, 0.0, 0.0, 0.0]}
    poses = [{"name": f"p{k}", **one} for k in range(MOST)]
    path.write_text(json.dumps({"schema_version": 1, "poses": poses}))
    with pytest.raises(BadInput, match=str(MOST)):
        TaughtPoses(path).teach("one more", pose(1))
