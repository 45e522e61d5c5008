"""The documentation builds, opens without a network, and knows every key of every file."""

from __future__ import annotations

import importlib
import inspect
import json
import re
import subprocess
import sys
from dataclasses import fields, is_dataclass
from html.parser import HTMLParser
from pathlib import Path
from shutil import which
from typing import Any, get_args

import numpy as np
import pytest
import yaml
from pydantic import BaseModel

import cdpr
from cdpr.cli.app import VERBS
from drivers.can_load import bus_load
from executor.control.winch_laws import MOST_RESERVE, RESERVE, RESERVE_COUNTS, CableStep
from executor.jogging import LONGEST_MM, SPEED
from executor.winch_runs import limit_of
from model.cameras import Camera, Tag
from model.errors import BadInput, Fault, HardwareMissing, Refused
from model.files.examples import rig_text
from model.files.new_rig import AFTER_COORDINATES, BEFORE_COORDINATES, collect_answers
from model.files.plan_file import PlanDocument
from model.files.rig_file import CableDocument, PlatformDocument, RigDocument, WinchDocument
from model.files.scene_file import SceneDocument
from model.files.validation import parse_yaml
from model.rig import Motion, Winch, load_rig, rig_from_document
from model.statics.gravity import STANDARD_GRAVITY
from planner.anytime import path as anytime_path
from tests.api.test_names import PACKAGES

ROOT = Path(__file__).parents[2]
OUTSIDE = re.compile(r"^\s*(https?:)?//", re.IGNORECASE)
FETCHING = {"src", "srcset", "data", "poster", "action"}


class Fetched(HTMLParser):
    """Collects what a browser fetches by itself; a link that a person clicks is none of it."""

    def __init__(self) -> None:
        super().__init__()
        self.outside: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        names = FETCHING | {"href"} if tag == "link" else FETCHING
        self.outside += [v for k, v in attrs if k in names and v and OUTSIDE.match(v)]


def fetched_outside(html: str) -> list[str]:
    """Addresses on other hosts that a page would load."""
    parser = Fetched()
    parser.feed(html)
    return parser.outside


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The documentation, built without a warning."""
    folder = tmp_path_factory.mktemp("docs") / "site"
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(folder)]
    build = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert build.returncode == 0, build.stderr
    return folder


@pytest.mark.slow
def test_the_documentation_builds_without_a_warning_and_asks_no_other_host(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 10
    styles = re.compile(r"""(?:url\(|@import)\s*['"]?\s*((?:https?:)?//[^'")]*)""", re.IGNORECASE)
    outside = {page.name: fetched_outside(page.read_text()) for page in pages}
    outside |= {sheet.name: styles.findall(sheet.read_text()) for sheet in site.rglob("*.css")}
    assert not {name: found for name, found in outside.items() if found}


@pytest.mark.slow
def test_the_search_needs_no_server(site: Path) -> None:
    """From a folder a browser loads scripts only: no JSON, and no worker."""
    index = (site / "search" / "search_index.js").read_text()
    assert index.startswith("var __index = {")
    documents = json.loads(index.removeprefix("var __index = "))["docs"]
    assert any("following_error" in document["text"] for document in documents)
    for page, script in (
        ("index.html", "javascripts/iframe-worker.js"),
        ("faults/index.html", "../javascripts/iframe-worker.js"),
    ):
        assert f'src="{script}"' in (site / page).read_text()
    assert (site / "javascripts" / "iframe-worker.js").is_file()


@pytest.mark.slow
@pytest.mark.skipif(which("chromium") is None, reason="there is no Chromium here")
def test_a_browser_finds_a_word_in_the_pages_of_a_folder(site: Path, tmp_path: Path) -> None:
    command = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom"]
    command += ["--virtual-time-budget=20000", f"--user-data-dir={tmp_path}"]
    address = f"{(site / 'index.html').as_uri()}?q=following+error"
    shown = subprocess.run([*command, address], capture_output=True, text=True, check=False)
    found = re.search(r'md-search-result__meta">(\d+) matching documents', shown.stdout)
    assert found is not None
    assert int(found.group(1)) > 5


def test_the_search_for_outside_addresses_sees_them() -> None:
    assert fetched_outside('<script src="//cdn.example.org/x.js"></script>')
    assert fetched_outside('<link rel="stylesheet" href="https://fonts.example.org/a">')
    assert not fetched_outside('<a href="https://example.org">read</a><img src="img/a.png">')


def keys(model: type[BaseModel]) -> set[str]:
    """Names of the fields of a document and of the documents in it."""
    found: set[str] = set()
    for name, field in model.model_fields.items():
        found.add(name)
        for inner in _models(field.annotation):
            found |= keys(inner)
    return found


def _models(annotation: object) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models(part)]


