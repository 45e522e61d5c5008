"""Scene files: shapes, names and ends are checked, and a changed scene is checked again."""

from __future__ import annotations

import copy
import json
import math
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.spatial
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from model.errors import BadInput, InvalidFile
from model.pose import Pose, matrix_from_rotation_vector
from model.scene import load_scene
from model.shapes import (
    Box,
    Capsule,
    ConvexHull,
    Cylinder,
    Sphere,
    TriangleMesh,
    convex_hull,
    enclosed_convex,
    shape_points,
)
from tests.model.rig_builds import CONFIGS, scene_data, scene_of

TETRAHEDRON = [[0, 0, 0], [100, 0, 0], [0, 100, 0], [0, 0, 100]]
FACES = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]


def problems_with(obstacles: list[dict[str, Any]], tmp_path: Path) -> list[tuple[str, str]]:
    data = scene_data()
    data["obstacles"] = obstacles
    path = tmp_path / "scene.yaml"
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    with pytest.raises(InvalidFile) as caught:
        load_scene(path)
    assert all(problem.line > 0 and problem.column > 0 for problem in caught.value.problems)
    return [(problem.key, problem.what) for problem in caught.value.problems]


@pytest.mark.parametrize(
    ("obstacle", "key", "sentence"),
    [
        ({}, "obstacles[0]", "'o' needs exactly one shape: one of box, sphere, cylinder, capsule"),
        (
            {"box": {"size_mm": [1, 1, 1]}, "sphere": {"radius_mm": 1}},
            "obstacles[0]",
            "obstacle 'o' needs exactly one shape: it has box, sphere",
        ),
        ({"box": {"size_mm": [1, 0, 1]}}, "obstacles[0].box.size_mm[1]", "must be more than 0"),
        ({"sphere": {"radius_mm": -1}}, "obstacles[0].sphere.radius_mm", "must be more than 0"),
        ({"capsule": {"radius_mm": 1}}, "obstacles[0].capsule.length_mm", "this key is missing"),
        ({"cone": {}, "box": {"size_mm": [1, 1, 1]}}, "obstacles[0].cone", "unknown key 'cone'"),
        (
            {"convex": {"points_mm": [[0, 0, 5], [9, 0, 5], [0, 9, 5], [9, 9, 5], [3, 1, 5]]}},
            "obstacles[0].convex.points_mm",
            "the points lie in a plane",
        ),
        (
            {"convex": {"points_mm": [[7, 7, 7]] * 4}},
            "obstacles[0].convex.points_mm",
            "the points lie in a plane",
        ),
        (
            {"convex": {"points_mm": TETRAHEDRON[:3]}},
            "obstacles[0].convex.points_mm",
            "needs 4 entries or more, it has 3",
        ),
        (
            {"mesh": {"points_mm": TETRAHEDRON, "triangles": [*FACES, [0, 1, 4]]}},
            "obstacles[0].mesh.triangles[4]",
            "[0, 1, 4] names a point outside 0..3",
        ),
        (
            {"mesh": {"points_mm": TETRAHEDRON, "triangles": [[0, 1, -1]]}},
            "obstacles[0].mesh.triangles[0]",
            "[0, 1, -1] names a point outside 0..3",
        ),
        (
            {"mesh": {"points_mm": TETRAHEDRON, "triangles": [[0, 1, 1]]}},
            "obstacles[0].mesh.triangles[0]",
            "[0, 1, 1] names a point twice",
        ),
        (
            {"mesh": {"points_mm": TETRAHEDRON, "triangles": [[0, 1]]}},
            "obstacles[0].mesh.triangles[0]",
            "needs 3 entries, it has 2",
        ),
        (
            {"mesh": {"points_mm": TETRAHEDRON, "triangles": [[0, 1, 2.5]]}},
            "obstacles[0].mesh.triangles[0][2]",
            "must be a whole number (it is 2.5)",
        ),
    ],
)
def test_a_wrong_obstacle_is_reported_by_key(
    obstacle: dict[str, Any], key: str, sentence: str, tmp_path: Path
) -> None:
    [(found, what)] = problems_with([{"name": "o", **obstacle}], tmp_path)
    assert found == key
    assert sentence in what


