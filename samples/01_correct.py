"""Correct a cloud for refraction and see how much deeper the bed is.

The scene beside this script has 20,000 points of a shore; its truth is known.
"""

from pathlib import Path

import pcfix

scene = Path(__file__).parent / "scene"
summary = pcfix.correct_file(
    scene / "cloud.laz", "corrected.laz", cameras=scene / "cameras.csv", water=0.37, overwrite=True
)
print(f"{summary.corrected:,} of {summary.points:,} points lay under water and were moved")
print(f"deepest point {summary.depth_m['max']:.2f} m, mean shift {summary.shift_z_m['mean']:.2f} m")
