"""The CAN bus of a rig, opened through python-can."""

from __future__ import annotations

import copy
import errno
import ipaddress
import os
import socket
import stat
import struct
import time
import traceback
from contextlib import suppress
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Any

import can
from can.interfaces.udp_multicast import UdpMulticastBus
from can.interfaces.virtual import VirtualBus, channels_lock

from drivers.can_errors import bus_fault, bus_text
from drivers.can_interfaces import bring_up, require_usable
from model.errors import BadInput, HardwareMissing
from model.rig import Rig

UDP_DEFAULT_GROUP = "239.74.163.2"
UDP_DEFAULT_PORT = 43113
"""Defaults of python-can, interfaces/udp_multicast; the group is that of IPv4."""

UNUSABLE = {
    "cantact": "python-can's back end gives a sender its own frames",
    "gs_usb": "python-can's back end gives a sender its own frames and hides failures of reading",
    "socketcand": "TCP may deliver set-points late, and several at once",
}
"""Interfaces of python-can that cannot command drives, and why."""

IN_PROCESS = "virtual"
"""python-can's interface within one process; a run simulates its drives on it."""

RECEIVE_BUFFER_BYTES = 4 * 2**20
"""A default socket silently drops frames after the first 278."""

SO_MEMINFO = 55
MEMINFO_BYTES = 36
"""Nine counters; the last is the number of dropped frames. Source: linux/sock_diag.h."""


class SentFrame(can.Message):
    """A classic frame whose data is replaced, never modified, so that copies may share it."""

    __slots__ = ()

    def __init__(self, can_id: int, data: bytes | bytearray) -> None:
        """A frame with an 11-bit identifier."""
        super().__init__(arbitration_id=can_id, data=data, is_extended_id=False)


class InProcessBus(VirtualBus):
    """python-can's virtual bus with faster sending, and faster `recv` without a wait.

    A run in simulated time sends about twenty frames per cycle. Deep copies for every listener
    and a queue with locks in Python took as long as the simulated drives.
    """

    def __init__(self, channel: str, **options: Any) -> None:
        super().__init__(channel, **options)
        inbox: Any = SimpleQueue()  # declared as a Queue, of which only put and get are used
        with channels_lock:
            self.channel[self.channel.index(self.queue)] = inbox
            self.queue = inbox

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Gives all other ends one copy, which none of them changes."""
        if self.receive_own_messages:
            super().send(msg, timeout)
            return
        self._check_if_open()
        ours = isinstance(msg, SentFrame)
        arrived = SentFrame(msg.arbitration_id, msg.data) if ours else copy.deepcopy(msg)
        arrived.timestamp, arrived.channel, arrived.is_rx = time.time(), self.channel_id, True
        for inbox in self.channel:
            if inbox is not self.queue:
                inbox.put(arrived)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next frame, or None if none arrives within the time [s]."""
        if timeout != 0.0 or self._filters is not None:
            return super().recv(timeout)
        self._check_if_open()
        inbox = self.queue
        return None if inbox.empty() else inbox.get_nowait()


@dataclass(frozen=True, slots=True)
class BusSettings:
    """Settings for opening a bus.

    Attributes:
        interface: python-can's name, such as ``socketcan``, ``udp_multicast`` or ``virtual``.
        channel: Channel of the interface; for ``udp_multicast`` ``group[:port]``.
        bitrate: [bit/s]; on socketcan ``ip link`` sets it, and another one is refused.
    """

    interface: str
    channel: str
    bitrate: int = 1_000_000

    @classmethod
    def of(cls, rig: Rig) -> BusSettings:
        """The bus of a rig file."""
        bus = rig.document.bus
        return cls(bus.interface, bus.channel, bus.bitrate)

    @property
    def canonical(self) -> str:
        """The same text for every spelling of a bus, with defaults filled in."""
        interface, channel = self.interface.strip().lower(), self.channel.strip()
        if interface == "udp_multicast":
            options = _udp_options(self)
            channel = f"{options['channel']}:{options.get('port', UDP_DEFAULT_PORT)}"
        elif channel.startswith("/"):  # a serial adapter, which has several names in /dev
            channel = os.path.realpath(channel.partition("@")[0])  # without its speed
        return f"{interface} {channel}"

    def __str__(self) -> str:
        """Interface and channel, for messages."""
        return f"{self.interface} {self.channel}".strip()


