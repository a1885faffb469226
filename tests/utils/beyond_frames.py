"""Clouds and blocks of tests that are wider, or deeper, than any that was photographed."""

import pytest

# Points at random, many of them in one frame or none.
BEYOND_FRAMES = pytest.mark.filterwarnings(
    "ignore:.*in fewer than two frames:pcfix.errors.PcfixWarning"
)
DEEP = pytest.mark.filterwarnings("ignore:.*deeper than 30 m:pcfix.errors.PcfixWarning")
