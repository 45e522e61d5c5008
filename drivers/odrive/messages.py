"""CANSimple messages: layouts from a DBC file, and meaning of the numbers. No bus.

Source: ODrive documentation, "CAN Protocol" and "API Reference" of firmware 0.6.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

import can

from drivers.can_bus import SentFrame
from model.errors import BadInput
from model.files.reading import MEGABYTE, read_bytes
from model.rig import Rig

# Layout of every message, read from a DBC file with cantools and packed by `struct`.
#
# cantools takes tens of microseconds per message, and a cycle has dozens; so the signals of a
# message become one `struct.Struct` when the file is read.


OWN_DBC = Path(__file__).with_name("cansimple.dbc")

DBC_LIMIT = 2 * MEGABYTE
"""Largest size of a file, [bytes]; ODrive's has a twentieth of it."""

#: Required signals of each message, in the order of its bytes.
NEEDED: dict[str, tuple[str, ...]] = {
    "Get_Version": (
        "Protocol_Version",
        "Hw_Version_Major",
        "Hw_Version_Minor",
        "Hw_Version_Variant",
        "Fw_Version_Major",
        "Fw_Version_Minor",
        "Fw_Version_Revision",
    ),
    "Heartbeat": ("Axis_Error", "Axis_State", "Procedure_Result"),
    "Estop": (),
    "RxSdo": ("Opcode", "Endpoint_ID", "Value"),
    "TxSdo": ("Endpoint_ID", "Value"),
    "Set_Axis_State": ("Axis_Requested_State",),
    "Get_Encoder_Estimates": ("Pos_Estimate", "Vel_Estimate"),
    "Set_Controller_Mode": ("Control_Mode", "Input_Mode"),
    "Set_Input_Pos": ("Input_Pos", "Vel_FF", "Torque_FF"),
    "Set_Limits": ("Velocity_Limit", "Current_Limit"),
    "Get_Bus_Voltage_Current": ("Bus_Voltage", "Bus_Current"),
    "Clear_Errors": (),
    "Get_Torques": ("Torque_Target", "Torque_Estimate"),
}

LARGEST_STEPS = 0x7FFF
"""Largest value of a scaled signal, [steps]."""

_INTEGERS = {(8, False): "B", (16, False): "H", (32, False): "I", (16, True): "h", (32, True): "i"}


@dataclass(frozen=True, slots=True)
class Layout:
    """Layout of the signals in a message.

    Attributes:
        name: As in the DBC file, without the axis.
        command: Number of the message.
        form: Format of the signals.
        scales: Value of one step of each signal; None if not scaled.
    """

    name: str
    command: int
    form: struct.Struct
    scales: tuple[float | None, ...]

    def pack(self, *values: float) -> bytes:
        """The bytes of a message, with scaled signals limited to their range."""
        return self.form.pack(*map(_steps, values, self.scales))

    def unpack(self, data: bytes | bytearray) -> tuple[float, ...] | None:
        """The values in a message; None if its length is wrong."""
        if len(data) != self.form.size:
            return None
        raw = self.form.unpack(data)
        return tuple(v if s is None else v * s for v, s in zip(raw, self.scales, strict=True))


def _steps(value: float, scale: float | None) -> float:
    if scale is None:
        return value
    return max(-0x8000, min(LARGEST_STEPS, round(value / scale)))


@dataclass(frozen=True, slots=True)
class Layouts:
    """All messages in use."""

    get_version: Layout
    heartbeat: Layout
    estop: Layout
    rxsdo: Layout
    txsdo: Layout
    set_axis_state: Layout
    get_encoder_estimates: Layout
    set_controller_mode: Layout
    set_input_pos: Layout
    set_limits: Layout
    get_bus_voltage_current: Layout
    clear_errors: Layout
    get_torques: Layout


def read_layouts(file: Path | str | None = None) -> Layouts:
    """The layouts in a DBC file, by default the one beside this module.

    Raises:
        BadInput: cantools is not installed, the file cannot be read, or a message or signal is
            missing or not aligned to bytes.
    """
    path = Path(file or OWN_DBC)
    database = _database(path)
    return Layouts(**{name.lower(): _layout(database, name, path) for name in NEEDED})


def _database(path: Path) -> Any:
    try:
        import cantools.database.errors
    except ImportError as error:
        raise BadInput(
            "the package cantools, needed for ODrives, is not installed",
            where="drives.type: odrive",
            next_step="pip install 'cdpr[odrive]'",
        ) from error
    # DBC files use code page 1252, as in cantools.
    text = read_bytes(path, DBC_LIMIT).decode("cp1252", errors="replace")
    try:
        # Not strict: in ODrive's file some signals have more bits than the message.
        return cantools.database.load_string(text, database_format="dbc", strict=False)
    except RecursionError as error:
        raise _unfit(path, "it is nested too deeply") from error
    # Errors of cantools in damaged files that it does not check.
    except (
        cantools.database.errors.Error,
        ArithmeticError,
        AttributeError,
        LookupError,
        TypeError,
        ValueError,
    ) as error:
        raise BadInput(
            f"the DBC file cannot be read: {error}",
            where=str(path),
            next_step="use ODrive's DBC file for the firmware (its page 'CAN Protocol'), or"
            " leave drives.dbc out",
        ) from error