@pytest.mark.parametrize(
    ("page", "model", "elsewhere"),
    [
        ("rig-file.md", RigDocument, set()),
        ("scene-file.md", SceneDocument, set()),
        ("plan-file.md", PlanDocument, keys(RigDocument) | keys(SceneDocument)),
    ],
)
def test_every_key_of_a_file_is_documented(
    page: str, model: type[BaseModel], elsewhere: set[str]
) -> None:
    words = set(re.findall(r"\w+", (ROOT / "docs" / page).read_text()))
    assert len(keys(model)) > 8
    assert not keys(model) - elsewhere - words


def test_the_example_of_tags_and_cameras_completes_a_rig_without() -> None:
    page = (ROOT / "docs" / "rig-file.md").read_text()
    (example,) = (block for block in page.split("```yaml\n")[1:] if block.startswith("tags:"))
    document = load_rig(ROOT / "configs" / "gachon_8_6.yaml").document.model_dump()
    added = yaml.safe_load(example.split("```")[0])
    assert set(added) == {"tags", "cameras"}
    rig = rig_from_document(RigDocument.model_validate({**document, **added}))
    camera, tag = rig.camera(), rig.platform_tags[0]
    camera_from_tag = camera.world_from_camera.inverse().compose(rig.home.compose(tag.pose))
    x, y, z = camera_from_tag.position
    u, v, _ = camera.matrix @ (x / z, y / z, 1.0)
    assert z > 1.0
    assert abs(u - camera.width / 2.0) < 300.0
    assert abs(v - camera.height / 2.0) < 200.0
    assert camera_from_tag.rotation[2, 2] < -0.9, "it faces the camera"
    np.testing.assert_allclose(camera_from_tag.rotation[:, 1], [0, -1, 0], atol=1e-9)


def test_a_jog_of_one_cable_takes_as_long_as_commissioning_says() -> None:
    page = (ROOT / "docs" / "commissioning.md").read_text("utf-8")
    rig = load_rig(ROOT / "configs" / "gachon_8_6.yaml")
    rows = re.findall(
        r"^\| ([\d.]+) N.* \| (\d+) \| ([\d.]+) s \| ([\d.]+) s \|$", page, re.MULTILINE
    )
    assert len(rows) >= 3
    for pull, limit_n, *durations in rows:
        limit = limit_of(rig, float(limit_n))
        for length, said in zip((0.005, 0.05), durations, strict=True):
            law = CableStep(
                rig, [0] * rig.cable_count, cable=0, length=length, limit=limit, speed=SPEED
            )
            cycles = 0
            while not law.done:
                law.next(1.0, [float(pull)] + [0.0] * (rig.cable_count - 1))
                cycles += 1
            assert cycles * rig.cycle == pytest.approx(float(said), rel=0.03)


def fall(ms: int) -> str:
    """How far a body falls from rest."""
    return f"{500.0 * STANDARD_GRAVITY * (ms / 1000.0) ** 2:.1f} mm in {ms} ms"


def percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def eight_drives(cycle_ms: int) -> str:
    return percent(bus_load(8, cycle_ms / 1000.0, 1_000_000))


