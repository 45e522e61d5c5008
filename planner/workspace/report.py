"""The page with all maps; it needs neither a server nor a network."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.pages.page import page as html_page
from model.pages.page import paragraph, picture, section, table
from model.pages.scene import SceneFigure
from model.pages.viewer import SCENE_SCRIPTS, page_data, viewer
from model.pose import quaternion_from_matrix
from planner.workspace.compute import VERDICTS, Maps
from planner.workspace.grid import AXES
from planner.workspace.maps import Question


@dataclass(frozen=True, slots=True)
class Chapter:
    """A grid on the page.

    Attributes:
        title: Heading.
        text: What the images show.
        pictures: File names of the images, each with its alternative text.
        tables: File names of the numbers.
        summary: From `planner.workspace.report.summary_of`.
        scene: In which the first image can be turned; at most one chapter of a page has one.
        layers: Of the scene.
    """

    title: str
    text: str
    pictures: tuple[tuple[str, str], ...]
    tables: tuple[str, ...]
    summary: dict[str, Any]
    scene: SceneFigure | None = None
    layers: tuple[tuple[str, str, str, bool], ...] = ()


def page(title: str, lead: Sequence[str], chapters: Sequence[Chapter]) -> str:
    """The whole page; ``lead`` is its first paragraphs."""
    body = "\n".join(_section(k, chapter) for k, chapter in enumerate(chapters, start=1))
    scenes = [chapter.scene for chapter in chapters if chapter.scene]
    scripts, data = (SCENE_SCRIPTS, page_data(scenes[0])) if scenes else ((), None)
    return html_page(
        title,
        body,
        lead="".join(map(paragraph, lead)),
        scripts=scripts,
        data=data,
        files_beside=True,
    )


def _section(number: int, chapter: Chapter) -> str:
    pictures = "".join(picture(name, text) for name, text in chapter.pictures)
    if chapter.scene:
        drawn = {one.layer for one in chapter.scene.surfaces} | {"robot", "numbers"}
        drawn |= {one.layer for one in chapter.scene.strokes}
        layers = [one for one in chapter.layers if one[0] in drawn]
        pictures = viewer(chapter.scene, chapter.title, layers, still=pictures)
    links = ", ".join(f'<a href="{escape(n)}">{escape(n)}</a>' for n in chapter.tables)
    numbers = f'<p class="quiet">Numbers: {links}</p>'
    parts = (paragraph(chapter.text), pictures, _table(chapter.summary), numbers)
    return section(f"grid-{number}", chapter.title, *parts)


def _table(summary: dict[str, Any]) -> str:
    rows = [("points", f"{summary['points']}")]
    rows += [
        (name.replace("_", " "), f"{share * 100:.2f} %") for name, share in summary["share"].items()
    ]
    rows += [
        (name, "–" if ends is None else f"{ends[0]:.5g} to {ends[1]:.5g}")
        for name, ends in summary["range"].items()
    ]
    return table(rows)


# Presentation of each quantity: title, unit, column name, colours and limit.


@dataclass(frozen=True, slots=True)
class Shown:
    """Presentation of a quantity.

    Attributes:
        name: In `Maps.values`.
        title: Human-readable name.
        unit: Unit of display; empty for none.
        column: Its name in tables, unit included.
        scale: From SI to the unit.
        colours: Name of a matplotlib colour map; bright means better.
    """

    name: str
    title: str
    unit: str
    column: str
    scale: float
    colours: str

    @property
    def label(self) -> str:
        """Title and unit."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title


SHOWN = (
    Shown("closure_margin", "wrench closure margin", "", "closure_margin", 1.0, "viridis"),
    Shown("capacity_margin", "capacity margin", "N", "capacity_margin_n", 1.0, "viridis"),
    Shown("condition_number", "condition number", "", "condition_number", 1.0, "viridis_r"),
    Shown("force_volume", "volume of forces", "N³", "force_volume_n3", 1.0, "viridis"),
    Shown("dexterity_cost", "dexterity cost", "", "dexterity_cost", 1.0, "viridis_r"),
    Shown("wrench_cost", "wrench cost", "", "wrench_cost", 1.0, "viridis_r"),
    Shown("cost", "kinematic cost", "", "kinematic_cost", 1.0, "viridis_r"),
    Shown("self_clearance", "self clearance", "mm", "self_clearance_mm", 1e3, "cividis"),
    Shown(
        "obstacle_clearance", "obstacle clearance", "mm", "obstacle_clearance_mm", 1e3, "cividis"
    ),
)


def shown_in(maps: Maps) -> tuple[Shown, ...]:
    """The quantities present in the maps."""
    return tuple(quantity for quantity in SHOWN if quantity.name in maps.values)


