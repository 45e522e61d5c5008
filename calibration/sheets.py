"""Prints on paper: in exact size, with a ruler to prove it, or refused."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibration.pdf import Page, Text
from calibration.prints import Print
from cdpr.errors import BadInput
from cdpr.poses import Array

PAPERS = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
"""Width and height upright, [mm]."""
MARGIN_MM = 5.0
"""What printers leave white."""
_FOOT_MM = 12.0
"""For ruler and caption."""
_CAPTION_MM = 5.0
"""For the line below each of several prints."""
_LETTERS_MM = 2.8
RULER_MM = 100.0


def sheet_of(print_: Print, paper: str) -> Page:
    """A print in the middle of a page of its own, upright or across.

    Raises:
        BadInput: It does not fit, and must not be scaled or cut into tiles.
    """
    for width, height in _turns(paper):
        if _fits(print_, width, height):
            border = _border(print_)
            free = np.array([width, height - _FOOT_MM - MARGIN_MM + border])
            corner = (free - 1e3 * print_.size) / 2.0
            corner[1] = min(corner[1], free[1] - border - 1e3 * (print_.size[1] + print_.quiet))
            return _page(width, height, [(print_, corner)], f"{print_.caption}. This side down.")
    raise _too_large(print_, paper)


def sheets_of(prints: Sequence[Print], paper: str) -> list[Page]:
    """Several prints with their names below, row after row on upright pages.

    Raises:
        BadInput: One of them does not fit.
    """
    width, height = PAPERS[paper]
    room = np.array([width, height - _FOOT_MM]) - 2.0 * MARGIN_MM
    pages: list[list[tuple[Print, Array]]] = [[]]
    x = y = deepest = 0.0
    for print_ in sorted(prints, key=lambda p: -float(p.size[1])):
        needed = 1e3 * (print_.size + 2.0 * print_.quiet) + [0.0, _CAPTION_MM]
        if (needed > room).any():
            raise _too_large(print_, paper)
        if x + needed[0] > room[0]:
            x, y, deepest = 0.0, y + deepest, 0.0
        if y + needed[1] > room[1]:
            pages.append([])
            x, y, deepest = 0.0, 0.0, 0.0
        pages[-1].append((print_, np.array([x, y]) + MARGIN_MM + 1e3 * print_.quiet))
        x, deepest = x + float(needed[0]), max(deepest, float(needed[1]))
    return [_page(width, height, placed, "") for placed in pages]


def _turns(paper: str) -> list[tuple[float, float]]:
    width, height = PAPERS[paper]
    return [(width, height), (height, width)]


def _border(print_: Print) -> float:
    """White at the sides and above, [mm]: what it needs, of which the printer leaves some."""
    return max(MARGIN_MM, 1e3 * print_.quiet)


def _needed(print_: Print) -> Array:
    """Width and height of the paper that it needs, shape (2,), [mm]."""
    border = _border(print_)
    below = 1e3 * print_.quiet + _FOOT_MM + MARGIN_MM
    return np.asarray(1e3 * print_.size + [2.0 * border, border + below])


def _fits(print_: Print, width: float, height: float) -> bool:
    return bool((_needed(print_) <= [width, height]).all())


def _page(width: float, height: float, placed: Sequence[tuple[Print, Array]], caption: str) -> Page:
    """A page with prints, the ruler, and one caption at its foot or each print's below it."""
    black, texts = _ruler(width, height)
    for print_, corner in placed:
        black = np.concatenate([black, 1e3 * print_.black + [*corner, 0.0, 0.0]])
        if not caption:
            below = float(corner[1]) + 1e3 * (float(print_.size[1]) + print_.quiet) + _LETTERS_MM
            texts.append(Text(float(corner[0]), below, _LETTERS_MM, print_.caption))
    if caption:
        texts.append(Text(MARGIN_MM, height - MARGIN_MM - 0.8, _LETTERS_MM, caption))
    return Page(width, height, black, tuple(texts))


def _ruler(width: float, height: float) -> tuple[Array, list[Text]]:
    """The ruler at the foot of the page."""
    left, top = MARGIN_MM, height - MARGIN_MM - _FOOT_MM + 2.0
    ticks = [[left, top, RULER_MM, 0.2]]
    for millimetre in range(int(RULER_MM) + 1):
        deep = 4.0 if millimetre % 10 == 0 else 2.5 if millimetre % 5 == 0 else 1.5
        ticks.append([left + millimetre - 0.05, top, 0.1, deep])
    say = f"{RULER_MM:g} mm: measure it. Print at 100 %, not fitted to the page."
    return np.array(ticks), [Text(left + RULER_MM + 3.0, top + 3.0, _LETTERS_MM, say)]


def _too_large(print_: Print, paper: str) -> BadInput:
    needed = _needed(print_)
    others = [name for name in PAPERS if any(_fits(print_, *turned) for turned in _turns(name))]
    width, height = PAPERS[paper]
    return BadInput(
        f"{print_.caption} needs paper of {needed[0]:.0f} x {needed[1]:.0f} mm with its white"
        f" border and the ruler; {paper} has {width:g} x {height:g} mm",
        where="--paper",
        why="a board in several parts would not be flat or exact, so it is not cut into tiles",
        next_step=f"use --paper {others[0]}" if others else "make it smaller, or order it printed",
    )
