"""How much longer a correction takes as a stage of PDAL than as ``pcfix correct``.

Both read and write the same LAS files (PDAL 2.2 writes no LAZ with class 40), by turns, each as a
process of its own; a plain copy by PDAL says how much of it is reading and writing. Run it with
the Python of an environment that has PDAL.

    python tests/benchmarks/pdal_ratio.py [--points 5000000] [--cameras 200] [--folder DIR]
"""

import json
import statistics
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from copy_ratio import camera_table, make, parsed, run


def main():
    arguments = parsed(__doc__)
    folder = arguments.folder
    folder.mkdir(parents=True, exist_ok=True)
    laz = folder / f"cloud_{arguments.points}_{arguments.cameras}.laz"
    if not laz.exists():
        make(laz, arguments.points, arguments.cameras)
    cloud = uncompressed(laz)
    options = [
        *("--cameras", camera_table(laz), "--sensor", folder / "sensor.csv", "--water", "0.37")
    ]
    outputs = [folder / f"{name}.las" for name in ("corrected", "stage", "copied")]
    pcfix = [sys.executable, "-m", "pcfix"]
    pdal = Path(sys.executable).with_name("pdal")
    with (folder / "stage.json").open("w") as stream:
        run([*pcfix, "pipeline", cloud, outputs[1], *options], stdout=stream)
    copy = [str(cloud), {"type": "writers.las", "filename": str(outputs[2]), "forward": "all"}]
    (folder / "copy.json").write_text(json.dumps(copy))
    commands = {
        "pcfix correct": [*pcfix, "correct", cloud, outputs[0], *options, "-q", "--overwrite"],
        "stage of PDAL": [pdal, "pipeline", folder / "stage.json"],
        "copy by PDAL": [pdal, "pipeline", folder / "copy.json"],
    }
    seconds = {name: [] for name in commands}
    memory = dict.fromkeys(commands, 0.0)
    run(commands["pcfix correct"])  # compile the kernels
    for _ in range(arguments.runs):
        for name, command in commands.items():
            taken, _, peak = run(command)
            seconds[name].append(taken)
            memory[name] = max(memory[name], peak)
    for name in commands:
        print(
            f"{name:<14} {statistics.median(seconds[name]):7.2f} s median,"
            f" {min(seconds[name]):6.2f} s least, peak {memory[name]:5.0f} MB"
        )
    pairs = zip(seconds["stage of PDAL"], seconds["pcfix correct"], strict=True)
    print(f"ratio          {statistics.median(one / other for one, other in pairs):7.2f}")


def uncompressed(laz):
    cloud = laz.with_suffix(".las")
    if not cloud.exists():
        program = "import sys, laspy; laspy.read(sys.argv[1]).write(sys.argv[2])"
        run([sys.executable, "-c", program, laz, cloud])
    return cloud


if __name__ == "__main__":
    main()
