"""The page's controls, in a real browser: which is possible when, and who can use them."""

from __future__ import annotations

import json
from typing import Any, Literal

import pytest
from playwright.sync_api import Browser, expect

from cdpr.console import commands
from tests.console.browsing import SIZES, VIEWS, Fake, Visit, visit

pytestmark = [pytest.mark.browser, pytest.mark.slow]
WEBGL = True


def state_of(**changes: Any) -> dict[str, Any]:
    """A state at rest, with control, homed, and with a plan."""
    return {
        "read_only": False,
        "control": {"yours": True, "held_by": "A", "mode": "operate"},
        "latched": None,
        "reference": {"counts": True, "known": True, "why_not": None},
        "busy": None,
        "motion": None,
        "platform": {},
        "preview": "1",
        "jog": {"ready": False, "why_not": None, "moving": False},
        "cable": {"ready": False, "why_not": None, "moving": False},
        "poses": [{}, {}],
        **changes,
    }


def moving(state: str, **wished: Any) -> dict[str, Any]:
    return {
        "state": state,
        "wished": {"stop": False, "hold": False, "speed_percent": 100, **wished},
    }


RUN = {"verb": "run", "text": ""}
PLANS = {"load_plan", "compare", "compare_end", "plan", "plan_poses", "go_to"}
PLANS |= {"plan_files", "scene_files"}
REST = {"home", "release", "read_drives", "run", "jog_begin", "service_begin"} | PLANS
ALWAYS = {"stop", "jog_setting", "cable_setting", "plan_setting"}
SERVICE = {"yours": True, "held_by": "A", "mode": "service"}
TAUGHT = {"teach", "teach_at", "edit_pose", "give_control"}
SELECTED = {"plan_file": "a.json", "scene_file": "b.yaml", "from_here": False}
#: Name, situation, and the buttons that are possible in it; all others are not.
TABLE: list[tuple[str, dict[str, Any], set[str]]] = [
    ("at rest", {}, ALWAYS | TAUGHT | REST),
    ("stale", {"stale": "No data for 0.9 s"}, {"stop"}),
    ("never heard", {"state": None, "stale": "Waiting for data"}, {"stop"}),
    ("read-only", {"read_only": True}, {"stop"}),
    ("control is free", {"control": {"yours": False, "held_by": None}}, ALWAYS | {"take_control"}),
    (
        "another has control",
        {"control": {"yours": False, "held_by": "B"}},
        ALWAYS | {"take_control"},
    ),
    (
        "latched",
        {"latched": "slack"},
        (ALWAYS | TAUGHT | REST | {"reset"}) - {"home", "run", "jog_begin"},
    ),
    (
        "latched, run over",
        {"latched": "x", "motion": moving("latched")},
        (ALWAYS | TAUGHT | REST | {"reset"}) - {"home", "run", "jog_begin"},
    ),
    (
        "not homed",
        {"reference": {"counts": False, "known": True, "why_not": "x"}},
        (ALWAYS | TAUGHT | REST) - {"run", "jog_begin"},
    ),
    ("no plan", {"preview": None}, (ALWAYS | TAUGHT | REST) - {"run", "compare"}),
    ("plan failed", {"plan": {"passed": False}}, (ALWAYS | TAUGHT | REST) - {"run"}),
    ("plan not read yet", {"plan": None}, (ALWAYS | TAUGHT | REST) - {"run"}),
    ("planning", {"busy": {"verb": "plan", "text": ""}}, ALWAYS | TAUGHT),
    (
        "homing",
        {"busy": {"verb": "home", "text": ""}, "motion": moving("moving")},
        ALWAYS | TAUGHT | {"hold", "speed"},
    ),
    ("loading", {"busy": {"verb": "load", "text": ""}}, ALWAYS | TAUGHT),
    (
        "loading during a run of a terminal",
        {"busy": {"verb": "load", "text": ""}, "motion": moving("moving")},
        ALWAYS | TAUGHT | {"hold", "speed"},
    ),
    ("preparing", {"busy": RUN, "motion": moving("preparing")}, ALWAYS | TAUGHT),
    ("moving", {"busy": RUN, "motion": moving("moving")}, ALWAYS | TAUGHT | {"hold", "speed"}),
    ("moved by another program", {"motion": moving("moving")}, ALWAYS | TAUGHT | {"hold", "speed"}),
    (
        "held",
        {"busy": RUN, "motion": moving("holding", hold=True)},
        ALWAYS | TAUGHT | {"resume", "speed"},
    ),
    ("stopping", {"busy": RUN, "motion": moving("stopping", stop=True)}, ALWAYS | TAUGHT),
    ("stopped", {"motion": moving("stopped", stop=True)}, ALWAYS | TAUGHT | REST),
    (
        "jogging",
        {"busy": {"verb": "jog", "text": ""}, "jog": {"ready": True, "why_not": None}},
        ALWAYS | TAUGHT | {"jog", "jog_end"},
    ),
    (
        "jogging, in motion",
        {
            "busy": {"verb": "jog", "text": ""},
            "jog": {"ready": True, "why_not": None},
            "motion": moving("moving"),
        },
        ALWAYS | TAUGHT | {"jog", "jog_end"},
    ),
    (
        "service mode",
        {"control": SERVICE, "reference": {"counts": False, "known": True, "why_not": "x"}},
        (ALWAYS | TAUGHT | REST | {"service_end", "cable_begin"})
        - {"service_begin", "run", "jog_begin"},
    ),
    (
        "service mode, latched",
        {"control": SERVICE, "latched": "slack"},
        (ALWAYS | TAUGHT | REST | {"reset", "service_end"})
        - {"service_begin", "home", "run", "jog_begin"},
    ),
    (
        "cables are jogged",
        {
            "control": SERVICE,
            "busy": {"verb": "jog", "text": ""},
            "cable": {"ready": True, "why_not": None},
            "motion": moving("moving"),
        },
        ALWAYS | TAUGHT | {"service_end", "cable", "jog_end"},
    ),
    (
        "cables are jogged by a page that is not in service mode",
        {
            "busy": {"verb": "jog", "text": ""},
            "cable": {"ready": True, "why_not": None},
            "motion": moving("moving"),
        },
        ALWAYS | TAUGHT | {"service_begin", "jog_end"},
    ),
    ("jogging begins", {"busy": {"verb": "jog", "text": ""}}, ALWAYS | TAUGHT | {"jog_end"}),
    (
        "position not known",
        {"platform": None},
        (ALWAYS | TAUGHT | REST) - {"teach", "teach_at", "go_to"},
    ),
    (
        "position not known, path from the current pose",
        {"platform": None, "form": {**SELECTED, "from_here": True}},
        (ALWAYS | TAUGHT | REST) - {"teach", "teach_at", "go_to", "plan_poses"},
    ),
    ("one pose", {"poses": [{}]}, (ALWAYS | TAUGHT | REST) - {"plan_poses"}),
    (
        "one pose, path from the current pose",
        {"poses": [{}], "form": {**SELECTED, "from_here": True}},
        ALWAYS | TAUGHT | REST,
    ),
    ("no pose", {"poses": []}, (ALWAYS | TAUGHT | REST) - {"plan_poses", "go_to", "edit_pose"}),
    (
        "no plan file selected",
        {"form": {**SELECTED, "plan_file": None}},
        (ALWAYS | TAUGHT | REST) - {"load_plan", "compare"},
    ),
    (
        "no scene file selected",
        {"form": {**SELECTED, "scene_file": None}},
        (ALWAYS | TAUGHT | REST) - {"plan"},
    ),
]


