"""A rig that differs from its file: drums, anchors, backlash, noise, lens, light."""

from __future__ import annotations

import ast
import itertools
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.can_bus import BusSettings, open_bus
from drivers.drive_group import GroupCommand
from drivers.factory import make_drive_group
from model.errors import BadInput
from model.files.rig_file import RigDocument
from model.kinematics import cable_lengths, forward_kinematics
from model.pose import Pose
from model.rig import Rig, load_rig, rig_from_document
from model.scene import Scene, load_scene
from model.statics.gravity import working_tensions
from simulation.drives.cia402_rig import SimulatedCia402Rig
from simulation.factory import make_synthetic_camera
from simulation.ground_truth import camera_as_built, rig_as_built
from simulation.plant import Plant
from simulation.rig import Transmission
from tracking.measurement import PoseMeasurement
from tracking.tracker import Tracker

ROOT = Path(__file__).resolve().parents[2]
_CHANNELS = itertools.count()


def imperfect(rig: Rig, **simulation: Any) -> Rig:
    document = rig.document.model_dump(mode="json") | {"simulation": simulation}
    return rig_from_document(RigDocument.model_validate(document))


def as_stated(rig: Rig) -> dict[str, Any]:
    """The truth of a rig that is built as its file says."""
    document = rig.document.model_dump(mode="json")
    return {
        "outlets_mm": document["outlets_mm"],
        "anchors_mm": document["anchors_mm"],
        "drums_mm_per_rev": [w["drum_mm_per_rev"] for w in document["winches"]],
        "home_counts": [0.0] * rig.cable_count,
    }


def rehearsal_of(rig: Rig, pose: Pose) -> SimulatedCia402Rig:
    bus = open_bus(BusSettings("virtual", f"imperfect-{next(_CHANNELS)}"))
    try:
        return SimulatedCia402Rig(rig, bus, pose)
    finally:
        bus.shutdown()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(ROOT / "configs/environment_3.yaml")


def test_a_rig_built_as_its_file_says_is_where_its_counts_say(rig: Rig) -> None:
    pose = Pose.level(rig.home.apply([0.08, -0.06, 0.05]))
    for robot in (rig, imperfect(rig, as_built=as_stated(rig))):
        assert rehearsal_of(robot, pose).pose.distance_to(pose) < 5e-6  # whole counts


def test_the_platform_of_wrong_drums_and_outlets_is_where_the_true_lengths_put_it(
    rig: Rig,
) -> None:
    """Independently: nominal counts, true drums, true geometry, forward kinematics."""
    truth = as_stated(rig)
    truth["outlets_mm"][3][0] += 0.4
    truth["drums_mm_per_rev"][5] *= 1.0005
    robot = imperfect(rig, as_built=truth)
    pose = Pose.level(rig.home.apply([0.1, 0.05, -0.05]))
    rehearsal = rehearsal_of(robot, pose)
    built, plant = rig_as_built(robot), rehearsal.plant
    unstrained = plant.winch_map.unstrained_from_counts(
        np.array([d.motor.position for d in rehearsal.drives])
    )
    lengths = plant.winch_map.strained(unstrained, rehearsal.tensions)
    taut = rehearsal.tensions > 0.0
    assert cable_lengths(built, rehearsal.pose)[taut] == pytest.approx(lengths[taut], abs=1e-9)
    assert rehearsal.pose.distance_to(pose) > 2e-5
    assert forward_kinematics(built, lengths, pose).pose.distance_to(rehearsal.pose) < 1e-4


def test_a_stiffer_cable_is_wound_off_longer_for_the_same_pull(rig: Rig) -> None:
    stiffness = np.full(rig.cable_count, 5000.0)
    stiffness[2] = 20000.0
    plant = Plant(rig, rig.home, stiffness=stiffness)
    pose = Pose.level(rig.home.apply([0.05, 0.0, 0.02]))
    tensions = working_tensions(rig, pose).tensions
    plant.settle(plant.winch_map.unstrained(cable_lengths(rig, pose), tensions))
    assert plant.pose.distance_to(pose) < 1e-8
    assert plant.tensions == pytest.approx(tensions, abs=1e-4)
    lengths = cable_lengths(rig, rig.home)
    held = working_tensions(rig, rig.home).tensions
    stretched = lengths / plant.winch_map.home_unstrained - 1.0
    assert stretched == pytest.approx(held / stiffness, rel=1e-9)


