"""Latency of hold-to-run jogs in real time over UDP: press to first set-point, release to rest.

    python benchmarks/jog_latency.py [--presses 60] [--scene configs/environment_1.yaml]
    python benchmarks/jog_latency.py --one-cable [--presses 60]

Presses of 0.6 s alternate between both directions of each axis; or they wind each cable in and pay
it out again, on the taut platform. Two times are measured on the loop's clock: from the first
message of a press to the first cycle with changed targets, and from the release to the last such
cycle, which includes the ramp from 20 mm/s. Not a test: it takes minutes.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from executor.hold_to_run.presses import CableMove, PlatformMove, PressBoard  # noqa: E402
from executor.hold_to_run.session import cable_session, jog_session  # noqa: E402
from executor.state_machine import CycleRecord, State  # noqa: E402
from model.rig import Rig, load_rig  # noqa: E402
from model.scene import load_scene  # noqa: E402
from tests.cli.plans import RIG  # noqa: E402

HELD, PAUSE, SAID = 0.6, 0.9, 0.05
#: Unique to this process, as another may measure at the same time.
CHANNEL = f"239.74.163.91:{20000 + os.getpid() % 20000}"


@dataclass
class Operator:
    """Presses and releases a control in a thread and records the times."""

    presses: int
    one_cable: bool
    spans: list[tuple[float, float]] = field(default_factory=list)
    moved: list[float] = field(default_factory=list)
    lateness: list[float] = field(default_factory=list)
    silent: int = 0
    _last: tuple[int, ...] = ()
    _thread: threading.Thread | None = None

    def on_cycle(self, record: CycleRecord, board: PressBoard, _: object) -> None:
        """Starts when the drives are ready; records the times of cycles with changed targets."""
        if record.state is not State.MOVING:
            return
        self.lateness.append(record.lateness)
        if self._last and record.targets != self._last:
            self.moved.append(record.at)
        self._last = record.targets
        if self._thread is None:
            self._thread = threading.Thread(target=self._hold, args=(board,))
            self._thread.start()

    def _hold(self, board: PressBoard) -> None:
        time.sleep(1.0)
        for number in range(1, self.presses + 1):
            began = time.monotonic()
            while time.monotonic() < began + HELD:
                self.silent += not self._say(board, number)
                time.sleep(SAID)
            ended = time.monotonic()
            board.let_go(number)
            self.spans.append((began, ended))
            time.sleep(PAUSE)
        board.end()

    def _say(self, board: PressBoard, number: int) -> bool:
        """Sends one message of a press: odd ones forward or in, even ones backward or out."""
        turn, is_even = (number - 1) // 2, number % 2 == 0
        if self.one_cable:
            cable = CableMove(1 + turn % 8, pays_out=is_even)
            return board.hold(number, cable, step=None, percent=100)
        direction = np.zeros(3)
        direction[turn % 3] = -1.0 if is_even else 1.0
        move = PlatformMove(direction, in_platform=False)
        return board.hold(number, move, step=None, percent=100)


@contextmanager
def drives() -> Iterator[None]:
    """Simulated drives in their own process."""
    verb = "from cdpr.cli import main; main()"
    bus = ["--interface", "udp_multicast", "--channel", CHANNEL]
    process = subprocess.Popen(
        [sys.executable, "-c", verb, "sim", str(RIG), *bus],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"},
    )
    assert process.stdout is not None
    process.stdout.readline()
    try:
        yield
    finally:
        process.terminate()
        process.wait()


def main() -> int:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--presses", type=int, default=60)
    parser.add_argument("--scene", type=Path, default=ROOT / "configs" / "environment_1.yaml")
    parser.add_argument("--one-cable", action="store_true", help="one cable, not the platform")
    options = parser.parse_args()
    rig: Rig = load_rig(RIG).with_bus("udp_multicast", CHANNEL)
    scene = load_scene(options.scene)
    operator = Operator(options.presses, options.one_cable)
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_STATE_HOME"] = folder
        os.chdir(folder)
        with drives():
            if options.one_cable:
                cable_session(rig, need_real_time_rights=False, on_cycle=operator.on_cycle)
            else:
                jog_session(rig, scene, need_real_time_rights=False, on_cycle=operator.on_cycle)
    moved = np.array(operator.moved)
    first, rest, lost = [], [], 0
    for began, ended in operator.spans:
        mine = moved[(moved > began) & (moved < ended + PAUSE)]
        if not len(mine):
            lost += 1
            continue
        first.append(1e3 * (mine[0] - began))
        rest.append(1e3 * (mine[-1] - ended))
    for name, values in (("press to first set-point", first), ("release to rest", rest)):
        p50, p90, most = np.percentile(values, (50, 90, 100))
        print(f"{name:26} median {p50:6.1f}  p90 {p90:6.1f}  most {most:6.1f} ms")
    late = np.percentile(operator.lateness, (50, 99.9, 100))
    print(
        f"{'lateness of cycles':26} median {late[0]:.3f}  p99.9 {late[1]:.3f}  most {late[2]:.3f}"
    )
    print(f"{len(operator.spans)} presses, {lost} without a motion;", end=" ")
    print(f"{operator.silent} messages came too late")
    return 1 if lost else 0


if __name__ == "__main__":
    sys.exit(main())
