"""The two robots of `configs/` that most tests are about, read once for all of a process."""

from __future__ import annotations

from pathlib import Path

from model.rig import load_rig

CONFIGS = Path(__file__).parents[1] / "configs"
GACHON = load_rig(CONFIGS / "gachon_8_6.yaml")
HALL = load_rig(CONFIGS / "hall_10_6.yaml")
