"""Messages of the console's page, in a real browser: readable, and in no one's way."""

from __future__ import annotations

import re
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.console.browsing import SIZES, VIEWS, Fake, Visit, visit

pytestmark = [pytest.mark.browser, pytest.mark.slow]

LONG = {
    "verb": "jog",
    "ok": False,
    "stopped": False,
    "text": "bus            virtual cdpr\n" * 20
    + "error: a cycle began 1.3 cycles late\n  next: wait",
    "report": "/report",
    "fault_page": "/help/late",
}
EVERYTHING = {
    "outcome": LONG,
    "latched": "slack: cable 3 tension 1.8 N, at least 5 N " * 3,
    "busy": {"verb": "reset", "text": "a long line about the command in progress " * 3},
}
#: Each control of the shown panel: its box, and what is in front of its middle.
CONTROLS = """() => [...document.querySelectorAll("#panels button, #panels input, #panels summary")]
  .filter((e) => e.checkVisibility() && !e.closest(".why"))
  .map((e) => {
    const { x, y, width, height } = e.getBoundingClientRect();
    const front = document.elementFromPoint(x + width / 2, y + height / 2);
    const own = front === e || e.contains(front) || Boolean(front?.closest("label, .files"));
    return { name: e.id || e.textContent.trim(), box: [x, y, width, height], front: own };
  })"""


def controls(page: Page) -> dict[str, Any]:
    found = page.evaluate(CONTROLS)
    return {f"{k} {one['name']}": (one["box"], one["front"]) for k, one in enumerate(found)}


@pytest.mark.parametrize("size", SIZES)
def test_no_message_moves_or_covers_a_control(browser: Browser, fake: Fake, size: str) -> None:
    with visit(browser, fake, size) as found:
        found.take_control()
        found.load()
        for view in ("operate", "jog", "teach", "service"):
            fake.ask(state={"outcome": None, "latched": None, "busy": None})
            found.view(view)
            expect(found.page.locator("#outcome")).to_be_hidden()
            found.fake.let_pass(found.page, 2)
            before = controls(found.page)
            fake.ask(state=EVERYTHING)
            expect(found.page.locator("#latched")).to_be_visible()
            found.fake.let_pass(found.page, 2)
            assert controls(found.page) == before, view
            stop, news = (found.page.locator(f"#{one}").bounding_box() for one in ("stop", "news"))
            assert stop
            assert news
            assert news["y"] + news["height"] <= stop["y"], "the strip ends above STOP"


@pytest.mark.parametrize("size", SIZES)
def test_the_run_button_is_in_view_with_a_plan_whatever_is_reported(
    browser: Browser, fake: Fake, size: str
) -> None:
    with visit(browser, fake, size) as found:
        found.take_control()
        found.load()
        fake.ask(state={"outcome": LONG})
        expect(found.page.locator("#outcome")).to_be_visible()
        found.page.evaluate(
            "() => { scrollTo(0, 0); document.getElementById('panels').scrollTop = 0; }"
        )
        in_front = """() => {
          const { x, y, width, height } = document.getElementById("run").getBoundingClientRect();
          return [2, height - 2].map((v) => document.elementFromPoint(x + width / 2, y + v)?.id);
        }"""
        assert found.page.evaluate(in_front) == ["run", "run"]


def test_dismissing_is_remembered_for_that_outcome_over_a_reload(desk: Visit) -> None:
    outcome = desk.page.locator("#outcome")
    desk.fake.ask(set={"outcome": LONG})
    expect(outcome).to_be_visible()
    desk.page.locator("#outcome-seen").click()
    expect(outcome).to_be_hidden()
    desk.page.reload()
    expect(desk.page.locator("#news-none")).to_be_visible()
    desk.fake.let_pass(desk.page)
    expect(outcome).to_be_hidden()
    desk.fake.ask(set={"outcome": {**LONG, "text": "error: another one"}})
    expect(outcome).to_be_visible()
    desk.page.reload()
    expect(outcome).to_be_visible()


def test_the_same_outcome_of_a_later_verb_is_shown_again(desk: Visit) -> None:
    desk.fake.ask(set={"outcome": LONG})
    desk.page.locator("#outcome-seen").click()
    desk.fake.ask(set={"outcome": None})
    desk.fake.let_pass(desk.page)
    desk.fake.ask(set={"outcome": LONG})
    expect(desk.page.locator("#outcome")).to_be_visible()


