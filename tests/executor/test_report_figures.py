"""Calculations for the figures: thinning, gaps, label positions, solids, the view."""

from __future__ import annotations

from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from executor.recording.run_folder import RunEvent
from executor.report.figures import (
    _coordinate,
    _difference,
    _error,
    _following,
    _obstacle,
    _smallest,
)
from executor.report.page import run_scene
from executor.report.tiles import event_table
from model.pages.charts import spread, thinned, with_gaps
from model.pages.viewer import Eye
from model.pose import Pose
from model.shapes import (
    Box,
    Capsule,
    Cylinder,
    Obstacle,
    Shape,
    Solid,
    Sphere,
    TriangleMesh,
    convex_hull,
    shape_points,
    solid_of,
)
from tests.executor import fake_run

SHAPES: dict[str, Shape] = {
    "box": Box(np.array([0.1, 0.2, 0.3])),
    "sphere": Sphere(0.2),
    "cylinder": Cylinder(0.1, 0.5),
    "capsule": Capsule(0.1, 0.5),
    "hull": convex_hull(np.random.default_rng(4).normal(size=(20, 3))),
}


@given(arrays(np.float64, st.integers(1, 3000), elements=st.floats(-1e3, 1e3) | st.just(np.nan)))
def test_a_thinned_line_keeps_its_ends_and_every_extreme(values: np.ndarray) -> None:
    time = np.arange(len(values), dtype=np.float64)
    x, y = thinned(time, values, 100)
    known = values[np.isfinite(values)]
    assert len(x) <= 104
    assert np.all(np.diff(x) > 0)
    np.testing.assert_array_equal(y, values[x.astype(int)])
    if known.size:
        assert (y.min(), y.max()) == (known.min(), known.max())
        assert (y[0], y[-1]) == (known[0], known[-1])


def test_a_line_is_broken_where_samples_are_missing() -> None:
    time = np.array([0.0, 0.1, 0.2, 0.7, 0.8])
    at, value = with_gaps(time, np.arange(5.0))
    assert len(at) == 6
    assert np.isnan(value[3])
    np.testing.assert_array_equal(value[np.isfinite(value)], np.arange(5.0))


def test_an_even_line_is_not_broken() -> None:
    time = np.linspace(0.0, 1.0, 11)
    at, value = with_gaps(time, time)
    np.testing.assert_array_equal(at, time)
    np.testing.assert_array_equal(value, time)


def test_a_line_whose_samples_are_denser_in_places_is_broken_only_beyond_its_largest_step() -> None:
    time = np.concatenate([np.linspace(0.0, 1.0, 101), np.linspace(1.1, 2.0, 10), [3.0]])
    at, value = with_gaps(time, time, step=0.1)
    assert at[np.isnan(value)] == pytest.approx([2.5])


VALUES = st.floats(-1e3, 1e3)


@given(
    arrays(np.float64, st.tuples(st.integers(3, 3000), st.just(3)), elements=VALUES),
    st.sets(st.integers(1, 2998), max_size=5),
)
def test_a_long_line_with_its_band_is_thinned_to_its_extremes_and_gaps(
    columns: np.ndarray, after: set[int]
) -> None:
    """The peaks of a band's edges are not at those of its line."""
    time = np.arange(len(columns), dtype=np.float64)
    for row in after:
        time[row:] += 1e4
    at, *drawn = with_gaps(time, *columns.T, most=210)
    assert len(at) <= 210 + 2
    assert np.all(np.diff(at) > 0)
    assert (at[0], at[-1]) == (time[0], time[-1])
    for values, thin in zip(columns.T, drawn, strict=True):
        known = np.isfinite(thin)
        np.testing.assert_array_equal(thin[known], values[np.searchsorted(time, at[known])])
        assert (thin[known].min(), thin[known].max()) == (values.min(), values.max())


@given(gap=st.integers(1, 35_999))
def test_the_gap_of_an_hour_of_images_is_drawn(gap: int) -> None:
    time = 0.1 * np.arange(36_000.0)
    time[gap:] += 60.0
    at, value = with_gaps(time, time)
    (row,) = np.flatnonzero(np.isnan(value))
    assert time[gap - 1] < at[row] < time[gap]
    assert len(at) < 1000


def repeated(table: Any, times: np.ndarray) -> Any:
    """A table whose rows repeat at other times."""
    chosen = np.arange(len(times)) % len(table)
    columns = {
        field.name: getattr(table, field.name)
        for field in fields(table)
        if field.name not in ("obstacles", "time")
    }
    more = {
        name: tuple(column[k] for k in chosen) if isinstance(column, tuple) else column[chosen]
        for name, column in columns.items()
    }
    return replace(table, time=times, **more)


def test_a_report_of_an_hour_holds_no_more_points_than_one_of_minutes() -> None:
    run, times = fake_run.make(rate_hz=2.0, every=20), 0.1 * np.arange(36_000.0)
    poses, clearance = repeated(run.poses, times), repeated(run.clearance, times)
    data: Any = SimpleNamespace(
        cycles=run.cycles, poses=poses, alone={"front": poses}, clearance=clearance,
        plan=run.context.plan, rig=run.context.rig, summary=run.summary,
    )  # fmt: skip
    drawn = [*(_coordinate(data, i) for i in range(3)), _error(data)]
    drawn += [_smallest(data), _difference(data), _obstacle(data, 0)]
    assert max(len(line.x) for chart in drawn for line in chart.lines) < 1000
    strokes = {stroke.layer: stroke for stroke in run_scene(data).scene.strokes}
    assert len(strokes["seen"].segments) < 1000


