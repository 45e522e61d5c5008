"""The fault table: what is done to a run that moves, and how soon, and how, it must stop."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from drivers.cia402.pdo import (
    HEARTBEAT_BASE,
    MASTER_NODE,
    RPDO1_BASE,
    SDO_REQUEST_BASE,
    SYNC_ID,
    TPDO1_BASE,
    make_set_point,
    parse_reply,
)
from drivers.cia402.state_machine import ControlWord, DriveState
from executor.safety.monitor import MonitorLimits
from executor.safety.stall import STUCK_CYCLES
from executor.state_machine import State
from simulation.drives.behaviour import STRICT, DriveBehaviour, behaviour_named
from tests.drivers.drive_bench import make_reply
from tests.scenarios.faults.bench import EVERY_ID, Bench, Script, SimulatedBench, a_message, once
from tests.scenarios.faults.fault_bus import BUS_OFF, delay, lose, lose_next, repeat, spoil
from tests.scenarios.faults.samples import emergencies, left_holding
from tests.scenarios.stage import CRUISING

NODES = range(1, 9)
REPLIES = frozenset(TPDO1_BASE + node for node in NODES)
REPLY_4, SET_POINT_4 = {TPDO1_BASE + 4}, {RPDO1_BASE + 4}
E_STOP_OPEN = 0x5441

#: Runs between processes until one is not spoilt by a computer that holds the drives up.
ATTEMPTS = 10


@dataclass(frozen=True)
class Fault:
    """One line of the table.

    Attributes:
        script: Makes a new script for every run.
        ends: How the run ends; None when its process is dead.
        within: Cycles from the fault until no drive follows set-points; None if the run continues.
        late: Cycles more in real time, where the stop waits for a cycle that may begin late.
        words: In the reported cause.
        code: Of its event; empty if not checked.
        spread: Cycles from the first drive that stops to the last one.
        mixed: Cycles in which some drives may be enabled and others not.
        rows: Rows of the table that targets may lie apart; more only where frames are taken from a
            drive, which stays where it was for so many cycles.
        live: It can also be done to an executor in another process, in real time.
        bitrate: Frames take their time on the wire, [bit/s].
        behaviour: What the drives do, as for ``cdpr sim --drive-behaviour``.
        profile: Keys of their drive profile that are not as in ``cia402``.
    """

    script: Callable[[], Script]
    ends: State | None = State.LATCHED
    within: float | None = 4.0
    late: float = 0.0
    words: tuple[str, ...] = ()
    code: str = ""
    spread: float = 1.0
    mixed: float = 4.0
    rows: float = 1.0
    live: bool = True
    bitrate: float | None = None
    behaviour: tuple[str, ...] = ()
    profile: Mapping[str, object] = field(default_factory=dict)

    def drives(self, base: DriveBehaviour = STRICT) -> DriveBehaviour:
        """Behaviour of the drives in this row, in addition to that in all rows."""
        return behaviour_named(self.behaviour, base)


def then(happens: Callable[[Bench], object]) -> Callable[[], Script]:
    """A fault at one time of the run."""

    def timed(bench: Bench) -> None:
        bench.happens()
        happens(bench)

    return lambda: once(timed)


def broken(*drives: int, by: Callable[[Bench], object]) -> Callable[[], Script]:
    """Drives fail at one time; the others must stop."""

    def timed(bench: Bench) -> None:
        bench.breaks(*drives)
        by(bench)

    return lambda: once(timed)


def from_then_on(each: Callable[[Bench], object]) -> Callable[[], Script]:
    """A fault in every cycle until the end."""

    def script(bench: Bench) -> None:
        if bench.cycle >= bench.fault_cycle:
            bench.happens()
            each(bench)

    return lambda: script


def late(cycles: float) -> Callable[[], Script]:
    def happens(bench: Bench) -> None:
        assert isinstance(bench, SimulatedBench)
        bench.late(cycles)

    return then(happens)


def incoming(rule: Callable[[], object]) -> Callable[[], Script]:
    """Frames to the drives."""
    return then(lambda bench: bench.line.incoming.append(rule()))  # type: ignore[arg-type]


def outgoing(rule: Callable[[], object]) -> Callable[[], Script]:
    """Frames from the drives."""
    return then(lambda bench: bench.line.outgoing.append(rule()))  # type: ignore[arg-type]


def far_on(make: Callable[[], Script]) -> Callable[[], Script]:
    """Later than usual, unless another cycle was chosen: near the start a sign matters little."""

    def made() -> Script:
        script = make()

        def delayed(bench: Bench) -> None:
            if bench.fault_cycle == CRUISING:
                bench.fault_cycle = 150
            script(bench)

        return delayed

    return made


def replies_held_up(bench: Bench) -> None:
    cycle = bench.prepared.checked.table.cycle
    bench.line.outgoing.append(delay(REPLIES, 20.0 * cycle))


def silence(bench: Bench) -> None:
    bench.drives[3].silent = True


def everything_dies(bench: Bench) -> None:
    for drive in bench.drives:
        drive.silent = True


def without_sync_watch(bench: Bench) -> None:
    """As drives that watch heartbeats alone; one falls silent together with the master."""
    for drive in bench.drives:
        drive.objects[0x1006, 0] = 0
        drive.objects[0x1400, 5] = 0
    bench.drives[3].silent = True
    bench.kill()


def bus_off(bench: Bench) -> None:
    bench.line.incoming.append(lose(EVERY_ID))
    bench.line.outgoing.append(lose(EVERY_ID))
    bench.line.inject(BUS_OFF)


def passive(bench: Bench) -> None:
    bench.line.inject(a_message(0x004, b"\0\x20" + bytes(6), error=True))


def comes(can_id: int, data: bytes = b"") -> Callable[[Bench], object]:
    return lambda bench: bench.line.inject(a_message(can_id, data))


def another_set_point(bench: Bench) -> None:
    """It requests nothing new: conflicting commands are not tested here."""
    target = round(bench.drives[3]._target)
    data = make_set_point(ControlWord.ENABLE_OPERATION, target)
    bench.line.inject(a_message(RPDO1_BASE + 4, data))


def shifted(counts: int) -> Callable[[bytes], bytes]:
    def change(data: bytes) -> bytes:
        reply = parse_reply(data)
        assert reply is not None
        return make_reply(reply.status_word, reply.position + counts, reply.torque)

    return change


def mirrored(data: bytes) -> bytes:
    reply = parse_reply(data)
    assert reply is not None
    return make_reply(reply.status_word, -reply.position, reply.torque)


def frozen() -> Callable[[bytes], bytes]:
    kept: list[int] = []

    def change(data: bytes) -> bytes:
        reply = parse_reply(data)
        assert reply is not None
        kept.append(reply.position)
        return make_reply(reply.status_word, kept[0], reply.torque)

    return change


def jam(bench: Bench) -> None:
    bench.drives[1].motor.jammed = True


def jam_seen_by_the_drive(bench: Bench) -> None:
    """The drive's own window is so narrow that it reports first."""
    per_metre = bench.prepared.rig.winches[1].counts_per_metre
    bench.drives[1].objects[0x6065, 0] = round(abs(per_metre) * 1e-5)
    jam(bench)