def test_dismiss_is_not_where_another_button_is_afterwards(desk: Visit) -> None:
    """The second click of a double click does nothing: it gave control away."""
    desk.take_control()
    desk.fake.ask(set={"outcome": LONG})
    desk.page.locator("#outcome-seen").dblclick()
    desk.fake.let_pass(desk.page)
    assert desk.fake.received("give_control") == []
    expect(desk.page.locator("#lamp-control")).to_have_text("You have control")


def test_a_stop_by_the_operator_is_no_failure(desk: Visit) -> None:
    desk.take_control()
    desk.load()
    desk.run()
    desk.page.keyboard.press(" ")
    expect(desk.page.locator("#outcome-title")).to_have_text("Run: stopped")
    colour = "e => getComputedStyle(e).color"
    ink = desk.page.locator("body").evaluate(colour)
    assert desk.page.locator("#outcome-title").evaluate(colour) == ink
    without = {key: value for key, value in LONG.items() if key != "stopped"}
    desk.fake.ask(set={"outcome": without})
    expect(desk.page.locator("#outcome-title")).to_have_text("Jogging: not completed")
    assert desk.page.locator("#outcome-title").evaluate(colour) != ink


def test_the_headline_of_a_stop_is_no_error(desk: Visit) -> None:
    text = "waiting for presses\nerror: stopped; the drives hold\n  next: begin again"
    ended = {**LONG, "text": text, "stopped": True}
    desk.fake.ask(set={"outcome": ended})
    expect(desk.page.locator("#outcome-headline")).to_have_text("Stopped; the drives hold")
    desk.fake.ask(set={"outcome": {**ended, "stopped": False}})
    expect(desk.page.locator("#outcome-headline")).to_have_text("error: stopped; the drives hold")


def test_a_robot_on_a_bus_is_not_said_to_rest_while_another_program_uses_it(desk: Visit) -> None:
    """STOP reaches no motion of another user: its answer stays until a motion begins here."""
    words = "another program sends set-points to drive 1"
    read = {"at": "2026-01-02T03:04:05+00:00", "why_not": words, "in_use": True}
    desk.fake.ask(state={"simulated": False})
    expect(desk.page.locator("#progress-text")).to_have_text(
        "No motion of this user is in progress."
    )
    desk.page.clock.install()
    desk.page.keyboard.press(" ")
    answer = desk.page.locator("#stop-answer")
    expect(answer).to_have_class("failed")
    unread = {"counts": False, "known": False, "why_not": words}
    state = {"simulated": False, "drives_read": read, "reference": unread}
    desk.fake.ask(state=state)  # which is read again every second
    expect(desk.page.locator("#motion-text")).to_have_text("Used by another program")
    expect(desk.page.locator("#progress-text")).to_have_text(f"As last read, {words}.")
    desk.fake.ask(state={**state, "tensions_n": None})
    at = re.compile(r"^Used by another program at 2 Jan \d\d:04:05$")
    expect(desk.page.locator("#motion-text")).to_have_text(at)
    at = re.compile(rf"^As last read at 2 Jan \d\d:04:05, {words}\.$")
    expect(desk.page.locator("#progress-text")).to_have_text(at)
    expect(desk.page.locator("#lamp-homed")).to_have_text("Homed: unknown")
    expect(desk.page.locator("#homed-text")).to_have_text(f"Homed: unknown: {words}.")
    desk.page.clock.run_for(7000)
    expect(answer).to_have_text("nothing moves")
    answer.click()
    expect(answer).to_have_text("")
    desk.page.keyboard.press(" ")
    expect(answer).to_have_class("failed")
    desk.fake.ask(state={"simulated": True, "drives_read": None}, set={"moving": "moving"})
    expect(answer).to_have_text("")


@pytest.mark.parametrize("size", SIZES)
def test_the_result_comes_first_and_the_output_keeps_its_columns(
    browser: Browser, fake: Fake, size: str
) -> None:
    with visit(browser, fake, size) as found:
        fake.ask(set={"outcome": LONG})
        late = "error: a cycle began 1.3 cycles late"
        for view in VIEWS:
            found.view(view)
            expect(found.page.locator("#outcome-headline")).to_have_text(late)
            expect(found.page.locator("#outcome-headline")).to_be_in_viewport()
        output = found.page.locator("#outcome-text")
        expect(output).to_be_hidden()
        found.page.locator("#news-more summary").click()
        expect(output).to_be_in_viewport()
        style = output.evaluate("e => [getComputedStyle(e).whiteSpace, getComputedStyle(e).font]")
        assert style[0] in ("pre-wrap", "preserve")
        assert "mono" in style[1]
        help_ = found.page.get_by_role("link", name="What this fault means").last
        expect(help_).to_be_visible()
        assert found.page.evaluate("() => document.documentElement.scrollWidth - innerWidth") <= 0


