"""The plant against independent statics: equilibrium, stiffness, slack, energy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, reject
from hypothesis import strategies as st
from scipy.optimize import minimize

from model.errors import Fault
from model.files.rig_file import RigDocument
from model.kinematics import cable_lengths, structure_matrix
from model.pose import Array, Pose, matrix_from_rotation_vector
from model.rig import Rig, rig_from_document
from model.scene import Load
from model.statics.gravity import weight_wrench, working_tensions
from model.statics.tension_distribution import TensionInfeasible
from model.winches import WinchMap
from simulation import plant as plant_module
from simulation.equilibrium.newton import StrainedCables, bend, is_positive, slope, solve, strain
from simulation.plant import Plant, Suspension

WEIGHT = 0.4 * 9.80665

share = st.floats(0.1, 0.9)
turn = st.floats(-0.05, 0.05)


def pose_in(rig: Rig, fraction: tuple[float, ...], rotation: tuple[float, ...]) -> Pose:
    span = rig.workspace_upper - rig.workspace_lower
    return Pose(
        rig.workspace_lower + np.array(fraction) * span, matrix_from_rotation_vector(rotation)
    )


def counts_for(plant: Plant, rig: Rig, pose: Pose, tensions: Array) -> Array:
    """Drive positions for a pose with given tensions, not rounded."""
    return plant.winch_map.counts(plant.winch_map.unstrained(cable_lengths(rig, pose), tensions))


def changed(rig: Rig, part: str, **values: object) -> Rig:
    document = rig.document.model_dump()
    document[part].update(values)
    return rig_from_document(RigDocument.model_validate(document))


@given(fraction=st.tuples(share, share, share), rotation=st.tuples(turn, turn, turn))
@pytest.mark.parametrize("pulleys", [False, True])
def test_drums_wound_for_a_pose_hold_the_platform_there(
    rig: Rig,
    pulley_rig: Rig,
    pulleys: bool,
    fraction: tuple[float, ...],
    rotation: tuple[float, ...],
) -> None:
    """Counts for pose and tensions, from somewhere else, lead back to pose and tensions."""
    robot = pulley_rig if pulleys else rig
    pose = pose_in(robot, fraction, rotation)
    try:
        tensions = working_tensions(robot, pose).tensions
    except TensionInfeasible:
        reject()
    plant = Plant(robot, robot.home)
    plant.settle_counts(counts_for(plant, robot, pose, tensions))
    assert plant.pose.distance_to(pose) < 1e-9
    assert plant.pose.angle_to(pose) < 1e-8
    assert plant.tensions == pytest.approx(tensions, abs=1e-4)


def test_home_counts_hold_the_platform_at_home(rig: Rig) -> None:
    shifted = [
        w | {"home_counts": 1000 * i} for i, w in enumerate(rig.document.model_dump()["winches"])
    ]
    document = rig.document.model_dump() | {"winches": shifted}
    robot = rig_from_document(RigDocument.model_validate(document))
    plant = Plant(robot, robot.home)
    counts = counts_for(plant, robot, robot.home, working_tensions(robot, robot.home).tensions)
    assert counts == pytest.approx([1000.0 * i for i in range(8)], abs=1e-6)


@given(
    shifts=st.lists(st.floats(-0.02, 0.02), min_size=8, max_size=8),
    fraction=st.tuples(share, share, share),
)
def test_cables_and_weight_balance_whatever_the_drums_do(
    rig: Rig, shifts: list[float], fraction: tuple[float, ...]
) -> None:
    """Slack or taut, forces and moments add up to nothing and no cable pushes."""
    pose = pose_in(rig, fraction, (0.0, 0.0, 0.0))
    plant = Plant(rig, pose)
    counts = counts_for(plant, rig, pose, plant.tensions)
    plant.settle_counts(counts + np.array(shifts) * [w.counts_per_metre for w in rig.winches])
    wrench = structure_matrix(rig, plant.pose) @ plant.tensions + weight_wrench(rig, plant.pose)
    assert np.abs(wrench).max() < 1e-6
    assert plant.tensions.min() >= 0.0


@given(
    offset=st.tuples(*[st.floats(-0.002, 0.002)] * 3),
    rotation=st.tuples(*[st.floats(-0.01, 0.01)] * 3),
)
def test_wrench_is_the_slope_of_the_energy(
    rig: Rig, offset: tuple[float, ...], rotation: tuple[float, ...]
) -> None:
    plant = Plant(rig, rig.home)
    pose = Pose(rig.home.position + np.array(offset), matrix_from_rotation_vector(rotation))
    wrench, step = plant.residual(pose), 1e-6
    slope = np.empty(6)
    for axis in range(6):
        twist = np.zeros(6)
        twist[axis] = step
        ends = [
            plant.energy(
                Pose(
                    pose.position + sign * twist[:3],
                    matrix_from_rotation_vector(sign * twist[3:]) @ pose.rotation,
                )
            )
            for sign in (1.0, -1.0)
        ]
        slope[axis] = (ends[0] - ends[1]) / (2.0 * step)
    # A cable that is taut on one side only bends the energy within the step.
    bend = rig.cable_stiffness.max() / 0.5 * step
    assert wrench == pytest.approx(-slope, abs=bend + 1e-6 * np.abs(wrench).max())


def test_stiff_cables_are_inverse_kinematics(rig: Rig) -> None:
    """With ever stiffer cables a shift of the drums is a shift of the kinematic pose."""
    goal = Pose.level(rig.home.position + np.array([0.05, -0.03, 0.04]))
    drums = cable_lengths(rig, goal) - cable_lengths(rig, rig.home)
    gaps = []
    for stiffness in (1e6, 1e8):
        robot = changed(rig, "cables", stiffness_n=stiffness)
        plant = Plant(robot, robot.home)
        counts = counts_for(plant, robot, robot.home, plant.tensions)
        # A little shorter everywhere: pretension instead of rounding decides the rest.
        shorter = drums - 1.0 / stiffness
        plant.settle_counts(counts + shorter * [w.counts_per_metre for w in robot.winches])
        gaps.append(plant.pose.distance_to(goal))
    assert gaps[1] < gaps[0] / 50
    assert gaps[1] < 1e-6


@pytest.mark.parametrize("stiffness", [1e7, 1e9])
def test_the_stiffest_cables_of_a_rig_file_settle(rig: Rig, stiffness: float) -> None:
    """A residual force below the round-off of their lengths was never reached."""
    robot = changed(rig, "cables", stiffness_n=stiffness)
    goal = Pose.level(robot.home.position + np.array([0.05, -0.03, 0.04]))
    plant = Plant(robot, robot.home)
    plant.settle_counts(counts_for(plant, robot, goal, working_tensions(robot, goal).tensions))
    assert plant.pose.distance_to(goal) < 1e-9


def test_a_known_load_lowers_the_platform_by_force_over_stiffness(rig: Rig) -> None:
    """A payload of 0.1 kg against the stiffness taken from the structure matrix."""
    mass = 0.1
    load = Load(mass, np.zeros(3), np.zeros(3), np.zeros(3))
    tensions = working_tensions(rig, rig.home).tensions
    plant = Plant(rig, rig.home, load)
    plant.settle_counts(counts_for(plant, rig, rig.home, tensions))  # wound for the empty platform
    matrix = structure_matrix(rig, rig.home)
    lengths = cable_lengths(rig, rig.home)
    stiffness = (matrix * rig.cable_stiffness / lengths) @ matrix.T
    sag = np.linalg.solve(stiffness, [0, 0, -mass * 9.80665, 0, 0, 0])
    moved = plant.pose.position - rig.home.position
    assert moved == pytest.approx(sag[:3], rel=1e-2, abs=1e-9)


def test_a_cable_paid_out_goes_slack_and_the_rest_carry(rig: Rig) -> None:
    plant = Plant(rig, rig.home)
    counts = counts_for(plant, rig, rig.home, plant.tensions).copy()
    counts[4] += 0.05 * rig.winches[4].counts_per_metre
    plant.settle_counts(counts)
    assert plant.tensions[4] == 0.0
    wrench = structure_matrix(rig, plant.pose) @ plant.tensions + weight_wrench(rig, plant.pose)
    assert np.abs(wrench).max() < 1e-6


def test_hanging_on_slack_lower_cables_is_the_lowest_energy(rig: Rig) -> None:
    """All lower cables paid out: the pose is the minimum that another search finds too."""
    plant = Plant(rig, rig.home)
    counts = counts_for(plant, rig, rig.home, plant.tensions).copy()
    counts[4:] += 0.2 * np.array([w.counts_per_metre for w in rig.winches[4:]])
    plant.settle_counts(counts)
    assert (plant.tensions[4:] == 0.0).all()
    vertical = plant.tensions @ structure_matrix(rig, plant.pose)[2]
    assert vertical == pytest.approx(WEIGHT, abs=1e-6)

    def energy(twist: np.ndarray) -> float:
        rotated = matrix_from_rotation_vector(twist[3:]) @ plant.pose.rotation
        return plant.energy(Pose(plant.pose.position + twist[:3], rotated))

    start = np.array([0.002, -0.001, -0.002, 0.01, -0.01, 0.005])
    other = minimize(energy, start, method="Nelder-Mead", options={"maxiter": 4000})
    assert other.fun >= plant.energy(plant.pose) - 1e-9


def test_the_same_drums_give_the_same_pose(rig: Rig) -> None:
    poses = []
    for _ in range(2):
        plant = Plant(rig, rig.home)
        for shift in (0.0003, 0.0005, -0.0002):
            counts = counts_for(plant, rig, rig.home, plant.tensions)
            plant.settle_counts(counts + shift * 1e5)
        poses.append(plant.pose.matrix())
    assert np.array_equal(*poses)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1e9])
def test_absurd_drum_positions_are_a_fault_that_says_so(rig: Rig, bad: float) -> None:
    plant = Plant(rig, rig.home)
    counts = counts_for(plant, rig, rig.home, plant.tensions).copy()
    counts[0] = bad
    with pytest.raises(Fault, match="simulation failed"):
        plant.settle_counts(counts)


@given(
    fraction=st.tuples(share, share, share),
    rotation=st.tuples(turn, turn, turn),
    winding=st.lists(st.floats(-1e-3, 3e-3), min_size=10, max_size=10),
)
@pytest.mark.parametrize("pulleys", [False, True])
def test_compiled_forces_and_stiffness_are_those_of_the_readable_code(
    rig: Rig,
    pulley_rig: Rig,
    pulleys: bool,
    fraction: tuple[float, ...],
    rotation: tuple[float, ...],
    winding: list[float],
) -> None:
    """Cables taut and slack, over pulleys and through points: the same numbers to rounding."""
    robot = pulley_rig if pulleys else rig
    pose, count = pose_in(robot, fraction, rotation), robot.cable_count
    winches = WinchMap(robot)
    whole = winches.unstrained(cable_lengths(robot, pose), np.zeros(count))
    hung = Suspension.wound(robot, winches, whole / (1.0 + np.array(winding[:count])), None)
    cables, strains = hung.strained(pose)
    tensions = hung.axial * np.maximum(strains, 0.0)
    rates = hung.rates(strains > 0.0)
    rotated = np.array(pose.rotation)
    seen = StrainedCables(
        np.empty((count, 3)), np.empty((count, 6)), np.empty(count), np.empty(count)
    )
    gradient, stiffness = np.empty(6), np.empty((6, 6))
    assert strain(hung.hanging, hung.unstrained, np.array(pose.position), rotated, seen)
    slope(hung.hanging, rotated, seen, tensions, gradient)
    bend(hung.hanging, rotated, seen, rates, tensions, stiffness)
    assert seen.strains == pytest.approx(strains, abs=1e-13)
    wanted = hung.gradient(pose, cables, tensions)
    assert gradient == pytest.approx(wanted, rel=1e-10, abs=1e-9)
    whole_matrix = hung.stiffness(pose, cables, rates, tensions)
    assert stiffness == pytest.approx(whole_matrix, rel=1e-10, abs=1e-10 * hung.axial.max())


@pytest.mark.parametrize("pulleys", [False, True])
def test_the_quick_search_and_the_descent_find_the_same_platform(
    rig: Rig, pulley_rig: Rig, pulleys: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two independent searches, one compiled and one down the energy, drum step by drum step."""
    robot = pulley_rig if pulleys else rig
    dice = np.random.default_rng(7)
    quick, slow = Plant(robot, robot.home), Plant(robot, robot.home)
    counts = counts_for(quick, robot, robot.home, quick.tensions)
    per_metre = np.array([w.counts_per_metre for w in robot.winches])
    slack = False
    for _ in range(40):
        counts = counts + dice.uniform(-1e-3, 1.5e-3, robot.cable_count) * per_metre
        quick.settle_counts(counts)
        with monkeypatch.context() as patch:
            patch.setattr(plant_module, "QUICK_STEPS", 0)
            slow.settle_counts(counts)
        slack = slack or bool((quick.tensions == 0.0).any())
        assert quick.pose.distance_to(slow.pose) < 1e-8
        assert quick.pose.angle_to(slow.pose) < 1e-7
        assert quick.tensions == pytest.approx(slow.tensions, abs=1e-4)
    assert slack


