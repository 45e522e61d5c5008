"""The kinematic cost: scaled over the workspace, integrated along edges."""

from __future__ import annotations

import numpy as np
import pytest

from model.errors import BadInput
from model.files.documents import PoseDocument
from model.files.rig_file import RigDocument
from model.kinematics import structure_matrix
from model.pose import Pose, matrix_from_rotation_vector
from model.rig import Rig, rig_from_document
from model.statics.wrench_sets import condition_number, force_volume, rms_anchor_radius
from planner.costs import KinematicCost
from planner.kernels import jit as stored
from planner.planning import make_plan, plan_from_waypoints
from planner.rrt.path import LengthCost
from planner.space import Lattice, corners_and_weights
from tests.cli.plans import free_scene
from tests.model.rig_builds import paper_rig_with_pulleys


@pytest.fixture(scope="module")
def cost(gachon) -> KinematicCost:
    return KinematicCost(gachon, np.eye(3))


@pytest.mark.parametrize("name", ["gachon", "hall"])
def test_integrals_from_the_lattice_are_within_two_percent_of_exact_ones(
    name, gachon, hall
) -> None:
    rig = {"gachon": gachon, "hall": hall}[name]
    cost, rng = KinematicCost(rig, np.eye(3)), np.random.default_rng(1)
    for _ in range(30):
        start, end = rng.uniform(rig.workspace_lower, rig.workspace_upper, (2, 3))
        points = start + np.linspace(0, 1, 201)[:, None] * (end - start)
        values = cost.at(points)
        mean = np.mean((values[1:] + values[:-1]) / 2)
        assert cost.edge(start, end) == pytest.approx(mean * np.linalg.norm(end - start), rel=0.02)


def test_the_lattice_is_computed_once_for_a_rig_and_an_orientation(
    gachon, monkeypatch, tmp_path
) -> None:
    monkeypatch.setattr(stored, "cache_folder", lambda *_: tmp_path)
    first = KinematicCost(gachon, np.eye(3))

    def refuse(_self: KinematicCost) -> np.ndarray:
        raise AssertionError("computed again")

    monkeypatch.setattr(KinematicCost, "_on_lattice", refuse)
    again = KinematicCost(gachon, np.eye(3))
    assert np.array_equal(first.values, again.values)
    assert first.extremes == again.extremes
    with pytest.raises(AssertionError, match="computed again"):
        KinematicCost(
            gachon, Pose.from_quaternion(np.zeros(3), np.array([0.8, 0, 0, 0.6])).rotation
        )
    monkeypatch.setattr("planner.costs._version", lambda: "another state of the code")
    with pytest.raises(AssertionError, match="computed again"):
        KinematicCost(gachon, np.eye(3))


def test_both_indices_are_scaled_by_their_extremes_over_the_workspace(gachon, cost) -> None:
    lattice = Lattice.over(gachon.workspace_lower, gachon.workspace_upper)
    points = lattice.points(np.arange(0, lattice.count, 97))
    length = rms_anchor_radius(gachon.anchors)
    condition = np.array(
        [condition_number(structure_matrix(gachon, Pose.level(p)), length) for p in points]
    )
    tension_range = gachon.max_tension - gachon.min_tension
    volume = np.array(
        [force_volume(structure_matrix(gachon, Pose.level(p)), tension_range) for p in points]
    )
    # c is affine in the condition number and in the inverse volume, with positive factors.
    columns = np.column_stack([condition, 1 / volume, np.ones(len(points))])
    factors, residual, *_ = np.linalg.lstsq(columns, cost.at(points), rcond=None)
    assert residual[0] < 1e-18
    assert factors[0] > 0
    assert factors[1] > 0
    everywhere = cost.at(lattice.points(np.arange(lattice.count)))
    assert everywhere.min() >= 0
    assert everywhere.max() <= 2


def test_dexterity_gets_better_and_the_wrench_set_worse_toward_the_centre(gachon) -> None:
    """Source: paper, Fig. 7 and section 5.1."""
    length = rms_anchor_radius(gachon.anchors)
    centre, corner = (structure_matrix(gachon, Pose.level([x, x, 0.445])) for x in (0.0, 0.2))
    assert condition_number(centre, length) < condition_number(corner, length)
    assert force_volume(centre, 100.0) < force_volume(corner, 100.0)


def test_edges_are_symmetric_additive_and_the_same_in_a_batch(cost) -> None:
    rng = np.random.default_rng(2)
    start, end = rng.uniform([-0.2, -0.2, 0.2], [0.2, 0.2, 0.6], (2, 3))
    middle = (start + end) / 2
    whole = cost.edge(start, end)
    assert cost.edge(end, start) == pytest.approx(whole)
    assert cost.edge(start, middle) + cost.edge(middle, end) == pytest.approx(whole, rel=2e-3)
    batch = cost.edges(np.stack([start, middle, end]), end)
    assert batch == pytest.approx([whole, cost.edge(middle, end), 0.0], rel=2e-3, abs=1e-12)
    assert len(cost.edges(np.zeros((0, 3)), end)) == 0


