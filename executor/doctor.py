"""Checks of this machine and of a rig's hardware before a run; nothing is changed.

Libraries may be missing: modules that need one are imported where used, after `libraries`.
"""

from __future__ import annotations

import os
import platform
import pwd
import re
import resource
import socket
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import distributions, version
from importlib.util import find_spec
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING

from drivers.can_interfaces import (
    MIN_TRANSMIT_QUEUE,
    KernelInterface,
    bring_up,
    can_interfaces,
    set_up_again,
)
from executor.cameras.sources import OneCamera, parse_camera_sources, source_texts
from executor.realtime.scheduling import (
    ALLOW_GROUP,
    CAP_IPC_LOCK,
    PRIORITY,
    has_capability,
    is_granted_priority,
    priority_limit,
)
from model.errors import BadInput, CdprError, InvalidFile, require_types, without_passwords
from model.rig import Camera, Rig

if TYPE_CHECKING:
    from drivers.can_bus import BusSettings
    from drivers.cia402.inspection import Examined

PACKAGES = (
    "cdpr",
    "calibration",
    "executor",
    "simulation",
    "planner",
    "drivers",
    "tracking",
    "model",
)
LIBRARIES = {
    "pydantic": "pydantic",
    "yaml": "pyyaml",
    "typer": "typer",
    "rich": "rich",
    "numpy": "numpy",
    "numba": "numba",
    "scipy": "scipy",
    "cv2": "opencv-python-headless",
    "fcl": "python-fcl",
    "can": "python-can",
    "canopen": "canopen",
    "msgpack": "msgpack",
    "daqp": "daqp",
    "foxglove": "foxglove-sdk",
    "mcap": "mcap",
    "matplotlib": "matplotlib",
}
"""Distributions that ours requires, by the module that each installs."""
LIMITS = Path("/etc/security/limits.d/cdpr.conf")
#: States of a controller in which it takes full part in the traffic.
HEALTHY = ("ERROR-ACTIVE", "ERROR-WARNING")


@dataclass(frozen=True, slots=True)
class MachineCheck:
    """Result of one check.

    Attributes:
        name: Of the checked item.
        good: Whether it meets the needs of a run.
        text: Finding.
        fix: Next step if it is not good.
    """

    name: str
    good: bool
    text: str
    fix: str = ""


def check_machine() -> list[MachineCheck]:
    """Whether this machine has what a run needs."""
    return [python_version(), *own_packages(), *libraries(), *machine()]


def check_rig(
    rig: Rig, camera: OneCamera | Sequence[OneCamera] | None = None
) -> list[MachineCheck]:
    """Checks the rig's tag detector, drive files, bus and cameras.

    Args:
        rig: The robot.
        camera: Index, device or address of its first camera, ``NAME=SOURCE`` of another, or one of
            these for each of several cameras; None to open none.

    Raises:
        BadInput: A source names no camera of the rig file.
    """
    require_types((rig, Rig))
    sources = [] if camera is None else source_texts("camera", camera)
    detector = libraries({"pyapriltags": "pyapriltags"} if rig.tag_detector == "apriltag" else {})
    return [*detector, *rig_drives(rig), *rig_bus(rig), *rig_cameras(rig, sources)]


def python_version() -> MachineCheck:
    """The Python version."""
    good = sys.version_info >= (3, 11)
    return MachineCheck("python", good, platform.python_version(), "install Python 3.11 or newer")


def own_packages() -> list[MachineCheck]:
    """Whether the imported packages are ours: others of the same names exist."""
    ours = Path(__file__).resolve().parents[1]
    checks = []
    for name in PACKAGES:
        spec = find_spec(name)
        origin = Path(spec.origin).resolve() if spec and spec.origin else None
        good = origin is not None and origin.parents[1] == ours
        text = "own package" if good else f"another package: {origin}" if origin else "not found"
        fix = f"uninstall the other {name!r}, or install cdpr in its own environment"
        checks.append(MachineCheck(f"package {name}", good, text, fix))
    return checks


