"""Settings of an ODrive by name: the endpoints of its firmware, and the values that cdpr requires.

ODrive publishes a `flat_endpoints.json` for each firmware and board, with number and type of each
name in the API reference.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from drivers.odrive.messages import Layouts
from model.errors import BadInput, Refused
from model.files.reading import read_json
from model.files.rig_file import OdriveDocument

_FORMS = {
    "bool": "<?",
    "uint8": "<B",
    "int8": "<b",
    "uint16": "<H",
    "int16": "<h",
    "uint32": "<I",
    "int32": "<i",
    "float": "<f",
}


_OTHER_FILE = (
    "use ODrive's flat_endpoints.json for the firmware and board, or leave out drives.endpoints"
)


class _EndpointEntry(BaseModel):
    """One entry of the file."""

    model_config = ConfigDict(strict=True)

    id: Annotated[int, Field(ge=0, le=0xFFFF)]
    type: str


class _EndpointsFile(BaseModel):
    """The parts of ODrive's file that are used."""

    model_config = ConfigDict(strict=True)

    fw_version: Annotated[str, Field(max_length=100)]
    hw_version: Annotated[str, Field(max_length=100)] = ""
    endpoints: dict[str, object]


@dataclass(frozen=True, slots=True)
class Endpoint:
    """One setting of a drive.

    Attributes:
        name: Such as ``axis0.config.enable_watchdog``.
        number: On the bus.
        type: As in ODrive's file, such as ``uint32``.
    """

    name: str
    number: int
    type: str

    @property
    def size(self) -> int:
        """Size of a value, [bytes]."""
        return struct.calcsize(_FORMS[self.type])

    def to_bytes(self, value: float) -> bytes:
        """A value as on the bus."""
        return struct.pack(_FORMS[self.type], value)

    def from_bytes(self, data: bytes) -> float:
        """The inverse of `to_bytes`."""
        return float(struct.unpack(_FORMS[self.type], data)[0])

    def value_in(self, answer: bytes, node: int) -> bytes:
        """The value at the beginning of a drive's answer.

        Raises:
            Refused: The answer is too short.
        """
        if len(answer) < self.size:
            plural = "" if len(answer) == 1 else "s"
            raise Refused(
                f"its answer has {len(answer)} byte{plural}, a {self.type} has {self.size}",
                where=f"drive {node}, endpoint {self.name}",
                why="the number or type in drives.endpoints is not that of the drive",
                next_step=f"{_OTHER_FILE}; the set-up was not finished: the axes are idle, with"
                " part of their settings",
                values={"node": node, "endpoint": self.name},
            )
        return answer[: self.size]


@dataclass(frozen=True, slots=True)
class Wanted:
    """A setting with its required value.

    Attributes:
        name: Of the endpoint.
        value: Required value.
        why: Reason for the value.
    """

    name: str
    value: float
    why: str


@dataclass(frozen=True, slots=True)
class Endpoints:
    """The endpoints of one firmware of one board.

    Attributes:
        firmware: Major, minor, revision.
        board: Product line, version, variant.
        by_name: The endpoints that cdpr uses.
    """

    firmware: tuple[int, int, int]
    board: tuple[int, int, int]
    by_name: dict[str, Endpoint]

    def require(self, node: int, board: tuple[int, ...], firmware: tuple[int, ...]) -> None:
        """Requires a drive of this firmware and board.

        Raises:
            Refused: It has another one.
        """
        rows = (("firmware", firmware, self.firmware), ("board", board, self.board))
        for kind, version, described in rows:
            if version != described:
                text, wanted = (".".join(map(str, numbers)) for numbers in (version, described))
                raise Refused(
                    f"its {kind} is {text}, drives.endpoints is for {wanted}",
                    where=f"drive {node}",
                    why=f"endpoint numbers differ between {kind} versions",
                    next_step=f"use the flat_endpoints.json of the drive's {kind}, or leave out"
                    " drives.endpoints if the drives differ",
                    values={"node": node, kind: text},
                )


