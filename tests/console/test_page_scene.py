"""The console's scene and camera images in a real browser: what is drawn, picked and compared."""

from __future__ import annotations

import re
from itertools import combinations
from typing import Any

import pytest
from playwright.sync_api import Browser, expect

from tests.console.browsing import NO_WEBGL, Fake, Visit, painted, visit
from tests.console.fake_server import on_circle

pytestmark = [pytest.mark.browser, pytest.mark.slow]
WEBGL = True


def until_painted(desk: Visit, role: str, least: int) -> None:
    """Waits until so many pixels of the scene have the colour; 0 for none at all."""

    def holds(_: dict[str, Any]) -> bool:
        found = painted(desk.page, role)
        return found >= least if least else found == 0

    desk.fake.wait(desk.page, holds)


def without_layer(desk: Visit, title: str) -> None:
    desk.page.locator("#live summary", has_text="Layers").click()
    desk.page.get_by_role("checkbox", name=title).uncheck()
    desk.page.locator("#live summary", has_text="Layers").click()  # it lies over the scene


def test_the_closest_pair_is_drawn_and_can_be_hidden(desk: Visit) -> None:
    desk.fake.ask(state={"tensions_n": [20.0] * 8})
    until_painted(desk, "limit", 10)
    without_layer(desk, "Closest pair")
    until_painted(desk, "limit", 0)


#: Pictures drawn by WebGL from now on, and when that began.
COUNT = """() => {
  window.drawn = { since: performance.now(), pictures: 0 };
  const clear = WebGL2RenderingContext.prototype.clear;
  WebGL2RenderingContext.prototype.clear = function (...given) {
    drawn.pictures += this.getParameter(this.FRAMEBUFFER_BINDING) === null;
    return clear.apply(this, given);
  };
}"""


def test_without_a_graphics_card_the_moving_scene_is_drawn_five_times_a_second(desk: Visit) -> None:
    """States come twenty times a second, and each picture would take the processor from a run."""
    desk.take_control()
    desk.load()
    desk.run()
    desk.page.evaluate(COUNT)
    desk.fake.let_pass(desk.page, 60)
    seconds, pictures = desk.page.evaluate(
        "() => [(performance.now() - drawn.since) / 1000, drawn.pictures]"
    )
    assert 3 <= pictures <= 5.0 * seconds + 2


def test_the_measured_position_is_shown_beside_the_one_by_the_drives(desk: Visit) -> None:
    desk.take_control()
    expect(desk.page.locator("#measured-x")).to_have_text("")
    desk.load()
    desk.run()
    expect(desk.page.locator("#measured-x")).to_contain_text("measured")
    expect(desk.page.locator("#note-measured")).to_contain_text(re.compile(r"measured [\d.]+ \("))
    expect(desk.page.locator("#scene-legend")).to_contain_text("ellipsoid drawn 200×")
    until_painted(desk, "tag", 20)
    without_layer(desk, "Measured position")
    until_painted(desk, "tag", 0)


