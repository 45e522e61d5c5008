"""The part of the rig file that says which drives turn the winches."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from cdpr.document_types import Document, Positive

Period = Annotated[int, Field(ge=1, le=1000)]
Identity = Annotated[int, Field(ge=0, le=0xFFFFFFFF)]
FileName = Annotated[str, Field(min_length=1)]

ODRIVE_LAST_NODE = 62
"""Of six bits; 63 is an ODrive without a node id."""


class Cia402Document(Document):
    """CANopen drives in cyclic synchronous position mode; all they need is set over the bus."""

    type: Literal["cia402"]
    vendor_id: Identity | None = Field(
        default=None, description="1018h:01 that every drive must tell; left out: not looked at"
    )
    product_code: Identity | None = Field(
        default=None, description="1018h:02 that every drive must tell; left out: not looked at"
    )


class OdriveDocument(Document):
    """ODrives, firmware 0.6 or later, that speak CANSimple."""

    type: Literal["odrive"]
    motor_torque_constant_nm_a: Positive = Field(
        description="torque by current of the motors; ODrive's torque_constant, 8.27 / KV"
    )
    watchdog_ms: Annotated[float, Field(ge=10, le=1000)] | None = Field(
        default=None,
        description="axis0.config.watchdog_timeout of every drive; without one nothing is armed",
    )
    heartbeat_ms: Period = Field(default=100, description="axis0.config.can.heartbeat_msg_rate_ms")
    estimates_ms: Period = Field(default=10, description="axis0.config.can.encoder_msg_rate_ms")
    torques_ms: Period = Field(default=10, description="axis0.config.can.torques_msg_rate_ms")
    dbc: FileName | None = Field(
        default=None,
        description="ODrive's own DBC file of the firmware; left out: the one of cdpr",
    )
    endpoints: FileName | None = Field(
        default=None,
        description="flat_endpoints.json of the firmware; settings are read back only with it",
    )


DrivesDocument = Annotated[Cia402Document | OdriveDocument, Field(discriminator="type")]
