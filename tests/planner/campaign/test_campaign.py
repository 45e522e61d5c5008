"""The campaign: fixed searches for fixed seeds, wherever they are done; verdicts; files."""

from __future__ import annotations

import ast
import csv
import io
import json
import pickle
import resource
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from html.parser import HTMLParser

import matplotlib as mpl
import numpy as np
import pytest

from model.errors import BadInput
from planner.campaign.evaluation import findings_json, summary_csv, trials_csv, write_campaign
from planner.campaign.page import page, save_figures
from planner.campaign.studies import (
    FIGURE_9,
    Change,
    Finding,
    Results,
    all_readings,
    batches,
    change_of_deviations,
    change_of_means,
    figure_9_arm,
    findings,
    run_all,
    summary,
)
from planner.campaign.trial import (
    OWN,
    SHARES,
    WIDE,
    Batch,
    Case,
    PathFigures,
    Trial,
    box_text,
    run_batch,
    with_box,
)
from planner.check import check_path
from planner.costs import KinematicCost
from planner.rrt.search import PaperPlanner
from planner.settings import CLEARANCE_RESERVE, PlannerSettings
from planner.workspace.figures import write_figures

ENVIRONMENTS = ("environment_1", "environment_2", "environment_3")
SEEDS = 3


@pytest.fixture(scope="module")
def scenes(ready_scene):
    return [ready_scene(name) for name in ENVIRONMENTS]


@pytest.fixture(scope="module")
def work(gachon, scenes) -> tuple[Batch, ...]:
    return batches(gachon, scenes, SEEDS)


@pytest.fixture(scope="module")
def figure_9_batch(work) -> Batch:
    return next(
        b for b in work if b.study == FIGURE_9 and b.case == Case(OWN, "environment_3", "random")
    )


@pytest.fixture(scope="module")
def results(work) -> Results:
    """Made-up trials of the whole campaign: adaptive needs 80 nodes, the goal bias 100."""
    trials = []
    for batch in work:
        random = np.random.default_rng(len(trials))
        for seed in batch.seeds:
            nodes = 80 if batch.arm.sampler == "adaptive" else 100
            cost = 0.5 if batch.arm.cost == "kinematic" else 0.51
            figures = PathFigures(900.0, 800.0, cost, cost * random.uniform(0.9, 1.1), 10.5)
            counts = (nodes + int(random.integers(-5, 6)), 300, 400, 1.0)
            found = seed > 0 or batch.case.ends == "scene"
            empty = figures if batch.measured and found else PathFigures()
            trials.append(
                Trial(batch.study, batch.case, batch.arm, seed, found, *counts, path=empty)
            )
    return Results(trials)


@pytest.fixture(scope="module")
def images(results, tmp_path_factory) -> dict[str, bytes]:
    """All images of these results, by file name."""
    names = save_figures(results, folder := tmp_path_factory.mktemp("images"))
    saved = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert saved.keys() == {f"{name}.{end}" for name in names for end in ("svg", "png")}
    return saved


def numbers(trials: list[Trial]) -> list[str]:
    """Trials without their times, which no two runs share; NaN never equals itself."""
    return [repr(replace(trial, time_ms=0.0)) for trial in trials]


def test_the_campaign_has_every_case_of_figure_9_and_both_boxes(work) -> None:
    figure = [b for b in work if b.study == FIGURE_9]
    assert {b.case.environment for b in figure} == set(ENVIRONMENTS)
    assert {(b.case.box, b.case.ends) for b in figure} == {
        (box, ends) for box in (OWN, WIDE) for ends in ("scene", "random")
    }
    assert {(b.arm.sampler, b.arm.cost) for b in figure} == {
        (s, c) for s in ("adaptive", "goal-bias") for c in ("kinematic", "length")
    }
    assert all(b.seeds == tuple(range(SEEDS)) for b in work)
    assert len(all_readings()) == 96


def test_the_baseline_of_figure_9_is_never_handicapped() -> None:
    """It takes the steps of the adaptive planner, and nothing of it is rejected."""
    adaptive = figure_9_arm("adaptive", "length").readings
    baseline = figure_9_arm("goal-bias", "length").readings
    assert baseline.steer == adaptive.steer
    assert baseline.spacing == 0.0


