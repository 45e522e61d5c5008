"""The SYNC time-out of drives, and the age of SYNC from which none may be enabled."""

from __future__ import annotations

from dataclasses import dataclass

# Limit on the age of the last SYNC when drives are commanded to follow a set-point.
#
# A drive that misses SYNC stops on its own, and "enable operation" (0Fh) takes it out of that stop
# again: CiA 402 transition 16 is level-triggered. So the sender of 0Fh must know that no drive has
# stopped meanwhile. A drive stops `timeout` periods after the SYNC that it received last; the age
# of that SYNC is measured here from just before it was sent, so it is never less than the drive's.
#
# The arithmetic, in periods, for a cycle that begins L periods late:
#
#     age = 1 + L                         the last SYNC belongs to the cycle before
#     limit = timeout - margin            0Fh is not sent from this age on
#     margin = min(1/2, (timeout - 1)/2)
#
# The margin covers what is not measured: the new SYNC waits for the set-points before it and for
# one foreign frame, at most 0.7 periods at the largest bus load that arming allows minus the same
# wait of the previous SYNC; and the drives' clocks. A drive that tolerates 1.5 periods leaves only
# half a period in all; half of it is the margin.
#
# Source: CiA 301 (communication cycle period, 1006h), CiA 402-2 (transition 16). Pure.


#: Time-out of drive groups without SYNC, in periods; that of CANopen drives is in their profile,
#: as `sync_timeout_periods`.
USUAL_TIMEOUT = 3.0
#: Shortest time-out of a drive that can be kept enabled, in periods.
LEAST_TIMEOUT = 1.1
#: The largest margin, in periods.
MARGIN = 0.5
#: Age from which a late cycle is reported and causes a path stop, in periods.
LATE_AGE = 2.0


@dataclass(frozen=True, slots=True)
class SyncAge:
    """Limit on the age of SYNC for drives with a common time-out.

    Attributes:
        timeout: Periods without SYNC after which a drive stops on its own, at least 1.1.
    """

    timeout: float = USUAL_TIMEOUT

    def __post_init__(self) -> None:
        """Refuses a time-out that no cycle could meet.

        Raises:
            ValueError: It is not longer than one period by enough.
        """
        if not self.timeout >= LEAST_TIMEOUT:
            raise ValueError(
                f"drives that stop after {self.timeout} periods cannot be kept enabled"
            )

    @property
    def margin(self) -> float:
        """Margin before the time-out, in periods."""
        return min(MARGIN, (self.timeout - 1.0) / 2.0)

    @property
    def limit(self) -> float:
        """Age of the last SYNC from which no drive is commanded to follow, in periods."""
        return self.timeout - self.margin

    def may_enable(self, age: float) -> bool:
        """Whether 0Fh may be sent with the next SYNC; False for NaN."""
        return age < self.limit
