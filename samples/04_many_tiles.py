"""Correct every tile in a folder; a tile without water is reported and left alone.

python samples/04_many_tiles.py [FOLDER]
"""

import sys
from pathlib import Path

import pcfix

scene = Path(__file__).parent / "scene"
folder = Path(sys.argv[1]) if len(sys.argv) > 1 else scene
cameras = pcfix.read_cameras(scene / "cameras.csv")  # read once for all tiles
out = Path("corrected_tiles")
out.mkdir(exist_ok=True)
for tile in sorted(folder.glob("cloud*.laz")):
    try:
        summary = pcfix.correct_file(
            tile, out / tile.name, cameras=cameras, water=0.37, overwrite=True
        )
    except pcfix.GeometryError as reason:  # for one, no point below the water
        print(f"{tile.name}: left as it is: {reason}")
    else:
        print(f"{tile.name}: {summary.corrected:,} of {summary.points:,} points corrected")
