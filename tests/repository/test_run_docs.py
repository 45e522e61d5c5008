"""`make docs-run` runs what the pages print, and says of every block that it leaves out why."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    import run_docs

    yield run_docs
    sys.modules.pop("run_docs", None)


def page(folder: Path, text: str) -> Path:
    path = folder / "page.md"
    path.write_text(text)
    return path


def test_every_block_of_the_documentation_can_be_read_and_most_are_run(tool: Any) -> None:
    pages = [page for sharing in tool.pages_in_order() for page in sharing]
    assert pages[0].name == "README.md"
    assert pages[1].name == "getting-started.md"
    blocks = [block for page in pages for block in tool.blocks_of(page)]
    assert len(blocks) > 50
    assert sum(not block.left_out(False) for block in blocks) > len(blocks) / 2


def test_blocks_of_a_page_share_a_folder_and_run_in_order(tool: Any, tmp_path: Path) -> None:
    text = "```sh\necho 1 > x\n```\n```text\nfalse\n```\n```console\n$ test -f x\n$ rm x\n```\n"
    assert tool.run_pages([[page(tmp_path, text)]], fast=True) == 0


def test_a_block_that_fails_is_named_with_its_line_and_its_output(
    tool: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = "\n```sh\ntrue\n```\n\n```bash\necho it broke\nfalse\necho never\n```\n"
    assert tool.run_pages([[page(tmp_path, text)]], fast=True) == 1
    shown = capsys.readouterr().out
    assert "page.md:6: exit code 1 instead of 0\nit broke\n" in shown
    assert "never" not in shown


def test_an_exit_code_that_the_page_promises_is_demanded(tool: Any, tmp_path: Path) -> None:
    text = "<!-- exit code 3: refused -->\n```sh\nexit {}\n```\n"
    assert tool.run_pages([[page(tmp_path, text.format(3))]], fast=True) == 0
    assert tool.run_pages([[page(tmp_path, text.format(0))]], fast=True) == 1


def test_a_block_that_is_not_run_gives_its_reason(tool: Any, tmp_path: Path) -> None:
    text = "<!-- not run: needs a CAN interface -->\n```sh\nfalse\n```\n"
    (block,) = tool.blocks_of(page(tmp_path, text))
    assert block.left_out(False) == "needs a CAN interface"
    text = "<!-- run in full: real time -->\n```sh\nfalse\n```\n"
    (block,) = tool.blocks_of(page(tmp_path, text))
    assert block.left_out(True) == "real time"
    assert block.left_out(False) == ""


@pytest.mark.parametrize("marker", ["not run", "not run:", "skip: hardware", "exit code: 3"])
def test_a_marker_without_a_reason_or_a_meaning_is_an_error(
    tool: Any, tmp_path: Path, marker: str
) -> None:
    path = page(tmp_path, f"<!-- {marker} -->\n```sh\nfalse\n```\n")
    with pytest.raises(tool.BadMarker, match=r"page.md:1: .* is not a marker with a reason"):
        tool.blocks_of(path)


def test_a_program_beside_the_page_runs_until_its_end_and_then_gets_ctrl_c(
    tool: Any, tmp_path: Path
) -> None:
    beside = "trap 'touch {0}; exit 130' INT\necho ready\nwhile :; do sleep 0.05; done"
    script = tmp_path / "beside.sh"
    script.write_text(beside.format(tmp_path / "interrupted"))
    text = (
        f"<!-- in another terminal, ready at: ready -->\n```sh\nsh {script}\n```\n"
        f"```sh\ntest ! -e {tmp_path / 'interrupted'}\n```\n"
    )
    assert tool.run_pages([[page(tmp_path, text)]], fast=True) == 0
    assert (tmp_path / "interrupted").exists()


def test_what_the_next_block_waits_for_is_printed_by_the_product() -> None:
    """Blocks in real time do not run in every CI: a changed message would go unnoticed."""
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    waits = {t for page in pages for t in re.findall(r"ready at: (.+?) -->", page.read_text())}
    assert waits
    product = "".join(p.read_text() for f in ("cdpr", "executor") for p in (ROOT / f).rglob("*.py"))
    assert [text for text in waits if text not in product] == []
