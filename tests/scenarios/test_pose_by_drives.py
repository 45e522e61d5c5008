"""During a run, cameras receive the encoder pose of the right time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from executor.cameras.multi_camera import CameraRecords
from executor.evaluation import _clearance
from executor.recording.recorder import RunLog
from executor.state_machine import CycleRecord, PlatformPoses, State
from executor.trajectory.setpoints import PreparedRun
from model.kinematics import cable_lengths
from model.pose import Pose, interpolate, matrix_from_rotation_vector
from model.winches import WinchMap
from tests.scenarios.stage import staged


def test_each_image_comes_with_the_drives_pose_of_its_own_time(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    """The table of the whole run is computed differently: all cycles at once, near the plan."""
    requests: list[tuple[float, Pose | None]] = []

    def trigger(poses: PlatformPoses, _is_due: bool) -> None:
        requests.append((poses.time, poses.encoder))

    with staged(prepared, tmp_path / "run", lambda _stage: None) as stage:
        cycles = stage.run(trigger=trigger).log.table()
    assert len(requests) > 20
    rows = np.searchsorted(cycles.time, [time - 1e-6 for time, _ in requests])
    following = np.isfinite(cycles.following_error[rows])
    assert following.sum() > 20
    for k in np.flatnonzero(following):
        row, (time, pose) = rows[k], requests[k]
        assert abs(cycles.time[row] - time) < 1e-9
        assert pose is not None
        assert np.linalg.norm(pose.position - cycles.encoder[row]) < 1e-6
        beside = np.linalg.norm(np.diff(cycles.encoder[row - 1 : row + 2], axis=0), axis=1)
        if beside.min() > 1e-4:  # it moves: another cycle's pose would be seen
            before = np.linalg.norm(pose.position - cycles.encoder[row - 1])
            assert before > 5e-5


def test_soft_cables_tighter_than_planned_still_give_a_pose(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    """All drives are where they should be: the cables stretch in ways that no pose has."""
    with staged(prepared, tmp_path / "run", lambda _stage: None) as stage:
        log = stage.run().log
    record = log.last
    assert record is not None
    rig, table = prepared.rig, prepared.checked.table
    soft, row = WinchMap(rig, np.full(rig.cable_count, 3000.0)), round(record.index)
    lengths = cable_lengths(rig, table.poses()[row])
    counts = np.rint(soft.counts(soft.unstrained(lengths, table.tensions[row]))).astype(int)
    tight = RunLog(rig, stage.prepared.scene, replace(prepared.checked, winches=soft))
    torques = np.rint(rig.torques_by(3.0 * table.tensions[row])).astype(int)
    for more, drives_fit in ((0, True), (round(0.3 * soft.counts_per_metre[2]), False)):
        counts[2] += more
        one = replace(
            record,
            state=State.MOVING,
            actual=tuple(counts.tolist()),
            torques=tuple(torques.tolist()),
            following_error=0.0,
        )
        tight.add(one)
        assert (tight.encoder_pose(one) is not None) is drives_fit
    stretched = soft.strained(soft.unstrained_from_counts(counts), 3.0 * table.tensions[row])
    assert np.abs(stretched - lengths).max() > 0.005
    assert tight.table().has_encoder_pose.tolist() == [True, False]


def test_positions_that_fit_no_pose_give_neither_a_pose_nor_a_clearance(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    """A drive that let go coasts by 30 mm: its cable is slack, and the pose unknown."""
    with staged(prepared, tmp_path / "run", lambda _stage: None) as stage:
        log = stage.run().log
    assert log.table().has_encoder_pose.all()
    last, before = log.last, len(log)
    assert last is not None
    coasted = list(last.actual)
    coasted[2] += round(0.030 * float(prepared.checked.winches.counts_per_metre[2]))
    for k in range(1, 101):
        log.add(
            replace(
                last,
                cycle=last.cycle + k,
                at=last.at + 0.01 * k,
                state=State.LATCHED,
                actual=tuple(coasted),
                following_error=np.nan,
            )
        )
    assert log.last is not None
    assert log.encoder_pose(last) is not None
    assert log.encoder_pose(log.last) is None
    cycles = log.table()
    assert cycles.has_encoder_pose.tolist() == [True] * before + [False] * 100
    scene = stage.prepared.scene
    assert scene.obstacles
    clearance = _clearance(prepared.rig, scene, cycles, CameraRecords())
    assert 0.0 < cycles.time[before - 1] - clearance.time.max() < 0.1


def test_planned_orientation_is_that_of_the_fraction_of_a_row(prepared: PreparedRun) -> None:
    """Below full speed the drives follow set-points between two rows, here 1 degree apart."""
    table = prepared.checked.table
    angles = np.radians(np.arange(len(table)))
    turning = replace(
        table, rotations=[matrix_from_rotation_vector([0.0, 0.0, angle]) for angle in angles]
    )
    log = RunLog(prepared.rig, prepared.scene, replace(prepared.checked, table=turning))
    zeros = (0,) * prepared.rig.cable_count
    last = len(table) - 1.0
    indices = (35.0, 35.25, 35.5, 179.5, last, last)  # w is 0 at 180 degrees
    for cycle, index in enumerate(indices):
        counts = tuple(turning.setpoints[round(index)].tolist())
        log.add(
            CycleRecord(
                cycle, 0.01 * cycle, State.MOVING, index, 1.0, counts, counts,
                zeros, zeros, 0, 0, 0, 0.0, 0.0, (True,) * len(zeros),
            )
        )  # fmt: skip
    cycles, rows = log.table(), turning.poses()
    reported = (0.0, *indices[:-1])  # CiA 402 drives report the set-point sent in the cycle before
    assert cycles.path_index.tolist() == [round(index) for index in reported]
    for k, index in enumerate(reported):
        low = int(index)
        expected = interpolate(rows[low], rows[min(low + 1, len(rows) - 1)], index - low)
        planned = Pose.from_quaternion(cycles.planned[k], cycles.planned_rotation[k])
        assert planned.angle_to(expected) < 1e-6
        assert planned.distance_to(expected) < 1e-9
        if index == low:
            assert cycles.planned_rotation[k].tolist() == rows[low].quaternion.tolist()