def limit_of(maps: Maps, quantity: Shown) -> float | None:
    """The smallest allowed value, in the unit shown; None for a quantity without a limit."""
    scene = maps.question.scene
    limits = {
        "closure_margin": 0.0,
        "capacity_margin": 0.0,
        "self_clearance": scene.self_clearance if scene else 0.0,
        "obstacle_clearance": scene.obstacle_clearance if scene else 0.0,
    }
    limit = limits.get(quantity.name)
    return None if limit is None else limit * quantity.scale


# Maps as tables, arrays and one summary, with units in the names.


_DIGITS = 9


def arrays_of(maps: Maps) -> dict[str, NDArray[Any]]:
    """Axes ``x_mm`` …, and every map in the shape of the grid, by column name."""
    arrays: dict[str, NDArray[Any]] = {
        f"{letter}_mm": axis * 1e3 for letter, axis in zip(AXES, maps.grid.axes, strict=True)
    }
    for quantity in shown_in(maps):
        arrays[quantity.column] = maps.values[quantity.name] * quantity.scale
    return arrays | _answers(maps)


def csv_of(maps: Maps) -> str:
    """One line per point; verdicts are 0 or 1, unknown values empty."""
    arrays = arrays_of(maps)
    coordinates = np.meshgrid(*(arrays.pop(f"{letter}_mm") for letter in AXES), indexing="ij")
    columns = {f"{letter}_mm": p for letter, p in zip(AXES, coordinates, strict=True)} | arrays
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(columns)
    flat = [column.ravel().tolist() for column in columns.values()]
    writer.writerows([_cell(value) for value in row] for row in zip(*flat, strict=True))
    return file.getvalue()


def summary_of(maps: Maps) -> dict[str, Any]:
    """Extent of the grid, share of points that are allowed, and the range of every quantity."""
    verdict = maps.verdict
    return {
        "points": maps.grid.count,
        "lower_mm": [round(float(a[0]) * 1e3, 6) for a in maps.grid.axes],
        "upper_mm": [round(float(a[-1]) * 1e3, 6) for a in maps.grid.axes],
        "share": {name: float(np.mean(answer)) for name, answer in _answers(maps).items()},
        "verdict": {text: float(np.mean(verdict == k)) for k, text in enumerate(VERDICTS)},
        "range": {
            quantity.column: _range(maps.values[quantity.name] * quantity.scale)
            for quantity in shown_in(maps)
        },
    }  # fmt: skip


ABOUT = "about"
"""Key of `about_of` beside the summaries of grids, none of which has this name."""


def about_of(question: Question) -> dict[str, Any]:
    """What maps were computed for and with: all that their values depend on but the grids."""
    rig, scene = question.rig, question.scene
    return {
        "rig": {"name": rig.name, "plan_hash": rig.plan_hash},
        "scene": None if scene is None else {"name": scene.name, "hash": scene.hash},
        "rotation_wxyz": quaternion_from_matrix(question.rotation).tolist(),
        "characteristic_length_mm": question.length * 1e3,
        "version": version("cdpr"),
    }


def about_text(about: Mapping[str, Any]) -> str:
    """The same as a sentence."""
    rig, scene = about["rig"], about["scene"]
    within = "no scene" if scene is None else f"scene {scene['name']}, hash {scene['hash']}"
    rotation = " ".join(f"{number:.6g}" for number in about["rotation_wxyz"])
    return (
        f"Rig {rig['name']}, hash {rig['plan_hash']}; {within}; rotation w x y z {rotation};"
        f" cdpr {about['version']}."
    )


def summary_facts(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Human-readable summary, one line per map.

    Args:
        summary: Of each map, see `summary_of`, by its name; beside them `ABOUT`.
    """
    facts = []
    for name, found in summary.items():
        if name == ABOUT:
            continue
        share = found["share"]
        margin = found["range"]["capacity_margin_n"]
        text = (
            f"{found['points']} points; wrench closure {share['closed'] * 100:.1f} %,"
            f" feasible {share['feasible'] * 100:.1f} %, allowed {share['allowed'] * 100:.1f} %"
        )
        if margin is not None:
            text += f"; capacity margin {margin[0]:.1f} to {margin[1]:.1f} N"
        facts.append((name.replace("_", " "), text))
    return facts


def _answers(maps: Maps) -> dict[str, NDArray[np.bool_]]:
    return {
        "closed": maps.closed,
        "feasible": maps.feasible,
        "collision_free": maps.collision_free,
        "allowed": maps.verdict == 0,
    }


def _range(values: NDArray[np.float64]) -> list[float] | None:
    finite = values[np.isfinite(values)]
    return [float(finite.min()), float(finite.max())] if len(finite) else None


def _cell(value: float | bool) -> str:
    if isinstance(value, bool):
        return str(int(value))
    return "" if np.isnan(value) else f"{value:.{_DIGITS}g}"
