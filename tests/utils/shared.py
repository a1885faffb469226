"""Where the data for tests lies that is not part of the project."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCENE = ROOT / "samples" / "scene"
SHARED = Path(os.environ.get("PCFIX_SHARED", ROOT.parent / "shared"))
if not SHARED.is_absolute():
    SHARED = ROOT / SHARED


def needs(*parts):
    """Return a path of the shared data and a mark that skips where it is absent."""
    path = SHARED.joinpath("data", *parts)
    reason = f"no {'/'.join(parts)} in {SHARED / 'data'}; set PCFIX_SHARED to the folder with data/"
    return path, pytest.mark.skipif(not path.exists(), reason=reason)
