"""The motor of a simulated drive."""

from __future__ import annotations

from hypothesis import example, given
from hypothesis import strategies as st

from simulation.drives.power import Motor

SPEEDS = st.floats(-1e7, 1e7, allow_nan=False)


@given(speed=SPEEDS, elapsed=st.floats(1e-4, 0.1), deceleration=st.floats(1e3, 1e9))
@example(speed=1.0706684e-317, elapsed=0.01, deceleration=6361361.066666666)
def test_a_motor_that_slows_down_comes_to_rest(
    speed: float, elapsed: float, deceleration: float
) -> None:
    """Whole, however little speed was left: drives leave their fault reaction by it."""
    motor = Motor(position=0.0, demand=0.0, top_speed=1e9, speed=speed)
    time = abs(speed) / deceleration
    motor.ramp_down(deceleration, elapsed, 0)
    assert abs(motor.speed) <= abs(speed)
    motor.ramp_down(deceleration, time + elapsed, 0)
    assert motor.speed == 0.0