def test_the_planned_clearance_is_drawn_where_no_camera_saw_the_platform() -> None:
    run = fake_run.make(rate_hz=2.0, every=20)
    plan = run.clearance.of("encoder")
    least = int(np.argmin(plan.planned_distance))
    blind = np.abs(run.clearance.time - plan.time[least]) < 5.0
    seen = run.clearance._chosen(~blind | (np.array(run.clearance.source) == "encoder"))
    assert seen.of("tag").planned_distance.min() > plan.planned_distance[least] + 5e-4
    data: Any = SimpleNamespace(
        cycles=run.cycles, clearance=seen, plan=run.context.plan, summary=run.summary
    )
    for chart, expected in (
        (_smallest(data), plan.planned_distance),
        (_obstacle(data, 0), plan.planned_distances[:, 0]),
    ):
        (line,) = (line for line in chart.lines if line.name == "planned")
        assert np.nanmin(line.y) == pytest.approx(1e3 * expected.min())
        assert np.diff(line.x).max() < 1.0


@given(st.lists(st.floats(0.0, 10.0), min_size=1, max_size=12))
def test_labels_keep_apart_and_in_order(values: list[float]) -> None:
    positions = spread(values, 0.5)
    order = np.argsort(values, kind="stable")
    assert np.all(np.diff(np.sort(positions)) > 0.45)
    assert np.all(np.diff(positions[order]) > -1e-9) or len(set(values)) < len(values)


def volume(solid: Solid) -> float:
    """By the divergence theorem; right only for a closed surface that is oriented outward."""
    a, b, c = np.moveaxis(solid.triangles(), 1, 0)
    return float(np.sum(a * np.cross(b, c)) / 6.0)


@pytest.mark.parametrize("name", SHAPES)
def test_a_solid_is_closed_and_oriented_and_placed(name: str) -> None:
    pose = Pose.from_quaternion([1.0, -2.0, 3.0], [0.5, 0.5, -0.5, 0.5])
    solid = solid_of(Obstacle(name, SHAPES[name], pose))
    sides = [
        (a, b) for face in solid.faces for a, b in zip(face, (*face[1:], face[0]), strict=True)
    ]
    assert len(sides) == len(set(sides))
    assert {(b, a) for a, b in sides} == set(sides)
    assert volume(solid) > 0.0
    local = pose.inverse().apply(solid.vertices)
    core = shape_points(SHAPES[name])
    grown = getattr(SHAPES[name], "radius", 0.0)
    assert np.all(np.abs(local).max(axis=0) <= np.abs(core).max(axis=0) + grown + 1e-9)


@pytest.mark.parametrize(
    ("name", "true"),
    [
        ("box", 8 * 0.1 * 0.2 * 0.3),
        ("sphere", 4 / 3 * np.pi * 0.2**3),
        ("cylinder", np.pi * 0.1**2 * 0.5),
        ("capsule", np.pi * 0.1**2 * 0.5 + 4 / 3 * np.pi * 0.1**3),
    ],
)
def test_a_solid_is_about_as_large_as_its_shape(name: str, true: float) -> None:
    solid = solid_of(Obstacle(name, SHAPES[name], Pose.level([0.3, 0.2, 0.1])))
    assert volume(solid) == pytest.approx(true, rel=0.06)
    assert volume(solid) <= true * (1 + 1e-9)


def test_only_edges_that_bend_are_drawn() -> None:
    box = solid_of(Obstacle("box", SHAPES["box"], Pose.level([0, 0, 0])))
    assert len(box.edges) == 12
    cylinder = solid_of(Obstacle("round", SHAPES["cylinder"], Pose.level([0, 0, 0])))
    heights = {round(abs(float(cylinder.vertices[i, 2])), 9) for e in cylinder.edges for i in e}
    assert heights == {0.25}
    assert len(cylinder.edges) == 48


def test_an_open_mesh_shows_its_rim() -> None:
    square = TriangleMesh(
        np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]),
        np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int64),
    )
    assert len(solid_of(Obstacle("rim", square, Pose.level([0, 0, 0]))).edges) == 4


def test_the_eye_sees_near_things_larger_and_the_centre_in_the_middle() -> None:
    eye = Eye(np.array([1.0, 2.0, 3.0]), 4.0, np.eye(3))
    np.testing.assert_allclose(eye.see(np.array([1.0, 2.0, 3.0])), [0.0, 0.0, 4.0])
    far, near = eye.see(np.array([[2.0, 2.0, 2.0], [2.0, 2.0, 4.0]]))
    assert near[0] > far[0]
    assert near[2] < far[2]


def test_the_events_have_a_column_of_fault_pages_only_where_one_has_a_page() -> None:
    """A narrow window has no room for an empty one."""
    fine = RunEvent(time_s=0.0, code="enabled", text="all drives are enabled and hold")
    ill = RunEvent(time_s=1.0, code="late", text="a cycle began 2 cycles late")
    assert "More about it" not in event_table(SimpleNamespace(events=(fine,)))
    assert "docs/faults/late.md" in event_table(SimpleNamespace(events=(fine, ill)))


def test_why_no_following_error_was_measured_is_that_of_the_verdict() -> None:
    """Drives that are being enabled report positions, and follow nothing."""
    run = fake_run.make(rate_hz=2.0, every=20)
    count = len(run.cycles)
    unknown = replace(run.cycles, following_error=np.full(count, np.nan))
    enabling = replace(unknown, state=("enabling",) * count)
    silent = replace(unknown, missing=np.full(count, run.cycles.cable_count))
    for cycles, text in ((enabling, "did not move along the path"), (silent, "was ever received")):
        said: Any = SimpleNamespace(rig=run.context.rig, cycles=cycles)
        assert text in _following(said)
