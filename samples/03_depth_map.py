"""Grid the depth of the bed to a GeoTIFF, and draw a map of it.

Run 01_correct.py first. QGIS opens depth.tif in the colours of depth.qml.
"""

import matplotlib.pyplot as plt
import numpy as np

import pcfix
from pcfix.io.rasters import read_raster

pcfix.grid_dsm(
    "corrected.laz", "depth.tif", what="depth", resolution=2.0, style=True, overwrite=True
)
raster = read_raster("depth.tif")
depth = np.where(raster.array[0] == raster.nodata, np.nan, raster.array[0])
plt.imshow(depth, cmap="YlGnBu")
plt.colorbar(label="depth (m)")
plt.savefig("depth.png", dpi=120)
print(f"depth.png: {np.nanmax(depth):.1f} m at the deepest cell of 2 m")
