"""Write the effect of refraction, and the tables of papers, into a folder.

What ``pcfix simulate --refraction-effect`` runs. One table is that of Hsu & Wang's experiment,
simulated: error by depth and method.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from pcfix.errors import SettingError
from pcfix.flow.correct import correct_points
from pcfix.flow.runner import json_text
from pcfix.io.atomic import all_or_none, output_folder
from pcfix.io.files import check_output, write_bytes
from pcfix.options.declare import File
from pcfix.options.scenes import SimulateOptions
from pcfix.report import papers
from pcfix.report.page import png_of
from pcfix.simulate.hsu_wang import (
    METHODS,
    WATER_LEVEL_M,
    Bowl,
    DepthBins,
    depth_bins,
    simulate_bowl,
)
from pcfix.simulate.refraction_effect import (
    APPARENT_DEPTHS_M,
    FLYING_HEIGHTS_M,
    OVERLAP,
    OVERLAPS,
    PAPER_INDEX,
    AerialCamera,
    Effect,
    StereoPair,
    effects,
    shan_iterations,
)
from pcfix.version import __version__
from pcfix.water.index import index_of

HEIGHTS_M = (50.0, 100.0, 200.0)
"""Flying heights of a camera that the user gives."""


def write_refraction_effect(out_dir: File, options: SimulateOptions) -> str:
    """Write tables, settings and figures, and return a summary.

    Without a camera of the user's, those of Skarlatos & Agrafiotis (2018) are used.
    """
    camera, apparent_depths_m = _camera(options), options.effect_depths or APPARENT_DEPTHS_M
    index, seed = index_of(options.index, options.index_formula)[0], options.seed
    effect_index = PAPER_INDEX if camera is None and options.index is None else index
    flights = {
        one: {
            "flying_heights_m": options.effect_heights or FLYING_HEIGHTS_M.get(one, HEIGHTS_M),
            "overlaps": options.effect_overlap or OVERLAPS.get(one, (OVERLAP,)),
        }
        for one in ([camera] if camera else FLYING_HEIGHTS_M)
    }
    pairs = [
        StereoPair(one, height, overlap)
        for one, flight in flights.items()
        for overlap in flight["overlaps"]
        for height in flight["flying_heights_m"]
    ]
    found = effects(pairs, apparent_depths_m, effect_index)
    deepest = max(apparent_depths_m)
    shan = {pair: shan_iterations(pair, deepest, effect_index) for pair in pairs}
    bins = bowl_bins(simulate_bowl(refractive_index=index, seed=seed))
    settings = {
        "made_by": f"pcfix {__version__}",
        "cameras": [asdict(one) | flight for one, flight in flights.items()],
        "apparent_depths_m": apparent_depths_m,
        "refractive_index": effect_index,
        "refractive_index_bowl": index,
        "seed": seed,
    }
    files = _pictures(found, bins, deepest) | {
        "refraction_effect.csv": papers.csv_text(papers.effect_rows(found)).encode(),
        "shan_iterations.csv": papers.csv_text(
            [row for pair, table in shan.items() for row in papers.shan_rows(pair, table)]
        ).encode(),
        "bowl_depth_bins.csv": papers.csv_text(papers.depth_bins_rows(bins)).encode(),
        "refraction_effect.json": json_text(settings).encode(),
    }
    folder = Path(out_dir)
    with output_folder(folder), all_or_none():
        for name in files:
            check_output(folder / name, overwrite=options.overwrite)
        for name, data in files.items():
            write_bytes(folder / name, data, overwrite=options.overwrite)
    return f"{papers.effect_text(found)}\n{out_dir}: {', '.join(sorted(files))}"


def _camera(options: SimulateOptions) -> AerialCamera | None:
    """Return the camera of the user, if one is given."""
    focal, frame = options.effect_focal_mm, options.effect_frame_px
    pixel = options.effect_pixel_um
    if focal is None and frame is None and pixel is None:
        return None
    if focal is None or frame is None or pixel is None:
        raise SettingError(
            "option.missing",
            "A camera needs --effect-focal-mm, --effect-frame-px and --effect-pixel-um. Give all.",
        )
    return AerialCamera("camera", focal, *frame, pixel)


def _pictures(found: list[Effect], bins: DepthBins, deepest: float) -> dict[str, bytes]:
    figures = {"refraction_effect_depth.png": papers.depth_figure(found)}
    for camera in dict.fromkeys(one.pair.camera for one in found):
        own = [one for one in found if one.pair.camera == camera]
        deep = [one for one in own if one.apparent_depth_m == deepest]
        name = f"refraction_effect_{camera.name.lower()}"
        figures[f"{name}.png"] = papers.error_map_figure(deep)
        figures[f"{name}_bed.png"] = papers.bed_figure(deep)
        figures[f"{name}_stack.png"] = papers.stack_figure(own)
    figures["bowl_depth_bins.png"] = papers.depth_bins_figure(bins)
    return {name: png_of(figure) for name, figure in figures.items()}


def bowl_bins(bowl: Bowl) -> DepthBins:
    """Correct the bowl by every method, and return the errors by depth."""
    corrected = {
        name: correct_points(
            bowl.apparent_xyz, bowl.cameras, WATER_LEVEL_M, index=bowl.refractive_index,
            views=bowl.views, method=method,
        ).xyz
        for name, method in METHODS.items() if method
    }  # fmt: skip
    return depth_bins(bowl, corrected)
