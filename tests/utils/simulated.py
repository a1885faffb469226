"""Simulated scenes that several files of tests look at: each is made once."""

from functools import lru_cache

from tests.utils.matchers import matched_scene

simulated = lru_cache(maxsize=8)(matched_scene)
