"""Benchmarks refuse what they cannot measure, before they keep the machine busy."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from benchmarks import realtime


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
