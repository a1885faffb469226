"""Grid the depth of the bed to a GeoTIFF, and draw a map of it.

Run 01_correct.py first. QGIS opens depth.tif in the colours of depth.qml.
"""

import matplotlib.pyplot as plt
import numpy as np
import rasterio

import pcfix

pcfix.grid_dsm(
    "corrected.laz", "depth.tif", what="depth", resolution=2.0, style=True, overwrite=True
)
with rasterio.open("depth.tif") as raster:
    depth = raster.read(1, masked=True).filled(np.nan)
plt.imshow(depth, cmap="YlGnBu")
plt.colorbar(label="depth (m)")
plt.savefig("depth.png", dpi=120)
print(f"depth.png: {np.nanmax(depth):.1f} m at the deepest cell of 2 m")
