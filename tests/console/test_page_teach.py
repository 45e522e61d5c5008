"""Files, taught poses and the plans made of them on the console's page, in a real browser."""

from __future__ import annotations

from typing import Any

import pytest
from playwright.sync_api import expect

from tests.console.browsing import Visit

pytestmark = [pytest.mark.browser, pytest.mark.slow]

POSE = {"name": "one", "position_mm": [100.0, 50.0, 400.0], "quaternion": [1, 0, 0, 0]}


def selected(found: Visit, group: str) -> Any:
    return found.page.evaluate(
        f"() => document.querySelector('input[name={group}]:checked')?.value ?? null"
    )


def read_files(found: Visit, **files: list[str]) -> None:
    """The page reads the lists of files again, as after every verb."""
    found.fake.ask(set={"files": {"scenes": [], "plans": [], "left_out": [], **files}})
    found.fake.ask(state={"busy": {"verb": "plan", "text": ""}})
    expect(found.page.locator("#busy")).to_be_visible()
    with found.page.expect_response("**/api/files*"):
        found.fake.ask(state={"busy": None})
    found.fake.let_pass(found.page, 2)


# Files.


def test_a_single_file_and_a_new_file_are_selected(desk: Visit) -> None:
    desk.take_control()
    scenes = desk.fake.ask()["files"]["scenes"]
    assert (selected(desk, "plan-file"), selected(desk, "scene-file")) == (None, None)
    read_files(desk, plans=["a.json"], scenes=scenes)
    assert (selected(desk, "plan-file"), selected(desk, "scene-file")) == ("a.json", None)
    read_files(desk, plans=["a.json", "b.json"], scenes=scenes)
    assert (selected(desk, "plan-file"), selected(desk, "scene-file")) == ("b.json", None)
    desk.page.locator("input[name=plan-file][value='a.json']").check(force=True)
    read_files(desk, plans=["a.json", "b.json"], scenes=scenes)
    assert selected(desk, "plan-file") == "a.json", "the operator's choice stays"


def test_a_list_of_files_that_is_not_complete_says_so(desk: Visit) -> None:
    note = desk.page.locator("#files-note")
    expect(note).to_be_hidden()
    read_files(desk, plans=["a.json"], left_out=["b\ufffd.json"])
    expect(note).to_contain_text("b\ufffd.json")
    desk.page.route("**/api/files*", lambda route: route.fulfill(status=500))
    read_files(desk, plans=["b.json"])
    expect(note).to_contain_text("could not be listed (error 500)")
    assert selected(desk, "plan-file") == "a.json", "the last list stays"
    desk.page.unroute("**/api/files*")
    read_files(desk, plans=["a.json"])
    expect(note).to_be_hidden()
    assert len(desk.errors) == 1, "the browser's own, on that error"
    desk.errors.clear()


def test_without_a_selected_file_its_buttons_are_inactive_and_say_why(desk: Visit) -> None:
    desk.fake.ask(set={"plan": "plans/circle.json"})
    desk.take_control()
    desk.page.locator("summary", has_text="Make a plan").click()
    for kind, buttons in (("plan", ("load-plan", "compare-plan")), ("scene", ("make-plan",))):
        for inactive in (desk.page.locator(f"#{button}") for button in buttons):
            expect(inactive).to_have_attribute("aria-disabled", "true")
            expect(inactive).to_have_attribute("title", f"Select a {kind} file first")
        desk.page.locator(f"input[name={kind}-file]").first.check(force=True)
        for active in (desk.page.locator(f"#{button}") for button in buttons):
            expect(active).not_to_have_attribute("aria-disabled", "true")


# Names.


def test_quick_presses_store_poses_with_different_names(desk: Visit) -> None:
    """The next press does not wait until the list shows the pose of the last one."""
    desk.take_control()
    desk.view("teach")
    desk.page.locator("#teach").evaluate("(teach) => [1, 2, 3].forEach(() => teach.click())")
    found = desk.fake.wait(desk.page, lambda f: len(f["poses"]) == 3)
    assert [pose["name"] for pose in found["poses"]] == ["pose 1", "pose 2", "pose 3"]


def test_a_name_typed_before_the_last_answer_stays(desk: Visit) -> None:
    desk.take_control()
    desk.view("teach")
    field = desk.page.locator("#teach-name")
    field.fill("left")
    desk.page.evaluate(
        """() => {
          document.getElementById("teach").click();
          document.getElementById("teach-name").value = "right";
        }"""
    )
    expect(desk.page.locator("#poses li input")).to_have_value("left")
    desk.fake.let_pass(desk.page)
    expect(field).to_have_value("right")
    desk.send("teach", "#teach")
    expect(field).to_have_value("")


def test_a_refusal_is_shown_until_a_command_succeeds(desk: Visit) -> None:
    desk.take_control()
    desk.view("teach")
    desk.fake.ask(set={"refusal": "this name is taken"})
    desk.page.locator("#teach").click()
    expect(desk.page.locator("#notice")).to_have_text("this name is taken")
    desk.fake.ask(set={"refusal": ""})
    desk.fake.let_pass(desk.page)
    expect(desk.page.locator("#notice-box")).to_be_visible()
    desk.page.locator("#teach").click()
    expect(desk.page.locator("#poses li")).to_have_count(1)
    expect(desk.page.locator("#notice-box")).to_be_hidden(timeout=1000)


