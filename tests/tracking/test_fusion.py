"""Encoders and camera fused: better than each alone, robust to outliers, synchronised."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import chdtrc

from model.pose import Array, Pose, matrix_from_rotation_vector, rotation_vector_from_matrix
from tracking.fusion import GATE, OUTLIERS, Measured, fuse_with_encoders

CYCLE, PERIOD = 0.01, 0.1
TAG = np.array([3e-4] * 3 + [np.radians(0.03)] * 3)


def truth_at(time: float) -> Pose:
    position = np.array([0.03 * time, 0.05 * np.sin(0.4 * time), 0.4])
    return Pose(position, matrix_from_rotation_vector(np.array([0.0, 0.0, 0.05 * time])))


def error(found: Pose, truth: Pose) -> Array:
    turn = rotation_vector_from_matrix(found.rotation @ truth.rotation.T)
    return np.concatenate([found.position - truth.position, turn])


def moved(pose: Pose, step: Array) -> Pose:
    return Pose(pose.position + step[:3], matrix_from_rotation_vector(step[3:]) @ pose.rotation)


def drives(times: Array, drift: float = 2e-4) -> list[Pose]:
    """Encoder poses off by 4 mm and half a degree, with a drift [m/s]."""
    off = [np.array([0.004, -0.002, drift * t, 0.0, 0.008, 0.0]) for t in times]
    return [moved(truth_at(t), o) for t, o in zip(times, off, strict=True)]


def camera(rng: np.random.Generator, until: float, outliers: float = 0.0) -> list[Measured]:
    found = []
    for time in np.arange(0.003, until, PERIOD):  # never at the time of a cycle
        step = TAG * rng.standard_normal(6)
        if rng.random() < outliers:
            step = step + np.array([0.03, 0.0, -0.02, 0.1, 0.0, 0.0])
        found.append(Measured(float(time), moved(truth_at(time), step), np.diag(TAG**2)))
    return found


def test_together_they_are_better_than_each_alone() -> None:
    times = np.arange(0.0, 8.0, CYCLE)
    by_drives, seen = drives(times), camera(np.random.default_rng(1), 8.0)
    found = list(fuse_with_encoders(times.tolist(), by_drives, seen))
    errors = np.array([error(f.pose, truth_at(f.time)) for f in found if f.time > 1.0])
    rms = np.sqrt(np.mean(np.sum(errors[:, :3] ** 2, axis=1)))
    assert rms < 0.6 * np.sqrt(3) * TAG[0]
    assert rms < 0.1 * 0.004
    values = [
        e @ np.linalg.solve(f.covariance, e)
        for e, f in zip(errors, found[-len(errors) :], strict=True)
    ]
    assert 1.0 < np.mean(values) < 8.0, "6 would be exact; the wander allowed for was not used up"


def test_one_measurement_in_ten_is_wrong_and_none_of_them_moves_the_pose() -> None:
    times = np.arange(0.0, 8.0, CYCLE)
    seen = camera(np.random.default_rng(2), 8.0, outliers=0.1)
    assert any(m.pose.distance_to(truth_at(m.time)) > 0.02 for m in seen[1:])
    found = list(fuse_with_encoders(times.tolist(), drives(times), seen))
    assert max(f.pose.distance_to(truth_at(f.time)) for f in found) < 1.5e-3


def test_measurements_are_compared_with_the_drives_at_their_own_time() -> None:
    """At 0.03 m/s a time error of 50 ms costs 1.5 mm."""
    times = np.arange(0.0, 4.0, 0.1)  # slow cycles, so that they are far from images
    exact = [Measured(t + 0.05, truth_at(t + 0.05), np.eye(6) * 1e-12) for t in times[:-1]]
    found = list(fuse_with_encoders(times.tolist(), [truth_at(t) for t in times], exact))
    assert max(f.pose.distance_to(truth_at(f.time)) for f in found) < 1e-4


def test_a_difference_that_jumps_is_believed_after_some_time() -> None:
    """A cable slips: from then on the encoders have another error."""
    times = np.arange(0.0, 6.0, CYCLE)
    by_drives = [
        moved(truth_at(t), np.array([0.02 if t > 3.0 else 0.0, 0, 0, 0, 0, 0])) for t in times
    ]
    found = list(
        fuse_with_encoders(times.tolist(), by_drives, camera(np.random.default_rng(3), 6.0))
    )
    off = {f.time: f.pose.distance_to(truth_at(f.time)) for f in found}
    assert max(v for t, v in off.items() if t < 3.0) < 2e-3
    settled = 3.0 + (OUTLIERS + 2) * PERIOD
    assert max(v for t, v in off.items() if t > settled) < 2e-3


def test_without_measurements_nothing_is_fused() -> None:
    times = np.arange(0.0, 1.0, CYCLE)
    assert list(fuse_with_encoders(times.tolist(), drives(times), [])) == []
    assert list(fuse_with_encoders([], [], camera(np.random.default_rng(1), 0.5))) == []


def test_uncertainty_and_age_grow_until_the_next_measurement() -> None:
    times = np.arange(0.0, 1.0, CYCLE)
    only = camera(np.random.default_rng(4), 0.05)
    found = list(fuse_with_encoders(times.tolist(), drives(times), only))
    assert found[-1].age == pytest.approx(found[-1].time - only[0].time)
    deviations = [float(np.trace(f.covariance)) for f in found]
    assert deviations == sorted(deviations)
    assert deviations[-1] > deviations[0]


def test_the_gate_lets_all_but_one_true_measurement_in_ten_thousand_through() -> None:
    assert chdtrc(6, GATE) == pytest.approx(1e-4, rel=0.05)
