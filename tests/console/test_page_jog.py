"""Jogging from the page, in a real browser: a press that ended never continues."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, expect

from tests.console.browsing import SIZES, Fake, Visit, visit

pytestmark = [pytest.mark.browser, pytest.mark.slow]


def end_by_event(target: str, event: str) -> Callable[[Visit], None]:
    return lambda found: found.page.evaluate(f"() => {target}.dispatchEvent(new {event})")


def hidden(found: Visit) -> None:
    found.page.evaluate(
        """() => {
             Object.defineProperty(document, "hidden", { get: () => true, configurable: true });
             document.dispatchEvent(new Event("visibilitychange"));
           }"""
    )


BUTTON = "document.querySelector('[data-jog].held')"
ENDS: dict[str, Callable[[Visit], Any]] = {
    "pointer up": lambda found: found.page.mouse.up(),
    "pointer cancelled": end_by_event(
        BUTTON, "PointerEvent('pointercancel', { pointerId: 1, bubbles: true })"
    ),
    "capture lost": lambda found: found.page.evaluate(f"() => {BUTTON}?.releasePointerCapture(1)"),
    "window blurred": end_by_event("window", "Event('blur')"),
    "page hidden": hidden,
    "page left": end_by_event("window", "Event('pagehide')"),
    "second pointer": end_by_event(
        "document.body", "PointerEvent('pointerdown', { pointerId: 7, bubbles: true })"
    ),
    "second mouse button": lambda found: found.page.mouse.down(button="right"),
    "menu": end_by_event(BUTTON, "MouseEvent('contextmenu', { bubbles: true })"),
    "second key": lambda found: found.page.keyboard.press("ArrowUp"),
    "other view": lambda found: found.page.evaluate(
        "() => document.getElementById('tab-teach').click()"
    ),
    "STOP by key": lambda found: found.page.keyboard.press(" "),
    "stale": lambda found: found.fake.ask(silent=True),
    "control lost": lambda found: found.fake.ask(
        state={"control": {"yours": False, "held_by": "B"}}
    ),
    "fault": lambda found: found.fake.ask(state={"latched": "slack"}),
    "not ready any more": lambda found: found.fake.ask(
        state={
            "jog": {
                "ready": False,
                "why_not": "ended",
                "moving": False,
                "limit": None,
                "speed_mm_s": 20,
            }
        }
    ),
}


#: Ends after which a page does not jog again, or has another pointer down.
LASTING = ["page hidden", "page left", "second pointer", "STOP by key", "control lost", "fault"]
LASTING += ["not ready any more"]


def ends_for_good(desk: Visit, number: int, end: Callable[[Visit], Any]) -> None:
    """One `let_go` with its number, and not one `held` after it, though the mouse stays down."""
    end(desk)
    desk.fake.wait(desk.page, lambda f: any(m["kind"] == "let_go" for m in f["received"]))
    desk.fake.ask(silent=False)
    found = [
        m for m in desk.fake.let_pass(desk.page)["received"] if m["kind"] in ("held", "let_go")
    ]
    assert found[-1] == {"kind": "let_go", "hold": number}
    assert [m["kind"] for m in found].count("let_go") == 1


def end_one_after_another(desk: Visit, button: str) -> None:
    """Every end that leaves page and server as they are, on one page."""
    for name in (name for name in ENDS if name not in LASTING):
        desk.view("jog" if button == "+x" else "service")
        desk.fake.ask(set={"received": []})
        try:
            ends_for_good(desk, desk.hold(button), ENDS[name])
        except AssertionError as error:
            raise AssertionError(f"end of a press by {name}") from error
        for mouse in ("left", "right"):
            desk.page.mouse.up(button=mouse)


def test_a_pad_does_not_have_the_focus_again_after_stale_data(desk: Visit) -> None:
    """A key that is still held does not reach it."""
    desk.ready_to_jog()
    desk.page.locator("#jog-pad").focus()
    desk.blink()
    desk.page.keyboard.down("ArrowRight")
    desk.fake.let_pass(desk.page)
    desk.page.keyboard.up("ArrowRight")
    assert desk.fake.received("held") == []


def test_a_pointer_that_slides_off_its_button_holds_it_until_it_is_lifted(desk: Visit) -> None:
    """As docs/console.md states it; the button has captured the pointer."""
    desk.ready_to_jog()
    other = desk.page.locator('[data-jog="-x"]').bounding_box()
    assert other
    number = desk.hold("+z")  # from now on a page that is held up ends the press
    desk.page.mouse.move(other["x"] + 9, other["y"] + 9)
    found = desk.fake.let_pass(desk.page)
    assert [m["hold"] for m in found["received"] if m["kind"] == "let_go"] == []
    assert {m["hold"] for m in found["received"] if m["kind"] == "held"} == {number}
    expect(desk.page.locator('[data-jog="+z"]')).to_have_class("held")
    desk.page.mouse.up()
    desk.fake.wait(desk.page, lambda f: f["received"][-1]["kind"] == "let_go")
    expect(desk.page.locator("#jog-said")).to_have_text("Released")
    expect(desk.page.locator("[data-jog].held")).to_have_count(0)


def test_a_held_jog_ends_for_good(desk: Visit) -> None:
    desk.ready_to_jog()
    end_one_after_another(desk, "+x")


@pytest.mark.parametrize("end", LASTING)
def test_a_held_jog_ends_for_good_with_what_lasts(desk: Visit, end: str) -> None:
    desk.ready_to_jog()
    ends_for_good(desk, desk.hold(), ENDS[end])


def test_what_a_held_message_says(desk: Visit) -> None:
    desk.ready_to_jog()
    desk.page.locator("input[name=jog-step][value='1']").check(force=True)
    desk.page.locator("input[name=jog-frame][value=platform]").check(force=True)
    desk.page.locator("#jog-speed").fill("15")
    first = desk.hold("-z")
    desk.page.mouse.up()
    desk.page.locator("input[name=jog-step][value=null]").check(force=True)
    second = desk.hold("+y")
    desk.page.mouse.up()
    held = desk.fake.received("held")
    assert second > first
    assert {m["hold"] for m in held} == {first, second}
    assert [m["seq"] for m in held] == sorted({m["seq"] for m in held})
    one, other = held[0], held[-1]
    assert one["direction"] == [0, 0, -1]
    assert (one["frame"], one["step_mm"], one["speed_mm_s"]) == ("platform", 1, 15)
    assert other["direction"] == [0, 1, 0]
    assert other["step_mm"] is None


def test_numbers_of_presses_rise_over_a_reload(desk: Visit) -> None:
    desk.ready_to_jog()
    first = desk.hold()
    desk.page.mouse.up()
    desk.fake.ask(set={"jog_ready": False})
    desk.page.reload()
    expect(desk.page.locator("#value-x")).to_contain_text(".")
    desk.ready_to_jog()
    assert desk.hold() > first
    desk.page.mouse.up()


def test_keys_jog_only_while_the_pad_has_the_focus(desk: Visit) -> None:
    desk.ready_to_jog()
    desk.page.locator("#jog-speed").focus()
    desk.page.keyboard.press("ArrowRight")
    desk.page.locator("#scene-in").focus()
    desk.page.keyboard.press("PageUp")
    assert [m for m in desk.fake.let_pass(desk.page)["received"] if m["kind"] == "held"] == []
    assert desk.hold_key("#jog-pad", "PageUp")["direction"] == [0, 0, 1]
    desk.page.keyboard.up("PageUp")
    desk.fake.wait(desk.page, lambda f: f["received"][-1]["kind"] == "let_go")


def test_a_key_ends_when_the_focus_goes(desk: Visit) -> None:
    desk.ready_to_jog()
    desk.hold_key("#jog-pad", "ArrowLeft")
    desk.page.locator("#jog-speed").focus()
    desk.fake.wait(desk.page, lambda f: f["received"][-1]["kind"] == "let_go")
    desk.page.keyboard.up("ArrowLeft")


def test_the_second_of_two_fingers_begins_nothing(phone: Visit) -> None:
    """The first one ends, and the second has to be lifted and put down again."""
    phone.ready_to_jog()
    press = """([name, id]) => document.querySelector(`[data-jog="${name}"]`).dispatchEvent(
      new PointerEvent("pointerdown", { pointerId: id, bubbles: true, button: 0, buttons: 1 }))"""
    lift = """id => window.dispatchEvent(new PointerEvent("pointerup", { pointerId: id }))"""
    phone.page.evaluate("() => { Element.prototype.setPointerCapture = () => {}; }")
    phone.press(
        lambda: phone.page.evaluate(press, ["+x", 11]),
        lambda: phone.page.evaluate(lift, 11),
    )
    phone.page.evaluate(press, ["+y", 12])
    phone.fake.wait(phone.page, lambda f: f["received"][-1]["kind"] == "let_go")
    assert phone.fake.let_pass(phone.page)["received"][-1]["kind"] == "let_go"


GAMEPAD = """() => {
  const buttons = Array.from({ length: 17 }, () => ({ pressed: false }));
  window.fakePad = { connected: true, mapping: "standard", axes: [0, 0, 0, 0], buttons };
  navigator.getGamepads = () => [window.fakePad];
}"""


def deflection(found: Visit, axes: list[float]) -> tuple[Callable[[], Any], Callable[[], Any]]:
    """Deflects the gamepad's sticks, and lets go of them."""
    script = "(axes) => { fakePad.axes = axes; }"
    return (
        lambda: found.page.evaluate(script, axes),
        lambda: found.page.evaluate(script, [0, 0, 0, 0]),
    )