@pytest.mark.parametrize(
    "parts",
    [
        {"box": {"size_mm": [1e8, 1e8, 10]}},
        {"sphere": {"radius_mm": 10}, "position_mm": [0, -2e6, 0]},
        {"mesh": {"points_mm": [[0, 0, 0], [1e7, 0, 0], [0, 1, 0]], "triangles": [[0, 1, 2]]}},
    ],
)
def test_an_obstacle_larger_than_distances_are_proved_for_is_refused(
    parts: dict[str, Any], tmp_path: Path
) -> None:
    [(found, what)] = problems_with([{"name": "floor", **parts}], tmp_path)
    assert found == "obstacles[0]"
    assert "'floor' reaches" in what
    assert "make it as large as the room" in what


def test_two_obstacles_of_one_name_are_reported_beside_other_problems(tmp_path: Path) -> None:
    box = {"size_mm": [1, 1, 1]}
    found = problems_with(
        [{"name": "a", "box": box}, {"name": "a", "box": {"size_mm": [1]}}, {"name": "b"}],
        tmp_path,
    )
    assert dict(found) == {
        "obstacles[1].name": "obstacle name 'a' appears twice",
        "obstacles[1].box.size_mm": "needs 3 entries, it has 1",
        "obstacles[2]": "obstacle 'b' needs exactly one shape: one of box, sphere, cylinder, "
        "capsule, convex, mesh",
    }


@pytest.mark.parametrize(
    ("section", "key", "value", "sentence"),
    [
        ("clearance", "obstacle_mm", -1, "must be 0 or more (it is -1)"),
        ("clearance", "self_mm", float("nan"), "must be a finite number (it is nan)"),
        ("load", "payload_kg", -1, "must be 0 or more (it is -1)"),
        ("start", "position_mm", [0, 0], "needs 3 entries, it has 2"),
        ("goal", "rotation_wxyz", [1, 0, 0, 1], "must be a unit quaternion"),
    ],
)
def test_a_wrong_number_in_a_section_is_reported(
    section: str, key: str, value: object, sentence: str, tmp_path: Path
) -> None:
    data = scene_data()
    data.setdefault(section, {})[key] = value
    path = tmp_path / "scene.yaml"
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    with pytest.raises(InvalidFile) as caught:
        load_scene(path)
    [problem] = caught.value.problems
    assert problem.key == f"{section}.{key}"
    assert sentence in problem.what


def test_every_shape_arrives_in_metres_and_at_its_pose() -> None:
    data = scene_data()
    mesh = {"points_mm": TETRAHEDRON, "triangles": FACES[1:]}  # open: a surface
    shapes: list[tuple[str, dict[str, Any]]] = [
        ("box", {"size_mm": [100, 200, 300]}),
        ("sphere", {"radius_mm": 50}),
        ("cylinder", {"radius_mm": 20, "length_mm": 90}),
        ("capsule", {"radius_mm": 20, "length_mm": 90}),
        ("convex", {"points_mm": [*TETRAHEDRON, [1, 1, 1]]}),
        ("mesh", mesh),
    ]
    turn = [0.7071067811865476, 0, 0, 0.7071067811865476]
    data["obstacles"] = [
        {"name": key, key: shape, "position_mm": [1, 2, 3], "rotation_wxyz": turn}
        for key, shape in shapes
    ]
    scene = scene_of(data)
    kinds = [type(obstacle.shape) for obstacle in scene.obstacles]
    assert kinds == [Box, Sphere, Cylinder, Capsule, ConvexHull, TriangleMesh]
    box, ball, cylinder, capsule, hull, surface = (o.shape for o in scene.obstacles)
    np.testing.assert_allclose(box.half_size, [0.05, 0.1, 0.15])
    assert ball.radius == 0.05
    assert (cylinder.radius, cylinder.length) == (0.02, 0.09)
    assert (capsule.radius, capsule.length) == (0.02, 0.09)
    assert len(hull.vertices) == 4  # the inner point is not a vertex
    for body in (hull, surface):
        assert not body.vertices.flags.writeable
        assert not body.triangles.flags.writeable
    pose = scene.obstacles[0].pose
    np.testing.assert_allclose(pose.apply([1.0, 0.0, 0.0]), [0.001, 1.002, 0.003], atol=1e-12)


