"""During a run, cameras receive the encoder pose of the right time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from executor.trajectory.setpoints import PreparedRun
from model.pose import Pose
from tests.scenarios.stage import staged


def test_each_image_comes_with_the_drives_pose_of_its_own_time(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    """The table of the whole run is computed differently: all cycles at once, near the plan."""
    requests: list[tuple[float, Pose | None]] = []

    def trigger(
        time: float, asked: float, true_pose: Pose | None, encoder_pose: Pose | None
    ) -> None:
        requests.append((time, encoder_pose))

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
