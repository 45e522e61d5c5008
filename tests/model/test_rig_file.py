"""Rig files: all mistakes are reported at once, each with its position and a plain sentence."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from model.errors import BadInput, CdprError, InvalidFile
from model.files.rig_file import RigDocument
from model.files.validation import key_path
from model.rig import load_rig, rig_from_document
from tests.model.rig_builds import CONFIGS, hall_data, paper_data, rig_of

PAPER = (CONFIGS / "gachon_8_6.yaml").read_text(encoding="utf-8")
HALL = (CONFIGS / "hall_10_6.yaml").read_text(encoding="utf-8")
JARGON = re.compile(r"(?i)input should|valid (dictionary|list|string)|value error|type=|pydantic")


def problems_in(text: str, tmp_path: Path) -> list[tuple[int, int, str, str]]:
    """Line, column, key and sentence of every problem."""
    path = tmp_path / "rig.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InvalidFile) as caught:
        load_rig(path)
    error = caught.value
    assert error.exit_code == 2
    assert not JARGON.search(str(error)), str(error)
    for problem in error.problems:
        assert f"{path}:{problem.line}:{problem.column}:" in str(error)
    return [(p.line, p.column, p.key, p.what) for p in error.problems]


def line_of(text: str, part: str) -> int:
    return text[: text.index(part)].count("\n") + 1


MISTAKES = {
    entry["mistake"]: entry
    for entry in yaml.safe_load((Path(__file__).parent / "rig_mistakes.yaml").read_text())
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_reported_by_key_and_sentence(mistake: str, tmp_path: Path) -> None:
    entry = MISTAKES[mistake]
    assert entry["old"] in PAPER
    text = PAPER.replace(entry["old"], entry["new"], 1)
    # A section that is renamed away for the example is itself an unknown key.
    found = [problem for problem in problems_in(text, tmp_path) if problem[2] != "x"]
    assert [problem[2] for problem in found] == [entry["key"]], found
    assert entry["sentence"] in found[0][3]
    assert 1 <= found[0][0] <= text.count("\n") + 1


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("  - {node_id: 8,", "  - {node_id: -8,", "node_id: -8"),
        ("mass_kg: 0.4", "mass_kg: zero", "mass_kg: zero"),
        ("fx_px: 900", "fx_px: -1", "fx_px: -1"),
    ],
)
def test_line_and_column_are_those_of_the_key(old: str, new: str, key: str, tmp_path: Path) -> None:
    text = PAPER.replace(old, new, 1)
    line = line_of(text, key)
    column = text.splitlines()[line - 1].index(key) + 1
    assert [(p[0], p[1]) for p in problems_in(text, tmp_path)] == [(line, column)]


def test_every_problem_of_a_file_is_reported_at_once_in_the_order_of_the_file(
    tmp_path: Path,
) -> None:
    """Also those between parts, as far as the parts that they compare are valid."""
    text = PAPER
    for old, new in (
        ("size_mm: [130, 130, 130]", "size_mm: [130, 130]"),
        ("mass_kg: 0.4", "mass_kg: -3"),
        ("[0, 0, 445]", "[0, 900, 445]"),
        ("  - [65, -65, 65]\n", ""),
        ("stiffness_n", "stifness_n"),
        ("min_tension_n: 5", "min_tension_n: 500"),
        ("counts_per_rev: 131072", "counts_per_rev: 1.5"),
        ("node_id: 2,", "node_id: 1,"),
        ("bitrate: 1000000", "bitrate: fast"),
        ("family: tag36h11", "family: tag36"),
        ("id: 302", "id: 301"),
        ("name: front", ""),
    ):
        assert old in text
        text = text.replace(old, new, 1)
    found = problems_in(text, tmp_path)
    assert [key for _, _, key, _ in found] == [
        "platform.size_mm",
        "platform.mass_kg",
        "platform.home.position_mm",
        "anchors_mm",
        "cables.stiffness_n",
        "cables.stifness_n",
        "cables.max_tension_n",
        "winches[0].counts_per_rev",
        "winches[1].node_id",
        "bus.bitrate",
        "tags.family",
        "tags.platform[1].id",
        "cameras[0].name",
    ]
    assert [problem[:2] for problem in found] == sorted(problem[:2] for problem in found)


@pytest.mark.parametrize("encoder", ["encoder: incremental, ", ""])
def test_odrives_need_absolute_encoders(encoder: str, tmp_path: Path) -> None:
    """Homing succeeded, and every motion asked to home again."""
    text = (CONFIGS / "gachon_8_6_odrive.yaml").read_text(encoding="utf-8")
    lines = text.replace("encoder: absolute, ", encoder, 2).replace("node_id: 8", "node_id: 63")
    assert [problem[2:] for problem in problems_in(lines, tmp_path)] == [
        *(
            (
                f"winches[{drive}].encoder",
                "an ODrive shows no loss of power: its encoder must be absolute over the travel",
            )
            for drive in (0, 1)
        ),
        ("winches[7].node_id", "an ODrive of a rig has a node id from 1 to 62"),
    ]


def test_an_invalid_part_is_not_compared_with_others(tmp_path: Path) -> None:
    """One mistake is one message: no home "outside" a workspace that is not a number."""
    text = PAPER.replace("upper_mm: [250, 250, 650]", "upper_mm: [250, x, 100]")
    text = text.replace("node_id: 1,", "node_id: x,").replace("node_id: 2,", "node_id: x,")
    found = problems_in(text, tmp_path)
    assert [p[2] for p in found] == [
        "workspace.upper_mm[1]",
        "winches[0].node_id",
        "winches[1].node_id",
    ]


@pytest.mark.parametrize(
    ("change", "key", "sentence"),
    [
        (("    - [0, 0, -1]\n", ""), "feed_directions", "9 feed directions for 10 outlets"),
        (("- [0, 0, -1]\n", "- [0, 0, 2]\n"), "feed_directions[6]", "its length is 2"),
        (("  radius_mm: 40", "  radius_mm: 0"), "radius_mm", "must be more than 0 (it is 0)"),
    ],
)
def test_pulleys_are_checked(
    change: tuple[str, str], key: str, sentence: str, tmp_path: Path
) -> None:
    assert change[0] in HALL
    [(_, _, found, what)] = problems_in(HALL.replace(*change, 1), tmp_path)
    assert found == f"pulleys.{key}"
    assert sentence in what


def test_two_cameras_of_one_name_are_reported(tmp_path: Path) -> None:
    start = PAPER.index("  - name: front")
    [(_, _, key, what)] = problems_in(PAPER + PAPER[start:], tmp_path)
    assert (key, what) == ("cameras[1].name", "camera name 'front' appears twice")


@pytest.mark.parametrize(
    ("line", "written"),
    [
        ("bitrate: 1000000", "bitrate: 1e6"),
        ("node_id: 8,", "node_id: 8.0,"),
        ("id: 301,", "id: 3.01e2,"),
    ],
)
def test_a_whole_number_may_have_a_point_or_an_exponent(
    line: str, written: str, tmp_path: Path
) -> None:
    text = PAPER if line in PAPER else PAPER.replace("bus:", f"bus:\n  {line}", 1)
    path = tmp_path / "rig.yaml"
    path.write_text(text)
    plain = load_rig(path)
    path.write_text(text.replace(line, written, 1))
    assert path.read_text() != text
    assert load_rig(path).hash == plain.hash


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("counts_per_rev: 1e17", "must be a whole number (it is 1e+17)"),
        ("counts_per_rev: 0.5", "must be a whole number (it is 0.5)"),
        ("counts_per_rev: .inf", "must be a whole number (it is inf)"),
    ],
)
def test_other_numbers_are_no_whole_ones(line: str, sentence: str, tmp_path: Path) -> None:
    whole = re.search(r"counts_per_rev: \d+", PAPER)
    assert whole is not None
    found = problems_in(PAPER.replace(whole[0], line, 1), tmp_path)
    assert {what for _, _, _, what in found} == {sentence}


def test_five_cables_are_too_few(tmp_path: Path) -> None:
    data = paper_data()
    for key in ("outlets_mm", "anchors_mm", "winches"):
        data[key] = data[key][:5]
    [(_, _, key, what)] = problems_in(yaml.safe_dump(data), tmp_path)
    assert key == "outlets_mm"
    assert "5 outlets" in what
    assert "6 or more" in what


@pytest.mark.parametrize(
    ("text", "line", "sentence"),
    [
        ("", 1, "the file is empty"),
        ("# only a remark\n", 1, "the file is empty"),
        ("just words", 1, "the file must hold keys and values"),
        ("- 1\n- 2\n", 1, "the file must hold keys and values"),
        ("a: 1\n\tb: 2\n", 2, "a tab"),
        ("a: [1, 2\nb: 3\n", 2, "not valid YAML"),
        ("a: 1\n b: 2\n", 2, "not valid YAML"),
        ("a: 'open\n", 2, "not valid YAML"),
        ("a: \x07\n", 1, "character #x0007"),
        ("a: 1\n--- \nb: 1\n", 2, "not valid YAML"),
        ("a: *nowhere\n", 1, "not valid YAML"),
        ("[" * 3000, 1, "nested too deeply"),
    ],
)
def test_text_that_is_not_a_rig_at_all_is_reported_with_its_line(
    text: str, line: int, sentence: str, tmp_path: Path
) -> None:
    [(found_line, _, _, what)] = problems_in(text, tmp_path)
    assert found_line == line
    assert sentence in what


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda path: None, "no such file"),
        (lambda path: path.mkdir(), "this is a folder"),
        (lambda path: path.write_bytes(b"a: 1\nb: \xff\n"), "byte 0xff in line 2"),
        (lambda path: path.write_bytes("a: 1".encode("utf-16")), "not UTF-8"),
    ],
)
def test_a_file_that_cannot_be_read_is_reported(
    make: Callable[[Path], object], words: str, tmp_path: Path
) -> None:
    path = tmp_path / "rig.yaml"
    make(path)
    with pytest.raises(BadInput, match=words) as caught:
        load_rig(path)
    assert caught.value.where == str(path)
    assert caught.value.next_step
    assert "Errno" not in str(caught.value)


def test_a_path_through_a_file_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match="cannot be read"):
        load_rig(tmp_path / "file" / "rig.yaml")


@pytest.mark.parametrize("name", ["gachon_8_6", "hall_10_6"])
@pytest.mark.parametrize("layout", ["\ufeff{}", "crlf"])
def test_byte_order_marks_and_windows_line_ends_do_no_harm(
    name: str, layout: str, tmp_path: Path
) -> None:
    text = (CONFIGS / f"{name}.yaml").read_text(encoding="utf-8")
    path = tmp_path / "rig.yaml"
    changed = text.replace("\n", "\r\n") if layout == "crlf" else "\ufeff" + text
    path.write_bytes(changed.encode())
    assert load_rig(path).hash == load_rig(CONFIGS / f"{name}.yaml").hash


def test_winches_may_share_their_values_by_alias(tmp_path: Path) -> None:
    data = paper_data()
    lines = [f"  - {{<<: *winch, node_id: {i}}}" for i in range(2, 9)]
    first = yaml.safe_dump(data["winches"][0], default_flow_style=True).strip()
    winches = "\n".join(["winches:", f"  - &winch {first}", *lines, "", ""])
    start, end = PAPER.index("winches:"), PAPER.index("motion:")
    path = tmp_path / "rig.yaml"
    path.write_text(PAPER[:start] + winches + PAPER[end:], encoding="utf-8")
    assert load_rig(path).hash == load_rig(CONFIGS / "gachon_8_6.yaml").hash
    path.write_text(path.read_text().replace("max_speed_mm_s: 100", "max_speed_mm_s: -1"))
    with pytest.raises(InvalidFile) as caught:
        load_rig(path)
    assert [p.key for p in caught.value.problems] == [
        f"winches[{i}].max_speed_mm_s" for i in range(8)
    ]


def test_the_rig_is_in_si_units_and_read_only() -> None:
    rig = load_rig(CONFIGS / "hall_10_6.yaml")
    data = hall_data()
    np.testing.assert_allclose(1000.0 * rig.outlets, data["outlets_mm"])
    np.testing.assert_allclose(1000.0 * rig.anchors, data["anchors_mm"])
    np.testing.assert_allclose(2000.0 * rig.half_size, data["platform"]["size_mm"])
    assert rig.pulley_radius == pytest.approx(0.04)
    assert rig.motion.speed == pytest.approx(0.1)
    assert rig.winches[1].counts_per_metre == pytest.approx(-4096 * 8 / 0.4)
    assert rig.winches[1].drum_to_outlet == pytest.approx(2.4)
    corners = {tuple(np.round(corner, 6)) for corner in rig.platform_corners}
    assert corners == {
        (x, y, z) for x in (-0.2, 0.2) for y in (-0.15, 0.15) for z in (-0.125, 0.125)
    }
    for array in (
        rig.outlets,
        rig.anchors,
        rig.half_size,
        rig.feed_directions,
        rig.platform_corners,
    ):
        assert not array.flags.writeable


def shuffled(value: Any, rng: np.random.Generator) -> Any:
    if isinstance(value, dict):
        keys = list(value)
        rng.shuffle(keys)
        return {key: shuffled(value[key], rng) for key in keys}
    return [shuffled(v, rng) for v in value] if isinstance(value, list) else value


def with_floats(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: with_floats(part) for key, part in value.items()}
    if isinstance(value, list):
        return [with_floats(part) for part in value]
    whole = {1, 301, 302, 303, 304, 305, 306, 401, 402, 403, 404}
    return float(value) if type(value) is int and value not in whole and value > 8 else value


def test_the_hash_is_of_the_content_not_of_its_layout() -> None:
    data = paper_data()
    rig = rig_of(data)
    assert rig_of(shuffled(data, np.random.default_rng(1))).hash == rig.hash
    spelt = paper_data()
    for section in ("platform", "workspace", "outlets_mm", "anchors_mm", "cables"):
        spelt[section] = with_floats(spelt[section])
    assert spelt != data or repr(spelt) != repr(data)
    assert rig_of(spelt).plan_hash == rig.plan_hash


def test_spelling_out_a_default_does_not_change_the_hash() -> None:
    data = paper_data()
    rig = rig_of(data)
    del data["platform"]["centre_of_mass_mm"]
    data["platform"]["home"]["rotation_wxyz"] = [1, 0, 0, 0]
    assert rig_of(data).hash == rig.hash


@pytest.mark.parametrize(
    ("section", "key", "value", "in_plan"),
    [
        ("platform", "mass_kg", 0.41, True),
        ("cables", "max_tension_n", 99, True),
        ("cables", "radius_mm", 0.5, True),
        ("workspace", "upper_mm", [250, 250, 651], True),
        ("bus", "channel", "can0", False),
        ("motion", "speed_mm_s", 21, False),
    ],
)
def test_a_plan_depends_on_geometry_and_limits_only(
    section: str, key: str, value: object, in_plan: bool
) -> None:
    """So that a plan may be run over another bus, and never on another robot."""
    rig, data = rig_of(paper_data()), paper_data()
    data[section][key] = value
    changed = rig_of(data)
    assert changed.hash != rig.hash
    assert (changed.plan_hash != rig.plan_hash) == in_plan


def test_a_document_whose_parts_disagree_is_refused() -> None:
    data = paper_data()
    data["anchors_mm"].pop()
    data["winches"][1]["node_id"] = 1
    with pytest.raises(BadInput, match=r"7 anchors for 8 outlets.*; .*node_id 1 appears twice"):
        rig_from_document(RigDocument.model_validate(data))


def leaves(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths of every value, sections and lists included."""
    parts: Any = ()
    if isinstance(value, dict):
        parts = value.items()
    elif isinstance(value, list):
        parts = enumerate(value)
    return [path] * bool(path) + [p for key, part in parts for p in leaves(part, (*path, key))]


