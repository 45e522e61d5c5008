"""Benchmarks refuse what they cannot measure, before they keep the machine busy."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks import jog_latency, realtime
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