@pytest.mark.parametrize(
    ("page", "words"),
    [
        ("safety.md", f"from rest by {fall(15)}, {fall(30)} and {fall(50)}"),
        (
            "console.md",
            f"{percent(RESERVE)} of the range from half of `min_tension_n` to the limit, but at"
            f" least the tension of {RESERVE_COUNTS:g} counts and at most {percent(MOST_RESERVE)}",
        ),
        (
            "planner.md",
            f"A round makes {anytime_path._TRIALS} small random changes to one of them"
            f" ({anytime_path._SLOW_TRIALS} for a rig with pulleys",
        ),
        (
            "rig-file.md",
            f"need {eight_drives(10)} of 1 Mbit/s at 10 ms and {eight_drives(4)} at 4 ms",
        ),
        (
            "rig-file.md",
            f"without the section `{RigDocument.model_fields['drives'].default.type}`",
        ),
        (
            "safety.md",
            f"exit code {BadInput.exit_code}, {Refused.exit_code} or {HardwareMissing.exit_code},"
            f" or with {Fault.exit_code} if a process of the program itself fails",
        ),
        ("your-own-rig.md", f"at most {LONGEST_MM:g} mm at a time"),
    ],
)
def test_a_page_repeats_what_the_program_does(page: str, words: str) -> None:
    assert words in " ".join((ROOT / "docs" / page).read_text("utf-8").split())


def test_the_page_on_python_lists_the_verbs_that_have_a_function() -> None:
    page = (ROOT / "docs" / "from-python.md").read_text("utf-8")
    functions, _, rest = page.split("```")[0].partition("; others")
    with_a_function = {verb.name for verb in VERBS} & set(cdpr.__all__)
    assert set(re.findall(r"`(\w+)`", functions)) == with_a_function
    assert not set(re.findall(r"`(?:cdpr )?(\w+)`", rest)) & with_a_function


def test_the_page_on_a_new_rig_lists_what_no_question_asks_for() -> None:
    page = " ".join((ROOT / "docs" / "your-own-rig.md").read_text("utf-8").split())
    listed = page.split("It does not ask for")[1].partition(" of each winch")[0]
    asked = {question.key for question in (*BEFORE_COORDINATES, *AFTER_COORDINATES)}
    asked |= {"size_mm", "home", "drum_mm_per_rev"}  # by other names
    asked |= set(parse_yaml(rig_text(collect_answers("rig", {}))).data)
    measured_later = {"home_counts", "cable_stiffness_n"}
    measured_later |= {"outlets_error_mm", "anchors_error_mm", "platform_error_mm"}
    of_no_robot = {"description", "simulation"}
    parts = (RigDocument, PlatformDocument, CableDocument, WinchDocument)
    of_a_rig = set().union(*(part.model_fields for part in parts))
    assert set(re.findall(r"`(\w+)`", listed)) == of_a_rig - asked - measured_later - of_no_robot


def test_commissioning_writes_no_file_twice() -> None:
    page = (ROOT / "docs" / "commissioning.md").read_text("utf-8")
    written = re.findall(r"-o (\S+?)[`\s]", page)
    assert len(written) > 5
    assert len(set(written)) == len(written)


OURS = re.compile(
    r"\b(?:tests|benchmarks|tools|examples|executor|planner|model)/[\w/]+\.(?:py|js)\b"
)


@pytest.mark.parametrize(
    "page", ["README.md", "CONTRIBUTING.md", *ROOT.glob("docs/**/*.md")], ids=str
)
def test_every_file_that_a_page_names_is_there(page: str | Path) -> None:
    named = set(OURS.findall((ROOT / page).read_text("utf-8")))
    assert sorted(name for name in named if not (ROOT / name).exists()) == []


PUBLIC = [
    getattr(module, name)
    for module in map(importlib.import_module, PACKAGES)
    for name in module.__all__
]
CLASSES: dict[str, Any] = {
    each.__name__: each
    for each in (*PUBLIC, Camera, Motion, Tag, Winch)
    if isinstance(each, type) and is_dataclass(each)
}


def listed_attributes(owner: type) -> list[str]:
    """Names in the section `Attributes:` of a docstring, in its order."""
    _, _, section = inspect.cleandoc(owner.__doc__ or "").partition("Attributes:\n")
    return re.findall(r"^    (\w+):", section.partition("\n\n")[0], re.MULTILINE)


@pytest.mark.parametrize("name", sorted(CLASSES))
def test_the_attributes_of_a_public_class_are_its_fields(name: str) -> None:
    """The API pages print this list; editors show it."""
    owner = CLASSES[name]
    passed_on = {"proof"}  # only by the function that proves the object
    names = {field.name for field in fields(owner) if not field.name.startswith("_")}
    listed = [name for part in owner.__mro__ for name in listed_attributes(part)]
    assert sorted(listed) == sorted(names - passed_on)