def test_a_pose_is_renamed_once_its_name_is_complete(desk: Visit) -> None:
    """Not to a part of it, where stale data take the focus meanwhile."""
    desk.fake.ask(set={"poses": [POSE]})
    desk.take_control()
    desk.view("teach")
    field = desk.page.get_by_role("textbox", name="Name of pose 1")
    field.press("End")
    desk.page.keyboard.type(" half")
    desk.blink()
    desk.fake.let_pass(desk.page)
    assert desk.fake.received("rename") == []
    expect(field).to_be_focused()
    desk.page.keyboard.type(" full")
    desk.blink()
    desk.page.keyboard.press("Enter")
    desk.fake.wait(desk.page, lambda f: [p["name"] for p in f["poses"]] == ["one half full"])
    assert len(desk.fake.received("rename")) == 1
    assert desk.fake.ask()["stops"] == 0


def test_a_half_typed_name_is_put_back_where_the_field_was_left_by_stop(desk: Visit) -> None:
    desk.fake.ask(set={"poses": [POSE]})
    desk.take_control()
    desk.view("teach")
    field = desk.page.get_by_role("textbox", name="Name of pose 1")
    field.press("End")
    desk.page.keyboard.type(" half")
    with desk.stale():
        desk.page.keyboard.press("Escape")
    expect(desk.page.locator("#notice")).to_have_text(
        "“one” was not renamed: data were not current."
    )
    expect(field).to_have_value("one")
    expect(field).not_to_be_focused()
    desk.fake.let_pass(desk.page)
    assert desk.fake.received("rename") == []


# Paths.


def planned(found: Visit) -> dict[str, Any]:
    """The last plan command, once it is executed."""
    answer = found.fake.wait(
        found.page, lambda f: any(m.get("command") == "plan" for m in f["received"])
    )
    return [m for m in answer["received"] if m.get("command") == "plan"][-1]  # type: ignore[no-any-return]


@pytest.mark.parametrize("from_here", [True, False])
def test_a_path_begins_at_the_present_pose_if_so_ticked(desk: Visit, from_here: bool) -> None:
    desk.fake.ask(set={"poses": [POSE, {**POSE, "name": "two"}]})
    desk.take_control()
    desk.view("teach")
    box = desk.page.get_by_role("checkbox", name="Begin at the current pose")
    expect(box).to_be_checked()
    box.set_checked(from_here)
    desk.page.locator("#plan-poses").click()
    message = planned(desk)
    assert (message["scene"], message["from_here"]) == (None, from_here)
    assert "pose" not in message


def test_one_pose_is_enough_for_a_path_from_the_present_one(desk: Visit) -> None:
    desk.fake.ask(set={"poses": [POSE]})
    desk.take_control()
    desk.view("teach")
    plan = desk.page.locator("#plan-poses")
    expect(plan).not_to_have_attribute("aria-disabled", "true")
    desk.page.locator("#plan-from-here").uncheck()
    expect(plan).to_have_attribute("title", "Teach two poses first")


def test_a_path_to_one_pose_is_planned_and_the_page_leads_to_it(desk: Visit) -> None:
    desk.fake.ask(set={"poses": [POSE, {**POSE, "name": "two"}]})
    desk.take_control()
    desk.view("teach")
    desk.page.get_by_role("button", name="Plan a path to two").click()
    message = planned(desk)
    assert (message["scene"], message["pose"]) == (None, "two")
    expect(desk.page.locator("#outcome-title")).to_have_text(
        "Path planned: it is loaded under Operate"
    )
    expect(desk.page.locator("#panel-teach")).to_be_visible()  # no view changes by itself
    desk.page.get_by_role("button", name="Show it").click()
    expect(desk.page.locator("#panel-operate")).to_be_visible()
    expect(desk.page.locator("#plan-name")).to_be_in_viewport()


def test_a_plan_that_failed_leads_nowhere(desk: Visit) -> None:
    outcome = {"verb": "plan", "ok": False, "text": "error: no path found", "report": None}
    desk.fake.ask(set={"outcome": {**outcome, "fault_page": None, "stopped": False}})
    expect(desk.page.locator("#outcome-title")).to_have_text("Planning: not completed")
    expect(desk.page.locator("#outcome-show")).to_be_hidden()


def test_jogging_can_be_ended_where_it_prevents_planning(desk: Visit) -> None:
    desk.fake.ask(set={"poses": [POSE]})
    desk.ready_to_jog()
    desk.view("teach")
    expect(desk.page.locator("#plan-poses")).to_have_attribute("aria-disabled", "true")
    expect(desk.page.locator("#plan-poses-why")).to_have_text("Jogging is enabled: end it first.")
    end = desk.page.locator("#teach-jog-end")
    end.click()
    expect(end).to_be_hidden()
    expect(desk.page.locator("#plan-poses-why")).to_have_text("")
    expect(desk.page.locator("#plan-poses")).not_to_have_attribute("aria-disabled", "true")


def test_a_pose_is_removed_only_after_a_question(desk: Visit) -> None:
    desk.fake.ask(set={"poses": [POSE]})
    desk.take_control()
    desk.view("teach")
    remove = desk.page.get_by_role("button", name="Remove one")
    remove.click()
    expect(desk.page.locator("#dialog")).to_contain_text("Remove “one”?")
    desk.page.get_by_role("button", name="Cancel").click()
    assert desk.fake.received("forget") == []
    remove.click()
    desk.page.locator(".confirm").click()
    desk.fake.wait(desk.page, lambda f: f["poses"] == [])
