"""Charts and scene of a page in a real browser: from a folder, by WebGL and without it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect

from model.pages.charts import Chart, ChartLine, charts
from model.pages.page import page as html_page
from model.pages.page import paragraph, section
from model.pages.scene import Moment
from model.pages.viewer import SCENE_SCRIPTS, page_data, viewer
from tests.console import browsing
from tests.console.browsing import NO_WEBGL, painted
from tests.console.fake_server import RIG, figure, on_circle

pytestmark = [pytest.mark.browser, pytest.mark.slow]
LAYERS = [
    ("obstacles", "Obstacles", "obstacle", True),
    ("robot", "Platform", "platform", True),
    ("numbers", "Cable numbers", "ink", True),
    ("path", "Path", "ink", True),
]
#: Counts what is drawn, and buffers that are kept, of all WebGL on the page.
COUNTED = """window.count = { drawn: 0, kept: 0 };
const watched = [["clear", "drawn", 1], ["createBuffer", "kept", 1], ["deleteBuffer", "kept", -1]];
for (const [name, of, by] of watched) {
  const known = WebGL2RenderingContext.prototype[name];
  WebGL2RenderingContext.prototype[name] = function (...given) {
    count[of] += by;
    return known.apply(this, given);
  };
}"""
FRAMES = "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"

#: Buffers kept after each of six pictures, of a scene whose parts are replaced by others.
REPLACED = """async () => {
  const stage = document.createElement("div"), canvas = document.createElement("canvas");
  stage.className = "stage";
  document.body.append(stage);
  stage.append(canvas);
  const data = JSON.parse(document.getElementById("scene-data").textContent), kept = [];
  const view = sceneViewer(canvas, data);
  for (let k = 0; k < 6; k++) {
    const { surfaces, strokes } = structuredClone(data);
    view.update({ surfaces, strokes });
    view.show(data.moments[k]);
    await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
    kept.push(count.kept);
  }
  return kept;
}"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with browsing.browser_at(browsing.chromium()) as browser:
        yield browser


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page as reports are, with the platform at moments of its way."""
    moments = tuple(
        Moment(float(k), on_circle(k / 12), np.eye(3), RIG.outlets, f"moment {k}")
        for k in range(12)
    )
    rig, plan = figure(moments), figure(path=True)
    scene = replace(rig, strokes=(*rig.strokes, *plan.strokes), labels=plan.labels)
    body = viewer(scene, "The rig.", LAYERS)
    text = html_page("Scene", body, scripts=SCENE_SCRIPTS, data=page_data(scene))
    path = tmp_path_factory.mktemp("page of its own") / "report.html"
    path.write_text(text, encoding="utf-8")
    return path


@contextmanager
def opened(browser: Browser, path: Path, script: str = COUNTED, **more: Any) -> Iterator[Page]:
    """The page as a file; fails when it logs an error or asks for anything but itself."""
    context = browser.new_context(viewport={"width": 900, "height": 800}, **more)
    context.add_init_script(script)
    page = context.new_page()
    wrong: list[str] = []
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on("console", lambda m: wrong.append(m.text) if m.type == "error" else None)
    page.on("request", lambda request: wrong.append(request.url))
    page.goto(path.as_uri())
    expect(page.locator("#scene-readout")).to_contain_text("moment 0")
    page.evaluate(FRAMES)
    yield page
    context.close()
    assert wrong == [path.as_uri()]


def test_a_hash_in_a_sentence_does_not_widen_the_page_of_a_phone(
    browser: Browser, tmp_path: Path
) -> None:
    """As in the pages of workspace maps: of rig and scene, 64 digits each."""
    path, words = tmp_path / "page.html", f"Rig six, hash {'0123456789abcdef' * 4}; no scene."
    body = section("about", "About", paragraph(words), f"<ul><li>{words}</li></ul>")
    path.write_text(html_page("Maps", body, lead=words))
    page = browser.new_page(viewport={"width": 390, "height": 800})
    page.goto(path.as_uri())
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    page.close()


@pytest.mark.parametrize("points", [101, 400_000])
def test_a_chart_of_any_length_is_zoomed_and_read(
    browser: Browser, tmp_path: Path, points: int
) -> None:
    """Too many arguments of a function ended the zoom half-way."""
    time = np.linspace(0.0, 10.0, points)
    line = ChartLine("wave", time, np.where(time < 7.0, time, 70.0), "encoder")
    chart = Chart("Wave", "A wave.", "height", "mm", (line,), (0.0, 10.0))
    path = tmp_path / "page.html"
    path.write_text(html_page("Charts", charts(chart, chart), scripts=("charts.js",)))
    page, wrong = browser.new_page(), list[str]()
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.goto(path.as_uri())
    area = page.locator(".plot svg[role=img]").first.bounding_box()
    assert area is not None
    middle = area["y"] + area["height"] / 2.0
    for share in (0.2, 0.6):
        page.mouse.move(area["x"] + share * area["width"], middle)
        page.mouse.down() if share == 0.2 else page.mouse.up()
    expect(page.locator(".plot.zoomed")).to_have_count(2)
    page.mouse.move(area["x"] + 0.5 * area["width"], middle)
    expect(page.locator(".readout").first).to_contain_text("4.0")
    highest = page.locator(".plot").first.locator("text.y").last.text_content()
    assert float(highest or "nan") <= 7.0
    page.close()
    assert wrong == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_scene_is_drawn_from_a_folder_and_asks_for_nothing(
    browser: Browser, path: Path, scheme: Any
) -> None:
    with opened(browser, path, color_scheme=scheme) as page:
        for role, least in (("obstacle", 500), ("platform", 300), ("cable", 300), ("ink", 300)):
            assert painted(page, role) > least, role
        expect(page.locator(".still")).to_be_hidden()


@pytest.mark.parametrize(
    ("title", "role"), [("Obstacles", "obstacle"), ("Platform", "platform"), ("Path", "ink")]
)
def test_a_layer_is_hidden_and_shown(browser: Browser, path: Path, title: str, role: str) -> None:
    with opened(browser, path) as page:
        page.get_by_role("checkbox", name="Cable numbers").uncheck()
        before = painted(page, role)
        page.get_by_role("checkbox", name=title).uncheck()
        page.evaluate(FRAMES)
        assert painted(page, role) < before / 2
        page.get_by_role("checkbox", name=title).check()
        page.evaluate(FRAMES)
        assert painted(page, role) == pytest.approx(before, rel=0.1)


def boxes_of_texts(page: Page) -> dict[str, dict[str, float]]:
    shown = [word for word in page.locator(".texts b").all() if word.is_visible()]
    return {word.inner_text(): dict(word.bounding_box() or {}) for word in shown}


def test_texts_keep_their_size_and_lie_beside_each_other(browser: Browser, path: Path) -> None:
    with opened(browser, path) as page:
        before = boxes_of_texts(page)
        assert set(before) == {"obstacle_1", "start", *(str(k) for k in range(1, 9))}
        stage = page.locator(".stage").bounding_box()
        assert stage
        for one in before.values():
            assert stage["x"] <= one["x"] <= stage["x"] + stage["width"] - one["width"]
            assert stage["y"] <= one["y"] <= stage["y"] + stage["height"] - one["height"]
        for one, other in combinations(before.values(), 2):
            apart_x = (
                one["x"] + one["width"] <= other["x"] or other["x"] + other["width"] <= one["x"]
            )
            assert apart_x or abs(one["y"] - other["y"]) >= 13.5
        page.locator("#scene-in").click()
        page.evaluate(FRAMES)
        after = boxes_of_texts(page)
        assert after["start"]["width"] == pytest.approx(before["start"]["width"])
        assert after["start"]["x"] != before["start"]["x"]


def test_the_scene_is_drawn_only_when_something_changes(browser: Browser, path: Path) -> None:
    with opened(browser, path) as page:
        page.wait_for_timeout(300)
        before = page.evaluate("count.drawn")
        page.wait_for_timeout(500)
        assert page.evaluate("count.drawn") == before
        page.locator("#scene-canvas").focus()
        page.keyboard.press("ArrowLeft")
        page.evaluate(FRAMES)
        assert page.evaluate("count.drawn") > before


def test_what_is_replaced_is_disposed_of(browser: Browser, path: Path) -> None:
    """The console puts plans into the scene for days."""
    with opened(browser, path) as page:
        kept = page.evaluate(REPLACED)
        assert kept[1:] == [kept[1]] * 5


def test_without_webgl_the_still_image_is_shown_with_a_message(
    browser: Browser, path: Path
) -> None:
    with opened(browser, path, NO_WEBGL) as page:
        expect(page.locator(".without")).to_contain_text("needs WebGL 2")
        expect(page.locator(".still")).to_be_visible()
        expect(page.locator("#scene-canvas")).to_be_hidden()
        expect(page.locator("#scene-play")).to_be_hidden()