def open_bus(settings: BusSettings) -> can.BusABC:
    """Opens a bus; the caller shuts it down.

    Raises:
        BadInput: python-can has no such interface, it cannot be used, or the channel is not one
            of its channels.
        HardwareMissing: It cannot be opened.
    """
    known = sorted(set(can.VALID_INTERFACES) - set(UNUSABLE))
    if settings.interface in UNUSABLE:
        raise BadInput(
            f"the CAN interface {settings.interface!r} cannot be used",
            where="bus.interface",
            why=UNUSABLE[settings.interface],
            next_step="use the adapter by its kernel driver, such as gs_usb, on this computer:"
            " interface: socketcan, channel: can0",
        )
    if settings.interface not in known:
        raise BadInput(
            f"unknown CAN interface {settings.interface!r}",
            where="bus.interface",
            next_step=f"use one of: {', '.join(known)}",
        )
    if settings.interface == "socketcan":
        require_usable(settings.channel, settings.bitrate)
    if settings.interface == IN_PROCESS:
        return InProcessBus(settings.channel)
    options = _options(settings)
    try:
        bus = can.Bus(interface=settings.interface, ignore_config=True, **options)
    # Back ends raise errors of their vendors' libraries; each means that the bus did not open.
    except Exception as error:
        _close_unopened(error)
        raise _cannot_open(settings, error) from error
    try:
        _prepare_socket(bus)
    except OSError as error:
        bus.shutdown()
        raise _cannot_open(settings, error) from error
    bus.channel_info = str(settings)  # names it in messages; some back ends set none
    return bus


def _close_unopened(error: Exception) -> None:
    """Closes the bus whose opening failed; python-can would report it as not shut down."""
    for frame, _line in traceback.walk_tb(error.__traceback__):
        bus = frame.f_locals.get("self")
        if isinstance(bus, can.BusABC):
            with suppress(Exception):  # of a back end, on a bus that it opened in part
                bus.shutdown()


def _options(settings: BusSettings) -> dict[str, Any]:
    if settings.interface == "udp_multicast":
        return _udp_options(settings)
    if settings.interface == "pcan":
        _require_rate_of_pcan(settings.bitrate)
    options: dict[str, Any] = {"channel": settings.channel, "bitrate": settings.bitrate}
    if settings.interface == "neovi":  # its default is to receive them
        options["receive_own_messages"] = False
    return options


def _require_rate_of_pcan(bitrate: int) -> None:
    """Requires a bit rate of these adapters; python-can would use 500 kbit/s for any other."""
    from can.interfaces.pcan.basic import PCAN_BITRATES  # its import prints a warning

    if bitrate not in PCAN_BITRATES:
        raise BadInput(
            f"adapters by PEAK have no bit rate of {bitrate} bit/s",
            where="bus.bitrate",
            next_step=f"use one of: {', '.join(map(str, sorted(PCAN_BITRATES)))}",
        )


def _udp_options(settings: BusSettings) -> dict[str, Any]:
    """Options of a multicast bus; hop limit 0 keeps set-points on this machine."""
    group, _, port = settings.channel.partition(":") if "." in settings.channel else ("", "", "")
    if settings.channel and not group:
        group = settings.channel  # an IPv6 group, which contains colons
    if group and not _is_multicast(group):
        raise BadInput(
            f"{group!r} is not a multicast address",
            where="bus.channel",
            next_step="the channel is a multicast address, such as 239.74.163.77 or"
            " 239.74.163.77:43114",
        )
    options: dict[str, Any] = {"channel": group or UDP_DEFAULT_GROUP, "hop_limit": 0, "fd": False}
    if port:
        if not port.isdecimal() or not 0 < int(port) < 65536:
            raise BadInput(
                f"port {port!r} is not a number from 1 to 65535",
                where="bus.channel",
                next_step=f"write group:port, such as {UDP_DEFAULT_GROUP}:43113",
            )
        options["port"] = int(port)
    return options


