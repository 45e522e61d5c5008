"""Every fault code in the source has a page, every page a code, and reports name it."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from html import unescape
from pathlib import Path
from typing import get_args

import pytest

from drivers.can_errors import BusFault
from drivers.stopping_distance import lost_master
from executor.report.run_data import markdown
from executor.safety.fault_messages import ORDINARY, fault_codes, faults_among, page_of, page_text
from model.files.scene_file import StopDocument
from model.rig import load_rig
from tests.cli.program import call, one_message

ROOT = Path(__file__).parents[2]
PAGES = ROOT / "docs" / "faults"
HEADINGS = ["## What it means", "## Likely cause", "## State of the machine", "## Next step"]
#: Which argument of a call is the code of an event.
CODE_ARGUMENT = {
    "CameraNews": 0,
    "Alarm": 1,
    "LoopEvent": 2,
    "RunEvent": 1,
    "StopReason": 0,
    "_stop": 2,
    "_fault": 0,
    "_report": 0,
    "_report_cause": 0,
    "_report_event": 0,
    "report_event": 0,
}


def codes_in_the_source() -> Iterator[str]:
    """Codes of events in the source, and those of bus faults."""
    for path in [*(ROOT / "executor").rglob("*.py"), *(ROOT / "cdpr").rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call):
                continue
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            index = CODE_ARGUMENT.get(name)
            if index is not None and len(node.args) > index:
                code = node.args[index]
                either = (code.body, code.orelse) if isinstance(code, ast.IfExp) else (code,)
                for one in either:
                    if isinstance(one, ast.Constant) and isinstance(one.value, str):
                        yield one.value
    yield from ("recorder", "supervisor_lost")  # reported in a loop, by name
    yield from (kind.code for kind in (BusFault, *BusFault.__subclasses__()))


PAGED = sorted(path.stem for path in PAGES.glob("*.md") if path.stem != "index")


def test_the_codes_in_the_source_and_no_others_have_pages() -> None:
    codes = sorted(set(codes_in_the_source()) - ORDINARY)
    assert codes == PAGED
    assert len(codes) >= 31
    assert {
        "camera",
        "pictures_dropped",
        "slack",
        "late",
        "gate_denied",
        "drive_stuck",
        "bus_off",
        "no_real_time",
    } <= set(codes)


@pytest.mark.parametrize("code", PAGED)
def test_a_code_has_a_page_with_everything_in_it(code: str) -> None:
    text = (PAGES / f"{code}.md").read_text()
    assert [line for line in text.splitlines() if line.startswith("## ")] == HEADINGS
    assert f"Event `{code}`." in text
    assert f"faults/{code}.md" in (ROOT / "mkdocs.yml").read_text()
    assert f"[`{code}`]({code}.md)" in (PAGES / "index.md").read_text()
    assert page_of(code) == f"docs/faults/{code}.md"


@pytest.mark.parametrize("code", PAGED)
def test_a_page_is_true_of_drives_of_every_kind(code: str) -> None:
    """ODrives hold by their brakes, and not every drive notices missing SYNC."""
    state = " ".join(
        page_text(code).split("## State of the machine")[1].split("## Next")[0].split()
    )
    if "under torque" in state or "torque on" in state:
        assert "ODrives: disarmed, held by their brakes" in state
    if "without SYNC" in state:
        assert "100 ms without heartbeat" in state


def test_drives_notice_the_loss_of_their_master_as_the_pages_say(tmp_path: Path) -> None:
    noticed = {}
    standard = (ROOT / "configs" / "gachon_8_6.yaml").read_text()
    for name in ("cia402", "epos4", "nanotec-c5e", "akd", "elmo-gold"):
        rig = tmp_path / f"{name}.yaml"
        rig.write_text(f"{standard}drives: {{type: cia402, profile: {name}}}\n")
        lost = lost_master(load_rig(rig))
        noticed[name] = (lost.noticed_by, round(lost.notice * 1000.0))
    assert noticed.pop("cia402") == ("SYNC", 30)
    assert set(noticed.values()) == {("heartbeat", 100)}
    odrives = lost_master(load_rig(ROOT / "configs" / "gachon_8_6_odrive.yaml"))
    assert odrives.noticed_by == "set-points"


@pytest.mark.parametrize("code", PAGED)
def test_a_page_resets_the_latch_before_it_homes(code: str) -> None:
    """Homing is refused while a fault is latched."""
    steps = page_text(code).split("## Next step")[1]
    homes = re.search(r"\bhome\b", steps)
    if homes is not None:
        assert 0 <= steps.find("`cdpr reset RIG`") < homes.start()


def test_faults_are_named_once_and_what_stopped_no_run_comes_last() -> None:
    codes = ["enabled", "reply_lost", "moving", "slack", "late", "slack", "held"]
    assert faults_among(codes) == ["slack", "late", "reply_lost"]


def harmless_by_the_index() -> list[str]:
    text = " ".join((PAGES / "index.md").read_text().split())
    return re.findall("`([a-z_]+)`", text.partition(" do not stop the motion")[0])


def test_the_codes_that_stop_no_run_are_those_of_the_index() -> None:
    codes = harmless_by_the_index()
    assert len(codes) == 8
    for code in codes:
        assert faults_among([code, "cable_loose"]) == ["cable_loose", code]


@pytest.mark.parametrize("code", ["camera_sees_nothing", "pictures_dropped", "pose_differs"])
def test_what_cameras_missed_may_fail_a_run_and_comes_before_what_does_not(code: str) -> None:
    assert faults_among(["drive_warning", code]) == [code, "drive_warning"]


@pytest.mark.parametrize(
    "code",
    [*sorted(ORDINARY), *get_args(StopDocument.model_fields["kind"].annotation), "unheard_of"],
)
def test_an_event_that_is_not_a_fault_points_to_no_page(code: str) -> None:
    assert page_of(code) == ""


def test_every_page_is_explained_and_a_wrong_code_gets_the_right_ones() -> None:
    for code in fault_codes():
        answer = call("explain", code)
        assert answer.code == 0
        assert answer.out.strip() == page_text(code).strip()
        assert "](" not in answer.out
    listed = call("explain")
    assert [line.split()[0] for line in listed.out.splitlines()] == fault_codes()
    one_message(call("explain", "drive_silnet"), 2, "cdpr explain drive_silent`", "drive_silnet")
    one_message(call("explain", "xyz"), 2, "use one of", "drive_silent")


def test_the_text_of_a_page_is_in_the_report_without_its_markup() -> None:
    for code in fault_codes():
        html = markdown(page_text(code).split("\n", 1)[1])
        assert "<h3>Next step</h3>" in html
        assert not set("`#*") & set(unescape(html)), html
