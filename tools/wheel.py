"""Builds the wheel into dist/ and tests it in a clean environment outside the repository.

    python tools/wheel.py               # needs no network
    python tools/wheel.py --with-index  # installs the dependencies by pip instead of borrowing them

The environment contains only the wheel. Its dependencies are those of the Python that runs this,
made visible by a path file; the repository is not visible, so files missing from the wheel are
noticed. Kernels run as plain Python, as compiling them in a new folder takes minutes.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import sysconfig
import tempfile
import tomllib
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
WHEEL = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]
PACKAGES = WHEEL["packages"]
VERSION = PROJECT["project"]["version"]

TRIED = (
    "cdpr --version",
    "cdpr examples",
    "cdpr examples --all",
    "cdpr examples rig_session -o copy",
    "cdpr doctor configs/gachon_8_6.yaml",
    "cdpr plan configs/gachon_8_6.yaml configs/environment_1.yaml -o plan.json --rounds 1",
    "cdpr check plan.json",
    "cdpr run plan.json -o runs/first --fast --no-camera",
    "cdpr explain drive_silent",
)


class Failed(Exception):
    """A requirement of a release is not met."""


class NoRepository(Exception):
    """Git is missing or refuses, or this folder has no commit or is part of another repository."""


def build() -> Path:
    """Builds the wheel in dist/."""
    require_tag_of_this_version()
    require_files_of_the_commit()
    output = ROOT / "dist"
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(output)]
    run(command, ROOT)
    return output / f"cdpr-{VERSION}-py3-none-any.whl"


def require_tag_of_this_version() -> None:
    """Checks that a version tag of this commit matches the version."""
    try:
        tags = git("tag", "--points-at", "HEAD", "--list", "v*").split()
    except NoRepository:
        return
    if wrong := [tag for tag in tags if tag != f"v{VERSION}"]:
        raise Failed(f"this commit has the tag {wrong[0]}, pyproject.toml has version {VERSION}")


def require_files_of_the_commit() -> None:
    """Checks that a release is built from committed files; another wheel is only remarked on.

    Hatchling packs new files, in the folders outside the packages even those that git ignores.
    """
    status = ("status", "--porcelain", "--untracked-files=all")
    try:
        tag = git("tag", "--points-at", "HEAD", "--list", f"v{VERSION}").strip()
        outside = git(*status, "--ignored", "--", *WHEEL["force-include"])
        changed = (outside + git(*status, "--", *PACKAGES)).splitlines()
    except NoRepository:
        return
    names = [line[3:] for line in changed if "__pycache__" not in line]
    text = f"the wheel differs from the commit in {', '.join(names)}"
    if names and tag:
        raise Failed(f"{text}. Next: commit or remove them, or build from a fresh clone of {tag}")
    if names:
        print(f"note   {text}")


def git(*words: str) -> str:
    """Output of a git command on this repository.

    Raises:
        NoRepository: This is a release that was unpacked, perhaps into another repository.
    """
    try:
        inside = run(["git", "rev-parse", "--show-prefix", "HEAD"], ROOT).splitlines()[0]
    except (Failed, FileNotFoundError) as error:
        raise NoRepository(str(error)) from None
    if inside:
        raise NoRepository(f"it is the folder {inside} of another repository")
    return run(["git", *words], ROOT)


def install(wheel: Path, folder: Path, with_index: bool) -> Path:
    """Creates a clean environment with the wheel; returns its folder of programs."""
    venv.create(folder, with_pip=True)
    python = folder / "bin" / "python"
    borrowed = [] if with_index else ["--no-deps", "--no-index"]
    options = ["--no-user", "--quiet", "--disable-pip-version-check", *borrowed]
    pinned = ["-c", str(ROOT / "constraints.txt"), str(wheel)]
    run([str(python), "-m", "pip", "install", *options, *pinned], folder)
    if not with_index:
        (site,) = folder.glob("lib/python*/site-packages")
        (site / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return python.parent


def try_out(programs: Path, folder: Path) -> None:
    """Runs a newcomer's first commands in an empty folder."""
    where = f"import {', '.join(PACKAGES)}; print({', '.join(f'{p}.__file__' for p in PACKAGES)})"
    found = run([str(programs / "python"), "-c", where], folder).split()
    if outside := [path for path in found if not path.startswith(str(programs.parent))]:
        raise Failed(f"not from the wheel: {outside[0]}")
    for command in TRIED:
        program, *words = command.split()
        answer = run([str(programs / program), *words], folder)
        if command == "cdpr --version" and answer.split() != ["cdpr", VERSION]:
            raise Failed(f"cdpr --version says {answer.strip()!r}, not {VERSION}")
        print(f"ok     {command}", flush=True)
    if not re.search(r"PASSED", (folder / "runs/first/summary.json").read_text()):
        raise Failed("the run did not pass")


def run(command: list[str], folder: Path) -> str:
    """Output of a command.

    Raises:
        Failed: Its exit code is not 0.
    """
    settings = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME")}
    settings["NUMBA_DISABLE_JIT"] = "1"
    done = subprocess.run(
        command, cwd=folder, env=settings, capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        raise Failed(
            f"{' '.join(command)}: exit code {done.returncode}\n{done.stdout}{done.stderr}"
        )
    return done.stdout


def main() -> int:
    """Parses the command line."""
    parser = argparse.ArgumentParser(description="build the wheel and try it")
    parser.add_argument("--with-index", action="store_true", help="install dependencies by pip")
    options = parser.parse_args()
    try:
        wheel = build()
        print(f"built  {wheel.relative_to(ROOT)}, {wheel.stat().st_size / 1e6:.1f} MB", flush=True)
        with tempfile.TemporaryDirectory(prefix="cdpr-wheel-") as base:
            folder = Path(base).resolve() / "empty"
            folder.mkdir()
            programs = install(wheel, Path(base).resolve() / "venv", options.with_index)
            try_out(programs, folder)
    except Failed as error:
        print(f"FAILED {error}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