@pytest.mark.parametrize(
    ("faces", "kind"),
    [
        (FACES, ConvexHull),
        ([face[::-1] for face in FACES], ConvexHull),
        (FACES[1:], TriangleMesh),
        ([*FACES, [0, 1, 4]], TriangleMesh),
    ],
    ids=["closed", "closed, seen from inside", "open", "closed, and a fin"],
)
def test_a_mesh_around_a_convex_volume_is_solid(faces: list[list[int]], kind: type) -> None:
    data = scene_data()
    mesh = {"points_mm": [*TETRAHEDRON, [0, 0, 200]], "triangles": faces}
    data["obstacles"] = [{"name": "mesh", "mesh": mesh, "position_mm": [0, 0, 0]}]
    [obstacle] = scene_of(data).obstacles
    assert isinstance(obstacle.shape, kind)
    assert len(obstacle.shape.vertices) == (4 if kind is ConvexHull else 5)


def drum(sides: int, length_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """A prism of 100 mm across, its ends as fans of thin triangles: points, triangles."""
    angles = 2.0 * np.pi * np.arange(sides) / sides
    ring = 50.0 * np.column_stack([np.cos(angles), np.sin(angles)])
    points = np.vstack([np.column_stack([ring, np.full(sides, z)]) for z in (0.0, length_mm)])
    low, after = np.arange(sides), np.roll(np.arange(sides), -1)
    fan = np.column_stack([np.zeros(sides - 2, dtype=int), low[1:-1], low[2:]])
    walls = [np.column_stack([low, after, after + sides])]
    walls += [np.column_stack([low, after + sides, low + sides])]
    return points, np.vstack([fan[:, ::-1], fan + sides, *walls])


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([3, 4, 17, 64]), st.sampled_from([5.0, 1000.0]))
def test_a_mesh_of_an_stl_file_is_solid(seed: int, sides: int, length_mm: float) -> None:
    """Every triangle has corners of its own there, often rounded to a micrometre."""
    rng = np.random.default_rng(seed)
    points, triangles = drum(sides, length_mm)
    turn = matrix_from_rotation_vector(rng.normal(size=3))
    corners = np.round(points @ turn.T + rng.uniform(-1e3, 1e3, 3), 3)[triangles] / 1e3
    numbers = np.arange(3 * len(triangles)).reshape(-1, 3)
    vertices = corners.reshape(-1, 3)
    hull = enclosed_convex(vertices, numbers)
    assert hull is not None
    planes = scipy.spatial.ConvexHull(hull.vertices).equations
    assert (vertices @ planes[:, :3].T + planes[:, 3]).max() < 1e-9
    missing = int(rng.integers(len(numbers)))
    assert enclosed_convex(vertices, np.delete(numbers, missing, axis=0)) is None
    dented = np.vstack([points, points[triangles[-1]].mean(axis=0) * [0.999, 0.999, 1.0]])
    a, b, c = triangles[-1]
    cone = [[a, b, len(points)], [b, c, len(points)], [c, a, len(points)]]
    assert enclosed_convex(dented / 1e3, np.vstack([triangles[:-1], cone])) is None


def test_a_sheet_is_not_solid_however_often_it_is_covered() -> None:
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    layers = np.array([[0, 1, 2], [0, 2, 3], [0, 1, 3], [1, 2, 3]])
    assert enclosed_convex(square, layers) is None
    assert enclosed_convex(square + [[0.0, 0, 0], [0, 0, 1e-6]] * 2, layers) is None


