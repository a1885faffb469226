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
    from pcfix.flow.adjust import adjust_cameras
    from pcfix.flow.calm import calm_frames
    from pcfix.flow.clean import clean_file
    from pcfix.flow.compare import compare_clouds
    from pcfix.flow.correct import correct_file, correct_points
    from pcfix.flow.dsm import grid_dsm
    from pcfix.flow.label import label_file, label_points
    from pcfix.flow.ortho import ortho_photo
    from pcfix.flow.photos import map_photos
    from pcfix.flow.plan import plan_flight
    from pcfix.flow.rebuild import rebuild_rounds
    from pcfix.flow.restore import restore_file
    from pcfix.flow.results import RunResults, open_run, run
    from pcfix.flow.view import view_clouds
    from pcfix.io.cameras import read_cameras
    from pcfix.io.water import read_water
    from pcfix.model import (
        Cameras,
        Correction,
        Lens,
        Outcome,
        Views,
        WaterDimension,
        WaterMesh,
        WaterPlane,
        WaterRaster,
        WaterSurface,
    )
    from pcfix.options.correct import CorrectOptions as Options
    from pcfix.refract.tally import Summary
    from pcfix.refract.tracing import trace
    from pcfix.simulate import simulate_scene
    from pcfix.water.index import refractive_index

_NAMES = {
    "pcfix.clean.points": "clean_points",
    "pcfix.errors": "GeometryError InputError PcfixError PcfixWarning SettingError",
    "pcfix.flow.adjust": "adjust_cameras",
    "pcfix.flow.calm": "calm_frames",
    "pcfix.flow.clean": "clean_file",
    "pcfix.flow.compare": "compare_clouds",
    "pcfix.flow.correct": "correct_file correct_points",
    "pcfix.flow.dsm": "grid_dsm",
    "pcfix.flow.label": "label_file label_points",
    "pcfix.flow.ortho": "ortho_photo",
    "pcfix.flow.photos": "map_photos",
    "pcfix.flow.plan": "plan_flight",
    "pcfix.flow.rebuild": "rebuild_rounds",
    "pcfix.flow.restore": "restore_file",
    "pcfix.flow.results": "RunResults open_run run",
    "pcfix.flow.view": "view_clouds",
    "pcfix.io.cameras": "read_cameras",
    "pcfix.io.water": "read_water",
    "pcfix.model": "Cameras Correction Lens Outcome Views WaterDimension WaterMesh"
    " WaterPlane WaterRaster WaterSurface",
    "pcfix.options.correct": "Options",
    "pcfix.refract.tally": "Summary",
    "pcfix.refract.tracing": "trace",
    "pcfix.simulate": "simulate_scene",
    "pcfix.water.index": "refractive_index",
}
_HOME = {name: home for home, names in _NAMES.items() for name in names.split()}

__all__ = [
    "Cameras",
    "Correction",
    "GeometryError",
    "InputError",
    "Lens",
    "Options",
    "Outcome",
    "PcfixError",
    "PcfixWarning",
    "RunResults",
    "SettingError",
    "Summary",
    "Views",
    "WaterDimension",
    "WaterMesh",
    "WaterPlane",
    "WaterRaster",
    "WaterSurface",
    "__version__",
    "adjust_cameras",
    "calm_frames",
    "clean_file",
    "clean_points",
    "compare_clouds",
    "correct_file",
    "correct_points",
    "grid_dsm",
    "label_file",
    "label_points",
    "map_photos",
    "open_run",
    "ortho_photo",
    "plan_flight",
    "read_cameras",
    "read_water",
    "rebuild_rounds",
    "refractive_index",
    "restore_file",
    "run",
    "simulate_scene",
    "trace",
    "view_clouds",
]


def __getattr__(name: str) -> Any:
    """Load a public name from its home."""
    if name not in _HOME:
        raise AttributeError(f"module 'pcfix' has no attribute '{name}'")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return __all__
