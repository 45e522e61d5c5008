"""The one style of every page: self-contained, escaped, complete without scripts."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from model.pages.charts import Chart, ChartLine, Span, charts, ticks
from model.pages.page import bullets, list_table, page, picture, resource, section, table, tile
from model.pages.scene import (
    Label,
    Moment,
    SceneFigure,
    SceneSurface,
    Stroke,
    arrows,
    frame_surface,
    grid_floor,
)
from model.pages.viewer import SCENE_SCRIPTS, page_data, still_image, viewer
from model.pose import Array, matrix_from_rotation_vector
from tests.model.rig_builds import hall_rig, paper_rig

EVIL = "</script><script>alert(1)</script><img src=x onerror=alert(1)> & \"'"


class Reader(HTMLParser):
    """Tags with their attributes, and whether all were closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "img", "br", "input"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


def chart_of(y: Array, **more: object) -> Chart:
    x = np.linspace(0.0, 10.0, len(y))
    line = ChartLine(EVIL, x, y, "encoder", band=(y - 1.0, y + 1.0))
    return Chart(
        EVIL, EVIL, EVIL, "mm", (line,), (0.0, 10.0), spans=(Span(2.0, 3.0, EVIL),), **more
    )  # type: ignore[arg-type]


def scene_of(name: str) -> SceneFigure:
    box = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (0.0, 1.0)])
    solid = SceneSurface("obstacles", "obstacle", box, ((0, 1, 3, 2),), ((0, 1), (2, 3)), name=name)
    platform = SceneSurface("robot", "platform", 0.1 * box, ((0, 1, 3, 2),), ((0, 1),))
    path = Stroke.along("path", "ink", np.array([[0.0, 0.0, 0.5], [0.5, 0.0, 0.5]]), 4.0)
    moments = tuple(
        Moment(float(k), np.array([0.5 * k, 0.0, 0.5]), np.eye(3), box[:3], name) for k in range(2)
    )
    labels = (Label("path", name, np.zeros(3), "ring"),)
    return SceneFigure(
        (solid,), (grid_floor(box)[0], path), labels, 0.1 * box[:3], platform, moments
    )


def whole() -> str:
    scene = scene_of(EVIL)
    parts = [
        section("one", EVIL, table([(EVIL, EVIL)]), list_table([EVIL], [[EVIL]])),
        tile(EVIL, EVIL, EVIL),
        picture("a.png", EVIL),
        charts(chart_of(np.arange(5.0))),
        viewer(scene, EVIL, [("path", EVIL, "ink", True)], EVIL),
    ]
    scripts = ("charts.js", *SCENE_SCRIPTS)
    return page(EVIL, "".join(parts), scripts=scripts, data=page_data(scene))


def test_bullets_show_commands_and_options_as_code() -> None:
    """An option broken after its two dashes reads as another word."""
    shown = bullets(["pass --calibration, or `cdpr run P --fast` <i>"])
    assert '<code class="option">--calibration</code>, or' in shown
    assert "<code>cdpr run P --fast</code> &lt;i&gt;" in shown


def test_drawings_scroll_within_themselves_on_a_phone() -> None:
    """Nine maps in 340 px of width would have numbers of 3 px."""
    assert picture("a.png", "maps").startswith('<div class="scroll drawn" tabindex="0">')
    assert re.search(
        r"max-width: 560px.*\.drawn img\.paper \{ width: \d{3}px", resource("base.css"), re.S
    )


def test_a_page_fits_a_phone_and_requests_nothing_from_outside() -> None:
    text = whole()
    reader = Reader(text)
    assert reader.open == []
    (viewport,) = [m for m in reader.all("meta") if m.get("name") == "viewport"]
    assert viewport["content"] == "width=device-width, initial-scale=1"
    (policy,) = [m for m in reader.all("meta") if m.get("http-equiv")]
    assert (policy["content"] or "").startswith("default-src 'none'")
    assert "@import" not in text
    # The one address is a name: of SVG's elements, in the script that makes them.
    assert set(re.findall(r"https?://[^\s\"'<)]+", text)) == {"http://www.w3.org/2000/svg"}
    assert not re.findall(r"url\(", text)


