"""Prints of boards and tags in exact size: vector shapes, PDF pages, paper layout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calibration.targets.boards import Board, Charuco, Chessboard
from calibration.targets.grids import CircleGrid, TagGrid
from model.errors import BadInput, path_of
from model.files.documents import write_bytes_atomic
from model.files.output import require_new_file
from model.pose import Array
from model.rig import Rig
from tracking.detection.tags import modules_across, official_modules


@dataclass(frozen=True, slots=True, eq=False)
class Print:
    """Vector shapes of one target.

    Attributes:
        black: Left, top, width and height of black rectangles, from the target's top left, shape
            (n, 4), [m].
        size: Width and height of the target, shape (2,), [m].
        quiet: Width of the quiet zone around it, [m].
        caption: Name of the target, printable ASCII.
        discs: Centre and radius of black discs, from the same origin, shape (n, 3), [m].
    """

    black: Array
    size: Array
    quiet: float
    caption: str
    discs: Array = field(default_factory=lambda: np.zeros((0, 3)))


def board_print(board: Board) -> Print:
    """The print of a calibration board.

    Raises:
        BadInput: Its tags would touch.
    """
    match board:
        case Chessboard():
            return _chessboard(board)
        case Charuco():
            return _charuco(board)
        case TagGrid():
            return _tag_grid(board)
        case CircleGrid():
            return _circle_grid(board)
        case _:
            raise TypeError(f"no print of {board}")


def tag_print(family: str, number: int, size: float) -> Print:
    """The print of a single tag whose black square has side ``size`` [m]."""
    module = size / modules_across(family)
    black = _modules(~official_modules(family, number), np.zeros(2), module)
    caption = f"{family} {number}, black square {size * 1e3:g} mm"
    return Print(black, np.full(2, size), module, caption)


def _chessboard(board: Chessboard) -> Print:
    """One square more than inner corners in each direction; the top left one is black."""
    rows, columns = np.indices((board.rows + 1, board.columns + 1))
    black = _modules((rows + columns) % 2 == 0, np.zeros(2), board.square)
    size = np.array([board.columns + 1, board.rows + 1]) * board.square
    caption = f"{board}, squares {board.square * 1e3:g} mm"
    return Print(black, size, _quiet(board.square), caption)


def _charuco(board: Charuco) -> Print:
    """Squares that hold a marker are white, the others black."""
    markers = board.markers()
    black = np.ones((board.rows, board.columns), dtype=np.bool_)
    parts = []
    for corner, modules in markers:
        column, row = np.floor((corner + board.marker / 2.0) / board.square).astype(int)
        black[row, column] = False
        parts.append(_modules(~modules, corner, board.marker / len(modules)))
    squares = _modules(black, np.zeros(2), board.square)
    caption = (
        f"{board}, squares {board.square * 1e3:g} mm, markers {board.marker * 1e3:g} mm"
        f"{', legacy' if board.legacy else ''}"
    )
    size = np.array([board.columns, board.rows]) * board.square
    return Print(np.concatenate([squares, *parts]), size, _quiet(board.square), caption)


def _tag_grid(board: TagGrid) -> Print:
    module = board.tag / modules_across(board.family)
    if board.gap < module:
        raise BadInput(
            f"the gap between tags is {board.gap * 1e3:g} mm, less than one module"
            f" ({module * 1e3:.3g} mm)",
            where="--gap-mm",
            why="a tag needs a white border to be detected",
            next_step=f"use {2.0 * module * 1e3:.3g} mm or more",
        )
    step = board.tag + board.gap
    parts = []
    for number in range(board.first, board.first + board.columns * board.rows):
        row, column = board.position_of(number)
        modules = ~official_modules(board.family, number)
        parts.append(_modules(modules, np.array([column, row]) * step, module))
    size = np.array([board.columns, board.rows]) * step - board.gap
    caption = f"{board}, black squares {board.tag * 1e3:g} mm, gaps {board.gap * 1e3:g} mm"
    return Print(np.concatenate(parts), size, max(module, board.gap / 2.0), caption)


def _circle_grid(board: CircleGrid) -> Print:
    centres, radius = board.points()[:, :2] + board.diameter / 2.0, board.diameter / 2.0
    discs = np.column_stack([centres, np.full(len(centres), radius)])
    caption = f"{board}, spacing {board.spacing * 1e3:g} mm, diameters {board.diameter * 1e3:g} mm"
    size = centres.max(axis=0) + radius
    return Print(np.zeros((0, 4)), size, _quiet(board.spacing), caption, discs)


def _quiet(square: float) -> float:
    """Quiet zone of a chessboard, [m]: it separates the outermost squares from the table."""
    return min(square / 3.0, 0.008)


def _modules(black: NDArray[np.bool_], corner: Array, side: float) -> Array:
    """Rectangles of a grid's black modules, merged along rows, shape (n, 4), [m]."""
    found = []
    for row, line in enumerate(black):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(np.int8), [0]])))
        for first, after in edges.reshape(-1, 2).tolist():
            left, top = corner + np.array([first, row]) * side
            found.append([left, top, (after - first) * side, side])
    return np.array(found).reshape(-1, 4)


