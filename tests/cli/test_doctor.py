"""`cdpr doctor` lists what is missing, each with the command that fixes it."""

from __future__ import annotations

import json
import os
import pwd
import resource
import subprocess
import sys
import tomllib
from dataclasses import replace
from functools import partial
from importlib import import_module
from importlib.metadata import packages_distributions
from pathlib import Path
from types import ModuleType
from typing import Any

import can
import numpy as np
import pytest
from packaging.requirements import Requirement

from drivers.cameras import live as cameras
from drivers.can_bus import BusSettings, open_bus
from drivers.can_interfaces import KernelInterface, can_interfaces, parse_interfaces
from executor import doctor
from executor.doctor import (
    MachineCheck,
    kernel_bus,
    memory_check,
    real_time_permission,
    rig_bus,
    stopping_text,
)
from executor.interlock import locks
from executor.interlock.locks import SetUpLock
from executor.realtime import scheduling
from executor.recording.summary import versions
from model.errors import HardwareMissing
from model.rig import load_rig, rig_from_document
from simulation import factory
from simulation.drives.behaviour import behaviour_named
from simulation.drives.eds_file import profile_path, read_eds
from simulation.factory import make_rehearsal
from tests.cli.plans import RIG
from tests.cli.program import call

CAN0 = BusSettings("socketcan", "can0", 1_000_000)


def link(**changes: Any) -> dict[str, Any]:
    """What `ip -details -json link show` prints of a healthy interface."""
    return {
        "ifindex": 3,
        "ifname": "can0",
        "flags": ["NOARP", "UP", "LOWER_UP", "ECHO"],
        "mtu": 16,
        "txqlen": 128,
        "link_type": "can",
        "linkinfo": {
            "info_kind": "can",
            "info_data": {
                "state": "ERROR-ACTIVE",
                "restart_ms": 0,
                "bittiming": {"bitrate": 1000000, "sample_point": "0.750"},
            },
        },
        **changes,
    }


def looked(**changes: Any) -> dict[str, MachineCheck]:
    """The answers for one interface, by name."""
    found = parse_interfaces(json.dumps([link(**changes)]))
    return {answer.name: answer for answer in kernel_bus(CAN0, found)}