def test_an_answer_is_shown_below_the_panel_and_covers_no_chart(desk: Visit) -> None:
    desk.view("jog")
    desk.page.locator('[data-jog="+x"]').click(force=True)
    notice = desk.page.locator("#notice-box").bounding_box()
    panels = desk.page.locator("#panels").bounding_box()
    assert notice
    assert panels
    assert notice["x"] >= panels["x"]
    assert panels["y"] + panels["height"] <= notice["y"] <= panels["y"] + panels["height"] + 20
    desk.page.locator("#notice-seen").click()
    expect(desk.page.locator("#notice")).to_be_hidden()


def test_what_a_run_does_now_is_said_not_the_last_line_of_its_output(desk: Visit) -> None:
    desk.take_control()
    desk.load()
    desk.run()
    at_stop = {"verb": "run", "text": "at stop 'via'"}
    desk.fake.ask(state={"busy": at_stop})
    expect(desk.page.locator("#busy")).to_have_text("Run: moving")
    desk.page.locator("#hold").click()
    expect(desk.page.locator("#busy")).to_have_text("Run: held, at stop 'via'")


def test_nothing_is_said_to_rest_while_a_verb_prepares_a_motion(desk: Visit) -> None:
    expect(desk.page.locator("#progress-text")).to_have_text("Nothing is moving.")
    desk.fake.ask(state={"busy": {"verb": "run", "text": "checking"}})
    expect(desk.page.locator("#motion-state")).to_have_text("Preparing the run")
    expect(desk.page.locator("#progress-text")).to_have_text("")


def test_drives_that_are_on_are_the_normal_state_and_drives_that_hold_are_not_off(
    desk: Visit,
) -> None:
    desk.take_control()
    desk.load()
    desk.run()
    lamp = desk.page.locator("#lamp-drives")
    expect(lamp).to_have_text("8 of 8 drives on")
    expect(lamp).to_have_class("pass")
    ready = {"ready": False, "why_not": None, "moving": False, "limit": None, "speed_mm_s": 20}
    wished = {"stop": False, "hold": False, "speed_percent": 100}
    drive = {"node": 1, "state": "quick stop active", "position_counts": 0, "set_counts": 0}
    drive |= {"torque": "holding", "in_fault": False}
    motion = {"process": 1, "state": "securing", "cause": None, "elapsed_s": 1.0, "age_s": 0.0}
    more = {"wished": wished, "events": [], "cameras": [], "path_mm": None, "feed_percent": 0}
    drives = [{**drive, "tension_n": 20.0}] * 8
    desk.fake.ask(
        state={"motion": {**motion, **more, "path_length_mm": None, "drives": drives}, "jog": ready}
    )
    expect(lamp).to_have_text("8 of 8 drives hold")
    odrive = {**drive, "state": "closed loop control", "torque": "enabled", "tension_n": 20.0}
    motion |= {**more, "path_length_mm": None}
    desk.fake.ask(state={"motion": {**motion, "drives": [odrive] * 8}, "jog": ready})
    expect(lamp).to_have_text("8 of 8 drives on")
    expect(lamp).to_have_class("pass")
    idle = {**odrive, "state": "idle, in error", "torque": "none", "in_fault": True}
    known = {"motion": {**motion, "drives": [idle] * 8}, "jog": ready, "tensions_n": [None] * 8}
    desk.fake.ask(state=known)
    expect(lamp).to_have_text("0 of 8 drives on")
    expect(lamp).to_have_class("fail")
    trouble = desk.page.locator("#tension-trouble")
    expect(trouble).to_have_text("Unknown: the drives have no torque.")
    expect(trouble).to_have_class("quiet")


