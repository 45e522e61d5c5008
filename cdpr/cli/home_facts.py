"""What `cdpr home` shows before and after it moves."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

    from cdpr.rig import Camera, Rig
    from executor.reference import ReferenceDocument


def show_wish(
    rig: Rig,
    target: float,
    limit: float,
    reach: float,
    speed: float,
    eye: tuple[Camera, str] | None,
    on: Console,
) -> None:
    """What is going to happen; tensions in N, lengths in m."""
    from cdpr.cli.output import show_facts
    from executor.winch_laws import wind_in_speed

    fastest = wind_in_speed(rig, target, limit, speed).max() * 1000.0
    bus = rig.document.bus
    show_facts(
        "ready to wind in",
        [
            ("rig", rig.name),
            ("pretension", f"{target:g} N a cable, at most {limit:g} N"),
            ("winches", f"all together, at most {fastest:.2f} mm/s and {reach * 1000:g} mm each"),
            (
                "pose",
                "stated, held by a jig"
                if eye is None
                else f"measured, camera {eye[0].name} ({eye[1]})",
            ),
            ("bus", f"{bus.interface} {bus.channel}".strip()),
        ],
        on,
    )


def show_reference(reference: ReferenceDocument, where: str | None) -> None:
    """What came of it."""
    from cdpr.cli.output import out, show_facts

    x, y, z = reference.pose.position_mm
    tensions = reference.tensions_n
    facts: list[tuple[str, Any]] = [
        ("platform", f"{x:.2f}, {y:.2f}, {z:.2f} mm, {reference.how}"),
        ("uncertainty", f"{reference.uncertainty_mm:.3f} mm"),
        ("tensions", f"{min(tensions):.1f} to {max(tensions):.1f} N"),
        ("reference", where or "not kept: simulated drives end with this process"),
    ]
    show_facts("drives referenced; they hold", [(name, str(value)) for name, value in facts])
    out.print(
        "next: `cdpr jog RIG --to-home` or `--by-mm X Y Z`, then `cdpr plan` and `cdpr run`",
        soft_wrap=True,
    )
