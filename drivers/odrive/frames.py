"""The frames that a master of ODrives sends, built from the layouts of the DBC file. No bus."""

from __future__ import annotations

from collections.abc import Sequence

import can

from cdpr.rig import Rig
from drivers.bus import SentFrame
from drivers.odrive.dbc import Layout, Layouts
from drivers.odrive.messages import AxisState, can_id


class OdriveFrames:
    """One frame a drive, to be sent back to back: no SYNC makes them count together."""

    def __init__(self, rig: Rig, layouts: Layouts) -> None:
        """Takes nodes, counts and cycle from the rig."""
        self._nodes = tuple(winch.node_id for winch in rig.winches)
        self._per_turn = tuple(winch.counts_per_turn for winch in rig.winches)
        self._cycle = rig.document.bus.cycle_ms / 1000.0
        self._layouts = layouts

    def set_points(self, targets: Sequence[int], before: Sequence[int]) -> list[can.Message]:
        """Positions, with their speed as feed-forward; they feed the watchdogs.

        Args:
            targets: Shape (m,), [counts].
            before: Of the cycle before, shape (m,), [counts].
        """
        layout = self._layouts.set_input_pos
        return [
            self._frame(
                node, layout, target / per_turn, (target - last) / per_turn / self._cycle, 0.0
            )
            for node, per_turn, target, last in zip(
                self._nodes, self._per_turn, targets, before, strict=True
            )
        ]

    def axis_states(self, state: AxisState) -> list[can.Message]:
        """Tells every drive to go to a state."""
        return [self._frame(node, self._layouts.set_axis_state, state) for node in self._nodes]

    def clear_errors(self) -> list[can.Message]:
        """Takes the errors off every drive."""
        return [self._frame(node, self._layouts.clear_errors, 0) for node in self._nodes]

    def _frame(self, node: int, layout: Layout, *values: float) -> can.Message:
        return SentFrame(can_id(node, layout.command), layout.pack(*values))
