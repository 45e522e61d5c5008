"""Simulated drives are built from an EDS file: objects, access, types, ranges, defaults, units."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import canopen
import pytest

from drivers.cia402.object_dictionary import settings_for
from drivers.cia402.profile import load_profile, profile_names
from model.errors import BadInput
from model.files.rig_file import RigDocument
from model.rig import Rig, rig_from_document
from model.winches import WinchMap
from simulation.drives.eds_file import EDS_FOLDER, profile_path, read_eds
from simulation.drives.object_dictionary import READ_ONLY, Abort, DriveObjects, counts_in
from tests.simulation.drive_line import CYCLE, Line, ready

EDS = EDS_FOLDER / "cia402.eds"
LENGTHS = {1: 1, 2: 1, 3: 2, 4: 4, 5: 1, 6: 2, 7: 4}  # CANopen type: bytes

MAKERS = """[FileInfo]
FileName=maker.eds
Description=100 % of a maker's habits
[DummyUsage]
Dummy0005=1
[1400]
ParameterName=RPDO 1
ObjectType=0x9
SubNumber=3
[1400SUB1]
DataType=0x0007
AccessType=rw
DefaultValue=0x80000200 + $NodeID
[1400sub2]
DataType=0x0005
AccessType=rw
DefaultValue=
[1016]
ObjectType=0x8
CompactSubObj=2
DataType=0x0007
AccessType=rw
[6085]
ParameterName=Quick stop deceleration
DataType=0x0007
AccessType=rw
DefaultValue=6000
[60AA]
DataType=0x0007
AccessType=rw
DefaultValue=0x00C00300
[60C2sub2]
DataType=0x0002
AccessType=rw
LowLimit=0xFD
HighLimit=-3
DefaultValue=0xFD
[2000]
DataType=0x0006
AccessType=wo
[607A]
DataType=0x0004
AccessType=rww
PDOMapping=1
[6064]
DataType=0x0004
AccessType=ro
PDOMapping=1
"""


def described(node: int) -> dict[tuple[int, int], canopen.objectdictionary.ODVariable]:
    """Every object of the file by index and sub-index, as canopen reads it."""
    dictionary = canopen.import_od(str(EDS), node)
    found = {}
    for index, entry in dictionary.items():
        if isinstance(entry, canopen.objectdictionary.ODVariable):
            found[index, 0] = entry
        else:
            found |= {(index, sub): entry[sub] for sub in entry.subindices}
    return found


@pytest.mark.parametrize("node", [1, 8, 126])
def test_the_drive_has_the_objects_of_the_file_with_their_defaults(node: int) -> None:
    drive, objects = DriveObjects(read_eds(EDS), node), described(node)
    assert drive.values().keys() == objects.keys()
    for (index, sub), entry in objects.items():
        data = drive.get_data(index, sub)
        if entry.data_type in LENGTHS:
            assert len(data) == LENGTHS[entry.data_type], f"{index:04X}h:{sub:02X}"
        assert entry.encode_raw(entry.default) == data, f"{index:04X}h:{sub:02X}"


def test_what_the_file_calls_writable_is_so() -> None:
    drive = DriveObjects(read_eds(EDS), 1)
    for (index, sub), entry in described(1).items():
        try:
            drive.set_data(index, sub, drive.get_data(index, sub))
        except Abort as abort:
            read_only = abort.code == READ_ONLY
        else:
            read_only = False
        assert read_only == (entry.access_type in ("ro", "const")), f"{index:04X}h:{sub:02X}"


@pytest.mark.parametrize("path", sorted(EDS_FOLDER.glob("*.eds")), ids=lambda path: path.stem)
def test_a_drive_of_every_profile_answers(path: Path) -> None:
    line = Line(eds=read_eds(path))
    assert line.read(0x1000, 0) & 0xFFFF == 402
    assert line.sdo(0x40, 0x6041, 0)[0] == 0x4B
    line.drive.on_nmt(1, 5)
    line.drive.advance(0.01)
    line.drive.on_sync()


@pytest.mark.parametrize("profile", profile_names())
def test_the_quick_stop_that_is_set_up_takes_one_cycle_on_drives_of_every_make(
    rig: Rig, profile: str
) -> None:
    """The distance from top speed is half of that in a cycle, in whatever unit 6085h is."""
    document = rig.document.model_dump()
    document["drives"]["profile"] = profile
    theirs = rig_from_document(RigDocument.model_validate(document))
    winch, cycle = theirs.winches[0], theirs.cycle
    line = Line(eds=read_eds(profile_path(profile)), counts_per_turn=winch.counts_per_turn)
    values = {s.index: s.value for s in settings_for(theirs, 0, WinchMap(theirs))}
    for index, form in ((0x6085, "<I"), (0x605A, "<h"), (0x6060, "<b")):
        assert line.abort(index, 0, form, values[index]) == 0
    for word in (0x06, 0x07, 0x0F):
        line.write(0x6040, 0, "<H", word)
    line.drive.motor.speed = top = winch.max_speed * abs(winch.counts_per_metre)
    line.write(0x6040, 0, "<H", 0x02)
    for _ in range(100):
        line.drive.advance(cycle / 20.0)
    assert line.drive.motor.speed == 0.0
    assert line.drive.motor.demand - 1000.0 == pytest.approx(0.5 * top * cycle, rel=1e-3)


@pytest.mark.parametrize(
    ("profile", "limit", "rated"), [("epos4", (0x3001, 2), 5.0), ("cia402", (0x6072, 0), 1.0)]
)
@pytest.mark.parametrize(("torque", "position"), [(-119.0, 990.0), (-120.0, 1000.0)])
def test_the_object_of_the_profile_limits_the_torque(
    profile: str, limit: tuple[int, int], rated: float, torque: float, position: float
) -> None:
    """At 120 per mille no cable is wound in that pulls with as much."""
    line = Line(eds=read_eds(profile_path(profile)), profile=load_profile(profile))
    line.write(0x6060, 0, "<b", 8)
    line.drive.objects[limit] = round(120 * rated)
    line.drive.objects[0x607D, 2] = 10_000
    for word in (0x06, 0x07, 0x0F):
        line.write(0x6040, 0, "<H", word)
    line.drive.torque = torque
    line.write(0x607A, 0, "<i", 990)
    line.drive.advance(CYCLE)
    assert line.drive.motor.position == position


@pytest.mark.parametrize(("profile", "reached"), [("akd", 1100.0), ("cia402", 1040.0)])
def test_limits_that_need_a_restart_are_not_in_force_when_they_are_written(
    profile: str, reached: float
) -> None:
    line = Line(eds=read_eds(profile_path(profile)), profile=load_profile(profile))
    line.write(0x6060, 0, "<b", 8)
    for sub, limit in ((2, 1040), (1, 900)):
        assert line.abort(0x607D, sub, "<i", limit) == 0
    for word in (0x06, 0x07, 0x0F):
        line.write(0x6040, 0, "<H", word)
    line.write(0x607A, 0, "<i", 1100)
    line.drive.advance(CYCLE)
    assert line.drive.motor.position == reached


def test_an_epos4_runs_csp_without_listing_it() -> None:
    line = Line(eds=read_eds(profile_path("epos4")))
    assert line.read(0x6502, 0) == 0x225
    assert line.abort(0x6060, 0, "<b", 8) == 0
    assert line.read(0x6061, 0) == 8
    assert line.abort(0x6060, 0, "<b", 4) == 0x06090030  # neither in 6502h nor in the file
    other = Line(eds=read_eds(EDS))
    other.drive.objects[0x6502, 0] = 0x225
    assert other.abort(0x6060, 0, "<b", 8) == 0x06090030


def test_a_makers_file_is_read_as_it_is_meant(tmp_path: Path) -> None:
    path = tmp_path / "maker.eds"
    path.write_bytes(b"\xef\xbb\xbf" + MAKERS.replace("\n", "\r\n").encode())
    line = Line(eds=read_eds(path), counts_per_turn=4000.0)
    assert line.read(0x1400, 1) == 0x80000205
    assert line.read(0x1400, 2) == 0
    assert line.read(0x1016, 0) == 2
    assert line.abort(0x1016, 3, "<I", 0) == 0x06090011
    assert line.abort(0x6072, 0, "<H", 0) == 0x06020000
    assert line.abort(0x60C2, 2, "<b", -4) == 0x06090030
    assert line.abort(0x60C2, 2, "<b", -3) == 0
    assert line.sdo(0x40, 0x2000, 0)[4:] == struct.pack("<I", 0x06010001)
    # 6000 rpm/s of 4000 counts a turn
    assert line.drive._motion.deceleration == pytest.approx(400_000.0)
    eds = read_eds(path)
    assert (eds.objects[0x607A, 0].to_rpdo, eds.objects[0x607A, 0].to_tpdo) == (True, False)
    assert (eds.objects[0x6064, 0].to_rpdo, eds.objects[0x6064, 0].to_tpdo) == (False, True)
    assert eds.dummies == {5}


PLAIN = """[FileInfo]
FileName=maker.eds
[Comments]
Lines=1
Line1=made by hand
[6040]
ParameterName=Controlword
ObjectType=0x7
DataType=0x0006
AccessType=rww
DefaultValue=0x0F
PDOMapping=1
[6085]
ParameterName=Quick stop
DataType=0x0007
AccessType=rw
LowLimit=
HighLimit=0xFFFFFFFF
DefaultValue=6000
[1400sub1]
DataType=0x0007
AccessType=rw
DefaultValue=$NODEID+0x40000200
"""
"""A file as CiA 306 has it."""

DEVIATIONS: dict[str, Callable[[str], str]] = {
    "end of file of DOS": lambda t: t + "\x1a\n",
    "lines of DOS": lambda t: t.replace("\n", "\r\n"),
    "lines of old Macs": lambda t: t.replace("\n", "\r"),
    "free text in remarks": lambda t: t.replace("[6040]", "see the manual\n[6040]"),
    "free text in the head": lambda t: t.replace("[Comments]", "version of May\n[Comments]"),
    "comment of a shell": lambda t: "# generated\n" + t.replace("[6085]", "# next\n[6085]"),
    "comment of C": lambda t: "// generated\n" + t.replace("AccessType", "// who\nAccessType"),
    "comment behind a value": lambda t: t.replace("=0x0006", "=0x0006 ; U16"),
    "comment behind a header": lambda t: t.replace("[6085]", "[6085] ; deceleration"),
    "blanks in a header": lambda t: t.replace("[6085]", "[ 6085 ]").replace("sub1]", "sub1\t]"),
    "blanks about keys": lambda t: t.replace("=", " =\t"),
    "capitals": lambda t: t.replace("sub1", "SUB1").replace("rww", "RWW").replace("0xF", "0XF"),
    "indented": lambda t: t.replace("DataType", "\t\tDataType").replace("Access", "    Access"),
    "node id in brackets": lambda t: t.replace("$NODEID+0x40000200", "($NODEID + 0x40000200)"),
    "node id last": lambda t: t.replace("$NODEID+0x40000200", "0x40000200 + $NodeId"),
    "node id between": lambda t: t.replace("$NODEID+0x40000200", "0x200+$NODEID+0x40000000"),
    "suffixes of C": lambda t: t.replace("FFFFF\n", "FFFFFUL\n").replace("=6000", "=6000L"),
    "a limit that is none": lambda t: t.replace("LowLimit=", "LowLimit=-"),
    "a limit not applicable": lambda t: t.replace("LowLimit=", "LowLimit=n/a"),
    "no access type": lambda t: t.replace("AccessType=rw\n", "AccessType=\n"),
    "repeated": lambda t: t + t[t.index("[6040]") :],
}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "utf-16"])
@pytest.mark.parametrize("name", DEVIATIONS)
def test_a_deviation_changes_nothing(tmp_path: Path, name: str, encoding: str) -> None:
    plain, other = tmp_path / "plain.eds", tmp_path / "other.eds"
    plain.write_text(PLAIN)
    text = DEVIATIONS[name](PLAIN)
    assert text != PLAIN
    other.write_bytes(text.replace("made by hand", "de Müller").encode(encoding))
    expected = read_eds(plain).objects
    assert expected.keys() == {(0x6040, 0), (0x6085, 0), (0x1400, 1)}
    assert read_eds(other).objects == expected


def test_positions_and_torques_are_signed_whatever_the_file_says(tmp_path: Path) -> None:
    """Some makers' files type them as unsigned; a negative position then ended the simulation."""
    path = tmp_path / "unsigned.eds"
    text = EDS.read_text().replace("DefaultValue=-2147483648", "DefaultValue=0x80000000")
    text = text.replace("DefaultValue=-3", "DefaultValue=0xFD")
    for signed, unsigned in (("0002", "0005"), ("0003", "0006"), ("0004", "0007")):
        full = f"LowLimit=0\nHighLimit={(1 << 8 * LENGTHS[int(unsigned)]) - 1}"
        text = text.replace(f"DataType=0x{signed}\n", f"DataType=0x{unsigned}\n{full}\n")
    path.write_text(text)
    lines = [ready(eds=read_eds(path)), ready(eds=read_eds(EDS))]
    for line in lines:
        line.enable()
        for target in (-500, -400, -400):
            line.sync(0x0F, target)
            line.drive.torque = -70.0
    for line in lines:
        assert (line.position, line.torque, line.read(0x6061, 0)) == (-400, -70, 8)
        assert line.abort(0x607D, 1, "<i", -600) == line.abort(0x60C2, 2, "<b", -4) == 0


