"""Stops of a scene: requirements of their kinds, and the load of every leg."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from model.errors import BadInput, InvalidFile
from model.files.scene_file import Payload, StopDocument, payloads
from model.plan import load_plan, sealed
from model.rig import load_rig
from model.scene import legs_of, load_scene
from tests.model.rig_builds import CONFIGS, scene_data, scene_of
from tests.model.test_plan_file import DOCUMENT

PICK = {"kind": "pick", "dwell_s": 1.0, "mass_kg": 0.5}


def stop(name: str, **keys: Any) -> dict[str, Any]:
    return {"name": name, "position_mm": [0.0, 0.0, 400.0], **keys}


def problems(stops: list[dict[str, Any]], path: Path, **parts: Any) -> dict[str, str]:
    path.write_text(yaml.safe_dump({**scene_data(), "stops": stops, **parts}), encoding="utf-8")
    with pytest.raises(InvalidFile) as caught:
        load_scene(path)
    lines = path.read_text(encoding="utf-8").splitlines()
    for problem in caught.value.problems:
        assert lines[problem.line - 1][problem.column - 1 :].strip(), "there is something there"
    return {problem.key: problem.what for problem in caught.value.problems}


@pytest.mark.parametrize(
    ("stops", "key", "words"),
    [
        ([stop("a"), stop("a")], "stops[1].name", "'a' appears twice"),
        ([stop("")], "stops[0].name", "must not be empty"),
        ([stop("a", kind="grasp")], "stops[0].kind", "must be 'pass', 'pick' or 'place'"),
        ([stop("a", dwell_s=-1.0)], "stops[0].dwell_s", "must be 0 or more"),
        ([stop("a", mass_kg=1.0)], "stops[0].mass_kg", "does not change the load"),
        ([stop("a", kind="pick", dwell_s=1.0)], "stops[0]", "needs mass_kg"),
        ([stop("a", kind="pick", mass_kg=1.0)], "stops[0]", "needs a dwell_s above 0"),
        ([stop("a", **PICK | {"mass_kg": 0.0})], "stops[0].mass_kg", "must be more than 0"),
        (
            [stop("a", **PICK), stop("b", kind="place", dwell_s=1.0, mass_kg=0.6)],
            "stops[1].mass_kg",
            "place 'b' puts down 0.6 kg, but only 0.5 kg are carried",
        ),
        (
            [
                stop("a", **PICK),
                stop("b", **PICK | {"kind": "place", "mass_centre_mm": [5.0, 0.0, 0.0]}),
            ],
            "stops[1].mass_kg",
            "the whole payload, whose centre is at [0, 0, 0] mm",
        ),
        ([{"name": "a"}], "stops[0].position_mm", "this key is missing"),
        ([stop("a", payload_kg=1.0)], "stops[0].payload_kg", "unknown key 'payload_kg'"),
    ],
)
def test_a_stop_that_does_not_fit_is_reported_with_its_position(
    stops: list[dict[str, Any]], key: str, words: str, tmp_path: Path
) -> None:
    found = problems(stops, tmp_path / "scene.yaml")
    assert list(found) == [key]
    assert words in found[key]


def test_problems_of_stops_are_reported_beside_others(tmp_path: Path) -> None:
    wrong = {"clearance": {"obstacle_mm": -1}}
    found = problems([stop("a", mass_kg=1.0)], tmp_path / "scene.yaml", **wrong)
    assert set(found) == {"clearance.obstacle_mm", "stops[0].mass_kg"}


masses = st.floats(0.001, 50.0)
points = st.tuples(*[st.floats(-200.0, 200.0)] * 3)


@given(st.lists(st.tuples(masses, points), min_size=1, max_size=6))
def test_the_payload_is_the_sum_and_the_mean_of_the_masses_picked(
    parts: list[tuple[float, tuple[float, float, float]]],
) -> None:
    stops = [
        StopDocument.model_validate(
            stop(str(i), **PICK | {"mass_kg": m, "mass_centre_mm": list(c)})
        )
        for i, (m, c) in enumerate(parts)
    ]
    carried = payloads(Payload(0.0, (0.0, 0.0, 0.0)), stops)[-1]
    weights = np.array([m for m, _ in parts])
    assert carried.mass_kg == pytest.approx(weights.sum())
    mean = weights @ np.array([c for _, c in parts]) / weights.sum()
    np.testing.assert_allclose(carried.centre_mm, mean, atol=1e-5)


@given(st.tuples(masses, points), st.tuples(masses, points))
def test_placing_the_last_mass_restores_the_payload_before_it(
    first: tuple[float, tuple[float, float, float]],
    second: tuple[float, tuple[float, float, float]],
) -> None:
    before = Payload(*first)
    after = before.with_mass(*second).without_mass(*second)
    assert after.mass_kg == pytest.approx(before.mass_kg, rel=1e-9)
    ratio = (first[0] + second[0]) / first[0]  # by which a nanometre of rounding grows
    np.testing.assert_allclose(after.centre_mm, before.centre_mm, atol=2e-6 * ratio + 1e-6)


def test_a_placed_mass_without_a_centre_takes_from_all_that_is_carried_alike() -> None:
    carried = Payload(2.0, (10.0, 20.0, 30.0))
    assert carried.without_mass(0.5, None) == Payload(1.5, (10.0, 20.0, 30.0))
    assert carried.without_mass(2.0, None) == Payload(0.0, (0.0, 0.0, 0.0))


def test_every_leg_has_its_ends_and_its_load() -> None:
    scene = load_scene(CONFIGS / "pick_and_place.yaml")
    legs = legs_of(scene)
    assert [leg.scene.load.payload_mass for leg in legs] == [0.0, 1.2, 1.2, 0.0, 0.5, 0.5, 0.0]
    np.testing.assert_allclose(legs[1].scene.load.payload_centre, [0.0, 0.0, -0.08])
    poses = [scene.start, *(s.pose for s in scene.stops), scene.goal]
    for leg, start, goal in zip(legs, poses[:-1], poses[1:], strict=True):
        assert leg.scene.start.distance_to(start) == leg.scene.goal.distance_to(goal) == 0.0
        assert leg.scene.stops == ()
        assert leg.scene.document.stops == []
        again = scene_of(leg.scene.document.model_dump(mode="json"))
        assert again.hash == leg.scene.hash, "a leg is a scene that could be written down"
        assert again.load.payload_mass == leg.scene.load.payload_mass
    assert [leg.end for leg in legs[:2]] == ["stop 'tray'", "stop 'over the wall'"]
    assert legs[-1].end == "goal"


def test_a_scene_without_stops_is_its_only_leg() -> None:
    scene = scene_of(scene_data())
    [leg] = legs_of(scene)
    assert leg.scene.hash == scene.hash


def test_a_payload_that_does_not_fit_the_stops_is_refused() -> None:
    scene = load_scene(CONFIGS / "pick_and_place.yaml")
    later = scene.document.stops[2:]
    with pytest.raises(BadInput, match=r"'shelf' puts down 1\.2 kg, but only 0 kg are carried"):
        scene.changed(stops=later)
    changed = scene.changed(stops=later, payload=Payload(1.2, (0.0, 0.0, -80.0)))
    assert len(changed.stops) == 4


@pytest.mark.parametrize(
    ("marks", "words"),
    [
        ([], "marks the stops []; its scene has ['a']"),
        ([("b", 1)], "marks the stops ['b']; its scene has ['a']"),
        ([("a", 0)], "misses a stop by"),
        ([("a", 3)], "marks the waypoints [3] of 3 as stops"),
        ([("a", 1)], "misses a stop by 1 mm"),
    ],
)
def test_a_plan_whose_marks_are_not_the_scenes_stops_is_refused(
    marks: list[tuple[str, int]], words: str, tmp_path: Path
) -> None:
    """Sealed with a correct hash by another program."""
    x, y, z = DOCUMENT.waypoints[1].position_mm
    at = StopDocument(name="a", position_mm=[x + 1.0, y, z])
    scene = scene_of({**DOCUMENT.scene.model_dump(mode="json"), "stops": [at.model_dump()]})
    fields = {k: v for k, v in dict(DOCUMENT).items() if k != "hash"}
    changes = {
        "scene": scene.document,
        "scene_hash": scene.hash,
        "stops": [{"name": name, "waypoint": waypoint} for name, waypoint in marks],
    }
    path = tmp_path / "plan.json"
    path.write_text(sealed({**fields, **changes}).model_dump_json(), encoding="utf-8")
    with pytest.raises(BadInput) as caught:
        load_plan(path)
    assert words in caught.value.what


def test_a_payload_with_its_centre_outside_the_platform_gets_a_remark() -> None:
    """The box of 130 mm and the cables are all that is kept away from obstacles."""
    rig = load_rig(CONFIGS / "gachon_8_6.yaml")
    scene = load_scene(CONFIGS / "pick_and_place.yaml")
    below = "mass_centre_mm is 15 mm outside the platform's box"
    remarks = scene.remarks(rig)
    assert len(remarks) == sum(stop.kind == "pick" for stop in scene.stops) == 2
    assert all(below in remark for remark in remarks)
    inside = [stop.model_copy(update={"mass_centre_mm": None}) for stop in scene.document.stops]
    assert scene.changed(stops=inside).remarks(rig) == []
    [first] = scene.changed(stops=[], payload=Payload(1.0, (0.0, 70.0, 0.0))).remarks(rig)
    assert first.startswith("load.payload_centre_mm is 5 mm outside the platform's box")
    assert scene.changed(stops=[], payload=Payload(0.0, (0.0, 70.0, 0.0))).remarks(rig) == []
