"""How each quantity is shown: its title, unit, column name, colours and the limit that matters."""

from __future__ import annotations

from dataclasses import dataclass

from planner.workspace.computing import Maps


@dataclass(frozen=True, slots=True)
class Shown:
    """How a quantity is shown.

    Attributes:
        name: In `Maps.values`.
        title: For people.
        unit: With which it is shown; empty for none.
        column: Its name in tables, unit included.
        scale: From SI to the unit.
        colours: Name of a matplotlib colour map; bright where the robot is better off.
    """

    name: str
    title: str
    unit: str
    column: str
    scale: float
    colours: str

    @property
    def label(self) -> str:
        """Title and unit."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title


SHOWN = (
    Shown("closure_margin", "wrench closure margin", "", "closure_margin", 1.0, "viridis"),
    Shown("capacity_margin", "capacity margin", "N", "capacity_margin_n", 1.0, "viridis"),
    Shown("condition_number", "condition number", "", "condition_number", 1.0, "viridis_r"),
    Shown("force_volume", "volume of forces", "N³", "force_volume_n3", 1.0, "viridis"),
    Shown("dexterity_cost", "dexterity cost", "", "dexterity_cost", 1.0, "viridis_r"),
    Shown("wrench_cost", "wrench cost", "", "wrench_cost", 1.0, "viridis_r"),
    Shown("cost", "kinematic cost", "", "kinematic_cost", 1.0, "viridis_r"),
    Shown("self_clearance", "self clearance", "mm", "self_clearance_mm", 1e3, "cividis"),
    Shown(
        "obstacle_clearance", "obstacle clearance", "mm", "obstacle_clearance_mm", 1e3, "cividis"
    ),
)


def shown_in(maps: Maps) -> tuple[Shown, ...]:
    """Those that the maps have."""
    return tuple(quantity for quantity in SHOWN if quantity.name in maps.values)


def limit_of(maps: Maps, quantity: Shown) -> float | None:
    """The smallest allowed value, in the unit shown; None for what only has better and worse."""
    scene = maps.question.scene
    limits = {
        "closure_margin": 0.0,
        "capacity_margin": 0.0,
        "self_clearance": scene.self_clearance if scene else 0.0,
        "obstacle_clearance": scene.obstacle_clearance if scene else 0.0,
    }
    limit = limits.get(quantity.name)
    return None if limit is None else limit * quantity.scale
