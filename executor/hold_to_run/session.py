"""Jog sessions: enable the drives once, move while a control is held, end in order.

Controls are reported over the command socket (`executor.remote.protocol`): the session itself has
no keys and no screen.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any

from executor.control.winch_motion import WinchResult
from executor.drives import (
    drives_of,
    is_simulated,
    require_drives,
    require_simulated_start,
    unreferenced_drives_of,
)
from executor.hold_to_run.cables import CableMotion, CableTravel
from executor.hold_to_run.line import JogProver, PieceRing
from executor.hold_to_run.loop import JogMotion
from executor.hold_to_run.presses import PressBoard
from executor.interlock.interlock import MotionInterlock
from executor.jogging import FASTEST, LONGEST_MM, measured_pose, with_speed
from executor.proposals import Proposal, cables_proposal, jog_proposal, require_confirmed
from executor.realtime.child import MotionTask, ReadyDrives
from executor.realtime.scheduling import SimulatedClock
from executor.realtime.shared_memory import SharedMemory
from executor.remote.command_server import Commands, commands_from_start
from executor.remote.status import CableStatus, JogStatus, SessionStatus
from executor.state_machine import REMARK, CycleRecord
from executor.supervision import Callbacks, RequestBoard, Supervisor
from executor.winch_runs import limit_of, move_supervised, record_folder, supervised
from model.errors import truth_value
from model.pose import Pose
from model.progress import SILENT, Listener
from model.rig import Rig
from model.scene import Scene, empty_scene
from model.winches import WinchMap

#: A session without a held control ends after this time, [s]: cables relax.
IDLE = 300.0


def jog_session(
    rig: Rig,
    scene: Scene | None,
    *,
    speed: float = FASTEST,
    start: Pose | None = None,
    realtime: bool = True,
    need_real_time_rights: bool = True,
    listener: Listener = SILENT,
    confirm: Callable[[Proposal], bool] | None = None,
    supervisor: Supervisor | None = None,
    on_cycle: Callable[[CycleRecord, PressBoard, JogProver], None] | None = None,
) -> None:
    """Enables the drives, and moves the platform in a straight line while a control is held.

    A press is reported over the command socket (``held``, every 50 ms) and ends with ``let_go``, or
    after 150 ms without a report. The line ahead of the platform is checked during the motion
    against the scene, the workspace, tensions and winches, and the platform slows down before the
    end of the checked line. The session ends with ``end``, with a stop, or after five minutes
    without a held control.

    Args:
        rig: The robot and its bus.
        scene: Obstacles and load; its stops are ignored. None states that there are no obstacles.
        speed: Largest jog speed, [m/s].
        start: Pose of the simulated platform, ``world_from_platform``; None for its home pose.
        realtime: As for `executor.runner.run`, like all up to the supervisor.
        need_real_time_rights: Refuse to enable drives on a bus without real-time scheduling.
        confirm: Called once, before anything is enabled; False cancels it.
        supervisor: Turns interrupts into stops; None for what signal handlers raise.
        on_cycle: Called after every cycle with the board of presses and the checked line, for
            programs that hold controls themselves.

    Raises:
        CdprError: As for `executor.jogging.jog`; a fault is latched, but not an exception of
            the listener, which stops the session.
        StoppedByOperator: Cancelled, or stopped; the drives hold.
    """
    realtime = truth_value("realtime", realtime)
    need_real_time_rights = truth_value("need_real_time_rights", need_real_time_rights)
    slow = with_speed(rig, speed)
    require_drives(slow, realtime)
    require_simulated_start(slow, start)
    with commands_from_start("jog", slow, supervisor, realtime=realtime) as commands:
        interlock = MotionInterlock(slow)
        interlock.require_free()
        ready = interlock.referenced_rig()
        around = (empty_scene(slow) if scene is None else scene).changed(stops=())
        known = (start or ready.home) if is_simulated(ready) else None
        start = known or measured_pose(ready, around)
        require_confirmed(confirm, jog_proposal(ready, around, start))
        _run(
            ready,
            commands,
            partial(_platform_jogs, ready, around, start),
            "jog-session",
            realtime=realtime,
            need_real_time_rights=need_real_time_rights,
            listener=listener,
            on_cycle=on_cycle,
        )


def cable_session(
    rig: Rig,
    *,
    limit: float | None = None,
    speed: float = FASTEST,
    realtime: bool = True,
    need_real_time_rights: bool = True,
    listener: Listener = SILENT,
    confirm: Callable[[Proposal], bool] | None = None,
    supervisor: Supervisor | None = None,
    on_cycle: Callable[[CycleRecord, PressBoard, CableTravel], None] | None = None,
) -> None:
    """Enables the drives, homed or not, and moves one winch while a control is held.

    As `executor.jogging.jog_cable`, except for the length: the winch slows down and comes to rest
    when the control is released, near the tension limit, and after 50 mm of a press. Presses and
    the end of the session are as for `jog_session`. The homing reference is kept; if the drive
    positions fit no pose afterwards, no run begins.

    Args:
        rig: The robot and its bus.
        limit: Largest tension of any cable, [N]; None for 60 % of the rig's range.
        speed: Largest winch speed, [m/s].
        realtime: As for `executor.runner.run`, like all up to the supervisor.
        need_real_time_rights: Refuse to enable drives on a bus without real-time scheduling.
        confirm: Called once, before anything is enabled; False cancels it.
        supervisor: Turns interrupts into stops; None for what signal handlers raise.
        on_cycle: Called after every cycle with the board of presses and the cable travel, for
            programs that hold controls themselves.

    Raises:
        CdprError: As for `executor.jogging.jog_cable`; a fault is latched, but not an exception of
            the listener, which stops the session.
        StoppedByOperator: Cancelled, or stopped; the drives hold.
    """
    realtime = truth_value("realtime", realtime)
    need_real_time_rights = truth_value("need_real_time_rights", need_real_time_rights)
    slow = with_speed(rig, speed)
    require_drives(slow, realtime)
    limit = limit_of(slow, limit)
    with commands_from_start("jog", slow, supervisor, realtime=realtime) as commands:
        MotionInterlock(slow).require_free()
        require_confirmed(confirm, cables_proposal(slow, limit))
        _run(
            slow,
            commands,
            partial(_cable_jogs, slow, limit),
            "jog-cables",
            cables=slow.cable_count,
            realtime=realtime,
            need_real_time_rights=need_real_time_rights,
            listener=listener,
            on_cycle=on_cycle,
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Jogs:
    """Parts of one kind of session.

    Attributes:
        task: For the real-time process.
        make_drives: See `open_mover`.
        status: Reported status.
        progress: Of the jogs: the checked line, or the cable travel.
        take_cycle: Called after every cycle.
    """

    task: MotionTask
    make_drives: Callable[..., AbstractContextManager[ReadyDrives]]
    status: SessionStatus
    progress: JogProver | CableTravel
    take_cycle: Callable[[CycleRecord], None]


def _platform_jogs(
    rig: Rig,
    scene: Scene,
    start: Pose,
    board: RequestBoard,
    presses: PressBoard,
    stack: ExitStack,
    *,
    simulated_time: bool,
) -> _Jogs:
    """Moves the platform along a checked straight line; its memory is closed by the stack."""
    load = scene.load
    memory = SharedMemory.create(PieceRing.size(rig.cable_count))
    stack.callback(memory.close)
    send = PieceRing(memory, rig.cable_count).put
    prover = JogProver(rig, scene, start, presses, send)
    task = JogMotion(
        rig=rig.document,
        cables=rig.cable_count,
        cycle=rig.cycle,
        begin=tuple(map(int, WinchMap(rig).counts_at(start, load))),
        presses=presses.memory,
        pieces=memory,
        reference=MotionInterlock(rig).require_ready(),
    )
    return _Jogs(
        task,
        partial(drives_of, rig.document, start, load),
        JogStatus(rig, board, prover, simulated_time=simulated_time),
        prover,
        prover.take_cycle,
    )


def _cable_jogs(
    rig: Rig,
    limit: float,
    board: RequestBoard,
    presses: PressBoard,
    _stack: ExitStack,
    *,
    simulated_time: bool,
) -> _Jogs:
    """Moves one cable at a time."""
    longest = LONGEST_MM / 1000.0
    travel = CableTravel(rig, limit, longest)
    speed = rig.motion.speed
    return _Jogs(
        CableMotion(rig.cable_count, rig.cycle, limit, speed, longest, presses.memory),
        partial(unreferenced_drives_of, rig.document, rig.home, limit, None),
        CableStatus(rig, board, travel, simulated_time=simulated_time),
        travel,
        lambda record: travel.take_cycle(record, presses.held()),
    )


def _run(
    rig: Rig,
    commands: Commands,
    make_jogs: Callable[..., _Jogs],
    name: str,
    *,
    cables: int = 0,
    realtime: bool,
    need_real_time_rights: bool,
    listener: Listener,
    on_cycle: Callable[[CycleRecord, PressBoard, Any], None] | None,
) -> None:
    """Runs a session; the command socket takes the presses; errors as `supervised`.

    Args:
        rig: The robot and its bus.
        commands: Those taken since the start of the verb.
        make_jogs: `_platform_jogs` or `_cable_jogs`, with the arguments before the board.
        name: Of its record folder in ``runs``.
        cables: See `PressBoard`.
        realtime: As for `jog_session`, like all that follow.
        need_real_time_rights: Refuse to enable drives on a bus without real-time scheduling.
        on_cycle: Called after every cycle.
    """
    clock = SimulatedClock(rig.cycle)
    now = time.monotonic if realtime else lambda: clock.now

    callbacks = Callbacks(commands.board.ask_stop)
    on_cycle = on_cycle and callbacks.guarded("on_cycle", on_cycle)

    def session() -> WinchResult:
        with ExitStack() as stack:
            presses = PressBoard(now, cables)
            stack.callback(presses.close)
            jogs = make_jogs(commands.board, presses, stack, simulated_time=not realtime)

            began = math.inf  # with the first cycle: the drives' set-up may take minutes

            def take_cycle(record: CycleRecord) -> None:
                nonlocal began
                began = min(began, record.at)
                jogs.take_cycle(record)
                if record.at - max(began, presses.last_heard) > IDLE:
                    presses.end()
                if on_cycle is not None:
                    on_cycle(record, presses, jogs.progress)

            return move_supervised(
                rig,
                commands,
                jogs.task,
                jogs.make_drives,
                jogs.status,
                record_folder(rig, None, name),
                clock=clock,
                need_real_time_rights=need_real_time_rights,
                listener=listener,
                callbacks=callbacks,
                showing=nullcontext(take_cycle),
                presses=presses,
                # Its user must know when drives are enabled.
                unreported={"moving", "traceback", REMARK},
            )

    supervised(rig, commands, session, callbacks)