def test_boxes_grow_from_the_rigs_own_to_the_wide_one(gachon) -> None:
    assert box_text(with_box(gachon, OWN)) == "x ±250, y ±250, z 150 to 650 mm"
    assert box_text(with_box(gachon, WIDE)) == "x ±350, y ±350, z 100 to 750 mm"
    sizes = [np.ptp([r.workspace_lower, r.workspace_upper], axis=0).prod() for r in
             (with_box(gachon, name) for name in SHARES)]  # fmt: skip
    assert sizes == sorted(sizes)


def test_a_batch_gives_the_same_numbers_here_in_a_pool_and_in_any_order(figure_9_batch) -> None:
    here = run_batch(figure_9_batch)
    assert [trial.seed for trial in here] == list(range(SEEDS))
    reported: list[int] = []
    single = [replace(figure_9_batch, seeds=(seed,)) for seed in figure_9_batch.seeds]
    with ThreadPoolExecutor(1) as pool:
        elsewhere = run_all(single, pool, reported.append)
    assert numbers(elsewhere) == numbers(here)
    assert numbers(run_all(single, None, reported.append)) == numbers(here)
    assert sum(reported) == 2 * SEEDS


def test_a_trial_reports_what_its_search_and_the_independent_routes_find(
    gachon, ready_scene, work
) -> None:
    batch = next(b for b in work if b.study == FIGURE_9 and b.case == Case(OWN, "environment_1"))
    trial = run_batch(batch)[1]
    scene = ready_scene("environment_1")
    settings = PlannerSettings(
        batch.arm.sampler, batch.arm.cost, "paper", readings=batch.arm.readings
    )
    planner = PaperPlanner(gachon, scene, settings, CLEARANCE_RESERVE)
    ends = np.array(scene.start.position), np.array(scene.goal.position)
    result = planner.search(*ends, np.random.default_rng(1))
    path = planner.shortcut(result.path)
    assert (trial.nodes, trial.searches) == (len(result.points), result.iterations)
    report = check_path(gachon, scene, [planner.space.pose(point) for point in path])
    assert report.passed
    assert trial.path.length_mm == pytest.approx(report.length * 1e3)
    near = report.obstacle_clearance.nearest.distance * 1e3
    assert trial.path.clearance_mm == pytest.approx(near, abs=0.2)
    assert trial.path.cost == pytest.approx(KinematicCost(gachon, np.eye(3)).mean_along(path))


def test_random_ends_are_as_far_apart_as_the_scenes_and_do_not_see_each_other(
    gachon, ready_scene
) -> None:
    from planner.campaign.trial import random_ends

    scene = ready_scene("environment_2")
    planner = PaperPlanner(gachon, scene, PlannerSettings(cost="length"), CLEARANCE_RESERVE)
    for seed in range(20):
        start, goal = random_ends(planner, 0.5, np.random.default_rng(seed))
        assert np.linalg.norm(goal - start) == pytest.approx(0.5)
        assert planner.edge(start, start)
        assert planner.edge(goal, goal)
        assert not planner.edge(start, goal)


def test_intervals_hold_the_mean_and_shrink_with_the_sample() -> None:
    rng = np.random.default_rng(0)
    small, large = rng.normal(10, 2, 30), rng.normal(10, 2, 3000)
    widths = []
    for sample in (small, large):
        found = summary(sample)
        assert found.low < found.mean < found.high
        assert found.mean == pytest.approx(sample.mean())
        assert found.deviation == pytest.approx(sample.std(ddof=1))
        widths.append(found.high - found.low)
    # The interval of a mean is about ± 1.96 deviations over the root of the count.
    assert widths[0] == pytest.approx(2 * 1.96 * small.std() / np.sqrt(30), rel=0.15)
    assert widths[1] < widths[0] / 5


def test_a_change_is_of_the_means_averaged_over_the_environments() -> None:
    pairs = [(np.array([8.0, 8.0]), np.array([10.0, 10.0])), (np.ones(3), np.full(3, 2.0))]
    change = change_of_means(pairs)
    assert change.each == pytest.approx((-0.2, -0.5))
    assert (change.mean, change.low, change.high) == pytest.approx((-0.35, -0.35, -0.35))


