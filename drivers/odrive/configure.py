"""Configures all ODrives and reads back what can be read, before any is enabled."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import can

from drivers.can_bus import SentFrame, echoes_own_frames, receive_frame, transmit
from drivers.can_errors import EchoFilter, ForeignMaster, bus_text, error_frame_fault
from drivers.can_load import heartbeat_within
from drivers.drive_group import Pump
from drivers.odrive.endpoints import Endpoint, Endpoints, Wanted, read_endpoints, wanted_settings
from drivers.odrive.messages import (
    LARGEST_STEPS,
    AxisError,
    AxisState,
    ControlMode,
    InputMode,
    Layout,
    Layouts,
    can_id,
    commanding_ids,
    foreign_master_message,
    is_command,
    node_and_command,
)
from drivers.odrive.monitor import LISTENED, in_error, no_version, not_idle, too_rare
from drivers.plausibility import position_limits
from drivers.setup_refusals import SETTING_UP, answers_twice, wrong_setting
from model.errors import BadInput, HardwareMissing, Refused
from model.files.rig_file import OdriveDocument
from model.rig import Rig
from model.winches import WinchMap

# Requests to ODrives and their answers during configuration. One thread.


RESPONSE_TIMEOUT = 0.5
"""Time-out of a request, [s]."""

ECHO_WAIT = 0.05
"""Time within which a second device with the same node id answers, [s]."""

SENT_CYCLICALLY = ("its version_msg_rate_ms is not 0", "set version_msg_rate_ms to 0")
"""Another cause of two version messages, and its cure."""

OPCODE_READ, OPCODE_WRITE = 0, 1

LISTENING_TRIES = 5  # as this computer may be late

PUMPED = 0.01
"""Time counted for each step of simulated drives, [s]."""


class SetupLink:
    """The bus during configuration."""

    def __init__(
        self, bus: can.BusABC, pump: Pump | None, layouts: Layouts, nodes: Sequence[int]
    ) -> None:
        """Takes an open bus, ``pump`` as for `drivers.factory.make_drive_group`, the drives."""
        self._bus, self._pump, self._layouts = bus, pump, layouts
        self._own = EchoFilter(commanding_ids(nodes), echoes_own_frames=echoes_own_frames(bus))

    def send(self, node: int, layout: Layout, *values: float) -> None:
        """Sends a message to one drive."""
        self._send(node, layout.command, layout.pack(*values))

    def ask(self, node: int, layout: Layout) -> None:
        """Requests a message from one drive, by a remote frame.

        ODrives also answer a data frame without data, but two nodes that send data frames of one
        identifier at the same time disturb each other. Source: ODrive, "CAN Protocol", overview.
        """
        identifier = can_id(node, layout.command)
        request = can.Message(arbitration_id=identifier, is_remote_frame=True, is_extended_id=False)
        transmit(self._bus, request)

    def read(self, node: int, endpoint: int) -> None:
        """Requests the value of an endpoint."""
        data = self._layouts.rxsdo.pack(OPCODE_READ, endpoint, 0)
        self._send(node, self._layouts.rxsdo.command, data[:4])

    def write(self, node: int, endpoint: int, value: bytes) -> None:
        """Writes the value of an endpoint."""
        data = self._layouts.rxsdo.pack(OPCODE_WRITE, endpoint, 0)
        self._send(node, self._layouts.rxsdo.command, data[:4] + value)

    def endpoint_values(self, timeout: float) -> Iterator[tuple[int, int, bytes]]:
        """Yields node, endpoint and value of every answer to `read` within a time [s].

        An answer is as long as its value, or 8 bytes; what follows the value is undefined.

        Raises:
            BusFault: As for `answers`.
        """
        layout = self._layouts.txsdo
        for node, data in self._messages(layout, timeout):
            values = layout.unpack(data.ljust(8, b"\0"))
            if len(data) > 4 and values is not None:
                yield node, int(values[0]), data[4:]

    def answers(self, layout: Layout, timeout: float) -> Iterator[tuple[int, tuple[float, ...]]]:
        """Yields node and values of every message of a kind within a time [s].

        Raises:
            BusFault: The bus failed, or another program commands a drive.
        """
        for node, data in self._messages(layout, timeout):
            values = layout.unpack(data)
            if values is not None:
                yield node, values

    def _messages(self, layout: Layout, timeout: float) -> Iterator[tuple[int, bytes]]:
        """Node and data of every message of a kind within a time [s]."""
        for message in self._frames(timeout):
            node, command = node_and_command(message.arbitration_id)
            if command == layout.command:
                yield node, bytes(message.data)

    def _send(self, node: int, command: int, data: bytes) -> None:
        identifier = can_id(node, command)
        if is_command(identifier, data):
            self._own.sent(identifier)
        transmit(self._bus, SentFrame(identifier, data))

    def _frames(self, timeout: float) -> Iterator[can.Message]:
        for left in self._waits(timeout):
            while (message := receive_frame(self._bus, left)) is not None:
                if message.is_error_frame:
                    fault = error_frame_fault(self._bus, message)
                    if fault is not None:
                        raise fault
                elif not (message.is_extended_id or message.is_remote_frame):
                    identifier = message.arbitration_id
                    if is_command(identifier, message.data) and self._own.is_foreign(identifier):
                        text = foreign_master_message(identifier, message.data)
                        raise ForeignMaster(text, bus_text(self._bus))
                    yield message
                if left > 0.0:
                    break

    def _waits(self, timeout: float) -> Iterator[float]:
        """Yields times to wait for the next frame; steps simulated drives instead."""
        if self._pump is not None:
            for _ in range(math.ceil(timeout / PUMPED)):
                self._pump()
                yield 0.0
            return
        deadline = time.monotonic() + timeout
        while (left := deadline - time.monotonic()) > 0.0:
            yield left


SPEED_RESERVE = 1.5
TORQUE_RESERVE = 1.2
"""Limits relative to a run's needs: the monitors of following error and tension must trip first."""