def test_the_table_of_buttons(desk: Visit) -> None:
    """State × button: what is possible, and a reason for everything that is not."""
    ask = """async (situation) => {
      const { BUTTONS, whyNot } = await import("/static/buttons.js");
      const names = Object.keys(BUTTONS);
      return Object.fromEntries(names.map((name) => [name, whyNot(name, situation)]));
    }"""
    for name, changes, possible in TABLE:
        stale, plan = changes.get("stale"), changes.get("plan", {"passed": True})
        state = (
            None
            if "state" in changes
            else state_of(
                **{k: v for k, v in changes.items() if k not in ("stale", "plan", "form")}
            )
        )
        situation = {"state": state, "stale": stale, "preview": plan}
        situation["form"] = changes.get("form", SELECTED)
        reasons = desk.page.evaluate(ask, situation)
        assert {button for button, reason in reasons.items() if reason is None} == possible, name
        assert all(reason for button, reason in reasons.items() if button not in possible), name
    tried = {button for _, _, possible in TABLE for button in possible}
    assert tried == set(reasons), "a button that no state of the table allows"


def test_every_button_is_in_the_table_and_says_why_it_is_not_possible(desk: Visit) -> None:
    desk.fake.ask(state={"control": {"yours": False, "held_by": "page 7"}})
    hold = desk.page.locator("#hold")
    expect(hold).to_have_attribute("aria-disabled", "true")
    expect(hold).to_have_attribute("title", "Page 7 has control")
    expect(hold).to_have_attribute("aria-description", "Page 7 has control")
    hold.click(force=True)
    expect(desk.page.locator("#notice")).to_have_text("Hold: Page 7 has control.")
    names = desk.page.evaluate(
        "() => [...document.querySelectorAll('[data-button]')].map(e => e.dataset.button)"
    )
    known = desk.page.evaluate(
        "async () => Object.keys((await import('/static/buttons.js')).BUTTONS)"
    )
    assert set(names) <= set(known)
    assert desk.fake.received("hold") == []