def test_mean_cost_weighs_by_length(cost) -> None:
    path = np.array([[0.0, 0, 0.3], [0.1, 0, 0.3], [0.1, 0.2, 0.3]])
    parts = [cost.mean_along(path[:2]), cost.mean_along(path[1:])]
    assert cost.mean_along(path) == pytest.approx((parts[0] + 2 * parts[1]) / 3)
    point = path[:1]
    assert cost.mean_along(np.concatenate([point, point])) == pytest.approx(cost.at(point)[0])


def test_an_index_better_than_anywhere_in_the_workspace_counts_as_zero(gachon, scene_with) -> None:
    """Start tilted in a workspace of one lattice cell, then level."""
    home = gachon.home.position
    box = {"lower_mm": (home * 1e3 - 5.0).tolist(), "upper_mm": (home * 1e3 + 5.0).tolist()}
    small = changed(gachon, workspace=box)
    tilted, level, goal = (
        Pose(
            np.add(home, [0.0, y, 0.0]),
            matrix_from_rotation_vector(np.radians([degrees, 0.0, 0.0])),
        )
        for degrees, y in ((-8.0, 0.0), (0.0, 0.0), (0.0, 0.004))
    )
    scene = scene_with(
        start=PoseDocument.of(tilted).model_dump(),
        goal=PoseDocument.of(goal).model_dump(),
        rotation_limits={"tilt_deg": 9.0, "turn_deg": 9.0},
        clearance={"obstacle_mm": 0.0, "self_mm": 0.0},
    )
    plan = plan_from_waypoints(small, scene, [scene.start, level, scene.goal])
    assert 0.0 < plan.quality.mean_kinematic_cost < 1.0


def test_length_cost_is_the_distance() -> None:
    assert LengthCost().edge(np.zeros(3), np.array([0.3, 0.4, 0.0])) == pytest.approx(0.5)


def test_trilinear_weights_reproduce_a_linear_function() -> None:
    lattice = Lattice.over(np.array([-1.0, 0.0, 2.0]), np.array([1.0, 0.5, 3.0]))
    rng = np.random.default_rng(3)
    points = rng.uniform([-1, 0, 2], [1, 0.5, 3], (50, 3))
    slope = np.array([1.0, -2.0, 0.5])
    corners, weights = corners_and_weights(lattice, points)
    values = lattice.points(corners.ravel()).reshape(50, 8, 3) @ slope
    assert np.sum(values * weights, axis=1) == pytest.approx(points @ slope)


def changed(rig: Rig, **changes: object) -> Rig:
    return rig_from_document(RigDocument.model_validate(rig.document.model_dump() | changes))


def singular_in_the_middle(gachon: Rig) -> Rig:
    """Mirrored about z = 500 mm, where the structure matrix loses a rank, and crossed in height."""
    turns = {s: np.array([[1.0, -s, 0.0], [s, 1.0, 0.0], [0.0, 0.0, 1.0]]) for s in (1.0, -1.0)}
    around = [(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)]
    return changed(
        gachon,
        outlets_mm=[[500.0 * x, 500.0 * y, 500.0 + 500.0 * s] for s in turns for x, y in around],
        anchors_mm=[
            (turn @ [65.0 * x, 65.0 * y, -65.0 * s] * [0.5**0.5, 0.5**0.5, 1.0]).tolist()
            for s, turn in turns.items()
            for x, y in around
        ],
    )


def test_a_singular_pose_in_the_workspace_spoils_no_other(gachon) -> None:
    """A whole plane of the lattice is singular; the cost is the worst there, and finite."""
    rig = singular_in_the_middle(gachon)
    cost = KinematicCost(rig, np.eye(3))
    points = cost.lattice.points(np.arange(cost.lattice.count))
    assert (np.abs(points[:, 2] - 0.5) < 1e-9).any()
    assert np.isfinite(cost.values).all()
    assert cost.values.min() >= 0.0
    assert cost.values.max() <= 2.0


@pytest.mark.slow
def test_poses_without_a_cable_path_spoil_no_plan_elsewhere() -> None:
    """The whole frame as workspace: near an outlet an anchor would be inside its pulley."""
    rig = changed(
        paper_rig_with_pulleys(13.0),
        workspace={"lower_mm": [-500.0, -500.0, 0.0], "upper_mm": [500.0, 500.0, 900.0]},
    )
    cost = KinematicCost(rig, np.eye(3))
    assert np.isfinite(cost.values).all()
    scene = free_scene((0.0, 0.0, 400.0), (100.0, 50.0, 500.0))
    assert make_plan(rig, scene).waypoints[-1].pose().distance_to(scene.goal) < 1e-9


def test_winches_slower_than_the_platform_are_no_fault_of_the_program(gachon) -> None:
    winches = [w | {"max_speed_mm_s": 5.0} for w in gachon.document.model_dump()["winches"]]
    scene = free_scene((0.0, 0.0, 400.0), (100.0, 0.0, 400.0))
    with pytest.raises(BadInput, match="faster than its winch can") as caught:
        make_plan(changed(gachon, winches=winches), scene)
    assert "motion.speed_mm_s" in caught.value.next_step


def test_an_end_near_a_pulleys_axis_is_refused_before_the_search() -> None:
    rig = paper_rig_with_pulleys(200.0)
    with pytest.raises(BadInput, match="swivel axis") as caught:
        make_plan(rig, free_scene((-100.0, 0.0, 400.0), (100.0, 0.0, 400.0)))
    assert "four pulley radii" in str(caught.value)
