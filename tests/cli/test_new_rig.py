"""`cdpr new` writes a rig file that the other verbs accept, or nothing, with a reason."""

from __future__ import annotations

import math
import re
from dataclasses import fields
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cdpr.cli.start import RigOptions
from drivers.cia402.profile import profile_names
from model.files.examples import rig_text
from model.files.new_rig import (
    AFTER_COORDINATES,
    BEFORE_COORDINATES,
    CSV_COLUMNS,
    collect_answers,
)
from model.files.rig_file import Cia402Document, RigDocument
from model.files.validation import parse_yaml
from model.rig import load_rig
from tests.cli.plans import CONFIGS
from tests.cli.program import call, nothing_written, one_message

PAPER = load_rig(CONFIGS / "gachon_8_6.yaml")


def cables_csv(folder: Path, rows: int = 8) -> Path:
    """Outlets and anchors of the paper's rig."""
    document = PAPER.document
    ends = zip(document.outlets_mm[:rows], document.anchors_mm[:rows], strict=True)
    lines = [",".join(CSV_COLUMNS), *(",".join(map(str, [*o, *a])) for o, a in ends)]
    path = folder / "cables.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_every_question_can_be_answered_by_an_option() -> None:
    """All but the name, which is that of the file, and what the file of cables states."""
    keys = [question.key for question in (*BEFORE_COORDINATES, *AFTER_COORDINATES)]
    assert [one.name for one in fields(RigOptions)] == [
        key for key in keys if key not in ("name", "cables")
    ]


def test_enter_for_every_question_makes_a_rig_that_can_be_planned_and_looked_at(
    tmp_path: Path,
) -> None:
    rig = tmp_path / "my rig.yaml"
    answer = call("new", rig, answers="\n" * 50)
    assert answer.code == 0, answer
    assert "next: review it, then cdpr doctor" in answer.out
    assert load_rig(rig).cable_count == 8
    assert load_rig(rig).name == "my rig"
    assert call("doctor", rig).code == 0
    scene = CONFIGS / "environment_1.yaml"
    planned = call("plan", rig, scene, "-o", tmp_path / "plan.json")
    assert planned.code == 0, planned


def test_a_new_file_shows_how_the_make_of_the_drives_is_named() -> None:
    """A laboratory with EPOS4 got a file for drives that need no profile, without a word of it."""
    text = rig_text(collect_answers("rig", {}))
    _, _, after = text.partition("# drives:\n")
    lines = after.split("\n\n")[0].replace("#", " ", 1).replace("\n#", "\n ")
    drives = parse_yaml(f"drives:\n{lines}\n").data["drives"]
    document = RigDocument.model_validate({**parse_yaml(text).data, "drives": drives})
    assert document.drives == Cia402Document(type="cia402", profile="epos4")
    assert all(name in lines for name in profile_names())
    pages = set(re.findall(r"/.*?\.md", text))
    assert {Path(page).name for page in pages} == {"drives.md", "odrive.md", "rig-file.md"}
    assert all(Path(page).is_absolute() and Path(page).is_file() for page in pages)


def test_each_question_shows_its_default_and_its_unit(tmp_path: Path) -> None:
    answer = call("new", tmp_path / "rig.yaml", answers="\n" * 50)
    question = "platform size X Y Z, a box about the origin of its frame [130 130 130] mm: "
    assert question in answer.err
    assert "mass of the platform [0.4] kg: " in answer.err
    assert "largest tension of a cable [100] N: " in answer.err


@pytest.mark.parametrize(
    ("question", "bad", "reason"),
    [
        (1, "130 130", "three numbers X Y Z are needed, 2 were given"),
        (1, "130 130 -1", "greater than 0"),
        (2, "heavy", "'heavy' is not a number"),
        (2, "nan", "finite number"),
        (3, "5", "not a whole number from 6 to 24"),
        (21, "0 0 500", "would be outside"),
        (26, "4", "more than the smallest tension, 5 N"),
        (30, "sometimes", "not one of absolute, incremental"),
    ],
)
def test_a_bad_answer_is_asked_again_with_the_reason(
    tmp_path: Path, question: int, bad: str, reason: str
) -> None:
    rig = tmp_path / "rig.yaml"
    answer = call("new", rig, answers="\n" * question + f"{bad}\n" + "\n" * 50)
    assert answer.code == 0, answer
    assert answer.err.count("; try again") == 1
    assert reason in answer.err
    load_rig(rig)


