"""The rig file's ``simulation`` section: deviations of a simulated rig from its rig file.

Only simulated drives, plant and cameras read it, so program and calibration know no more of a
simulated rig than of a real one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pydantic import Field

from model.files.camera_file import Gamma, Latency, LensName, TagDocument
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
    """True geometry of the simulated rig; absolute, so that no calibration changes it."""

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
    """Transmission from a simulated motor to its cable, and noise of measured torque."""

    backlash_mm: NonNegative = Field(
        default=0.0, description="cable length lost when a motor reverses (backlash)"
    )
    step_counts: Positive = Field(default=1.0, description="resolution of a drum's position")
    tension_noise_n: NonNegative = Field(
        default=0.0, description="standard deviation of tensions computed from torques"
    )


class LensDocument(Document):
    """True lens of a simulated camera."""

    fx_px: Positive
    fy_px: Positive
    cx_px: Number
    cy_px: Number
    distortion: Annotated[list[Number], Field(max_length=14)] = []
    lens: LensName = "pinhole"


class SimulatedCameraDocument(Document):
    """Simulated images of one of the rig's cameras."""

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
    latency_ms: Latency | None = Field(
        default=None, description="true latency; left out, as in `cameras`"
    )
    gamma: Gamma | None = Field(default=None, description="true gamma; left out, as in `cameras`")
    vignetting: Share = Field(default=0.25, description="share of light lost in the corners")
    light: Positive = Field(default=1.0, description="share of full light")
    cables: bool = Field(default=True, description="cables hide what is behind them")
    halo: Share = Field(default=0.0, description="light added by a lamp in view, share of white")
    shadow: Share = Field(default=0.0, description="share of light lost beyond a line in the image")
    sharpening: NonNegative = Field(default=0.0, description="by the camera, share of contrast")
    enlarged: Annotated[int, Field(ge=1, le=4)] = Field(
        default=1, description="ratio of rows and columns of the image to those of the sensor"
    )
    jpeg_quality: Annotated[int, Field(ge=1, le=100)] = Field(
        default=100, description="of compression; 100 for none"
    )


class SimulatedTagsDocument(Document):
    """True poses of tags, which no calibration changes; those left out are as in `tags`."""

    platform: list[TagDocument] = []
    frame: list[TagDocument] = []

    def misfits(self, known: Mapping[str, set[int]]) -> list[Finding]:
        """Tags that are not in `tags`.

        Args:
            known: Numbers of the platform's and the frame's tags.
        """
        return [
            (("simulation", "tags", part, k, "id"), f"`tags.{part}` has no tag {tag.id}")
            for part, tags in (("platform", self.platform), ("frame", self.frame))
            for k, tag in enumerate(tags)
            if tag.id not in known[part]
        ]


class SimulationDocument(Document):
    """Imperfections of a simulated rig; those left out are zero."""

    seed: Seed = Field(default=0, description="of all noise")
    as_built: AsBuiltDocument | None = None
    tags: SimulatedTagsDocument = SimulatedTagsDocument()
    winches: SimulatedWinchesDocument = SimulatedWinchesDocument()
    cameras: list[SimulatedCameraDocument] = []

    def misfits(self, cables: int, pulleys: bool, cameras: Mapping[str, float]) -> list[Finding]:
        """Mismatches with the rest of the rig file.

        Args:
            pulleys: Whether the rig has pulleys.
            cameras: Names of its cameras and their frame rates, [1/s].
        """
        found: list[Finding] = []
        if self.as_built is not None:
            section = ("simulation", "as_built")
            for key, values in self.as_built:
                if isinstance(values, list) and len(values) != cables:
                    what = f"needs {cables} entries, one per cable; it has {len(values)}"
                    found.append(((*section, key), what))
            if pulleys != (self.as_built.pulley_radius_mm is not None):
                what = "needs pulley_radius_mm" if pulleys else "the rig has no pulleys"
                found.append(((*section, "pulley_radius_mm"), what))
        names = [camera.name for camera in self.cameras]
        for i, name in enumerate(names):
            name_key = ("simulation", "cameras", i, "name")
            if name not in cameras:
                found.append((name_key, f"unknown camera {name!r}"))
            elif name in names[:i]:
                found.append((name_key, f"camera {name!r} appears twice"))
            elif self.cameras[i].exposure_ms > 1000.0 / cameras[name]:
                what = f"the exposure exceeds the frame period at {cameras[name]:g} images/s"
                found.append((("simulation", "cameras", i, "exposure_ms"), what))
        return found
