"""How much is tried: little of each property by default, much of it at night (tests/README.md)."""

from __future__ import annotations

from hypothesis import settings

settings.register_profile("default", max_examples=20, deadline=None)
settings.register_profile("nightly", max_examples=250, deadline=None)
settings.load_profile("default")