ODD = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(10**30), 10**30),
    st.floats(),
    st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Cs")), max_size=8),
    st.just([]),
    st.just({}),
    st.lists(st.floats(), max_size=4),
    st.dictionaries(st.sampled_from(["name", "x", "position_mm"]), st.integers(), max_size=2),
)


@settings(max_examples=100)
@given(path=st.sampled_from(leaves(paper_data())), value=ODD)
def test_any_content_of_a_file_makes_a_rig_or_one_of_our_errors(
    path: tuple[Any, ...], value: Any, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """No exception of a library ever reaches the user."""
    changed = paper_data()
    inner = changed
    for part in path[:-1]:
        inner = inner[part]
    inner[path[-1]] = value
    file = tmp_path_factory.mktemp("odd") / "rig.yaml"
    text = yaml.dump(changed, Dumper=yaml.CSafeDumper, allow_unicode=True)  # the quick one
    file.write_text(text, encoding="utf-8")
    found = ""
    try:
        load_rig(file)
    except CdprError as error:
        found = str(error)
    assert not JARGON.search(found), found


def rig_with(**changes: object) -> RigDocument:
    return RigDocument.model_validate(yaml.safe_load(PAPER) | changes)


@pytest.mark.parametrize("key", ["anchors_mm", "outlets_mm"])
@settings(max_examples=30)
@given(
    at=st.tuples(*[st.floats(-600.0, 600.0)] * 3),
    along=st.tuples(*[st.floats(-1.0, 1.0)] * 3),
    aside=st.sampled_from([0.0, 100.0]),
)
def test_cables_that_meet_one_point_or_line_are_refused(key: str, at, along, aside: float) -> None:
    """About it no cable exerts a moment; files round to a tenth of a micrometre."""
    steps = np.array([-50.0, 20.0, 0.0, 65.0, -10.0, 35.0, 80.0, -90.0])
    points = np.array(at) + np.outer(steps, along)
    points[3] += aside * np.array([-1.0 - along[1], 1.0 + along[0], 0.0])
    found = rig_with(**{key: np.round(points, 4).tolist()}).findings()
    beside = points - points[0]
    rank = np.linalg.matrix_rank(beside, tol=0.1)
    if rank >= 2:
        assert found == []
    elif np.linalg.matrix_rank(beside, tol=1e-3 / 10) < 2:
        [(path, what)] = found
        assert path == (key,)
        assert ("at one point" if np.ptp(points, axis=0).max() < 1e-4 else "on one") in what
        assert "cannot hold six degrees of freedom; use three or more points" in what


def scaled(points: list[list[float]], factor: float) -> list[list[float]]:
    return [[factor * x for x in point] for point in points]


def resized(factor: float, *keys: str) -> RigDocument:
    """The paper's rig with some of its lengths multiplied by a factor."""
    data = paper_data()
    for key in keys:
        if key == "size_mm":
            data["platform"] = data["platform"] | {key: scaled([[130, 130, 130]], factor)[0]}
        else:
            data[key] = scaled(data[key], factor)
    return RigDocument.model_validate(data)


LENGTHS = ("size_mm", "outlets_mm", "anchors_mm")


@pytest.mark.parametrize(
    ("keys", "refused"),
    [
        (("size_mm",), {"platform.size_mm"}),
        (("anchors_mm",), {"anchors_mm"}),
        (("outlets_mm",), {"outlets_mm"}),
        (("outlets_mm", "anchors_mm"), {"outlets_mm", "anchors_mm"}),
        (LENGTHS, {"outlets_mm", "platform.size_mm"}),
    ],
)
def test_metres_in_a_rig_file_are_refused_with_their_key(
    keys: tuple[str, ...], refused: set[str]
) -> None:
    """A platform of 0.13 mm would let obstacles into the real one."""
    found = resized(1e-3, *keys).findings()
    assert {key_path(key) for key, _ in found} == refused
    assert all("write lengths in mm, not in m" in what for _, what in found)


def test_a_platform_of_more_than_a_metre_in_metres_is_refused() -> None:
    """Its edges in metres are above the least thickness."""
    data = paper_data()
    data["platform"]["size_mm"] = [1.3, 1.3, 1.3]
    for key in ("outlets_mm", "anchors_mm"):
        data[key] = scaled(data[key], 10.0)
    [(key, what)] = RigDocument.model_validate(data).findings()
    assert key_path(key) == "platform.size_mm"
    assert "the anchors span 1300 mm, the longest edge of platform.size_mm 1.3" in what


@settings(max_examples=60)
@given(
    frame=st.floats(0.2, 40.0),
    share=st.floats(0.2, 1.5),
    thin=st.floats(1.0, 130.0),
    posts=st.floats(1.0, 6.0),
)
def test_desktop_rigs_halls_thin_plates_and_posts_are_accepted(
    frame: float, share: float, thin: float, posts: float
) -> None:
    """From a frame of 210 mm to one of 42 m; anchors up to six times as far apart as the box."""
    data = paper_data()
    data["outlets_mm"] = scaled(data["outlets_mm"], frame)
    data["platform"]["size_mm"] = [130 * frame * share, 130 * frame * share, thin]
    data["anchors_mm"] = scaled(data["anchors_mm"], min(frame * share * posts, 8.0 * frame))
    document = RigDocument.model_validate(data)
    assert document.findings() == []
    assert document.remarks() == []


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*_8_6*.yaml")), ids=lambda path: path.stem)
def test_the_rigs_of_the_repository_have_no_remarks(path: Path) -> None:
    assert load_rig(path).document.remarks() == []


def test_a_cable_listed_twice_is_refused() -> None:
    data = paper_data()
    for key in ("outlets_mm", "anchors_mm"):
        data[key][7] = data[key][0]
    [(key, what)] = RigDocument.model_validate(data).findings()
    assert (key_path(key), what) == (
        "anchors_mm[7]",
        "cable 8 has the outlet and anchor of cable 1",
    )


def test_an_anchor_beyond_the_frame_is_refused() -> None:
    data = paper_data()
    data["anchors_mm"] = [[x + 5000.0, y, z] for x, y, z in data["anchors_mm"]]
    [(key, what)] = RigDocument.model_validate(data).findings()
    assert key_path(key) == "anchors_mm"
    assert (
        "from the platform's origin, farther than the outlets from each other (1699.1 mm)" in what
    )
    assert "in the platform frame, not the world frame" in what


def test_anchors_in_the_world_frame_and_a_tiny_box_get_a_remark() -> None:
    world, box = paper_data(), paper_data()
    world["anchors_mm"] = [[x, y, z + 445.0] for x, y, z in world["anchors_mm"]]
    [of_world] = rig_of(world).document.remarks()
    assert of_world.startswith("anchors_mm: along z their middle is 445 mm from the platform's")
    box["platform"]["size_mm"] = [5.0, 5.0, 5.0]
    [of_box] = rig_of(box).document.remarks()
    assert of_box.startswith("platform.size_mm: the longest edge is 5 mm, but the anchors span 130")


def test_a_frame_at_the_bottom_of_the_platform_gets_a_remark_but_not_eyebolts() -> None:
    """The box is about the frame: half of a cube with its frame at the bottom is outside it."""
    data, bolts = paper_data(), paper_data()
    half = data["platform"]["size_mm"][2] / 2.0
    data["anchors_mm"] = [[x, y, z + half] for x, y, z in data["anchors_mm"]]
    [remark] = rig_of(data).document.remarks()
    assert remark.startswith(f"anchors_mm: along z their middle is {half:g} mm from the platform's")
    bolts["anchors_mm"] = [[x, y, half + 15.0] for x, y, _ in bolts["anchors_mm"]]
    assert rig_of(bolts).document.remarks() == []


def test_a_point_mass_is_refused_with_its_line(tmp_path: Path) -> None:
    text = yaml.safe_dump(yaml.safe_load(PAPER) | {"anchors_mm": [[0, 0, 0]] * 8})
    [(line, _, key, what)] = problems_in(text, tmp_path)
    assert text.splitlines()[line - 1].startswith("anchors_mm")
    assert (key, what.split(",")[0]) == ("anchors_mm", "all 8 anchors are at one point")


def test_outlets_on_a_line_are_accepted_with_pulleys() -> None:
    """The exits are a pulley's radius beside the line."""
    outlets = [[100.0 * i, 0.0, 900.0] for i in range(8)]
    pulleys = {"radius_mm": 13, "feed_directions": [[0, 0, 1]] * 8}
    assert rig_with(outlets_mm=outlets, pulleys=pulleys).findings() == []
    assert len(rig_with(outlets_mm=outlets).findings()) == 1