def slip(bench: Bench) -> None:
    """3 mm run off a drum that then sticks; the drive's own monitoring is off."""
    per_metre = bench.prepared.rig.winches[1].counts_per_metre
    bench.drives[1].objects[0x6065, 0] = 0xFFFFFFFF
    bench.drives[1].motor.position += 0.003 * per_metre
    jam(bench)


def feels(share: float) -> Callable[[Bench], object]:
    """The motor of cable 6 feels another load."""

    def happens(bench: Bench) -> None:
        bench.rehearsal.per_newton[5] *= share

    return happens


def at_torque_limit(bench: Bench) -> None:
    bench.drives[1].objects[0x6072, 0] = 1


def emergency_stop(bench: Bench) -> None:
    for drive in bench.drives:
        drive._emergency(E_STOP_OPEN)
        drive._power_off(DriveState.SWITCH_ON_DISABLED)


def deaf_drives(share: float, seed: int) -> Callable[[], Script]:
    """Each drive misses SYNC independently now and then."""

    def make() -> Script:
        dice = random.Random(seed)

        def script(bench: Bench) -> None:
            if bench.cycle >= bench.fault_cycle:
                bench.happens()
                bench.rehearsal.deaf = {i for i in range(8) if dice.random() < share}

        return script

    return make


def hangs(bench: Bench) -> None:
    """No frame of the executor reaches the drives for 200 ms; it continues unaware."""
    assert isinstance(bench, SimulatedBench)
    bench.late(20.0)


