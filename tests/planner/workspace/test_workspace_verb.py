"""`cdpr workspace`: the files it leaves, and what it refuses before any work."""

from __future__ import annotations

import csv
import json
import re
import resource
from collections.abc import Callable, Mapping
from functools import partial
from importlib.metadata import version
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from typer.testing import CliRunner

from cdpr.cli.app import build_app
from model.errors import BadInput
from model.rig import load_rig
from model.scene import legs_of, load_scene
from model.statics.gravity import inertial_wrench
from planner.costs import margin_reserve
from planner.workspace.compute import Maps, map_workspace, workspace_grids
from planner.workspace.figures import cost_figure, space_scene, write_figures
from planner.workspace.files import write_maps
from planner.workspace.grid import frame_box, parsed_slice, volume
from planner.workspace.maps import Question

CONFIGS = Path(__file__).parents[3] / "configs"
RIG, SCENE = str(CONFIGS / "gachon_8_6.yaml"), str(CONFIGS / "environment_1.yaml")


def run(*arguments: str):
    return CliRunner().invoke(build_app(), ["workspace", *arguments])


Drawn = Mapping[str, Callable[[], Figure]]


def write_one_figure(folder: Path, drawn: Drawn, saved: str = "", drawing: bool = False) -> None:
    """Saves one figure; the files of the others are empty, where only names count.

    Args:
        folder: An existing folder.
        drawn: Functions that draw figures, by name.
        saved: Name of the figure.
        drawing: Whether the others are drawn too; it takes less long than saving.
    """
    for name, draw in drawn.items():
        if name == saved:
            write_figures(folder, {name: draw})
            continue
        if drawing:
            draw()
        for kind in ("png", "svg"):
            (folder / f"{name}.{kind}").touch()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    where = tmp_path_factory.mktemp("maps") / "slices"
    slices = ("--slice", "z=445", "--slice", "x=-50", "--step-mm", "50")
    with pytest.MonkeyPatch.context() as patch:
        write = partial(write_one_figure, saved="slice_x_minus_50_costs", drawing=True)
        patch.setattr("planner.workspace.files.write_figures", write)
        result = run(RIG, "-o", str(where), *slices, "--json")
    assert result.exit_code == 0, result.output
    (where / "printed.json").write_text(result.stdout)
    return where


def test_a_slice_leaves_pictures_tables_and_a_page(folder, whole):
    assert all(content for content in whole.values())
    made = {p.name for p in folder.iterdir()}
    assert {name for name in whole if "z_445" in name} <= made
    for name in ("slice_z_445", "slice_x_minus_50"):
        assert {f"{name}{e}" for e in (".png", ".svg", ".csv", ".npz", "_costs.png")} <= made
    assert {"index.html", "summary.json"} <= made


def test_the_page_shows_files_that_are_there_and_requests_nothing_from_the_network(folder):
    page = (folder / "index.html").read_text()
    named = re.findall(r'(?:src|href)="([^"]+)"', page)
    assert len(named) == 12
    assert all((folder / name).is_file() for name in named)
    assert "://" not in page


def test_the_whole_frame_can_be_turned_on_the_page(tmp_path):
    """Its regions are in the scene, within the frame; without scripts the picture is there."""
    rig, scene = load_rig(Path(RIG)), load_scene(Path(SCENE))
    question, (lower, upper) = Question.about(rig, scene), frame_box(rig)
    made = map_workspace(question, [volume("frame", lower, upper, 0.25)], workers=1)
    drawn = {one.layer: one.vertices for one in space_scene(made[0]).surfaces}
    assert {"closed", "feasible", "free", "frame", "obstacles"} == set(drawn)
    for layer in ("closed", "feasible", "free"):
        assert np.all(lower - 1e-3 <= drawn[layer])
        assert np.all(drawn[layer] <= upper + 1e-3)
    write_maps(tmp_path, made, question, scene)
    page = (tmp_path / "index.html").read_text()
    assert page.count('id="scene-canvas"') == page.count('id="scene-data"') == 1
    assert '<div class="still"><div class="scroll drawn"' in page


@pytest.fixture(scope="module")
def slice_maps() -> tuple[list[Maps], Question]:
    rig = load_rig(Path(RIG))
    question = Question.about(rig, None)
    grids = workspace_grids(rig, [parsed_slice("z=445")], step=0.05)
    return map_workspace(question, grids, workers=1), question


