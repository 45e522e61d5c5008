"""The HTML page and its parts; all text from outside is escaped here.

A page is one file in one style (`base.css`), light or dark like the reader's system, and needs
neither a server nor a network. It is complete without scripts.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

_UNIT = re.compile(r"(?<=\d) (?=(?:mm|ms|s|N|%)\b|%)")

_OPTION = re.compile(r"(?<![\w<-])(--[a-z][a-z-]*[a-z])(?![^<]*</code>)")


def page(
    title: str,
    body: str,
    *,
    lead: str = "",
    scripts: Sequence[str] = (),
    data: Mapping[str, object] | None = None,
    files_beside: bool = False,
) -> str:
    """The whole page.

    Args:
        body: HTML, such as of `section`.
        lead: HTML below the title.
        scripts: File names in this package, such as ``charts.js``.
        data: Data for the scripts, JSON-like, by the id of its element.
        files_beside: Whether the page shows images that are files in its folder.
    """
    policy = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
    policy += " 'self' file:" if files_beside else ""
    policy += "; script-src 'unsafe-inline'" if scripts else ""
    parts = [_json_script(name, value) for name, value in (data or {}).items()]
    parts += [f"<script>{resource(name)}</script>" for name in scripts]
    return Template(resource("page.template")).substitute(
        title=escape(title),
        policy=policy,
        style=resource("base.css"),
        lead=lead,
        body=body,
        scripts="\n".join(parts),
    )


def resource(name: str) -> str:
    """The text of a file of this package."""
    return files("model.pages").joinpath(name).read_text(encoding="utf-8")


def _json_script(name: str, value: Any) -> str:
    text = json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return f'<script type="application/json" id="{name}">{text}</script>'


def section(name: str, title: str, *parts: str) -> str:
    """A section with a heading; ``name`` is its id."""
    return f'<section id="{name}"><h2>{escape(title)}</h2>{"".join(parts)}</section>'


def contents(sections: Iterable[tuple[str, str]]) -> str:
    """Links to sections by id and title."""
    links = "".join(f'<li><a href="#{name}">{escape(text)}</a></li>' for name, text in sections)
    return f'<nav aria-label="Sections"><ul>{links}</ul></nav>'


def paragraph(text: str, kind: str = "") -> str:
    """A muted line of explanation; ``kind`` is an additional CSS class."""
    return (
        f'<p class="quiet {kind}">{escape(text)}</p>'
        if kind
        else (f'<p class="quiet">{escape(text)}</p>')
    )


def bullets(texts: Iterable[str]) -> str:
    """A list of plain texts; commands in backticks and command-line options become code."""
    return "<ul>" + "".join(f"<li>{_with_code(text)}</li>" for text in texts) + "</ul>"


def _with_code(text: str) -> str:
    commands = re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(text))
    return _OPTION.sub(r'<code class="option">\1</code>', commands)


def tile(name: str, value: str, note: str, kind: str = "") -> str:
    """A key figure: name, number with unit, and a note below; kind ``headline`` is large."""
    number, _, unit = value.rpartition(" ") if " " in value else (value, "", "")
    opening = f'<div class="{kind}">' if kind else "<div>"
    return (
        f"{opening}<dt>{escape(name)}</dt><dd>{escape(number)}\u00a0<small>{escape(unit)}</small>"
        f'<span class="note">{prose(note)}</span></dd></div>'
    )


def tiles(parts: Iterable[str]) -> str:
    """Key figures beside each other."""
    return f'<dl class="tiles">{"".join(parts)}</dl>'


def table(rows: Iterable[tuple[str, str]]) -> str:
    """A table of names and values."""
    body = "".join(
        f'<tr><th scope="row">{escape(k)}</th><td>{escape(v)}</td></tr>' for k, v in rows
    )
    return f'<div class="scroll"><table>{body}</table></div>'


def list_table(head: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> str:
    """A table with a header row; it scrolls where the window is narrow.

    Args:
        head: Title of each column.
        rows: Cells; line breaks are kept.
        kind: CSS class, such as ``numbers`` for columns of numbers.
    """
    top = "".join(f'<th scope="col">{escape(name)}</th>' for name in head)
    body = "".join("<tr>" + "".join(map(_cell, row)) + "</tr>" for row in rows)
    return (
        f'<div class="scroll" tabindex="0"><table class="events {kind}">'
        f"<thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def _cell(text: str) -> str:
    joined = text.replace(" ± ", "\u00a0±\u00a0")
    return "<td>" + escape(joined).replace("\n", "<br>") + "</td>"


def picture(name: str, alternative: str) -> str:
    """An image file beside the page, on a white background, with a link to it.

    It scrolls where the window is narrow, so that its numbers stay legible.
    """
    file = escape(name)
    shown = f'<a href="{file}"><img class="paper" src="{file}" alt="{escape(alternative)}"></a>'
    return f'<div class="scroll drawn" tabindex="0">{shown}</div>'


def known(value: float | None, digits: int, unit: str) -> str:
    """A number with its unit, or a dash where unknown."""
    return "–" if value is None else f"{value:.{digits}f} {unit}".rstrip()


def prose(text: str) -> str:
    """An escaped sentence with each number and its unit kept on the same line."""
    return _UNIT.sub("\u00a0", escape(text))


# Notebook display.


def html_table(title: str, rows: Iterable[tuple[str, str]]) -> str:
    """A title and rows of name and value as HTML; every text is escaped."""
    cells = "".join(
        f'<tr><th style="text-align:left">{escape(name)}</th>'
        f'<td style="text-align:left">{escape(value)}</td></tr>'
        for name, value in rows
    )
    return f"<table><caption><b>{escape(title)}</b></caption>{cells}</table>"


class FactsDisplay:
    """Base of results that show their facts: in one line as text, as a table in a notebook."""

    __slots__ = ()

    def facts(self) -> list[tuple[str, str]]:
        """Human-readable names and values."""
        raise NotImplementedError

    def __repr__(self) -> str:
        """The facts in one line."""
        facts = "; ".join(f"{name}: {value}" for name, value in self.facts())
        return f"<{type(self).__name__} {facts}>"

    def _repr_html_(self) -> str:
        """For notebooks."""
        return html_table(type(self).__name__, self.facts())