def test_a_press_that_ends_while_data_are_stale_is_not_lost_silently(desk: Visit) -> None:
    """The browser sends no click then."""
    desk.take_control()
    desk.view("teach")
    mouse = desk.move_to("#teach")
    mouse.down()
    with desk.stale():
        mouse.up()
    notice = desk.page.locator("#notice")
    expect(notice).to_contain_text("Teach this pose: not done. No data from the console’s server")
    desk.fake.let_pass(desk.page)
    assert desk.fake.received("teach") == []
    desk.send("teach", "#teach")
    expect(desk.page.locator("#notice-box")).to_be_hidden()


def test_a_press_that_begins_while_data_are_stale_is_not_lost_silently(desk: Visit) -> None:
    desk.take_control()
    desk.view("teach")
    mouse = desk.move_to("#teach")
    with desk.stale():
        mouse.down()
    mouse.up()
    expect(desk.page.locator("#notice")).to_have_text("Not done: data were not current.")
    desk.fake.let_pass(desk.page)
    assert desk.fake.received("teach") == []


def test_enter_held_since_data_were_stale_presses_nothing(desk: Visit) -> None:
    """Its repetitions would press the button that has the focus again."""
    desk.take_control()
    desk.load()
    desk.run()
    desk.send("hold", "#hold")
    resume, keyboard = desk.page.locator("#resume"), desk.page.keyboard
    expect(resume).not_to_have_attribute("aria-disabled", "true")
    resume.focus()
    with desk.stale():
        keyboard.down("Enter")
    expect(desk.page.locator("#notice")).to_have_text("Not done: data were not current.")
    expect(resume).to_be_focused()
    keyboard.down("Enter")  # repeats
    desk.fake.let_pass(desk.page)
    assert desk.fake.received("resume") == []
    keyboard.up("Enter")
    keyboard.press("Enter")
    desk.fake.wait(desk.page, lambda f: any(m.get("command") == "resume" for m in f["received"]))


# For everybody.


def fill_everything(found: Visit) -> None:
    """A page that shows as much as it can."""
    found.take_control()
    found.load()
    found.view("teach")
    found.page.locator("#teach").click()
    expect(found.page.locator("#poses li")).to_have_count(1)
    found.view("operate")
    found.run()
    slow = {"stop": False, "hold": False, "speed_percent": 1}  # the run outlasts every test
    found.fake.ask(
        set={"latched": "slack: cable 3", "wished": slow},
        state={"tensions_n": [20, 20, 1.8, 20, 20, 20, 104.2, 20]},
    )
    found.fake.ask(
        set={
            "outcome": {
                "verb": "plan",
                "ok": True,
                "text": "done",
                "report": None,
                "fault_page": None,
            }
        }
    )
    expect(found.page.locator("#latched")).to_be_visible()