def libraries(packages: Mapping[str, str] = LIBRARIES) -> list[MachineCheck]:
    """Whether every library can be imported, and is as new as required.

    Args:
        packages: Distributions by module, as `LIBRARIES`.
    """
    lines = [line for ours in distributions(name="cdpr") for line in ours.requires or []]
    lowest: dict[str, str] = dict(re.findall(r"(?m)^([\w.-]+)>=([\d.]+)", "\n".join(lines)))
    checks = []
    for module, package in packages.items():
        try:
            own, found = getattr(import_module(module), "__version__", ""), version(package)
            if module == "cv2" and not found.startswith(own):
                found = own  # another distribution of OpenCV replaced the files of this one
            bound = lowest.get(package, "0")
            has, needs = ([int(n) for n in re.findall(r"\d+", text)] for text in (found, bound))
            text = found if has >= needs else f"{found}; {bound} or newer is required"
            fix = f"pip install --force-reinstall --no-deps '{package}>={bound}'"
            checks.append(MachineCheck(package, has >= needs, text, fix))
        except Exception as error:  # any: the module's own code runs, and may be damaged
            absent = isinstance(error, ModuleNotFoundError)
            fix = f"pip install {'' if absent else '--force-reinstall '}{package}"
            checks.append(MachineCheck(package, False, str(error), fix))
    return checks


def machine() -> list[MachineCheck]:
    """Processors and kernel; only reported, since simulation needs neither."""
    cores = os.cpu_count() or 1
    kernel = kernel_support()
    text = kernel.text if kernel.good else f"{kernel.text}; other interfaces work"
    return [
        MachineCheck("processors", cores >= 2, f"{cores}", "use a machine with two or more cores"),
        MachineCheck("kernel", True, text),
    ]


def rig_drives(rig: Rig) -> list[MachineCheck]:
    """Whether the files that the drives of a rig need exist and are valid."""
    from drivers.factory import check_drive_files  # needs python-can

    try:
        return [MachineCheck("drives", True, check_drive_files(rig))]
    except BadInput as error:
        text = f"{error.where}: {error.what}"
        if isinstance(error, InvalidFile):
            text = "; ".join(str(error).splitlines()[:-1])  # the last one is the next step
        return [MachineCheck("drives", False, text, error.next_step)]


def rig_bus(rig: Rig) -> list[MachineCheck]:
    """Whether the bus of a rig is fast enough, is set up, and can be opened.

    It is not opened while another program uses it: that would close the channel of a serial
    adapter during a motion.
    """
    # Imported after the check of libraries: needs python-can.
    from drivers.can_bus import IN_PROCESS, BusSettings, open_bus
    from drivers.can_load import check_bus_load
    from executor.interlock.locks import SetUpLock

    settings = BusSettings.of(rig)
    checks: list[MachineCheck] = []
    try:
        load = check_bus_load(rig)
        checks.append(MachineCheck("bus load", True, f"{load:.0%} at worst"))
    except CdprError as error:
        checks.append(MachineCheck("bus load", False, error.what, error.next_step))
    if settings.interface == "socketcan":
        try:
            checks += kernel_bus(settings, can_interfaces())
        except CdprError as error:
            checks.append(MachineCheck("interfaces", False, error.what, error.next_step))
    try:
        with SetUpLock(settings).tried() as alone:
            if alone:
                open_bus(settings).shutdown()
        text = "opens" if alone else "in use by another program, not opened"
        checks.append(MachineCheck(f"bus {settings}", True, text))
    except CdprError as error:
        checks.append(MachineCheck(f"bus {settings}", False, error.what, error.next_step))
    if settings.interface != IN_PROCESS:
        checks += real_time_permission()
    return checks


def rig_cameras(rig: Rig, sources: Sequence[str]) -> list[MachineCheck]:
    """Whether cameras open and their images have the size that the rig file states.

    Sources and errors as for `check_rig`; without a source no camera is opened.
    """
    if not rig.cameras:
        fix = "describe the camera under `cameras` of the rig file, with the size of its images"
        return [MachineCheck("camera", not sources, "the rig file has none", fix)]
    if sources:
        chosen = parse_camera_sources(rig, list(sources), None, "`camera=`")
        return [_camera(rig, camera, source) for camera, source in chosen.items()]
    devices = ", ".join(str(path) for path in sorted(Path("/dev").glob("video*"))) or "none"
    checks = []
    for camera in rig.cameras:
        text = f"not tested (--camera {camera.name}=INDEX tests it, in Python"
        text += f" camera='{camera.name}=INDEX'); devices here: {devices}"
        text += _unstated_gamma(rig, camera)
        checks.append(MachineCheck(f"camera {camera.name}", True, text))
    return checks


