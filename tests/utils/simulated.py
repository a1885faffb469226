"""Simulated scenes that several files of tests look at: each is made once."""

from functools import lru_cache

from pcfix.simulate.scene import simulate_scene

simulated = lru_cache(maxsize=8)(simulate_scene)