# PDF 1.4 pages in exact size: black shapes and plain text, in millimetres.
#
# Rectangles of a page are one path, so that viewers show no seams between them.
#
# Source: ISO 32000-1, 7.5 (file structure), 8.5 (paths), 9.4 (text).


POINTS_A_MM = 72.0 / 25.4


@dataclass(frozen=True, slots=True)
class Text:
    """A line of text.

    Attributes:
        x_mm: Of its start, from the left.
        y_mm: Of its base line, from the top.
        size_mm: Of the letters.
        text: Printable ASCII.
    """

    x_mm: float
    y_mm: float
    size_mm: float
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class Page:
    """A page.

    Attributes:
        width_mm: Of the paper.
        height_mm: Of the paper.
        black_mm: Left, top, width and height of black rectangles, from the top left, shape (n, 4).
        texts: Drawn on top.
        discs_mm: Centre and radius of black discs, from the same origin, shape (n, 3).
    """

    width_mm: float
    height_mm: float
    black_mm: Array
    texts: tuple[Text, ...]
    discs_mm: Array = field(default_factory=lambda: np.zeros((0, 3)))


def pdf_of(pages: list[Page], title: str) -> bytes:
    """The PDF file."""
    kids = " ".join(f"{4 + 2 * k} 0 R" for k in range(len(pages)))
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        f"<< /Type /Pages /Kids [{kids}] /Count {len(pages)} >>".encode(),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
    ]
    for number, page in enumerate(pages):
        box = f"[0 0 {page.width_mm * POINTS_A_MM:.4f} {page.height_mm * POINTS_A_MM:.4f}]"
        objects.append(
            f"<< /Type /Page /Parent 2 0 R /MediaBox {box} /Contents {5 + 2 * number} 0 R"
            " /Resources << /Font << /F1 3 0 R >> >> >>".encode()
        )
        content = _content_stream(page)
        objects.append(b"<< /Length %d >>\nstream\n%s\nendstream" % (len(content), content))
    objects.append(f"<< /Title ({_escaped(title)}) /Producer (cdpr) >>".encode())
    return _file(objects)


def _content_stream(page: Page) -> bytes:
    """The content stream of a page; one unit is a millimetre, y points down."""
    scale = f"{POINTS_A_MM:.10f}"
    lines = [f"{scale} 0 0 -{scale} 0 {page.height_mm * POINTS_A_MM:.6f} cm", "0 g"]
    lines += [f"{x:.5f} {y:.5f} {w:.5f} {h:.5f} re" for x, y, w, h in page.black_mm.tolist()]
    lines += [_disc(*disc) for disc in page.discs_mm.tolist()]
    lines.append("f")
    for text in page.texts:
        matrix = f"1 0 0 -1 {text.x_mm:.4f} {text.y_mm:.4f} Tm"
        lines.append(f"BT /F1 {text.size_mm:.3f} Tf {matrix} ({_escaped(text.text)}) Tj ET")
    return "\n".join(lines).encode("ascii")


def _disc(x: float, y: float, radius: float) -> str:
    """A disc of four Bézier curves, which are within 0.03 % of its radius."""
    bent = 4.0 / 3.0 * (2.0**0.5 - 1.0) * radius
    ends = [(radius, 0.0), (0.0, radius), (-radius, 0.0), (0.0, -radius), (radius, 0.0)]
    parts = [f"{x + radius:.5f} {y:.5f} m"]
    for (x0, y0), (x1, y1) in pairwise(ends):
        points = (
            (x0 - y0 / radius * bent, y0 + x0 / radius * bent),
            (x1 + y1 / radius * bent, y1 - x1 / radius * bent),
            (x1, y1),
        )
        parts.append(" ".join(f"{x + dx:.5f} {y + dy:.5f}" for dx, dy in points) + " c")
    return "\n".join(parts)


