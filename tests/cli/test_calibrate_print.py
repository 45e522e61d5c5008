"""`cdpr calibrate print`: a file at exact scale, or one clear message."""

from __future__ import annotations

import inspect
import json
from dataclasses import fields
from pathlib import Path

import pytest

from cdpr.cli.arguments import as_command
from cdpr.cli.calibrate.boards import BoardOptions, print_
from cdpr.cli.calibrate.camera import camera
from tests.calibration.pages import pages_in
from tests.cli.plans import RIG
from tests.cli.program import call, nothing_written, one_message

BOARD = ("--columns", "9", "--rows", "6", "--square-mm", "25")


def test_a_board_is_printed(tmp_path: Path) -> None:
    answer = call("calibrate", "print", tmp_path / "board.pdf", *BOARD, "--json")
    assert answer.code == 0, answer
    document = json.loads(answer.out)
    assert (document["pages"], document["width_mm"], document["height_mm"]) == (1, 297.0, 210.0)
    assert "measure the ruler" in document["next_steps"][0]
    ((size, _, _),) = pages_in((tmp_path / "board.pdf").read_bytes())
    assert size.round(2).tolist() == [297.0, 210.0]


def test_the_tags_of_a_rig_are_printed(tmp_path: Path) -> None:
    answer = call("calibrate", "print", tmp_path / "tags.pdf", "--rig", RIG)
    assert answer.code == 0, answer
    texts = [text for page in pages_in((tmp_path / "tags.pdf").read_bytes()) for text in page[2]]
    for number in (301, 306, 401, 404):
        assert any(f"tag36h11 {number}," in text for text in texts)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ((*BOARD[:-1], "35"), "use --paper a3"),
        ((*BOARD, "--rig", RIG), "--rig prints the rig's tags"),
        (("--family", "tag25h9", "--rig", RIG), "--rig prints the rig's tags"),
        ((), "needs --columns and --rows"),
        (("--board", "charuco"), "needs --columns and --rows"),
        (("--columns", "9", "--rows", "6"), "needs --square-mm"),
        (
            ("--board", "tags", "--columns", "3", "--rows", "2", "--tag-mm", "40", "--gap-mm", "2"),
            "less than one module",
        ),
    ],
)
def test_prints_that_cannot_be_are_refused(tmp_path: Path, options, named: str) -> None:
    with nothing_written(tmp_path):
        answer = call("calibrate", "print", tmp_path / "board.pdf", *options)
    one_message(answer, 2, named)


def test_camera_and_print_know_boards_by_the_same_options() -> None:
    verbs = [as_command(verb) for verb in (camera, print_)]
    commands = [inspect.signature(verb).parameters for verb in verbs]
    for option in fields(BoardOptions):
        one, other = (command[option.name] for command in commands)
        assert one.default == other.default == option.default
        helps = [parameter.annotation.__metadata__[0].help for parameter in (one, other)]
        assert helps[0] == helps[1]


def test_a_print_is_named_as_what_it_is(tmp_path: Path) -> None:
    with nothing_written(tmp_path):
        answer = call("calibrate", "print", tmp_path / "board.txt", *BOARD)
    one_message(answer, 2, "the output must be a PDF file", "name it board.pdf")


@pytest.mark.parametrize("folder", ["/", ".", ".."])
def test_a_folder_is_no_print(folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    one_message(call("calibrate", "print", folder, *BOARD), 2, "this is a folder", "name a file")


def test_a_file_that_exists_is_kept(tmp_path: Path) -> None:
    (tmp_path / "board.pdf").write_text("mine")
    answer = call("calibrate", "print", tmp_path / "board.pdf", *BOARD)
    one_message(answer, 2, "exists already")
    assert (tmp_path / "board.pdf").read_text() == "mine"
