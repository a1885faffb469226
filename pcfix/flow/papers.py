"""Work out the effect of refraction and the tables of papers, and write them into a folder.

What ``pcfix simulate --refraction-effect`` runs. One table is that of Hsu & Wang, remade on the
simulated flume: error by depth, method by method.

The paper was not at hand; the methods are read as follows, depths from the water surface, D true
and d apparent.

=========== =====================================================================================
uncorrected D = d
I           D = n d
II          Snell's law along the line of sight of each camera that made the point, at the place of
            the apparent point; the mean of their depths (Dietrich 2017): D = d tan r / tan i,
            sin r = n sin i, r from the vertical
III         D = a + b d, fitted by least squares to check points of known depth, which are then
            left out of the table
pcfix       `pcfix.correct_points` with the cameras that made each point
=========== =====================================================================================

Methods I to III change the height only. The error is that of the height of each point against its
own true position, not against the bed below or above it.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np

from pcfix.errors import SettingError
from pcfix.flow.correct import correct_points
from pcfix.flow.runner import json_text
from pcfix.io.files import check_output, write_bytes
from pcfix.model import BoolArray, FloatArray, IntArray
from pcfix.options.declare import File
from pcfix.options.scenes import SimulateOptions
from pcfix.report import papers
from pcfix.report.page import png_of
from pcfix.simulate.flume import Flume, simulate_flume
from pcfix.simulate.refraction_effect import (
    APPARENT_DEPTHS_M,
    FLYING_HEIGHTS_M,
    OVERLAP,
    AerialCamera,
    Effect,
    effects,
    shan_iterations,
)
from pcfix.version import __version__
from pcfix.water.index import index_of

BIN_M = 0.1
CHECKS_PER_BIN = 10
CHECK_SD_M = 0.002  # of a depth read from a point gauge
PUBLISHED = (
    "published (Skarlatos & Agrafiotis 2018) for the SwingletCAM from 100 m, 80 %, 15 m: centre"
    " -5.15 m, corner -8.23 m"
)


def write_refraction_effect(out_dir: File, options: SimulateOptions) -> str:
    """Write tables, settings and pictures, and return a short text about them.

    Parameters
    ----------
    out_dir : path
    options : SimulateOptions
        Those called effect_..., index and seed. Without a camera of one's own the two of
        Skarlatos & Agrafiotis (2018) are taken.

    Raises
    ------
    SettingError
        If an argument is outside its rule, or a file exists and `overwrite` is not set; then
        none is written.
    """
    camera, overlap = _camera(options), options.effect_overlap or OVERLAP
    apparent_depths_m = options.effect_depths or APPARENT_DEPTHS_M
    index, seed = index_of(options.index)[0], options.seed
    heights = {
        one: options.effect_heights or FLYING_HEIGHTS_M.get(one, (50.0, 100.0, 200.0))
        for one in ([camera] if camera else FLYING_HEIGHTS_M)
    }
    found = effects(heights, apparent_depths_m, overlap=overlap, refractive_index=index)
    deepest = max(one.apparent_depth_m for one in found)
    pairs = dict.fromkeys(one.pair for one in found)
    shan = {pair: shan_iterations(pair, deepest, index) for pair in pairs}
    bins = depth_bins(simulate_flume(refractive_index=index, seed=seed))
    settings = {
        "made_by": f"pcfix {__version__}",
        "cameras": [asdict(one) | {"flying_heights_m": h} for one, h in heights.items()],
        "overlap": overlap,
        "apparent_depths_m": apparent_depths_m,
        "refractive_index": index,
        "seed": seed,
    }
    files = _pictures(found, bins, deepest) | {
        "refraction_effect.csv": papers.csv_text(papers.effect_rows(found)).encode(),
        "shan_iterations.csv": papers.csv_text(
            [row for pair, table in shan.items() for row in papers.shan_rows(pair, table)]
        ).encode(),
        "flume_depth_bins.csv": papers.csv_text(papers.depth_bins_rows(bins)).encode(),
        "refraction_effect.json": json_text(settings).encode(),
    }
    _write(Path(out_dir), files, options.overwrite)
    pair, table = list(shan.items())[len(next(iter(heights.values()))) // 2]
    shan_lines = papers.shan_text(pair, table, max(apparent_depths_m))
    parts = [papers.effect_text(found), shan_lines, papers.depth_bins_text(bins)]
    if camera is None:
        parts[0] += f"\n{PUBLISHED}"
    return "\n\n".join([*parts, f"{out_dir}: {', '.join(sorted(files))}"])


def _camera(options: SimulateOptions) -> AerialCamera | None:
    """Return the camera of one's own, where one is given."""
    focal, frame = options.effect_focal_mm, options.effect_frame_px
    pixel = options.effect_pixel_um
    if focal is None and frame is None and pixel is None:
        return None
    if focal is None or frame is None or pixel is None:
        raise SettingError(
            "a camera needs --effect-focal-mm, --effect-frame-px and --effect-pixel-um; give all"
            " three."
        )
    return AerialCamera("camera", focal, *frame, pixel)