def lost_syncs(share: float, seed: int) -> Callable[[], Script]:
    return incoming(lambda: lose({SYNC_ID}, share, random.Random(seed)))


def babble(bench: Bench) -> None:
    """A device sends the most urgent identifier as often as 95 % of the bus allows."""
    for _ in range(70):
        bench.line.send(a_message(0x001, bytes(8)))


PATH_STOP = 60.0
"""Cycles that slowing down along the path and settling take."""


SEEN_TWICE = STUCK_CYCLES + 1.0
"""Cycles from a fault at a SYNC whose reply still shows motion until a standstill stops the drives.

The next `STUCK_CYCLES` replies each show the drive where it was; the quick stop goes out at the
beginning of the cycle after the last of them, and the drives obey at its SYNC.
"""

REPORTED_BY_DRIVE = 3.0
"""Cycles: one until the error is over the window, one of time-out (6066h), one until the stop."""

BELIEVED = 2.0
"""Cycles after a jump that the reply at its SYNC shows: the next one confirms it, then the stop."""

MAY_BE_LATE = MonitorLimits(0.0, 0.0, 0.0, 0.0).late_periods
"""Lateness that ends no run; a stop that waits for such a cycle is as late."""


def goes_on(script: Callable[[], Script], *, live: bool = True) -> Fault:
    """It is counted, and the run finishes."""
    return Fault(script, ends=State.FINISHED, within=None, live=live)


def path_stop_for_lateness(cycles: float) -> Fault:
    """The drives have not stopped yet, and do not before the next SYNC."""
    words = (f"{cycles:.1f} cycles late",)
    return Fault(late(cycles), within=PATH_STOP + cycles, words=words, live=False)


def quick_stop_for_lateness(cycles: float) -> Fault:
    """The drives have stopped, or may before the next SYNC reaches them."""
    words = (f"{cycles:.1f} cycles late; quick stop",)
    return Fault(late(cycles), words=words, code="late", live=False)


