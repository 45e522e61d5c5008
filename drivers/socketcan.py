"""What Linux reports about a CAN interface: there, up, bit rate, queue, state of its controller."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from dataclasses import dataclass
from typing import Any

from model.errors import HardwareMissing

#: Where `ip` is for users whose PATH has no system folders.
SYSTEM_FOLDERS = ("/usr/sbin", "/sbin")


@dataclass(frozen=True, slots=True)
class KernelInterface:
    """One CAN interface of the kernel.

    Attributes:
        name: Such as ``can0``.
        kind: ``can``, or ``vcan`` for one without hardware.
        up: It was brought up.
        queue: Frames that may wait to be sent.
        bitrate: [bit/s]; None where it has none or none was set.
        state: Of the controller, such as ``ERROR-ACTIVE``; empty where it has none.
    """

    name: str
    kind: str
    up: bool
    queue: int
    bitrate: int | None
    state: str

    @property
    def has_hardware(self) -> bool:
        """A controller with a bit rate, not a virtual bus."""
        return self.kind == "can"


def parse_interfaces(text: str) -> tuple[KernelInterface, ...]:
    """CAN interfaces in what ``ip -details -json link show`` prints.

    Raises:
        ValueError: It is not that.
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
        bitrate=data.get("bittiming", {}).get("bitrate"),
        state=data.get("state", ""),
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
            next_step="run `ip -details -json link show` by hand",
        ) from error
