"""Correct a cloud that is larger than memory: each tile of it goes through the stage by itself.

python pipelines/correct_large.py CLOUD OUTPUT.las [SIDE_M [PDALARGS]]

Cutting and joining stream. filters.python does not: PDAL gives it all points at once, so memory is
that of the largest tile. With snell, a largest angle and without occlusion no point's place depends
on the others; SigmaZ does. "pdal tile" would cut in one pass, but loses every 10,000th point (PDAL
issue 4076; seen in 2.2).
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

cloud, output, side_m, text = [*sys.argv[1:], *("50", "{}")[len(sys.argv) - 3 :]]
scene, recipe = Path(__file__).parents[1] / "samples" / "scene", Path(__file__).parent
args = {"cameras": str(scene / "cameras.csv"), "water": 0.37, "max_angle": 40, **json.loads(text)}
args |= {"method": "snell", "occlusion": "off"}
las = {"type": "writers.las", "forward": "all", "minor_version": 4, "dataformat_id": 7,
       "extra_dims": "all"}  # fmt: skip


def pdal(*words, stages=None):
    command = ["pdal", *map(str, words)]
    text = json.dumps(stages) if stages else None
    return subprocess.run(command, input=text, capture_output=True, text=True, check=False)


def stream(*stages):
    done = pdal("pipeline", "--stream", "--stdin", stages=stages)
    if done.returncode:
        sys.exit(done.stderr)


def summary(file):
    return json.loads(pdal("info", "--summary", file).stdout)["summary"]


def corners(low, high):
    return range(int(low // float(side_m)), int(high // float(side_m)) + 1)


box, total, tiles = summary(cloud)["bounds"], summary(cloud)["num_points"], []
with tempfile.TemporaryDirectory(dir=Path(output).resolve().parent) as folder:
    for x, y in (
        (x * float(side_m), y * float(side_m))
        for x in corners(box["minx"], box["maxx"])
        for y in corners(box["miny"], box["maxy"])
    ):
        tile, done = Path(folder, f"{x:.0f}_{y:.0f}.las"), Path(folder, f"{x:.0f}_{y:.0f}_done.las")
        inside = f"X[{x}:{x + float(side_m)}),Y[{y}:{y + float(side_m)})"
        cut = {"type": "filters.range", "limits": inside}
        stream(cloud, cut, {**las, "filename": str(tile)})
        if not summary(tile)["num_points"]:
            continue
        found = pdal(
            "pipeline", recipe / "correct.json", f"--readers.las.filename={tile}",
            f"--writers.las.filename={done}", f"--filters.python.pdalargs={json.dumps(args)}",
        )  # fmt: skip
        if "GeometryError" in found.stderr:  # no water in it, or no camera over it
            print(f"{tile.stem}: left as it is: {found.stderr.splitlines()[0]}")
            done = tile
        elif found.returncode:
            sys.exit(found.stderr)
        else:
            tile.unlink()
        tiles.append(str(done))
    if all("_done" not in tile for tile in tiles):
        sys.exit("no tile could be corrected")
    stream(*tiles, {**las, "filename": output})
    print(f"{summary(output)['num_points']:,} of {total:,} points in {len(tiles)} tiles")
