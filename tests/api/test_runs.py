"""Run results: verdict, columns, figures, and the same loaded from the folder."""

from __future__ import annotations

import csv
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest

import cdpr

CONFIGS = Path(__file__).parents[2] / "configs"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> cdpr.RunResult:
    rig = cdpr.load_rig(CONFIGS / "gachon_8_6.yaml")
    scene = cdpr.load_scene(CONFIGS / "environment_1.yaml")
    goal = cdpr.Pose.level(np.add(scene.start.position, (-0.01, 0.0, 0.01)))
    plan = cdpr.plan(rig, scene, goal=goal, rounds=12)
    folder = tmp_path_factory.mktemp("runs") / "short"
    return cdpr.run(plan, rig, folder=str(folder), cameras=[], realtime=False)


def test_a_run_passes_and_says_so(run: cdpr.RunResult) -> None:
    assert run.passed
    assert run.verdict == "PASSED"
    assert run.exit_code == 0
    assert "PASSED" in repr(run)
    assert run.sentence in run._repr_html_()


def test_tables_are_columns_of_one_length_by_the_names_in_the_file(run: cdpr.RunResult) -> None:
    for table, name in ((run.cycles, "cycles"), (run.clearance, "clearance")):
        assert type(table) is dict  # what `pandas.DataFrame` takes
        with (run.folder / f"{name}.csv").open(newline="") as stream:
            rows = list(csv.DictReader(stream))
        assert list(table) == list(rows[0])
        assert {array.shape for array in table.values()} == {(len(rows),)}
    assert run.cycles["time_s"].dtype == np.float64
    assert run.cycles["actual_1_counts"].dtype == np.int64
    assert run.poses["time_s"].shape == (0,)


def test_the_smallest_clearance_lies_in_its_interval(run: cdpr.RunResult) -> None:
    low, high = run.clearance_interval
    assert low < run.smallest_clearance < high
    assert run.smallest_clearance * 1e3 == pytest.approx(
        run.clearance["distance_mm"].min(), abs=1e-3
    )


def test_a_run_is_loaded_from_its_folder_and_reported_again(run: cdpr.RunResult) -> None:
    page = cdpr.report(run.folder)
    again = cdpr.load_run(str(run.folder))
    assert again.report == page
    assert again.summary == run.summary
    np.testing.assert_array_equal(again.cycles["time_s"], run.cycles["time_s"])
    with pytest.raises(cdpr.BadInput, match="no such run folder"):
        cdpr.load_run(run.folder / "missing")


def test_a_figure_shows_error_tensions_and_clearance(run: cdpr.RunResult) -> None:
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    error, tension, near = run.plot().axes
    assert (len(error.lines), len(tension.lines), len(near.lines)) == (1, 8, 1)
    plt.close("all")


def test_without_a_run_under_way_a_stop_reaches_nothing() -> None:
    with pytest.raises(cdpr.Fault):
        cdpr.stop()
