"""Grid the bed to a GeoTIFF, and draw a map of the depth.

Run 01_correct.py first. QGIS opens bed.tif as it is.
"""

import matplotlib.pyplot as plt
import numpy as np

import pcfix
from pcfix.io.rasters import read_raster

WATER_M = 0.37

pcfix.grid_dsm("corrected.laz", "bed.tif", resolution=2.0, surface="bed", overwrite=True)
raster = read_raster("bed.tif")
bed = np.where(raster.array[0] == raster.nodata, np.nan, raster.array[0])
plt.imshow(WATER_M - bed, cmap="viridis_r")
plt.colorbar(label="depth (m)")
plt.savefig("depth.png", dpi=120)
print(f"depth.png: {np.nanmax(WATER_M - bed):.1f} m at the deepest cell of 2 m")
