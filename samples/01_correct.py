"""Correct a cloud for refraction, and print how much deeper the bed is.

The folder `scene` has a simulated shore of 20,000 points with known truth.
"""

from pathlib import Path

import pcfix

scene = Path(__file__).parent / "scene"
summary = pcfix.correct_file(
    scene / "cloud.laz", "corrected.laz", cameras=scene / "cameras.csv", water=0.37, overwrite=True
)
print(f"{summary.corrected:,} of {summary.points:,} points are under water and were corrected")
print(f"deepest point {summary.depth_m['max']:.2f} m, mean shift {summary.shift_z_m['mean']:.2f} m")
