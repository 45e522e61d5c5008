"""The environment, the wheel, and the import contracts."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
import zipfile
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

import cdpr
from tests.cli.program import call
from tools.wheel import (
    Failed,
    NoRepository,
    git,
    require_files_of_the_commit,
    require_tag_of_this_version,
)

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def pins() -> dict[str, Version]:
    """The pinned version of every package in constraints.txt."""
    return pins_of((ROOT / "constraints.txt").read_text())


def pins_of(text: str) -> dict[str, Version]:
    found: dict[str, Version] = {}
    for line in text.splitlines():
        if not line or line.startswith("#"):
            continue
        name, _, version = line.partition("==")
        assert re.fullmatch(r"[A-Za-z0-9._-]+", name), f"not an exact pin: {line}"
        assert canonicalize_name(name) not in found, f"pinned twice: {name}"
        found[canonicalize_name(name)] = Version(version)
    return found


def declared() -> list[Requirement]:
    """Every requirement in pyproject.toml: run-time, extras, build."""
    extras = PROJECT["project"]["optional-dependencies"].values()
    lists = [PROJECT["project"]["dependencies"], PROJECT["build-system"]["requires"], *extras]
    return [Requirement(text) for requirements in lists for text in requirements]


@pytest.mark.parametrize("requirement", declared(), ids=str)
def test_a_declared_dependency_has_a_lower_bound_and_a_pin_that_meets_it(
    requirement: Requirement,
) -> None:
    assert any(part.operator == ">=" for part in requirement.specifier)
    pin = pins().get(canonicalize_name(requirement.name))
    assert pin is not None, f"{requirement.name} has no pin in constraints.txt"
    assert requirement.specifier.contains(pin)


FIRST_WITH_WHEELS = {"matplotlib": "3.9.2", "numpy": "2.1", "pyyaml": "6.0.2"}
"""The first releases with wheels for every Python in the classifiers, where others are older."""


@pytest.mark.parametrize("name", FIRST_WITH_WHEELS)
def test_the_lowest_version_of_a_dependency_has_wheels_for_every_python(name: str) -> None:
    """Elsewhere `make test-lowest`, and so `.ci/run`, ends in pip's error."""
    command = [sys.executable, str(ROOT / "tools/lowest.py")]
    lowest = pins_of(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    assert lowest[canonicalize_name(name)] >= Version(FIRST_WITH_WHEELS[name])


def installed_pins() -> set[str]:
    """Every pinned package; those of the extras at the end of the file only where they are."""
    text = (ROOT / "constraints.txt").read_text()
    always, dask, apriltag = re.split(r"\n# The extra `(?:dask|apriltag)`", text)
    found = set(pins_of(always))
    if find_spec("distributed") is not None:
        found |= set(pins_of(dask.partition("\n")[2]))
    if find_spec("pyapriltags") is not None:
        found |= set(pins_of(apriltag.partition("\n")[2]))
    return found


def test_the_pins_are_closed_under_dependencies() -> None:
    """Whatever a pinned package needs here is pinned too, so an install takes nothing unpinned."""
    pinned = pins()
    missing = []
    for name in installed_pins():
        for text in metadata.requires(name) or []:
            requirement = Requirement(text)
            if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
                continue
            if canonicalize_name(requirement.name) not in pinned:
                missing.append(f"{requirement.name} (needed by {name})")
    assert not missing


def test_the_import_contracts_are_kept() -> None:
    run = "from importlinter.cli import lint_imports_command; lint_imports_command()"
    command = [sys.executable, "-c", run, "--no-cache", "--no-logo"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_version_is_the_same_wherever_it_is_written() -> None:
    version = PROJECT["project"]["version"]
    assert call("--version").out == f"cdpr {version}\n"
    assert cdpr.__version__ == version
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == version
    headings = re.findall(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    released = [Version(heading) for heading in headings if heading != "Unreleased"]
    assert headings[0] == "Unreleased" or released[0] == Version(version)
    assert all(Version(version) >= earlier for earlier in released)
    assert released == sorted(released, reverse=True)


def test_the_citation_names_the_software_and_the_paper() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    assert citation["authors"] == PROJECT["project"]["authors"]
    assert citation["license"] == PROJECT["project"]["license"]
    (paper,) = citation["references"]
    assert [author["family-names"] for author in paper["authors"]] == ["Xu", "Park"]


def repository(folder: Path, tag: str = "v99.0") -> Path:
    """A git repository with one commit, which has this tag."""
    settings = ("-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false")
    for words in (["init"], ["commit", "--allow-empty", "-m", "first"], ["tag", tag]):
        command = ["git", "-C", folder, *settings, *words]
        subprocess.run(command, check=True, capture_output=True)
    return folder


def test_a_tag_of_another_version_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tools.wheel.ROOT", repository(tmp_path))
    with pytest.raises(Failed, match=r"has the tag v99\.0"):
        require_tag_of_this_version()


@pytest.mark.parametrize("name", ["configs/our_lab.yaml", "examples/all.mcap", "model/notes.txt"])
def test_a_release_contains_only_files_of_its_commit(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    name: str,
) -> None:
    """Hatchling packs what lies there: a rig with a camera's password, a log that git ignores."""
    tag = f"v{PROJECT['project']['version']}"
    monkeypatch.setattr("tools.wheel.ROOT", repository(tmp_path, tag))
    (tmp_path / ".git/info/exclude").write_text("__pycache__\n*.mcap\n")
    own, compiled = tmp_path / name, tmp_path / "configs/__pycache__/rigs.pyc"
    for path in (own, compiled):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    with pytest.raises(Failed, match=name):
        require_files_of_the_commit()
    git("tag", "--delete", tag)
    require_files_of_the_commit()
    assert name in capsys.readouterr().out
    own.unlink()
    require_files_of_the_commit()
    assert not capsys.readouterr().out


@pytest.mark.parametrize("program", ["git", "none"])
def test_a_release_unpacked_in_another_repository_is_not_judged_by_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: str
) -> None:
    """A laboratory's own, or with the sources of all that it uses; or there is no git at all."""
    inside = repository(tmp_path) / "cdpr"
    inside.mkdir()
    monkeypatch.setattr("tools.wheel.ROOT", inside)
    if program == "none":
        monkeypatch.setenv("PATH", str(inside))
    require_tag_of_this_version()
    with pytest.raises(NoRepository):
        git("ls-files")


@pytest.mark.slow
def test_a_wheel_holds_every_package_its_type_marker_the_ready_rigs_and_the_documentation(
    tmp_path: Path,
) -> None:
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    build = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert build.returncode == 0, build.stderr
    (wheel,) = tmp_path.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    packages = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    assert {f"{package}/py.typed" for package in packages} <= names
    configs = {f"cdpr/configs/{path.name}" for path in (ROOT / "configs").glob("*.yaml")}
    assert configs
    assert configs <= names
    sessions = {
        f"cdpr/{path.relative_to(ROOT)}"
        for path in (ROOT / "examples").rglob("*")
        if path.is_file()
    }
    assert sessions
    assert sessions <= names
    parts = [*(ROOT / "docs").rglob("*.md"), *(ROOT / "docs/schema").glob("*.json")]
    documentation = {f"cdpr/{path.relative_to(ROOT)}" for path in parts}
    assert {"cdpr/docs/rig-file.md", "cdpr/docs/faults/late.md"} <= documentation
    assert documentation <= names
    tops = {name.split("/")[0] for name in names}
    assert tops == {*packages, f"cdpr-{PROJECT['project']['version']}.dist-info"}
