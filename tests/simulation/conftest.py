"""Rigs for the simulation's tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from model.rig import Rig, load_rig

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


@pytest.fixture(scope="session")
def rig() -> Rig:
    return load_rig(CONFIGS / "gachon_8_6.yaml")


@pytest.fixture(scope="session")
def pulley_rig() -> Rig:
    return load_rig(CONFIGS / "hall_10_6.yaml")
