"""The platform pose, recovered from the drive positions that hold it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from executor.drives import current_pose
from model.errors import CdprError
from model.files.scene_file import LoadDocument
from model.kinematics import cables_at
from model.pose import Array, Pose, matrix_from_rotation_vector
from model.rig import Rig, load_rig, rig_from_document
from model.scene import load_from_document
from model.statics.gravity import working_tensions
from model.winches import WinchMap
from tests.cli.plans import HALL, RIG


def with_stiffness(rig: Rig, stiffness_n: float) -> Rig:
    cables = rig.document.cables.model_copy(update={"stiffness_n": stiffness_n})
    return rig_from_document(rig.document.model_copy(update={"cables": cables}))


LOAD = load_from_document(LoadDocument())
PAPER, HALL_RIG = load_rig(RIG), load_rig(HALL)
#: Where a pose changes tensions, and so the stretch of the cables, by more than the pose itself.
SOFT_HALL = with_stiffness(HALL_RIG, 20000.0)
shares = st.tuples(*[st.floats(0.2, 0.8)] * 3)
turns = st.tuples(*[st.floats(-0.03, 0.03)] * 3)


def planned_counts(rig: Rig, pose: Pose) -> Array:
    """Drive positions as in the set-point table."""
    winches = WinchMap(rig)
    tensions = working_tensions(rig, pose, LOAD).tensions
    return np.rint(winches.counts(winches.unstrained(cables_at(rig, pose).lengths, tensions)))


@pytest.mark.parametrize("rig", [PAPER, HALL_RIG, SOFT_HALL], ids=["paper", "hall", "soft cables"])
@given(share=shares, turn=turns)
@settings(max_examples=15)
def test_a_pose_is_found_again_from_its_drive_positions(rig, share, turn):
    position = rig.workspace_lower + np.array(share) * (rig.workspace_upper - rig.workspace_lower)
    pose = Pose(position, matrix_from_rotation_vector(np.array(turn)))
    try:
        counts = planned_counts(rig, pose)
    except CdprError:  # the cables cannot hold this one
        return
    found = current_pose(rig, counts, LOAD)
    assert found.distance_to(pose) < 2e-5
    assert found.angle_to(pose) < 2e-4


def test_home_is_where_all_drives_are_at_home():
    home = np.array([winch.home_counts for winch in PAPER.winches], dtype=np.float64)
    assert current_pose(PAPER, home, LOAD).distance_to(PAPER.home) < 1e-6


@pytest.mark.parametrize("cable", range(8))
def test_positions_of_a_drive_that_lost_its_reference_fit_no_pose(cable):
    counts = planned_counts(PAPER, PAPER.home)
    counts[cable] += 0.1 * PAPER.winches[cable].counts_per_metre
    with pytest.raises(CdprError, match=r"fit no pose|no pose fits|cannot"):
        current_pose(PAPER, counts, LOAD)


@pytest.mark.parametrize("rig", [PAPER, HALL_RIG], ids=["paper", "hall"])
@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("outside", [0.0, 5e-6])
def test_on_a_face_of_the_workspace_rounded_counts_give_a_pose_of_it(rig, axis, outside):
    position = rig.home.position.copy()
    position[axis] = rig.workspace_upper[axis] + outside
    found = current_pose(rig, planned_counts(rig, Pose(position, rig.home.rotation)), LOAD)
    assert (found.position <= rig.workspace_upper).all()
    assert np.linalg.norm(found.position - position) < 5e-5


def test_a_pose_outside_the_workspace_is_refused():
    outside = Pose.level(PAPER.workspace_upper + np.array([0.005, 0.0, -0.1]))
    with pytest.raises(CdprError, match="fit no pose in the workspace"):
        current_pose(PAPER, planned_counts(PAPER, outside), LOAD)