def _is_multicast(group: str) -> bool:
    try:
        return ipaddress.ip_address(group).is_multicast
    except ValueError:
        return False


def _cannot_open(settings: BusSettings, error: Exception) -> HardwareMissing:
    cause = error.__cause__ or error
    number = getattr(cause, "errno", None)
    step = "check the adapter, its driver and the channel name, then run `cdpr doctor`"
    if isinstance(error, (ImportError, can.CanInterfaceNotImplementedError)):
        step = (
            "install the adapter's Python package into this environment; for serial adapters"
            " (slcan, robotell, seeedstudio, serial): pip install 'python-can[serial]'"
        )
    if settings.interface == "socketcan":
        step = bring_up(settings.channel, settings.bitrate)
        if number == errno.EAFNOSUPPORT:
            step = "load the kernel's CAN support: sudo modprobe can_raw"
    elif settings.interface == "udp_multicast":
        step = "route multicast through the loopback: sudo ip route add 239.0.0.0/8 dev lo"
    return HardwareMissing(
        "the bus cannot be opened",
        where=f"bus {settings}",
        why=f"{type(cause).__name__}: {cause}",
        next_step=step,
    )


def _prepare_socket(bus: can.BusABC) -> None:
    """Enlarges the receive buffer; on IP sockets refuses groups joined by other sockets."""
    descriptor = _socket_of(bus)
    if descriptor is None:
        return
    with socket.socket(fileno=os.dup(descriptor)) as bus_socket:
        bus_socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        if bus_socket.family == socket.AF_INET:
            ip_multicast_all = 49  # Source: linux/in.h; Python names it from 3.14
            bus_socket.setsockopt(socket.IPPROTO_IP, ip_multicast_all, 0)


def _socket_of(bus: can.BusABC) -> int | None:
    """Descriptor of a bus's socket; None where it has none, as with a serial adapter."""
    try:
        descriptor = bus.fileno()
        is_socket = descriptor >= 0 and stat.S_ISSOCK(os.fstat(descriptor).st_mode)
    except (NotImplementedError, OSError):
        return None
    return descriptor if is_socket else None


def echoes_own_frames(bus: can.BusABC) -> bool:
    """Whether a sender receives its own frames, as with multicast but not on CAN."""
    return isinstance(bus, UdpMulticastBus)


def lost_frames(bus: can.BusABC) -> int:
    """Number of frames the kernel dropped since opening, because they were not read in time.

    0 for buses without a socket, where only missing replies indicate a loss.
    """
    descriptor = _socket_of(bus)
    if descriptor is None:
        return 0
    bus_socket = socket.socket(fileno=descriptor)
    try:
        # python-can rejects the control message of SO_RXQ_OVFL; this reads the same counter.
        memory = bus_socket.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, MEMINFO_BYTES)
    finally:
        bus_socket.detach()
    (lost,) = struct.unpack_from("=I", memory, MEMINFO_BYTES - 4)
    return int(lost)


def transmit(bus: can.BusABC, message: can.Message) -> None:
    """Sends one frame.

    Raises:
        BusFault: The bus did not accept it. A full queue counts too: a late set-point is wrong.
    """
    try:
        bus.send(message)
    except Exception as error:  # back ends raise errors of their own libraries
        raise bus_fault("a frame could not be sent", bus_text(bus), error) from error


def receive_frame(bus: can.BusABC, timeout: float) -> can.Message | None:
    """The next frame, or None if none arrives within the time [s].

    Raises:
        BusFault: The bus failed.
    """
    try:
        return bus.recv(timeout)
    except Exception as error:  # back ends raise errors of their own libraries
        raise bus_fault("the bus cannot be read", bus_text(bus), error) from error