def written(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture(scope="module")
def whole(slice_maps, tmp_path_factory) -> dict[str, bytes]:
    """All files of a slice."""
    write_maps(folder := tmp_path_factory.mktemp("whole"), *slice_maps)
    return written(folder)


def test_images_are_the_same_whatever_the_user_s_matplotlibrc_is(slice_maps, whole, tmp_path):
    own, name = {"text.usetex": True, "axes.facecolor": "red"}, "slice_z_445_costs"
    with mpl.rc_context(own):
        write_figures(tmp_path, {name: partial(cost_figure, slice_maps[0][0])})
        assert all(mpl.rcParams[key] == value for key, value in own.items())
    images = written(tmp_path)
    assert set(images) == {f"{name}.png", f"{name}.svg"}
    assert images.items() < whole.items()


@pytest.mark.parametrize("limit", [1000, 12_000, 40_000])
def test_a_full_disk_leaves_whole_files_only(slice_maps, whole, tmp_path, limit):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        with pytest.raises(BadInput, match="cannot be written"):
            write_maps(tmp_path, *slice_maps)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert written(tmp_path).items() < whole.items()


def test_table_and_arrays_hold_the_same_numbers(folder):
    arrays = np.load(folder / "slice_z_445.npz")
    with (folder / "slice_z_445.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 11 * 11
    for name in ("condition_number", "capacity_margin_n", "self_clearance_mm"):
        column = np.array([float(row[name]) for row in rows])
        assert column == pytest.approx(arrays[name].ravel(), rel=1e-8)
    assert {row["z_mm"] for row in rows} == {"445"}
    assert {row["allowed"] for row in rows} == {"1"}


def test_the_summary_is_what_is_printed(folder):
    printed = json.loads((folder / "printed.json").read_text())
    assert printed["maps"] == json.loads((folder / "summary.json").read_text())
    assert printed["maps"]["slice_z_445"]["share"]["closed"] == 1.0


def test_summary_and_page_name_what_was_mapped(tmp_path, monkeypatch):
    monkeypatch.setattr("planner.workspace.files.write_figures", write_one_figure)
    rig, scene = load_rig(Path(RIG)), load_scene(Path(SCENE))
    tilted = ("--rotation-wxyz", "0.9961946980917455", "0.08715574274765817", "0", "0")
    where = tmp_path / "maps"
    options = ("--slice", "z=445", "--step-mm", "100", *tilted)
    assert run(RIG, "--scene", SCENE, "-o", str(where), *options).exit_code == 0
    about = json.loads((where / "summary.json").read_text())["about"]
    assert about["rig"] == {"name": rig.name, "plan_hash": rig.plan_hash}
    assert about["scene"] == {"name": scene.name, "hash": scene.hash}
    assert about["rotation_wxyz"] == pytest.approx([float(x) for x in tilted[1:]], abs=1e-12)
    assert about["characteristic_length_mm"] == pytest.approx(
        Question.about(rig).length * 1e3, abs=1e-9
    )
    assert about["version"] == version("cdpr")
    page = (where / "index.html").read_text()
    for text in (rig.plan_hash, scene.hash, "0.996195 0.0871557 0 0", version("cdpr")):
        assert text in page


def test_the_page_states_the_margins_that_check_and_plan_also_require(tmp_path, slice_maps):
    """With the heaviest payload that the scene carries."""
    rig, scene = slice_maps[1].rig, load_scene(CONFIGS / "pick_and_place.yaml")
    loads = [leg.scene.load for leg in legs_of(scene)]
    checked = max(inertial_wrench(rig, load, turns=False) for load in loads)
    planned = max(margin_reserve(rig, load, turns=False) for load in loads)
    assert planned > margin_reserve(rig, scene.load, turns=False)
    write_maps(tmp_path, [], Question.about(rig, scene), scene)
    page = (tmp_path / "index.html").read_text()
    assert f"cdpr check also requires a capacity margin of {checked:.3g} N" in page
    assert f"cdpr plan keeps 0.05 mm and a capacity margin of {planned:.3g} N" in page


def test_maps_without_a_scene_name_none(folder):
    assert json.loads((folder / "summary.json").read_text())["about"]["scene"] is None
    assert "no scene" in (folder / "index.html").read_text()


def test_a_folder_that_holds_something_is_left_alone(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    result = run(RIG, "-o", str(tmp_path), "--slice", "z=445")
    assert isinstance(result.exception, BadInput)
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


def test_maps_replace_all_of_a_former_run_and_nothing_else(
    tmp_path, slice_maps, whole, monkeypatch
):
    """Also where that run ended before its summary; files without a map's arrays are others'."""
    question = slice_maps[1]
    rig, planes = question.rig, [parsed_slice("x=-50"), parsed_slice("z=400.5")]
    former = workspace_grids(rig, planes, step=0.2)
    former.append(volume("frame", *frame_box(rig), 0.25))
    former.append(volume("workspace", rig.workspace_lower, rig.workspace_upper, 0.2))
    write = partial(write_one_figure, saved="workspace_self_clearance")
    monkeypatch.setattr("planner.workspace.files.write_figures", write)
    write_maps(tmp_path, map_workspace(question, former, workers=1), question)
    (tmp_path / "summary.json").unlink()
    made = {"slice_x_minus_50_costs.png", "slice_z_400.5.csv", "workspace.npz", "frame.svg"}
    assert made | {"workspace_self_clearance.png"} <= set(written(tmp_path))
    own = ["slice_z_notes.npz", "slice_z_445.txt", "workspace.png", "frame.csv", "slice_y_1.csv"]
    for name in own:
        (tmp_path / name).write_text("mine")
    write_maps(tmp_path, *slice_maps)
    left = written(tmp_path)
    drawn = {name for name in whole if name.endswith((".png", ".svg"))}
    assert drawn < left.keys()
    tables = {name: content for name, content in left.items() if name not in drawn}
    expected = {name: content for name, content in whole.items() if name not in drawn}
    assert tables == {**expected, **dict.fromkeys(own, b"mine")}


@pytest.mark.parametrize(
    "wrong",
    [
        ["--slice", "z=9000"],
        ["--slice", "up"],
        ["--step-mm", "-3"],
        ["--rotation-wxyz", "0", "0", "0", "0"],
        ["--characteristic-length-mm", "0"],
        ["--lower-mm", "0", "0", "900"],
    ],
)
def test_wrong_arguments_are_bad_input_and_create_no_folder(tmp_path, wrong):
    where = tmp_path / "maps"
    result = run(RIG, "-o", str(where), *wrong)
    assert isinstance(result.exception, BadInput)
    assert not where.exists()