@given(st.integers(0, 2**32 - 1), st.integers(4, 30))
def test_a_hull_contains_its_points_and_faces_outward(seed: int, count: int) -> None:
    points = np.random.default_rng(seed).normal(size=(count, 3))
    hull = convex_hull(points)
    corners = hull.vertices[hull.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    heights = np.einsum("ij,nij->ni", normals, points[:, None, :] - corners[None, :, 0])
    assert heights.max() < 1e-9
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    assert volume > 0.0  # counter-clockwise from outside


@pytest.mark.parametrize(
    "shape",
    [Box(np.array([1.0, 2.0, 3.0])), Sphere(2.0), Cylinder(1.0, 4.0), Capsule(1.0, 4.0)],
    ids=lambda shape: type(shape).__name__,
)
def test_the_points_of_a_shape_grown_by_its_radius_contain_it(shape: Any) -> None:
    points = shape_points(shape)
    radius = getattr(shape, "radius", 0.0)
    rng = np.random.default_rng(3)
    for direction in rng.normal(size=(50, 3)):
        u = direction / np.linalg.norm(direction)
        flat = np.hypot(u[0], u[1])
        reach = {
            Box: lambda u=u: np.abs(u) @ [1.0, 2.0, 3.0],
            Sphere: lambda: 2.0,
            Cylinder: lambda u=u, flat=flat: flat + 2.0 * abs(u[2]),
            Capsule: lambda u=u: 1.0 + 2.0 * abs(u[2]),
        }[type(shape)]()
        assert np.max(points @ u) + radius >= reach - 1e-12


SHAPES_MM: list[dict[str, Any]] = [
    {"box": {"size_mm": [300, 200, 400]}},
    {"sphere": {"radius_mm": 150}},
    {"cylinder": {"radius_mm": 90, "length_mm": 300}},
    {"capsule": {"radius_mm": 90, "length_mm": 300}},
    {"convex": {"points_mm": TETRAHEDRON}},
    {"mesh": {"points_mm": TETRAHEDRON, "triangles": FACES[1:]}},
]


def in_metres(value: Any, key: str = "") -> Any:
    if isinstance(value, dict):
        return {name: in_metres(part, name) for name, part in value.items()}
    if isinstance(value, list):
        return [in_metres(part, key) for part in value]
    return value / 1e3 if key.endswith("_mm") else value


@pytest.mark.parametrize("shape", SHAPES_MM, ids=lambda shape: next(iter(shape)))
def test_obstacles_in_metres_get_a_remark(shape: dict[str, Any]) -> None:
    data = scene_data()
    data["obstacles"] = [{"name": "shelf", **shape}]
    assert scene_of(data).document.remarks() == []
    data["obstacles"] = [{"name": "shelf", **in_metres(shape)}]
    [remark] = scene_of(data).document.remarks()
    assert remark.startswith("obstacles[0]: 'shelf' is 0.")
    assert remark.endswith("check that it is in mm, not in m")


def test_many_obstacles_in_metres_get_one_remark() -> None:
    data = scene_data()
    data["obstacles"] = [{"name": f"pin{k}", "sphere": {"radius_mm": 0.2}} for k in range(40)]
    [remark] = scene_of(data).document.remarks()
    assert remark.startswith("obstacles[0]: 'pin0' is 0.4 mm large, obstacles[1]: 'pin1' is 0.4 mm")
    assert remark.endswith("'pin2' is 0.4 mm large and 37 more; check that it is in mm, not in m")


@pytest.mark.parametrize("key", ["obstacle_mm", "self_mm"])
@pytest.mark.parametrize(("value", "count"), [(0, 0), (0.04, 1), (1, 0)])
def test_a_clearance_in_metres_gets_a_remark(key: str, value: float, count: int) -> None:
    data = scene_data()
    data["clearance"] = {key: value}
    found = scene_of(data).document.remarks()
    assert [remark.split(":")[0] for remark in found] == [f"clearance.{key}"] * count


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.stem)
def test_the_scenes_of_the_repository_have_no_remarks(path: Path) -> None:
    if "goal:" in path.read_text(encoding="utf-8"):
        assert load_scene(path).document.remarks() == []