@pytest.mark.parametrize("index", ["6007", "605A", "605C", "605E"])
def test_limits_that_exclude_every_signed_value_do_not_apply(tmp_path: Path, index: str) -> None:
    """0 to FFFFh of 16 bits: 0 to -1; each value was refused as if by the drive."""
    path = tmp_path / "crossed.eds"
    limits = "LowLimit=0\nHighLimit=0xFFFF\n"
    path.write_text(PLAIN + f"[{index}]\nDataType=3\nAccessType=rw\n{limits}")
    described = read_eds(path).objects[int(index, 16), 0]
    assert described.holds(6)
    assert described.holds(-1)


def test_the_values_of_a_dcf_are_those_after_power_on(tmp_path: Path) -> None:
    """They were ignored without a word."""
    path = tmp_path / "drive.dcf"
    text = PLAIN.replace("DefaultValue=6000", "DefaultValue=6000\nParameterValue=7000")
    array = "[1016]\nObjectType=8\nDataType=7\nAccessType=rw\nParameterValue=5\nCompactSubObj=2\n"
    path.write_text(
        text.replace("AccessType=rww", "ParameterValue=\nAccessType=rww")
        + array
        + "[1016Value]\n2=9\n"
    )
    drive = DriveObjects(read_eds(path), 9)
    assert [drive[key] for key in ((0x6085, 0), (0x6040, 0), (0x1400, 1))] == [7000, 15, 0x40000209]
    assert [drive[0x1016, 1], drive[0x1016, 2]] == [5, 9]


