"""How process data of the simulated drive are set up and parsed: CiA 301, 7.5.2.35 to 7.5.2.38."""

from __future__ import annotations

import struct

import pytest

from simulation.drives.behaviour import behaviour_named
from tests.simulation.drive_line import CYCLE, ENABLED, REPLY, THREE, TWO, Line, ready

OFF = 0x80000000


@pytest.mark.parametrize(
    ("index", "sub", "form", "value", "abort"),
    [
        # A PDO that is valid keeps bits 0 to 29 of its COB-ID.
        (0x1400, 1, "<I", 0x206, 0x06090030),
        (0x1800, 1, "<I", 0x186, 0x06090030),
        (0x1800, 1, "<I", 0x185, 0),
        (0x1800, 1, "<I", 0x40000185, 0),
        (0x1400, 1, "<I", OFF | 0x206, 0),
        # Long and restricted identifiers.
        (0x1400, 1, "<I", OFF | 0x20000205, 0x06090030),
        (0x1400, 1, "<I", 0x00000705, 0x06090030),
        # Reserved transmission types, and those on remote request.
        (0x1400, 2, "<B", 241, 0x06090030),
        (0x1800, 2, "<B", 253, 0x06090030),
        (0x1800, 2, "<B", 240, 0),
        # Mapping while the PDO is valid.
        (0x1600, 0, "<B", 0, 0x06010000),
        (0x1600, 1, "<I", 0x60400010, 0x06010000),
        (0x1A00, 0, "<B", 0, 0x06010000),
    ],
)
def test_writes_to_a_valid_pdo(index: int, sub: int, form: str, value: int, abort: int) -> None:
    assert Line().abort(index, sub, form, value) == abort


@pytest.mark.parametrize(
    ("index", "entry", "abort"),
    [
        (0x1600, 0x60400010, 0),
        (0x1600, 0x607A0020, 0),
        (0x1600, 0x607A0010, 0x06040041),  # half of it
        (0x1600, 0x60410010, 0x06040041),  # read-only
        (0x1600, 0x60850020, 0x06040041),  # not mappable
        (0x1600, 0x5FFF0020, 0x06040041),  # not there
        (0x1A00, 0x60410010, 0),
        (0x1A00, 0x60850020, 0x06040041),
    ],
)
def test_what_can_be_mapped(index: int, entry: int, abort: int) -> None:
    line = Line()
    line.write(index - 0x200, 1, "<I", OFF | 0x205)
    assert line.abort(index, 0, "<B", 0) == 0
    assert line.abort(index, 1, "<I", entry) == abort


def test_entries_are_written_only_while_none_counts() -> None:
    line = Line()
    line.write(0x1400, 1, "<I", OFF | 0x205)
    assert line.abort(0x1600, 2, "<I", 0x607A0020) == 0x06010000
    assert line.abort(0x1600, 0, "<B", 0) == 0
    assert line.abort(0x1600, 2, "<I", 0x607A0020) == 0


@pytest.mark.parametrize(
    ("entries", "count", "abort"),
    [
        ((0x60400010, 0x607A0020), 2, 0),
        ((0x607A0020, 0x607A0020), 2, 0),
        ((0x607A0020, 0x607A0020, 0x60600008), 3, 0x06040042),
        ((0x60400010,), 2, 0x06040041),  # an entry that maps nothing
        ((0x60400010,), 9, 0x06040042),  # more entries than there are
    ],
)
def test_the_mapping_is_checked_when_it_is_counted(
    entries: tuple[int, ...], count: int, abort: int
) -> None:
    line = Line()
    line.write(0x1400, 1, "<I", OFF | 0x205)
    line.write(0x1600, 0, "<B", 0)
    for sub in range(1, 9):
        line.write(0x1600, sub, "<I", 0)
    for sub, entry in enumerate(entries, start=1):
        line.write(0x1600, sub, "<I", entry)
    assert line.abort(0x1600, 0, "<B", count) == abort