def test_no_text_becomes_markup() -> None:
    text = whole()
    reader = Reader(text)
    programs = [s for s in reader.all("script") if s.get("type") != "application/json"]
    assert len(programs) == 3
    assert len(reader.all("img")) == 1
    assert not [a for _, a in reader.tags if "onerror" in a]
    for found in re.findall(r'<script type="application/json"[^>]*>(.*?)</script>', text, re.S):
        json.loads(found)


def test_every_figure_says_what_it_shows() -> None:
    for figure in Reader(whole()).tags:
        if figure[0] in ("canvas", "svg") and figure[1].get("role") == "img":
            assert figure[1]["aria-label"]


def test_colours_are_defined_for_light_and_dark() -> None:
    style = resource("base.css")
    light, dark = (
        set(re.findall(r"--([\w-]+):", part))
        for part in style.split("@media screen and (prefers-color-scheme: dark)")
    )
    assert light - {"dashed", "dotted", "dash-dotted"} == dark - {"of"}


def luminance(colour: str) -> float:
    """As WCAG 2.2 defines it."""
    parts = np.array([*bytes.fromhex(colour.lstrip("#"))]) / 255.0
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def test_lines_have_the_contrast_that_wcag_asks_for_of_graphics() -> None:
    for part in resource("base.css").split("prefers-color-scheme: dark"):
        colours = dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6});", part))
        for name in (*(f"series{k + 1}" for k in range(8)), "encoder", "tag", "limit", "planned"):
            low, high = sorted(luminance(colours[one]) for one in (name, "surface"))
            assert (high + 0.05) / (low + 0.05) >= 3.0, name


def test_scripts_are_small_and_ask_for_nothing() -> None:
    assert len(resource("charts.js").splitlines()) <= 150
    for name in ("charts.js", *SCENE_SCRIPTS):
        assert not re.findall(r"\b(fetch|import|XMLHttpRequest|eval|innerHTML)\b", resource(name))


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6))
def test_ticks_are_few_and_within(low: float, span: float) -> None:
    found = ticks(low, low + span)
    assert 1 <= len(found) <= 8
    assert all(low - 1e-6 * span <= value <= low + span * (1 + 1e-6) for value in found)


def data_of(text: str) -> dict[str, object]:
    found = re.search(r'<script type="application/json">(.*?)</script>', text, re.S)
    assert found
    data = json.loads(found[1])
    assert isinstance(data, dict)
    return data


@pytest.mark.parametrize(
    "y", [np.zeros(5), np.full(5, np.nan), np.array([1.0, np.nan, 2.0, 3.0, 3.0]), np.ones(1)]
)
def test_a_chart_of_any_values_is_drawn_with_gaps_and_no_nan(y: Array) -> None:
    text = charts(chart_of(y))
    assert "nan" not in text.lower().replace(EVIL, "")
    (line,) = data_of(text)["lines"]  # type: ignore[misc]
    assert [v is None for v in line["y"]] == np.isnan(y).tolist()


def test_the_chart_and_the_data_of_its_script_agree() -> None:
    text = charts(chart_of(np.array([2.0, 4.0, 8.0]), from_zero=True))
    low, high = data_of(text)["y"]  # type: ignore[misc]
    path = re.findall(r'<path d="([^"Z]*)" fill="none"', text.split('class="lines"')[1])[0]
    drawn = [float(point.split()[1]) for point in path[1:].split("L")]
    assert [high - v / 1000.0 * (high - low) for v in drawn] == pytest.approx([2, 4, 8], abs=1e-2)


def test_a_line_that_does_not_fit_leaves_the_range_unchanged() -> None:
    far = ChartLine("limit", np.array([0.0, 10.0]), np.array([100.0, 100.0]), "limit", fits=False)
    near = ChartLine("", np.array([0.0, 10.0]), np.array([1.0, 2.0]), "ink")
    chart = Chart("t", "a", "q", "mm", (near, far), (0.0, 10.0))
    assert data_of(charts(chart))["y"] == pytest.approx([0.94, 2.06])


