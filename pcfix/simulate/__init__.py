"""Scenes with known truth, traced by code that shares nothing with `pcfix.refract`."""

from pcfix.simulate.scene import Scene, simulate_scene
from pcfix.simulate.settings import SceneSettings

__all__ = ["Scene", "SceneSettings", "simulate_scene"]
