"""Self clearance of rigs of every build: edges and regions against `ClearanceModel`, sampled.

The required clearance is set next to the one that an edge has, so that each decision is close.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from model.clearance import ClearanceModel
from model.errors import CdprError
from model.pose import Array
from model.rig import Rig
from planner.collision.self_collision_regions import PROVED, REFUTED, compared
from planner.collision.world import (
    build_robot,
    build_world,
    self_edge_free,
    self_rotating_edge_free,
    unproved_robot,
)
from tests.configs import GACHON
from tests.effort import cases
from tests.planner.collision.random_builds import Build, random_build, rig_of
from tests.planner.collision.sampled_oracle import changed_rig, random_scene

EMPTY = random_scene(np.random.default_rng(0), GACHON, 0)
SAMPLES = 129
CLOSER = 33
"""Samples about the smallest so far: three rounds lead to 2e-6 of an edge."""
CLOSE = 2e-6
"""Distance of the required clearance from that of an edge, [m]."""
CLOSE_IF_BOUNDED = 1e-4
"""As `CLOSE`, where exits move on pulleys or the platform rotates: motion is then only bounded, and
an edge with little room all along would take more intervals than are tried."""


def open_frame() -> Rig:
    """The paper's rig with its platform's box sunk below the plane of the upper anchors."""
    platform = GACHON.document.platform.model_dump(mode="json") | {"size_mm": [130, 130, 20]}
    return changed_rig(GACHON, platform=platform)


def edges_of(rig: Rig, rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    low, high = rig.workspace_lower, rig.workspace_upper
    starts = rng.uniform(low, high, (count, 3))
    reach = rng.choice([1e-5, 0.01, 0.1], (count, 1))
    return starts, np.clip(starts + reach * rng.normal(size=(count, 3)), low, high)


def rotations_along(first: Rotation, turn: Array, shares: Array) -> Array:
    rotated: Array = (first * Rotation.from_rotvec(shares[:, None] * turn)).as_matrix()
    return rotated


class Along:
    """The sampled self clearance along one edge."""

    def __init__(self, rig: Rig, start: Array, end: Array, first: Rotation, turn: Array) -> None:
        self.model = ClearanceModel(rig, EMPTY)
        self.start, self.end, self.first, self.turn = start, end, first, turn

    def at(self, shares: Array) -> Array:
        positions = self.start + shares[:, None] * (self.end - self.start)
        return self.model.self_clearances(positions, rotations_along(self.first, self.turn, shares))

    def least(self) -> float:
        """The smallest clearance, sampled ever more closely about the smallest so far."""
        low, high, least = 0.0, 1.0, np.inf
        for samples in (SAMPLES, CLOSER, CLOSER, CLOSER):
            shares = np.linspace(low, high, samples)
            found = self.at(shares)
            at, width = int(np.argmin(found)), (high - low) / (samples - 1)
            least = min(least, float(found[at]))
            low, high = max(shares[at] - width, 0.0), min(shares[at] + width, 1.0)
        return least


def builds(count: int, seed: int) -> list[tuple[Build, Rig]]:
    rng, found = np.random.default_rng(seed), []
    while len(found) < count:
        build = random_build(rng)
        rig = rig_of(build, rng)
        try:
            ClearanceModel(rig, EMPTY).self_clearance(rig.home)
        except CdprError:  # an anchor within its pulley
            continue
        found.append((build, rig))
    return found


def test_rigs_with_anchors_off_the_box_of_their_platform_have_free_edges() -> None:
    rig = open_frame()
    home = rig.home.position
    world = build_world(rig, EMPTY, np.eye(3), 0.01)
    robot = build_robot(rig, world, 0.005)
    ends = home + np.array([[0.0, 0.0, 6e-6], [0.02, 0.0, 0.0], [-0.05, 0.04, 0.03]])
    model = ClearanceModel(rig, EMPTY)
    for end in ends:
        positions = home + np.linspace(0.0, 1.0, SAMPLES)[:, None] * (end - home)
        level = np.broadcast_to(np.eye(3), (SAMPLES, 3, 3))
        assert model.self_clearances(positions, level).min() > 0.005
    assert all(self_edge_free(world, robot, home, end) for end in ends)
    turn = np.array([0.0, 0.0, 0.01])
    assert self_rotating_edge_free(world, robot, home, ends[1], np.eye(3), turn)


@pytest.mark.parametrize("turns", [False, True])
def test_edges_of_every_build_are_free_up_to_touching_and_no_further(turns: bool) -> None:
    rng = np.random.default_rng(11)
    tested = {"free": 0, "refused": 0}
    for _, rig in builds(cases(24, 0.5), 5 + turns):
        world = build_world(rig, EMPTY, np.eye(3), 0.01)
        close = CLOSE_IF_BOUNDED if turns or rig.pulley_radius else CLOSE
        for start, end in zip(*edges_of(rig, rng, 6), strict=True):
            first = Rotation.from_rotvec(rng.normal(size=3) * 0.1 * turns)
            turn = rng.normal(size=3) * 0.1 * turns
            least = Along(rig, start, end, first, turn).least()
            args = (start, end, first.as_matrix(), turn)
            if least > close:
                tested["free"] += 1
                robot = unproved_robot(rig, world, least - close)
                assert self_rotating_edge_free(world, robot, *args)
            tested["refused"] += 1
            robot = unproved_robot(rig, world, max(least, 0.0) + CLOSE)
            assert not self_rotating_edge_free(world, robot, *args)
    assert min(tested.values()) > cases(60, 0.5)


def test_edges_are_decided_the_same_with_and_without_precomputed_proofs() -> None:
    rng = np.random.default_rng(12)
    answers: list[bool] = []
    for _, rig in builds(cases(10, 0.5), 6):
        world = build_world(rig, EMPTY, np.eye(3), 0.01)
        starts, ends = edges_of(rig, rng, 20)
        least = np.array(
            [Along(rig, *edge, Rotation.identity(), np.zeros(3)).least()
             for edge in zip(starts, ends, strict=True)]
        )  # fmt: skip
        if not least.max() > CLOSE:
            continue
        clearance = float(np.median(least[least > CLOSE])) - CLOSE
        robot = build_robot(rig, world, clearance)
        edges = zip(starts, ends, strict=True)
        free = np.array([self_edge_free(world, robot, *edge) for edge in edges])
        assert not free[least < clearance - CLOSE].any()
        assert free[least > clearance + CLOSE].all()
        answers += free.tolist()
    assert 0.2 < np.mean(answers) < 0.8


def test_no_region_is_proved_in_which_a_pose_is_too_near() -> None:
    rng = np.random.default_rng(13)
    proved = 0
    for _, rig in builds(cases(40, 0.5), 7):
        world = build_world(rig, EMPTY, np.eye(3), 0.01)
        model = ClearanceModel(rig, EMPTY)
        for _ in range(6):
            first = Rotation.from_rotvec(rng.normal(size=3) * 0.1)
            middle = rng.uniform(rig.workspace_lower, rig.workspace_upper)
            half = rng.uniform(0.0, 0.04, 3)
            angle = float(rng.choice([0.0, 0.05]))
            corners = middle + np.array([half * s for s in np.ndindex(2, 2, 2)]) * 2.0 - half
            inside = corners[rng.integers(0, 8, 40)] * (share := rng.uniform(size=(40, 1)))
            inside += (1.0 - share) * rng.uniform(middle - half, middle + half, (40, 3))
            axes = rng.normal(size=(40, 3))
            axes *= angle / np.linalg.norm(axes, axis=1, keepdims=True)
            rotations = (first * Rotation.from_rotvec(axes)).as_matrix()
            least = float(model.self_clearances(inside, rotations).min())
            clearance = max(least + float(rng.uniform(-0.004, 0.002)), 0.0)
            robot = unproved_robot(rig, world, clearance)
            found = [
                compared(world, robot, which, first.as_matrix(), corners, tuple(middle), angle)
                for which in range(len(robot.pairs) + rig.cable_count)
            ]
            proved += sum(answer == PROVED for answer in found)
            if all(answer == PROVED for answer in found):
                assert least >= clearance - 1e-9
    assert proved > cases(1000, 0.5)


def test_a_single_pose_is_decided_at_once() -> None:
    rng = np.random.default_rng(14)
    for _, rig in builds(cases(60, 0.5), 8):
        world = build_world(rig, EMPTY, np.eye(3), 0.01)
        model = ClearanceModel(rig, EMPTY)
        for position in rng.uniform(rig.workspace_lower, rig.workspace_upper, (10, 3)):
            first = Rotation.from_rotvec(rng.normal(size=3) * 0.1).as_matrix()
            least = float(model.self_clearances(position[None, :], first[None, :, :])[0])
            for clearance in (least - 1e-9, least + 1e-9):
                if clearance < 0.0:
                    continue
                robot = unproved_robot(rig, world, clearance)
                found = [
                    compared(world, robot, k, first, position[None, :], tuple(position), 0.0)
                    for k in range(len(robot.pairs) + rig.cable_count)
                ]
                expected = PROVED if clearance < least else REFUTED
                assert min(found) == expected