def test_sub_objects_of_a_compact_array_have_values_and_names_of_their_own(tmp_path: Path) -> None:
    path = tmp_path / "compact.eds"
    path.write_text(
        PLAIN
        + "[1016]\nParameterName=Heartbeat\nObjectType=8\nDataType=7\nAccessType=rw\n"
        + "DefaultValue=1\nCompactSubObj=12\n"
        + "[1016Value]\nNrOfEntries=2\n2=0x7F0064\n12=$NODEID+5\n"
        + "[1016NAME]\nNrOfEntries=1\n2=Of the master\n"
    )
    drive, objects = DriveObjects(read_eds(path), 9), read_eds(path).objects
    values = [drive[0x1016, sub] for sub in range(13)]
    assert values == [12, 1, 0x7F0064, 1, 1, 1, 1, 1, 1, 1, 1, 1, 14]
    assert [objects[0x1016, sub].name for sub in (1, 2)] == ["Heartbeat", "Of the master"]


@pytest.mark.parametrize(
    ("text", "value"),
    [("1.5", 1.5), ("1,5", 1.5), ("-2", -2.0), ("1e3", 1000.0), ("0x3FC00000", 1.5), ("", 0.0)],
)
def test_defaults_of_real_numbers(tmp_path: Path, text: str, value: float) -> None:
    path = tmp_path / "real.eds"
    path.write_text(
        PLAIN + f"[2000]\nDataType=8\nDefaultValue={text}\nLowLimit=0,1\nHighLimit=10\n"
    )
    described = read_eds(path).objects[0x2000, 0]
    assert described.default == int.from_bytes(struct.pack("<f", value), "little")
    assert (described.low, described.high) == (None, None)


