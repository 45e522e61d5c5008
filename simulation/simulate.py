"""The simulated rig for the drives that a rig file names."""

from __future__ import annotations

from typing import Any

import can

from cdpr.poses import Pose
from cdpr.rig import Rig
from cdpr.scene import Load
from simulation.simulated_rig import SimulatedRig


def make_rehearsal(
    rig: Rig, bus: can.BusABC, start_pose: Pose, load: Load | None = None
) -> SimulatedRig[Any]:
    """Simulated drives of a rig's kind; arguments and errors as for `SimulatedRig`."""
    # The protocol's library is loaded only for those who need it.
    if rig.document.drives.type == "odrive":
        from simulation.odrive_rehearsal import OdriveRehearsal

        return OdriveRehearsal(rig, bus, start_pose, load)
    from simulation.rehearsal import Rehearsal

    return Rehearsal(rig, bus, start_pose, load)