def test_values_read_at_rest_are_not_shown_as_live(desk: Visit) -> None:
    """Nothing watches the drives then: they may lose power, or be moved by another program."""
    lamp, said = desk.page.locator("#lamp-drives"), desk.page.locator("#drives-read")
    value = desk.page.locator("#tensions .value").first
    quiet = """e => getComputedStyle(e).color
      === getComputedStyle(document.querySelector('.quiet')).color"""
    expect(said).to_be_hidden()
    assert not value.evaluate(quiet)
    today = desk.page.evaluate("() => new Date().toISOString()")
    desk.fake.ask(state={"drives_read": {"at": today, "why_not": None}})
    expect(said).to_have_text(re.compile(r"^Read at \d\d:\d\d:\d\d, not watched\.$"))
    read = {"at": "2026-01-02T19:12:05", "why_not": None}
    desk.fake.ask(state={"drives_read": read})
    expect(said).to_have_text("Read at 2 Jan 19:12:05, not watched.")
    expect(lamp).to_have_text("Read 2 Jan")
    for figure in (value, desk.page.locator("#tile-clearance dd")):
        assert figure.evaluate(quiet)
    released = {"platform": None, "clearance_mm": None, "tensions_n": [0.0] * 8}
    desk.fake.ask(state={**released, "drives_read": {**read, "why_not": "the torque was removed"}})
    expect(said).to_contain_text("not watched. The torque was removed.")
    expect(desk.page.locator("#value-x")).to_have_text("–")
    expect(desk.page.locator("#tension-trouble")).to_have_text("8 cables are slack: at least 5 N")
    unread = {"drives_read": {**read, "why_not": "drive 3 does not answer"}, "tensions_n": None}
    desk.fake.ask(state=unread)
    expect(lamp).to_have_text("Drives not read")
    expect(said).to_have_text("Drive 3 does not answer.")
    expect(desk.page.locator("#tension-trouble")).to_have_text("Unknown.")


def test_no_number_is_a_negative_zero(desk: Visit) -> None:
    pose = {"name": "one", "position_mm": [-0.04, -0.0, 445.0], "quaternion": [1, 0, 0, 0]}
    platform = {"position_mm": [-0.04, -0.0, 445.0], "tilt_deg": -0.0, "turn_deg": -0.001}
    turned = {"rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "exits_mm": [[0, 0, 0]] * 8}
    desk.fake.ask(
        set={"poses": [pose]}, state={"platform": {**platform, **turned, "source": "drives"}}
    )
    desk.view("teach")
    expect(desk.page.locator("#poses .figure")).to_have_text("0, 0, 445 mm")
    expect(desk.page.locator("#teach-here")).to_have_text("Now at 0.0, 0.0, 445.0 mm")
    expect(desk.page.locator("#value-x")).to_have_text("0.0")
    expect(desk.page.locator("#note-tilt")).to_have_text("turn 0.00°")


# Without control.


def test_the_lamp_takes_control(desk: Visit) -> None:
    desk.view("jog")
    desk.page.get_by_role("button", name="Control is free").click()
    expect(desk.page.locator("#lamp-control")).to_have_text("You have control")
    assert len(desk.fake.received("take_control")) == 1


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("panel", ["jog", "teach", "service"])
def test_a_panel_says_why_its_controls_are_inactive_and_takes_control(
    browser: Browser, fake: Fake, size: str, panel: str
) -> None:
    with visit(browser, fake, size) as found:
        found.view(panel)
        why = found.page.locator(f"#panel-{panel} .why")
        expect(why).to_contain_text("Control is free: take it to use these controls.")
        before = controls(found.page)
        why.get_by_role("button", name="Take control").click()
        expect(why).to_have_text(re.compile("You have control"))
        expect(why.get_by_role("button")).to_be_hidden()
        assert {name: box for name, (box, _) in controls(found.page).items()} == {
            name: box for name, (box, _) in before.items()
        }


def test_a_panel_says_other_reasons_too(desk: Visit) -> None:
    desk.take_control()
    desk.view("jog")
    why = desk.page.locator("#panel-jog .why")
    desk.fake.ask(set={"latched": "slack"})
    expect(why).to_have_text(re.compile(r"^A fault is latched: reset it first\."))
    desk.fake.ask(set={"latched": None, "homed": False})
    expect(why).to_have_text(re.compile(r"^Cable 3 was switched on again\."))
    desk.fake.ask(state={"control": {"yours": False, "held_by": "page 7", "mode": "observe"}})
    expect(why).to_have_text(re.compile(r"^Page 7 has control\."))
    expect(why.get_by_role("button", name="Take control")).to_be_visible()
