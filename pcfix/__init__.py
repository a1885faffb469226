"""Refraction correction of through-water photogrammetric point clouds.

The names here are the whole public interface; each is loaded when it is first used, so that
``import pcfix`` is quick.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from pcfix.version import __version__

if TYPE_CHECKING:
    from pcfix.clean.points import clean_points
    from pcfix.errors import GeometryError, InputError, PcfixError, PcfixWarning, SettingError
    from pcfix.flow.clean import clean_file
    from pcfix.flow.compare import compare_clouds
    from pcfix.flow.dsm import grid_dsm
    from pcfix.flow.files import correct_file
    from pcfix.flow.points import correct_points
    from pcfix.flow.restore import restore_file
    from pcfix.io.cameras import read_cameras
    from pcfix.io.water import read_water
    from pcfix.model import (
        Cameras,
        Correction,
        Lens,
        Outcome,
        Summary,
        Views,
        WaterDimension,
        WaterMesh,
        WaterPlane,
        WaterSurface,
    )
    from pcfix.options import ErrorBudget, Settings
    from pcfix.refract.tracing import trace
    from pcfix.simulate import simulate_scene
    from pcfix.water.index import refractive_index


_HOME = {
    "clean_file": "pcfix.flow.clean",
    "clean_points": "pcfix.clean.points",
    "compare_clouds": "pcfix.flow.compare",
    "grid_dsm": "pcfix.flow.dsm",
    "adjust_cameras": "pcfix.flow.adjust",
    "correct_file": "pcfix.flow.files",
    "correct_points": "pcfix.flow.points",
    "restore_file": "pcfix.flow.restore",
    "label_file": "pcfix.flow.label",
    "label_points": "pcfix.flow.label",
    "ErrorBudget": "pcfix.options",
    "LabelSettings": "pcfix.options",
    "WaterRaster": "pcfix.model",
    "read_cameras": "pcfix.io.cameras",
    "refractive_index": "pcfix.water.index",
    "read_water": "pcfix.io.water",
    "simulate_scene": "pcfix.simulate",
    "trace": "pcfix.refract.tracing",
    "Cameras": "pcfix.model",
    "Correction": "pcfix.model",
    "Lens": "pcfix.model",
    "Outcome": "pcfix.model",
    "Settings": "pcfix.options",
    "Summary": "pcfix.model",
    "Views": "pcfix.model",
    "WaterDimension": "pcfix.model",
    "WaterMesh": "pcfix.model",
    "WaterPlane": "pcfix.model",
    "WaterSurface": "pcfix.model",
    "PcfixError": "pcfix.errors",
    "InputError": "pcfix.errors",
    "SettingError": "pcfix.errors",
    "GeometryError": "pcfix.errors",
    "PcfixWarning": "pcfix.errors",
}

__all__ = [
    "Cameras",
    "Correction",
    "ErrorBudget",
    "GeometryError",
    "InputError",
    "LabelSettings",
    "Lens",
    "Outcome",
    "PcfixError",
    "PcfixWarning",
    "SettingError",
    "Settings",
    "Summary",
    "Views",
    "WaterDimension",
    "WaterMesh",
    "WaterPlane",
    "WaterRaster",
    "WaterSurface",
    "__version__",
    "adjust_cameras",
    "clean_file",
    "clean_points",
    "compare_clouds",
    "correct_file",
    "correct_points",
    "grid_dsm",
    "label_file",
    "label_points",
    "read_cameras",
    "read_water",
    "refractive_index",
    "restore_file",
    "simulate_scene",
    "trace",
]


def __getattr__(name: str) -> Any:
    """Load a public name from its home."""
    if name not in _HOME:
        raise AttributeError(f"module 'pcfix' has no attribute '{name}'")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return __all__