@pytest.mark.parametrize(
    "end",
    [
        "() => { fakePad.axes = [0.1, 0, 0, 0]; }",
        "() => { fakePad.buttons[4].pressed = false; }",
        "() => { navigator.getGamepads = () => [null]; }",
        "() => { window.dispatchEvent(new Event('gamepaddisconnected')); }",
    ],
    ids=["stick centred", "shoulder released", "gone", "disconnected"],
)
def test_a_gamepad_jogs_with_a_shoulder_button_and_from_the_centre(desk: Visit, end: str) -> None:
    desk.ready_to_jog()
    desk.page.evaluate(GAMEPAD)
    desk.page.locator("#jog-gamepad").check()
    desk.page.evaluate("() => { fakePad.axes = [0, -0.5, 0, 0]; }")
    desk.fake.let_pass(desk.page)
    assert desk.fake.received("held") == []  # no shoulder button
    desk.page.evaluate("() => { fakePad.buttons[4].pressed = true; }")
    desk.fake.let_pass(desk.page)
    assert desk.fake.received("held") == []  # the stick was not at its centre before
    desk.page.evaluate("() => { fakePad.axes = [0, 0, 0, 0]; }")
    desk.fake.let_pass(desk.page, 4)
    found = desk.press(*deflection(desk, [0, -0.5, 0, 0]))
    assert found["direction"] == [0, 1, 0]
    assert found["speed_mm_s"] == pytest.approx(2.5)
    desk.page.evaluate(end)
    desk.fake.wait(desk.page, lambda f: f["received"][-1]["kind"] == "let_go")
    assert desk.fake.let_pass(desk.page)["received"][-1]["kind"] == "let_go"


