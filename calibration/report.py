"""Calibration report: one self-contained HTML page."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape

from calibration.results import CalibrationVerdict
from calibration.statistics import Interval
from model.pages.page import bullets, list_table, page, paragraph, section, table


@dataclass(frozen=True, slots=True)
class Section:
    """A section of a report.

    Attributes:
        heading: Plain text.
        body: HTML, such as from `table_of`.
        note: Plain text between heading and body.
    """

    heading: str
    body: str
    note: str = ""


def page_of(
    title: str,
    lead: str,
    verdict: CalibrationVerdict,
    sections: Iterable[Section],
    *,
    tiles: str = "",
    scripts: Sequence[str] = (),
    data: Mapping[str, object] | None = None,
) -> str:
    """The report page: verdict and next steps first, then the sections.

    Args:
        lead: Plain text below the title.
        sections: In order.
        tiles: Key figures, HTML from `model.pages.page.tiles`.
        scripts: As in `model.pages.page.page`.
        data: Read by the scripts.
    """
    mark = "pass" if verdict.good else "fail"
    banner = (
        f'<section class="verdict {mark}" id="verdict">'
        f'<p class="sentence">{escape(str(verdict))}</p>'
        f"{bullets(verdict.next_steps)}</section>"
    )
    body = "\n".join(_section(k, part) for k, part in enumerate(sections, start=1))
    return page(title, banner + tiles + body, lead=paragraph(lead), scripts=scripts, data=data)


def _section(number: int, part: Section) -> str:
    note = paragraph(part.note) if part.note else ""
    return section(f"part-{number}", part.heading, note, part.body)


def table_of(rows: Iterable[Sequence[str]], head: Sequence[str] = ()) -> str:
    """A table of plain text, with a header row or names first; "none" without rows."""
    found = [tuple(row) for row in rows]
    if not found:
        return paragraph("none")
    return list_table(head, found) if head else table((row[0], ", ".join(row[1:])) for row in found)


def drawing(shapes: str, size: tuple[float, float], label: str, kind: str = "medium") -> str:
    """A figure of SVG shapes.

    Args:
        shapes: SVG elements that use the page's colour variables.
        size: Width and height of their coordinates.
        label: Text alternative for readers who cannot see the figure.
        kind: CSS class of its size, ``small`` or ``medium``.
    """
    text = escape(label, quote=True)
    return (
        f'<figure class="drawing {kind}"><svg viewBox="0 0 {size[0]:.0f} {size[1]:.0f}" role="img"'
        f' aria-label="{text}"><title>{text}</title>{shapes}</svg></figure>'
    )


def interval_rows(intervals: dict[str, Interval]) -> list[tuple[str, str]]:
    """Table rows: name, and value with its half width."""
    return [(name, str(interval)) for name, interval in intervals.items()]
