"""How old the last SYNC may be when drives are commanded to follow a set-point.

A drive that misses SYNC stops by itself, and "enable operation" (0Fh) takes it out of that stop
again: CiA 402 transition 16 acts by level. So the sender of 0Fh must know that no drive has stopped
meanwhile. A drive stops `timeout` periods after the SYNC that it received last; the age of that
SYNC is measured here from just before it was sent, which is never less than what the drive counts.

The arithmetic, in periods, for a cycle that begins L periods late:

    age = 1 + L                         the last SYNC belongs to the cycle before
    limit = timeout - margin            from this age on 0Fh is not sent
    margin = min(1/2, (timeout - 1)/2)

The margin covers what the measurement cannot see: the new SYNC waits for the set-points before it
and for one foreign frame, at most 0.7 periods at the largest bus load that arming allows minus the
same wait of the SYNC before, and the drives' own clocks. A drive that tolerates 1.5 periods leaves
only half a period in all; half of it is kept.

Source: CiA 301 (communication cycle period, 1006h), CiA 402-2 (transition 16). Pure.
"""

from __future__ import annotations

from dataclasses import dataclass

#: Periods without SYNC after which drives stop by themselves unless their profile says otherwise.
USUAL_TIMEOUT = 3.0
#: A drive less patient than this could not be kept going, in periods.
LEAST_TIMEOUT = 1.1
#: The largest margin, in periods.
MARGIN = 0.5
#: Age from which the operator hears of a late cycle and the motion stops along the path, periods.
LATE_AGE = 2.0


@dataclass(frozen=True, slots=True)
class SyncAge:
    """The rule for drives with one time-out.

    Attributes:
        timeout: Periods without SYNC after which a drive stops by itself, at least 1.1.
    """

    timeout: float = USUAL_TIMEOUT

    def __post_init__(self) -> None:
        """Refuses a time-out that no cycle could keep.

        Raises:
            ValueError: It leaves no room beside one period.
        """
        if not self.timeout >= LEAST_TIMEOUT:
            raise ValueError(
                f"drives that stop after {self.timeout} periods cannot be kept enabled"
            )

    @property
    def margin(self) -> float:
        """Kept before the time-out, in periods."""
        return min(MARGIN, (self.timeout - 1.0) / 2.0)

    @property
    def limit(self) -> float:
        """From this age of the last SYNC on no drive is commanded to follow, in periods."""
        return self.timeout - self.margin

    def may_enable(self, age: float) -> bool:
        """Whether 0Fh may be sent with the next SYNC; not when the age is no number."""
        return age < self.limit