def test_samples_tied_by_their_seeds_are_resampled_together() -> None:
    """Twice the same hard and easy problems: the ratio is certain, though the means are not."""
    hard = np.random.default_rng(1).exponential(100.0, 50)
    change = change_of_means([(0.8 * hard, hard)])
    assert change.high - change.low < 1e-9


@pytest.mark.parametrize(
    ("low", "mean", "high", "claimed", "verdict"),
    [
        (-0.28, -0.25, -0.21, -0.205, "reached"),
        (-0.25, -0.21, -0.15, -0.205, "reached on average"),
        (-0.25, -0.18, -0.10, -0.205, "not reached, but within the interval"),
        (-0.10, -0.05, -0.01, -0.205, "smaller, but by less than claimed"),
        (-0.10, -0.03, 0.02, -0.205, "no difference seen"),
        (0.01, 0.05, 0.10, -0.205, "the opposite"),
        (-0.50, -0.30, -0.01, 0.0, "reached"),
        (-0.50, -0.30, 0.10, 0.0, "no difference seen"),
        (0.10, 0.30, 0.50, 0.0, "the opposite"),
    ],
)
def test_a_verdict_says_no_more_than_the_interval_allows(low, mean, high, claimed, verdict) -> None:
    finding = Finding("claim", claimed, OWN, "scene", Change((mean,), mean, low, high))
    assert finding.verdict == verdict


def test_deviations_are_compared_where_there_are_some() -> None:
    """Three seeds had a change of up to 10^284 %: one of them, drawn three times, has none."""
    random = np.random.default_rng(3)
    one, other = random.normal(size=(2, 12))
    few = change_of_deviations([(one[:3], other[:3])])
    assert -1.0 < few.low <= few.mean <= few.high < 100.0
    alike = np.full(12, 0.1)  # its mean is not exactly 0.1
    both = change_of_deviations([(one, other), (one, alike)])
    alone = change_of_deviations([(one, other)])
    none = change_of_deviations([(alike, alike)])
    assert (*none.each, none.mean, none.low, none.high) == (0.0, 0.0, 0.0, 0.0)
    assert np.isnan(both.each[1])
    assert (both.each[0], both.mean, both.low, both.high) == (
        alone.each[0], alone.mean, alone.low, alone.high
    )  # fmt: skip
    tied = np.where(np.arange(12) == 0, 1.0, 0.0)  # a third of its resamples are alike
    rare = change_of_deviations([(tied, tied[::-1])])
    assert -1.0 <= rare.low <= rare.mean == 0.0 <= rare.high < 10.0


def test_only_seeds_with_which_both_found_a_path_are_compared(results) -> None:
    by_claim = {(f.claim, f.box, f.ends): f for f in findings(results)}
    nodes = by_claim["20.5 % fewer nodes, adaptive alone rejects near nodes", OWN, "random"].change
    assert -0.25 < nodes.mean < -0.15
    assert results.lost(FIGURE_9) == 2 * 3 * 4  # seed 0 of the random ends


def test_tables_have_a_row_for_everything_and_their_keys_distinguish_arms(results, work) -> None:
    rows = list(csv.DictReader(io.StringIO(trials_csv(results))))
    assert len(rows) == sum(len(batch.seeds) for batch in work)
    keys = [name for name in rows[0] if name not in ("nodes", "found")]
    figures = keys[keys.index("searches") :]
    seen = {
        tuple(v for k, v in row.items() if k not in (*figures, "nodes", "found")) for row in rows
    }
    assert len(seen) == len(rows)
    means = list(csv.DictReader(io.StringIO(summary_csv(results))))
    nodes = [float(row["mean"]) for row in means if row["quantity"] == "nodes"]
    assert min(nodes) > 70
    assert max(nodes) < 110