def test_a_cable_with_too_much_of_it_hangs_slack(rig: Rig) -> None:
    truth = as_stated(rig)
    per_metre = rig.winches[6].counts_per_metre
    truth["home_counts"][6] = -0.02 * per_metre  # 20 mm more is out than the drive's count says
    robot = imperfect(rig, as_built=truth)
    assert rehearsal_of(robot, rig.home).tensions[6] == 0.0


@given(
    motors=st.lists(st.floats(-500.0, 500.0), min_size=1, max_size=20), play=st.floats(0.0, 50.0)
)
def test_a_drum_is_within_half_its_backlash_of_its_motor(motors: list[float], play: float) -> None:
    transmission = Transmission(np.array([play]), 1.0, np.array([0.0]))
    before = 0.0
    for motor in motors:
        (drum,) = transmission.drums(np.array([motor]))
        assert abs(drum - motor) <= play / 2.0 + 1e-9
        assert drum == before or abs(abs(drum - motor) - play / 2.0) < 1e-9  # rests, or is pushed
        before = drum


def test_a_drum_with_steps_rests_only_at_whole_ones() -> None:
    transmission = Transmission(np.zeros(3), 8.0, np.zeros(3))
    assert transmission.drums(np.array([3.9, 4.1, -21.0])) == pytest.approx([0.0, 8.0, -24.0])


def reported_torques(robot: Rig) -> list[list[float]]:
    """Torques reported by the resting drives in some cycles after power-on."""
    settings = BusSettings("virtual", f"noisy-{next(_CHANNELS)}")
    with open_bus(settings) as far_end, open_bus(settings) as bus:
        rehearsal = SimulatedCia402Rig(robot, far_end, robot.home)
        group = make_drive_group(robot, bus, rehearsal.pump)
        group.configure()
        start = [int(p) for p in group.read_positions().positions]
        group.command(GroupCommand.ENABLE)
        reported = []
        for _ in range(30):
            group.send_cycle(start)
            reported.append([float(t) for t in group.receive(0.0).torques])
        group.close()
    return reported[-20:]


def test_tensions_are_reported_with_noise_and_with_the_same_noise_again(rig: Rig) -> None:
    noisy = imperfect(rig, seed=3, winches={"tension_noise_n": 0.5})
    reported = reported_torques(noisy)
    assert reported == reported_torques(noisy)
    assert np.std(reported, axis=0) == pytest.approx(5.0, abs=3.0)  # per mille of 100 N
    assert np.std(reported_torques(rig), axis=0).max() == 0.0


def test_images_are_taken_through_the_true_lens_and_the_tracker_assumes_another(
    rig: Rig, scene: Scene
) -> None:
    camera = rig.cameras[0]
    lens = {"fx_px": 930.0, "fy_px": 920.0, "cx_px": 630.0, "cy_px": 365.0}
    robot = imperfect(rig, cameras=[{"name": "front", "lens": lens, "noise": 0, "light": 0.5}])
    truth, optics = camera_as_built(robot, camera)
    assert truth.matrix[0, 0] == 930.0
    assert robot.cameras[0].matrix[0, 0] == camera.matrix[0, 0]
    assert optics.light == 0.5
    picture = make_synthetic_camera(robot, scene, camera).render(rig.home)
    corners, _, _ = cv2.aruco.ArucoDetector(
        cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    ).detectMarkers(picture)
    seen = np.array([c.reshape(4, 2).mean(axis=0) for c in corners])
    centres = np.array([rig.home.apply(tag.pose.position) for tag in rig.platform_tags])
    in_camera = truth.world_from_camera.inverse().apply(centres)
    pixels = in_camera[:, :2] / in_camera[:, 2:] * [930.0, 920.0] + [630.0, 365.0]
    nearest = [np.min(np.linalg.norm(seen - p, axis=1)) for p in pixels]
    assert sum(n < 2.0 for n in nearest) >= 2


def test_less_light_and_no_cables_show_in_the_picture(rig: Rig, scene: Scene) -> None:
    camera = rig.cameras[0]

    def shown(**values: Any) -> Any:
        robot = imperfect(rig, cameras=[{"name": "front", "noise": 0, **values}])
        return make_synthetic_camera(robot, scene, camera).render(rig.home).astype(float)

    full = shown(cables=False)
    assert shown(cables=False, light=0.5).mean() == pytest.approx(full.mean() / 2.0, rel=0.02)
    assert 100 < np.count_nonzero(shown() != full) < full.size / 20  # thin cables


