"""Rows of the fault table for what standards leave to drives, and makers' drives are known to do.

Each is a named behaviour of `simulation.drives.behaviour`: the run finishes, or stops by a rule.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from executor.state_machine import State
from tests.scenarios.faults.bench import Bench, Script
from tests.scenarios.faults.cases import TABLE, Fault, broken, late, then

WARNED = 60.0
"""Cycles from arming until an enabled drive sends its first warning."""

WHOLE_RUN = 500.0
"""Cycles of the short plan, and of an enabling that takes as long as it may."""

POLLED = 11.0
"""Cycles until the state of each drive between its replies was read and all have stopped."""

IMPATIENT = {"sync_timeout_periods": 1.5}
ONCE_ENABLED = {"mode_display_when_enabled": True}
LETS_GO = ("heartbeat-loss-is-fault",)
UNWATCHED = {"heartbeat_loss": "fault"}


def nothing(_bench: Bench) -> None:
    """Faults of the drives themselves."""


def with_drives(
    *behaviour: str,
    profile: Mapping[str, object] | None = None,
    script: Callable[[], Script] | None = None,
) -> Fault:
    """It finishes, without an EMCY, and the drives hold after the end."""
    return Fault(
        script or then(nothing),
        ends=State.FINISHED,
        within=None,
        behaviour=behaviour,
        profile=profile or {},
        live=not profile,
    )


def stopped_by_rule(
    *behaviour: str, words: tuple[str, ...], profile: Mapping[str, object] | None = None
) -> Fault:
    """A fault at some time of the run."""
    return Fault(
        lambda: Bench.happens,
        within=WHOLE_RUN,
        words=words,
        behaviour=behaviour,
        profile=profile or {},
        live=False,
    )


def answers_of(**changes: object) -> Callable[[], Script]:
    """SDO answers become so while the drives move; the end is made of them."""

    def happens(bench: Bench) -> None:
        for drive in bench.drives:
            drive._server._behaviour = replace(drive.behaviour, **changes)  # type: ignore[arg-type]

    return then(happens)


def at_limit_switch(bench: Bench) -> None:
    """From now on the third drive is beyond its limit switch, and coasts from SYNC to SYNC."""
    drive = bench.drives[2]
    drive.behaviour = replace(drive.behaviour, limit_switch=1.0)
    drive._motion = replace(drive._motion, deceleration=drive._motion.deceleration / 50.0)


DRIVES: dict[str, Fault] = {
    "D SYNC overdue after 1.5 periods": with_drives("sync-periods=1.5", profile=IMPATIENT),
    "D 1.5 periods, a cycle late by 0.2 T": replace(
        with_drives("sync-periods=1.5", profile=IMPATIENT, script=late(0.2)), live=False
    ),
    "D 1.5 periods, a cycle late by 0.25 T": Fault(
        late(0.25),
        words=("0.2 cycles late",),
        live=False,
        behaviour=("sync-periods=1.5",),
        profile=IMPATIENT,
    ),
    "D 1.5 periods, a cycle late by 0.6 T": Fault(
        late(0.6),
        words=("0.6 cycles late",),
        live=False,
        behaviour=("sync-periods=1.5",),
        profile=IMPATIENT,
    ),
    "D a lost heartbeat is a fault": with_drives(*LETS_GO),
    "D a lost heartbeat is a fault, as in the profile": with_drives(*LETS_GO, profile=UNWATCHED),
    **{
        f"D a lost heartbeat is a fault, {name}": replace(
            TABLE[name], behaviour=LETS_GO, profile=UNWATCHED, live=False
        )
        for name in ("F1 kill -9", "F7 a drive falls silent", "F9 a drive restarts")
    },
    "D PDOs mapped when operational": with_drives("maps-when-operational"),
    # In real time their set-up takes minutes, in turn.
    "D SDO answers take 300 ms": replace(with_drives("sdo-delay=300"), live=False),
    "D every 5th SDO answer lost": replace(with_drives("sdo-lost=5"), live=False),
    "D every 7th SDO answer 800 ms late": with_drives("sdo-late=800"),
    "D SDO answers twice at the end": with_drives(script=answers_of(sdo_twice=0.03)),
    "D SDO answers lost at the end": with_drives(script=answers_of(sdo_lost=2)),
    "D no optional object": with_drives(
        "absent=1400:05/06010000",
        "absent=1007",
        "absent=1029/06090011",
        "absent=1800:03/06010002",
        "absent=605C/08000000",
        "absent=605E/06020000",
        "absent=1401/06010000",
        "absent=1402/08000000",
        "absent=1803/06040041",
    ),
    "D mode 50 ms late": with_drives("mode-late=50"),
    "D mode shown once enabled": with_drives("mode-when-enabled", profile=ONCE_ENABLED),
    "D mode shown 200 ms after enabling": with_drives(
        "mode-when-enabled", "mode-late=200", profile=ONCE_ENABLED
    ),
    "D enabled 400 ms late": with_drives("enable-late=400"),
    "D boot-up 1.5 s late": with_drives("boot-late=1500"),
    "D a warning of the profile": with_drives("warning=4210", profile={"warnings": ["42xxh"]}),
    "D a warning that the profile lacks": Fault(
        lambda: Bench.happens,
        within=WARNED,
        words=("4210",),
        behaviour=("warning=4210",),
    ),
    "D position limits monitored": with_drives("limits-monitored"),
    "D status bits flicker": with_drives("status-flicker"),
    "D a limit switch after each reply": Fault(
        broken(2, by=at_limit_switch),
        within=POLLED,
        mixed=POLLED,
        words=("drive 3) stopped on its own: quick stop active between two replies",),
        live=False,
    ),
    "D mode shown 5 s after enabling": stopped_by_rule(
        "mode-when-enabled", "mode-late=5000", words=("6061h",), profile=ONCE_ENABLED
    ),
    "D position noise of 10 counts": with_drives("position-noise=10"),
    "D position noise of 20 counts": stopped_by_rule("position-noise=20", words=("did not move",)),
    "D torque noise of 40 per mille": with_drives("torque-noise=40"),
    "D friction of 100 per mille": with_drives("friction=100"),
    "D friction of 200 per mille": stopped_by_rule("friction=200", words=("it may be slack",)),
    "D stick-slip of 15 counts": with_drives("stick-slip=15"),
    "D stick-slip of 120 counts": stopped_by_rule("stick-slip=120", words=("did not move",)),
}

ROWS: dict[str, Fault] = TABLE | DRIVES
"""The whole fault table."""