class Reader(HTMLParser):
    """Collects open tags and images."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.pictures: list[str] = []
        self.text = ""

    def handle_starttag(self, tag, attrs) -> None:
        if tag == "img":
            self.pictures.append(dict(attrs)["src"])
        elif tag not in ("meta", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data) -> None:
        self.text += data


def test_the_page_has_every_claim_with_its_verdict_and_every_picture(results, images) -> None:
    about = {"seeds": SEEDS, "boxes": {OWN: "its own", WIDE: "wider"}, "rig": "gachon <8 & 6>"}
    reader = Reader()
    reader.feed(page(results, about))
    assert reader.open == []
    assert {name for name in images if name.endswith(".svg")} == set(reader.pictures)
    assert all(len(image) > 1000 for image in images.values())
    for finding in findings(results):
        assert finding.claim in reader.text
        assert finding.verdict in reader.text
    assert "gachon <8 & 6>" in reader.text
    reported = json.loads(findings_json(results, about))
    assert len(reported["findings"]) == len(findings(results))


def test_images_need_no_settings_of_the_user_and_are_whole(
    results, images, tmp_path, monkeypatch
) -> None:
    for name in ("own", "full"):
        (tmp_path / name).mkdir()
    with monkeypatch.context() as patch:
        patch.setattr("planner.campaign.page.write_figures", write_one_figure)
        with mpl.rc_context({"text.usetex": True, "axes.facecolor": "red"}):
            save_figures(results, tmp_path / "own")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
    try:
        with pytest.raises(BadInput, match="cannot be written"):
            save_figures(results, tmp_path / "full")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    own, full = (
        {path.name: path.read_bytes() for path in (tmp_path / name).iterdir()}
        for name in ("own", "full")
    )
    assert set(own) == {"figure_9.png", "figure_9.svg"}
    assert own.items() < images.items()
    assert full.items() < images.items()


def write_one_figure(folder, drawn, settings) -> None:
    """Saves the first figure and draws the others, which takes less long."""
    first, *others = drawn
    write_figures(folder, {first: drawn[first]}, settings)
    for name in others:
        drawn[name]()


@pytest.mark.parametrize("paths", [0, 1])
def test_a_campaign_in_which_few_searches_found_a_path_is_written(
    results, tmp_path, monkeypatch, paths
) -> None:
    """In the first environment, or in all with random ends, at most one seed found a path."""
    monkeypatch.setattr("planner.campaign.page.write_figures", write_one_figure)
    lacking = Results(
        replace(t, found=False, path=PathFigures())
        if t.seed >= paths and ("1" in t.case.environment or t.case.ends == "random")
        else t
        for t in results.trials
    )
    about = {"seeds": SEEDS, "boxes": {OWN: "its own", WIDE: "wider"}}
    write_campaign(tmp_path, lacking, about)
    assert len((tmp_path / "trials.csv").read_text().splitlines()) == len(results.trials) + 1
    text = (tmp_path / "index.html").read_text()
    assert "in 2 of 3 environments" in text
    assert "nan" not in text
    found = json.loads((tmp_path / "findings.json").read_text())["findings"]
    unknown = [f for f in found if f["change"]["mean"] is None]
    assert {f["verdict"] for f in unknown} == {"too few paths to compare"}
    assert {f["ends"] for f in unknown} == {"random"}
    assert all(f["change"]["each"][1] is not None for f in found if f["ends"] == "scene")


CLUSTER = """
import sys
from dataclasses import replace
from pickle import load
from distributed import Client, LocalCluster
from planner.campaign.studies import run_all

if __name__ == "__main__":
    batches = load(sys.stdin.buffer)
    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        with Client(cluster) as client:
            found = run_all(batches, client.get_executor(), lambda _: None)
    print([repr(replace(trial, time_ms=0.0)) for trial in found])
"""


@pytest.mark.slow
def test_a_dask_cluster_gives_the_same_numbers(figure_9_batch, tmp_path) -> None:
    pytest.importorskip("distributed")
    single = [replace(figure_9_batch, seeds=(seed,)) for seed in figure_9_batch.seeds]
    program = tmp_path / "cluster.py"  # Dask leaves threads behind: in a process of its own
    program.write_text(CLUSTER)
    command = [sys.executable, str(program)]
    done = subprocess.run(command, input=pickle.dumps(single), capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    assert ast.literal_eval(done.stdout.decode()) == numbers(run_batch(figure_9_batch))
