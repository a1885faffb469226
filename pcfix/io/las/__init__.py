"""LAS and LAZ: in by chunks, out by chunks, nothing lost on the way."""

from pcfix.io.las.sink import LasSink
from pcfix.io.las.source import LasSource

__all__ = ["LasSink", "LasSource"]
