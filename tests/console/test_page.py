"""The console's page in a real browser: STOP, stale data, confirmations, contents."""

from __future__ import annotations

import re

import pytest
from playwright.sync_api import Browser, expect

from model.pages.charts import series_style
from tests.console.browsing import ROOT, SIZES, VIEWS, Fake, Visit, visit

pytestmark = [pytest.mark.browser, pytest.mark.slow]
WEBGL = False
STALE = re.compile("No data from the console’s server")


def test_data_that_become_stale_unasked_are_a_hold_up(desk: Visit) -> None:
    """A test that then fails is repeated, unless it silenced the server itself."""
    busy = "() => { const began = performance.now(); while (performance.now() - began < 1000); }"
    desk.page.evaluate(busy)
    desk.fake.let_pass(desk.page, 2)
    assert desk.was_held_up()
    desk.blink()
    assert not desk.was_held_up()


# STOP.


@pytest.mark.parametrize("size", SIZES)
def test_stop_is_at_the_same_position_in_every_view(
    browser: Browser, fake: Fake, size: str
) -> None:
    """The lower left corner; whole, large enough for a finger, and in front of everything."""
    with visit(browser, fake, size) as found:
        boxes = []
        for view in VIEWS:
            found.view(view)
            boxes.append(found.page.locator("#stop").bounding_box())
        assert all(box == boxes[0] for box in boxes)
        box = boxes[0]
        assert box
        assert box["x"] < 20
        assert box["y"] + box["height"] <= SIZES[size][1]
        assert min(box["width"], box["height"]) >= 60
        in_front = """b => document.elementFromPoint(b.x + b.width / 2, b.y + b.height / 2)
          .closest('#stop') !== null"""
        assert found.page.evaluate(in_front, box)
        expect(found.page.locator("#stop-words")).to_be_in_viewport(ratio=1)


def test_stop_acts_when_it_is_touched_and_needs_no_control(phone: Visit) -> None:
    """At pointerdown, not when the finger is lifted; once, though the browser adds a click."""
    assert phone.fake.ask()["stops"] == 0
    phone.page.locator("#stop").dispatch_event("pointerdown", {"pointerId": 1, "button": 0})
    phone.fake.wait(phone.page, lambda f: bool(f["stops"] == 1))
    phone.page.locator("#stop").tap()
    phone.fake.wait(phone.page, lambda f: bool(f["stops"] == 2))
    assert phone.fake.let_pass(phone.page)["stops"] == 2


def test_the_space_bar_stops_and_does_nothing_else(desk: Visit) -> None:
    focused = ("body", "#tab-jog", "#take-control", "#scene-canvas", "#load-box summary", "#stop")
    for stops, element in enumerate(focused, start=1):
        desk.fake.ask(set={"received": []})
        if element != "body":
            desk.page.locator(element).focus()
        desk.page.keyboard.press(" ")
        desk.fake.wait(desk.page, lambda f, stops=stops: bool(f["stops"] == stops))  # type: ignore[misc]
        found = desk.fake.let_pass(desk.page)
        assert [m["command"] for m in found["received"]] == ["stop"], element
        assert found["stops"] == stops, element
        expect(desk.page.locator("#tab-operate")).to_have_attribute("aria-selected", "true")


def test_enter_on_stop_and_escape_stop_as_well(desk: Visit) -> None:
    desk.page.locator("#stop").focus()
    desk.page.keyboard.press("Enter")
    desk.page.keyboard.press("Escape")
    desk.fake.wait(desk.page, lambda f: bool(f["stops"] == 2))


def test_in_a_text_field_a_space_is_a_space(desk: Visit) -> None:
    desk.take_control()
    desk.view("teach")
    desk.page.locator("#teach-name").press_sequentially("above the box")
    expect(desk.page.locator("#teach-name")).to_have_value("above the box")
    assert desk.fake.let_pass(desk.page)["stops"] == 0


