"""Correct a folder of tiles as one cloud, and grid them to one raster.

python samples/04_many_tiles.py [FOLDER]
"""

import sys
from pathlib import Path

import laspy

import pcfix

scene = Path(__file__).parent / "scene"
tiles, out = Path("tiles"), Path("corrected_tiles")
if len(sys.argv) > 1:
    tiles = Path(sys.argv[1])
else:  # the sample cut in two
    tiles.mkdir(exist_ok=True)
    cloud = laspy.read(scene / "cloud.laz")
    west = cloud.x < (cloud.header.mins[0] + cloud.header.maxs[0]) / 2
    for name, rows in (("west", west), ("east", ~west)):
        part = laspy.LasData(cloud.header, cloud.points[rows])
        part.write(tiles / f"{name}.laz")

summary = pcfix.correct_file(tiles, out, cameras=scene / "cameras.csv", water=0.37, overwrite=True)
print(f"{summary.corrected:,} of {summary.points:,} points corrected, files in {out}:")
for path in sorted(out.glob("*.laz")):
    print(f"  {path.name}")

raster = pcfix.grid_dsm(out, "tiles_bed.tif", surface="bed", resolution=1.0, overwrite=True)
print(f"{raster.output}: {raster.width} x {raster.height} cells")