TABLE: dict[str, Fault] = {
    "F1 kill -9": Fault(then(lambda bench: bench.kill()), ends=None, within=5.0),
    "F2 the executor hangs": Fault(
        then(hangs), words=("20.0 cycles late; quick stop",), code="late", live=False
    ),
    "F4 a cycle late by 0.95 T": goes_on(late(0.95), live=False),
    "F4 a cycle late by 1 T": path_stop_for_lateness(1.0),
    "F4 a cycle late by 1.45 T": path_stop_for_lateness(1.45),
    "F4 a cycle late by 1.5 T": quick_stop_for_lateness(1.5),
    "F4 a cycle late by 2.5 T": quick_stop_for_lateness(2.5),
    "F4 a cycle late by 10 T": quick_stop_for_lateness(10.0),
    "F5 one set-point lost": goes_on(incoming(lambda: lose_next(SET_POINT_4, 1))),
    "F5 three set-points lost": Fault(
        incoming(lambda: lose_next(SET_POINT_4, 3)), words=("drive 4",), rows=3.0
    ),
    "F6 0.1 % of SYNC lost": goes_on(lost_syncs(0.001, 5)),
    "F6 20 % of SYNC lost": Fault(lost_syncs(0.2, 5), within=PATH_STOP, words=("did not answer",)),
    "F6 drives miss 0.1 % of SYNC": goes_on(deaf_drives(0.001, 6)),
    "F6 drives miss 20 % of SYNC": Fault(
        deaf_drives(0.2, 6), within=PATH_STOP, words=("did not answer",), rows=2.0, spread=3.0
    ),
    "F7 a drive falls silent": Fault(
        broken(3, by=silence), words=("(drive 4) did not answer",), code="drive_silent"
    ),
    "F7 a drive and the master fall silent": Fault(
        broken(3, by=without_sync_watch), ends=None, within=11.0, mixed=12.0, spread=4.0
    ),
    "F8 a drive in fault": Fault(
        broken(2, by=lambda bench: bench.drives[2].fail(0x2310)),
        within=3.0,
        words=("drive 3",),
        code="drive_fault",
    ),
    "F9 a drive restarts": Fault(
        broken(0, by=lambda bench: bench.drives[0].power_on()),
        within=3.0,
        words=("(drive 1) restarted",),
        code="drive_fault",
    ),
    "F10 bus-off": Fault(then(bus_off), words=("bus-off",), within=5.0),
    "F10 error-passive": Fault(then(passive), words=("error-passive",)),
    "F11 replies held up for 20 cycles": Fault(then(replies_held_up), words=("did not answer",)),
    "F12 one short reply": goes_on(outgoing(lambda: spoil(REPLY_4, lambda d: d[:2], 1))),
    "F12 two short replies": Fault(
        outgoing(lambda: spoil(REPLY_4, lambda d: d[:2], 2)), words=("drive 4", "2 bytes")
    ),
    "F12 one position spike": goes_on(outgoing(lambda: spoil(REPLY_4, shifted(99999), 1))),
    "F12 two position spikes": Fault(
        outgoing(lambda: spoil(REPLY_4, shifted(99999), 2)), words=("drive 4", "jumped")
    ),
    "F12 sign flipped": Fault(
        far_on(outgoing(lambda: spoil(REPLY_4, mirrored))), words=("drive 4", "jumped")
    ),
    "F12 a frozen position": Fault(
        outgoing(lambda: spoil(REPLY_4, frozen())), words=("(drive 4) did not move",)
    ),
    "F12 a short set-point": Fault(
        incoming(lambda: spoil(SET_POINT_4, lambda d: d[:5], 1)),
        within=PATH_STOP,
        words=("drive 4", "length"),
    ),
    "F13 replies come twice": Fault(
        outgoing(lambda: repeat(REPLY_4)), words=("(drive 4) answered twice",), within=5.0
    ),
    "F13 old replies": Fault(
        outgoing(lambda: delay(REPLY_4, 0.02)), words=("(drive 4) did not answer",)
    ),
    "F13 another SYNC": Fault(then(comes(SYNC_ID)), words=("another program sends SYNC",)),
    "F13 another master's set-point": Fault(
        then(another_set_point), words=("another program sends set-points",)
    ),
    "F13 another master's heartbeat": Fault(
        then(comes(HEARTBEAT_BASE + MASTER_NODE, b"\x05")), words=("master's heartbeat",)
    ),
    "F13 another program writes an object": Fault(  # 1006h = 0: drive 4 would not miss SYNC
        then(comes(SDO_REQUEST_BASE + 4, bytes.fromhex("2306100000000000"))),
        words=("another program writes objects of drive 4",),
    ),
    "F17 a winch jams": Fault(
        broken(1, by=jam),
        within=SEEN_TWICE,
        late=MAY_BE_LATE,
        words=("(drive 2) did not move",),
        code="drive_stuck",
    ),
    "F17 a winch jams, its drive reports it": Fault(
        broken(1, by=jam_seen_by_the_drive),
        within=REPORTED_BY_DRIVE,
        late=MAY_BE_LATE,
        words=("drive 2", "following error"),
    ),
    "F17 a winch slips, its drive does not monitor it": Fault(
        broken(1, by=slip),
        within=BELIEVED,
        late=MAY_BE_LATE,
        words=("cable 2", "limit 2.00 mm"),
    ),
    "F18 a cable slackens": Fault(then(feels(0.05)), within=PATH_STOP, words=("cable 6", "slack")),
    "F18 a cable is overloaded": Fault(
        then(feels(6.0)),
        within=PATH_STOP,
        words=("cable 6", "more than 102.0 N"),
        code="over_tension",
    ),
    "F18 a winch at its torque limit": Fault(
        broken(1, by=at_torque_limit),
        within=SEEN_TWICE,
        late=MAY_BE_LATE,
        words=("(drive 2) did not move",),
    ),
    "F19 a cable breaks": Fault(
        then(feels(0.0)),
        within=5.0,
        words=("cable 6 carries 0.0 N, no tension: it is broken",),
        code="cable_loose",
    ),
    "F20 the operator stops": Fault(
        then(lambda bench: bench.ask_stop()),
        ends=State.STOPPED,
        within=PATH_STOP,
        words=("stop requested",),
    ),
    "F21 all drives vanish": Fault(
        broken(*range(8), by=everything_dies), words=("did not answer",)
    ),
    "F26 emergency stop": Fault(
        broken(*range(8), by=emergency_stop), words=("emergency stop",), within=3.0
    ),
    "F27 a device babbles": Fault(
        from_then_on(babble), words=("did not answer",), within=8.0, bitrate=1e6, live=False
    ),
}


