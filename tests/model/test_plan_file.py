"""Plan files: a round trip changes nothing, and nothing else is accepted as a plan."""

from __future__ import annotations

import copy
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.errors import BadInput, CdprError, InvalidFile
from model.files.documents import PoseDocument
from model.files.plan_file import PlanDocument
from model.plan import load_plan, plan_from_document, save_plan, sealed
from tests.model.rig_builds import paper_data, rig_of, scene_data, scene_of


def a_plan() -> PlanDocument:
    """Two waypoints between the ends of environment 3; not collision-free, but intact."""
    rig, scene = rig_of(paper_data()), scene_of(scene_data())
    nearest = {
        "first": "cable 1",
        "second": "obstacle_1",
        "distance_mm": 12.5,
        "position_mm": [0.0, 0.0, 300.0],
    }
    middle = {"position_mm": [0.1, -0.2, 500.0], "rotation_wxyz": [0.8, 0.0, 0.6, 0.0]}
    path = [scene.document.start, middle, scene.document.goal]
    return sealed(
        {
            "rig_hash": rig.plan_hash,
            "scene_hash": scene.hash,
            "rig": rig.document,
            "scene": scene.document,
            "planner": {
                "name": "adaptive",
                "cost": "kinematic",
                "mode": "rewire",
                "seed": 1,
                "step_mm": 40.0,
                "neighbour_radius_mm": 79.0,
                "goal_radius_mm": 50.0,
                "max_iterations": 5000,
            },
            "waypoints": path,
            "raw_path": path,
            "tree": {"positions_mm": [[180.0, 180.0, 300.0], [0, 0, 500]], "parents": [-1, 0]},
            "statistics": {
                "nodes": 2,
                "iterations": 3,
                "edge_checks": 4,
                "planning_time_s": 0.1,
            },
            "quality": {
                "length_mm": 600.0,
                "raw_length_mm": 700.0,
                "obstacle_clearance": nearest,
                "self_clearance": nearest,
                "mean_kinematic_cost": 0.5,
                "min_tension_n": 5.0,
                "max_tension_n": 60.0,
            },
        }
    )


DOCUMENT = a_plan()
DATA = DOCUMENT.model_dump(mode="json")
SAID = DOCUMENT.model_dump(mode="json", exclude_defaults=True)


