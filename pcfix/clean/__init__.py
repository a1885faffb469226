"""Noise: which points of a cloud are none of the ground.

`clean_points` and `clean_file` are the doors; both run the arithmetic of this room.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pcfix.clean.settings import CleanSettings, CleanSummary, Reason
    from pcfix.flow.clean import clean_file
    from pcfix.flow.clean_points import clean_points

_HOME = {
    "CleanSettings": "pcfix.clean.settings",
    "CleanSummary": "pcfix.clean.settings",
    "Reason": "pcfix.clean.settings",
    "clean_file": "pcfix.flow.clean",
    "clean_points": "pcfix.flow.clean_points",
}

__all__ = ["CleanSettings", "CleanSummary", "Reason", "clean_file", "clean_points"]


def __getattr__(name: str) -> Any:
    """Load a public name from its home."""
    if name not in _HOME:
        raise AttributeError(f"module 'pcfix.clean' has no attribute '{name}'")
    return getattr(import_module(_HOME[name]), name)