def test_two_cameras_at_one_pose_differ_only_by_their_noise(rig: Rig, scene: Scene) -> None:
    first = rig.document.cameras[0]
    second = first.model_copy(update={"name": "second"})
    two = rig_from_document(rig.document.model_copy(update={"cameras": [first, second]}))
    pictures = [
        make_synthetic_camera(two, scene, camera).render(rig.home).astype(float)
        for camera in two.cameras
    ]
    apart = pictures[0] - pictures[1]
    assert abs(apart.mean()) < 0.01
    assert 1.0 < apart.std() < 3.0  # of 1.5 grey levels each


def test_true_tags_stay_where_they_are_whatever_the_rig_file_says(rig: Rig, scene: Scene) -> None:
    """So that a rehearsal shows what a wrong calibration of tags costs."""
    true = rig.document.tags
    assert true is not None
    truth = {"platform": [tag.model_dump(mode="json") for tag in true.platform]}
    shifted = [
        tag.model_copy(update={"position_mm": [tag.position_mm[0] + 10.0, *tag.position_mm[1:]]})
        for tag in true.platform
    ]
    robot = imperfect(rig, tags=truth)
    wrong = rig_from_document(
        robot.document.model_copy(update={"tags": true.model_copy(update={"platform": shifted})})
    )
    image = make_synthetic_camera(wrong, scene, wrong.cameras[0]).render(rig.home)
    found = Tracker(wrong, wrong.cameras[0]).observe(image, 0.0)
    assert isinstance(found, PoseMeasurement)
    assert found.pose.position - rig.home.position == pytest.approx([-0.01, 0.0, 0.0], abs=5e-4)


@pytest.mark.parametrize(
    ("simulation", "key", "what"),
    [
        ({"as_built": "short"}, "simulation.as_built.outlets_mm", "needs 8 entries"),
        ({"as_built": "pulleys"}, "pulley_radius_mm", "the rig has no pulleys"),
        ({"cameras": [{"name": "rear"}]}, "simulation.cameras[0].name", "unknown camera"),
        ({"cameras": [{"name": "front"}] * 2}, "simulation.cameras[1].name", "appears twice"),
        (
            {"tags": {"platform": [{"id": 999, "size_mm": 96, "position_mm": [0, 0, 65]}]}},
            "simulation.tags.platform[0].id",
            "has no tag 999",
        ),
        (
            {"cameras": [{"name": "front", "exposure_ms": 101}]},
            "simulation.cameras[0].exposure_ms",
            "exceeds the frame period at 10 images/s",
        ),
    ],
)
def test_a_simulation_that_does_not_fit_the_rig_is_refused_by_key(
    rig: Rig, simulation: dict[str, Any], key: str, what: str
) -> None:
    truth = as_stated(rig)
    if simulation.get("as_built") == "short":
        simulation = {"as_built": truth | {"outlets_mm": truth["outlets_mm"][:7]}}
    elif simulation.get("as_built") == "pulleys":
        simulation = {"as_built": truth | {"pulley_radius_mm": 10.0}}
    with pytest.raises(BadInput, match=what) as error:
        imperfect(rig, **simulation)
    assert key in str(error.value)


def test_a_true_lens_with_three_coefficients_is_refused(rig: Rig) -> None:
    lens = {"fx_px": 900.0, "fy_px": 900.0, "cx_px": 640.0, "cy_px": 360.0}
    lens_of_three = lens | {"distortion": [0.1, 0.2, 0.3]}
    robot = imperfect(rig, cameras=[{"name": "front", "lens": lens_of_three}])
    with pytest.raises(BadInput, match="it has 3"):
        camera_as_built(robot, robot.cameras[0])


def test_plans_do_not_hang_on_how_a_rig_is_simulated(rig: Rig) -> None:
    assert imperfect(rig, as_built=as_stated(rig)).plan_hash == rig.plan_hash


def test_the_rig_for_rehearsals_is_not_built_as_its_file_says() -> None:
    rig = load_rig(ROOT / "configs/gachon_8_6_rehearsal.yaml")
    built = rig_as_built(rig)
    off = np.linalg.norm(built.outlets - rig.outlets, axis=1)
    assert off.min() > 0.5e-3
    assert off.max() < 15e-3
    assert built.mass == rig.mass


def test_only_the_simulation_looks_at_what_a_simulated_rig_truly_is() -> None:
    """Else the executor, the tracker or a calibration could know what only the plant may."""
    for package in ("planner", "executor", "drivers", "tracking", "calibration", "cdpr"):
        for path in (ROOT / package).rglob("*.py"):
            if path.name in ("rig_file.py", "simulation_file.py"):
                continue
            nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            names = {n.attr for n in nodes if isinstance(n, ast.Attribute)}
            assert not names & {"simulation", "as_built"}, path
