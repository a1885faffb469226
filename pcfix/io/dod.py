"""The difference of two rasters of heights (DoD), block by block."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import GeometryError
from pcfix.io.files import replaced_when_whole
from pcfix.io.rasters import NO_HEIGHT, add_overviews, check_tif, open_raster

if TYPE_CHECKING:
    from pathlib import Path

    from pcfix.model import FloatArray

PREVIEW_CELLS = 600


def write_dod(dsm: Path, reference: Path, output: Path, *, overwrite: bool = False) -> int:
    """Write the first band of one raster minus that of another, metres.

    Parameters
    ----------
    dsm : Path
        Its cells and CRS are those of the output.
    reference : Path
        A raster of heights, which is resampled (bilinear) where its cells are others.
    output : Path
        GeoTIFF of one band, float32; -9999 where either has no height.
    overwrite : bool
        Replace an output that exists.

    Returns
    -------
    int
        Cells that have a difference.

    Raises
    ------
    GeometryError
        If the two have no cell in common.
    """
    from rasterio.enums import Resampling
    from rasterio.vrt import WarpedVRT

    target = check_tif(output, overwrite=overwrite, inputs=[dsm, reference])
    known = 0
    with open_raster(dsm) as one, open_raster(reference) as source:
        import rasterio

        crs = source.crs or one.crs
        same = WarpedVRT(
            source, src_crs=crs, crs=one.crs or crs, transform=one.transform, width=one.width,
            height=one.height, resampling=Resampling.bilinear, dtype="float64", nodata=NO_HEIGHT,
        )  # fmt: skip
        profile = one.profile | {"count": 1, "driver": "GTiff"}
        with replaced_when_whole(target) as draft:
            with same, rasterio.open(draft, "w", **profile) as sink:
                sink.set_band_description(1, "difference")
                for _, window in sink.block_windows(1):
                    difference = _heights(one, window) - _heights(same, window)
                    known += int(np.isfinite(difference).sum())
                    whole = np.where(np.isfinite(difference), difference, NO_HEIGHT)
                    sink.write(whole.astype(np.float32), 1, window=window)
            if known == 0:
                raise GeometryError(f"{dsm} and {reference} have no cell in common; see their CRS.")
            add_overviews(draft)
    return known


def preview(path: Path) -> tuple[FloatArray, tuple[float, float, float, float]]:
    """Return a small version of a raster with NaN for no data, and west, east, south, north."""
    with open_raster(path) as source:
        scale = max(1.0, max(source.height, source.width) / PREVIEW_CELLS)
        shape = max(1, int(source.height / scale)), max(1, int(source.width / scale))
        values = source.read(1, out_shape=shape, masked=True).astype(np.float64).filled(np.nan)
        west, south, east, north = source.bounds
    return values, (west, east, south, north)


def _heights(raster: Any, window: Any) -> FloatArray:
    values: FloatArray = (
        raster.read(1, window=window, masked=True).astype(np.float64).filled(np.nan)
    )
    return values