def leaves(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths of all scalar values."""
    if isinstance(value, dict):
        return [p for key, part in value.items() for p in leaves(part, (*path, key))]
    if isinstance(value, list):
        return [p for key, part in enumerate(value) for p in leaves(part, (*path, key))]
    return [path]


def holder_of(data: Any, path: tuple[Any, ...]) -> Any:
    for part in path[:-1]:
        data = data[part]
    return data


def refused(text: str, tmp_path: Path) -> CdprError:
    path = tmp_path / "plan.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(BadInput) as caught:
        load_plan(path)
    assert str(path) in str(caught.value)
    assert "cdpr plan" in caught.value.next_step
    return caught.value


@pytest.mark.parametrize("key", ["nodes", "iterations", "edge_checks"])
def test_the_counts_of_a_long_search_are_kept(key: str, tmp_path: Path) -> None:
    """Half an hour checks more than 2**31 edges."""
    fields = {k: v for k, v in DATA.items() if k != "hash"}
    path = tmp_path / "plan.json"
    save_plan(sealed({**fields, "statistics": DATA["statistics"] | {key: 2**31}}), path)
    assert getattr(load_plan(path).document.statistics, key) == 2**31


def test_a_plan_comes_back_as_it_was_written(tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    save_plan(DOCUMENT, path)
    plan = load_plan(path)
    assert plan.document == DOCUMENT
    assert plan.rig.plan_hash == DOCUMENT.rig_hash
    assert plan.scene.hash == DOCUMENT.scene_hash
    assert len(plan.waypoints) == 3
    np.testing.assert_allclose(plan.waypoints[0].position, [0.18, 0.18, 0.3])
    expected = plan_from_document(DOCUMENT).waypoints[1].matrix()
    np.testing.assert_array_equal(plan.waypoints[1].matrix(), expected)


def test_writing_a_read_plan_gives_the_same_bytes(tmp_path: Path) -> None:
    first, second = tmp_path / "a.json", tmp_path / "b.json"
    save_plan(DOCUMENT, first)
    save_plan(load_plan(first).document, second)
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize("indent", [None, 4])
def test_layout_and_the_order_of_keys_do_not_matter(indent: int | None, tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    path.write_text(json.dumps(dict(reversed(DATA.items())), indent=indent, sort_keys=bool(indent)))
    assert load_plan(path).document == DOCUMENT


POSITIONS = st.lists(st.tuples(*[st.floats(-2.0, 2.0)] * 3), min_size=2, max_size=5)


@settings(max_examples=20)
@given(positions=POSITIONS)
def test_any_path_survives_its_file(
    positions: list[tuple[float, ...]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Every digit of every float is in the text."""
    fields = {k: v for k, v in dict(DOCUMENT).items() if k not in ("hash", "waypoints")}
    waypoints = [PoseDocument(position_mm=[1000.0 * x for x in p]) for p in positions]
    document = sealed({**fields, "waypoints": waypoints})
    path = tmp_path_factory.mktemp("plan") / "plan.json"
    save_plan(document, path)
    found = load_plan(path)
    assert found.document == document
    np.testing.assert_allclose([w.position for w in found.waypoints], positions, atol=1e-12)


def other_than(value: Any, draw: st.DataObject) -> Any:
    """A value of the same kind, or of any kind, that is not the same."""
    kinds = st.one_of(
        st.none(),
        st.booleans(),
        st.integers(-5, 5),
        st.floats(-1e3, 1e3),
        st.text(st.characters(codec="ascii"), max_size=5),
    )
    if type(value) is float:
        kinds = st.one_of(st.just(np.nextafter(value, 1e9).item()), st.just(-value - 1.0), kinds)
    return draw.draw(kinds.filter(lambda new: new != value))


@settings(max_examples=200)
@given(path=st.sampled_from(leaves(DATA)), draw=st.data())
def test_a_plan_edited_anywhere_is_refused(
    path: tuple[Any, ...], draw: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    data = copy.deepcopy(DATA)
    holder = holder_of(data, path)
    holder[path[-1]] = other_than(holder[path[-1]], draw)
    refused(json.dumps(data), tmp_path_factory.mktemp("edited"))


@settings(max_examples=60)
@given(path=st.sampled_from([p for p in leaves(DATA) if isinstance(p[-1], str)]), add=st.booleans())
def test_a_plan_with_a_missing_or_extra_key_is_refused(
    path: tuple[Any, ...], add: bool, tmp_path_factory: pytest.TempPathFactory
) -> None:
    data = copy.deepcopy(DATA)
    if add:
        holder_of(data, path)["remark"] = 1
    else:
        del holder_of(data, path)[path[-1]]
    folder = tmp_path_factory.mktemp("keys")
    if add or not _is_default(path):
        refused(json.dumps(data), folder)
    else:
        (folder / "plan.json").write_text(json.dumps(data))
        assert load_plan(folder / "plan.json").document == PlanDocument.model_validate(DATA)


def _is_default(path: tuple[Any, ...]) -> bool:
    if path[-1] in ("kind", "schema_version", "type"):  # they say what the file, or a part, is
        return False
    try:
        return path[-1] not in holder_of(SAID, path)
    except KeyError:  # so does all that holds it
        return True


def test_a_plan_of_a_version_with_fewer_keys_is_read(tmp_path: Path) -> None:
    """Missing keys have their defaults, as in the plan of a later version."""
    data = {**SAID, "kind": DATA["kind"], "schema_version": DATA["schema_version"]}
    assert len(json.dumps(data)) < 0.9 * len(json.dumps(DATA))
    (tmp_path / "plan.json").write_text(json.dumps(data))
    assert load_plan(tmp_path / "plan.json").document == PlanDocument.model_validate(DATA)


@pytest.mark.parametrize("key", ["waypoints", "raw_path"])
def test_waypoints_moved_or_dropped_are_refused(key: str, tmp_path: Path) -> None:
    for change in (lambda p: p[::-1], lambda p: [p[0], p[2]], lambda p: [*p, p[0]]):
        data = copy.deepcopy(DATA)
        data[key] = change(data[key])
        assert "does not match" in refused(json.dumps(data), tmp_path).what


@pytest.mark.parametrize("constant", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_nan_and_infinity_are_refused(constant: str, tmp_path: Path) -> None:
    text = json.dumps(DATA).replace("600.0", constant)
    error = refused(text, tmp_path)
    assert "NaN" in str(error) or "Infinity" in str(error) or "finite" in str(error)


def test_a_plan_truncated_anywhere_is_refused(tmp_path: Path) -> None:
    text = json.dumps(DATA)
    for end in (0, 1, len(text) // 3, len(text) // 2, len(text) - 1):
        error = refused(text[:end], tmp_path)
        assert "not valid JSON" in error.what
        assert error.why


@pytest.mark.parametrize("text", ["[]", "1", '"plan"', "{}", '{"kind": "cdpr-run"}', "null"])
def test_json_that_is_not_a_plan_is_reported_in_one_sentence(text: str, tmp_path: Path) -> None:
    assert refused(text, tmp_path).what == "this is not a plan file"


def test_a_plan_without_its_kind_is_refused_by_schema_and_program(tmp_path: Path) -> None:
    """The hash leaves it out as a default; the file must not."""
    assert "kind" in PlanDocument.model_json_schema()["required"]
    without = {key: value for key, value in DATA.items() if key != "kind"}
    assert refused(json.dumps(without), tmp_path).why == "its key `kind` must be `cdpr-plan`"


def test_a_plan_of_another_version_is_reported_as_that_alone(tmp_path: Path) -> None:
    """Whatever else the other version has: its keys are not mistakes."""
    error = refused(json.dumps({**DATA, "schema_version": 2, "newer": 1}), tmp_path)
    assert isinstance(error, InvalidFile)
    [problem] = error.problems
    assert problem.what == "the file has schema version 2; this program reads version 1"


def test_keys_that_do_not_fit_are_reported_by_path(tmp_path: Path) -> None:
    data = copy.deepcopy(DATA)
    data["waypoints"][1]["position_mm"] = [1.0, "x", 3.0]
    data["planner"]["sead"] = data["planner"].pop("seed")
    error = refused(json.dumps(data), tmp_path)
    assert isinstance(error, InvalidFile)
    assert {problem.key for problem in error.problems} == {
        "waypoints[1].position_mm[1]",
        "planner.seed",
        "planner.sead",
    }
    assert ":0:0" not in str(error)  # a plan has no lines to go to
    assert "did you mean 'seed'" in str(error)


def test_a_duplicate_key_is_refused(tmp_path: Path) -> None:
    """Another program might read the first one."""
    text = json.dumps(DATA)
    text = text.replace('"seed": 1', '"seed": 2, "seed": 1')
    assert "'seed' appears twice" in refused(text, tmp_path).what


@pytest.mark.parametrize(
    ("text", "words"),
    [("[" * 100_000, "nested too deeply"), ('{"a": ' + "9" * 5000 + "}", "digits")],
)
def test_absurd_json_is_refused(text: str, words: str, tmp_path: Path) -> None:
    assert words in refused(text, tmp_path).what


@pytest.mark.parametrize("key", ["rig_hash", "scene_hash"])
def test_a_plan_sealed_over_a_wrong_part_hash_is_refused(key: str, tmp_path: Path) -> None:
    fields = {k: v for k, v in dict(DOCUMENT).items() if k != "hash"}
    document = sealed({**fields, key: "sha256:" + "0" * 64})
    error = refused(document.model_dump_json(), tmp_path)
    assert f"the plan's {key} does not match" in error.what


def test_a_folder_is_not_a_plan_and_cannot_be_replaced_by_one(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="this is a folder"):
        load_plan(tmp_path)
    with pytest.raises(BadInput, match="this is a folder"):
        save_plan(DOCUMENT, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_missing_folder_is_reported(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="cannot be written") as caught:
        save_plan(DOCUMENT, tmp_path / "nowhere" / "plan.json")
    assert "existing folder" in caught.value.next_step


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_read_only_folder_is_reported_and_left_as_it_was(tmp_path: Path) -> None:
    folder = tmp_path / "locked"
    folder.mkdir()
    folder.chmod(0o555)
    try:
        with pytest.raises(BadInput, match="cannot be written") as caught:
            save_plan(DOCUMENT, folder / "plan.json")
    finally:
        folder.chmod(0o755)
    assert "denied" in caught.value.why
    assert list(folder.iterdir()) == []