def _layout(database: Any, name: str, path: Path) -> Layout:
    try:
        message = database.get_message_by_name(f"Axis0_{name}")
        signals = {signal.name: signal for signal in message.signals}
        wanted = [signals[signal] for signal in NEEDED[name]]
    except KeyError as error:
        raise _unfit(path, f"it has no {error.args[0]!r}") from error
    codes, scales, end = "<", [], 0
    for signal in wanted:
        size = "f" if signal.is_float else _INTEGERS.get((signal.length, signal.is_signed))
        gap, odd = divmod(signal.start - end, 8)
        if size is None or odd or gap < 0 or signal.byte_order != "little_endian":
            raise _unfit(path, f"{name}.{signal.name} is not a whole number of bytes in order")
        codes += f"{gap}x{size}"
        step = _scale(signal.conversion.scale, f"{name}.{signal.name}", path)
        scales.append(None if step == 1.0 and size != "h" else step)  # feed-forward is a fraction
        end = signal.start + signal.length
    if not end <= message.length * 8 <= 64:
        raise _unfit(
            path,
            f"{name} has {message.length} bytes; its signals need {end // 8}, the limit is 8",
        )
    form = struct.Struct(f"{codes}{message.length - end // 8}x")
    return Layout(name, message.frame_id, form, tuple(scales))


def _scale(given: float, name: str, path: Path) -> float:
    """Value of one step of a signal."""
    if not 1e-9 <= abs(given) <= 1e9:
        raise _unfit(path, f"{name} has a scale of {str(given)[:40]}")
    return float(given)


def _unfit(path: Path, what: str) -> BadInput:
    return BadInput(
        f"the DBC file does not describe CANSimple of firmware 0.6: {what}",
        where=str(path),
        next_step="use ODrive's DBC file for the firmware, or leave out drives.dbc",
    )


COMMAND_BITS = 5

BROADCAST = 0x3F
"""Node id by which every ODrive is addressed, from firmware 0.6.9. Source: ODrive's changelog."""

RXSDO, ADDRESS = 0x04, 0x06

COMMANDS: dict[int, str] = {
    0x02: "Estop",
    RXSDO: "RxSdo",
    ADDRESS: "Address",
    0x07: "Set_Axis_State",
    0x0B: "Set_Controller_Mode",
    0x0C: "Set_Input_Pos",
    0x0D: "Set_Input_Vel",
    0x0E: "Set_Input_Torque",
    0x0F: "Set_Limits",
    0x10: "Start_Anticogging",  # up to firmware 0.5
    0x11: "Set_Traj_Vel_Limit",
    0x12: "Set_Traj_Accel_Limits",
    0x13: "Set_Traj_Inertia",
    0x16: "Reboot",
    0x18: "Clear_Errors",
    0x19: "Set_Absolute_Position",
    0x1A: "Set_Pos_Gain",
    0x1B: "Set_Vel_Gains",
    0x1F: "Enter_DFU_Mode",
}
"""Every message by which a master changes a drive; also those that cdpr never sends."""


class AxisState(IntEnum):
    """Axis states in use; in the others the axis calibrates or searches."""

    IDLE = 1
    CLOSED_LOOP_CONTROL = 8


class ControlMode(IntEnum):
    """What the controller controls."""

    POSITION = 3


class InputMode(IntEnum):
    """Processing of a set-point before the controller."""

    PASSTHROUGH = 1


class AxisError(IntEnum):
    """Errors that are handled specially."""

    INITIALIZING = 0x0000_0001
    DC_BUS_UNDER_VOLTAGE = 0x0000_0200
    WATCHDOG_TIMER_EXPIRED = 0x0100_0000
    ESTOP_REQUESTED = 0x0200_0000


ERROR_TEXTS: dict[int, str] = {
    AxisError.INITIALIZING: "still starting",
    0x0000_0002: "drive electronics",
    0x0000_0004: "control loop late",
    0x0000_0008: "no position from the encoder",
    0x0000_0010: "invalid configuration",
    0x0000_0020: "gate driver",
    0x0000_0040: "no set-point received",
    0x0000_0100: "supply over-voltage",
    AxisError.DC_BUS_UNDER_VOLTAGE: "supply under-voltage",
    0x0000_0400: "supply over-current",
    0x0000_0800: "regenerated current above its limit",
    0x0000_1000: "motor current above its limit",
    0x0000_2000: "motor over-temperature",
    0x0000_4000: "drive over-temperature",
    0x0000_8000: "speed above its limit",
    0x0001_0000: "position outside its limits",
    0x0002_0000: "current demand above its limit",
    AxisError.WATCHDOG_TIMER_EXPIRED: "watchdog: no set-point in time",
    AxisError.ESTOP_REQUESTED: "emergency stop",
    0x0400_0000: "motor spinning out; has the encoder slipped?",
    0x0800_0000: "brake resistor",
    0x1000_0000: "temperature sensor",
    0x4000_0000: "calibration",
}

