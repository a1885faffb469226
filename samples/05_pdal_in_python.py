"""Use pcfix as a stage of a PDAL pipeline in Python (needs PDAL; see the README)."""

import json
from pathlib import Path

import pdal

root = Path(__file__).parents[1]
job = json.loads((root / "pipelines" / "correct.json").read_text())
reader, stage, writer = job["pipeline"]
reader["filename"] = str(root / "samples" / "scene" / "cloud.laz")
stage["pdalargs"] = {"cameras": str(root / "samples" / "scene" / "cameras.csv"), "water": 0.37}
writer["filename"] = "corrected_by_pdal.las"
pipeline = pdal.Pipeline(json.dumps(job))
pipeline.execute()
points = pipeline.arrays[0]
moved = points["RayCount"] > 0
deepest_m = points["WaterDepth"].max()
print(f"{moved.sum():,} of {len(points):,} points corrected, deepest {deepest_m:.2f} m")
