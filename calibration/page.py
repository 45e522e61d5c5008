"""The report of a calibration: one page that needs neither a server nor a network."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from string import Template

from calibration.interval import Interval
from calibration.verdict import Verdict


@dataclass(frozen=True, slots=True)
class Section:
    """A part of a report.

    Attributes:
        heading: Plain text.
        body: HTML, such as of `table_of`.
        note: Plain text between both.
    """

    heading: str
    body: str
    note: str = ""


def page_of(title: str, lead: str, verdict: Verdict, sections: Iterable[Section]) -> str:
    """The whole page: verdict and next steps first, then the sections.

    Args:
        title: Plain text.
        lead: Plain text below it.
        verdict: What the calibration is good for.
        sections: In order.
    """
    template = files("calibration").joinpath("page.template").read_text(encoding="utf-8")
    return Template(template).substitute(
        title=escape(title),
        lead=escape(lead),
        mark="good" if verdict.good else "bad",
        verdict=escape(str(verdict)),
        steps="".join(f"<li>{escape(step)}</li>" for step in verdict.next_steps),
        sections="\n".join(_section(section) for section in sections),
    )


def _section(section: Section) -> str:
    note = f'<p class="quiet">{escape(section.note)}</p>' if section.note else ""
    return f"<section><h2>{escape(section.heading)}</h2>{note}{section.body}</section>"


def table_of(rows: Iterable[Sequence[str]], head: Sequence[str] = ()) -> str:
    """A table of plain texts, the first of each row its heading; "none" without rows."""
    titles = "".join(f'<th scope="col">{escape(title)}</th>' for title in head)
    text = [f"<tr>{titles}</tr>"] if head else []
    for first, *rest in rows:
        cells = "".join(f"<td>{escape(cell)}</td>" for cell in rest)
        text.append(f'<tr><th scope="row">{escape(first)}</th>{cells}</tr>')
    body = "".join(text) or "<tr><td>none</td></tr>"
    return f'<div class="scroll"><table>{body}</table></div>'


def interval_rows(intervals: dict[str, Interval]) -> list[tuple[str, str]]:
    """Rows of numbers and how far off they may be."""
    return [(name, str(interval)) for name, interval in intervals.items()]
