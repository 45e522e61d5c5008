"""Benchmarks measure what they print, and refuse what they cannot measure before they begin."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks import detection, jog_latency, realtime
from model.pose import Array
from model.rig import Rig
from model.scene import Scene

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--rates", "500"), "500 Hz is outside 10 to 250 Hz"),
        (("--rates", "100", "nan"), "nan Hz is outside"),
        (("--rates", "0"), "0 Hz is outside"),
        (("--seconds", "0"), "the measuring time is 0 s"),
        (("--seconds", "inf"), "the measuring time is inf s"),
        (("--seconds", "120"), "the measuring time is 120 s, the path takes 43.4 s"),
    ],
)
def test_a_case_that_cannot_be_measured_is_refused_in_one_message(
    options: tuple[str, ...],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def measured(*_asked: object) -> list[str]:
        pytest.fail("it began to measure")

    monkeypatch.setattr(realtime, "measured", measured)
    monkeypatch.setattr(realtime, "verified_plan", str)
    monkeypatch.setattr(realtime, "prepare", lambda *_: SimpleNamespace(duration=43.42))
    assert realtime.main(options) == 2
    told = capsys.readouterr()
    assert said in told.err
    assert "next:" in told.err
    assert not told.out


def test_the_plain_loop_is_measured_during_the_motion_of_the_real_time_process_only(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Start and end of that process keep a core busy for seconds."""
    clock = SimpleNamespace(now=0.0)

    def sleep(seconds: float) -> None:
        slow = 0.0 if 10.0 < clock.now + seconds < 20.0 else 0.25
        clock.now += seconds + slow

    class Link:
        def poll(self, _seconds: float) -> bool:
            return clock.now > 30.0

        def recv(self) -> tuple[float, float]:
            return 10.5, 19.5

        def send(self, late: Array) -> None:
            sent.append(late)

    sent: list[Array] = []
    monkeypatch.setattr(realtime, "time", SimpleNamespace(monotonic=lambda: clock.now, sleep=sleep))
    realtime.plain_loop(1.0, Link())  # type: ignore[arg-type]
    assert sent[0].tolist() == [0.0] * 9


@pytest.mark.parametrize(("denied", "loop"), [("", "process |"), ("x", "process, rights denied |")])
def test_a_loop_without_real_time_rights_is_named_so_in_the_table(
    denied: str, loop: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    motion = realtime.Motion(np.zeros(3), 0.0, 0.0, denied)
    link = SimpleNamespace(send=lambda _span: None, recv=lambda: np.zeros(3))
    plain = SimpleNamespace(start=lambda: None, join=lambda: None)
    context = SimpleNamespace(Pipe=lambda: (link, link), Process=lambda **_: plain)
    monkeypatch.setattr(realtime.multiprocessing, "get_context", lambda _: context)
    monkeypatch.setattr(realtime, "process_lateness", lambda *_: motion)
    prepared: Any = SimpleNamespace(checked=SimpleNamespace(table=SimpleNamespace(cycle=0.01)))
    ours, _ = realtime.measured(prepared, False, 1.0, tmp_path)
    assert f"real-time {loop}" in ours


def test_the_detectors_are_timed_as_they_are_scored(monkeypatch: pytest.MonkeyPatch) -> None:
    def find(name: str, image: Array, _number: int) -> dict[int, Array]:
        timed.append((name, image))
        return {7: image}

    timed: list[tuple[str, Array]] = []
    image = np.zeros((48, 64), np.uint8)
    finders = {name: partial(find, name) for name in ("ours", "cv2 NONE")}
    camera = SimpleNamespace(render=lambda *_: image)
    monkeypatch.setattr(detection, "SyntheticCamera", lambda *_, **__: camera)
    monkeypatch.setattr(detection, "finders_of", lambda *_: finders)
    detection.times(1)
    assert ("ours", image) in timed


def test_a_path_counts_at_a_mark_only_if_it_was_known_by_then(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """OMPL's planners, which run beside ours, are read that way."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks" / "planner"))
    import ours

    for name in ("ours", "compiled_rrt", "result"):
        del sys.modules[name]
    rounds = iter([(0.4, 5.0), (1.5, 4.0), (30.0, 3.0)])
    clock = SimpleNamespace(now=0.0)

    def advance(_handle: object, _rounds: int) -> float:
        clock.now, length = next(rounds)
        return length

    search = SimpleNamespace(points=np.zeros((9, 2, 3)), counts=np.zeros((9, 2), np.int64))
    monkeypatch.setattr(ours, "time", SimpleNamespace(process_time=lambda: clock.now))
    monkeypatch.setattr(ours, "advance", advance)
    monkeypatch.setattr(ours, "handle_of", lambda *_: None)
    monkeypatch.setattr(ours, "new_search", lambda *_: search)
    monkeypatch.setattr(ours, "_checks", lambda _search: 0)
    contestant: Any = object.__new__(ours.Contestant)
    vars(contestant).update(_problem=None, _start=None, _goal=None, _first=lambda _seed: 0.3)
    assert contestant.run(1, (0.2, 1.0, 10.0, 20.0)).lengths_m == (np.inf, 5.0, 4.0, 4.0)


def test_the_scene_of_jogs_is_a_path_in_the_current_folder(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The jogs themselves run in an empty folder."""
    scenes: list[str] = []

    def session(_rig: Rig, scene: Scene, **_options: object) -> None:
        scenes.append(scene.name)
        raise KeyboardInterrupt

    monkeypatch.setattr(jog_latency, "drives", nullcontext)
    monkeypatch.setattr(jog_latency, "jog_session", session)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, "argv", ["jog_latency.py", "--scene", "configs/environment_2.yaml"])
    with pytest.raises(KeyboardInterrupt):
        jog_latency.main()
    assert scenes == ["environment_2"]