@pytest.fixture(autouse=True)
def kernel_with_can(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests are about interfaces; this machine's kernel may have none."""
    monkeypatch.setattr(doctor, "kernel_support", lambda: MachineCheck("kernel", True, "there"))


def test_a_healthy_interface_has_nothing_to_fix() -> None:
    answers = looked()
    assert len(answers) == 4
    assert all(answer.good for answer in answers.values())


@pytest.mark.parametrize(
    ("changes", "name", "found", "command"),
    [
        (
            {"flags": ["NOARP", "ECHO"]},
            "interface can0",
            "down",
            "sudo ip link set can0 up txqueuelen 128 type can bitrate 1000000",
        ),
        (
            {"txqlen": 10},
            "txqueuelen of can0",
            "10 frames",
            "sudo ip link set can0 txqueuelen 128",
        ),
        (
            {"linkinfo": {"info_kind": "can", "info_data": {"bittiming": {"bitrate": 500000}}}},
            "bit rate of can0",
            "500000 bit/s; the rig file says 1000000",
            "sudo ip link set can0 down && sudo ip link set can0 up txqueuelen 128 type can"
            " bitrate 1000000",
        ),
        (  # a controller of fixed bit rates, such as slcan
            {"linkinfo": {"info_kind": "can", "info_data": {"bittiming_bitrate": 250000}}},
            "bit rate of can0",
            "250000 bit/s; the rig file says 1000000",
            "bitrate 1000000",
        ),
        (
            {"flags": ["NOARP", "ECHO"], "linkinfo": {"info_kind": "can", "info_data": {}}},
            "bit rate of can0",
            "not set; the rig file says 1000000",
            "bitrate 1000000",
        ),
        (
            {"linkinfo": {"info_kind": "can", "info_data": {"state": "BUS-OFF"}}},
            "controller of can0",
            "BUS-OFF",
            "termination (60 ohm), then sudo ip link set can0 down && sudo ip link set can0 up",
        ),
    ],
)
def test_what_is_wrong_comes_with_its_command(
    changes: dict[str, Any], name: str, found: str, command: str
) -> None:
    answer = looked(**changes)[name]
    assert not answer.good
    assert found in answer.text
    assert command in answer.fix


@pytest.mark.parametrize(
    ("linkinfo", "state"),
    [
        ({}, "not stated by its driver"),  # before Linux 6.0
        (
            {"info_kind": "can", "info_data": {"state": "ERROR-ACTIVE", "bittiming_bitrate": 0}},
            "ERROR-ACTIVE",
        ),
    ],
)
def test_a_serial_adapter_set_up_by_slcand_states_no_bit_rate(
    linkinfo: dict[str, Any], state: str
) -> None:
    """A run accepts it, and `type can bitrate`, which was the cure, does not fit it."""
    answers = looked(linkinfo=linkinfo)
    assert len(answers) == 4
    assert all(answer.good for answer in answers.values())
    text = answers["bit rate of can0"].text
    assert text == "not stated by its driver; the rig file says 1000000 (slcand sets it by -s)"
    assert answers["controller of can0"].text == state


@pytest.mark.parametrize("mode", ["LISTEN-ONLY", "ONE-SHOT", "LOOPBACK"])
def test_a_controller_in_a_mode_that_hinders_is_named_with_its_cure(mode: str) -> None:
    info = {"state": "ERROR-ACTIVE", "ctrlmode": ["FD", mode], "bittiming": {"bitrate": 1_000_000}}
    answer = looked(linkinfo={"info_kind": "can", "info_data": info})["controller of can0"]
    assert not answer.good
    assert f"ERROR-ACTIVE, {mode}: " in answer.text
    assert answer.fix.endswith(f"type can bitrate 1000000 {mode.lower()} off")
    down = looked(flags=["NOARP"], linkinfo={"info_kind": "can", "info_data": info})
    assert not down["controller of can0"].good
    info["ctrlmode"] = ["FD", "BERR-REPORTING"]
    good = looked(linkinfo={"info_kind": "can", "info_data": info})["controller of can0"]
    assert good.good
    assert good.text == "ERROR-ACTIVE"


def test_a_missing_interface_names_those_that_are_there() -> None:
    (answer,) = kernel_bus(CAN0, [KernelInterface("can1", "can", True, 128, 500_000, "")])
    assert not answer.good
    assert "can1" in answer.text
    (virtual,) = kernel_bus(BusSettings("socketcan", "vcan0"), [])
    assert "sudo ip link add dev vcan0 type vcan" in virtual.fix


def test_a_virtual_interface_has_no_bit_rate_to_be_wrong() -> None:
    vcan = link(ifname="can0", linkinfo={"info_kind": "vcan"})
    answers = kernel_bus(CAN0, parse_interfaces(json.dumps([vcan])))
    assert len(answers) == 2
    assert all(answer.good for answer in answers)


def test_other_interfaces_are_left_out() -> None:
    lines = [{"ifname": "lo", "flags": ["LOOPBACK", "UP"], "link_type": "loopback"}, link()]
    assert [found.name for found in parse_interfaces(json.dumps(lines))] == ["can0"]
    assert parse_interfaces("") == ()


def test_unexpected_output_of_ip_is_reported(tmp_path: Path) -> None:
    program = tmp_path / "ip"
    program.write_text("#!/bin/sh\necho no idea\n")
    program.chmod(0o755)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PATH", str(tmp_path), prepend=":")
        with pytest.raises(HardwareMissing, match="did not list"):
            can_interfaces()


@pytest.mark.parametrize(
    ("limit", "privileged", "granted", "fix", "denied"),
    [
        (0, False, False, "rtprio 50' | sudo tee -a /etc/security/limits.d", "`ulimit -r 50`"),
        (49, False, False, "rtprio 50' | sudo tee -a /etc/security/limits.d", "`ulimit -r 50`"),
        (50, False, True, "", ""),
        (0, True, True, "", ""),
        (resource.RLIM_INFINITY, False, True, "", ""),
        (50, False, False, "`docker run --cpu-rt-runtime=950000`", "`cpu.rt_runtime_us`"),
        (0, True, False, "`RestrictRealtime=`", "`RestrictRealtime=`"),
    ],
)
def test_real_time_priority(
    limit: int,
    privileged: bool,
    granted: bool,
    fix: str,
    denied: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Limit or capability allow it, and the control group may still deny it: it is tried."""

    def take(*_: object) -> None:
        if not granted:
            raise PermissionError

    monkeypatch.setattr("resource.getrlimit", lambda _: (limit, limit))
    monkeypatch.setattr("os.sched_setscheduler", take)
    monkeypatch.setattr(scheduling, "has_capability", lambda _: privileged)
    monkeypatch.setattr(scheduling, "_lock_memory", lambda: True)
    answer, _ = real_time_permission()
    assert answer.good is granted
    assert fix in answer.fix
    with scheduling.real_time() as found:
        assert bool(found) is not granted
        assert denied in found


def test_the_priority_is_tried_in_another_thread() -> None:
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    real_time_permission()
    assert (os.sched_getscheduler(0), os.sched_getparam(0)) == before


@pytest.mark.parametrize(
    ("limit", "privileged", "good"),
    [(65536, False, False), (resource.RLIM_INFINITY, False, True), (65536, True, True)],
)
def test_locked_memory(limit: int, privileged: bool, good: bool) -> None:
    answer = memory_check(limit, privileged=privileged)
    assert answer.good is good
    assert "memlock unlimited'" in answer.fix


class FakeCapture:
    """A camera of OpenCV with images of one size."""

    size = (720, 1280)

    def isOpened(self) -> bool:  # noqa: N802
        return True

    def set(self, *_: object) -> None:
        """Cameras accept settings and may ignore them."""

    def getBackendName(self) -> str:  # noqa: N802
        return "FFMPEG"

    def get(self, _property: int) -> float:
        return 0.0

    def read(self) -> tuple[bool, np.ndarray]:
        return True, np.zeros(self.size, dtype=np.uint8)

    def release(self) -> None:
        """Nothing is held."""


def camera_answer(*arguments: str) -> tuple[int, dict[str, Any]]:
    answer = call("doctor", RIG, *arguments, "--json")
    (camera,) = [one for one in json.loads(answer.out) if one["name"].startswith("camera")]
    return answer.code, camera


def test_a_camera_is_opened_and_its_pictures_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cameras, "_opened", lambda _source: FakeCapture())
    code, camera = camera_answer("--camera", "0")
    assert (code, camera["good"]) == (0, True)
    assert "1280 x 720 px" in camera["text"]
    monkeypatch.setattr(FakeCapture, "size", (480, 640))
    code, camera = camera_answer("--camera", "0")
    assert (code, camera["good"]) == (4, False)
    assert "640 x 480 px" in camera["text"]


@pytest.mark.parametrize("source", [0, 2, Path("/dev/video7"), [Path("/dev/video7")]])
def test_an_index_or_a_path_in_python_opens_a_camera(
    monkeypatch: pytest.MonkeyPatch, source: int | Path | list[Path]
) -> None:
    monkeypatch.setattr(cameras, "_opened", lambda _source: FakeCapture())
    (camera,) = (one for one in doctor.check_rig(load_rig(RIG), source) if "camera" in one.name)
    assert camera.good
    (name,) = source if isinstance(source, list) else [source]
    assert camera.text.startswith(f"{name} opens")


def test_a_camera_that_is_not_there_is_missing_and_one_not_named_is_not_tried() -> None:
    code, camera = camera_answer("--camera", "97")
    assert (code, camera["good"]) == (4, False)
    code, camera = camera_answer()
    assert (code, camera["good"]) == (0, True)
    assert "not tested" in camera["text"]


def with_two_cameras(tmp_path: Path) -> Path:
    """A rig whose second camera, `side`, has larger images."""
    document = load_rig(RIG).document
    changes = {"name": "side", "width_px": 1920, "height_px": 1080}
    side = document.cameras[0].model_copy(update=changes)
    document = document.model_copy(update={"cameras": [*document.cameras, side]})
    rig = tmp_path / "two.yaml"
    rig.write_text(document.model_dump_json(exclude_unset=True))
    return rig


def test_each_camera_is_judged_by_its_own_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[int | str] = []

    def capture(source: int | str) -> FakeCapture:
        opened.append(source)
        return FakeCapture()

    monkeypatch.setattr(cameras, "_opened", capture)
    rig = with_two_cameras(tmp_path)

    def answers(*options: str) -> dict[str, tuple[bool, str]]:
        checks = json.loads(call("doctor", rig, *options, "--json").out)
        return {
            one["name"]: (one["good"], one["text"])
            for one in checks
            if one["name"].startswith("camera")
        }

    (front,) = answers("--camera", "front=0").items()
    assert (front[0], front[1][0]) == ("camera front", True)
    (side,) = answers("--camera", "side=1").items()
    assert (side[0], side[1][0]) == ("camera side", False)
    assert "1920 x 1080" in side[1][1]
    both = answers("--camera", "front=0", "--camera", "side=1")
    assert {name: good for name, (good, _) in both.items()} == {
        "camera front": True,
        "camera side": False,
    }
    assert opened == [0, 1, 0, 1]
    untested = answers()
    assert "--camera side=INDEX tests it" in untested["camera side"][1]
    unknown = call("doctor", rig, "--camera", "rear=0")
    assert unknown.code == 2
    assert "'rear'" in unknown.said


def test_the_cure_for_a_rig_without_cameras_is_to_describe_them(tmp_path: Path) -> None:
    document = load_rig(RIG).document.model_copy(update={"cameras": []})
    rig = tmp_path / "blind.yaml"
    rig.write_text(document.model_dump_json(exclude_unset=True))
    assert call("doctor", rig).code == 0
    answer = call("doctor", rig, "--camera", "0")
    assert answer.code == 4
    assert "the rig file has none next: describe the camera under `cameras`" in answer.said


def test_a_camera_needs_the_rig_that_describes_it() -> None:
    answer = call("doctor", "--camera", "0")
    assert answer.code == 2
    assert "cdpr doctor RIG --camera INDEX" in answer.said


def test_a_bus_too_slow_and_an_interface_missing_are_both_reported(tmp_path: Path) -> None:
    text = RIG.read_text().replace("interface: virtual", "interface: socketcan")
    rig = tmp_path / "rig.yaml"
    rig.write_text(
        text.replace("channel: cdpr", "channel: can77").replace("cycle_ms: 10", "cycle_ms: 1")
    )
    answer = call("doctor", rig, "--json")
    assert answer.code == 4
    document = {one["name"]: one for one in json.loads(answer.out)}
    assert not document["bus load"]["good"]
    assert "4 or more" in document["bus load"]["fix"]
    assert not document["interface can77"]["good"]
    assert "real-time priority" in document


def with_profile(tmp_path: Path, profile: str) -> Path:
    rig = tmp_path / "rig.yaml"
    rig.write_text(f"{RIG.read_text()}drives: {{type: cia402, profile: {profile}}}\n")
    return rig


def test_a_bus_that_another_program_uses_is_not_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Opening a serial adapter sets its bit rate, which closes the channel of the other program."""
    monkeypatch.setattr(locks, "SHARED", tmp_path / "absent")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    rig = load_rig(RIG).with_bus("udp_multicast", "239.74.163.66")
    opened: list[BusSettings] = []

    def note(settings: BusSettings) -> can.BusABC:
        opened.append(settings)
        return open_bus(BusSettings("virtual", "instead"))

    monkeypatch.setattr("drivers.can_bus.open_bus", note)
    with SetUpLock(BusSettings.of(rig)).held():
        checks = {check.name: check for check in rig_bus(rig)}
    assert opened == []
    used = checks["bus udp_multicast 239.74.163.66"]
    assert (used.good, used.text) == (True, "in use by another program, not opened")
    assert "opens" in [check.text for check in rig_bus(rig)]
    assert len(opened) == 1


def test_objects_of_all_drives_are_read_in_one_table(tmp_path: Path) -> None:
    answer = call("doctor", RIG, "--drives")
    assert answer.code == 0, answer.said
    assert "of 8 drives read, nothing written; 0 to change" in answer.out
    assert "stop by SYNC after 30 ms: up to 0.7 mm" in answer.out
    answer = call("doctor", RIG, "--drives", "--json")
    document = json.loads(answer.out)
    assert document["drives"]["answered"] == list(range(1, 9))
    assert {one["verdict"] for one in document["drives"]["objects"]} <= {"ok", "remark"}


def test_drives_of_another_make_are_reported_with_what_to_change(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Drives of the standard have no current limit of Maxon's, and no units."""
    standard = read_eds(profile_path("cia402"))
    monkeypatch.setattr("simulation.drives.cia402_rig.eds_of", lambda _rig, _path: standard)
    answer = call("doctor", with_profile(tmp_path, "epos4"), "--drives", "--json")
    assert answer.code == 4
    objects = {one["object"][:8]: one for one in json.loads(answer.out)["drives"]["objects"]}
    assert objects["3001h:02"]["verdict"] == "wrong"
    assert objects["3001h:02"]["found"] == [{"drives": list(range(1, 9)), "value": "absent"}]
    shown = call("doctor", with_profile(tmp_path, "epos4"), "--drives").out
    assert "…" not in shown, "the keys that the user types are not cut"


@pytest.mark.parametrize("index", ["1006", "1016", "6065"])
def test_drives_that_may_not_notice_a_lost_master_get_no_stopping_distance(
    index: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The distance of the profile stood below a line that said what it relies on was absent."""
    absent = behaviour_named([f"absent={index}"])
    monkeypatch.setattr(factory, "make_rehearsal", partial(make_rehearsal, behaviour=absent))
    answer = call("doctor", RIG, "--drives")
    assert answer.code == 4
    assert ("without the master" in answer.out) == (index == "6065")


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        (None, ("lab.yaml: no such file", "relative to the current folder")),
        ("name: Ours\nsources: [x]\nmonitoring: pigeon\n", ("lab.yaml:3", "monitoring")),
        ("name: Ours\nsources: [x]\n", ()),
    ],
)
def test_a_profile_that_is_missing_or_invalid_is_found_without_reading_drives(
    tmp_path: Path, text: str | None, parts: tuple[str, ...]
) -> None:
    profile = tmp_path / "lab.yaml"
    if text is not None:
        profile.write_text(text)
    answer = call("doctor", with_profile(tmp_path, str(profile)))
    assert answer.code == (4 if parts else 0), answer
    assert all(part in answer.said for part in parts), answer.said
    line = "miss drives: " if parts else f"ok drives: CANopen, profile {profile}"
    assert line in answer.said


def test_drives_need_the_rig_and_a_profile_that_is_there(tmp_path: Path) -> None:
    answer = call("doctor", "--drives")
    assert answer.code == 2
    assert "cdpr doctor RIG --drives" in answer.said
    answer = call("doctor", with_profile(tmp_path, "epos5"), "--drives")
    assert answer.code == 2
    assert "epos4" in answer.said


def test_every_required_library_is_checked_under_the_module_that_it_installs() -> None:
    project = tomllib.loads((RIG.parents[1] / "pyproject.toml").read_text())["project"]
    required = {Requirement(one).name for one in project["dependencies"]}
    assert sorted(doctor.LIBRARIES.values()) == sorted(required)
    installed = packages_distributions()
    for module, package in doctor.LIBRARIES.items():
        assert package in [name.lower() for name in installed[module]]


def test_another_opencv_in_place_of_ours_is_recognised(monkeypatch: pytest.MonkeyPatch) -> None:
    """`opencv-python`, as other packages require, overwrites the files and not the metadata."""
    monkeypatch.setattr("cv2.__version__", "4.10.0")
    (check,) = doctor.libraries({"cv2": "opencv-python-headless"})
    assert (check.good, check.text) == (False, "4.10.0; 5.0.0.93 or newer is required")
    assert check.fix.endswith("'opencv-python-headless>=5.0.0.93'")
    assert "--force-reinstall" in check.fix, "pip takes the version in the metadata for installed"
    assert versions()["opencv-python-headless"] == "4.10.0"


def test_a_library_older_than_required_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """As after the installation of another package that requires an old one."""
    monkeypatch.setattr(doctor, "version", lambda _: "1.9.3")
    (check,) = doctor.libraries({"scipy": "scipy"})
    assert (check.good, check.text) == (False, "1.9.3; 1.16 or newer is required")
    assert check.fix.endswith("'scipy>=1.16'")
    monkeypatch.setattr(doctor, "version", lambda _: "1.16.0rc1")
    (check,) = doctor.libraries({"scipy": "scipy"})
    assert (check.good, check.text) == (True, "1.16.0rc1")


@pytest.mark.parametrize(
    "error",
    [
        ValueError("numpy.dtype size changed, may indicate binary incompatibility"),
        OSError("libGL.so.1: cannot open shared object file"),
        ImportError("DLL load failed"),
    ],
)
def test_a_library_that_fails_in_any_way_is_one_check_that_failed(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def broken(module: str) -> ModuleType:
        if module == "matplotlib":
            raise error
        return import_module(module)

    monkeypatch.setattr(doctor, "import_module", broken)
    answer = call("doctor")
    assert answer.code == 4, answer
    assert f"miss matplotlib: {error}" in answer.said
    assert "matplotlib\n" in answer.out.partition("next: pip install ")[2]
    assert "ok mcap" in answer.said


@pytest.mark.parametrize(
    "text", ["rtsp://[fe80::1]/live", "could not read [/dev/video0]", "[red]", ":x: :warning:"]
)
def test_findings_are_shown_letter_for_letter(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    found = MachineCheck(text, False, text, text)
    monkeypatch.setattr("cdpr.cli.doctor.check_machine", lambda: [found])
    answer = call("doctor")
    assert answer.code == 4, answer
    assert answer.out == f"miss {text}: {text}\n     next: {text}\n"


def test_no_verb_depends_on_the_user_s_matplotlib_backend() -> None:
    """A name that matplotlib does not know, as an old one, fails its import."""
    done = subprocess.run(
        [sys.executable, "-c", "from cdpr.cli import main; main()", "doctor"],
        env=os.environ | {"MPLBACKEND": "Qt4Agg"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert "ok   matplotlib" in done.stdout, done.stderr


def test_the_detector_of_the_rig_is_checked_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyapriltags", None)
    rig = load_rig(RIG)
    assert all(check.good for check in doctor.check_rig(rig) if "apriltag" in check.name)
    checks = doctor.check_rig(replace(rig, tag_detector="apriltag"))
    (missing,) = (check for check in checks if check.name == "pyapriltags")
    assert not missing.good


def test_a_user_without_a_name_is_named_by_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a container; `limits.conf` takes ``:UID``."""
    for name in ("LOGNAME", "USER", "LNAME", "USERNAME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("os.getuid", lambda: 54321)
    with pytest.raises(KeyError):
        pwd.getpwuid(54321)
    assert "echo ':54321 - memlock unlimited'" in memory_check(65536, privileged=False).fix


def test_a_platform_too_heavy_at_home_has_no_distance_by_inertia() -> None:
    rig = load_rig(RIG)
    heavy = rig.document.platform.model_copy(update={"mass_kg": 60.0})
    assert "its inertia adds" in stopping_text(rig)
    text = stopping_text(rig_from_document(rig.document.model_copy(update={"platform": heavy})))
    assert "inertia" not in text
    assert "inf" not in text