def test_a_text_field_has_the_focus_again_after_stale_data(desk: Visit) -> None:
    """Else the next space of a name would stop a run."""
    desk.take_control()
    desk.load()
    desk.run()
    desk.view("teach")
    field = desk.page.locator("#teach-name")
    field.press_sequentially("left")
    desk.blink()
    desk.page.keyboard.type(" side")
    expect(field).to_have_value("left side")
    assert desk.fake.let_pass(desk.page)["stops"] == 0


def test_a_space_on_a_stale_page_stops_where_a_text_field_had_the_focus(desk: Visit) -> None:
    desk.take_control()
    desk.view("teach")
    field = desk.page.locator("#teach-name")
    field.press_sequentially("left")
    with desk.stale():
        expect(field).not_to_be_focused()
        desk.page.keyboard.press(" ")
        stops = desk.fake.wait(desk.page, lambda f: bool(f["stops"] >= 1))["stops"]
    desk.page.keyboard.press(" ")
    desk.fake.wait(desk.page, lambda f: bool(f["stops"] > stops))
    expect(field).to_have_value("left")


def test_a_text_field_that_was_left_on_a_stale_page_stays_left(desk: Visit) -> None:
    """By a press of a pointer beside it, which is reported, as it presses nothing."""
    desk.take_control()
    desk.view("teach")
    field = desk.page.locator("#teach-name")
    field.press_sequentially("left")
    with desk.stale():
        desk.page.locator("#stale-text").click()
    expect(desk.page.locator("#notice")).to_have_text("Not done: data were not current.")
    desk.page.keyboard.press("Escape")
    desk.fake.wait(desk.page, lambda f: bool(f["stops"] == 1))
    desk.page.keyboard.press(" ")
    desk.fake.wait(desk.page, lambda f: bool(f["stops"] == 2))
    expect(field).to_have_value("left")


def test_stop_works_on_a_stale_page(desk: Visit) -> None:
    desk.fake.ask(silent=True)
    expect(desk.page.locator("#stale-text")).to_have_text(STALE)
    desk.page.locator("#stop").click()
    desk.fake.wait(desk.page, lambda f: bool(f["stops"] >= 1))


def test_stop_goes_by_http_when_the_socket_is_lost(desk: Visit) -> None:
    desk.fake.ask(refuse=True, hang_up=True)
    expect(desk.page.locator("#stale-text")).to_have_text(re.compile("Connection lost"))
    desk.page.keyboard.press(" ")
    found = desk.fake.wait(desk.page, lambda f: bool(f["stops"] == 1))
    assert found["received"] == []
    expect(desk.page.locator("#stop-answer")).to_have_text("nothing moves")


def test_stop_that_reaches_no_one_says_so(desk: Visit) -> None:
    desk.page.route("**/stop", lambda route: route.abort())
    desk.fake.ask(refuse=True, hang_up=True)
    expect(desk.page.locator("#stale-text")).to_have_text(re.compile("Connection lost"))
    desk.page.locator("#stop").click()
    expect(desk.page.locator("#stop-answer")).to_contain_text("use the emergency-stop button")
    desk.errors.clear()  # the request that failed


def test_a_stop_without_an_answer_says_so(desk: Visit) -> None:
    """The server hangs: the socket is open, and nothing comes back."""
    desk.page.route("**/stop", lambda route: None)
    desk.page.evaluate("() => { WebSocket.prototype.send = () => {}; }")
    desk.page.locator("#stop").click()
    expect(desk.page.locator("#stop-answer")).to_contain_text("No answer to STOP for 1 s")


