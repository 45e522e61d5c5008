"""What the platform carries, and what picking up and putting down make of it.

In the units of the scene file, where it comes from and goes back to.
"""

from __future__ import annotations

from dataclasses import dataclass

NOTHING_KG = 1e-9
"""Less than this is nothing."""
SAME_PLACE_MM = 1e-3
"""Centres nearer to each other than this are one."""

Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Payload:
    """A mass on the platform.

    Attributes:
        mass_kg: [kg].
        centre_mm: Its centre in the platform frame; the origin when there is no mass.
    """

    mass_kg: float
    centre_mm: Point

    def with_mass(self, mass_kg: float, centre_mm: Point) -> Payload:
        """After a mass was taken up whose centre is there."""
        whole = self.mass_kg + mass_kg
        return Payload(whole, self._centre(mass_kg, centre_mm, whole))

    def without_mass(self, mass_kg: float, centre_mm: Point | None) -> Payload:
        """After a mass was put down whose centre was there, or where the whole payload's is.

        Raises:
            ValueError: It is more than is carried, or all of it with its centre elsewhere.
        """
        rest = self.mass_kg - mass_kg
        if rest < -NOTHING_KG:
            raise ValueError(f"puts down {mass_kg:g} kg, but {self.mass_kg:g} kg are carried then")
        if rest > NOTHING_KG:
            return Payload(rest, self._centre(-mass_kg, centre_mm or self.centre_mm, rest))
        away = [
            abs(a - b) for a, b in zip(centre_mm or self.centre_mm, self.centre_mm, strict=True)
        ]
        if max(away) > SAME_PLACE_MM:
            x, y, z = self.centre_mm
            raise ValueError(
                f"puts down all that is carried, and its centre is at [{x:g}, {y:g}, {z:g}] mm"
            )
        return Payload(0.0, (0.0, 0.0, 0.0))

    def _centre(self, mass_kg: float, centre_mm: Point, whole_kg: float) -> Point:
        """Where the centre is with a mass more (or less); to a nanometre, as poses are written."""
        x, y, z = (
            round((self.mass_kg * own + mass_kg * other) / whole_kg, 6) + 0.0
            for own, other in zip(self.centre_mm, centre_mm, strict=True)
        )
        return x, y, z