def test_the_still_scene_holds_all_its_points() -> None:
    """Cropped at no side, with the platform at its first moment."""
    text = still_image(scene_of("box"), "a box")
    box = re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', text)
    assert box
    width, height = map(float, box.groups())
    points = np.array(re.findall(r"[ML]([-\d.]+) ([-\d.]+)", text), dtype=float)
    assert points.min() >= 0.0
    assert points[:, 0].max() <= width
    assert points[:, 1].max() <= height
    assert [f">{k}</text>" in text for k in (1, 2, 3)] == [True] * 3


def test_the_floor_is_below_everything_with_round_lines() -> None:
    points = np.array([[-0.61, 0.0, 0.2], [0.58, 0.9, 1.2]])
    floor, step = grid_floor(points)
    assert step == pytest.approx(0.1)
    assert floor.segments[..., 2].max() == 0.0
    ends = floor.segments.reshape(-1, 3)
    assert np.all(ends[:, :2].min(axis=0) <= points[0, :2] + 1e-9)
    assert np.all(ends[:, :2].max(axis=0) >= points[1, :2] - 1e-9)
    sunk, _ = grid_floor(points - [0.0, 0.0, 1.0])
    assert sunk.segments[..., 2].max() == pytest.approx(-0.8)


def test_arrows_begin_and_end_where_they_are_given_and_vanish_without_length() -> None:
    ends = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    found = arrows("a", "limit", np.zeros((2, 3)), ends).segments
    assert len(found) == 5
    np.testing.assert_allclose(found[0], [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    np.testing.assert_allclose(found[1:, 0], np.tile([1.0, 0.0, 0.0], (4, 1)))


def test_on_paper_nothing_is_shown_that_only_a_screen_can_use() -> None:
    style = resource("base.css")
    assert style.count("{") == style.count("}")
    screen, paper = style.split("@media print {")
    hidden = [
        selector.strip()
        for selectors in re.findall(r"([^{}]+)\{ display: none; \}", paper)
        for selector in selectors.split(",")
    ]
    assert {"nav", ".viewer", ".scripted .viewer"} <= set(hidden)
    assert not {line for line in paper.splitlines() if len(line) > 40} & set(screen.splitlines())


@given(
    st.tuples(*[st.floats(-2.0, 2.0)] * 3),
    st.sampled_from([(0.0, 0.0, 0.0), (np.pi / 2, 0.0, 0.0), (0.3, 1.0, 0.0)]),
)
@example((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))  # on the floor
def test_a_frame_is_drawn_of_outlets_in_any_plane(
    shift: tuple[float, ...], turn: tuple[float, ...]
) -> None:
    rig = paper_rig()
    flat = rig.outlets * [1.0, 1.0, 0.0] @ matrix_from_rotation_vector(np.array(turn)).T + shift
    frame = frame_surface(replace(rig, outlets=flat))
    assert np.linalg.matrix_rank(frame.vertices - frame.vertices.mean(axis=0), tol=0.01) == 3
    assert np.linalg.norm(flat[0] - frame.vertices, axis=1).min() < 1e-9
    assert len(frame.edges) >= 9


@given(st.tuples(*[st.floats(-2.0, 2.0)] * 3), st.tuples(*[st.floats(-2.0, 2.0)] * 3))
@example((-2.0, 0.0, 2.0), (2.0, 0.0, 2.0))
def test_a_frame_is_drawn_of_pulleys_on_any_line_with_the_workspace(
    start: tuple[float, ...], end: tuple[float, ...]
) -> None:
    """With pulleys such a rig is valid: the exits move off the line."""
    rig = hall_rig()
    line = np.linspace(start, end, rig.cable_count)
    frame = frame_surface(replace(rig, outlets=line))
    inside = np.vstack([line, [rig.workspace_lower, rig.workspace_upper]])
    assert (frame.vertices.min(axis=0) <= inside.min(axis=0) + 1e-9).all()
    assert (frame.vertices.max(axis=0) >= inside.max(axis=0) - 1e-9).all()