def test_an_answer_that_stop_failed_stays_while_the_own_run_stops(desk: Visit) -> None:
    """It was overwritten by the next state: another robot's run of this user does not answer."""
    desk.take_control()
    desk.load()
    desk.run()
    answer, words = desk.page.locator("#stop-answer"), "a run does not answer"
    desk.fake.ask(set={"stop_refusal": words})
    desk.fake.let_pass(desk.page, 12)  # at full speed it takes some states to stop
    desk.page.keyboard.press(" ")
    expect(desk.page.locator("#motion-text")).to_have_text("At rest")
    desk.fake.let_pass(desk.page)
    expect(answer).to_have_text(words)
    expect(answer).to_have_class("failed")
    desk.fake.ask(set={"stop_refusal": ""})
    desk.run()
    expect(answer).to_have_text("")
    desk.fake.let_pass(desk.page, 12)
    desk.page.keyboard.press(" ")
    expect(answer).to_have_text("Stopping along the path")
    expect(answer).not_to_have_class("failed")


def test_stop_answers_an_open_question_with_no(desk: Visit) -> None:
    desk.take_control()
    desk.load()
    desk.page.locator("#run").click()
    expect(desk.page.locator("#dialog")).to_be_visible()
    desk.page.locator("#stop").click()
    expect(desk.page.locator("#dialog")).to_be_hidden()
    assert desk.fake.received("run") == []


def test_stop_does_not_look_like_an_emergency_stop(desk: Visit) -> None:
    """Neither red nor yellow, nor round; ISO 13850 keeps those for the button on the machine."""
    colours = desk.page.evaluate(
        """() => ["stop", "stop-bar"].flatMap(id => {
             const s = getComputedStyle(document.getElementById(id));
             return [s.backgroundColor, s.borderTopColor, s.color];
           })"""
    )
    for colour in colours:
        red, green, blue = (int(v) for v in re.findall(r"\d+", colour)[:3])
        assert max(red, green, blue) - min(red, green, blue) < 40, colour
    radius = desk.page.evaluate(
        "() => parseFloat(getComputedStyle(document.getElementById('stop')).borderRadius)"
    )
    assert radius <= 12
    expect(desk.page.locator("#stop-words")).to_have_text(
        "Software stop. The emergency-stop button is on the machine."
    )


# Stale data.


def test_stale_data_say_so_over_the_whole_view_and_leave_only_stop(desk: Visit) -> None:
    desk.take_control()
    assert len(desk.audit("usable")) > 10
    desk.fake.ask(silent=True)
    expect(desk.page.locator("#stale .band")).to_be_visible(timeout=1500)
    expect(desk.page.locator("#stale-text")).to_have_text(STALE)
    assert desk.audit("usable") == ["stop"]
    expect(desk.page).to_have_title(re.compile("^No current data – "))
    box = desk.page.locator("#stale .band").bounding_box()
    assert box
    assert box["width"] == SIZES["desk"][0]
    muted = """e => getComputedStyle(e).color
      === getComputedStyle(document.querySelector('.quiet')).color"""
    for figure in ("#value-x", "#value-clearance", ".value.figure"):
        assert desk.page.locator(figure).first.evaluate(muted), figure
    desk.fake.ask(silent=False)
    expect(desk.page.locator("#stale")).to_be_hidden()
    expect(desk.page).to_have_title(re.compile("^At rest – "))
    assert len(desk.audit("usable")) > 10


def test_a_hidden_tab_has_a_current_title_and_misses_no_event(desk: Visit) -> None:
    """Browsers draw no frames for it."""
    without_frames = """() => {
      globalThis.drawn = globalThis.requestAnimationFrame;
      globalThis.waiting = [];
      globalThis.requestAnimationFrame = (frame) => waiting.push(frame);
    }"""
    desk.page.evaluate(without_frames)
    events = [{"time_s": 1.5, "code": "slack", "text": "cable 3 carries 1.8 N"}]
    desk.fake.ask(set={"moving": "moving", "events": events})
    expect(desk.page).to_have_title(re.compile("^Moving"))
    desk.fake.ask(set={"moving": None, "latched": "slack"})
    expect(desk.page).to_have_title(re.compile("^Fault latched"))
    shown_again = """() => {
      globalThis.requestAnimationFrame = drawn;
      waiting.forEach((frame) => drawn(frame));
    }"""
    desk.page.evaluate(shown_again)
    desk.view("events")
    expect(desk.page.locator("#events li").first).to_contain_text("cable 3 carries 1.8 N")
    expect(desk.page.locator("#events-none")).to_be_hidden()


