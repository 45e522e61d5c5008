"""One cable from the page, in a real browser: in service mode only, by the rules of a jog."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from playwright.sync_api import Browser, expect

from tests.console.browsing import SIZES, Fake, Visit, visit
from tests.console.test_page_jog import (
    ENDS,
    GAMEPAD,
    LASTING,
    deflection,
    end_one_after_another,
    ends_for_good,
)

pytestmark = [pytest.mark.browser, pytest.mark.slow]

AT_REST = {"ready": False, "why_not": "ended", "moving": False, "cable": None, "press_mm": None}
AT_REST |= {"session_mm": None, "limit": None, "limit_n": None, "speed_mm_s": 20.0}  # type: ignore[dict-item]
LASTING_OF_CABLES: dict[str, Callable[[Visit], Any]] = {
    **{name: ENDS[name] for name in LASTING},
    "not ready any more": lambda found: found.fake.ask(state={"cable": AT_REST}),
    "service mode left": lambda found: found.fake.ask(
        state={"control": {"yours": True, "held_by": "A", "mode": "operate"}}
    ),
    "another cable": lambda found: found.page.evaluate(
        "() => document.querySelector('input[name=cable][value=\"5\"]').click()"
    ),
}


def test_a_held_cable_ends_for_good(desk: Visit) -> None:
    desk.ready_to_jog_cables()
    end_one_after_another(desk, "wind_in")


@pytest.mark.parametrize("end", LASTING_OF_CABLES)
def test_a_held_cable_ends_for_good_with_what_lasts(desk: Visit, end: str) -> None:
    desk.ready_to_jog_cables()
    ends_for_good(desk, desk.hold("wind_in"), LASTING_OF_CABLES[end])


def test_what_a_held_message_says(desk: Visit) -> None:
    desk.ready_to_jog_cables()
    desk.page.locator("input[name=cable][value='6']").check(force=True)
    desk.page.locator("input[name=cable-step][value='0.1']").check(force=True)
    desk.page.locator("#cable-speed").fill("3")
    desk.hold("pay_out")
    desk.page.mouse.up()
    (one, *_) = desk.fake.received("held")
    expected = {"kind": "held", "cable": 6, "sense": "pay_out", "step_mm": 0.1, "speed_mm_s": 3}
    assert {k: one[k] for k in expected} == expected
    assert set(one) == {*expected, "hold", "seq", "state"}


def test_nothing_is_possible_outside_service_mode(desk: Visit) -> None:
    desk.take_control()
    desk.view("service")
    for button in ("#cable-begin", '[data-jog="wind_in"]', '[data-jog="pay_out"]'):
        expect(desk.page.locator(button)).to_have_attribute("aria-disabled", "true")
        expect(desk.page.locator(button)).to_have_attribute("title", "Enter service mode first")
    desk.page.locator("#cable-pad").focus()
    desk.page.keyboard.down("ArrowUp")
    assert [m for m in desk.fake.let_pass(desk.page)["received"] if m["kind"] == "held"] == []
    desk.page.keyboard.up("ArrowUp")
    desk.page.locator("#service-begin").click()
    expect(desk.page.locator("#dialog")).to_contain_text("Obstacles, workspace")
    desk.page.locator("#dialog button", has_text="Cancel").click()
    assert desk.fake.received("service_begin") == []


@pytest.mark.parametrize("homed", [True, False])
def test_what_it_means_for_the_reference_is_said_before(desk: Visit, homed: bool) -> None:
    desk.take_control()
    desk.fake.ask(set={"homed": homed, "service": True})
    desk.view("service")
    desk.page.locator("#cable-begin").click()
    text = "the reference stays" if homed else "are not homed"
    expect(desk.page.locator("#dialog .cause")).to_contain_text(text)
    assert desk.fake.received("cable_begin") == []


def test_keys_wind_in_and_pay_out_while_the_pad_has_the_focus(desk: Visit) -> None:
    desk.ready_to_jog_cables()
    for key, sense in (("ArrowUp", "wind_in"), ("PageDown", "pay_out")):
        found = desk.hold_key("#cable-pad", key)
        assert (found["cable"], found["sense"]) == (1, sense)
        desk.page.keyboard.up(key)
        desk.fake.wait(desk.page, lambda f: f["received"][-1]["kind"] == "let_go")


def test_a_key_that_is_held_ends_with_a_finger_and_begins_nothing(desk: Visit) -> None:
    """The second control ends the press of the first and does not begin its own."""
    desk.ready_to_jog_cables()
    desk.hold_key("#cable-pad", "ArrowUp")
    desk.page.locator('[data-jog="pay_out"]').hover()
    desk.page.mouse.down()
    desk.fake.wait(desk.page, lambda f: f["received"][-1]["kind"] == "let_go")
    assert desk.fake.let_pass(desk.page)["received"][-1]["kind"] == "let_go"
    desk.page.mouse.up()
    desk.page.keyboard.up("ArrowUp")


@pytest.mark.parametrize(
    ("axes", "sense"), [([0, -0.5, 0, 0], "wind_in"), ([0, 0, 0, 0.6], "pay_out")]
)
def test_a_stick_winds_in_and_pays_out_and_ends_when_it_changes_direction(
    desk: Visit, axes: list[float], sense: str
) -> None:
    desk.ready_to_jog_cables()
    desk.page.evaluate(GAMEPAD)
    desk.page.locator("#cable-gamepad").check()
    desk.page.evaluate("() => { fakePad.buttons[4].pressed = true; }")
    desk.fake.let_pass(desk.page, 4)
    assert desk.press(*deflection(desk, axes))["sense"] == sense
    desk.page.evaluate("(axes) => { fakePad.axes = axes.map((v) => -v); }", axes)
    desk.fake.wait(desk.page, lambda f: f["received"][-1]["kind"] == "let_go")
    assert desk.fake.let_pass(desk.page)["received"][-1]["kind"] == "let_go", (
        "not the other direction"
    )


def test_tension_and_travel_are_shown(desk: Visit) -> None:
    desk.ready_to_jog_cables()
    cable = {
        **AT_REST,
        "ready": True,
        "moving": True,
        "cable": 3,
        "press_mm": -0.25,
        "limit_n": 62.0,
    }
    travel = [0.0, 0.0, 1.25, 0.0, 0.0, 0.0, 0.0, 0.0]
    limit = "cable 3 carries 55.1 N, near the limit of 62 N"
    desk.fake.ask(
        state={
            "cable": {**cable, "session_mm": travel, "limit": limit},
            "tensions_n": [20.0, 20.0, 55.1, 20.0, 20.0, 20.0, 20.0, 20.0],
        }
    )
    desk.page.locator("input[name=cable][value='3']").check(force=True)
    expect(desk.page.locator("#cable-tension")).to_have_text("Cable 3: 55.1\u00a0N")
    expect(desk.page.locator("#cable-range")).to_contain_text("limit 62\u00a0N")
    expect(desk.page.locator("#cable-travel")).to_have_text(
        "This press: 0.250\u00a0mm wound in · since the session began 1.250\u00a0mm paid out"
    )
    expect(desk.page.locator("#cable-limit")).to_have_text(limit)


def test_the_pad_stays_where_it_is_whatever_is_shown(browser: Browser, fake: Fake) -> None:
    for size in SIZES:
        with visit(browser, fake, size) as found:
            found.ready_to_jog_cables()
            before = found.page.locator("#cable-pad").bounding_box()
            outcome = {"verb": "jog", "ok": False, "text": "a\n" * 20, "report": None}
            limit = "cable 3 carries 55.1 N, near the limit of 62 N"
            cable = {**AT_REST, "ready": True, "moving": True, "cable": 3, "limit": limit}
            fake.ask(
                state={
                    "cable": {**cable, "session_mm": [0.0] * 8, "limit_n": 62.0},
                    "outcome": {**outcome, "fault_page": None},
                }
            )
            expect(found.page.locator("#cable-limit")).to_be_visible()
            assert found.page.locator("#cable-pad").bounding_box() == before, size
