"""Printed boards and tags: exact to the micrometre, and detectable."""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import pytest

from calibration.targets.boards import Board, Charuco, Chessboard
from calibration.targets.grids import CircleGrid, TagGrid
from calibration.targets.printing import (
    MARGIN_MM,
    PAPERS,
    board_print,
    pdf_of,
    printout,
    sheet_of,
    sheets_of,
    tag_print,
)
from model.errors import BadInput
from tests.calibration.pages import discs_in, drawn, pages_in
from tracking.detection.detector import TagDetector

BOARDS = [
    Chessboard(9, 6, 0.025),
    Charuco(7, 5, 0.035, 0.026, "4X4_50"),
    Charuco(5, 8, 0.030, 0.022, "5X5_100", legacy=True),
    TagGrid(6, 4, 0.030, 0.009, "tag36h11", first=40),
    TagGrid(6, 4, 0.030, 0.009, "tag36h11", first=40, order="kalibr"),
]
PER_MM = 6.0


def page_of(board: Board, paper: str = "a4"):
    return pages_in(pdf_of([sheet_of(board_print(board), paper)], "a board"))[0]


@pytest.mark.parametrize("board", BOARDS, ids=str)
def test_a_printed_board_is_found_in_its_size(board: Board) -> None:
    size, rectangles, texts = page_of(board)
    seen = board.find(drawn(size, rectangles, PER_MM))
    assert seen is not None
    # The corners as found on paper, [mm], must be the board's points after a rigid motion.
    on_paper, points = (seen.corners + 0.5) / PER_MM, seen.points[:, :2] * 1e3
    spread = np.linalg.norm(points - points.mean(axis=0))
    assert np.linalg.norm(on_paper - on_paper.mean(axis=0)) / spread == pytest.approx(1.0, abs=5e-4)
    expected = {Chessboard: 54, Charuco: 24 if not getattr(board, "legacy", 0) else 28, TagGrid: 96}
    assert len(points) == expected[type(board)]
    assert any("This side down" in text for text in texts)


@pytest.mark.parametrize("asymmetric", [False, True])
def test_printed_circles_are_found_in_their_size(asymmetric: bool) -> None:
    board = CircleGrid(4, 11, 0.020, 0.015, True) if asymmetric else CircleGrid(7, 5, 0.03, 0.018)
    data = pdf_of([sheet_of(board_print(board), "a4")], "a board")
    size, _, _ = pages_in(data)[0]
    page = np.full(np.round(size[::-1] * PER_MM).astype(int), 235, np.uint8)
    for x, y, radius in discs_in(data) * PER_MM:
        middle, shift = (round((x - 0.5) * 256), round((y - 0.5) * 256)), 8
        cv2.circle(page, middle, round(radius * 256), 20, -1, cv2.LINE_AA, shift)
    seen = board.find(page)
    assert seen is not None
    on_paper, points = (seen.corners + 0.5) / PER_MM, seen.points[:, :2] * 1e3
    turn, left = np.linalg.lstsq(
        np.column_stack([points, np.ones(len(points))]), on_paper, rcond=None
    )[:2]
    np.testing.assert_allclose(turn[:2] @ turn[:2].T, np.eye(2), atol=2e-3)
    assert np.sqrt(left.sum() / len(points)) < 0.02


@pytest.mark.parametrize("board", BOARDS, ids=str)
def test_a_printed_board_keeps_white_around_it_and_inside_the_paper(board: Board) -> None:
    size, rectangles, _ = page_of(board)
    print_ = board_print(board)
    ink = rectangles[len(rectangles) - len(print_.black) :]
    quiet = print_.quiet * 1e3 - 1e-6
    left_top, right_bottom = ink[:, :2].min(axis=0), (ink[:, :2] + ink[:, 2:]).max(axis=0)
    assert (left_top >= quiet).all()
    assert (right_bottom <= size - quiet).all()
    ruler = rectangles[: len(rectangles) - len(print_.black)]
    assert ruler[:, 1].min() >= right_bottom[1] + quiet
    assert ((ruler[:, 1] + ruler[:, 3]) <= size[1] - MARGIN_MM).all()


def test_edges_are_exact_to_a_micrometre() -> None:
    _, rectangles, _ = page_of(BOARDS[0])
    squares = rectangles[rectangles[:, 2] > 20.0]
    squares = squares[squares[:, 3] > 20.0]
    assert len(squares) == 35
    assert np.abs(squares[:, 2:] - 25.0).max() < 1e-3
    steps = (squares[:, :2] - squares[:, :2].min(axis=0)) / 25.0
    assert np.abs(steps - np.round(steps)).max() * 25.0 < 1e-3


def test_the_ruler_is_a_hundred_millimetres_with_a_tick_each() -> None:
    _, rectangles, texts = page_of(BOARDS[0])
    ticks = rectangles[np.abs(rectangles[:, 2] - 0.1) < 1e-6]
    assert len(ticks) == 101
    middles = np.sort(ticks[:, 0] + ticks[:, 2] / 2.0)
    assert np.abs(np.diff(middles) - 1.0).max() < 1e-4
    assert any("100 mm" in text for text in texts)


def test_single_tags_are_printed_in_their_sizes_with_their_names() -> None:
    prints = [tag_print("tag36h11", k, size) for k, size in ((301, 0.096), (7, 0.030), (8, 0.030))]
    pages = pages_in(pdf_of(sheets_of(prints, "a4"), "tags"))
    found, named = {}, []
    for size, rectangles, texts in pages:
        named += texts
        for seen in TagDetector("tag36h11").detect(drawn(size, rectangles, 4.0)):
            sides = np.linalg.norm(seen.corners - np.roll(seen.corners, 1, axis=0), axis=1) / 4.0
            found[seen.id] = float(sides.mean())
    assert found == {
        301: pytest.approx(96.0, abs=0.5),
        7: pytest.approx(30.0, abs=0.5),
        8: pytest.approx(30.0, abs=0.5),
    }
    assert any("tag36h11 301, black square 96 mm" in text for text in named)


