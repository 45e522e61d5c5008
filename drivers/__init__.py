"""Drives and cameras: CAN bus, drive groups behind one interface, and image sources."""

from __future__ import annotations

from typing import TYPE_CHECKING

from model.lazy import lazy_names

if TYPE_CHECKING:
    from drivers.cameras.files import ImageFolder
    from drivers.cameras.live import LiveCamera, VideoFile
    from drivers.can_bus import BusSettings, open_bus
    from drivers.can_errors import BusFault
    from drivers.drive_group import CycleStatus, DriveGroup, DriveSnapshot
    from drivers.factory import make_drive_group, read_drives

__all__ = [
    "BusFault",
    "BusSettings",
    "CycleStatus",
    "DriveGroup",
    "DriveSnapshot",
    "ImageFolder",
    "LiveCamera",
    "VideoFile",
    "make_drive_group",
    "open_bus",
    "read_drives",
]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "drivers.cameras.files": "ImageFolder",
            "drivers.cameras.live": "LiveCamera VideoFile",
            "drivers.can_bus": "BusSettings open_bus",
            "drivers.can_errors": "BusFault",
            "drivers.drive_group": "CycleStatus DriveGroup DriveSnapshot",
            "drivers.factory": "make_drive_group read_drives",
        },
    )
