"""Clearances from the encoders: the smallest is found at every speed, with few rows."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import pytest

from executor.cameras.multi_camera import CameraRecords
from executor.evaluation import _clearance
from executor.recording.clearance import ClearanceTable, _motion
from executor.recording.summary import _clearance as smallest
from executor.recording.tables import CycleTable
from executor.recording.verdict import distances
from model.clearance import ClearanceModel
from model.pose import Array, Pose, matrix_from_rotation_vector, quaternion_from_matrix
from model.rig import Rig, load_rig
from model.scene import Scene, load_scene
from tests.executor import fake_run

CYCLE_M = 0.005
"""Motion in a cycle of 10 ms at 0.5 m/s."""


@dataclass(frozen=True)
class Passage:
    """A straight line past a thin post, and the clearance at every point, shape (n,), [m]."""

    rig: Rig
    scene: Scene
    line: Array
    clearance: Array


@pytest.fixture(scope="module", params=[240.0, 270.0])
def passage(request: pytest.FixtureRequest) -> Passage:
    rig = load_rig(fake_run.ROOT / "configs/gachon_8_6.yaml")
    data = load_scene(fake_run.ROOT / "configs/environment_1.yaml").as_dict()
    height = request.param
    box = {"size_mm": [5.0, 5.0, height]}
    data["obstacles"] = [{"name": "post", "position_mm": [0.0, 87.5, height / 2.0], "box": box}]
    data["start"] = {"position_mm": [-230.0, 0.0, 300.0]}
    data["goal"] = {"position_mm": [230.0, 0.0, 300.0]}
    scene = Scene.from_dict(data)
    model = ClearanceModel(rig, scene)
    x = np.arange(-0.23, 0.23, CYCLE_M)
    line = np.column_stack([x, np.zeros(len(x)), np.full(len(x), 0.3)])
    found = [min(n.distance for n in model.obstacles(Pose.level(p))) for p in line]
    clearance = np.array(found)
    # Begun so that the smallest one is far from every tenth cycle.
    first = max(range(10), key=lambda k: clearance[k::10].min())
    assert clearance[first::10].min() > clearance.min() + 0.005
    return Passage(rig, scene, line[first:], clearance[first:])


def measured(rig: Rig, scene: Scene, line: Array) -> ClearanceTable:
    """The rows of a run that is at one point of a line in each cycle."""
    some = fake_run.make(rate_hz=2.0, every=20).cycles
    count = len(line)
    first = CycleTable(**{f.name: getattr(some, f.name)[:count] for f in fields(CycleTable)})
    times = np.arange(count) * fake_run.CYCLE
    cycles = replace(first, time=times, planned=line, encoder=line)
    return _clearance(rig, scene, cycles, CameraRecords())


def test_the_smallest_clearance_of_a_fast_run_is_that_of_all_cycles(passage: Passage) -> None:
    table = measured(passage.rig, passage.scene, passage.line)
    found = smallest(table, 0.0)
    assert found is not None
    least = passage.clearance.min() * 1e3
    assert found["measured_min"] == pytest.approx(least, abs=1.0)
    assert found["planned_min"] == pytest.approx(least, abs=1.0)
    (check,) = distances(table, (least + 3.0) / 1e3)
    assert not check.passed


def test_rows_are_added_only_where_the_smallest_may_lie(passage: Passage) -> None:
    table = measured(passage.rig, passage.scene, passage.line)
    cycles = np.rint(table.time / fake_run.CYCLE).astype(int)
    assert (np.diff(cycles) > 0).all()
    assert {*range(0, len(passage.line), 10)} <= {*cycles.tolist()}
    assert len(table) < len(passage.line) / 2
    assert table.distance == pytest.approx(passage.clearance[cycles], abs=1e-6)


@pytest.mark.parametrize("ends_after", [1, 5, 9])
def test_a_record_that_ends_in_motion_has_a_row_at_its_end(
    passage: Passage, ends_after: int
) -> None:
    """As at a collision: the last tenth of a second counted only up to its beginning."""
    nearest = int(np.argmin(passage.clearance))
    line = passage.line[(nearest - ends_after) % 10 : nearest + 1]
    table = measured(passage.rig, passage.scene, line)
    assert table.distance.min() == pytest.approx(passage.clearance.min(), abs=1e-6)
    backwards = measured(passage.rig, passage.scene, line[::-1])
    assert backwards.distance.min() == pytest.approx(passage.clearance.min(), abs=1e-6)


def test_a_slow_run_has_ten_rows_per_second(passage: Passage) -> None:
    middle = int(np.argmin(passage.clearance))
    x = passage.line[middle] + np.arange(-45.0, 45.0)[:, None] * [0.0002, 0.0, 0.0]
    table = measured(passage.rig, passage.scene, x)
    assert table.time == pytest.approx(np.arange(0.0, 0.9, 0.1))


def test_the_motion_of_a_rotating_platform_is_that_of_its_farthest_point() -> None:
    """Both signs of a quaternion are one rotation."""
    run = fake_run.make(rate_hz=2.0, every=20)
    rig, count = run.context.rig, len(run.cycles)
    angles = np.linspace(0.0, 3.0, count)
    turns = [quaternion_from_matrix(matrix_from_rotation_vector([0.0, 0.0, a])) for a in angles]
    signs = np.where(np.arange(count) % 2, -1.0, 1.0)
    cycles = replace(
        run.cycles,
        encoder=np.zeros((count, 3)),
        encoder_rotation=np.array(turns) * signs[:, None],
    )
    motion = _motion(rig, cycles, np.arange(count))
    reach = np.linalg.norm(np.vstack([rig.anchors, rig.platform_corners]), axis=1).max()
    assert motion == pytest.approx(angles * reach)
