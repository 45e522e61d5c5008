"""What the synthetic camera's lens and sensor do to a picture."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Optics:
    """What lens, sensor and lamp do to brightness, and whether cables are in the way.

    Attributes:
        noise: Standard deviation, [grey levels of 255].
        vignetting: Light lost in the corners of the picture, share of 1.
        blur: Standard deviation of the lens's and focus's blur, [px].
        exposure: Time for which the platform's motion is smeared, [s]; 0 for sharp pictures.
        light: Share of full light; less leaves less contrast, more overexposes.
        cables: Cables hide what is behind them.
    """

    noise: float = 1.5
    vignetting: float = 0.25
    blur: float = 0.0
    exposure: float = 0.0
    light: float = 1.0
    cables: bool = True
