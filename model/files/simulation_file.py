"""The rig file's ``simulation`` section: how a simulated rig differs from what its file says.

Simulated drives, plant and camera read it; nothing else does, so that program and calibration know
of a simulated rig what they know of a real one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pydantic import Field

from model.files.camera_file import LensName
from model.files.documents import (
    Document,
    Finding,
    NonNegative,
    Number,
    PoseDocument,
    Positive,
    Seed,
    Vector,
)

Share = Annotated[float, Field(ge=0.0, le=1.0)]


class AsBuiltDocument(Document):
    """The geometry that the simulated rig truly has; absolute, so that no calibration moves it."""

    outlets_mm: list[Vector]
    anchors_mm: list[Vector]
    drums_mm_per_rev: list[Positive]
    home_counts: list[Number] = Field(
        description="true drive positions with the platform at home under its working tensions"
    )
    pulley_radius_mm: Positive | None = None
    stiffness_n: list[Positive] | None = Field(
        default=None, description="E·A of each cable; left out, that of the rig file"
    )


class SimulatedWinchesDocument(Document):
    """What lies between a simulated motor and its cable, and how well torque is measured."""

    backlash_mm: NonNegative = Field(
        default=0.0, description="cable length lost when a motor reverses (backlash)"
    )
    step_counts: Positive = Field(default=1.0, description="resolution of a drum's position")
    tension_noise_n: NonNegative = Field(
        default=0.0, description="standard deviation of tensions computed from torques"
    )


class LensDocument(Document):
    """The lens that a simulated camera truly has."""

    fx_px: Positive
    fy_px: Positive
    cx_px: Number
    cy_px: Number
    distortion: Annotated[list[Number], Field(max_length=14)] = []
    lens: LensName = "pinhole"


class SimulatedCameraDocument(Document):
    """What the simulated images of one of the rig's cameras show."""

    name: Annotated[str, Field(min_length=1)] = Field(description="of the camera in `cameras`")
    lens: LensDocument | None = Field(default=None, description="left out, as in `cameras`")
    world_from_camera: PoseDocument | None = Field(
        default=None, description="true pose; left out, as in `cameras`"
    )
    noise: NonNegative = Field(default=1.5, description="standard deviation, grey levels of 255")
    blur_px: NonNegative = Field(default=0.0, description="standard deviation")
    exposure_ms: NonNegative = Field(
        default=0.0, description="motion blur over this time; 0 for none"
    )
    readout_ms: Annotated[float, Field(ge=-1000.0, le=1000.0)] | None = Field(
        default=None, description="true readout of the rows; left out, as in `cameras`"
    )
    vignetting: Share = Field(default=0.25, description="share of light lost in the corners")
    light: Positive = Field(default=1.0, description="share of full light")
    cables: bool = Field(default=True, description="cables hide what is behind them")
    halo: Share = Field(default=0.0, description="of a lamp in view: added there, share of white")
    shadow: Share = Field(default=0.0, description="share of light lost beyond a line in the image")
    sharpening: NonNegative = Field(default=0.0, description="as cameras do, share of the contrast")
    enlarged: Annotated[int, Field(ge=1, le=4)] = Field(
        default=1, description="how many times more rows and columns the image has than the sensor"
    )
    jpeg_quality: Annotated[int, Field(ge=1, le=100)] = Field(
        default=100, description="of compression; 100 for none"
    )


class SimulationDocument(Document):
    """Imperfections of a simulated rig; what is left out is perfect."""

    seed: Seed = Field(default=0, description="of all noise")
    as_built: AsBuiltDocument | None = None
    winches: SimulatedWinchesDocument = SimulatedWinchesDocument()
    cameras: list[SimulatedCameraDocument] = []

    def misfits(self, cables: int, pulleys: bool, cameras: Mapping[str, float]) -> list[Finding]:
        """What does not agree with the rest of the rig file.

        Args:
            cables: Number of outlets.
            pulleys: The rig has pulleys.
            cameras: Names of its cameras and how many images they take, [1/s].
        """
        found: list[Finding] = []
        if self.as_built is not None:
            place = ("simulation", "as_built")
            for key, values in self.as_built:
                if isinstance(values, list) and len(values) != cables:
                    what = f"needs {cables} entries, one a cable; it has {len(values)}"
                    found.append(((*place, key), what))
            if pulleys != (self.as_built.pulley_radius_mm is not None):
                what = "needs pulley_radius_mm" if pulleys else "the rig has no pulleys"
                found.append(((*place, "pulley_radius_mm"), what))
        names = [camera.name for camera in self.cameras]
        for i, name in enumerate(names):
            place_of_name = ("simulation", "cameras", i, "name")
            if name not in cameras:
                found.append((place_of_name, f"there is no camera {name!r}"))
            elif name in names[:i]:
                found.append((place_of_name, f"camera {name!r} appears twice"))
            elif self.cameras[i].exposure_ms > 1000.0 / cameras[name]:
                what = f"the exposure exceeds the frame period at {cameras[name]:g} pictures/s"
                found.append((("simulation", "cameras", i, "exposure_ms"), what))
        return found