def typed(points) -> list[str]:
    """Points as typed, a line each."""
    return [" ".join(map(str, point)) for point in points]


@pytest.mark.parametrize("scale", [1e-3, 0.0])
def test_outlets_in_metres_or_at_one_point_are_asked_for_again_with_the_last_as_defaults(
    tmp_path: Path, scale: float
) -> None:
    """They were refused after the last question, and all answers were lost."""
    outlets, anchors = PAPER.document.outlets_mm, PAPER.document.anchors_mm
    wrong = typed([[scale * x for x in point] for point in outlets])
    begin, anchors_too = ["", "", "", "8", *wrong], [] if scale else [*typed(anchors)]
    lines = [*begin, *anchors_too, "", *typed(outlets), *typed(anchors)]
    answer = call("new", tmp_path / "rig.yaml", answers="\n".join(lines) + "\n" * 50)
    assert answer.code == 0, answer
    assert answer.err.count("; try again") == 1
    assert ("write lengths in mm, not in m" if scale else "are at one point") in answer.err
    assert "outlet of cable 1, X Y Z in the world frame [-0" in answer.err
    document = load_rig(tmp_path / "rig.yaml").document
    assert document.outlets_mm == outlets
    assert document.anchors_mm == anchors


def test_a_platform_too_thin_or_a_cable_entered_twice_can_be_corrected_alone(
    tmp_path: Path,
) -> None:
    outlets = [list(point) for point in PAPER.document.outlets_mm]
    anchors = [list(point) for point in PAPER.document.anchors_mm]
    twice = [*typed(outlets[:7]), typed(outlets)[0], *typed(anchors[:7]), typed(anchors)[0]]
    again = ["130 130 130", *[""] * 7, typed(outlets)[7], *[""] * 7, typed(anchors)[7]]
    lines = ["", "", "8", *twice, *again]
    options = ("--platform-mm", "0.13", "0.13", "0.13")
    answer = call("new", tmp_path / "rig.yaml", *options, answers="\n".join(lines) + "\n" * 50)
    assert answer.code == 0, answer
    assert "cable 8 has the outlet and anchor of cable 1; an edge of 0.13 mm" in answer.err
    document = load_rig(tmp_path / "rig.yaml").document
    assert document.platform.size_mm == [130.0, 130.0, 130.0]
    assert document.outlets_mm == outlets
    assert document.anchors_mm == anchors


def suggested(outlets) -> list[list[float]]:
    """Anchors for outlets, [mm]; those of a table would not be asked for."""
    given = {"cables": len(outlets), "outlets_mm": outlets}
    anchors: list[list[float]] = collect_answers("rig", given)["anchors_mm"]
    return anchors


@given(shift=st.tuples(*[st.integers(-5000, 5000)] * 3))
def test_suggested_anchors_do_not_depend_on_the_origin_of_the_world_frame(shift) -> None:
    """A frame whose corner is the origin got all its anchors at one corner of the platform."""
    outlets = PAPER.document.outlets_mm
    moved = [[x + d for x, d in zip(point, shift, strict=True)] for point in outlets]
    assert suggested(moved) == suggested(outlets) == PAPER.document.anchors_mm


def test_level_outlets_all_get_anchors_at_the_lower_edges() -> None:
    """Heights of 2000 mm measured to 1 mm were split at random."""
    outlets = [[x, y, 2000.0 + dz] for x in (0, 900) for y in (0, 800) for dz in (-1.0, 1.0)]
    assert {anchor[2] for anchor in suggested(outlets)} == {-65.0}