def wanted_settings(document: OdriveDocument, layouts: Layouts) -> tuple[Wanted, ...]:
    """Required settings of every drive of a rig; limits are set by separate messages.

    Raises:
        BadInput: No scale of a drive gives the steps of feed-forward in ``layouts``.
    """
    can, config, controller = "axis0.config.can", "axis0.config", "axis0.controller.config"
    watchdog = (document.watchdog_ms or 0.0) / 1000.0
    _, speed_step, torque_step = layouts.set_input_pos.scales
    return (
        Wanted(f"{config}.watchdog_timeout", watchdog, "drives.watchdog_ms"),
        Wanted(f"{config}.enable_watchdog", watchdog > 0.0, "it stops when its master is lost"),
        Wanted(f"{can}.heartbeat_msg_rate_ms", document.heartbeat_ms, "drives.heartbeat_ms"),
        Wanted(f"{can}.encoder_msg_rate_ms", document.estimates_ms, "drives.estimates_ms"),
        Wanted(f"{can}.torques_msg_rate_ms", document.torques_ms, "drives.torques_ms"),
        Wanted(f"{can}.input_vel_scale", *_steps_per_unit("Vel_FF", speed_step, document)),
        Wanted(f"{can}.input_torque_scale", *_steps_per_unit("Torque_FF", torque_step, document)),
        Wanted(f"{controller}.circular_setpoints", False, "cable travel does not wrap around"),
        Wanted(f"{controller}.absolute_setpoints", True, "positions survive a power cycle"),
    )


def _steps_per_unit(signal: str, step: float | None, document: OdriveDocument) -> tuple[int, str]:
    """Scale of feed-forward in the drives' settings, and its reason."""
    step = 1.0 if step is None else step
    scale = round(1.0 / step)
    if scale < 1 or abs(scale * step - 1.0) > 1e-6:
        raise BadInput(
            f"Set_Input_Pos.{signal} has steps of {step:g}; an ODrive divides a unit into a whole"
            " number of steps",
            where=f"drives.dbc: {document.dbc}",
            next_step=f"give {signal} a scale such as 0.001, or leave out drives.dbc",
        )
    return scale, f"the DBC file gives {signal} steps of {step:g}"


def read_endpoints(path: Path, document: OdriveDocument, layouts: Layouts) -> Endpoints:
    """The endpoints in a `flat_endpoints.json`.

    Raises:
        BadInput: The file cannot be read, has another format, lacks a required endpoint or its
            board, or as for `wanted_settings`.
    """
    content = read_json(path, _OTHER_FILE)
    names = [wanted.name for wanted in wanted_settings(document, layouts)]
    try:
        file = _EndpointsFile.model_validate(content)
        firmware = _version("fw_version", file.fw_version, "0.6.11")
        board = _version("hw_version", file.hw_version, "4.4.58") if file.hw_version else None
        missing = [name for name in names if name not in file.endpoints]
        found = {name: _endpoint(name, file) for name in names if name not in missing}
    except ValueError as error:  # also of pydantic
        why = str(error)
        if isinstance(error, ValidationError):
            first = error.errors(include_url=False)[0]
            why = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
        raise BadInput(
            f"the file lacks required endpoints: {why}",
            where=str(path),
            next_step=_OTHER_FILE,
        ) from error
    if board is None:
        raise BadInput(
            "the file does not state its board: it has no hw_version",
            where=str(path),
            why="endpoint numbers differ between boards",
            next_step=_OTHER_FILE,
        )
    if missing:
        raise BadInput(
            f"the file lacks required endpoints: {', '.join(missing)}",
            where=str(path),
            why=f"it describes firmware {file.fw_version}, which may be older than these settings",
            next_step="update the drives' firmware and use its flat_endpoints.json, or leave out"
            " drives.endpoints",
        )
    return Endpoints(firmware, board, found)


def _version(key: str, text: str, example: str) -> tuple[int, int, int]:
    """The three numbers of a version such as ``0.6.11-1``."""
    matched = re.match(r"(\d{1,5})\.(\d{1,5})\.(\d{1,5})(?:-|$)", text, re.ASCII)
    if matched is None or max(map(int, matched.groups())) > 255:  # a byte each in Get_Version
        raise ValueError(f"{key} is {text!r}, not a version such as {example}")
    major, minor, revision = map(int, matched.groups())
    return major, minor, revision


def _endpoint(name: str, file: _EndpointsFile) -> Endpoint:
    entry = _EndpointEntry.model_validate(file.endpoints[name])
    if entry.type not in _FORMS:
        raise ValueError(f"{name} has the type {entry.type[:40]!r}, not {' or '.join(_FORMS)}")
    return Endpoint(name, entry.id, entry.type)