def complaints(
    fault: Fault, bench: Bench, ended: State | None, cause: str, cycle: float
) -> list[str]:
    """Deviations from the table; ``cycle`` in [s]."""
    found = bench.violations(fault.mixed, fault.rows)
    if ended is not fault.ends:
        found.append(f"the run ended {ended}, not {fault.ends}")
    found += [f"{word!r} is not in {cause!r}" for word in fault.words if word not in cause]
    if fault.code and fault.code not in bench.codes():
        found.append(f"no event {fault.code}")
    found += _said_or_left(fault, bench)
    if fault.within is None or len(bench.lost) == len(bench.drives):
        return found
    stop = bench.stop()
    within = fault.within + (fault.late if bench.real_time else 0.0)
    if stop.time > within * cycle + bench.blur:
        found.append(f"the last drive stopped after {1e3 * stop.time:.1f} ms")
    if stop.spread > fault.spread * cycle + bench.blur:
        found.append(f"the drives stopped within {1e3 * stop.spread:.1f} ms of each other")
    return found


def _said_or_left(fault: Fault, bench: Bench) -> list[str]:
    """No EMCY before the fault, and none at all of a run that finishes; whole drives then hold."""
    finishes = fault.ends is State.FINISHED
    until = float("inf") if finishes or bench.since is None else bench.since
    found = emergencies(bench.rehearsal, until, bench.rehearsal.behaviour.warning)
    return [*found, *left_holding(bench.rehearsal, bench.lost)]


HELD_UP = {"drive_silent", "late"}
"""Codes of events that end a run when its computer does something else."""


def held_up(fault: Fault, bench: Bench, cause: str) -> bool:
    """Whether this computer delayed the simulated drives, before or during the fault."""
    silent = "did not answer" in cause and not any(word in cause for word in fault.words)
    unasked = fault.ends is not State.LATCHED and HELD_UP & set(bench.codes())
    return bench.since is None or silent or bool(unasked) or "cycles late;" in cause


def row(
    name: str,
    fault: Fault,
    transport: str,
    bench: Bench,
    ended: State | None,
    cause: str,
    found: list[str],
) -> dict[str, Any]:
    """One line of the measured table; drives that go on have no time to the stop."""
    stop = bench.stop() if len(bench.lost) < len(bench.drives) else None
    stops = stop is not None and fault.within is not None
    return {
        "fault": name,
        "transport": transport,
        "ended": ended.value if ended else "killed",
        "cause": cause,
        "stop_ms": round(1e3 * stop.time, 2) if stop and stops else None,
        "spread_ms": round(1e3 * stop.spread, 2) if stop and stops else None,
        "step_mm": round(1e3 * stop.worst_step, 3) if stop else None,
        "travel_mm": round(1e3 * stop.travel, 3) if stop and stops else None,
        "violations": found,
    }