WHOLE_IN_FLOAT = 2**24
"""Integers up to this are exact in the 32-bit float of a set-point."""

MOST_CYCLES = 5
"""Longest period of positions and torques, [cycles]: a position may belong to any set-point since
the last one, which delays the detection of a drive that does not follow."""

HEARD_BEFORE = 3
"""Time without another master before anything is sent, [cycles]."""

OLDEST_FIRMWARE = (0, 6)
NO_SUPPLY = 1.0
"""Voltage below which the motor supply is off, [V]."""

CONFIRMATION_WAIT = 0.01
"""Time for the confirmation of a write, [s]."""


Answers = dict[int, tuple[float, ...]]


def configure_drives(
    rig: Rig,
    document: OdriveDocument,
    layouts: Layouts,
    bus: can.BusABC,
    pump: Pump | None,
    *,
    max_tension: float,
    to_reset: bool,
) -> tuple[str, ...]:
    """Configures every drive; arguments and errors as for `DriveGroup.configure`.

    ``max_tension`` sets the torque limit, [N].

    A watchdog that expired while no drive was enabled only shows that a master was lost; it is
    cleared if all brakes are closed.
    """
    nodes = tuple(winch.node_id for winch in rig.winches)
    check_rig(rig, document, layouts)
    known = (
        read_endpoints(Path(document.endpoints), document, layouts) if document.endpoints else None
    )
    link = SetupLink(bus, pump, layouts, nodes)
    for _ in link.answers(layouts.heartbeat, HEARD_BEFORE * rig.cycle):
        pass  # another program that commands a drive is found before anything is sent
    _check_versions(link, layouts, nodes, document, known)
    _check_idle(link, layouts, nodes, document, to_reset)
    _check_supply(link, layouts, nodes)
    if pump is None:  # drives simulated in this process have the periods of the rig file
        _check_rates(link, layouts, nodes, document)
    if known is not None:
        for node in nodes:
            for wanted in wanted_settings(document, layouts):
                _set(link, node, known.by_name[wanted.name], wanted)
    for winch in rig.winches:
        turns = SPEED_RESERVE * winch.max_speed * abs(winch.counts_per_metre)
        torque = TORQUE_RESERVE * max_tension / winch.torque_constant * winch.rated_torque
        limits = turns / winch.counts_per_turn, torque / document.motor_torque_constant_nm_a
        link.send(winch.node_id, layouts.set_limits, *limits)
        mode = ControlMode.POSITION, InputMode.PASSTHROUGH
        link.send(winch.node_id, layouts.set_controller_mode, *mode)
    if known is not None:
        return ()
    return (
        "the drives' settings (watchdog, message periods, scales of feed-forward, absolute and"
        " circular set-points) were not read back, because the rig file names no drives.endpoints;"
        " they must be as the rig file and the documentation of ODrives say",
    )