def test_curves_have_a_gap_where_no_state_arrived(desk: Visit) -> None:
    """A line across it would show a dip in it as a steady value."""
    draw = """async () => {
      const { Curves } = await import("/static/curves.js");
      const drawn = [], kept = globalThis.uPlot, curves = new Curves();
      globalThis.uPlot = class { setData(data) { drawn.push(data); } setSize() {} redraw() {} };
      const tensions_n = Array(8).fill(20), tension_limits_n = [5, 100];
      const clearance_mm = { now: 80, required: 10 }, motion = { following_error_mm: 0.2 };
      const state = { tensions_n, tension_limits_n, clearance_mm, motion };
      for (const now of [1000, 1050, 30000, 30050]) curves.take(state, now);
      curves.show(30050);
      globalThis.uPlot = kept;
      return drawn;
    }"""
    tensions, clearance, following = desk.page.evaluate(draw)
    for curve, value in ((tensions[8], 20), (clearance[1], 80), (following[1], 0.2)):
        assert curve == [value, value, None, value, value]
    assert following[0] == pytest.approx([-29.05, -29.0, -29.0, -0.05, 0.0])


def test_the_key_of_the_tensions_shows_the_line_of_each_cable(desk: Visit) -> None:
    """Cables 1 and 9 had the same key, and lines as those of a report have other dashes."""
    draw = """async (count) => {
      const { Curves } = await import("/static/curves.js");
      const made = [], kept = globalThis.uPlot, curves = new Curves();
      globalThis.uPlot = class {
        constructor({ series }) { made.push(series.slice(1)); }
        setData() {} setSize() {} redraw() {}
      };
      curves.take({ tensions_n: Array(count).fill(20), tension_limits_n: [5, 100] }, 1000);
      curves.show(1000);
      globalThis.uPlot = kept;
      const lines = made[0].map((line) => [line.stroke(), line.dash.join()]);
      const keys = [...document.querySelectorAll("#curve-tensions .key path")].map((path) => {
        const { stroke, strokeDasharray } = getComputedStyle(path);
        return [stroke, strokeDasharray.replace(/none|px| /g, "")];
      });
      const pixel = document.createElement("canvas").getContext("2d");
      const hex = (colour) => ((pixel.fillStyle = colour), pixel.fillStyle);
      return [lines, keys.map(([stroke, dashes]) => [hex(stroke), dashes])];
    }"""
    lines, keys = desk.page.evaluate(draw, 24)
    assert keys == [*lines[:24], lines[-1]], "one key for both limits"
    assert len({tuple(line) for line in lines}) == 25
    reported = [series_style(k) for k in range(24)]
    root = "(name) => getComputedStyle(document.body).getPropertyValue(`--${name}`)"
    shown = {name: desk.page.evaluate(root, name) for pair in reported for name in pair}
    assert lines[:24] == [[shown[a], shown[b].replace(" ", ",")] for a, b in reported]


def test_the_age_grows_by_the_page_s_own_clock(desk: Visit) -> None:
    """Whatever the computer's clock does meanwhile."""
    desk.page.evaluate("() => { Date.now = () => 0; }")
    desk.fake.ask(silent=True)
    expect(desk.page.locator("#stale-text")).to_have_text(re.compile(r"for 1\.[0-9] s"))


