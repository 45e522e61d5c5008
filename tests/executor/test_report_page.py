"""The page of a run: complete, self-contained, explicit about unknown values."""

from __future__ import annotations

import json
import re
from dataclasses import fields, replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from executor.recording.clearance import no_clearance
from executor.recording.record_files import CameraRecord
from executor.recording.run_folder import RunEvent, RunFolder
from executor.recording.summary import versions
from executor.recording.tables import CycleTable, PoseTable
from executor.report import build_report
from executor.report.run_data import read_run
from executor.report.tiles import camera_table, chips
from model.errors import BadInput
from model.files.rig_file import PulleysDocument
from model.files.scene_file import SceneDocument
from model.kinematics import cables_to
from model.plan import Plan, plan_facts, plan_from_document, sealed
from model.rig import rig_from_document
from model.scene import scene_from_document
from tests.executor import fake_run

SVG_LINKS = {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"}


class Page(HTMLParser):
    """Elements of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.text = text
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.headings: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        self.open.append(f"/{tag}")

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] in ("h1", "h2"):
            self.headings.append(data)

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


@pytest.fixture(scope="module")
def run() -> fake_run.FakeRun:
    return fake_run.make(rate_hz=2.0, every=20)


def built(run: fake_run.FakeRun, path: Path, pictures: bool = False) -> Page:
    folder = fake_run.write(run, path, pictures)
    return Page(build_report(RunFolder.open(folder.path)).read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def page(run: fake_run.FakeRun, tmp_path_factory: pytest.TempPathFactory) -> Page:
    return built(run, tmp_path_factory.mktemp("page") / "run", pictures=True)


def test_an_image_taken_just_before_the_start_is_at_zero(
    run: fake_run.FakeRun, tmp_path: Path
) -> None:
    """By the camera's latency."""
    early = replace(run, poses=replace(run.poses, time=run.poses.time - 0.02))
    page = built(early, tmp_path / "run", pictures=True)
    assert "<b>0.0 s</b>" in page.text
    assert "-0.0 s" not in page.text


def test_the_verdict_comes_first_and_every_section_is_there(page: Page) -> None:
    assert page.headings == [
        "Run of environment_3 on gachon_8_6",
        "PASSED",
        "Scene and path",
        "Clearance",
        "Position",
        "Images",
        "Cables",
        "Following and timing",
        "Plan, rig and bus",
        "Events",
    ]


def test_the_plan_is_described_in_the_words_of_cdpr_plan(page: Page, run: fake_run.FakeRun) -> None:
    document = run.context.plan.document
    facts = dict(plan_facts(document))
    found = re.search(r"<th[^>]*>Length</th><td[^>]*>(.*?)</td>", page.text)
    assert found
    length, first = found[1].split(" (")
    assert facts["length"].startswith(f"{length} ({len(document.waypoints)} waypoints;")
    assert facts["length"].endswith(f" {first}")
    assert re.search(rf"<th[^>]*>Waypoints</th><td[^>]*>{len(document.waypoints)}</td>", page.text)


def test_nothing_is_asked_from_outside(page: Page) -> None:
    """A lab's machine has no network, and opening a report must make no request."""
    assert set(re.findall(r"https?://[^\s\"'<)]+", page.text)) <= SVG_LINKS
    for tag, attributes in page.tags:
        assert tag not in {"link", "iframe", "object", "base"}
        for name in ("src", "href", "xlink:href", "action"):
            value = attributes.get(name) or ""
            assert not value or value.startswith(("#", "data:image/jpeg;base64,")), (tag, value)
    assert "@import" not in page.text
    (policy,) = [m for m in page.all("meta") if m.get("http-equiv") == "Content-Security-Policy"]
    assert "default-src 'none'" in (policy["content"] or "")


def test_ids_are_unique_and_links_lead_somewhere(page: Page) -> None:
    ids = [a["id"] for _, a in page.tags if a.get("id")]
    assert len(ids) == len(set(ids))
    wanted = [a.get("href") or a.get("xlink:href") or "" for _, a in page.tags]
    wanted += [f"#{name}" for name in re.findall(r"url\(#([^)]+)\)", page.text)]
    missing = {name for name in wanted if name.startswith("#")} - {f"#{i}" for i in ids}
    assert not missing


def test_every_image_says_what_it_shows(page: Page) -> None:
    assert len(page.all("img")) == 5
    assert all(len(image["alt"] or "") > 10 for image in page.all("img"))
    figures = [svg for svg in page.all("svg") if svg.get("role") == "img"]
    assert len(figures) >= 18
    assert all(len(svg["aria-label"] or "") > 40 for svg in figures)


def test_figures_take_their_colours_from_the_page(page: Page) -> None:
    """A matplotlib colour would be wrong in one of the two colour schemes."""
    figures = "".join(re.findall(r"<svg.*?</svg>", page.text, re.DOTALL))
    used = set(re.findall(r"(?<!dasharray:)var\(--([\w]+)\)", figures))
    defined = set(re.findall(r"--([\w]+):", page.text))
    assert used >= {"ink", "encoder", "tag", "limit", "obstacle", "platform", "cable", "tree"}
    assert used <= defined
    assert not re.findall(r"(?:fill|stroke): #(?!ffffff)[0-9a-f]{6}", figures)
    dark = page.text[page.text.index("prefers-color-scheme: dark") :]
    assert used - {"surface"} <= set(re.findall(r"--([\w]+):", dark))


def test_the_page_is_small(page: Page) -> None:
    assert len(page.text) < 6_000_000


def scene_data(page: Page) -> dict[str, object]:
    found = re.search(r'<script type="application/json" id="scene-data">(.*?)</script>', page.text)
    assert found
    data = json.loads(found[1])
    assert isinstance(data, dict)
    return data


def test_the_viewer_moves_the_platform_as_the_drives_did(page: Page, run: fake_run.FakeRun) -> None:
    data = scene_data(page)
    moments = data["moments"]
    assert isinstance(moments, list)
    assert moments[0]["t"] == 0.0
    assert moments[-1]["t"] == pytest.approx(run.cycles.time[-1], abs=1e-3)
    for moment in moments[:: len(moments) // 7]:
        row = int(np.argmin(np.abs(run.cycles.time - moment["t"])))
        np.testing.assert_allclose(moment["p"], run.cycles.encoder[row] * 1e3, atol=0.051)
    (tree,) = [stroke for stroke in data["strokes"] if stroke["layer"] == "tree"]  # type: ignore[attr-defined]
    assert len(tree["segments"]) == 399


def test_texts_of_files_cannot_become_markup(tmp_path: Path, run: fake_run.FakeRun) -> None:
    evil = "</script><script>alert(1)</script><img src=x onerror=alert(1)>"
    document = run.context.plan.document
    scene = document.scene.model_dump(mode="json")
    scene["name"] = scene["obstacles"][0]["name"] = evil
    context = fake_run.changed(
        run.context,
        plan=with_scene(run, SceneDocument.model_validate(scene)),
        interface=evil,
        final_state="latched",
        events=(RunEvent(0.0, evil, evil),),
        versions={evil: evil},
    )
    names = (evil, *run.clearance.obstacles[1:])
    clearance = replace(run.clearance, obstacles=names, obstacle=(evil,) * len(run.clearance))
    page = built(replace(run, context=context, clearance=clearance), tmp_path / "run")
    programs = [s for s in page.all("script") if s.get("type") != "application/json"]
    assert len(programs) == 3
    assert "alert(1)</script>" not in page.text
    assert not page.all("img")
    assert not [a for _, a in page.tags if "onerror" in a]


def with_scene(run: fake_run.FakeRun, scene: SceneDocument) -> Plan:
    document = run.context.plan.document
    parts = {name: getattr(document, name) for name in type(document).model_fields}
    parts = {k: v for k, v in parts.items() if k not in ("hash", "kind", "schema_version")}
    parts |= {"scene": scene, "scene_hash": scene_from_document(scene).hash}
    return plan_from_document(sealed(parts))


def test_a_run_without_camera_has_no_camera_section(tmp_path: Path, run: fake_run.FakeRun) -> None:
    only = replace(run, poses=PoseTable.empty(), clearance=run.clearance.of("encoder"))
    page = built(only, tmp_path / "run")
    assert "Images" not in page.headings
    assert "Clearance" in page.headings
    assert "no camera" in page.text


def test_a_camera_without_images_is_not_called_no_camera(run: fake_run.FakeRun) -> None:
    summary = {**run.summary, "tag_error_mm": None}
    assert "no camera" in chips(summary)
    failed = {"name": "ceiling", "pictures": 0, "failed": "it was unplugged"}
    found = chips({**summary, "cameras": [failed]})
    assert "no camera" not in found
    assert "camera without images" in found
    killed = chips({**summary, "final_state": "not_ended"})  # its cameras are not on record
    assert "camera" not in killed


def test_each_camera_is_compared_with_the_plan_by_the_same_images_as_all(
    tmp_path: Path, run: fake_run.FakeRun
) -> None:
    """Before the path the platform may be beside the start: it is not along the plan yet."""
    waits = run.cycles.time < 5.0
    states = tuple("enabling" if wait else "moving" for wait in waits)
    off = np.where(run.poses.time < 5.0, 0.8, 0.0)[:, None] * [1e-3, 0.0, 0.0]
    poses = replace(run.poses, position=run.poses.position + off)
    used = (
        CameraRecord("front", "0", 9, 9, 0, 2.0, ""),
        CameraRecord("blind", "1", 0, 0, 9, None, ""),
    )
    made = replace(
        run,
        cycles=replace(run.cycles, state=states),
        poses=poses,
        context=fake_run.changed(run.context, cameras=used),
    )
    folder = fake_run.write(made, tmp_path / "run", pictures=False)
    for camera, table in (("front", poses), ("blind", PoseTable.empty())):
        folder.write_table(f"poses-{camera}.csv", table)
    rms = made.summary["tag_error_mm"]["rms"]  # type: ignore[index]
    rows = re.findall(r"<tr>(.*?)</tr>", camera_table(read_run(folder)))
    assert f"{rms:.2f} mm RMS" in rows[1]
    assert "RMS" not in rows[2]
    assert f"{rms:.2f}" != f"{1e3 * np.sqrt(np.nanmean(poses.error**2)):.2f}"


def test_the_page_names_its_maker_and_the_program_that_ran(
    tmp_path: Path, run: fake_run.FakeRun
) -> None:
    own = versions()["cdpr"]
    for name, ran, made in (
        ("own", own, f"Made by cdpr {own} from"),
        ("older", "0.0.1", f"Run with cdpr 0.0.1; page made by cdpr {own} from"),
    ):
        context = fake_run.changed(run.context, versions={"cdpr": ran})
        page = built(replace(run, context=context), tmp_path / name)
        assert f"<footer>{made} the files of the run folder" in page.text


def test_a_scene_without_obstacles_reports_it(tmp_path: Path, run: fake_run.FakeRun) -> None:
    scene = run.context.plan.document.scene.model_copy(update={"obstacles": []})
    context = replace(run.context, plan=with_scene(run, scene))
    empty = replace(run, context=context, poses=PoseTable.empty(), clearance=no_clearance())
    page = built(empty, tmp_path / "run")
    assert "The scene has no obstacles." in page.text
    assert "Smallest clearance" not in page.text


def test_a_run_that_ended_before_its_first_cycle_still_has_a_page(
    tmp_path: Path, run: fake_run.FakeRun
) -> None:
    none = CycleTable(**{f.name: getattr(run.cycles, f.name)[:0] for f in fields(CycleTable)})
    context = fake_run.changed(run.context, final_state="latched", fast=False)
    early = replace(
        run, context=context, cycles=none, poses=PoseTable.empty(), clearance=no_clearance()
    )
    page = built(early, tmp_path / "run")
    assert page.headings[1] == "FAILED"
    assert "Position" not in page.headings
    assert scene_data(page)["moments"] == []


def test_a_run_in_real_time_shows_its_lateness(tmp_path: Path, run: fake_run.FakeRun) -> None:
    late = np.abs(np.random.default_rng(5).normal(0.0, 1e-4, len(run.cycles)))
    cycles = replace(run.cycles, lateness=late)
    real = {"fast": False, "simulated": False, "interface": "socketcan"}
    context = fake_run.changed(run.context, **real)
    page = built(replace(run, cycles=cycles, context=context), tmp_path / "run")
    assert "Lateness of the cycles" in page.text
    assert "real drives, bus socketcan" in page.text
    assert "Simulated time" not in page.text


def test_replies_that_never_came_leave_gaps_not_errors(
    tmp_path: Path, run: fake_run.FakeRun
) -> None:
    tensions, encoder = run.cycles.tensions.copy(), run.cycles.encoder.copy()
    tensions[:, 2] = np.nan
    encoder[5:9] = np.nan
    missing = run.cycles.missing.copy()
    missing[5:9] = 8
    cycles = replace(run.cycles, tensions=tensions, encoder=encoder, missing=missing)
    page = built(replace(run, cycles=cycles), tmp_path / "run")
    assert page.headings[1] == "FAILED"
    assert "NaN" not in json.dumps(scene_data(page))


def test_cables_over_pulleys_leave_them_where_the_model_says(
    tmp_path: Path, run: fake_run.FakeRun
) -> None:
    pulleys = PulleysDocument(radius_mm=13.0, feed_directions=[[0.0, 0.0, 1.0]] * 8)
    rig = rig_from_document(run.context.rig.document.model_copy(update={"pulleys": pulleys}))
    page = built(replace(run, context=replace(run.context, rig=rig)), tmp_path / "run")
    moment = scene_data(page)["moments"][0]  # type: ignore[index]
    exits = cables_to(rig, run.cycles.encoder[0] + rig.anchors).exits
    np.testing.assert_allclose(moment["exits"], exits * 1e3, atol=0.051)


def test_the_report_is_made_from_the_folder_alone(tmp_path: Path, run: fake_run.FakeRun) -> None:
    folder = fake_run.write(run, tmp_path / "run")
    first = build_report(folder).read_bytes()
    moved = folder.path.rename(tmp_path / "moved and renamed")
    (moved / "report.html").unlink()
    assert build_report(RunFolder.open(moved)).read_bytes() == first


def test_an_incomplete_folder_gets_no_page(tmp_path: Path, run: fake_run.FakeRun) -> None:
    folder = fake_run.write(run, tmp_path / "run", pictures=False)
    (folder.path / "cycles.csv").unlink()
    with pytest.raises(BadInput, match="no such file"):
        build_report(folder)
    assert not folder.report.exists()


def test_an_error_too_small_for_its_digits_is_not_shown_as_zero(
    tmp_path: Path, run: fake_run.FakeRun
) -> None:
    exact = replace(run.cycles, following_error=np.full(len(run.cycles), 1e-8))
    page = built(replace(run, cycles=exact), tmp_path / "run")
    assert "&lt;\u00a00.001\u00a0<small>mm" in page.text
    assert "No cable was more than 0.001\u00a0mm off" in page.text