def test_answers_are_in_the_file(tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    answer = call("new", rig, answers="beam\n200 100, 50\n1.5\n" + "\n" * 50)
    assert answer.code == 0, answer
    document = load_rig(rig).document
    assert document.name == "beam"
    assert document.platform.size_mm == [200.0, 100.0, 50.0]
    assert document.platform.mass_kg == 1.5


def test_the_end_of_the_answers_writes_nothing(tmp_path: Path) -> None:
    with nothing_written(tmp_path):
        answer = call("new", tmp_path / "rig.yaml", answers="\n\n\n8\n1 2")
    one_message(answer, 2, "no answer to the question about 'outlet of cable 1", "--from")


def test_coordinates_from_a_table_ask_nothing(tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    options = ("--mass-kg", "0.7", "--platform-mm", "130", "130", "130", "--drum-radius-mm", "50")
    answer = call("new", rig, "--from", cables_csv(tmp_path), *options)
    assert answer.code == 0, answer
    assert answer.err == ""
    document = load_rig(rig).document
    assert document.outlets_mm == PAPER.document.outlets_mm
    assert document.anchors_mm == PAPER.document.anchors_mm
    assert document.platform.mass_kg == 0.7
    assert document.winches[7].drum_mm_per_rev == pytest.approx(2.0 * math.pi * (50.0 + 0.5))


@pytest.mark.parametrize(("drum", "cable"), [(32.3, 0.5), (50.0, 0.0), (8.0, 1.5)])
def test_a_drum_turn_moves_the_circumference_of_the_cables_centre_line(
    drum: float, cable: float
) -> None:
    """A cable wound on a bare drum has its centre line one cable radius farther out."""
    answers = collect_answers("rig", {"drum_radius_mm": drum, "radius_mm": cable})
    tree = parse_yaml(rig_text(answers)).data
    outer, inner = 2.0 * math.pi * (drum + 2.0 * cable), 2.0 * math.pi * drum
    for winch in tree["winches"]:
        assert winch["drum_mm_per_rev"] == pytest.approx((outer + inner) / 2.0, rel=1e-9)


def test_the_question_about_drums_says_which_radius(tmp_path: Path) -> None:
    answer = call("new", tmp_path / "rig.yaml", answers="\n" * 50)
    assert "radius of the bare drums" in answer.err
    assert "the cable's radius is added [32.3] mm: " in answer.err
    assert "32.3 mm of the bare drum and 0.5 mm of the cable" in (tmp_path / "rig.yaml").read_text()


def test_a_suspended_robot_gets_a_home_below_its_outlets(tmp_path: Path) -> None:
    """RoboCrane: pairs of cables from three points to three corners of the platform."""

    def corner(radius: float, angle: float, height: float) -> list[float]:
        return [radius * math.cos(angle), radius * math.sin(angle), height]

    ends = [(0, 0), (0, 1), (1, 1), (1, 2), (2, 2), (2, 0)]
    rows = [
        [*corner(3000.0, math.radians(120 * a + 90), 5000.0),
         *corner(600.0, math.radians(120 * b + 30), 0.0)]
        for a, b in ends
    ]  # fmt: skip
    table = tmp_path / "cables.csv"
    lines = [",".join(CSV_COLUMNS), *(",".join(map(str, row)) for row in rows)]
    table.write_text("\n".join(lines) + "\n")
    limits = ("--mass-kg", "200", "--max-tension-n", "5000")
    made = call("new", tmp_path / "rig.yaml", "--from", table, *limits)
    assert made.code == 0, made
    rig = load_rig(tmp_path / "rig.yaml")
    assert 0.0 < rig.home.position[2] < 4.0
    assert rig.workspace_lower[2] < rig.home.position[2] - 0.3
    assert rig.at(rig.home).is_wrench_feasible


@pytest.mark.parametrize(
    ("mass", "parts"),
    [
        ("0.4", ("cannot pull less than t_min", "lower the smallest tensions, add weight")),
        ("80", ("cannot pull harder than t_max", "lower the load, raise the largest tensions")),
        ("5", ()),
    ],
)
def test_a_ceiling_robot_that_cannot_hold_its_platform_at_home_gets_a_remark(
    tmp_path: Path, mass: str, parts: tuple[str, ...]
) -> None:
    rows = []
    for x, y in product((1, -1), repeat=2):
        rows.append([1000 * x, 900 * y, 2000, 65 * x, 65 * y, -65])
        rows.append([900 * x, 1000 * y, 2000, 65 * x, 65 * y, 65])
    table = tmp_path / "cables.csv"
    lines = [",".join(CSV_COLUMNS), *(",".join(map(str, row)) for row in rows)]
    table.write_text("\n".join(lines) + "\n")
    answer = call("new", tmp_path / "rig.yaml", "--from", table, "--mass-kg", mass)
    assert answer.code == 0, answer
    assert ("remark platform.home: no tensions" in answer.err) == bool(parts)
    assert all(part in answer.err for part in parts)


def test_a_table_or_an_option_that_cannot_be_is_refused(tmp_path: Path) -> None:
    table = cables_csv(tmp_path)
    with nothing_written(tmp_path):
        low = call("new", tmp_path / "rig.yaml", "--from", table, "--max-tension-n", "3")
    one_message(low, 2, "--max-tension-n", "more than the smallest tension, 5 N")
    table.write_text(table.read_text().replace("864.7443", "high"))
    high = call("new", tmp_path / "rig.yaml", "--from", table)
    one_message(high, 2, str(table), "line 2", "'high' is not a finite number")
    table.write_text(table.read_text().replace("\n", ",1\n", 1))
    one_message(call("new", tmp_path / "rig.yaml", "--from", table), 2, "line 2 has 6 values")
    table.write_text("outlet_x_mm\n1\n")
    missing = call("new", tmp_path / "rig.yaml", "--from", table)
    one_message(missing, 2, "columns 'outlet_y_mm', 'outlet_z_mm'", "which has: outlet_x_mm")
    few = call("new", tmp_path / "rig.yaml", "--from", cables_csv(tmp_path, 5))
    one_message(few, 2, "5 cables", "from 6 to 24", "one line per cable, 6 or more")
    assert "begin with the line" not in few.err
    lines = cables_csv(tmp_path).read_text().splitlines()
    table.write_text("\n".join([*lines[:4], ",,,,,", *lines[5:]]))
    gap = call("new", tmp_path / "rig.yaml", "--from", table)
    one_message(gap, 2, "line 6 follows an empty line")  # not cable 5 taken for cable 4


def test_a_table_in_metres_or_with_a_cable_twice_is_refused(tmp_path: Path) -> None:
    table = cables_csv(tmp_path)
    head, *rows = table.read_text().splitlines()
    metres = [",".join(str(float(cell) / 1e3) for cell in row.split(",")) for row in rows]
    for lines, part in (
        (metres, "outlets_mm: the outlets span only 1.07504 mm: write lengths in mm, not in m"),
        ([*rows[:7], rows[0]], "anchors_mm[7]: cable 8 has the outlet and anchor of cable 1"),
    ):
        table.write_text("\n".join([head, *lines]) + "\n")
        with nothing_written(tmp_path):
            answer = call("new", tmp_path / "rig.yaml", "--from", table)
        one_message(answer, 2, part)


def test_anchors_in_the_world_frame_get_a_remark_from_new_and_doctor(tmp_path: Path) -> None:
    table = cables_csv(tmp_path)
    head, *rows = table.read_text().splitlines()
    lines = [row.rpartition(",")[0] + "," + str(float(row.split(",")[-1]) + 445.0) for row in rows]
    table.write_text("\n".join([head, *lines]) + "\n")
    rig = tmp_path / "rig.yaml"
    for answer in (call("new", rig, "--from", table), call("doctor", rig)):
        assert answer.code == 0, answer
        assert "remark anchors_mm: along z their middle is 445 mm from the platform's" in answer.err


def test_cables_that_touch_at_home_get_a_remark_from_new_and_doctor(tmp_path: Path) -> None:
    """Every jog there was refused for the start of a scene that was not given."""
    rows = [
        [500.25 * x, 500.5 * y, z, 62 * x, 62 * y, (470 - z) // 6]
        for y, x, z in product((1, -1), (-1, 1), (860, 80))
    ]
    table, rig = tmp_path / "cables.csv", tmp_path / "rig.yaml"
    lines = [",".join(CSV_COLUMNS), *(",".join(map(str, row)) for row in rows)]
    table.write_text("\n".join(lines) + "\n")
    for answer in (call("new", rig, "--from", table), call("doctor", rig)):
        assert answer.code == 0, answer
        assert answer.err.count("remark ") == 1, answer.err
        assert "remark platform.home: cable 1 touches cable 2; " in answer.err
    apart = tmp_path / "apart.yaml"
    assert call("new", apart, "--from", cables_csv(tmp_path)).err == ""
    assert "remark" not in call("doctor", apart).err


def test_a_file_that_exists_is_kept(tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text("mine")
    one_message(call("new", rig, answers="\n" * 50), 2, "exists already", "--force")
    assert rig.read_text() == "mine"
    assert call("new", rig, "--force", answers="\n" * 50).code == 0
    load_rig(rig)


@pytest.mark.parametrize("force", [(), ("--force",)])
@pytest.mark.parametrize("where", ["missing/rig.yaml", "a file/rig.yaml", "folder"])
def test_a_file_that_cannot_be_written_is_refused_before_the_first_question(
    tmp_path: Path, where: str, force: tuple[str, ...]
) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "a file").touch()
    with nothing_written(tmp_path):
        answer = call("new", tmp_path / where, *force, answers="\n" * 50)
    one_message(answer, 2, where)
    assert "platform size" not in answer.err


@pytest.mark.parametrize("force", [(), ("--force",)])
def test_the_table_of_cables_is_never_replaced_by_the_rig(
    tmp_path: Path, force: tuple[str, ...]
) -> None:
    table = cables_csv(tmp_path)
    (tmp_path / "link.yaml").symlink_to(table)
    for rig in (table, tmp_path / "link.yaml"):
        with nothing_written(tmp_path):
            answer = call("new", rig, "--from", table, *force)
        one_message(answer, 2, "would overwrite an input")


def test_the_platform_is_the_box_of_the_anchors_where_only_they_are_known(tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    big = [[10.0 * x for x in point] for point in PAPER.document.anchors_mm]
    ends = zip(PAPER.document.outlets_mm, big, strict=True)
    lines = [",".join(map(str, [*(10.0 * x for x in outlet), *anchor])) for outlet, anchor in ends]
    (tmp_path / "cables.csv").write_text("\n".join([",".join(CSV_COLUMNS), *lines]) + "\n")
    answer = call("new", rig, "--from", tmp_path / "cables.csv")
    assert answer.code == 0, answer
    half = 0.5 * np.array(load_rig(rig).document.platform.size_mm)
    assert (half >= np.abs(big).max(axis=0)).all()
    assert (half <= np.maximum(np.abs(big).max(axis=0), 0.1 * np.abs(big).max()) + 0.1).all()
    assert "is assumed" not in answer.said


def table_of_anchors(folder: Path, anchors: list[list[float]]) -> Path:
    """The paper's outlets, with other anchors, [mm]."""
    ends = zip(PAPER.document.outlets_mm, anchors, strict=True)
    lines = [",".join(map(str, [*outlet, *anchor])) for outlet, anchor in ends]
    (folder / "cables.csv").write_text("\n".join([",".join(CSV_COLUMNS), *lines]) + "\n")
    return folder / "cables.csv"


@pytest.mark.parametrize("size", [(), ("--platform-mm", "130", "130", "60")])
def test_a_platform_edge_that_the_anchors_do_not_show_is_named(
    tmp_path: Path, size: tuple[str, ...]
) -> None:
    flat = [[x, y, 0.0] for x, y, _ in PAPER.document.anchors_mm]
    rig = tmp_path / "rig.yaml"
    answer = call("new", rig, "--from", table_of_anchors(tmp_path, flat), *size)
    assert answer.code == 0, answer
    edges = load_rig(rig).document.platform.size_mm
    remark = f"platform.size_mm: {edges[2]:g} mm along z is assumed, as the anchors span 0 mm there"
    assert (remark in answer.said) is (not size)
    assert answer.said.count("is assumed") == (not size)


def test_anchors_at_one_point_are_named_where_the_platform_has_no_given_size(
    tmp_path: Path,
) -> None:
    table = table_of_anchors(tmp_path, [[0.0, 0.0, 0.0]] * 8)
    with nothing_written(tmp_path):
        answer = call("new", tmp_path / "rig.yaml", "--from", table)
    one_message(answer, 2, "anchors_mm: all 8 anchors are")
    assert "platform.size_mm" not in answer.said
