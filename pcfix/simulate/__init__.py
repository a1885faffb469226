"""Scenes with known truth, traced by code that shares nothing with `pcfix.refract`."""

from pcfix.simulate.scene import Scene, simulate_scene

__all__ = ["Scene", "simulate_scene"]