def _escaped(text: str) -> str:
    plain = text.encode("ascii", "replace").decode()
    return plain.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")


def _file(objects: list[bytes]) -> bytes:
    """Objects numbered from 1, the cross-reference table, and the trailer."""
    out = bytearray(b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n")
    offsets = []
    for number, body in enumerate(objects, 1):
        offsets.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    start = len(out)
    out += b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    for offset in offsets:
        out += b"%010d 00000 n \n" % offset
    out += b"trailer\n<< /Size %d /Root 1 0 R /Info %d 0 R >>\n" % (len(objects) + 1, len(objects))
    out += b"startxref\n%d\n%%%%EOF\n" % start
    return bytes(out)


# Layout on paper: in exact size, with a ruler to check it, or refused.


PaperName = Literal["a4", "a3", "letter"]
PAPERS = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
"""Width and height in portrait, [mm]."""
MARGIN_MM = 5.0
"""Margin that printers leave white, [mm]."""
_FOOT_MM = 12.0
"""Height of ruler and caption, [mm]."""
_CAPTION_MM = 5.0
"""Height of the caption below each of several prints, [mm]."""
_LETTERS_MM = 2.8
_LETTER_WIDTH_MM = 0.56 * _LETTERS_MM
"""More than the mean width of a caption's letters; of Helvetica's digits (Adobe's font metrics)."""
RULER_MM = 100.0


def sheet_of(print_: Print, paper: str, note: str = ". This side down.") -> Page:
    """A print centred on its own page, in portrait or landscape; a note follows its caption.

    Raises:
        BadInput: It does not fit, and must not be scaled or cut into tiles.
    """
    for width, height in _orientations(paper):
        if _fits(print_, width, height):
            border = _border(print_)
            free = np.array([width, height - _FOOT_MM - MARGIN_MM + border])
            corner = (free - 1e3 * print_.size) / 2.0
            corner[1] = min(corner[1], free[1] - border - 1e3 * (print_.size[1] + print_.quiet))
            return _page(width, height, [(print_, corner)], print_.caption + note)
    raise _too_large(print_, paper)


def sheets_of(prints: Sequence[Print], paper: str) -> list[Page]:
    """Several captioned prints, in rows on portrait pages; the largest on their own pages.

    Raises:
        BadInput: One of them does not fit.
    """
    width, height = PAPERS[paper]
    room = np.array([width, height - _FOOT_MM]) - 2.0 * MARGIN_MM
    alone: list[Page] = []
    pages: list[list[tuple[Print, Array]]] = []
    x = y = deepest = 0.0
    for print_ in sorted(prints, key=lambda p: -float(p.size[1])):
        needed = 1e3 * (print_.size + 2.0 * print_.quiet) + [0.0, _CAPTION_MM]
        if (needed > room).any():
            alone.append(sheet_of(print_, paper, note=""))
            continue
        caption = _LETTER_WIDTH_MM * len(print_.caption)
        needed[0] = max(needed[0], 1e3 * print_.quiet + caption)
        if x + needed[0] > room[0]:
            x, y, deepest = 0.0, y + deepest, 0.0
        if not pages or y + needed[1] > room[1]:
            pages.append([])
            x, y, deepest = 0.0, 0.0, 0.0
        pages[-1].append((print_, np.array([x, y]) + MARGIN_MM + 1e3 * print_.quiet))
        x, deepest = x + float(needed[0]), max(deepest, float(needed[1]))
    return alone + [_page(width, height, placed, "") for placed in pages]


@dataclass(frozen=True, slots=True, eq=False)
class Printout:
    """Targets on sheets of paper.

    Attributes:
        what: Human-readable name of the targets.
        pages: The sheets.
    """

    what: str
    pages: tuple[Page, ...]

    def pdf(self) -> bytes:
        """The sheets as a PDF file, in exact size."""
        return pdf_of(list(self.pages), f"cdpr: {self.what}")

    def save(self, path: Path | str, *, replace: bool = False) -> None:
        """Writes the sheets to a PDF file.

        Args:
            path: Its name ends in ``.pdf``.
            replace: Whether it may exist.

        Raises:
            BadInput: It exists, is named otherwise, or cannot be written.
        """
        path = path_of(path)
        require_new_file(path, replace)
        if path.suffix.lower() != ".pdf":
            raise BadInput(
                "the output must be a PDF file",
                where=str(path),
                next_step=f"name it {path.with_suffix('.pdf').name}",
            )
        write_bytes_atomic(path, self.pdf())


def printout(of: Board | Rig, paper: str = "a4") -> Printout:
    """A board, or all tags of a rig, on paper of a size: ``a4``, ``a3`` or ``letter``.

    Raises:
        BadInput: The rig has no tags, or something does not fit the paper.
    """
    if isinstance(of, Rig):
        prints = tag_prints(of)
        return Printout(f"{len(prints)} tags", tuple(sheets_of(prints, paper)))
    return Printout(str(of), (sheet_of(board_print(of), paper),))


def tag_prints(rig: Rig) -> list[Print]:
    """The prints of all tags of a rig, each captioned with its group.

    Raises:
        BadInput: It has none.
    """
    groups = {"platform": rig.platform_tags, "frame": rig.frame_tags}
    if not any(groups.values()):
        raise BadInput("the rig has no tags", where=rig.name, next_step="add a `tags` section")
    prints = [
        (group, tag_print(rig.tag_family, tag.id, tag.size))
        for group, tags in groups.items()
        for tag in tags
    ]
    return [replace(made, caption=f"{made.caption}, {group}") for group, made in prints]


def _orientations(paper: str) -> list[tuple[float, float]]:
    width, height = PAPERS[paper]
    return [(width, height), (height, width)]


def _border(print_: Print) -> float:
    """White border at the sides and above, [mm]; includes the printer's margin."""
    return max(MARGIN_MM, 1e3 * print_.quiet)


def _needed(print_: Print) -> Array:
    """Width and height of paper required, shape (2,), [mm]."""
    border = _border(print_)
    below = 1e3 * print_.quiet + _FOOT_MM + MARGIN_MM
    return np.asarray(1e3 * print_.size + [2.0 * border, border + below])


def _fits(print_: Print, width: float, height: float) -> bool:
    return bool((_needed(print_) <= [width, height]).all())


def _page(width: float, height: float, placed: Sequence[tuple[Print, Array]], caption: str) -> Page:
    """A page with prints, the ruler, and a caption at the foot or one below each print."""
    black, texts = _ruler(height)
    discs = np.zeros((0, 3))
    for print_, corner in placed:
        black = np.concatenate([black, 1e3 * print_.black + [*corner, 0.0, 0.0]])
        discs = np.concatenate([discs, 1e3 * print_.discs + [*corner, 0.0]])
        if not caption:
            below = float(corner[1]) + 1e3 * (float(print_.size[1]) + print_.quiet) + _LETTERS_MM
            texts.append(Text(float(corner[0]), below, _LETTERS_MM, print_.caption))
    if caption:
        texts.append(Text(MARGIN_MM, height - MARGIN_MM - 0.8, _LETTERS_MM, caption))
    return Page(width, height, black, tuple(texts), discs)


def _ruler(height: float) -> tuple[Array, list[Text]]:
    """The ruler at the foot of the page."""
    left, top = MARGIN_MM, height - MARGIN_MM - _FOOT_MM + 2.0
    ticks = [[left, top, RULER_MM, 0.2]]
    for millimetre in range(int(RULER_MM) + 1):
        deep = 4.0 if millimetre % 10 == 0 else 2.5 if millimetre % 5 == 0 else 1.5
        ticks.append([left + millimetre - 0.05, top, 0.1, deep])
    note = f"{RULER_MM:g} mm: measure it. Print at 100 %, not scaled to the page."
    return np.array(ticks), [Text(left + RULER_MM + 3.0, top + 3.0, _LETTERS_MM, note)]


def _too_large(print_: Print, paper: str) -> BadInput:
    needed = _needed(print_)
    others = [name for name in PAPERS if any(_fits(print_, *size) for size in _orientations(name))]
    width, height = PAPERS[paper]
    return BadInput(
        f"{print_.caption} needs paper of {needed[0]:.0f} x {needed[1]:.0f} mm with its white"
        f" border and the ruler; {paper} has {width:g} x {height:g} mm",
        where="--paper",
        why="a board in several parts would be neither flat nor exact, so it is not split",
        next_step=f"use --paper {others[0]}"
        if others
        else "make it smaller, or have it printed professionally",
    )