def check_rig(rig: Rig, document: OdriveDocument, layouts: Layouts) -> None:
    """Requires positions, speeds and message periods that ODrives can meet.

    Raises:
        BadInput: One cannot be met.
    """
    check_resolution(rig)
    _check_speeds(rig, layouts)
    _check_periods(rig, document)


def check_resolution(rig: Rig) -> None:
    """Requires that set-points, 32-bit floats in turns, resolve every count of the travel.

    Raises:
        BadInput: They do not.
    """
    winch_map = WinchMap(rig)
    for drive in range(rig.cable_count):
        farthest = max(map(abs, position_limits(rig, drive, winch_map)))
        if farthest > WHOLE_IN_FLOAT:
            raise BadInput(
                f"an ODrive's set-point does not resolve positions up to {farthest} counts",
                where=f"rig {rig.name}: winches[{drive}]",
                next_step="choose a smaller counts_per_rev (an arbitrary unit for ODrives), or"
                " home_counts closer to 0",
            )


def _check_speeds(rig: Rig, layouts: Layouts) -> None:
    """Requires that feed-forward, 16 bits, holds the top speed of every winch."""
    _, step, _ = layouts.set_input_pos.scales
    most = LARGEST_STEPS * (step or 1.0)
    for drive, winch in enumerate(rig.winches):
        turns = winch.max_speed * abs(winch.counts_per_metre) / winch.counts_per_turn
        if turns > most:
            raise BadInput(
                f"the motor turns at up to {turns:g} turns/s; an ODrive's feed-forward holds"
                f" {most:g} turns/s",
                where=f"rig {rig.name}: winches[{drive}]",
                next_step="lower max_speed_mm_s, or use larger steps: a smaller input_vel_scale of"
                " the drives, and a drives.dbc with the same steps of Vel_FF",
            )


def _check_periods(rig: Rig, document: OdriveDocument) -> None:
    """Requires positions and torques often enough for the monitors."""
    limit = MOST_CYCLES * rig.document.bus.cycle_ms
    for key, setting in (("estimates_ms", "encoder"), ("torques_ms", "torques")):
        period = getattr(document, key)
        if period > limit:
            raise BadInput(
                f"drives.{key} is {period} ms; the limit is {MOST_CYCLES} cycles, {limit:g} ms",
                where=f"rig {rig.name}: drives.{key}",
                why="a drive that does not follow, or a loose cable, would be noticed too late",
                next_step=f"set {setting}_msg_rate_ms of every drive, and drives.{key}, to the"
                " cycle",
            )


def _answers(
    link: SetupLink,
    layout: Layout,
    nodes: Sequence[int],
    timeout: float,
    *,
    asked: bool,
    once: bool = False,
    alive: tuple[Layout, float] | None = None,
) -> Answers:
    """One message from every drive.

    Args:
        timeout: Time for all of them, [s].
        asked: The message was requested; otherwise drives send it on their own.
        once: No drive may send it twice.
        alive: Message that shows which silent drives are there, and the time to wait for it, [s].
    """
    received: Answers = {}
    for node, values in link.answers(layout, timeout):
        if node in received and once:
            raise answers_twice(node, *SENT_CYCLICALLY)
        if node in nodes:
            received[node] = values
        if len(received) == len(nodes):
            return received
    there = {node for node, _ in link.answers(*alive)} if alive else set()
    missing = [node for node in nodes if node not in received]
    silent = ", ".join(map(str, missing))
    if there.issuperset(missing):
        raise no_version(silent)
    adapter = ", or an adapter without remote frames" if asked else ""
    raise HardwareMissing(
        f"drive{'s' if ',' in silent else ''} {silent}: no {layout.name}",
        where=SETTING_UP,
        why="no power, a broken cable, a wrong bit rate or node id, the message is disabled"
        + adapter,
        next_step="check power and wiring, and node id, bit rate and message periods with"
        " odrivetool",
        values={"nodes": silent},
    )