def test_data_of_a_slow_connection_are_as_old_as_they_are(desk: Visit) -> None:
    """They arrive 20 times a second: their receipt says nothing about their age."""
    expect(desk.page.locator("#lamp-data")).to_have_text(re.compile("Data 0\\.[0-2]"))
    desk.fake.ask(set={"behind_ms": 300.0})
    expect(desk.page.locator("#lamp-data")).to_have_text(re.compile("Data 0\\.[34]"))
    desk.fake.ask(set={"behind_ms": 8000.0})
    slow = re.compile(r"The connection is slow: data are 8\.[0-9] s old")
    expect(desk.page.locator("#stale-text")).to_have_text(slow)
    assert desk.audit("usable") == ["stop"]
    desk.fake.ask(set={"behind_ms": 0.0})
    expect(desk.page.locator("#stale")).to_be_hidden()


def test_a_run_that_does_not_report_is_stale_though_the_server_speaks(desk: Visit) -> None:
    desk.take_control()
    desk.load()
    desk.run()
    motion = {"process": 1, "state": "moving", "cause": None, "path_mm": 1.0, "path_length_mm": 2.0}
    wished = {"stop": False, "hold": False, "speed_percent": 100}
    more = {"wished": wished, "cameras": [], "drives": [], "events": [], "feed_percent": 100.0}
    desk.fake.ask(state={"motion": {**motion, **more, "elapsed_s": 1.0, "age_s": 0.9}})
    expect(desk.page.locator("#stale-text")).to_have_text(re.compile("No data from the run"))
    desk.fake.ask(
        state={"motion": {**motion, **more, "elapsed_s": 1.0, "age_s": 9.0, "state": "finished"}}
    )
    expect(desk.page.locator("#stale")).to_be_hidden()


def test_after_a_reconnection_nothing_goes_on_by_itself(desk: Visit) -> None:
    desk.ready_to_jog()
    desk.hold()
    before = len(desk.fake.ask()["received"])
    desk.fake.ask(hang_up=True)
    expect(desk.page.locator("#stale")).to_be_visible()
    expect(desk.page.locator("#stale")).to_be_hidden()
    after = desk.fake.let_pass(desk.page)["received"][before:]
    # Messages in transit when the socket was closed; none since, though the mouse is still down.
    assert len([m for m in after if m["kind"] == "held"]) <= 3
    assert [m for m in after if m["kind"] == "command"] == []
    count = len(desk.fake.ask()["received"])
    assert len(desk.fake.let_pass(desk.page)["received"]) == count
    expect(desk.page.locator("#lamp-control")).to_have_text("Control is free")


# What is asked before.


def test_reset_shows_the_cause_and_asks(desk: Visit) -> None:
    cause = "slack: cable 3 tension 1.8 N"
    desk.fake.ask(set={"latched": cause})
    desk.take_control()
    desk.page.locator("#reset").click()
    expect(desk.page.locator("#dialog .cause")).to_contain_text(cause)
    expect(desk.page.get_by_role("button", name="Cancel")).to_be_focused()
    desk.page.get_by_role("button", name="Cancel").click()
    assert desk.fake.received("reset") == []
    desk.page.locator("#reset").click()
    desk.page.locator(".confirm").click()
    expect(desk.page.locator("#lamp-latch")).to_have_text("No fault")
    (sent,) = desk.fake.received("reset")
    assert sent["cause"] == cause
    desk.fake.ask(set={"latched": cause})
    desk.page.locator("#reset").click()
    desk.fake.ask(set={"latched": "drive 3: over-current"})
    expect(desk.page.locator("#dialog")).to_be_hidden()
    expect(desk.page.locator("#notice")).to_contain_text("withdrawn: What it showed has changed")
    assert len(desk.fake.received("reset")) == 1


def test_release_says_what_drops_and_asks(desk: Visit) -> None:
    desk.take_control()
    desk.page.locator("#release").click()
    expect(desk.page.locator("#dialog")).to_contain_text("The platform drops unless")
    desk.page.locator(".confirm").click()
    desk.fake.wait(desk.page, lambda f: f["received"][-1]["command"] == "release")


