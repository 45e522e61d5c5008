"""Small pieces of HTML; every text that comes from a file is escaped here."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from html import escape

_UNIT = re.compile(r"(?<=\d) (?=(?:mm|ms|s|N|%)\b|%)")


def table(rows: Iterable[tuple[str, str]]) -> str:
    """A table of names and values."""
    body = "".join(
        f'<tr><th scope="row">{escape(k)}</th><td>{escape(v)}</td></tr>' for k, v in rows
    )
    return f'<div class="scroll"><table>{body}</table></div>'


def list_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table with a head line."""
    top = "".join(f'<th scope="col">{escape(name)}</th>' for name in head)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows
    )
    return (
        f'<div class="scroll"><table class="events"><thead><tr>{top}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def chart(svg: str) -> str:
    """A figure on the page; on a narrow window it scrolls sideways."""
    return f'<figure class="chart">{svg}</figure>'


def section(name: str, title: str, *parts: str) -> str:
    """A section with a heading."""
    return f'<section id="{name}"><h2>{escape(title)}</h2>{"".join(parts)}</section>'


def paragraph(text: str) -> str:
    """A quiet line of explanation."""
    return f'<p class="quiet">{escape(text)}</p>'


def known(value: float | None, digits: int, unit: str) -> str:
    """A number with its unit, or a dash for one that is not known."""
    return "–" if value is None else f"{value:.{digits}f} {unit}".rstrip()


def prose(text: str) -> str:
    """An escaped sentence whose numbers keep their units on the same line."""
    return _UNIT.sub("\u00a0", escape(text))
