"""The real-time process: one thread that opens the drives, arms them and runs the loop."""

from __future__ import annotations

import signal
from contextlib import suppress
from multiprocessing.connection import Connection

from cdpr.errors import CdprError, Fault
from drivers.drive_group import CycleStatus
from executor.clock import RealClock
from executor.machine import State
from executor.real_time_job import (
    CYCLE_SLOTS,
    EVENT_SLOTS,
    Armed,
    Ended,
    Failed,
    Go,
    Job,
    Look,
    ReadyDrives,
)
from executor.realtime import real_time, require_real_time
from executor.records import CycleRecord, LoopEvent
from executor.ring import Ring
from executor.shared_board import Supervised
from executor.wire import RecordWire, pack_event

_FROM_A_TERMINAL = (
    signal.SIGINT, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU
)  # fmt: skip


def serve(job: Job, link: Connection, supervisor: int) -> None:
    """What the process does; it ends with the drives holding by themselves, whatever happens.

    Args:
        job: What to do.
        link: To the supervisor.
        supervisor: Number of its process.
    """
    supervised = Supervised(job.board, supervisor)
    # What a terminal sends is the supervisor's to decide on; it tells by the board, and where it is
    # suspended or killed its silence does.
    for number in _FROM_A_TERMINAL:
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: supervised.ask_stop())
    try:
        with job.make_drives() as drives:
            _arm_and_run(job, drives, link, supervised)
    except CdprError as error:
        _say(link, Failed(error))
    except Exception as error:
        _say(link, Failed(Fault(f"the real-time process broke: {type(error).__name__}: {error}")))


def _arm_and_run(job: Job, drives: ReadyDrives, link: Connection, supervised: Supervised) -> None:
    motion = job.motion
    cycles, events = Ring(job.cycles, CYCLE_SLOTS), Ring(job.events, EVENT_SLOTS)
    wire = RecordWire(motion.cables)

    def on_cycle(record: CycleRecord) -> None:
        cycles.put(wire.pack(record, motion.after(record, drives)))

    def on_event(event: LoopEvent) -> None:
        events.put(pack_event(event, events.largest_content))

    with real_time() as denied:
        require_real_time(denied, needed=job.need_real_time)
        loop = motion.loop(
            drives,
            RealClock(motion.cycle),
            wishes=supervised.read,
            on_cycle=on_cycle,
            on_event=on_event,
        )
        loop.arm()
        _say(link, Armed(denied, loop.stands_at))
        if not isinstance(_heard(link), Go):
            return
        state = loop.run()
    _say(link, Ended(state, loop.cause, loop.holding, drives.true_pose_now()))
    # After any other end the supervisor may hang, and nobody asks.
    while state is State.FINISHED and isinstance(_heard(link), Look):
        _say(link, drives.group.read_positions())


def _heard(link: Connection) -> object:
    """The supervisor's next word; None when it changed its mind, is done, or is gone."""
    try:
        return link.recv()
    except (EOFError, OSError):
        return None


def _say(link: Connection, what: Armed | Ended | Failed | CycleStatus) -> None:
    with suppress(OSError):  # nobody is there to hear it; the drives hold all the same
        link.send(what)