def test_a_changed_scene_keeps_the_rest_and_has_another_hash() -> None:
    scene = scene_of(scene_data())
    other = scene.changed(
        start=Pose.level([0.1, 0.0, 0.3]), goal=Pose.level([0.0, 0.1, 0.3]), clearance=0.02
    )
    assert other.obstacle_clearance == 0.02
    assert other.self_clearance == scene.self_clearance
    np.testing.assert_allclose(other.start.position, [0.1, 0.0, 0.3])
    assert [o.name for o in other.obstacles] == [o.name for o in scene.obstacles]
    assert other.hash != scene.hash
    assert scene.changed().hash == scene.hash
    assert scene.changed(clearance=scene.obstacle_clearance).hash == scene.hash


@pytest.mark.parametrize(
    "change",
    [
        {"clearance": -0.001},
        {"clearance": float("nan")},
        {"clearance": float("inf")},
        {"clearance": "3"},
        {"start": [0.0, 0.0, 0.3]},
        {"goal": "home"},
    ],
)
def test_a_scene_cannot_be_changed_into_an_invalid_one(change: dict[str, Any]) -> None:
    """A negative clearance would make every plan pass."""
    with pytest.raises(BadInput):
        scene_of(scene_data()).changed(**change)


@pytest.mark.parametrize("name", ["environment_1", "environment_2", "environment_3", "hall_pillar"])
def test_the_hash_of_a_scene_depends_on_each_obstacle_but_not_on_the_layout(
    name: str, tmp_path: Path
) -> None:
    expected = load_scene(CONFIGS / f"{name}.yaml").hash
    data = yaml.safe_load((CONFIGS / f"{name}.yaml").read_text(encoding="utf-8"))
    path = tmp_path / "scene.yaml"
    path.write_text(yaml.safe_dump(data), encoding="utf-8")  # in another order, without comments
    assert load_scene(path).hash == expected
    for index, axis in product(range(len(data["obstacles"])), range(3)):
        changed = copy.deepcopy(data)
        changed["obstacles"][index]["position_mm"][axis] += 0.001
        assert scene_of(changed).hash != expected


def bowl(rings: int) -> dict[str, Any]:
    """An open surface of revolution with 40 · (rings - 1) triangles."""
    around = range(20)
    points = [
        [math.cos(k * math.pi / 10) * (10 + ring), math.sin(k * math.pi / 10) * (10 + ring), ring]
        for ring in range(rings)
        for k in around
    ]
    corners = [
        (20 * ring + k, 20 * ring + (k + 1) % 20) for ring in range(rings - 1) for k in around
    ]
    triangles = [[[a, b, a + 20], [b, b + 20, a + 20]] for a, b in corners]
    return {"points_mm": points, "triangles": [t for pair in triangles for t in pair]}


@pytest.mark.parametrize(("rings", "refusal"), [(160, ""), (180, "40000 keys"), (900, "MB")])
def test_a_mesh_that_is_too_large_is_refused_with_what_helps(
    tmp_path: Path, rings: int, refusal: str
) -> None:
    obstacle = {"name": "bowl", "mesh": bowl(rings), "position_mm": [500, 0, 0]}
    pose = {"position_mm": [0, 0, 0]}
    content = {"schema_version": 1, "name": "s", "start": pose, "goal": pose}
    path = tmp_path / "scene.yaml"
    path.write_text(json.dumps({**content, "obstacles": [obstacle]}))
    if not refusal:
        (loaded,) = load_scene(path).obstacles
        assert len(loaded.shape.triangles) == 40 * (rings - 1)
        return
    with pytest.raises(BadInput, match=refusal) as caught:
        load_scene(path)
    assert "simplify meshes or replace them by convex hulls" in caught.value.next_step
    assert not any(word in str(caught.value) for word in ("alias", "split"))
