"""CAN interfaces of Linux: state, bit rate, queue and modes, and the commands that set them."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from model.errors import HardwareMissing

MIN_TRANSMIT_QUEUE = 64
"""Frames that a kernel CAN interface must queue: a cycle and a stop in one burst, and a margin."""

OFF_THE_BUS = ("BUS-OFF", "STOPPED", "SLEEPING")
"""States of a controller that is up, in which it neither sends nor receives."""

UNUSABLE_MODES = {
    "LISTEN-ONLY": "the controller sends nothing, not even acknowledgements",
    "ONE-SHOT": "a set-point or stop that loses arbitration or is disturbed is not sent again",
    "LOOPBACK": "this program would take its own frames for those of another master",
}
"""Modes of a controller in which drives cannot be commanded, and why."""

INTERFACES = Path("/sys/class/net")

#: Folders of `ip` for users whose PATH has no system folders.
SYSTEM_FOLDERS = ("/usr/sbin", "/sbin")


@dataclass(frozen=True, slots=True)
class KernelInterface:
    """One CAN interface of the kernel.

    Attributes:
        name: Such as ``can0``.
        kind: ``can`` with a controller, which has a bit rate, or ``vcan`` without.
        up: Whether it is up.
        queue: Length of the transmit queue, [frames].
        bitrate: [bit/s]; None if not set, or if the driver states none, as with slcand.
        state: Of the controller, such as ``ERROR-ACTIVE``; empty if the driver states none.
        modes: Of the controller, such as ``LISTEN-ONLY``.
    """

    name: str
    kind: str
    up: bool
    queue: int
    bitrate: int | None
    state: str
    modes: tuple[str, ...] = ()

    @property
    def hindering(self) -> dict[str, str]:
        """Its modes in which drives cannot be commanded, each with the reason."""
        return {mode: UNUSABLE_MODES[mode] for mode in self.modes if mode in UNUSABLE_MODES}


def parse_interfaces(text: str) -> tuple[KernelInterface, ...]:
    """CAN interfaces in the output of ``ip -details -json link show``.

    Raises:
        ValueError: The text is not such output.
    """
    listed = json.loads(text or "[]")
    return tuple(_interface(link) for link in listed if link.get("link_type") == "can")


def _interface(link: dict[str, Any]) -> KernelInterface:
    details = link.get("linkinfo", {})
    data = details.get("info_data", {})
    return KernelInterface(
        name=link["ifname"],
        kind=details.get("info_kind", "can"),
        up="UP" in link["flags"],
        queue=int(link.get("txqlen", 0)),
        bitrate=data.get("bittiming", {}).get("bitrate") or data.get("bittiming_bitrate") or None,
        state=data.get("state", ""),
        modes=tuple(data.get("ctrlmode", ())),
    )


def can_interfaces() -> tuple[KernelInterface, ...]:
    """All CAN interfaces of this machine.

    Raises:
        HardwareMissing: The program ``ip`` is missing or fails.
    """
    path = os.pathsep.join((os.environ.get("PATH", ""), *SYSTEM_FOLDERS))
    program = shutil.which("ip", path=path)
    if program is None:
        raise HardwareMissing(
            "the program `ip`, which lists interfaces, is not installed",
            where="SocketCAN",
            next_step="sudo apt-get install iproute2",
        )
    shown = subprocess.run(
        [program, "-details", "-json", "link", "show"], capture_output=True, text=True, check=False
    )
    try:
        return parse_interfaces(shown.stdout)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise HardwareMissing(
            f"`ip` did not list the interfaces: {shown.stderr.strip() or error}",
            where="SocketCAN",
            next_step="run `ip -details -json link show` manually",
        ) from error


def require_usable(name: str, bitrate: int) -> None:
    """Requires what python-can notices only at the first frame, or never.

    Args:
        bitrate: That of the rig file, [bit/s].

    Raises:
        HardwareMissing: The interface is missing or down, its queue is too short, its controller is
            off the bus or in a mode that hinders, or its bit rate is another one.
    """
    folder = INTERFACES / name
    if not name or not folder.exists():
        present = sorted(p.name for p in INTERFACES.glob("*can*"))
        raise HardwareMissing(
            f"there is no network interface {name!r}",
            where=f"bus socketcan {name}",
            why=f"CAN interfaces here: {', '.join(present) or 'none'}",
            next_step=bring_up(name, bitrate),
        )
    if not int((folder / "flags").read_text(), 16) & 1:  # IFF_UP
        raise HardwareMissing(
            f"the network interface {name} is down",
            where=f"bus socketcan {name}",
            next_step=bring_up(name, bitrate),
        )
    queue = int((folder / "tx_queue_len").read_text())
    if queue < MIN_TRANSMIT_QUEUE:
        raise HardwareMissing(
            f"the transmit queue of {name} holds {queue} frames,"
            f" at least {MIN_TRANSMIT_QUEUE} are needed",
            where=f"bus socketcan {name}",
            why="a stop is sent as one batch, which must fit in the queue after a cycle",
            next_step=f"sudo ip link set {name} txqueuelen 128",
            values={"tx_queue_len": queue},
        )
    try:
        found = {each.name: each for each in can_interfaces()}.get(name)
    except HardwareMissing:  # without `ip`, which `cdpr doctor` reports
        return
    if found is not None:
        _require_controller(found, bitrate)


def _require_controller(found: KernelInterface, bitrate: int) -> None:
    """Requires a controller on the bus, without a mode that hinders, at the stated bit rate.

    A serial adapter (slcand) states none of the three.
    """
    again = set_up_again(found, bitrate)
    if found.state in OFF_THE_BUS:
        raise HardwareMissing(
            f"the controller of {found.name} is in the state {found.state}",
            where=f"bus socketcan {found.name}",
            why="it neither sends nor receives until the interface is taken down and up again",
            next_step=f"measure 60 ohm between CAN-H and CAN-L, then {again}",
        )
    for mode, why in found.hindering.items():
        raise HardwareMissing(
            f"{found.name} is in the mode {mode}",
            where=f"bus socketcan {found.name}",
            why=why,
            next_step=again,
        )
    if found.bitrate not in (None, bitrate):
        raise HardwareMissing(
            f"{found.name} runs at {found.bitrate} bit/s; the rig file states {bitrate}",
            where=f"bus socketcan {found.name}",
            why="the bus load is checked at the bit rate of the rig file",
            next_step=f"correct bus.bitrate, or {again}",
            values={"bitrate": found.bitrate},
        )


def set_up_again(found: KernelInterface, bitrate: int) -> str:
    """The command that sets the bit rate and ends modes that hinder, possible only while down."""
    name = found.name
    ended = "".join(f" {mode.lower()} off" for mode in found.hindering)
    return (
        f"sudo ip link set {name} down && sudo ip link set {name} up txqueuelen 128"
        f" type can bitrate {bitrate}{ended}"
    )


def bring_up(name: str, bitrate: int) -> str:
    """The command that brings a kernel CAN interface up."""
    name = name or "can0"
    if name.startswith("vcan"):
        return (
            f"sudo modprobe vcan && sudo ip link add dev {name} type vcan"
            f" && sudo ip link set {name} up txqueuelen 128"
        )
    return f"sudo ip link set {name} up txqueuelen 128 type can bitrate {bitrate}"
