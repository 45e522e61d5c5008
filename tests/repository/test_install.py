"""Installations from the `Makefile`, and the newcomer's clone of `.ci/as-user`."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from executor.doctor import PACKAGES

ROOT = Path(__file__).parents[2]

PYTHON = """\
#!/bin/sh
case "$*" in
  -V) echo "Python {version}" ;;
  "-m venv "*)
    mkdir -p "$3/bin" && cd "$3/bin" || exit 1
    echo "#!/bin/sh" > cdpr
    [ -e python ] || cp "{path}" python || exit 1
    chmod +x cdpr ;;
  "-m pip check "* | "-m pip install --no-user "*)
    [ ! -e killed ] || kill $PPID
    [ -e "${{0%python}}cdpr" ] && [ ! -e broken ] ;;
  "-m pip "*) exit 1 ;;
esac
"""
"""Stands for a distribution's Python: with venv, which keeps a Python that exists and fails at a
dangling link; pip only in an environment, where it fails while a file `broken` exists, ends
`make`'s shell while `killed` does, and refuses to install into the user's folder, as `pip.conf` may
say."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the files that an installation reads."""
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, tmp_path)
    return tmp_path


def python(folder: Path, version: str) -> Path:
    path = folder / f"python{version}"
    path.write_text(PYTHON.format(version=version, path=path))
    path.chmod(0o755)
    return path


def make(target: str, python: Path, folder: Path | None = None) -> bool:
    """Whether it succeeds, from the Python's folder or another; the shell's PWD is that name."""
    folder = folder or python.parent
    command, settings = ["make", f"PYTHON={python}", target], {**os.environ, "PWD": str(folder)}
    done = subprocess.run(command, cwd=folder, env=settings, capture_output=True)
    return done.returncode == 0


def installed(folder: Path) -> tuple[str, str]:
    """The version of the environment's Python, and the one it is said to be."""
    shown = subprocess.run([folder / ".venv/bin/python", "-V"], capture_output=True, text=True)
    return shown.stdout.split()[1], (folder / ".venv/installed").read_text().split()[1]


def test_an_installation_on_another_python_is_replaced(folder: Path) -> None:
    """`venv` itself keeps the Python of an environment that exists."""
    assert make("install", python(folder, "3.11.2"))
    assert make("install", python(folder, "3.12.1"))
    assert installed(folder) == ("3.12.1", "3.12.1")


def test_a_folder_reached_by_another_name_is_the_same_folder(folder: Path) -> None:
    interpreter, link = python(folder, "3.12.1"), folder / "link"
    link.symlink_to(folder)
    assert make("install", interpreter)
    own = folder / ".venv/own"
    own.touch()
    (folder / "broken").touch()
    assert make("install", interpreter, link)
    assert own.exists()


@pytest.mark.parametrize("reason", ["broken", "killed"])
def test_an_installation_is_replaced_only_by_a_complete_one(folder: Path, reason: str) -> None:
    """Without a network it would be lost. It comes back to the path that its scripts hold."""
    old, new = python(folder, "3.11.2"), python(folder, "3.12.1")
    assert make("install", old)
    own, obstacle = folder / ".venv/own", folder / reason
    own.touch()
    obstacle.touch()
    assert not make("install", new)
    assert own.exists()
    assert installed(folder) == ("3.11.2", "3.11.2")
    obstacle.unlink()
    assert make("install", new)
    assert installed(folder) == ("3.12.1", "3.12.1")
    assert not own.exists()
    assert not list(folder.glob(".venv-*"))


def test_an_installation_behind_a_link_is_left_as_it_is(folder: Path) -> None:
    """As of another working tree of the repository."""
    interpreter, tree = python(folder, "3.12.1"), folder / "tree"
    assert make("install", interpreter)
    stamp = (folder / ".venv/installed").read_text()
    tree.mkdir()
    for file in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(folder / file, tree)
    (tree / ".venv").symlink_to(folder / ".venv")
    assert make("install", interpreter, tree)
    assert (folder / ".venv/installed").read_text() == stamp
    assert not (tree / ".venv").is_symlink()