def test_a_limit_is_shown_as_the_one_ahead_and_only_during_a_press(desk: Visit) -> None:
    """Its numbers are those predicted at the limit; at rest they would pass for present ones."""
    desk.ready_to_jog()
    jog = {"ready": True, "why_not": None, "moving": True, "speed_mm_s": 20.0}
    jog["limit"] = "obstacle clearance too small, pillar: 2.353 mm (limit 10 mm)"
    jog["room_mm"] = 12.0
    desk.fake.ask(state={"jog": jog})
    shown = desk.page.locator("#jog-limit")
    expect(shown).to_have_text(
        "Limit ahead: comes to rest within 12.0 mm. Farther on:"
        " obstacle clearance too small, pillar: 2.353 mm (limit 10 mm)"
    )
    desk.fake.ask(state={"jog": {**jog, "moving": False}})
    expect(shown).to_be_hidden()
    desk.hold()
    expect(shown).to_have_text(
        "Limit reached. Farther on: obstacle clearance too small, pillar: 2.353 mm (limit 10 mm)"
    )
    desk.page.mouse.up()
    expect(shown).to_be_hidden()


def test_what_rests_is_not_said_to_move(desk: Visit) -> None:
    """Such as at the limit, or after the step, while the button is still held."""
    desk.ready_to_jog()
    jog = {"ready": True, "why_not": None, "speed_mm_s": 20.0, "limit": None}
    desk.fake.ask(state={"jog": {**jog, "moving": False}})
    desk.hold()
    expect(desk.page.locator("#jog-state")).to_have_text("At rest: release, then press again")
    expect(desk.page.locator("#motion-text")).to_have_text("Ready to jog")
    desk.fake.ask(state={"jog": {**jog, "moving": True}})
    expect(desk.page.locator("#jog-state")).to_have_text("Moving")
    expect(desk.page.locator("#motion-text")).to_have_text("Jogging")
    why = "press 7: its line does not begin where the platform rests"
    desk.fake.ask(state={"jog": {**jog, "moving": False, "not_begun": why}})
    expect(desk.page.locator("#jog-limit")).to_contain_text(f"Not begun: {why}")
    desk.page.mouse.up()


