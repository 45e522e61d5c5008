"""Verdicts on a rig's calibration: rigs that were calibrated before, and errors of tensions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibration.geometry.calibrate import fit_rig
from calibration.geometry.identifiability import HeldOut
from calibration.geometry.parameters import DEFAULT_DEVIATIONS
from calibration.geometry.quality import judge_rig
from model.rig import Rig, load_rig
from tests.calibration.synthetic_rig import LENGTH_NOISE, BuiltRig, built_rig, measured, only

TILT = float(np.radians(5.0))


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(Path(__file__).parents[2] / "configs" / "hall_10_6.yaml")


def as_in_its_file(rig: Rig) -> BuiltRig:
    """A rig that was calibrated before."""
    off = built_rig(rig, 0).off
    return BuiltRig(rig, {group: np.zeros_like(values) for group, values in off.items()})


@pytest.mark.parametrize("seed", [1, 2])
def test_a_rig_as_in_its_file_passes_and_keeps_the_file(rig: Rig, seed: int) -> None:
    """The check of an earlier calibration with new data: a fit of 66 numbers cannot improve it."""
    data = only(measured(as_in_its_file(rig), 30, seed))
    quality = judge_rig(fit_rig(rig, data, DEFAULT_DEVIATIONS, LENGTH_NOISE), 2e-3, TILT)
    assert quality.held_out > quality.before
    assert quality.verdict.reasons == ()
    assert quality.verdict.next_steps[0].startswith("keep the rig file")


def test_a_calibration_that_is_worse_than_it_states_is_refused(rig: Rig) -> None:
    """Held-out samples contradict it by more than its interval."""
    data = only(measured(as_in_its_file(rig), 30, 1))
    found = fit_rig(rig, data, DEFAULT_DEVIATIONS, LENGTH_NOISE)
    stated = judge_rig(found, 2e-3, TILT).rotated
    for times, refused in ((0.9, False), (1.1, True)):
        before = found.held_out.before
        off = HeldOut(before, np.hypot(before, times * stated), poses=True)
        found.__dict__["held_out"] = off
        reasons = judge_rig(found, 2e-3, TILT).verdict.reasons
        assert any("fits better" in reason for reason in reasons) == refused