def test_run_asks_with_verdict_duration_and_length(desk: Visit) -> None:
    desk.take_control()
    desk.load()
    desk.page.locator("#run").click()
    for text in ("plans/circle.json", "passed its check", "24.0", "921"):
        expect(desk.page.locator("#dialog .facts")).to_contain_text(text)
    desk.page.locator(".confirm").click()
    expect(desk.page.locator("#motion-state")).to_contain_text("Moving")
    desk.page.locator("#hold").click()
    expect(desk.page.locator("#motion-state")).to_contain_text("Held")
    desk.page.locator("#resume").click()
    expect(desk.page.locator("#motion-state")).to_contain_text("Moving")
    desk.page.keyboard.press(" ")
    expect(desk.page.locator("#outcome-headline")).to_have_text(
        "Stopped along the path by the operator."
    )
    assert (
        desk.page.locator("#outcome-links a").get_attribute("href")
        == "/report?token=token-of-the-fake"
    )


def test_a_question_goes_when_its_answer_no_longer_counts(desk: Visit) -> None:
    desk.take_control()
    desk.load()
    desk.page.locator("#run").click()
    desk.fake.ask(set={"latched": "late"})
    expect(desk.page.locator("#dialog")).to_be_hidden()
    expect(desk.page.locator("#notice")).to_contain_text("withdrawn: A fault is latched")
    assert desk.fake.received("run") == []


def test_run_says_that_simulated_drives_are_put_at_the_start(desk: Visit) -> None:
    desk.take_control()
    desk.load()
    dialog = desk.page.locator("#dialog")
    for off, count in ((82.4, 1), (0.3, 0)):
        desk.fake.ask(set={"over": {"plan_start_off_mm": off}})
        desk.fake.let_pass(desk.page)
        desk.page.locator("#run").click()
        expect(dialog.get_by_text("put at the plan’s start, 82 mm")).to_have_count(count)
        desk.page.keyboard.press("Escape")
        expect(dialog).to_be_hidden()


def test_a_plan_that_failed_its_check_cannot_be_run(desk: Visit) -> None:
    desk.take_control()
    desk.load("plans/colliding.json")
    expect(desk.page.locator("#plan-verdict")).to_contain_text("collides: 3.1 mm")
    desk.page.locator("#run").click(force=True)
    expect(desk.page.locator("#notice")).to_contain_text("The plan did not pass its check")
    expect(desk.page.locator("#dialog")).to_be_hidden()


def test_looking_through_a_plan_is_marked_and_ends_when_something_moves(desk: Visit) -> None:
    desk.take_control()
    desk.load()
    desk.page.locator("#plan-time").fill("20")
    expect(desk.page.locator("#scene-preview")).to_contain_text("Preview, not live.")
    desk.run()
    expect(desk.page.locator("#scene-preview")).to_be_hidden()


# Teaching.


def test_poses_are_taught_named_ordered_forgotten_and_planned(desk: Visit) -> None:
    desk.take_control()
    desk.view("teach")
    desk.taught("one", "two", "three")
    desk.page.get_by_role("button", name="Move three up").click()
    desk.fake.wait(desk.page, lambda f: [p["name"] for p in f["poses"]] == ["one", "three", "two"])
    desk.page.get_by_role("button", name="Remove one").click()
    desk.page.locator(".confirm").click()
    desk.fake.wait(desk.page, lambda f: [p["name"] for p in f["poses"]] == ["three", "two"])
    expect(desk.page.locator("#poses li")).to_have_count(2)
    desk.page.get_by_role("textbox", name="Name of pose 2").fill("home")
    desk.page.get_by_role("textbox", name="Name of pose 2").press("Enter")
    desk.fake.wait(desk.page, lambda f: [p["name"] for p in f["poses"]] == ["three", "home"])
    desk.page.locator("input[name=poses-objective][value=clearance]").check(force=True)
    desk.page.locator("#plan-poses").click()
    found = desk.fake.wait(desk.page, lambda f: f["plan"] is not None)["received"][-1]
    assert (found["scene"], found["objective"]) == (None, "clearance")