def test_the_state_of_a_pad_begins_with_a_capital_letter(desk: Visit) -> None:
    at_rest = {"ready": False, "why_not": "a fault is latched", "moving": False}
    for panel in ("jog", "cable"):
        desk.fake.ask(state={panel: at_rest})
        expect(desk.page.locator(f"#{panel}-state")).to_have_text("A fault is latched")


def test_the_distance_of_a_press_is_called_its_limit(desk: Visit) -> None:
    for panel in ("jog", "service"):
        desk.view(panel)
        expect(desk.page.locator(f"#panel-{panel}")).to_contain_text(
            "At most per press: hold until it has moved"
        )


def test_the_pad_stays_where_it_is_whatever_is_shown(browser: Browser, fake: Fake) -> None:
    """A finger that comes down again must not find another direction."""
    for size in SIZES:
        with visit(browser, fake, size) as found:
            found.view("jog")
            before = found.page.locator("#jog-pad").bounding_box()
            found.ready_to_jog()
            jog = {"ready": True, "why_not": None, "moving": True, "speed_mm_s": 20.0}
            limit = "obstacle clearance too small, platform – obstacle_1"
            outcome = {"verb": "jog", "ok": False, "text": "a\n" * 20, "report": None}
            changes = {
                "jog": {**jog, "limit": limit, "room_mm": 17.1},
                "latched": "slack: cable 3 " * 4,
            }
            busy = {"verb": "jog", "text": "a long line about the command in progress " * 3}
            more = {"outcome": {**outcome, "fault_page": "/help/slack"}, "busy": busy}
            found.hold()
            found.page.evaluate("() => window.dispatchEvent(new Event('blur'))")
            found.page.mouse.up()
            expect(found.page.locator("#jog-said")).to_contain_text("Ended: the window lost")
            why = "cable 3 was switched on again"
            lamps = {"reference": {"counts": False, "known": True, "why_not": why}}
            found.fake.ask(state={**changes, **more, **lamps})
            expect(found.page.locator("#jog-limit")).to_contain_text("comes to rest within 17.1 mm")
            expect(found.page.locator("#latched")).to_be_visible()
            assert found.page.locator("#jog-pad").bounding_box() == before, size


@pytest.mark.parametrize(("ready", "button"), [("jog", "+z"), ("jog_cables", "wind_in")])
def test_the_reason_why_a_press_ended_is_shown_whole(phone: Visit, ready: str, button: str) -> None:
    """It was cut to "End…" beside the state, and a finger opens no tooltip."""
    getattr(phone, f"ready_to_{ready}")()
    phone.hold(button)
    assert phone.audit("cut") == []
    phone.page.evaluate("() => window.dispatchEvent(new Event('blur'))")
    phone.page.mouse.up()
    words = phone.page.locator(f"#{ready.split('_')[-1].removesuffix('s')}-words .heading")
    expect(words).to_contain_text("Ended: the window lost the focus")
    expect(words).to_contain_text("Ready: hold a button to move")
    assert phone.audit("cut") == []
    assert phone.audit("overlapping") == []


def test_random_sequences_hold_only_what_is_pressed(desk: Visit) -> None:
    """100 000 events: nothing is held unpressed, refused, after its end or after a gap."""
    sequences = (Path(__file__).parent / "hold_sequences.js").read_text(encoding="utf-8")
    script = sequences.split("*/", 1)[1].strip()
    run = f"async (seed) => ({script})((await import('/static/hold.js')).Hold, 100000, seed)"
    for seed in range(5):
        found = desk.page.evaluate(run, seed)
        assert found["wrong"] == [], seed
        assert found["held"] > 10_000
        assert found["ended"] > 5_000
