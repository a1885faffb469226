"""Correct a DSM whose cloud is lost, and see how much deeper the bed is.

The DSM is made from the cloud of the scene first. Yours may come from Metashape, ODM or an archive.
"""

from pathlib import Path

import pcfix

scene = Path(__file__).parent / "scene"
pcfix.grid_dsm(scene / "cloud.laz", "dsm.tif", resolution=1.0, method="tin", overwrite=True)
summary = pcfix.correct_file(
    "dsm.tif", "corrected.tif", cameras=scene / "cameras.csv", water=0.37,
    depth="dsm_depth.tif", uncertainty="dsm_uncertainty.tif", overwrite=True,
)  # fmt: skip
print(f"{summary.submerged:,} of {summary.points:,} cells are under water")
print(f"deepest cell {summary.depth_m['max']:.2f} m, mean shift {summary.shift_z_m['mean']:.2f} m")
