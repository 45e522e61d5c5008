"""The wrench of weight: sign, lever arm, payload."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.errors import BadInput
from model.statics.gravity import STANDARD_GRAVITY, gravity_wrench

metres = st.floats(-1.0, 1.0)
offsets = st.tuples(metres, metres, metres)
masses = st.floats(0.0, 100.0)


def test_the_paper_s_cube_weighs_3_92_newtons_downward():
    expected = [0.0, 0.0, -0.4 * 9.80665, 0.0, 0.0, 0.0]
    np.testing.assert_allclose(gravity_wrench(0.4, (0.0, 0.0, 0.0)), expected, rtol=1e-15)


@given(mass=masses, offset=offsets, payload_mass=masses, payload_offset=offsets)
def test_moments_are_those_of_each_weight_at_its_own_centre(
    mass, offset, payload_mass, payload_offset
):
    wrench = gravity_wrench(mass, offset, payload_mass=payload_mass, payload_offset=payload_offset)
    down = np.array([0.0, 0.0, -STANDARD_GRAVITY])
    moment = np.cross(offset, mass * down) + np.cross(payload_offset, payload_mass * down)
    np.testing.assert_allclose(wrench[:3], (mass + payload_mass) * down, rtol=1e-12)
    np.testing.assert_allclose(wrench[3:], moment, rtol=1e-12, atol=1e-9)


def test_a_batch_of_offsets_gives_a_wrench_each():
    arms = np.random.default_rng(1).normal(size=(4, 5, 3))
    wrenches = gravity_wrench(2.0, arms, payload_mass=1.0, payload_offset=(0.1, 0.0, 0.0))
    assert wrenches.shape == (4, 5, 6)
    single = gravity_wrench(2.0, arms[3, 2], payload_mass=1.0, payload_offset=(0.1, 0.0, 0.0))
    np.testing.assert_array_equal(wrenches[3, 2], single)


@pytest.mark.parametrize(
    ("mass", "offset"),
    [(-1.0, np.zeros(3)), (np.nan, np.zeros(3)), (1.0, np.full(3, np.inf)), (1.0, np.zeros(2))],
)
def test_unusable_loads_are_refused(mass, offset):
    with pytest.raises(BadInput, match="of the platform"):
        gravity_wrench(mass, offset)
    with pytest.raises(BadInput, match="of the payload"):
        gravity_wrench(1.0, np.zeros(3), payload_mass=mass, payload_offset=offset)
