"""Complete calibrations from a script: result, report and progress."""

from __future__ import annotations

import time
from datetime import date
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.images import ImageSet, open_images
from calibration.procedures import calibrate_camera
from calibration.result_files import load_result
from calibration.results import Destination
from calibration.targets.boards import Chessboard
from model.errors import BadInput
from model.progress import Listener
from tests.cli.test_calibrate_camera import pictures

BOARD = Chessboard(9, 6, 0.025)
ON = date(2026, 3, 1)


class Heard(Listener):
    """Records the reported progress."""

    def __init__(self) -> None:
        self.totals: list[tuple[str, float | None]] = []

    def progress(self, text: str, total: float | None):  # type: ignore[no-untyped-def]
        self.totals.append((text, total))
        return super().progress(text, total)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six images of the board."""
    path = tmp_path_factory.mktemp("pictures")
    for number, image in enumerate(pictures(6, 0.09)):
        cv2.imwrite(str(path / f"{number}.png"), image)
    return path


def test_a_folder_becomes_a_result_file_and_a_report(folder: Path, tmp_path: Path) -> None:
    heard = Heard()
    to = Destination(tmp_path, on=ON)
    made = calibrate_camera(folder, BOARD, name="front", output=to, listener=heard)
    assert heard.totals == [("detecting the board", 6)]
    assert [path.name for path in made.files] == [
        "calibration_camera_front_2026-03-01.yaml",
        "calibration_camera_front_2026-03-01.html",
    ]
    assert load_result(made.files[0]) == made.result.sealed()
    assert made.quality.verdict.good == made.good_enough


def test_pictures_need_no_folder_and_nothing_is_written_unless_asked(folder: Path) -> None:
    images = list(open_images(folder).images)
    made = calibrate_camera(ImageSet(images, len(images)), BOARD)
    assert made.files == ()
    assert np.isfinite(made.found.matrix).all()


def test_a_result_has_the_date_of_the_laboratory_s_calendar(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As run folders: on a morning in Seoul, the date in UTC is still yesterday's."""
    dates = {}
    for zone in ("Etc/GMT-14", "Etc/GMT+12"):  # 14 h before UTC and 12 h after it
        monkeypatch.setenv("TZ", zone)
        time.tzset()
        dates[zone] = Destination().on
    monkeypatch.undo()
    time.tzset()
    assert dates["Etc/GMT-14"] > dates["Etc/GMT+12"]


def test_a_result_that_exists_is_refused_before_any_picture_is_read(tmp_path: Path) -> None:
    (tmp_path / "calibration_camera_front_2026-03-01.yaml").write_text("mine")
    with pytest.raises(BadInput, match="exists already"):
        calibrate_camera(
            ImageSet(_unread(), 1), BOARD, name="front", output=Destination(tmp_path, on=ON)
        )


def _unread():  # type: ignore[no-untyped-def]
    raise AssertionError("an image was read")
    yield
