"""Images, calibrations and workspace maps with one call each, and paths as strings."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import cdpr
from calibration.geometry.pose_selection import MeasurementPlan
from drivers import ImageFolder
from drivers.cameras.files import ImageOutput
from executor.track import TrackResult
from model.plan import plan_facts
from model.progress import Advance, Listener
from tests.executor import fake_run
from tracking.track import MultiCameraCount
from tracking.tracker import Tracker

ROOT = Path(__file__).parents[2]
SESSION = ROOT / "examples" / "rig_session"


@pytest.fixture(scope="module")
def rig() -> cdpr.Rig:
    return cdpr.load_rig(ROOT / "configs/gachon_8_6_rehearsal.yaml")


def test_a_folder_of_images_is_tracked_and_logged(rig: cdpr.Rig, tmp_path: Path) -> None:
    result = cdpr.track(rig, str(SESSION / "pictures"), pictures=1)
    assert repr(result) == "<TrackResult 1 poses in 1 images>"
    table = result._repr_html_()
    assert table.count("<tr>") == len(result.summary())
    assert f'<td style="text-align:left">{result.summary()["reprojection_px"]}</td>' in table
    result.save(str(tmp_path / "poses.csv"))
    assert len((tmp_path / "poses.csv").read_text().splitlines()) == 2


def test_a_result_without_images_has_figures_that_are_unknown() -> None:
    result = TrackResult()
    assert result.summary() == {
        **dict.fromkeys(("pictures", "poses"), 0),
        **dict.fromkeys(("position_deviation_mm", "reprojection_px")),
        **dict.fromkeys(("pictures_per_second", "measuring_ms")),
    }
    assert result._repr_html_().count("–") == 4
    assert dict(result.facts())["measuring ms"] == "–"


def test_figures_of_several_cameras_have_names_that_explain_themselves() -> None:
    result = TrackResult(together=MultiCameraCount(without_partner=3, apart=2, without_speed=1))
    facts = dict(result.facts())
    assert facts["images without partner"] == "3"
    assert facts["frame sets with images too far apart in time"] == "2"
    assert facts["frame sets with a pose of unknown velocity"] == "1"
    assert not [name for name in facts if "picture" in name or "_" in name]


def test_the_poses_to_measure_at_are_a_table_with_their_plan() -> None:
    plan = fake_run.make(rate_hz=2.0, every=20).context.plan
    measuring = MeasurementPlan(plan.waypoints, plan.document)
    assert repr(measuring) == f"<MeasurementPlan {len(plan.waypoints)} poses>"
    assert measuring.facts()[1:] == plan_facts(plan.document)
    assert measuring._repr_html_().count("<tr>") == len(measuring.facts())


def test_what_was_measured_before_ctrl_c_is_kept_and_tracking_ends_when_told(
    rig: cdpr.Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen, kept = iter(range(100)), []
    result = cdpr.track(rig, SESSION / "pictures", stopped=lambda: next(seen) >= 2)
    assert len(result.pictures) == 2
    observe, calls = Tracker.observe, iter(range(100))

    def interrupted(self: Tracker, *arguments: Any) -> Any:
        if next(calls) == 3:
            raise KeyboardInterrupt
        return observe(self, *arguments)

    monkeypatch.setattr(Tracker, "observe", interrupted)
    with pytest.raises(KeyboardInterrupt):
        cdpr.track(rig, SESSION / "pictures", keep=kept.append)
    assert [len(partial.pictures) for partial in kept] == [3]


def test_a_source_of_images_is_opened_by_what_it_is(rig: cdpr.Rig) -> None:
    images = cdpr.open_camera(rig, SESSION / "pictures", "front")
    assert isinstance(images, ImageFolder)
    assert next(iter(images)).name == "place_01.jpg"
    with cdpr.open_camera(rig, SESSION / "pictures") as opened:
        assert len(list(islice(opened, 2))) == 2
    with pytest.raises(cdpr.BadInput):
        cdpr.open_camera(rig, str(SESSION / "no-such-folder"))


@pytest.mark.parametrize("locate", [cdpr.locate_camera, cdpr.locate_tags])
def test_the_number_of_images_is_that_of_a_video_or_a_camera(
    rig: cdpr.Rig, tmp_path: Path, locate: Callable[..., object]
) -> None:
    totals: list[float | None] = []

    class Totals(Listener):
        def progress(self, text: str, total: float | None) -> AbstractContextManager[Advance]:
            totals.append(total)
            return super().progress(text, total)

    video = tmp_path / "session.avi"
    with ImageOutput(video, 30.0) as out:
        for frame in islice(cdpr.open_camera(rig, SESSION / "pictures"), 4):
            out.write(cv2.cvtColor(frame.image, cv2.COLOR_GRAY2BGR), frame.name)
    with pytest.raises(cdpr.BadInput, match="`pictures=` is for a video or a camera"):
        locate(rig, SESSION / "pictures", pictures=2)
    with pytest.raises(cdpr.BadInput, match="pictures must be a whole number from 1"):
        locate(rig, video, pictures=0)
    with suppress(cdpr.BadInput):  # too few tags for the layout
        locate(rig, video, pictures=2, listener=Totals())
    assert totals == [2]


@pytest.mark.parametrize(
    "use",
    [
        lambda rig, path: cdpr.open_camera(rig, path),
        lambda rig, path: cdpr.track(rig, path),
        lambda rig, path: cdpr.locate_camera(rig, path),
        lambda rig, path: cdpr.locate_camera(rig, SESSION / "pictures", poses=path),
        lambda rig, path: cdpr.locate_tags(rig, path),
        lambda rig, path: cdpr.calibrate_rig(rig, path),
        lambda rig, path: cdpr.calibrate_camera(path, cdpr.Chessboard(9, 6, 0.02)),
        lambda rig, path: ImageFolder(path, rig.camera()),
    ],
)
def test_a_folder_that_cannot_be_examined_is_bad_input(
    rig: cdpr.Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, use: Callable[..., object]
) -> None:
    """Python 3.11 raises, where a later one takes it for missing."""
    with pytest.raises(cdpr.BadInput):
        use(rig, tmp_path / ("x" * 300))
    examine = Path.stat

    def denied(self: Path, **options: Any) -> os.stat_result:
        if self.name == "theirs":
            raise PermissionError(13, "Permission denied", str(self))
        return examine(self, **options)

    monkeypatch.setattr(Path, "stat", denied)
    with pytest.raises(cdpr.BadInput, match="Permission denied"):
        use(rig, tmp_path / "theirs")


def test_a_folder_that_cannot_be_listed_is_bad_input(
    rig: cdpr.Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def denied(self: Path) -> Any:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "iterdir", denied)
    with pytest.raises(cdpr.BadInput, match="Permission denied"):
        cdpr.open_camera(rig, tmp_path)


def test_a_calibrated_rig_is_used_in_memory_and_kept_in_a_file(
    rig: cdpr.Rig, tmp_path: Path
) -> None:
    outcome = cdpr.calibrate_rig(rig, [str(SESSION / "places.csv")], output=str(tmp_path))
    better = rig.with_calibration(outcome)
    assert np.abs(better.outlets - rig.outlets).max() > 1e-5
    again = rig.with_calibration(cdpr.load_calibration(str(outcome.files[0])))
    np.testing.assert_allclose(again.outlets, better.outlets, atol=1e-9)
    assert repr(outcome).startswith("<Calibration rig rig, ")
    with pytest.raises(cdpr.BadInput, match="two results"):
        rig.with_calibration(outcome, outcome)


def test_a_slice_of_the_workspace_is_mapped(rig: cdpr.Rig) -> None:
    (maps,) = cdpr.workspace_map(rig, slices=[("z", 0.445)], step=0.1, workers=1)
    assert maps.values["capacity_margin"].shape == maps.grid.shape
    middle = tuple(n // 2 for n in maps.grid.shape)
    assert maps.feasible[middle]
    assert "capacity_margin" in repr(maps)
    assert maps._repr_html_().count("<tr>") >= 5


def test_a_region_and_a_characteristic_length_are_mapped_as_by_the_verb(rig: cdpr.Rig) -> None:
    lower, upper = [-0.1, -0.1, 0.4], np.array([0.1, 0.0, 0.5])
    (maps,) = cdpr.workspace_map(
        rig, volume=False, step=0.05, lower=lower, upper=upper,
        characteristic_length=0.2, workers=1,
    )  # fmt: skip
    x, y, z = maps.grid.axes
    np.testing.assert_allclose([x[0], x[-1], y[0], y[-1], *z], [-0.1, 0.1, -0.1, 0.0, 0.445])
    assert maps.question.length == 0.2
    for corner in ([0.1, 0.1], [0.1, 0.1, np.nan], "abc", [[1, 2, 3]]):
        with pytest.raises(cdpr.BadInput, match="upper must be three finite numbers"):
            cdpr.workspace_map(rig, upper=corner, workers=1)
    with pytest.raises(cdpr.BadInput, match="characteristic length"):
        cdpr.workspace_map(rig, characteristic_length=0.0, workers=1)
    with pytest.raises(cdpr.BadInput, match="no extent"):
        cdpr.workspace_map(rig, lower=upper, upper=lower, workers=1)