def test_a_name_being_typed_outlives_what_happens_to_the_other_poses(desk: Visit) -> None:
    desk.take_control()
    desk.view("teach")
    desk.taught("one", "two", "three")
    two = desk.page.get_by_role("textbox", name="Name of pose 2")
    two.press("End")
    two.press("x")
    poses = [p for p in desk.fake.ask()["poses"] if p["name"] != "one"]
    desk.fake.ask(set={"poses": poses[::-1]})
    expect(desk.page.locator("#poses li").first.locator("input")).to_have_value("three")
    desk.page.keyboard.press("y")
    desk.page.keyboard.press("Enter")
    desk.fake.wait(desk.page, lambda f: [p["name"] for p in f["poses"]] == ["three", "twoxy"])


# What it shows.


def test_cables_beyond_a_limit_are_named_in_newtons(desk: Visit) -> None:
    desk.fake.ask(state={"tensions_n": [20, 20, 1.8, 20, 20, 20, 104.2, 20]})
    trouble = desk.page.locator("#tension-trouble")
    expect(trouble).to_contain_text(re.compile(r"Cable 3 is slack: 1\.8\sN, at least 5\sN"))
    expect(trouble).to_contain_text(re.compile(r"Cable 7 is too tight: 104\.2\sN, at most 100\sN"))
    expect(desk.page.locator("#tensions li.bad")).to_have_count(2)


def test_limits_are_shown_as_stated(desk: Visit) -> None:
    """Rounded, they could be on the other side of a value."""
    nearest = {"now": 7.6, "required": 7.5, "pair": ["cable 5", "obstacle_1"]}
    limits = {"tension_limits_n": [1.5, 40.25], "tensions_n": [20, 1.4, *[20] * 6]}
    desk.fake.ask(state={**limits, "clearance_mm": {**nearest, "points_mm": [[0, 0, 0]] * 2}})
    page = desk.page
    expect(page.locator("#tension-limits")).to_have_text("limits 1.5 to 40.25\u00a0N")
    expect(page.locator("#tension-trouble")).to_contain_text("1.4\u00a0N, at least 1.5\u00a0N")
    expect(page.locator("#note-clearance")).to_contain_text("of 7.5\u00a0mm")


def test_nothing_known_is_shown_as_not_known(desk: Visit) -> None:
    keys = ("platform", "tensions_n", "clearance_mm", "next_stop", "preview", "motion", "busy")
    keys += ("measured",)
    reference = {"counts": False, "known": True, "why_not": None}
    desk.fake.ask(state={**dict.fromkeys(keys), "reference": reference})
    for name in ("x", "tilt", "clearance", "stop", "following", "lost"):
        expect(desk.page.locator(f"#value-{name}")).to_have_text("–")
    expect(desk.page.locator("#tension-trouble")).to_contain_text("Unknown")


def test_texts_of_the_server_never_become_markup(desk: Visit) -> None:
    evil = "<img src=x onerror=alert(1)>"
    event = {"time_s": 1.0, "code": evil, "text": evil}
    outcome = {
        "verb": "run",
        "ok": False,
        "text": evil,
        "report": "javascript:alert(1)",
        "fault_page": "//evil.example/",
    }
    motion = {
        "process": 1,
        "state": evil,
        "cause": evil,
        "events": [event],
        "age_s": 0.0,
        "elapsed_s": 1.0,
    }
    wished = {"stop": False, "hold": False, "speed_percent": 50}
    more = {
        "path_mm": None,
        "path_length_mm": None,
        "feed_percent": 1.0,
        "wished": wished,
        "cameras": [],
        "drives": [],
    }
    pose = {"name": evil, "position_mm": [0, 0, 0], "quaternion": [1, 0, 0, 0]}
    desk.fake.ask(
        state={
            "rig": evil,
            "bus": evil,
            "latched": evil,
            "outcome": outcome,
            "poses": [pose],
            "motion": {**motion, **more},
        }
    )
    expect(desk.page.locator("#rig")).to_have_text(evil)
    expect(desk.page.locator("#outcome-text")).to_have_text(evil)
    expect(desk.page.locator("#outcome-links a")).to_have_count(0)
    desk.view("events")
    expect(desk.page.locator("#events li").first).to_contain_text(evil)
    expect(desk.page.locator("img")).to_have_count(0)