def test_an_old_measurement_is_not_shown_as_one_of_now(desk: Visit) -> None:
    old = desk.fake.ask(state={"measured": None})
    assert old
    measured = {"position_mm": [1.0, 2.0, 3.0], "half_axes_mm": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
    more = {"within_mm": 1.0, "stated": True, "clearance": None}
    desk.fake.ask(state={"measured": {**measured, **more, "age_s": 3.2}})
    expect(desk.page.locator("#note-measured")).to_have_text(re.compile("no measured pose for 3"))
    expect(desk.page.locator("#measured-x")).to_have_text("measured –")
    until_painted(desk, "tag", 0)
    desk.fake.ask(state={"measured": {**measured, **more, "age_s": 0.1, "stated": False}})
    expect(desk.page.locator("#note-measured")).to_contain_text("from scatter only")


def test_pictures_of_cameras_come_at_most_five_times_a_second(desk: Visit) -> None:
    """And only where they are looked at; a server that is slow is not asked again meanwhile."""
    desk.take_control()
    desk.load()
    desk.run()
    assert desk.fake.let_pass(desk.page)["pictures"] == []
    desk.view("events")
    found = desk.fake.wait(desk.page, lambda f: len(f["pictures"]) >= 6)
    expect(desk.page.locator("#pictures img")).to_be_visible()
    expect(desk.page.locator("#pictures figcaption")).to_have_text("top: tags 301, 305")
    gaps = [b - a for a, b in zip(found["pictures"], found["pictures"][1:], strict=False)]
    assert sum(gaps) / len(gaps) >= 0.19
    desk.fake.ask(set={"slow_ms": 600})
    count = len(desk.fake.let_pass(desk.page, 20)["pictures"])
    assert len(desk.fake.let_pass(desk.page, 20)["pictures"]) - count <= 3
    desk.view("operate")
    desk.fake.let_pass(desk.page, 20)
    count = len(desk.fake.ask()["pictures"])
    assert len(desk.fake.let_pass(desk.page, 10)["pictures"]) == count


def test_without_webgl_the_console_says_so_and_works(browser: Browser, fake: Fake) -> None:
    with visit(browser, fake, script=NO_WEBGL) as found:
        expect(found.page.locator("#scene .without")).to_contain_text("needs WebGL 2")
        expect(found.page.locator("#scene-canvas")).to_be_hidden()
        found.take_control()
        found.load()
        found.run()
        found.page.locator("#scene-in").click()
        expect(found.page.locator("#measured-x")).to_contain_text("measured")
        found.page.locator("#stop").click()
        fake.wait(found.page, lambda state: bool(state["stops"] == 1))


# Picking a goal, comparing plans.


#: Where a goal is picked, as shares of the scene's width and height.
PICKED = (0.48, 0.38)


def picked_at(desk: Visit) -> tuple[float, float]:
    """That point of the page; the scene moves when the text above it gets longer."""
    box = desk.page.locator("#scene-canvas").bounding_box()
    assert box
    return box["x"] + PICKED[0] * box["width"], box["y"] + PICKED[1] * box["height"]


def near_picked(desk: Visit, role: str) -> int:
    """Pixels in about the colour of a role within 8 px of that point."""
    x, y = picked_at(desk)
    return painted(desk.page, role, {"x": x - 8, "y": y - 8, "width": 17, "height": 17})


def begin_to_pick(found: Visit) -> dict[str, Any]:
    found.take_control()
    found.view("teach")
    found.page.locator("#pick").click()
    expect(found.page.locator("#pick-bar")).to_be_visible()
    box = found.page.locator("#scene-canvas").bounding_box()
    assert box
    return dict(box)


@pytest.mark.parametrize("turned", [0, 4])
def test_a_goal_is_picked_where_the_pointer_is(desk: Visit, turned: int) -> None:
    """The goal is drawn, by the projection of the scene, under the pointer that picked it."""
    begin_to_pick(desk)
    expect(desk.page.locator("#pick")).to_be_visible()  # the list stays: the scene is beside it
    desk.page.locator("#scene-canvas").focus()
    for _ in range(turned):
        desk.page.keyboard.press("ArrowLeft")
        desk.page.keyboard.press("ArrowUp")
    for height in (300, 500):
        desk.page.locator("#pick-height").fill(str(height))
        desk.page.mouse.click(*picked_at(desk))
        expect(desk.page.locator("#pick-text")).to_contain_text(f", {height} mm")
        # The ring about the goal.
        desk.fake.wait(desk.page, lambda _: near_picked(desk, "ink") > 20)
    desk.page.locator("#pick-keep").click()
    expect(desk.page.locator("#pick-bar")).to_be_hidden()
    (pose,) = desk.fake.wait(desk.page, lambda f: bool(f["poses"]))["poses"]
    assert pose["name"] == "goal 1"
    assert pose["position_mm"][2] == 500.0
    expect(desk.page.locator("#poses li")).to_have_count(1)


def test_turning_the_view_picks_nothing_and_cancel_keeps_nothing(desk: Visit) -> None:
    begin_to_pick(desk)
    x, y = picked_at(desk)
    desk.page.mouse.move(x, y)
    desk.page.mouse.down()
    desk.page.mouse.move(x + 60, y, steps=4)
    desk.page.mouse.up()
    expect(desk.page.locator("#pick-text")).to_have_text(
        "Click on the grid where the platform is to go."
    )
    desk.page.locator("#pick-keep").click()
    expect(desk.page.locator("#notice")).to_have_text("Click in the scene first.")
    desk.page.locator("#pick-cancel").click()
    expect(desk.page.locator("#pick-bar")).to_be_hidden()
    assert desk.fake.ask()["poses"] == []


def test_a_place_outside_the_workspace_is_told_before_it_is_kept(desk: Visit) -> None:
    box = begin_to_pick(desk)
    desk.page.mouse.click(box["x"] + 0.5 * box["width"], box["y"] + 5)
    expect(desk.page.locator("#pick-text")).to_contain_text("outside the workspace")
    desk.page.locator("#pick-keep").click()
    expect(desk.page.locator("#notice")).to_contain_text("click on the grid")
    assert desk.fake.ask()["poses"] == []


def test_on_a_phone_the_scene_comes_up_to_pick_and_the_list_afterwards(phone: Visit) -> None:
    box = begin_to_pick(phone)
    expect(phone.page.locator("#scene")).to_be_in_viewport()
    phone.page.touchscreen.tap(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
    phone.page.locator("#pick-keep").click()
    expect(phone.page.locator("#poses li")).to_have_count(1)


def test_picking_goes_on_after_stale_data(desk: Visit) -> None:
    begin_to_pick(desk)
    desk.pick()
    goal = desk.page.locator("#pick-text").inner_text()
    desk.fake.ask(set={"behind_ms": 700.0})
    expect(desk.page.locator("#stale")).to_be_visible()
    desk.fake.let_pass(desk.page)
    desk.fake.ask(set={"behind_ms": 0.0})
    expect(desk.page.locator("#stale")).to_be_hidden()
    desk.fake.let_pass(desk.page)
    expect(desk.page.locator("#pick-text")).to_have_text(goal)
    desk.send("teach_at", "#pick-keep")
    expect(desk.page.locator("#poses li")).to_have_count(1)
    expect(desk.page.locator("#pick-bar")).to_be_hidden()


def test_a_goal_is_kept_once_however_often_it_is_confirmed(desk: Visit) -> None:
    begin_to_pick(desk)
    desk.pick()
    desk.page.locator("#pick-keep").evaluate("(keep) => [1, 2].forEach(() => keep.click())")
    expect(desk.page.locator("#pick-bar")).to_be_hidden()
    assert [pose["name"] for pose in desk.fake.ask()["poses"]] == ["goal 1"]


def test_picking_ends_with_control(desk: Visit) -> None:
    begin_to_pick(desk)
    desk.fake.ask(state={"control": {"yours": False, "held_by": "page 7"}})
    expect(desk.page.locator("#pick-bar")).to_be_hidden()


# Texts in the scene.


def texts(desk: Visit) -> dict[str, dict[str, float]]:
    """The texts that are shown, with their boxes."""
    words = desk.page.evaluate(
        """() => [...document.querySelectorAll(".texts b")].filter((e) => e.checkVisibility())
             .map((e) => [e.textContent, e.getBoundingClientRect().toJSON()])"""
    )
    assert len({word for word, _ in words}) == len(words), "no text appears twice"
    return dict(words)


def pose_of(name: str, *position: float) -> dict[str, Any]:
    return {"name": name, "position_mm": list(position), "quaternion": [1, 0, 0, 0]}


def test_taught_poses_are_named_in_the_scene_with_and_without_a_plan(desk: Visit) -> None:
    start = on_circle(0.0) * 1e3
    poses = [pose_of("grip", *start), pose_of("above", -100.0, 150.0, 500.0)]
    desk.fake.ask(set={"poses": poses})
    desk.fake.wait(desk.page, lambda _: {"grip", "above"} <= set(texts(desk)))
    desk.take_control()
    desk.load()  # it starts at "grip"
    desk.fake.let_pass(desk.page)
    assert {"grip", "above"} <= set(texts(desk))
    assert "start" not in texts(desk)
    without_layer(desk, "Taught poses")
    desk.fake.wait(desk.page, lambda _: "start" in texts(desk))
    assert not {"grip", "above"} & set(texts(desk))


def test_a_picked_goal_is_named_so(desk: Visit) -> None:
    begin_to_pick(desk)
    desk.pick()
    desk.fake.wait(desk.page, lambda _: "picked" in texts(desk))
    assert "goal" not in texts(desk)


def test_the_axes_of_the_world_are_shown(desk: Visit) -> None:
    desk.fake.wait(desk.page, lambda _: {"x", "y", "z"} <= set(texts(desk)))
    found = texts(desk)
    assert found["z"]["y"] < min(found["x"]["y"], found["y"]["y"]), "z is up"
    without_layer(desk, "Axes")
    desk.fake.wait(desk.page, lambda _: not {"x", "y", "z"} & set(texts(desk)))


def test_texts_that_would_overlap_are_left_out_the_less_important_first(desk: Visit) -> None:
    """Taught names stay; numbers of cables and names of obstacles give way."""
    crowd = [pose_of(f"pose number {k}", -150.0, 4.0 * k, 450.0) for k in range(5)]
    desk.fake.ask(set={"poses": crowd})
    desk.fake.wait(desk.page, lambda _: "pose number 2" in texts(desk))
    found = texts(desk)
    assert {pose["name"] for pose in crowd} <= set(found)
    assert "obstacle_1" not in found
    for one, other in combinations(found.values(), 2):
        assert (
            one["right"] <= other["left"]
            or other["right"] <= one["left"]
            or abs(one["top"] - other["top"]) >= 13.0
        )


def test_two_plans_stand_side_by_side_and_both_paths_are_drawn(desk: Visit) -> None:
    desk.take_control()
    desk.load()
    hide = {"clearance_mm": None, "tensions_n": None}
    desk.fake.ask(state=hide)
    until_painted(desk, "raw", 0)
    name = "plans/colliding.json"
    desk.page.locator(f"input[name=plan-file][value='{name}']").check(force=True)
    desk.page.locator("#compare-plan").click()
    table = desk.page.locator("#comparison")
    expect(table).to_contain_text("Least clearance12.4\u00a0mm–")
    expect(table).to_contain_text("Checkpassedfailed")
    expect(desk.page.locator("#plan-name")).to_have_text("plans/circle.json")
    until_painted(desk, "raw", 20)
    desk.page.locator("#compare-end").click()
    expect(table).to_be_hidden()
    until_painted(desk, "raw", 0)