RESULT_TEXTS: dict[int, str] = {
    1: "still busy",
    2: "cancelled",
    3: "disarmed",
    4: "no response",
    11: "time-out",
    13: "not possible in this state",
    14: "not calibrated",
}
"""Reason why an axis did not reach a requested state."""


def can_id(node: int, command: int) -> int:
    """The identifier of a message of one drive."""
    return node << COMMAND_BITS | command


def node_and_command(identifier: int) -> tuple[int, int]:
    """The inverse of `can_id`."""
    return identifier >> COMMAND_BITS, identifier & (1 << COMMAND_BITS) - 1


def commanding_ids(nodes: Iterable[int]) -> frozenset[int]:
    """Identifiers of the `COMMANDS` to these drives; see `is_command`."""
    return frozenset(can_id(node, command) for node in (*nodes, BROADCAST) for command in COMMANDS)


def is_command(identifier: int, data: bytes | bytearray) -> bool:
    """Whether a frame with one of the `commanding_ids` changes a drive.

    RxSdo also reads. Address also asks for the drives on the bus, and is their answer: the sender's
    own node id, where a master writes a new one.
    """
    node, command = node_and_command(identifier)
    if command == RXSDO:
        return data[:1] != b"\0"
    if command == ADDRESS:
        return data[:1] not in (b"", bytes([node]))
    return True


def foreign_master_message(identifier: int, _data: bytes | bytearray) -> str:
    """Message about another program that sends a frame with one of the `commanding_ids`."""
    node, command = node_and_command(identifier)
    drives = "all drives" if node == BROADCAST else f"drive {node}"
    return f"another program commands {drives} ({COMMANDS[command]})"


def error_text(errors: int) -> str:
    """Text of an axis error."""
    known = [text for bit, text in ERROR_TEXTS.items() if errors & bit]
    return f"{', '.join(known) or 'unknown error'} (error {errors:08X}h)"


def state_text(word: int) -> str:
    """Text of a `status_word`."""
    state, error = state_in(word), word & ERROR_FLAG
    names = {AxisState.IDLE: "idle", AxisState.CLOSED_LOOP_CONTROL: "closed loop control"}
    text = names.get(AxisState(state)) if state in names else f"axis state {state}"
    return f"{text}, in error" if error else f"{text}"


ERROR_FLAG = 0x100


def status_word(state: int, errors: int) -> int:
    """State of an axis as one number, with a flag for errors.

    An expired watchdog of an idle axis is none: its brake holds, and enabling clears it.
    """
    excused = AxisError.WATCHDOG_TIMER_EXPIRED if state == AxisState.IDLE else 0
    return state | (ERROR_FLAG if errors & ~excused else 0)


def state_in(word: int) -> int:
    """The state of an axis in a `status_word`."""
    return word & 0xFF


# The frames that a master of ODrives sends. No bus.


class OdriveFrames:
    """Builds one frame per drive, to be sent back to back as there is no SYNC."""

    def __init__(self, rig: Rig, layouts: Layouts) -> None:
        """Takes nodes, counts and cycle from the rig."""
        self._nodes = tuple(winch.node_id for winch in rig.winches)
        self._per_turn = tuple(winch.counts_per_turn for winch in rig.winches)
        self._cycle = rig.cycle
        self._layouts = layouts

    def set_points(self, targets: Sequence[int], before: Sequence[int]) -> list[can.Message]:
        """Positions with speed feed-forward; they also feed the watchdogs.

        Args:
            targets: Shape (m,), [counts].
            before: Targets of the previous cycle, shape (m,), [counts].
        """
        layout = self._layouts.set_input_pos
        return [
            self._frame(
                node, layout, target / per_turn, (target - last) / per_turn / self._cycle, 0.0
            )
            for node, per_turn, target, last in zip(
                self._nodes, self._per_turn, targets, before, strict=True
            )
        ]

    def axis_states(
        self, state: AxisState, drives: Iterable[int] | None = None
    ) -> list[can.Message]:
        """Requests a state of every drive, or of some by index."""
        return [self._frame(n, self._layouts.set_axis_state, state) for n in self._of(drives)]

    def clear_errors(self, drives: Iterable[int] | None = None) -> list[can.Message]:
        """Clears the errors of every drive, or of some by index."""
        return [self._frame(n, self._layouts.clear_errors) for n in self._of(drives)]

    def _of(self, drives: Iterable[int] | None) -> Sequence[int]:
        return self._nodes if drives is None else [self._nodes[drive] for drive in drives]

    def _frame(self, node: int, layout: Layout, *values: float) -> can.Message:
        return SentFrame(can_id(node, layout.command), layout.pack(*values))