def _pictures(found: list[Effect], bins: papers.DepthBins, deepest: float) -> dict[str, bytes]:
    figures = {"refraction_effect_depth.png": papers.depth_figure(found)}
    for camera in dict.fromkeys(one.pair.camera for one in found):
        own = [f for f in found if f.pair.camera == camera and f.apparent_depth_m == deepest]
        figures[f"refraction_effect_{camera.name.lower()}.png"] = papers.error_map_figure(own)
    figures["flume_depth_bins.png"] = papers.depth_bins_figure(bins)
    return {name: png_of(figure) for name, figure in figures.items()}


def _write(folder: Path, files: dict[str, bytes], overwrite: bool) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in files:
        check_output(folder / name, overwrite=overwrite)
    for name, data in files.items():
        write_bytes(folder / name, data, overwrite=overwrite)


def depth_bins(flume: Flume, seed: int = 1) -> papers.DepthBins:
    """Correct the flume's cloud by every method and return the errors by depth."""
    bins = int(np.ceil(flume.true_depth_m.max() / BIN_M - 1e-9))
    edges = BIN_M * np.arange(bins + 1)
    which = np.clip(np.digitize(flume.true_depth_m, edges) - 1, 0, bins - 1)
    rng = np.random.default_rng(seed)
    check = _check_points(which, rng)
    slope, offset, r2 = _regression(flume, check, rng)
    corrected = correct_points(
        flume.apparent_xyz, flume.cameras, flume.water_level_m, index=flume.refractive_index,
        views=flume.views,
    )  # fmt: skip
    estimates = [
        flume.apparent_depth_m,
        flume.refractive_index * flume.apparent_depth_m,
        mean_of_cameras(flume),
        offset + slope * flume.apparent_depth_m,
        flume.water_level_m - corrected.xyz[:, 2],
    ]
    errors = flume.true_depth_m[:, None] - np.column_stack(estimates)
    groups = [(which == i) & ~check for i in range(bins)]
    rows = [errors[group] for group in [*groups, ~check]]
    return papers.DepthBins(
        edges_m=np.asarray(edges, dtype=np.float64),
        points=np.array([group.sum() for group in groups]),
        rmse_m=np.array([np.sqrt((row**2).mean(axis=0)) for row in rows]),
        mean_m=np.array([row.mean(axis=0) for row in rows]),
        offset_m=offset,
        slope=slope,
        r2=r2,
    )


def _check_points(which: IntArray, rng: np.random.Generator) -> BoolArray:
    """Choose the same number of points from every bin."""
    check = np.zeros(len(which), dtype=bool)
    for i in range(int(which.max()) + 1):
        own = np.flatnonzero(which == i)
        check[rng.choice(own, min(CHECKS_PER_BIN, len(own) // 2), replace=False)] = True
    return check


def _regression(
    flume: Flume, check: BoolArray, rng: np.random.Generator
) -> tuple[float, float, float]:
    """Return slope, offset and r^2 of the measured depth of the check points on the apparent."""
    apparent = flume.apparent_depth_m[check]
    measured = flume.true_depth_m[check] + rng.normal(0.0, CHECK_SD_M, len(apparent))
    slope, offset = np.polyfit(apparent, measured, 1)
    return float(slope), float(offset), float(np.corrcoef(apparent, measured)[0, 1] ** 2)


def mean_of_cameras(flume: Flume) -> FloatArray:
    """Return the depth by method II, shape (n,)."""
    counts = np.diff(flume.views.start)
    owner = np.repeat(np.arange(len(counts)), counts)
    sight = flume.cameras.centres[flume.views.camera] - flume.apparent_xyz[owner]
    r = np.arctan2(np.hypot(sight[:, 0], sight[:, 1]), sight[:, 2])
    i = np.arcsin(np.sin(r) / flume.refractive_index)
    ratio = np.divide(
        np.tan(r), np.tan(i), out=np.full(len(r), flume.refractive_index), where=i > 0
    )
    return np.asarray(flume.apparent_depth_m * np.bincount(owner, ratio) / counts)
