"""`cdpr jog`: short, slow, straight motions from the current pose."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import typer
from rich.live import Live
from rich.text import Text

from cdpr.cli.arguments import flag, given_options, option
from cdpr.cli.operate.run import MotionOptions, supervise
from cdpr.cli.operate.supervision import Keys, speed_by_key
from cdpr.cli.options import (
    RIG,
    SUMMARY_JSON,
    BusOptions,
    Quaternion,
    Triple,
    require_unused,
    rotation_of,
)
from cdpr.cli.output import err, out, show_json, show_line
from executor import jogging
from executor.drives import is_simulated
from executor.hold_to_run.line import JogProver
from executor.hold_to_run.presses import TIMEOUT, PlatformMove, PressBoard, press_clock
from executor.hold_to_run.session import cable_session, jog_session
from executor.jogging import FASTEST, SPEED
from executor.state_machine import CycleRecord, State
from model.errors import BadInput
from model.files.documents import millimetres
from model.pose import Pose
from model.rig import Rig
from model.scene import Scene, load_scene


@dataclass(frozen=True, slots=True)
class DistanceOptions:
    """Where a jog moves to; every field is an option of `cdpr jog`."""

    by_mm: Triple | None = option("distance x y z, at most 50 mm")
    to_home: bool = flag("move to the rig's home pose and orientation")


@dataclass(frozen=True, slots=True)
class SceneOptions:
    """Surroundings of a jog; every field is an option of `cdpr jog`."""

    scene: Path | None = option("scene file: obstacles and payload")
    no_scene: bool = flag("jog without a description of obstacles")
    clearance_mm: float | None = option("obstacle clearance instead of the scene's", min=0.0)

    def loaded(self) -> Scene | None:
        """The surroundings; None only with ``--no-scene``."""
        if (self.scene is None) != self.no_scene:
            raise BadInput(
                "obstacles are unknown: pass either --scene SCENE or --no-scene",
                where="--scene",
                next_step="pass --scene with the scene file, or --no-scene if there are no"
                " obstacles",
            )
        if self.scene is None:
            return None
        clearance = None if self.clearance_mm is None else self.clearance_mm / 1000.0
        return load_scene(self.scene).changed(stops=()).changed(clearance=clearance)


@dataclass(frozen=True, slots=True)
class HeldOptions:
    """Hold-to-run controls; every field is an option of `cdpr jog`."""

    hold_to_run: bool = flag(
        "enable the drives and follow held controls, such as those of `cdpr console`"
    )
    keys: bool = flag("as --hold-to-run, with keys: arrows for x and y, page up and down for z")
    end_with: int | None = option(
        "with --hold-to-run: end the session when this process, which started it, is gone",
        metavar="PID",
        min=1,
    )
    one_cable: bool = flag("with --hold-to-run: wind one cable in or pay it out, homed or not")
    simulated_start_mm: Triple | None = option(
        "with --hold-to-run or --keys: initial position of the simulated platform x y z"
        " (default: home)"
    )
    simulated_start_wxyz: Quaternion | None = option("its orientation (default: as at home)")

    def start(self, rig: Rig) -> Pose | None:
        """The initial pose of the simulated platform, ``world_from_platform``; None for home.

        Raises:
            BadInput: Only the orientation is stated, or it is none.
        """
        rotation = rotation_of(self.simulated_start_wxyz)
        if self.simulated_start_mm is None:
            if rotation is not None:
                raise BadInput(
                    "an orientation without a position", next_step="add --simulated-start-mm X Y Z"
                )
            return None
        position = millimetres(list(self.simulated_start_mm))
        return Pose(position, rig.home.rotation if rotation is None else rotation)


#: Keys that hold a jog, and its direction.
DIRECTIONS = {
    "right": (1.0, 0.0, 0.0),
    "left": (-1.0, 0.0, 0.0),
    "up": (0.0, 1.0, 0.0),
    "down": (0.0, -1.0, 0.0),
    "page up": (0.0, 0.0, 1.0),
    "page down": (0.0, 0.0, -1.0),
}
HELP = "arrows x and y · page up and down z · + and - speed · f frame · space stop · q end"
#: Update period of the line with the position, [s].
SHOWN_EVERY = 0.2


def jog(
    *,
    rig: Path = RIG,
    distance: DistanceOptions,
    surroundings: SceneOptions,
    output: Path | None = option(
        "folder to create (default: runs/jog or, with --cable, runs/jog-cable)", "-o", "--output"
    ),
    cable: int | None = option("move one winch by --mm", min=1),
    mm: float | None = option("length to pay out, at most 50; negative: wind in"),
    held: HeldOptions,
    limit_n: float | None = option(
        "with --cable or --one-cable: tension limit of any cable (default: 60 %)"
    ),
    speed_mm_s: float = option(
        "largest speed, at most the rig's", default=1000.0 * SPEED, min=0.1, max=1000.0 * FASTEST
    ),
    bus: BusOptions,
    motion: MotionOptions,
    as_json: bool = SUMMARY_JSON,
) -> None:
    """Move the platform slowly and straight by a few millimetres from its current pose.

    A jog is a run: planned, verified and gated like any other, and it can be stopped, held and
    monitored. With the interface 'virtual' the simulated platform starts at home. With --cable a
    single winch moves: for commissioning, with unloaded cables. With --hold-to-run the drives stay
    enabled, and the platform moves while a control is held over the command socket; `cdpr console`
    has such controls. With --keys it moves while a key is held in this terminal. With --hold-to-run
    --one-cable controls move one winch at a time instead of the platform.

    Examples:
      cdpr jog rig.yaml --cable 3 --mm -5
      cdpr jog configs/gachon_8_6.yaml --by-mm 0 0 10 --scene configs/environment_1.yaml --fast
    """
    the_rig = bus.rig(rig)
    speed = speed_mm_s / 1000.0
    path = given_options(distance) | given_options(surroundings)
    if cable is not None or mm is not None:
        why = "a single cable is moved without a path, and obstacles are not checked"
        require_unused("cdpr jog", path, why)
        _one_cable(the_rig, cable, mm, limit_n, speed, output, motion, as_json)
        return
    if not held.hold_to_run:
        require_unused("cdpr jog", {"--end-with": held.end_with}, "only with --hold-to-run")
    if not (held.hold_to_run or held.keys):
        simulated_start = {
            "--simulated-start-mm": held.simulated_start_mm,
            "--simulated-start-wxyz": held.simulated_start_wxyz,
        }
        require_unused("cdpr jog", simulated_start, "only with --hold-to-run or --keys")
    no_effect = {"--json": as_json, "--fast": motion.fast, "--output": output}
    if held.one_cable:
        if not held.hold_to_run or held.keys:
            raise BadInput(
                "--one-cable needs --hold-to-run, without --keys",
                where="cdpr jog",
                why="single cables are jogged by held controls, such as those of `cdpr console`",
                next_step="pass --hold-to-run --one-cable, or --cable N --mm X for a fixed length",
            )
        why = "controls move one cable at a time, without a path"
        require_unused("cdpr jog", path | no_effect, why)
        session = partial(cable_session, the_rig, limit=limit_n, speed=speed)
        _hold_to_run(session, the_rig, motion, parent=held.end_with)
        return
    why = "only with --cable or --one-cable; a path uses the rig's limits"
    require_unused("cdpr jog", {"--limit-n": limit_n}, why)
    if held.hold_to_run or held.keys:
        unused = given_options(distance) | no_effect
        require_unused("cdpr jog", unused, "held controls set the direction, in real time")
        keys = JogKeys(Keys(), 1000.0 * min(speed, the_rig.motion.speed)) if held.keys else None
        session = partial(
            jog_session,
            the_rig,
            surroundings.loaded(),
            speed=speed,
            start=held.start(the_rig),
        )
        _hold_to_run(session, the_rig, motion, keys, held.end_with)
        return
    by = None if distance.by_mm is None else millimetres(list(distance.by_mm))
    jogging.require_distance(by, to_home=distance.to_home)
    jog_by = partial(
        jogging.jog,
        the_rig,
        surroundings.loaded(),
        by=by,
        to_home=distance.to_home,
        speed=speed,
        folder=output,
        realtime=not motion.fast,
        need_real_time_rights=not motion.without_real_time,
    )
    raise typer.Exit(supervise(jog_by, the_rig, yes=motion.yes, as_json=as_json))


def _hold_to_run(
    session: Callable[..., object],
    rig: Rig,
    motion: MotionOptions,
    keys: JogKeys | None = None,
    parent: int | None = None,
) -> None:
    """Runs a session of hold-to-run controls until it ends, or the process that started it."""
    arguments = motion.arguments(rig, as_json=False)
    ask = arguments["confirm"]

    def is_orphan() -> bool:
        return parent is not None and os.getppid() != parent

    def take_cycle(record: CycleRecord, presses: PressBoard, progress: Any) -> None:
        if is_orphan():
            presses.end()
        if keys is not None:
            keys.take_cycle(record, presses, progress)

    with keys or ExitStack():
        arguments["confirm"] = lambda proposal: not is_orphan() and ask(proposal)
        session(**arguments, on_cycle=take_cycle)
    out.print("jogging ended" + ("" if is_simulated(rig) else "; the drives hold"))


class JogKeys:
    """Hold-to-run by keys: a held key repeats, and each repetition counts for 150 ms.

    A terminal does not report the release of a key, so the platform moves until no repetition has
    arrived for that time. Between the first press and its first repetition it comes to rest.
    """

    def __init__(self, keys: Keys, speed_mm_s: float) -> None:
        """Starts with no key held.

        Args:
            keys: Of the terminal; read once the drives are ready.
            speed_mm_s: Largest speed, [mm/s].
        """
        self._keys, self._most = keys, speed_mm_s
        self._percent, self._in_platform = 100, False
        self._key, self._number = "", 0
        self._shown_at = float("-inf")
        self._read_at = float("inf")
        self._live = Live(console=err, auto_refresh=False, transient=True)
        self._stack = ExitStack()
        self._is_ready = self._is_closed = False

    def __enter__(self) -> JogKeys:
        """Leaves the terminal unchanged until the drives are ready."""
        return self

    def __exit__(self, *_: object) -> None:
        """Restores the terminal."""
        self._stack.close()

    def take_cycle(self, record: CycleRecord, presses: PressBoard, prover: JogProver) -> None:
        """After a cycle: reads the keys, and shows the position; a closed terminal is a stop."""
        if record.state is not State.MOVING or self._is_closed:
            return
        try:
            self._use_terminal(record, presses, prover)
        except OSError:
            self._is_closed = True
            signal.raise_signal(signal.SIGINT)  # as Ctrl-C

    def _use_terminal(self, record: CycleRecord, presses: PressBoard, prover: JogProver) -> None:
        if not self._is_ready:
            self._is_ready = True
            self._stack.enter_context(self._keys)
            if err.is_terminal:
                self._stack.enter_context(self._live)
        now = time.monotonic()
        # After a pause of this program a key that waited may not be held any more.
        waited, self._read_at = now - self._read_at > TIMEOUT, now
        for key in self._keys.pressed():
            if not (waited and key in DIRECTIONS):
                self._take(key, presses)
        if record.at - self._shown_at >= SHOWN_EVERY:
            self._shown_at = record.at
            self._show(prover)

    def _take(self, key: str, presses: PressBoard) -> None:
        if key in DIRECTIONS:
            self._hold(key, presses)
            return
        presses.let_go(self._number)
        if key == " ":
            signal.raise_signal(signal.SIGINT)  # as Ctrl-C: a stop
        elif key == "q":
            presses.end()
        elif key == "f":
            self._in_platform = not self._in_platform
        elif key in "+-":
            self._percent = speed_by_key(self._percent, key)

    def _hold(self, key: str, presses: PressBoard) -> None:
        """Continues the press of the same key if it has not ended; otherwise begins another."""
        if key == self._key and self._send(presses):
            return
        self._key = key
        self._number = max(self._number + 1, press_clock())
        self._send(presses)

    def _send(self, presses: PressBoard) -> bool:
        move = PlatformMove(np.array(DIRECTIONS[self._key]), self._in_platform)
        return presses.hold(self._number, move, step=None, percent=self._percent)

    def _show(self, prover: JogProver) -> None:
        x, y, z = prover.pose.position * 1e3
        frame = "platform" if self._in_platform else "world"
        speed = self._most * self._percent / 100.0
        limit = f"; stops in {prover.room * 1e3:.1f} mm: {prover.limit}" if prover.limit else ""
        text = f"{x:.1f}, {y:.1f}, {z:.1f} mm  {speed:.1f} mm/s, {frame} frame{limit}\n{HELP}"
        self._live.update(Text(text), refresh=self._live.is_started)


def _one_cable(
    rig: Rig,
    cable: int | None,
    mm: float | None,
    limit_n: float | None,
    speed: float,
    output: Path | None,
    motion: MotionOptions,
    as_json: bool,
) -> None:
    if cable is None or mm is None:
        raise BadInput(
            "a single cable needs both --cable N and --mm X",
            where="cdpr jog",
            next_step="pass both, or --by-mm X Y Z to move the platform",
        )
    done = jogging.jog_cable(
        rig,
        cable,
        mm / 1000.0,
        limit=limit_n,
        speed=speed,
        folder=output,
        **motion.arguments(rig, as_json),
    )
    moved_mm = done.moved * 1000.0
    tensions = [round(float(t), 2) for t in done.tensions]
    if as_json:
        record = done.folder and str(done.folder)
        moved = {"cable": cable, "moved_mm": round(moved_mm, 4), "tensions_n": tensions}
        show_json({**moved, "record": record})
        return
    out.print(f"cable {cable} moved by {moved_mm:+.3f} mm, positive pays out; the drives hold")
    show_line(f"tensions: {', '.join(f'{t:.1f}' for t in tensions)} N")
    if done.folder:
        show_line(f"record: {done.folder}")