def test_an_installation_outlives_a_replacement_that_lost_power(folder: Path) -> None:
    old, new = python(folder, "3.11.2"), python(folder, "3.12.1")
    assert make("install", old)
    (folder / ".venv").rename(folder / ".venv-replaced")
    subprocess.run([new, "-m", "venv", ".venv"], cwd=folder, check=True)
    (folder / ".venv/installed").write_text(f"Python 3.12.1 in {folder}, unfinished")
    (folder / "broken").touch()
    assert not make("install", new)
    assert installed(folder) == ("3.11.2", "3.11.2")


def test_an_installation_whose_python_moved_is_made_again(folder: Path) -> None:
    """The same version is elsewhere, as of conda, pyenv or uv; venv keeps the dangling link."""
    interpreter = python(folder, "3.12.1")
    assert make("install", interpreter)
    link = folder / ".venv/bin/python"
    link.unlink()
    link.symlink_to(folder / "gone/python3.12")
    assert make("install", interpreter)
    assert installed(folder) == ("3.12.1", "3.12.1")


@pytest.mark.parametrize(
    ("name", "good"),
    [("ein Ordner für cdpr", True), ("a $b", False), ("a `b", False), ('a "b', False)],
)
def test_a_folder_whose_name_a_shell_would_expand_is_refused(
    folder: Path, name: str, good: bool
) -> None:
    """pip begins a program's file with a line of shell that has the path in double quotes."""
    inside = folder / name
    inside.mkdir()
    for file in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(folder / file, inside)
    assert make("install", python(folder, "3.12.1"), inside) == good
    assert (inside / ".venv").exists() == good


def test_an_environment_of_the_user_s_own_is_kept(folder: Path) -> None:
    """An editor may have made it; on the same Python it is installed into."""
    old, new = python(folder, "3.11.2"), python(folder, "3.12.1")
    subprocess.run([old, "-m", "venv", ".venv"], cwd=folder, check=True)
    own = folder / ".venv/own"
    own.touch()
    assert not make("install", new)
    assert own.exists()
    assert make("install", old)
    assert own.exists()
    assert installed(folder) == ("3.11.2", "3.11.2")


def test_an_interrupted_installation_continues_on_its_own_python_only(folder: Path) -> None:
    broken = folder / "broken"
    old, new = python(folder, "3.11.2"), python(folder, "3.12.1")
    broken.touch()
    assert not make("install", old)
    download = folder / ".venv/download"
    download.touch()
    assert not make("install", old)
    assert download.exists()
    broken.unlink()
    assert make("install", new)
    assert not download.exists()
    assert installed(folder) == ("3.12.1", "3.12.1")


def test_pins_that_return_after_an_interrupted_installation_are_installed_again(
    folder: Path,
) -> None:
    pins, interpreter = folder / "constraints.txt", python(folder, "3.12.1")
    assert make("install", interpreter)
    before = pins.read_text()
    pins.write_text(f"{before}another==1\n")
    (folder / "broken").touch()
    assert not make("install", interpreter)
    pins.write_text(before)
    assert not make("install", interpreter)


def test_wheels_are_checked_where_the_python_has_no_pip(folder: Path) -> None:
    assert make("check-arm64", python(folder, "3.12.1"))


def test_clean_removes_byte_code_from_every_folder(folder: Path) -> None:
    tops = (*PACKAGES, "tests", "benchmarks", "tools", "examples")
    for name in tops:
        (folder / name / "part/__pycache__").mkdir(parents=True)
    assert make("clean", python(folder, "3.12.1"))
    assert not list(folder.rglob("__pycache__"))


@pytest.mark.root
def test_root_runs_as_a_newcomer_what_lies_in_another_user_s_clone(tmp_path: Path) -> None:
    """As in a container with the developer's folder mounted: git refuses a stranger's files."""
    (tmp_path / ".ci").mkdir()
    shutil.copy(ROOT / ".ci/as-user", tmp_path / ".ci")
    for command in ("init", "add .", "-c user.name=a -c user.email=a@b commit -m first"):
        subprocess.run(["git", "-C", tmp_path, *command.split()], check=True, capture_output=True)
    subprocess.run(["chown", "-R", "65534:65534", tmp_path], check=True)
    command = [tmp_path / ".ci/as-user", "git", "log", "--format=%s"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "first\n"), done.stderr