@pytest.mark.parametrize(
    ("unit", "counts"),
    [
        (0, 1.0),
        (0x00B50000, 1.0),
        (0x00B44700, 4000 / 60),  # rpm
        (0xFDB44700, 4 / 60),  # 1/1000 rpm
        (0x00C00300, 4000 / 60),  # rpm/s
        (0x00B40300, 4000.0),  # rev/s
        (0x00B55700, 1.0),  # counts/s²
        (0x00410000, None),  # degrees
    ],
)
def test_units(unit: int, counts: float | None) -> None:
    found = counts_in(unit, 4000.0)
    assert found == (None if counts is None else pytest.approx(counts))


def test_a_unit_that_is_not_known_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "unit.eds"
    path.write_text(MAKERS)
    line = Line(eds=read_eds(path), counts_per_turn=4000.0)
    assert line.abort(0x60AA, 0, "<I", 0x00410300) == 0x06090030
    assert line.abort(0x60AA, 0, "<I", 0x00B55700) == 0
    assert line.drive._motion.deceleration == pytest.approx(6000.0)


def test_it_says_that_it_is_simulated_whatever_the_file_says(tmp_path: Path) -> None:
    path = tmp_path / "named.eds"
    path.write_text(MAKERS + "[1008]\nDataType=0x0009\nAccessType=const\nDefaultValue=EPOS4\n")
    line = Line(eds=read_eds(path))
    head = line.sdo(0x40, 0x1008, 0)
    assert head == b"\x41\x08\x10\x00\x14\x00\x00\x00"
    text, toggle = b"", 0
    while True:
        part = line.sdo(0x60 | toggle, 0, 0)
        assert part[0] & 0x10 == toggle
        text += part[1 : 8 - (part[0] >> 1 & 7)]
        toggle ^= 0x10
        if part[0] & 1:
            break
    assert text == b"cdpr simulated drive"
    assert line.sdo(0x40, 0x1009, 0) == b"\x43\x09\x10\x00none"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("no section", "cannot be read"),
        ("hello\n", "EDS file: File contains no section headers, line 1\n"),
        ("[1000]\nDataType\n", "EDS file: Source contains parsing errors, line 2\n"),
        ("[1000]\nDataType=0x7\nAccessType=ro\n", "no object of a drive profile"),
        ("[6040]\nDataType=0x6\nAccessType=never\n", "access type"),
        ("[6040]\nDataType=0x6\nDefaultValue=many\n", "not a number"),
        ("[6040]\nDataType=sixteen\n", "not a number"),
        ("[6040]\nDataType=0x6\nDefaultValue=1000h\n", r"\[6040\]: '1000h' is not a number"),
        ("[6040]\nDataType=0x6\nDefaultValue=2*$NODEID\n", "not a number"),
        ("[6040]\nDataType=0x6\nDefaultValue=65536\n", "65536 needs more than 2 bytes"),
        ("[6040]\nDataType=0x6\nDefaultValue=-32769\n", "-32769 needs more than 2 bytes"),
        ("[6040]\nDataType=0x6\nHighLimit=large\n", "'large' is not a number"),
        ("[6040]\nDataType=0x6\nPDOMapping=perhaps\n", "'perhaps' is not a number"),
        ("[6040]\nDataType=0x8\nDefaultValue=1.234,5\n", "'1.234,5' is not a real number"),
        ("[6040]\nDataType=0x8\nDefaultValue=1e300\n", "'1e300' is not a real number"),
        ("[Comments]\n[6040\nDataType=0x6\n", "EDS file: .*line 2\n"),
        (
            "[6040]\nObjectType=8\nCompactSubObj=2\nDataType=7\n[6040Value]\n3=1\n",
            "CompactSubObj 2: there is no sub-object 3",
        ),
    ],
)
def test_a_file_that_cannot_be_used_says_why(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "bad.eds"
    path.write_text(text)
    with pytest.raises(BadInput, match=says) as caught:
        read_eds(path)
    assert "bad.eds" in str(caught.value)
    assert "<string>" not in str(caught.value)


def test_a_profile_without_a_file_names_those_that_have_one() -> None:
    with pytest.raises(BadInput, match="cia402"):
        profile_path("epos9")


def test_a_status_word_decodes_by_name() -> None:
    entry = canopen.import_od(str(EDS), 1)["Statusword"]
    assert entry.index == 0x6041
    assert entry.decode_raw(struct.pack("<H", 0x0237)) == 0x0237
