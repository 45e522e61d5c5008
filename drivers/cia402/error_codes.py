"""Error codes of drives: texts of EMCY and SDO abort codes, and the stored error."""

from __future__ import annotations

from collections.abc import Callable

from canopen import SdoAbortedError

from drivers.cia402.sdo_jobs import ERROR_REQUESTS
from model.errors import Refused

HEARTBEAT_LOST = 0x8130

EMCY_TEXTS: dict[int, str] = {
    0x1000: "generic error",
    0x2300: "current on the motor side",
    0x2310: "continuous over-current",
    0x2320: "short circuit or earth leakage",
    0x2330: "earth leakage",
    0x3110: "mains over-voltage",
    0x3120: "mains under-voltage",
    0x3210: "DC link over-voltage",
    0x3220: "DC link under-voltage",
    0x4110: "ambient temperature too high",
    0x4210: "drive temperature too high",
    0x4310: "drive temperature too high",
    0x5100: "control supply",
    0x5200: "drive control hardware",
    0x5441: "emergency stop input open",
    0x6100: "drive software",
    0x6320: "parameter error",
    0x7120: "motor",
    0x7121: "motor blocked",
    0x7300: "position sensor",
    0x7305: "incremental encoder signal",
    0x8110: "CAN overrun, a message was lost",
    0x8120: "CAN controller in error-passive mode",
    HEARTBEAT_LOST: "heartbeat or life guard missed",
    0x8140: "recovered from bus-off",
    0x8150: "CAN identifier used twice",
    0x8210: "PDO ignored, its length is wrong",
    0x8220: "PDO longer than mapped",
    0x8240: "SYNC of unexpected length",
    0x8250: "set-point (RPDO) overdue",
    0x8311: "torque limit reached",
    0x8400: "velocity control",
    0x8480: "speed limit exceeded",
    0x8500: "position control",
    0x8611: "following error too large",
    0x8612: "position limit reached",
    0x8700: "SYNC missed or out of time",
    0x9000: "external error",
    0xFF00: "manufacturer-specific error",
}
"""Source: CiA 301 (error code classes) and CiA 402-2 (error codes)."""

_CLASSES = (0xFFFF, 0xFFF0, 0xFF00, 0xF000)

_CLASS_TEXTS: dict[int, str] = {
    0x2000: "current",
    0x3000: "voltage",
    0x4000: "temperature",
    0x5000: "drive hardware",
    0x6000: "drive software",
    0x7000: "additional module",
    0x8000: "monitoring",
    0xF000: "additional functions",
}


def emergency_text(code: int) -> str:
    """Text of an EMCY error code (also object 603Fh), or of its class."""
    for mask in _CLASSES:
        text = EMCY_TEXTS.get(code & mask) or _CLASS_TEXTS.get(code & mask)
        if text:
            return f"{text} (error {code:04X}h)"
    return f"error {code:04X}h"


def abort_text(code: int) -> str:
    """Text of an SDO abort code."""
    text = SdoAbortedError.CODES.get(code, "")
    return f"{text} (abort {code:08X}h)" if text else f"abort {code:08X}h"


def stored_error(read: Callable[[int, int, str, int], bytes | None]) -> int:
    """The error code that a drive stores for its fault; 0 if it has none.

    Reads `ERROR_REQUESTS`; the first one that states an error counts.

    Args:
        read: Reads an optional object by index, sub-index, name and size.
    """
    for job in ERROR_REQUESTS:
        try:
            data = read(job.index, job.sub, "error code", job.size)
        except Refused as error:
            if "node" not in error.values:  # as another master
                raise
            continue
        if code := int.from_bytes((data or b"")[:2], "little"):
            return code
    return 0