def test_a_code_leads_to_its_page_of_help(desk: Visit) -> None:
    """Every page of docs/faults has its link, and no other code has one."""
    pages = {path.stem for path in (ROOT / "docs" / "faults").glob("*.md")} - {"index"}
    help_ = desk.page.evaluate("async () => [...(await import('/static/events.js')).HELP]")
    assert set(help_) == pages
    desk.take_control()
    desk.load()
    desk.run()
    desk.fake.ask(set={"events": [{"time_s": 1.5, "code": "slack", "text": "cable 3"}]})
    desk.view("events")
    link = desk.page.get_by_role("link", name="slack")
    assert (link.get_attribute("href") or "").startswith("/help/slack?token=")
    assert link.get_attribute("target") == "_blank"


def test_the_page_asks_nothing_from_outside(desk: Visit) -> None:
    desk.take_control()
    desk.load()
    allowed = (desk.fake.origin, desk.fake.origin.replace("http", "ws"), "data:")
    assert [url for url in desk.asked if not url.startswith(allowed)] == []


def test_control_is_taken_from_another_page_only_after_a_question(
    browser: Browser, desk: Visit
) -> None:
    desk.take_control()
    other = browser.new_context().new_page()
    other.goto(desk.fake.address)
    expect(other.locator("#lamp-control")).to_have_text("Control: page 1")
    other.locator("#take-control").click()
    expect(other.locator("#dialog")).to_contain_text("page 1 has control, and loses it immediately")
    other.locator(".confirm").click()
    expect(other.locator("#lamp-control")).to_have_text("You have control")
    expect(desk.page.locator("#lamp-control")).to_have_text("Control: page 2")
    other.context.close()


def test_how_a_verb_ended_is_said_in_every_view_until_it_is_dismissed(phone: Visit) -> None:
    text = "ready\n" * 30 + "error: a cycle began 1.4 cycles late\n  next: try again\nreport: a"
    outcome = {"verb": "jog", "ok": False, "text": text, "report": None, "fault_page": None}
    phone.view("jog")
    phone.fake.ask(set={"outcome": outcome})
    for view in VIEWS:
        phone.view(view)
        expect(phone.page.locator("#outcome")).to_have_text(
            re.compile("^Jogging: not completed error: a cycle began 1.4 cycles late")
        )
    # Of the output, the end is shown, not the beginning.
    phone.page.locator("#news-more summary").click()
    end = "e => e.scrollTop > 0 && e.scrollTop + e.clientHeight >= e.scrollHeight - 2"
    phone.fake.wait(phone.page, lambda _: phone.page.locator("#outcome-text").evaluate(end))
    phone.page.locator("#outcome-seen").click()
    expect(phone.page.locator("#outcome")).to_be_hidden()
    phone.fake.let_pass(phone.page)
    expect(phone.page.locator("#outcome")).to_be_hidden()


def test_nothing_on_the_page_can_keep_the_space_bar_or_cover_stop(desk: Visit) -> None:
    """The list of a `select` is a window of the browser's: it takes every key and every touch."""
    takers = "select, iframe, dialog, [popover], input[list], input[type=file], input[type=color]"
    expect(desk.page.locator(takers)).to_have_count(0)
