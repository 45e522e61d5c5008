"""What `cdpr doctor RIG` looks at on a kernel CAN bus, each with the command that mends it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from cdpr.cli.doctor_answer import Answer

if TYPE_CHECKING:
    from drivers.bus import BusSettings
    from drivers.socketcan import KernelInterface

#: States of a controller in which it takes part in the traffic without restriction.
HEALTHY = ("ERROR-ACTIVE", "ERROR-WARNING")


def kernel_bus(settings: BusSettings, interfaces: Sequence[KernelInterface]) -> list[Answer]:
    """Whether the interface of a rig is there, up, fast enough and healthy.

    Args:
        settings: The rig's bus.
        interfaces: The CAN interfaces of this machine.
    """
    from drivers.bus import bring_up

    name = settings.channel
    kernel = kernel_support()
    if not kernel.good:
        return [kernel]
    found = next((interface for interface in interfaces if interface.name == name), None)
    if found is None:
        there = ", ".join(interface.name for interface in interfaces) or "none"
        text = f"not there; CAN interfaces here: {there}"
        return [Answer(f"interface {name}", False, text, bring_up(settings))]
    answers = [_up(found, settings), _queue(found)]
    if found.has_hardware:
        answers += [_bitrate(found, settings.bitrate), _controller(found, settings.bitrate)]
    return answers


def kernel_support() -> Answer:
    """Whether sockets of the CAN family open; no privilege is needed for them."""
    import socket

    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (AttributeError, OSError) as error:
        text = f"no SocketCAN: {error}"
        fix = "sudo modprobe can_raw; where there is no such module, boot the ordinary kernel"
        return Answer("kernel", False, text, f"{fix} (linux-image-amd64)")
    return Answer("kernel", True, "SocketCAN is there")


def _up(found: KernelInterface, settings: BusSettings) -> Answer:
    from drivers.bus import bring_up

    text = f"{found.kind}, {'up' if found.up else 'down'}"
    return Answer(f"interface {found.name}", found.up, text, bring_up(settings))


def _queue(found: KernelInterface) -> Answer:
    from drivers.bus import MIN_TRANSMIT_QUEUE

    return Answer(
        f"txqueuelen of {found.name}",
        found.queue >= MIN_TRANSMIT_QUEUE,
        f"{found.queue} frames; {MIN_TRANSMIT_QUEUE} or more are needed",
        f"sudo ip link set {found.name} txqueuelen 128",
    )


def _bitrate(found: KernelInterface, wanted: int) -> Answer:
    text = f"{found.bitrate} bit/s" if found.bitrate else "not set"
    if found.bitrate != wanted:
        text += f"; the rig file says {wanted}"
    fix = _set_anew(found.name, wanted)
    return Answer(f"bit rate of {found.name}", found.bitrate == wanted, text, fix)


def _controller(found: KernelInterface, bitrate: int) -> Answer:
    healthy = found.state in HEALTHY
    fix = f"check power, cable and termination (60 ohm), then {_set_anew(found.name, bitrate)}"
    text = found.state or "unknown"
    # Down it has no state worth a word; that it is down is told already.
    return Answer(f"controller of {found.name}", healthy or not found.up, text, fix)


def _set_anew(name: str, bitrate: int) -> str:
    """A bit rate can be set only while the interface is down."""
    return (
        f"sudo ip link set {name} down && sudo ip link set {name} up txqueuelen 128"
        f" type can bitrate {bitrate}"
    )