@pytest.mark.parametrize("size", ["phone", "desk"])
def test_texts_have_the_contrast_of_wcag_aa(browser: Browser, fake: Fake, size: str) -> None:
    """4.5 to 1 for every text, 3 to 1 for large ones; also when data are stale."""
    schemes: tuple[Literal["light", "dark"], ...] = ("light", "dark")
    with visit(browser, fake, size) as found:
        fill_everything(found)
        weak = []
        for view in VIEWS:
            found.view(view)
            for scheme in schemes:
                found.page.emulate_media(color_scheme=scheme)
                weak += found.audit("weak")
        found.fake.ask(silent=True)
        expect(found.page.locator("#stale")).to_be_visible()
        for scheme in schemes:
            found.page.emulate_media(color_scheme=scheme)
            weak += found.audit("weak")
        assert weak == []


@pytest.mark.parametrize("size", SIZES)
def test_nothing_is_cut_off_and_touch_targets_are_large(
    browser: Browser, fake: Fake, size: str
) -> None:
    with visit(browser, fake, size) as found:
        fill_everything(found)
        for view in VIEWS:
            found.view(view)
            assert (
                found.page.evaluate("() => document.documentElement.scrollWidth - innerWidth") <= 0
            ), view
            assert found.audit("small") == [], view
            assert found.audit("cut") == [], view


def test_many_cables_and_a_long_name_cover_nothing(desk: Visit) -> None:
    """At every width; that drives are simulated is always shown."""
    name = "large_hall_of_the_institute_with_a_name_of_some_length_and_number_0815"
    read = {"at": "2026-01-28T19:12:05", "why_not": None}
    for cables in (8, 10, 24):
        tensions = [8.0 + 3.5 * k for k in range(cables)]
        desk.fake.ask(state={"rig": name, "tensions_n": tensions, "drives_read": read})
        expect(desk.page.locator("#tensions li")).to_have_count(cables)
        for width, height in ((320, 640), (390, 844), (768, 1024), (1024, 768), (1400, 780)):
            desk.page.set_viewport_size({"width": width, "height": height})
            desk.view("live")
            assert desk.audit("overlapping") == [], (cables, width)
            assert desk.audit("cut") == [], (cables, width)


def test_curves_that_do_not_yet_follow_a_narrower_window_do_not_widen_the_page(
    phone: Visit,
) -> None:
    fill_everything(phone)
    phone.view("live")
    curves = phone.page.locator("#live .plotted > *")
    expect(curves).to_have_count(3)
    curves.evaluate_all("(all) => { for (const curve of all) curve.style.width = '900px'; }")
    assert phone.page.evaluate("() => document.documentElement.scrollWidth <= innerWidth")


def test_everything_has_a_name_and_is_reached_by_keyboard(desk: Visit) -> None:
    """Every control that is shown, in every view, by Tab or, for tabs and radios, by an arrow."""
    fill_everything(desk)
    for view in VIEWS[1:]:
        desk.view(view)
        wanted = set(desk.audit("tabbable"))
        reached: set[str] = set()
        desk.page.evaluate("() => document.activeElement.blur()")
        for _ in range(90):
            if wanted <= reached:
                break
            desk.page.keyboard.press("Tab")
            reached |= set(desk.audit("nameOf", "document.activeElement"))
            wanted &= set(desk.audit("tabbable"))  # a notice is shown for some seconds only
        assert wanted - reached == set(), view
        assert desk.audit("unnamed") == [], view


def test_homing_without_a_camera_says_that_the_pose_is_stated_and_not_measured(desk: Visit) -> None:
    """Else the platform would be taken to be at home wherever it hangs."""
    desk.fake.ask(state={"home_mm": [0.0, -12.0, 180.44]})
    desk.take_control()
    desk.fake.let_pass(desk.page)
    desk.page.locator("#home").click()
    expect(desk.page.locator("#dialog .cause")).to_contain_text("held by the jig")
    expect(desk.page.locator("#dialog .cause")).to_contain_text("0, \u221212, 180.44 mm")
    expect(desk.page.locator(".confirm")).to_contain_text("On the jig")
    desk.page.locator("#dialog button", has_text="Cancel").click()
    desk.fake.ask(state={"homes_by": "front=0"})
    desk.fake.let_pass(desk.page)  # the question is that of the state when the button is clicked
    desk.page.locator("#home").click()
    expect(desk.page.locator("#dialog .cause")).to_contain_text("Camera front=0 measures")
    assert desk.fake.received("home") == []


