"""The page that shows all maps; it needs neither a server nor a network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from string import Template
from typing import Any


@dataclass(frozen=True, slots=True)
class Chapter:
    """A grid on the page.

    Attributes:
        title: Heading.
        text: What is seen.
        pictures: File names of the pictures, each with its alternative text.
        tables: File names of the numbers.
        summary: From `planner.workspace.tables.summary_of`.
    """

    title: str
    text: str
    pictures: tuple[tuple[str, str], ...]
    tables: tuple[str, ...]
    summary: dict[str, Any]


def page(title: str, lead: str, chapters: Sequence[Chapter]) -> str:
    """The whole page."""
    template = files("planner.workspace").joinpath("page.template").read_text(encoding="utf-8")
    return Template(template).substitute(
        title=escape(title), lead=escape(lead), sections="\n".join(map(_section, chapters))
    )


def _section(chapter: Chapter) -> str:
    pictures = "".join(
        f'<img src="{escape(name)}" alt="{escape(text)}">' for name, text in chapter.pictures
    )
    links = ", ".join(f'<a href="{escape(n)}">{escape(n)}</a>' for n in chapter.tables)
    return (
        f"<section><h2>{escape(chapter.title)}</h2>"
        f'<p class="quiet">{escape(chapter.text)}</p>{pictures}'
        f'{_table(chapter.summary)}<p class="quiet">Numbers: {links}</p></section>'
    )


def _table(summary: dict[str, Any]) -> str:
    rows = [("points", f"{summary['points']}")]
    rows += [
        (name.replace("_", " "), f"{share * 100:.2f} %") for name, share in summary["share"].items()
    ]
    rows += [
        (name, "–" if ends is None else f"{ends[0]:.5g} to {ends[1]:.5g}")
        for name, ends in summary["range"].items()
    ]
    body = "".join(
        f'<tr><th scope="row">{escape(k)}</th><td>{escape(v)}</td></tr>' for k, v in rows
    )
    return f'<div class="scroll"><table>{body}</table></div>'