def _check_versions(
    link: SetupLink,
    layouts: Layouts,
    nodes: Sequence[int],
    document: OdriveDocument,
    known: Endpoints | None,
) -> None:
    """Checks that every drive answers once, with a supported firmware and the known board."""
    for node in nodes:
        link.ask(node, layouts.get_version)
    layout, alive = layouts.get_version, (layouts.heartbeat, heartbeat_within(document))
    versions = _answers(link, layout, nodes, RESPONSE_TIMEOUT, asked=True, once=True, alive=alive)
    for node, _ in link.answers(layout, ECHO_WAIT):
        if node in nodes:
            raise answers_twice(node, *SENT_CYCLICALLY)
    for node, (_, *numbers) in versions.items():
        board, firmware = tuple(map(int, numbers[:3])), tuple(map(int, numbers[3:]))
        if firmware[:2] < OLDEST_FIRMWARE:
            text = ".".join(map(str, firmware))
            raise Refused(
                f"its firmware {text} is too old",
                where=f"drive {node}",
                why="CANSimple has other messages since firmware 0.6",
                next_step="update it with odrivetool",
                values={"node": node, "firmware": text},
            )
        if known is not None:
            known.require(node, board, firmware)


def _check_idle(
    link: SetupLink, layouts: Layouts, nodes: Sequence[int], document: OdriveDocument, reset: bool
) -> None:
    """Checks that no drive is enabled, busy or in error."""
    wait = heartbeat_within(document)
    heartbeats = _answers(link, layouts.heartbeat, nodes, wait, asked=False)
    for node, (_, state, _) in heartbeats.items():
        if state != AxisState.IDLE:
            raise not_idle(node, int(state))
    for node, (errors, _, _) in heartbeats.items():
        if int(errors) & ~AxisError.WATCHDOG_TIMER_EXPIRED and not reset:
            raise in_error(node, int(errors))
    if any(errors == AxisError.WATCHDOG_TIMER_EXPIRED for errors, _, _ in heartbeats.values()):
        for node in nodes:
            link.send(node, layouts.clear_errors)


def _check_supply(link: SetupLink, layouts: Layouts, nodes: Sequence[int]) -> None:
    for node in nodes:
        link.ask(node, layouts.get_bus_voltage_current)
    layout = layouts.get_bus_voltage_current
    supplies = _answers(link, layout, nodes, RESPONSE_TIMEOUT, asked=True)
    for node, (voltage, _) in supplies.items():
        if not voltage > NO_SUPPLY:  # also for NaN
            raise Refused(
                f"drive {node} has no motor supply: {voltage:.1f} V",
                where=f"drive {node}, Get_Bus_Voltage_Current",
                next_step="switch on the motor supply",
                values={"node": node, "voltage": voltage},
            )


def _check_rates(
    link: SetupLink, layouts: Layouts, nodes: Sequence[int], document: OdriveDocument
) -> None:
    """Checks that positions and torques are as frequent as in the rig file."""
    for key, setting, layout in (
        ("estimates_ms", "encoder_msg_rate_ms", layouts.get_encoder_estimates),
        ("torques_ms", "torques_msg_rate_ms", layouts.get_torques),
    ):
        period = getattr(document, key)
        for left in reversed(range(LISTENING_TRIES)):
            answers = link.answers(layout, LISTENED * period / 1000.0)
            rare = too_rare(nodes, Counter(node for node, _ in answers), key, setting, period)
            if rare is None:
                break
            if not left:
                raise rare


def _set(link: SetupLink, node: int, endpoint: Endpoint, wanted: Wanted) -> None:
    """Writes a setting and reads it back."""
    value = endpoint.to_bytes(wanted.value)
    link.write(node, endpoint.number, value)
    # Since firmware 0.6.11 writes are confirmed; the confirmation must not be taken for the answer.
    for _ in link.endpoint_values(CONFIRMATION_WAIT):
        pass
    link.read(node, endpoint.number)
    for answering, number, answer in link.endpoint_values(RESPONSE_TIMEOUT):
        if answering != node or number != endpoint.number:
            continue
        reported = endpoint.value_in(answer, node)
        if reported == value:
            return
        raise wrong_setting(
            node,
            f"endpoint {endpoint.name}",
            f"{endpoint.from_bytes(reported):g}",
            f"{wanted.value:g}",
            wanted.why,
            "see ODrive's API reference; the set-up was not finished: the axes are idle, with part"
            " of their settings",
        )
    raise HardwareMissing(
        f"drive {node} does not report {endpoint.name}",
        where=SETTING_UP,
        next_step="check that drives.endpoints matches the drive's firmware and board",
        values={"node": node, "endpoint": endpoint.name},
    )
