"""Harmful input is refused before it costs memory or time: devices, pipes, sizes, odd content."""

from __future__ import annotations

import csv
import io
import os
import tracemalloc
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.geometry.measurements import read_rig_data
from executor.recording.table_files import TableFile
from model.errors import BadInput, InvalidFile
from model.files.csv_table import CsvTable
from model.files.documents import load_yaml
from model.files.reading import (
    READING_NEEDS,
    TEXT_LIMIT,
    CsvFile,
    parse_json,
    read_bytes,
    read_text,
    table_limit,
)
from model.files.scene_file import SceneDocument
from model.rig import load_rig
from model.scene import load_scene

CONFIGS = Path(__file__).parents[2] / "configs"


def test_a_device_is_refused_without_reading_it() -> None:
    with pytest.raises(BadInput, match="not a regular file"):
        read_text(Path("/dev/zero"))


def test_a_pipe_is_refused_without_waiting_for_its_writer(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(BadInput, match="not a regular file"):
        read_text(tmp_path / "pipe")


def test_a_file_beyond_the_limit_is_refused_by_its_stated_size(tmp_path: Path) -> None:
    with (tmp_path / "large").open("wb") as stream:
        stream.truncate(10**12)  # no block of it is on disk
    with pytest.raises(BadInput, match=r"1000000\.0 MB"):
        read_bytes(tmp_path / "large")


@pytest.mark.parametrize("name", ["loop", "x" * 300, "a\0b"])
def test_an_impossible_path_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(BadInput, match=r"cannot be (read|used)"):
        read_text(tmp_path / name)


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000,
        '{"a": 1, "a": 2}',
        '{"a": 1e400}',
        '{"a": NaN}',
        '{"a": ' + "9" * 50 + "}",
        "",
    ],
)
def test_json_that_our_programs_never_write_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"nested|twice|finite|not a number|digits|Expecting"):
        parse_json(text)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_a_csv_file_is_the_same_with_any_line_ends(tmp_path: Path, end: str) -> None:
    (tmp_path / "a.csv").write_bytes(f"a,b{end}1,2{end}{end}3,4{end}".encode())
    file = CsvFile(tmp_path / "a.csv")
    assert file.rows == [["a", "b"], ["1", "2"], ["3", "4"]]
    assert file.lines == [1, 2, 4], "as an editor counts them"


def test_columns_and_lines_that_a_spreadsheet_left_empty_are_ignored(tmp_path: Path) -> None:
    """It writes every cell that was used once."""
    (tmp_path / "a.csv").write_text(",,,\na,b,,\n1,2,,\n,,,\n , ,,\n3,4,,\n,,,\n")
    table = CsvTable(tmp_path / "a.csv")
    assert table.of(["a", "b"]).tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert [table.line(row) for row in range(2)] == [3, 6], "as an editor counts them"
    with pytest.raises(BadInput) as caught:
        table.of(["c"])
    assert caught.value.next_step == "name it in the first line, which has: a, b"


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("a,b,a\n1,2,3\n", "the column 'a' appears twice"),
        ("a,b\n1,\n", "line 2, b: '' is not a finite number"),
        ("a,b,\n1,2\n", "line 2 has 2 values for 3 columns"),
        ("a,b\n,\n", "the file holds no values"),
    ],
)
def test_a_table_by_other_programs_is_refused_with_the_reason(
    tmp_path: Path, text: str, what: str
) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(BadInput) as caught:
        CsvTable(tmp_path / "a.csv").of(["a", "b"])
    assert caught.value.what == what


def test_a_field_that_never_ends_is_reported_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text('a,b\n1,"' + "x" * 200_000)
    for reader in (CsvFile, TableFile, lambda path: read_rig_data(path, 8)):
        with pytest.raises(BadInput, match="not valid CSV") as caught:
            reader(tmp_path / "a.csv")
        assert caught.value.where.endswith("a.csv:2")