def _camera(rig: Rig, camera: Camera, source: str) -> MachineCheck:
    from drivers.cameras.live import LiveCamera  # needs OpenCV

    name = f"camera {camera.name}"
    try:
        LiveCamera(source, camera, needs_times=False, cameras=rig.cameras).close()
    except CdprError as error:
        return MachineCheck(name, False, error.what, error.next_step)
    size = f"{camera.width} x {camera.height} px"
    text = f"{without_passwords(source)} opens and delivers images of {size}"
    return MachineCheck(name, True, text + _unstated_gamma(rig, camera))


def _unstated_gamma(rig: Rig, camera: Camera) -> str:
    [document] = (one for one in rig.document.cameras if one.name == camera.name)
    stated = "gamma" in document.model_fields_set
    return "" if stated else "; its `gamma` is not stated: a webcam needs `gamma: srgb`"


def home_remarks(rig: Rig) -> list[str]:
    """Why no motion can begin at home; empty if one can."""
    from planner.endpoints import unusable_home  # needs python-fcl

    return unusable_home(rig)


# Kernel CAN bus: each check with the command that fixes it.


def kernel_bus(settings: BusSettings, interfaces: Sequence[KernelInterface]) -> list[MachineCheck]:
    """Whether the interface of a rig exists, is up, fast enough and healthy.

    Args:
        interfaces: The CAN interfaces of this machine.
    """
    name = settings.channel
    kernel = kernel_support()
    if not kernel.good:
        return [kernel]
    found = next((interface for interface in interfaces if interface.name == name), None)
    if found is None:
        there = ", ".join(interface.name for interface in interfaces) or "none"
        text = f"missing; CAN interfaces here: {there}"
        fix = bring_up(name, settings.bitrate)
        return [MachineCheck(f"interface {name}", False, text, fix)]
    checks = [_up(found, settings.bitrate), _queue(found)]
    if found.kind == "can":
        again = set_up_again(found, settings.bitrate)
        checks += [_bitrate(found, settings.bitrate, again), _controller(found, again)]
    return checks


def kernel_support() -> MachineCheck:
    """Whether CAN sockets can be opened; needs no privilege."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (AttributeError, OSError) as error:
        text = f"no SocketCAN: {error}"
        fix = "sudo modprobe can_raw; without that module, boot the standard kernel"
        return MachineCheck("kernel", False, text, f"{fix} (linux-image-amd64)")
    return MachineCheck("kernel", True, "SocketCAN is available")


def _up(found: KernelInterface, bitrate: int) -> MachineCheck:
    text = f"{found.kind}, {'up' if found.up else 'down'}"
    return MachineCheck(f"interface {found.name}", found.up, text, bring_up(found.name, bitrate))


def _queue(found: KernelInterface) -> MachineCheck:
    return MachineCheck(
        f"txqueuelen of {found.name}",
        found.queue >= MIN_TRANSMIT_QUEUE,
        f"{found.queue} frames; {MIN_TRANSMIT_QUEUE} or more are required",
        f"sudo ip link set {found.name} txqueuelen 128",
    )


def _bitrate(found: KernelInterface, wanted: int, again: str) -> MachineCheck:
    name = f"bit rate of {found.name}"
    if found.up and found.bitrate is None:  # of other adapters the kernel requires one
        text = f"not stated by its driver; the rig file says {wanted} (slcand sets it by -s)"
        return MachineCheck(name, True, text)
    text = f"{found.bitrate} bit/s" if found.bitrate else "not set"
    if found.bitrate != wanted:
        text += f"; the rig file says {wanted}"
    return MachineCheck(name, found.bitrate == wanted, text, again)


def _controller(found: KernelInterface, again: str) -> MachineCheck:
    healthy = not found.state or found.state in HEALTHY
    fix = f"check power, cable and termination (60 ohm), then {again}"
    text = found.state or "not stated by its driver"
    if found.hindering:
        why = "; ".join(found.hindering.values())
        text, healthy, fix = f"{text}, {', '.join(found.hindering)}: {why}", False, again
    elif not found.up:
        healthy = True  # it has no state to report; `_up` reports that
    return MachineCheck(f"controller of {found.name}", healthy, text, fix)


# Real time.


def real_time_permission() -> list[MachineCheck]:
    """Priority and locked memory, as `cdpr run` requests them for real drives."""
    locked = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    return [
        priority_check(priority_limit(), granted=is_granted_priority()),
        memory_check(locked, privileged=has_capability(CAP_IPC_LOCK)),
    ]


def priority_check(limit: float, *, granted: bool) -> MachineCheck:
    """Whether the loop gets its real-time priority, which a control group may deny.

    Args:
        limit: Highest priority that the user may have (RLIMIT_RTPRIO).
        granted: Whether the system granted it.
    """
    text, fix = f"up to {limit:g}", _allow("rtprio", PRIORITY)
    if limit >= PRIORITY:
        text, fix = "allowed" if granted else "allowed to the user, but denied", ALLOW_GROUP
    return MachineCheck("real-time priority", granted, f"{text}; {PRIORITY} is used", fix)


def memory_check(limit: int, *, privileged: bool) -> MachineCheck:
    """Whether the loop's memory may be locked, so that it never waits for a disk."""
    unlimited = limit == resource.RLIM_INFINITY
    text = "allowed" if privileged or unlimited else f"{limit // 1024} KiB; unlimited is required"
    return MachineCheck(
        "locked memory", privileged or unlimited, text, _allow("memlock", "unlimited")
    )


