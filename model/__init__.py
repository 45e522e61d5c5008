"""The rig's model: description files, poses, kinematics, statics and clearance.

Pure functions and checked documents; nothing here plans, moves or measures.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from model.lazy import lazy_names

if TYPE_CHECKING:
    from model.clearance import ClearanceModel
    from model.errors import CdprError
    from model.kinematics import forward_kinematics
    from model.plan import Plan, load_plan
    from model.pose import Pose
    from model.posed_rig import PosedRig
    from model.rig import Rig, load_rig
    from model.scene import Scene, load_scene
    from model.statics.gravity import working_tensions

# Read by OpenCV when it is first imported: no image of any format is decoded beyond it, whatever
# its header states (`drivers.cameras.files` says so in words for the usual ones).
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**28))

__all__ = [
    "CdprError",
    "ClearanceModel",
    "Plan",
    "Pose",
    "PosedRig",
    "Rig",
    "Scene",
    "forward_kinematics",
    "load_plan",
    "load_rig",
    "load_scene",
    "working_tensions",
]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "model.clearance": "ClearanceModel",
            "model.errors": "CdprError",
            "model.kinematics": "forward_kinematics",
            "model.plan": "Plan load_plan",
            "model.pose": "Pose",
            "model.posed_rig": "PosedRig",
            "model.rig": "Rig load_rig",
            "model.scene": "Scene load_scene",
            "model.statics.gravity": "working_tensions",
        },
    )
