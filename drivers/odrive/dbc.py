"""The layout of every message, taken from a DBC file with cantools; packed by `struct` afterwards.

cantools takes tens of microseconds a message, and a cycle has dozens of them; so the signals of a
message become one `struct.Struct` when the file is read.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from model.errors import BadInput
from model.files.reading import MEGABYTE, read_bytes

OWN_DBC = Path(__file__).with_name("cansimple.dbc")

DBC_LIMIT = 2 * MEGABYTE
"""Of a file, [bytes]; ODrive's own has a twentieth of it."""

#: What is needed of each message, in the order of its bytes.
NEEDED: dict[str, tuple[str, ...]] = {
    "Get_Version": (
        "Protocol_Version",
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
    "Clear_Errors": ("Identify",),
    "Get_Torques": ("Torque_Target", "Torque_Estimate"),
}

_INTEGERS = {(8, False): "B", (16, False): "H", (32, False): "I", (16, True): "h", (32, True): "i"}


@dataclass(frozen=True, slots=True)
class Layout:
    """How the signals of one message lie in its bytes.

    Attributes:
        name: As in the DBC file, without the axis.
        command: Its number.
        form: The signals.
        scales: Value of one step of each signal; None where it is not scaled.
    """

    name: str
    command: int
    form: struct.Struct
    scales: tuple[float | None, ...]

    def pack(self, *values: float) -> bytes:
        """The bytes of a message; a scaled signal that does not fit is as large as it may be."""
        return self.form.pack(*map(_steps, values, self.scales))

    def unpack(self, data: bytes | bytearray) -> tuple[float, ...] | None:
        """The values in a message; None when its length is wrong."""
        if len(data) != self.form.size:
            return None
        raw = self.form.unpack(data)
        return tuple(v if s is None else v * s for v, s in zip(raw, self.scales, strict=True))


def _steps(value: float, scale: float | None) -> float:
    if scale is None:
        return value
    return max(-0x8000, min(0x7FFF, round(value / scale)))


@dataclass(frozen=True, slots=True)
class Layouts:
    """All messages that are used."""

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


def read_layouts(path: Path = OWN_DBC) -> Layouts:
    """The layouts in a DBC file: ODrive's own, or the one beside this module.

    Raises:
        BadInput: cantools is not installed; the file cannot be read; a message or signal is not in
            it, or lies where no byte begins.
    """
    database = _database(path)
    found = {name.lower(): _layout(database, name, path) for name in NEEDED}
    return Layouts(**{field.name: found[field.name] for field in fields(Layouts)})


def _database(path: Path) -> Any:
    try:
        import cantools.database.errors
    except ImportError as error:
        raise BadInput(
            "the package cantools, needed for ODrives, is not installed",
            where="drives.type: odrive",
            next_step="pip install 'cdpr[odrive]'",
        ) from error
    # As cantools itself reads it: DBC files are of code page 1252.
    text = read_bytes(path, DBC_LIMIT).decode("cp1252", errors="replace")
    try:
        # Not strict: in ODrive's own file some signals have more bits than the message.
        return cantools.database.load_string(text, database_format="dbc", strict=False)
    except RecursionError as error:
        raise _unfit(path, "it is nested too deeply") from error
    # What of a damaged file cantools does not foresee comes as it stumbles over it.
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
        scales.append(_scale(signal.conversion.scale, f"{name}.{signal.name}", path))
        end = signal.start + signal.length
    if not end <= message.length * 8 <= 64:
        raise _unfit(
            path,
            f"{name} has {message.length} bytes; its signals need {end // 8}, the limit is 8",
        )
    form = struct.Struct(f"{codes}{message.length - end // 8}x")
    return Layout(name, message.frame_id, form, tuple(scales))


def _scale(given: float, name: str, path: Path) -> float | None:
    """Value of one step of a signal; None where it is not scaled."""
    if not 1e-9 <= abs(given) <= 1e9:
        raise _unfit(path, f"{name} has a scale of {str(given)[:40]}")
    return None if given == 1 else float(given)


def _unfit(path: Path, what: str) -> BadInput:
    return BadInput(
        f"the DBC file does not describe CANSimple of firmware 0.6: {what}",
        where=str(path),
        next_step="use ODrive's DBC file for the firmware, or leave out drives.dbc",
    )
