"""Write an orthophoto of land and bed, tile by tile."""

import time
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from pcfix.flow.inputs import paths_in
from pcfix.flow.photos import PhotoBlock, block_of, check_kind, finished
from pcfix.flow.runner import Progress, check_summary
from pcfix.grid.lattice import Lattice, lattice_over
from pcfix.io import rasters
from pcfix.io.clouds import is_cloud
from pcfix.io.files import scratch_folder
from pcfix.io.photographs import photographs_in, read_colours
from pcfix.model import WaterPlane
from pcfix.options.declare import File, taken
from pcfix.options.steps import OrthoOptions, PhotosOptions
from pcfix.photos.ortho import Picture, mosaic, picture_of
from pcfix.running import threads
from pcfix.sums import Figures


def ortho_photo(
    images: File,
    output: File,
    *,
    options: OrthoOptions | None = None,
    progress: Progress | None = None,
    **keywords: Any,
) -> Figures:
    """Write an orthophoto of land and bed on a DSM; what ``pcfix ortho`` runs.

    The file is a cloud optimised GeoTIFF in the CRS of the DSM, with the bands of the photographs
    and alpha, 0 where no photograph sees the cell. See `pcfix.photos.ortho`.

    Parameters
    ----------
    images : path
        Folder of JPEG, TIFF or PNG files of 8 or 16 bits.
    output : path
        The name ends in ``.tif`` or ``.tiff``.
    options, progress
        See `pcfix.correct_file`; original photographs need the option water, and progress is in
        cells.
    """
    started = time.perf_counter()
    given = taken(OrthoOptions, options, keywords, "ortho_photo")
    paths = photographs_in(Path(images))
    known = [*paths_in(given), *([given.dsm] if given.dsm else []), *paths]
    target = rasters.check_tif(output, overwrite=given.overwrite, inputs=known)
    check_summary(given, [*known, target])
    with threads(given.jobs), scratch_folder(target) as folder:
        # without water, its level is below all ground, so that every ray is straight
        water = WaterPlane(-100_000.0) if given.water is None else given.water
        coarse_m = None
        if given.resolution and is_cloud(Path(given.dsm)):
            coarse_m = 2.0 * given.resolution
        same = replace(given, water=water, resolution=coarse_m).part(PhotosOptions)
        block = block_of(same, paths, folder)
        # the cells over the DSM; their side is the ground pixel, rounded to two digits
        bed = block.scene.ground
        rows, columns = bed.height_m.shape
        low = np.array([bed.left_m, bed.top_m - rows * bed.cell_m])
        high = np.array([bed.left_m + columns * bed.cell_m, bed.top_m])
        side = given.resolution or float(f"{block.gsd_m:.1e}")
        lattice = lattice_over(low, high - 1e-6 * side, side, str(given.dsm))
        covered, ground = _write(block, lattice, given, target, progress)
    return finished(
        given,
        started,
        block.notes,
        output=str(target),
        images=len(block.photos),
        width=lattice.width,
        height=lattice.height,
        resolution_m=lattice.resolution_m,
        bounds_m=lattice.bounds_m,
        covered_share=round(covered / max(ground, 1), 5),  # of the cells over the DSM
        dsm=str(given.dsm),
        water=None if given.water is None else str(given.water),
    )


def _write(
    block: PhotoBlock, lattice: Lattice, given: OrthoOptions, path: Path, progress: Progress | None
) -> tuple[int, int]:
    """Write the raster, and return the number of cells with a colour and with a height."""
    first = read_colours(block.paths[0])
    bands, dtype = first.shape[2], first.dtype
    shrunk = max(1, int(lattice.resolution_m / block.gsd_m))

    @lru_cache(maxsize=max(4, 400_000_000 // first.nbytes))  # 400 MB for the next tile
    def picture(row: int) -> Picture:
        pixels = read_colours(block.paths[row])
        check_kind(block.paths[row], pixels, first)
        return picture_of(pixels, shrunk, blanks=given.water is None)

    colours = {1: ("gray",), 3: ("red", "green", "blue")}
    names = colours.get(bands, tuple(f"band {b + 1}" for b in range(bands)))
    covered = ground = done = 0
    layers = dict.fromkeys((*names, "alpha"), "")
    with rasters.new_raster(
        path, lattice, block.crs, layers, dtype=str(dtype), nodata=None
    ) as target:  # fmt: skip
        for window in lattice.window.parts(512):
            xy = lattice.centres(window)
            z = block.scene.ground.heights_at(xy)
            known = np.isfinite(z)
            xyz = np.column_stack([xy, z])[known]
            found = mosaic(xyz, block.photos, block.scene, picture) if len(xyz) else None
            ground += len(xyz)
            if found is not None:
                colour, is_seen = found
                tile = np.zeros((bands + 1, window.height, window.width), dtype)
                most = np.iinfo(dtype).max
                known = known.reshape(window.height, window.width)
                tile[:-1, known] = np.clip(np.rint(colour), 0, most).T
                tile[-1, known] = most * is_seen
                rasters.write_bands(target, tile, window)
                covered += int(is_seen.sum())
            done += window.height * window.width
            if progress is not None:
                progress(done, lattice.height * lattice.width)
    return covered, ground
