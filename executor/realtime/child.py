"""Main function of the real-time process: opens the drives, arms them, runs the loop."""

from __future__ import annotations

import signal
from contextlib import suppress
from functools import partial
from multiprocessing.connection import Connection

from drivers.drive_group import CycleStatus
from executor.control.sync_master import SyncMaster
from executor.realtime.job import (
    CYCLE_SLOTS,
    EVENT_SLOTS,
    Armed,
    Ended,
    Failed,
    Go,
    Gone,
    Job,
    ReadDrives,
    ReadyDrives,
)
from executor.realtime.scheduling import RealClock, real_time, require_real_time
from executor.realtime.shared_memory import CycleRecordCodec, Ring, Supervised, pack_event
from executor.state_machine import SIMULATED, CycleRecord, LoopEvent, State
from model.errors import CdprError, Fault

_TERMINAL_SIGNALS = (
    signal.SIGINT, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU
)  # fmt: skip


def serve(job: Job, link: Connection, supervisor: int) -> None:
    """Runs a job; always ends with the drives holding on their own.

    Args:
        job: The job.
        link: To the supervisor.
        supervisor: Its process ID.
    """
    supervised = Supervised(job.board, supervisor)
    # The supervisor handles signals of the terminal, through the board; if it is suspended or
    # killed, its silence is detected.
    for number in _TERMINAL_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: supervised.ask_stop())
    try:
        with job.make_drives() as drives:
            _arm_and_run(job, drives, link, supervised)
    except CdprError as error:
        _send(link, Failed(error))
    except Exception as error:
        _send(link, Failed(Fault(f"the real-time process failed: {type(error).__name__}: {error}")))


def _arm_and_run(job: Job, drives: ReadyDrives, link: Connection, supervised: Supervised) -> None:
    motion = job.motion
    cycles, events = Ring(job.cycles, CYCLE_SLOTS), Ring(job.events, EVENT_SLOTS)
    wire = CycleRecordCodec(motion.cables)

    def on_cycle(record: CycleRecord) -> None:
        cycles.put(wire.pack(record, motion.after(record, drives)))

    def on_event(event: LoopEvent) -> None:
        events.put(pack_event(event, events.largest_content))

    with real_time() as denied:
        require_real_time(denied, needed=job.need_real_time)
        master = SyncMaster(
            drives.rig, drives.group, RealClock(motion.cycle, supervised.note_cycle)
        )
        try:
            loop = motion.loop(
                drives, master, requests=supervised.read, on_cycle=on_cycle, on_event=on_event
            )
            loop.arm(partial(motion.require, drives))
            if drives.group.capabilities.simulated and drives.true_pose is None:  # on a real bus
                on_event(LoopEvent(0, 0.0, SIMULATED, "the drives report that they are simulated"))
            _send(link, Armed(denied, loop.positions, drives.restarted, drives.remarks))
            message = master.cycle_until(lambda: _poll(link))
        except Exception:
            master.leave_disabled()
            raise
        if not isinstance(message, Go):
            master.leave_disabled()
            return
        state = loop.run()
    true_pose = drives.true_pose_now()
    _send(link, Ended(state, loop.cause, loop.holding, true_pose, loop.error))
    # After any other end the supervisor may hang, and requests nothing.
    while state is State.FINISHED and isinstance(_receive(link), ReadDrives):
        _send(link, master.read_state())


def _poll(link: Connection) -> object:
    """Next message of the supervisor, Gone if its link is closed, None if there is none."""
    return (_receive(link) or Gone()) if link.poll() else None


def _receive(link: Connection) -> object:
    """Next message of the supervisor; None when it closed the link."""
    try:
        return link.recv()
    except (EOFError, OSError):
        return None


def _send(link: Connection, what: Armed | Ended | Failed | CycleStatus) -> None:
    with suppress(OSError):  # the supervisor is gone; the drives still hold
        link.send(what)