def test_a_whole_number_past_64_bits_in_a_table_is_reported(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("n\n" + "9" * 30 + "\n")
    with pytest.raises(BadInput, match="whole number"):
        TableFile(tmp_path / "a.csv").column("n", int)


@pytest.mark.parametrize("value", ["-1e308", "1.1e15", "1e400", "-inf"])
def test_a_number_that_no_run_records_is_reported(tmp_path: Path, value: str) -> None:
    (tmp_path / "a.csv").write_text(f"x_mm,y_mm\n1,2\nnan,{value}\n")
    table = TableFile(tmp_path / "a.csv")
    assert table.column("x_mm", float)[0] == 1.0
    with pytest.raises(BadInput, match="'y_mm' has a value beyond"):
        table.column("y_mm", float)


def test_a_table_with_two_columns_of_one_name_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x_mm,y_mm,x_mm\n1,2,3\n")
    with pytest.raises(BadInput, match="2 columns have the name 'x_mm'"):
        TableFile(tmp_path / "a.csv")


def changed(tmp_path: Path, name: str, old: str, new: str) -> Path:
    text = (CONFIGS / name).read_text()
    assert old in text
    path = tmp_path / "changed.yaml"
    path.write_text(text.replace(old, new, 1))
    return path


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("home_counts: 0", "home_counts: " + "9" * 399),
        ("mass_kg: 0.4", "mass_kg: 1e308"),
        ("mass_kg: 0.4", "mass_kg: 1e-300"),
        ("max_tension_n: 100", "max_tension_n: 1e308"),
        ("width_px: 1280", "width_px: 9000000000000000000"),
        ("channel: cdpr", "channel: " + "x" * 300),
    ],
)
def test_an_absurd_number_or_name_is_refused(tmp_path: Path, old: str, new: str) -> None:
    text = (CONFIGS / "gachon_8_6.yaml").read_text()
    if old not in text:
        old, new = "direction: 1", f"direction: 1, {new}"
    with pytest.raises(InvalidFile) as caught:
        load_rig(changed(tmp_path, "gachon_8_6.yaml", old, new))
    (problem,) = caught.value.problems
    assert problem.key.endswith(new.split(": ")[-2].split()[-1])
    assert problem.line > 0


def test_a_name_too_long_for_a_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput) as caught:
        load_scene(changed(tmp_path, "environment_1.yaml", "name: ", f"name: {'x' * 300} "))
    assert "100 bytes" in str(caught.value)


def test_a_hull_with_a_point_of_two_numbers_is_reported_with_its_position(tmp_path: Path) -> None:
    scene = tmp_path / "scene.yaml"
    scene.write_text(
        "schema_version: 1\nname: hull\nstart: {position_mm: [0, 0, 0]}\n"
        "goal: {position_mm: [0, 0, 9]}\nobstacles:\n  - name: hull\n    convex:\n"
        "      points_mm: [[0, 0, 0], [1, 0], [0, 1, 0], [0, 0, 1]]\n"
    )
    with pytest.raises(BadInput) as caught:
        load_yaml(scene, SceneDocument)
    assert "points_mm[1]" in str(caught.value)
    assert "needs 3 entries" in str(caught.value)


@pytest.mark.parametrize("size", [0, 1, 999_999, 1_000_000, 2_500_000])
def test_a_file_needs_memory_for_its_size_and_not_for_the_limit(size: int, tmp_path: Path) -> None:
    content = bytes(range(250)) * (size // 250 + 1)
    (tmp_path / "table.csv").write_bytes(content[:size])
    tracemalloc.start()
    try:
        data = read_bytes(tmp_path / "table.csv", 10**9)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert data == content[:size]
    assert peak < 2 * size + 2_000_000


def test_a_file_without_a_size_of_its_own_is_read_whole_and_bounded() -> None:
    process = Path("/proc/self")
    assert read_bytes(process / "cmdline") == (process / "cmdline").read_bytes()
    assert len(read_bytes(process / "pagemap", 2_500_000)) <= 3_000_000


@pytest.mark.parametrize("gigabytes", [1, 4, 16, 64])
def test_a_table_is_as_large_as_memory_permits(gigabytes: int) -> None:
    memory = gigabytes * 10**9
    limit = table_limit(memory)
    assert limit >= TEXT_LIMIT
    assert limit * READING_NEEDS <= max(memory, TEXT_LIMIT * READING_NEEDS)


@given(
    st.lists(
        st.lists(st.text(st.characters(exclude_characters="\r\0")), min_size=1, max_size=3),
        max_size=4,
    )
)
def test_a_csv_file_has_the_rows_that_were_written(rows: list[list[str]]) -> None:
    """Whatever characters end lines elsewhere, and with line ends in quotes."""
    stream = io.StringIO(newline="")
    csv.writer(stream, lineterminator="\n", quoting=csv.QUOTE_ALL).writerows(rows)
    assert CsvFile(Path("x.csv"), stream.getvalue()).rows == rows
