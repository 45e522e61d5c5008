"""Images, tables and page of maps, as files in a folder."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable, Set
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from model.files.documents import write_atomic, write_bytes_atomic
from model.scene import Scene
from model.statics.gravity import inertial_wrench
from planner.costs import margin_reserve
from planner.settings import CLEARANCE_RESERVE
from planner.workspace.compute import Maps
from planner.workspace.figures import (
    SPACE_LAYERS,
    cost_figure,
    level_figure,
    slice_figure,
    space_figure,
    space_scene,
    title_of,
    write_figures,
)
from planner.workspace.maps import Question
from planner.workspace.report import (
    ABOUT,
    Chapter,
    about_of,
    about_text,
    arrays_of,
    csv_of,
    page,
    shown_in,
    summary_of,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Draw = Callable[[], "Figure"]
PAGE = "index.html"
SUMMARY = "summary.json"
_GRID = re.compile(r"slice_[xyz]_(minus_)?[\d.]+(e(\+|minus_)\d+)?|frame|workspace")
_LEVELS_OF = (
    "capacity_margin",
    "dexterity_cost",
    "wrench_cost",
    "self_clearance",
    "obstacle_clearance",
)


def write_maps(
    folder: Path, made: list[Maps], question: Question, scene: Scene | None = None
) -> dict[str, Any]:
    """Writes all files and returns the summaries by name of grid, after what they are about.

    Then removes the maps of a former run from the folder.

    Args:
        made: Maps of slices, of a volume named ``frame`` for the image of the whole space, and of
            other volumes.
        question: Rig, scene, orientation and quantities of the maps.
        scene: With the obstacles.
    """
    where = f" in {scene.name}" if scene else ""
    title = f"Workspace of {question.rig.name}{where}"
    chapters = [_chapter(folder, maps) for maps in made]
    about = about_of(question)
    lead = (_lead(question), about_text(about))
    write_atomic(folder / PAGE, page(title, lead, chapters))
    summary = {ABOUT: about} | {m.grid.name: c.summary for m, c in zip(made, chapters, strict=True)}
    write_atomic(folder / SUMMARY, json.dumps(summary, indent=1) + "\n")
    shown = {name for chapter in chapters for name in (*chapter.tables, *dict(chapter.pictures))}
    _remove_former(folder, kept={Path(name).stem for name in shown})
    return summary


def _remove_former(folder: Path, kept: Set[str]) -> None:
    """Removes files of maps but those ``kept``, named without suffix.

    A map has its arrays beside it, so other files with such names stay.
    """
    for arrays in list(folder.glob("*.npz")):
        if _GRID.fullmatch(arrays.stem):
            for name in _files_of(arrays.stem):
                if Path(name).stem not in kept and (folder / name).is_file():
                    (folder / name).unlink()


def _files_of(grid: str) -> list[str]:
    """Names of all files that a grid can have; that of its arrays last."""
    figures, tables = [grid, f"{grid}_costs"], [f"{grid}.csv"]
    if grid == "frame":
        figures, tables = [grid], []
    elif grid == "workspace":
        figures, tables = [f"{grid}_{quantity}" for quantity in _LEVELS_OF], []
    images = [f"{figure}.{kind}" for figure in figures for kind in ("png", "svg")]
    return [*images, *tables, f"{grid}.npz"]


def _lead(question: Question) -> str:
    """First sentences of the page."""
    rig = question.rig
    inertia = max(inertial_wrench(rig, load, turns=False) for load in question.loads)
    reserve = max(margin_reserve(rig, load, turns=False) for load in question.loads)
    return (
        f"Tensions {rig.min_tension:g} to {rig.max_tension:g} N; moments divided by"
        f" {question.length * 1e3:.1f} mm in condition number and dexterity cost."
        " Beyond what is mapped as allowed, along the whole path, cdpr check also requires a"
        f" capacity margin of {inertia:.3g} N for acceleration, and cdpr plan keeps"
        f" {CLEARANCE_RESERVE * 1e3:g} mm and a capacity margin of {reserve:.3g} N."
    )


def _chapter(folder: Path, maps: Maps) -> Chapter:
    name = maps.grid.name
    tables = [f"{name}.npz"]
    packed = io.BytesIO()
    np.savez_compressed(packed, allow_pickle=False, **arrays_of(maps))
    write_bytes_atomic(folder / tables[0], packed.getvalue())
    if maps.grid.normal is not None:
        tables.append(f"{name}.csv")
        write_atomic(folder / tables[1], csv_of(maps))
    title, text, figures = _content(maps)
    write_figures(folder, figures)
    alternative = f"{title}: colour maps; the numbers are in the table below and in the files"
    scene = space_scene(maps) if name == "frame" else None
    shown = tuple((f"{file}.png", alternative) for file in figures)
    return Chapter(title, text, shown, tuple(tables), summary_of(maps), scene, SPACE_LAYERS)


def _content(maps: Maps) -> tuple[str, str, dict[str, Draw]]:
    """Heading, sentence and images of a grid."""
    name = maps.grid.name
    if maps.grid.normal is not None:
        figures: dict[str, Draw] = {
            name: partial(slice_figure, maps),
            f"{name}_costs": partial(cost_figure, maps),
        }
        text = (
            "Red lines: where a limit is reached. Colours leave out the most extreme 1 %"
            " at each end. The two surfaces are the paper's Fig. 7."
        )
        return f"Slice {title_of(maps.grid)}", text, figures
    if name == "frame":
        text = (
            "The paper's Fig. 6: where the cables can balance any wrench, and where the tension"
            " limits suffice; the boxes are the frame of the outlets and, in it, the workspace."
        )
        return "The whole frame", text, {name: partial(space_figure, maps)}
    chosen = [quantity for quantity in shown_in(maps) if quantity.name in _LEVELS_OF]
    levels: dict[str, Draw] = {
        f"{name}_{quantity.name}": partial(level_figure, maps, quantity) for quantity in chosen
    }
    return "The workspace, level by level", "Red lines: where a limit is reached.", levels
