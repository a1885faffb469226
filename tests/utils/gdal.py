"""What the GDAL in rasterio can do."""

import rasterio

HAS_STATISTICS = tuple(map(int, rasterio.__gdal_version__.split(".")[:2])) >= (3, 8)
"""Whether it writes them into cloud-optimised rasters; older ones ignore the option."""