def _allow(item: str, value: int | str) -> str:
    user = f":{os.getuid()}"  # by its number, as in a container
    with suppress(KeyError):
        user = pwd.getpwuid(os.getuid()).pw_name
    return f"echo '{user} - {item} {value}' | sudo tee -a {LIMITS}, then log out and in again"


# The objects of the drives.


def examine(rig: Rig) -> Examined:
    """Reads the objects of a rig's drives; simulates them here on the interface ``virtual``.

    Raises:
        BadInput: They are not CANopen drives, or their profile is wrong.
        HardwareMissing: The bus cannot be opened.
        Refused: Another program configures the drives.
        ForeignMaster: Another program commands them.
    """
    # Imported after the check of libraries: needs python-can and canopen.
    from drivers.can_bus import IN_PROCESS, BusSettings, open_bus
    from drivers.can_errors import BusFault, ForeignMaster, before_motion
    from drivers.cia402.inspection import Examined, examine_drives
    from executor.interlock.locks import SetUpLock
    from simulation.factory import make_rehearsal

    if rig.document.drives.type != "cia402":
        raise BadInput(
            f"the drives of {rig.name} are not CANopen drives",
            where="--drives",
            next_step="leave out --drives; `cdpr doctor RIG` checks the files that they need",
        )
    settings = BusSettings.of(rig)
    with ExitStack() as stack:
        stack.enter_context(SetUpLock(settings).held())
        bus = open_bus(settings)
        stack.callback(bus.shutdown)
        pump = None
        if settings.interface == IN_PROCESS:
            far_end = open_bus(settings)
            stack.callback(far_end.shutdown)
            pump = make_rehearsal(rig, far_end, rig.home).pump
        try:
            with before_motion():
                return examine_drives(rig, bus, pump)
        except ForeignMaster:
            raise
        except BusFault as fault:
            return Examined((), tuple(rig.drive_names), (), missing=fault)


def stopping_text(rig: Rig) -> str:
    """Stopping distance after loss of the master, which plans must keep as clearance."""
    from drivers.stopping_distance import coasting_distance, lost_master  # needs python-can

    lost, home = lost_master(rig), rig.home
    margin = rig.at(home).capacity_margin
    at_home = home.position[None], home.rotation[None]
    coasting = coasting_distance(rig, (), *at_home, margin, turns=False)
    inertia = f"; its inertia adds {coasting * 1000:.2g} mm at home" if isfinite(coasting) else ""
    return (
        f"without the master, drives stop by {lost.noticed_by} after {lost.notice * 1000:.0f} ms:"
        f" up to {lost.distance * 1000:.1f} mm at {rig.motion.speed * 1000:g} mm/s,"
        f" {lost.distance_turning * 1000:.1f} mm where the platform rotates{inertia}"
    )