def test_it_is_mapped_only_in_pre_operational() -> None:
    line = ready()
    assert line.abort(0x1400, 1, "<I", OFF | 0x205) == 0
    assert line.abort(0x1600, 0, "<B", 0) == 0x08000022
    line.drive.on_nmt(0x80, 5)
    assert line.abort(0x1600, 0, "<B", 0) == 0


def test_a_named_behaviour_lets_a_pdo_that_is_off_be_mapped_in_operational() -> None:
    line = ready(behaviour=behaviour_named(["maps-when-operational"]))
    assert line.abort(0x1600, 0, "<B", 0) == 0x06010000  # still valid
    line.write(0x1400, 1, "<I", OFF | 0x205)
    assert line.abort(0x1600, 0, "<B", 0) == 0


def test_bit_30_of_a_tpdo_is_not_kept() -> None:
    line = Line()
    assert line.abort(0x1800, 1, "<I", 0x40000185) == 0
    assert line.read(0x1800, 1) == 0x185


@pytest.mark.parametrize(
    ("mapping", "frame"),
    [
        (THREE, struct.pack("<Hih", 0x0F, 1100, 7)),
        (TWO, struct.pack("<Hi", 0x0F, 1100)),
        ((0x607A0020, 0x60400010), struct.pack("<iH", 1100, 0x0F)),
        ((0x60400010, 0x60B20010, 0x607A0020), struct.pack("<Hhi", 0x0F, 7, 1100)),
    ],
)
def test_frames_are_parsed_by_the_current_mapping(mapping: tuple[int, ...], frame: bytes) -> None:
    line = Line()
    line.set_up(mapping)
    for word in (0x06, 0x07, 0x0F):
        line.write(0x6040, 0, "<H", word)
    line.drive.on_pdo(0x205, frame)
    line.drive.advance(CYCLE)
    assert line.sync(None) == ENABLED
    line.drive.advance(CYCLE)
    assert line.drive.motor.position == 1100


@pytest.mark.parametrize("length", [0, 5, 7, 8])
def test_a_frame_of_another_length_is_reported_once_and_not_processed(length: int) -> None:
    line = Line()
    line.set_up(TWO)
    for _ in range(3):
        line.drive.on_pdo(0x205, b"\x06" + b"\0" * (length - 1) if length else b"")
    line.drive.on_sync()
    assert line.drive.status_word & 0x6F == 0x40
    assert line.emergencies() == [0x8210]
    line.drive.on_pdo(0x205, struct.pack("<Hi", 0x06, 0))
    assert line.emergencies() == [0x0000]


def test_the_mapping_of_the_reply_is_what_is_sent() -> None:
    line = Line()
    line.map(0x1800, REPLY[1:])
    line.write(0x1800, 1, "<I", 0x185)
    line.drive.on_nmt(1, 5)
    line.drive.on_sync()
    assert line.take(0x185) == [struct.pack("<ih", 1000, 0)]


def test_a_reply_at_each_third_sync() -> None:
    line = Line()
    line.map(0x1800, REPLY)
    line.write(0x1800, 2, "<B", 3)
    line.write(0x1800, 1, "<I", 0x185)
    line.drive.on_nmt(1, 5)
    for _ in range(7):
        line.drive.on_sync()
    assert len(line.take(0x185)) == 2


def test_another_identifier_is_heard_once_it_is_set_up() -> None:
    line = Line()
    line.map(0x1400, TWO)
    assert line.abort(0x1400, 1, "<I", 0x333) == 0
    line.drive.on_nmt(1, 5)
    assert line.drive.pdo_ids == [0x333, 0x305]
    line.drive.on_pdo(0x333, struct.pack("<Hi", 0x06, 0))
    line.drive.on_sync()
    assert line.drive.status_word & 0x6F == 0x21


@pytest.mark.parametrize("window_us", [0, 4000])
def test_a_set_point_after_the_synchronous_window_is_dropped(window_us: int) -> None:
    line = ready()
    line.write(0x1007, 0, "<I", window_us)
    line.drive.on_sync()
    line.drive.advance(0.006)
    line.drive.on_pdo(0x205, struct.pack("<HiH", 0x06, 1000, 0))
    line.drive.on_sync()
    assert bool(line.take(0x085)) == bool(window_us)