def test_a_speed_slider_that_is_put_back_shows_the_run_s_speed_again(desk: Visit) -> None:
    """Browsers report no change then, and nothing is sent."""
    more = {"age_s": 0.0, "elapsed_s": 1.0, "cameras": [], "drives": [], "events": []}
    desk.take_control()
    desk.fake.ask(state={"motion": {**moving("moving", speed_percent=50), **more}})
    slider, shown = desk.page.locator("#speed"), desk.page.locator("#speed-shown")
    expect(shown).to_have_text("50 %")
    box, mouse = slider.bounding_box(), desk.page.mouse
    assert box
    middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    mouse.move(*middle)
    mouse.down()
    mouse.move(middle[0] + box["width"] / 4, middle[1])
    expect(shown).not_to_have_text("50 %")
    for step in range(-20, 20):  # back, to the value at which it was pressed
        if slider.input_value() != "50":
            mouse.move(middle[0] + step / 4, middle[1])
    expect(shown).to_have_text("50 %")
    mouse.up()
    desk.fake.ask(state={"motion": {**moving("moving", speed_percent=100), **more}})
    expect(shown).to_have_text("100 %")
    assert desk.fake.received("speed") == []


def test_the_server_understands_every_message_of_the_page(desk: Visit) -> None:
    """The fake server takes anything; what the real one takes is in `cdpr.console.commands`."""
    page = desk.page
    desk.take_control()
    desk.load()
    desk.send("compare", "#compare-plan")
    desk.send("compare", "#compare-end")
    desk.run()
    page.locator("#speed").fill("50")
    desk.send("hold", "#hold")
    desk.send("resume", "#resume")
    page.keyboard.press(" ")
    expect(page.locator("#outcome")).to_be_visible()
    for name in ("home", "release"):
        desk.send(name, f"#{name}", ".confirm")
    desk.fake.ask(set={"latched": "slack", "homed": True}, state={"simulated": False})
    desk.send("read_drives", "#read-drives")
    desk.send("reset", "#reset", ".confirm")
    page.locator("summary", has_text="Make a plan").click()
    desk.choose("scene-file", desk.fake.ask()["files"]["scenes"][0])
    desk.send("plan", "#make-plan")
    expect(page.locator("#outcome-show")).to_be_visible()
    desk.view("teach")
    for _ in range(2):
        desk.send("teach", "#teach")
    expect(page.locator("#poses li")).to_have_count(2)
    desk.pick()
    desk.send("teach_at", "#pick-keep")
    expect(page.locator("#poses li")).to_have_count(3)
    desk.send("move", "[aria-label='Move pose 2 up']")
    expect(page.locator("#poses li").first.locator("input")).to_have_value("pose 2")
    page.get_by_role("textbox", name="Name of pose 1").fill("grip")
    page.get_by_role("textbox", name="Name of pose 1").press("Enter")
    desk.send("plan", "#plan-poses")
    desk.fake.wait(page, lambda found: found["plan"] is not None)
    desk.send("plan", "[aria-label='Plan a path to grip']")
    desk.fake.wait(page, lambda found: found["plan"] is not None)
    desk.send("forget", "[aria-label='Remove pose 1']", ".confirm")
    expect(page.locator("#poses li")).to_have_count(2)
    desk.view("jog")
    desk.send("jog_begin", "#jog-begin")
    expect(page.locator("#jog-state")).to_contain_text("Ready")
    for step in ("0.1", "1", "10", "null"):
        desk.choose("jog-step", step)
        desk.hold()
        page.mouse.up()
    desk.send("jog_end", "#jog-end")
    desk.view("operate")
    desk.send("give_control", "#give-control")
    expect(page.locator("#lamp-control")).to_have_text("Control is free")
    said = desk.fake.ask()["received"]
    names = {m.get("command", m["kind"]) for m in said}
    assert names == {
        *("take_control", "give_control", "load_plan", "plan", "run", "speed", "hold", "resume"),
        *(
            "stop",
            "home",
            "release",
            "read_drives",
            "reset",
            "teach",
            "teach_at",
            "compare",
            "move",
            "rename",
            "forget",
        ),
        *("jog_begin", "held", "let_go", "jog_end"),
    }
    for message in said:
        commands.parse_message(json.dumps(message))
