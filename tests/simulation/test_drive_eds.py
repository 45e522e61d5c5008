"""The EDS file of the simulated drives says exactly what they hold when they are switched on."""

from __future__ import annotations

import struct
from pathlib import Path

import canopen
import pytest

import simulation
from simulation.drive_objects import READ_ONLY, DriveObjects

EDS = Path(simulation.__file__).parent / "cia402_drive.eds"
LENGTHS = {2: 1, 3: 2, 4: 4, 5: 1, 6: 2, 7: 4}  # CANopen type: bytes


def described(node: int) -> dict[tuple[int, int], canopen.objectdictionary.ODVariable]:
    """Every object of the file by index and sub-index."""
    dictionary = canopen.import_od(str(EDS), node)
    found = {}
    for index, entry in dictionary.items():
        if isinstance(entry, canopen.objectdictionary.ODVariable):
            found[index, 0] = entry
        else:
            found |= {(index, sub): entry[sub] for sub in entry.subindices}
    return found


@pytest.mark.parametrize("node", [1, 8, 126])
def test_the_file_has_the_objects_of_the_drive_with_their_first_values(node: int) -> None:
    drive, objects = DriveObjects(node), described(node)
    for (index, sub), entry in objects.items():
        data = drive.get_data(index, sub)
        assert len(data) == LENGTHS[entry.data_type], f"{index:04X}h:{sub:02X}"
        assert entry.encode_raw(entry.default) == data, f"{index:04X}h:{sub:02X}"
    # Nothing is in the drive that the file does not tell.
    for index in (*range(0x1000, 0x1B00), *range(0x6000, 0x6600)):
        for sub in range(10):
            try:
                drive.get_data(index, sub)
            except canopen.SdoAbortedError:
                continue
            assert (index, sub) in objects, f"{index:04X}h:{sub:02X}"


def test_what_the_file_calls_writable_is_so() -> None:
    drive = DriveObjects(1)
    for (index, sub), entry in described(1).items():
        try:
            drive.set_data(index, sub, drive.get_data(index, sub))
        except canopen.SdoAbortedError as error:
            read_only = error.code == READ_ONLY
        else:
            read_only = False
        assert read_only == (entry.access_type == "ro"), f"{index:04X}h:{sub:02X}"


def test_a_status_word_decodes_by_name() -> None:
    entry = canopen.import_od(str(EDS), 1)["Statusword"]
    assert entry.index == 0x6041
    assert entry.decode_raw(struct.pack("<H", 0x0237)) == 0x0237
