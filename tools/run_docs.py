"""Runs the command blocks of README.md and docs/*.md in order, as a newcomer would.

    python tools/run_docs.py                      # all pages; a few minutes
    python tools/run_docs.py --fast               # without the blocks marked `run in full`
    python tools/run_docs.py --list               # which blocks are left out, and why
    python tools/run_docs.py docs/odrive.md       # one page

Each page starts in a folder with a clone's `configs`, `examples` and `.venv`; README.md and
docs/getting-started.md share one. A block is run by `sh -e` with the `cdpr` of this Python first on
the path, and with separate sockets, locks and temporary files, so that it affects no other runs.
Comments on the lines before a fence are markers:

    <!-- not run: REASON -->                        hardware, root, a camera, the network, hours
    <!-- run in full: REASON -->                    left out by --fast
    <!-- exit code 3: REASON -->                    required exit code, instead of 0
    <!-- in another terminal, ready at: TEXT -->    runs beside the page's next blocks once it
                                                    has printed TEXT; then it gets Ctrl-C
    <!-- before: COMMAND -->                        what the reader has already done
    <!-- with options: OPTIONS -->                  options for a run without a terminal

The exit code is 1 if a block fails (page:line and its output are printed), 2 for a bad marker.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: A verb of cdpr, after which options may follow.
VERB = re.compile(r"^(cdpr (?:calibrate |bench )?\S+)")
FENCE = re.compile(r"^```(sh|console|bash)\s*$")
COMMENT = re.compile(r"^<!--\s*(.*?)\s*-->$")
MARKER = re.compile(
    r"(?P<kind>not run|run in full|exit code (?P<code>\d+)|in another terminal, ready at|before"
    r"|with options)"
    r":\s*(?P<text>.*)"
)
CLONE = {
    "configs": ROOT / "configs",
    "examples": ROOT / "examples",
    ".venv": Path(sys.prefix),  # `make VENV=…` gives it another name
}
BLOCK_LIMIT_S = 600.0
READY_LIMIT_S = 120.0
ENDED_BY_CTRL_C = (0, 130)


class BadMarker(Exception):
    """An unknown comment before a block."""


@dataclass(frozen=True)
class Block:
    """A block of commands with its markers."""

    page: Path
    line: int
    commands: str
    before: tuple[str, ...] = ()
    not_run: str = ""
    in_full: str = ""
    exit_code: int = 0
    ready_at: str = ""
    options: str = ""

    @property
    def where(self) -> str:
        """Page and line of the fence."""
        path = self.page.relative_to(ROOT) if self.page.is_relative_to(ROOT) else self.page
        return f"{path}:{self.line}"

    @property
    def script(self) -> str:
        """Script for the shell."""
        commands = self.commands.splitlines()
        if self.options:
            commands = [VERB.sub(rf"\1 {self.options}", command) for command in commands]
        if self.ready_at:
            commands = ["exec " + "\n".join(commands)]  # Ctrl-C reaches it, not its shell
        return "\n".join((*self.before, *commands))

    def left_out(self, fast: bool) -> str:
        """Reason why it is left out; empty if it is run."""
        return self.not_run or (self.in_full if fast else "")


def blocks_of(page: Path) -> list[Block]:
    """The command blocks of a page.

    Raises:
        BadMarker: A marker is unknown or gives no reason.
    """
    lines = page.read_text().splitlines()
    found = []
    for number, line in enumerate(lines):
        if not FENCE.match(line):
            continue
        end = lines.index("```", number + 1)
        commands = "\n".join(_command(text) for text in lines[number + 1 : end])
        markers = _markers(page, lines, number)
        found.append(Block(page, number + 1, commands, **markers))  # type: ignore[arg-type]
    return found


def _command(line: str) -> str:
    return line.removeprefix("$ ")


def _markers(page: Path, lines: list[str], fence: int) -> dict[str, object]:
    found: dict[str, object] = {}
    before: list[str] = []
    for number in range(fence - 1, -1, -1):
        comment = COMMENT.match(lines[number])
        if comment is None:
            break
        marker = MARKER.fullmatch(comment.group(1))
        if marker is None or not marker["text"]:
            raise BadMarker(
                f"{page}:{number + 1}: {lines[number]!r} is not a marker with a reason; the markers"
                " are in the first lines of tools/run_docs.py"
            )
        match marker["kind"]:
            case "not run":
                found["not_run"] = marker["text"]
            case "run in full":
                found["in_full"] = marker["text"]
            case "before":
                before.insert(0, marker["text"])
            case "with options":
                found["options"] = marker["text"]
            case "in another terminal, ready at":
                found["ready_at"] = marker["text"]
            case _:
                found["exit_code"] = int(marker["code"])
    return found | {"before": tuple(before)}


def pages_in_order() -> list[list[Path]]:
    """The pages by shared folder: the first two share one."""
    docs = ROOT / "docs"
    first = [ROOT / "README.md", docs / "getting-started.md"]
    return [first, *([page] for page in sorted(docs.rglob("*.md")) if page not in first)]


class Terminal:
    """Runs blocks in a folder like a clone, with separate state beside it.

    Args:
        base: An empty folder with a short path, as it contains sockets.
    """

    def __init__(self, base: Path) -> None:
        self.folder = base / "cdpr"
        self.folder.mkdir()
        for name, target in CLONE.items():
            if target.exists():
                (self.folder / name).symlink_to(target)
        settings = {"XDG_RUNTIME_DIR": "r", "XDG_STATE_HOME": "s", "TMPDIR": "t"}
        for name in settings.values():
            (base / name).mkdir(mode=0o700)
        self._base = base
        self._beside: list[tuple[subprocess.Popen[str], Path]] = []
        bin_folder = str(Path(sys.executable).parent)
        self._environment = os.environ | {
            **{variable: str(base / name) for variable, name in settings.items()},
            "PATH": f"{bin_folder}{os.pathsep}{os.environ['PATH']}",
            "MPLBACKEND": "Agg",
        }

    def run(self, block: Block) -> str:
        """Runs a block.

        Returns:
            The problem with the block's output; empty on success.
        """
        if block.ready_at:
            return self._run_beside(block)
        with tempfile.TemporaryFile("w+") as output:
            process = self._started(block.script, output)
            try:
                code = process.wait(BLOCK_LIMIT_S)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
                return f"took longer than {BLOCK_LIMIT_S:g} s\n{_content(output)}"
            if code == block.exit_code:
                return ""
            return f"exit code {code} instead of {block.exit_code}\n{_content(output)}"

    def close(self) -> list[str]:
        """Sends Ctrl-C to blocks still running; returns their problems."""
        problems = []
        while self._beside:
            process, log = self._beside.pop()
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGINT)
            try:
                code = process.wait(READY_LIMIT_S)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                code = process.wait()
            if code not in ENDED_BY_CTRL_C:
                problems.append(f"another terminal: exit code {code}\n{log.read_text()}")
        return problems

    def _run_beside(self, block: Block) -> str:
        log = self._base / f"beside-{block.page.stem}-{block.line}.log"
        with log.open("w") as output:
            process = self._started(block.script, output)
        self._beside.append((process, log))
        deadline = time.monotonic() + READY_LIMIT_S
        while time.monotonic() < deadline and process.poll() is None:
            if block.ready_at in log.read_text():
                return ""
            time.sleep(0.1)
        return "\n".join((f"did not print {block.ready_at!r}", *self.close()))

    def _started(self, script: str, output: object) -> subprocess.Popen[str]:
        return subprocess.Popen(
            ["sh", "-e", "-c", script],
            cwd=self.folder,
            env=self._environment | {"PYTHONUNBUFFERED": "1"},
            stdin=subprocess.DEVNULL,
            stdout=output,  # type: ignore[arg-type]
            stderr=subprocess.STDOUT,
            start_new_session=True,
            text=True,
        )


def _content(output: object) -> str:
    output.seek(0)  # type: ignore[attr-defined]
    return str(output.read()).rstrip()  # type: ignore[attr-defined]


def run_pages(pages: list[list[Path]], fast: bool) -> int:
    """Runs the blocks of the pages; returns the number of failures."""
    failures = 0
    for sharing in pages:
        base = Path(tempfile.mkdtemp(prefix="docs-"))
        try:
            terminal = Terminal(base)
            failures += sum(_run_page(terminal, page, fast) for page in sharing)
        finally:
            shutil.rmtree(base)
    return failures


def _run_page(terminal: Terminal, page: Path, fast: bool) -> int:
    blocks = [block for block in blocks_of(page) if not block.left_out(fast)]
    try:
        failures = sum(_reported(terminal, block) for block in blocks)
    finally:
        problems = terminal.close()
    for problem in problems:
        print(f"FAILED {page.name}: {problem}", flush=True)
    return failures + len(problems)


def _reported(terminal: Terminal, block: Block) -> bool:
    began = time.monotonic()
    problem = terminal.run(block)
    took = time.monotonic() - began
    if problem:
        print(f"FAILED {block.where}: {problem}", flush=True)
        return True
    print(f"ok     {block.where}  {took:.1f} s", flush=True)
    return False


def main() -> int:
    """Parses the command line."""
    parser = argparse.ArgumentParser(description="run the command blocks of the documentation")
    parser.add_argument("pages", nargs="*", type=Path, help="pages (default: all)")
    parser.add_argument("--fast", action="store_true", help="leave out `run in full`")
    parser.add_argument("--list", action="store_true", help="only list what is left out")
    options = parser.parse_args()
    pages = [[page.resolve()] for page in options.pages] or pages_in_order()
    try:
        blocks = [block for sharing in pages for page in sharing for block in blocks_of(page)]
    except BadMarker as error:
        print(error)
        return 2
    for block in blocks:
        if reason := block.left_out(options.fast):
            print(f"out    {block.where}  {reason}")
    if options.list:
        return 0
    failures = run_pages(pages, options.fast)
    done = sum(not block.left_out(options.fast) for block in blocks)
    print(f"{done} of {len(blocks)} blocks run, {failures} failed")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
