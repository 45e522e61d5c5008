"""Edges against the robot itself: bounds along an edge against dense sampling."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpr.clearance import ClearanceModel
from cdpr.poses import Pose, interpolate
from planner.self_edges import SelfEdges


@pytest.mark.parametrize(
    ("name", "required", "turn_deg"),
    [
        ("gachon", 0.0125, 0.0),
        ("gachon", 0.0110, 3.0),
        ("hall", 0.030, 0.0),
        ("hall", 0.025, 3.0),
    ],
)
def test_edges_decide_as_dense_sampling_does(
    name, required, turn_deg, gachon, hall, scene_with
) -> None:
    rig = {"gachon": gachon, "hall": hall}[name]
    edges, model = SelfEdges(rig, required), ClearanceModel(rig, scene_with())
    rng = np.random.default_rng(8)
    decided = []
    for _ in range(40):
        start = rng.uniform(rig.workspace_lower, rig.workspace_upper)
        end = start + rng.uniform(-0.08, 0.08, 3)
        turns = Rotation.from_rotvec(np.radians(rng.uniform(-turn_deg, turn_deg, (2, 3))))
        first, second = (Pose(p, r) for p, r in zip((start, end), turns.as_matrix(), strict=True))
        sampled = min(
            model.self_clearance(interpolate(first, second, t)).distance
            for t in np.linspace(0, 1, 30)
        )
        decided.append(edges.clear(first, second))
        if decided[-1]:
            assert sampled >= required - 1e-9
        else:  # refused although dense samples keep it: only within what two samples may hide
            assert sampled < required + 0.001
    assert 3 < sum(decided) < 38


def test_cables_in_one_plane_are_still_decided(gachon) -> None:
    """On the plane of symmetry of a symmetric robot the affine map of two cables does not exist."""
    from cdpr.rig import rig_from_document

    outlets = [
        [sx * 450.0, sy * 500.0, z] for z in (850.0, 80.0) for sy in (1, -1) for sx in (-1, 1)
    ]
    symmetric = rig_from_document(gachon.document.model_copy(update={"outlets_mm": outlets}))
    edges = SelfEdges(symmetric, 0.001)
    assert edges.clear(Pose.level([0, 0, 0.445]), Pose.level([0.03, 0, 0.445])) in (True, False)
    far = SelfEdges(gachon, 0.005)
    assert far.clear(Pose.level([0, 0, 0.445]), Pose.level([0.1, 0.1, 0.5]))