@pytest.mark.parametrize("size", [0.02, 0.03, 0.04, 0.06])
def test_captions_of_small_tags_are_apart_and_on_the_paper(size: float) -> None:
    """By the widths of Helvetica's letters; without its caption a tag cannot be told apart."""
    afm = Path(matplotlib.get_data_path(), "fonts", "pdfcorefonts", "Helvetica.afm").read_text()
    widths = {int(c): int(w) for c, w in re.findall(r"^C (\d+) ; WX (\d+)", afm, re.MULTILINE)}
    made = tag_print("tag36h11", 301, size)
    pages = sheets_of([replace(made, caption=f"{made.caption}, platform")] * 12, "a4")
    rows: dict[tuple[int, float], list[tuple[float, float]]] = {}
    for number, page in enumerate(pages):
        for text in page.texts:
            if text.text.startswith("tag"):
                width = sum(widths[ord(c)] for c in text.text) * text.size_mm / 1000.0
                row = rows.setdefault((number, text.y_mm), [])
                row.append((text.x_mm, text.x_mm + width))
    assert sum(map(len, rows.values())) == 12
    for row in rows.values():
        ends = [end for _, end in row]
        assert (np.array(ends[:-1]) < [start for start, _ in row[1:]]).all()
        assert ends[-1] <= PAPERS["a4"][0] - MARGIN_MM


@pytest.mark.parametrize(("paper", "size"), [("a4", 0.165), ("letter", 0.170)])
def test_a_tag_that_needs_its_own_page_has_one(paper: str, size: float) -> None:
    """Its white border and the printer's margin may overlap there."""
    prints = [tag_print("tag36h11", 301, size), tag_print("tag36h11", 302, 0.03)]
    alone, other = sheets_of(prints, paper)
    assert [t.text for t in alone.texts if t.text.startswith("tag")] == [prints[0].caption]
    assert [t.text for t in other.texts if t.text.startswith("tag")] == [prints[1].caption]
    assert len(sheets_of(prints[:1], paper)) == 1


def test_a_refused_tag_is_never_referred_to_the_paper_it_does_not_fit() -> None:
    for size in (0.169, 0.19, 0.24):
        with pytest.raises(BadInput) as caught:
            sheets_of([tag_print("tag36h11", 301, size)], "a4")
        assert "a4" not in caught.value.next_step


def test_a_board_that_does_not_fit_is_refused_with_the_paper_that_would_do() -> None:
    with pytest.raises(BadInput) as caught:
        sheet_of(board_print(Chessboard(9, 6, 0.035)), "a4")
    assert caught.value.next_step == "use --paper a3"
    assert "a4 has 210 x 297 mm" in caught.value.what
    with pytest.raises(BadInput, match="needs paper of") as caught:
        sheet_of(board_print(Chessboard(9, 6, 0.070)), "a3")
    assert "smaller" in caught.value.next_step
    with pytest.raises(BadInput, match="needs paper of"):
        sheets_of([tag_print("tag36h11", 0, 0.25)], "a4")


def test_tags_whose_white_borders_would_be_lost_are_refused() -> None:
    with pytest.raises(BadInput, match="less than one module"):
        board_print(TagGrid(3, 2, 0.040, 0.002, "tag36h11"))


@pytest.mark.parametrize("paper", PAPERS)
def test_the_table_of_a_file_points_at_its_objects(paper: str) -> None:
    data = pdf_of([sheet_of(board_print(Chessboard(4, 3, 0.03)), paper)] * 2, "two (2) pages")
    start = int(re.search(rb"startxref\n(\d+)", data).group(1))
    assert data[start : start + 4] == b"xref"
    offsets = re.findall(rb"(\d{10}) 00000 n ", data)
    for number, offset in enumerate(offsets, 1):
        assert data[int(offset) :].startswith(b"%d 0 obj" % number)
    assert rb"two \(2\) pages" in data


@pytest.mark.skipif(shutil.which("pdftoppm") is None, reason="needs poppler's pdftoppm")
def test_a_foreign_renderer_draws_what_we_meant(tmp_path: Path) -> None:
    page = sheet_of(board_print(BOARDS[1]), "a4")
    (tmp_path / "board.pdf").write_bytes(pdf_of([page], "board"))
    command = ["pdftoppm", "-r", "150", "-gray", "-singlefile", "board.pdf", "board"]
    subprocess.run(command, cwd=tmp_path, check=True, timeout=60)
    picture = cv2.imread(str(tmp_path / "board.pgm"), cv2.IMREAD_GRAYSCALE)
    seen = BOARDS[1].find(picture)
    assert seen is not None
    assert len(seen.points) == 24
    on_paper, points = seen.corners / 150.0 * 25.4, seen.points[:, :2] * 1e3
    gap = np.linalg.norm(on_paper[0] - on_paper[-1]) / np.linalg.norm(points[0] - points[-1])
    assert gap == pytest.approx(1.0, abs=1e-3)


def test_a_script_saves_a_print_and_replaces_none_by_accident(tmp_path: Path) -> None:
    made, path = printout(BOARDS[0], "a3"), tmp_path / "board.pdf"
    made.save(str(path))
    assert path.read_bytes() == made.pdf()
    with pytest.raises(BadInput, match="exists already"):
        made.save(path)
    made.save(path, replace=True)
    with pytest.raises(BadInput, match="must be a PDF file"):
        made.save(tmp_path / "board.txt")
    assert list(tmp_path.iterdir()) == [path]