@given(shifts=st.lists(st.floats(-0.01, 0.02), min_size=8, max_size=8))
def test_a_slack_cable_carries_nothing_and_a_taut_one_what_its_stretch_asks(
    rig: Rig, shifts: list[float]
) -> None:
    """Tensions by Hooke's law from lengths that the kinematics gives."""
    plant = Plant(rig, rig.home)
    counts = counts_for(plant, rig, rig.home, plant.tensions)
    counts = counts + np.array(shifts) * [w.counts_per_metre for w in rig.winches]
    plant.settle_counts(counts)
    unstrained = plant.winch_map.unstrained_from_counts(counts)
    whole = cable_lengths(rig, plant.pose) + plant.winch_map.behind_outlet
    pull = rig.cable_stiffness * (whole / unstrained - 1.0)
    assert plant.tensions == pytest.approx(np.maximum(pull, 0.0), abs=1e-6)


def test_a_matrix_that_is_not_positive_or_singular_is_seen() -> None:
    """The platform would tip, or Newton's step is not defined."""
    assert is_positive(np.eye(6))
    assert not is_positive(np.diag([1.0, 1.0, 1.0, 1.0, 1.0, -1e-9]))
    assert not is_positive(np.full((6, 6), np.nan))
    assert not solve(np.zeros((6, 6)), np.ones(6))
    dice = np.random.default_rng(3)
    for _ in range(20):
        matrix, vector = dice.normal(size=(6, 6)), dice.normal(size=6)
        found = vector.copy()
        assert solve(matrix.copy(), found)
        assert matrix @ found == pytest.approx(vector, abs=1e-9)
