"""Compare the results of two versions of the code, within tolerances.

`record` runs the command lines of same_results_commands.py and keeps what each leaves: its files,
its exit codes and what it printed. `compare` reads two such folders and prints every difference:

- coordinates, depths, shifts, standard errors and rasters that differ by more than `--metres`;
- classes, flags, counts and other whole numbers that differ at all;
- numbers in JSON, tables and text files that differ by more than `--relative`;
- exit codes, and files, dimensions, bands, layers and JSON keys that only one side has.

Sentences, dates, times and paths are not compared. A dimension stored as whole multiples of a step
(a LAS coordinate of 1 mm, say) may differ by one step in the few points that a change below the
tolerance moves across a rounding limit.

    python tests/benchmarks/same_results.py record FOLDER [--tree DIR] [--only NAME,...] [--pdal]
    python tests/benchmarks/same_results.py compare FOLDER FOLDER [--only NAME,...]

The data is found through PCFIX_SHARED. `--only` takes patterns such as ``river.*``; earlier
commands whose files they read are run too. Keep the folders outside the repository: a full record
has about 1 GB.
"""

import argparse
import fnmatch
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from same_results_commands import pdal_table, table, write_inputs

ROOT = Path(__file__).parents[2]
SHARED = Path(os.environ.get("PCFIX_SHARED", ROOT.parent / "shared")).absolute() / "data"
OUTCOME = "outcome.json"
# Keys of JSON that hold times, versions, or sizes and checksums of texts that contain them.
NOT_COMPARED = {"seconds", "pcfix", "made_by", "changed_ns", "bytes", "identity", "sha256"}
ZERO = 1e-9  # numbers closer to each other than this are equal, whatever their relative difference
NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w.])")
SHOWN = 12  # differences that are printed of each command; the rest are counted


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    actions = parser.add_subparsers(dest="action", required=True)
    action = actions.add_parser("record")
    action.add_argument("folder", type=Path)
    action.add_argument("--tree", type=Path, default=ROOT, help="checkout whose code is run")
    action.add_argument("--only", default="*", help="names or patterns, separated by commas")
    action.add_argument("--pdal", action="store_true", help="the commands that need PDAL")
    action = actions.add_parser("compare")
    action.add_argument("one", type=Path)
    action.add_argument("other", type=Path)
    action.add_argument("--only", default="*", help="names or patterns, separated by commas")
    action.add_argument("--metres", type=float, default=1e-6, help="tolerance of lengths [m]")
    action.add_argument("--relative", type=float, default=1e-6, help="tolerance of other numbers")
    given = parser.parse_args()
    if given.action == "record":
        record(given)
    else:
        sys.exit(compare(given))


def record(given):
    commands = pdal_table() if given.pdal else table()
    if given.pdal and not Path(sys.executable).with_name("pdal").exists():
        raise SystemExit("There is no program 'pdal' beside this Python.")
    folder, tree = given.folder.resolve(), given.tree.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(folder / "inputs", ignore_errors=True)
    write_inputs(folder / "inputs", SHARED, ROOT / "samples")
    for name in chosen(commands, given.only):
        shutil.rmtree(folder / name, ignore_errors=True)
        started = time.perf_counter()
        codes = run(folder / name, commands[name], tree)
        print(f"{name:<40} exit {codes!s:<8} {time.perf_counter() - started:6.1f} s", flush=True)


def chosen(commands, only):
    """Return the names that match and, before each, those whose files it reads."""
    names = [name for name in commands if matches(name, only)]
    for name in names:  # the list grows while it is read
        names += [n for n in re.findall(r"{([\w.-]+)/", commands[name]) if n in commands]
    return [name for name in commands if name in names]


def matches(name, only):
    return any(fnmatch.fnmatch(name, pattern) for pattern in only.split(","))


def run(folder, line, tree):
    """Run a command line in its own folder, keep what it printed, and return its exit codes."""
    folder.mkdir()
    places = {"shared": SHARED, "samples": ROOT / "samples", "tree": tree}
    filled = re.sub(r"{([\w./-]+)}", lambda m: str(places.get(m[1], folder.parent / m[1])), line)
    programs = Path(sys.executable).parent
    environment = {
        **os.environ, "PYTHONPATH": str(tree), "COLUMNS": "200", "NO_COLOR": "1",
        "MPLBACKEND": "agg", "PATH": f"{programs}{os.pathsep}{os.environ['PATH']}",
    }  # fmt: skip
    codes, printed = [], ""
    for part in filled.split(" && "):
        words = shlex.split(part)
        if words[0] == "python":
            words[0] = sys.executable
        elif words[0] != "pdal":
            words = [sys.executable, "-m", "pcfix", *words]
        done = subprocess.run(
            words, cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
        codes.append(done.returncode)
        printed += done.stdout + done.stderr
    (folder / OUTCOME).write_text(json.dumps({"exit": codes, "printed": printed}, indent=1))
    return codes


def compare(given):
    """Print the differences between two records, and return whether there are any."""
    sides = [
        {path.name for path in folder.iterdir() if (path / OUTCOME).exists()}
        for folder in (given.one, given.other)
    ]
    names = sorted(name for name in sides[0] & sides[1] if matches(name, given.only))
    count = 0
    for name in names:
        found = list(differences(given.one / name, given.other / name, given))
        count += len(found)
        for line in found[:SHOWN]:
            print(f"{name}: {line}")
        if len(found) > SHOWN:
            print(f"{name}: and {len(found) - SHOWN} more")
    one_sided = sorted(name for name in sides[0] ^ sides[1] if matches(name, given.only))
    if one_sided:
        print(f"{len(one_sided)} commands are in one record only: {' '.join(one_sided)}")
    print(f"{count} differences in {len(names)} commands")
    return int(count > 0 or not names)


def differences(one, other, given):
    """Yield the differences between what one command left on the two sides."""
    codes = [json.loads((side / OUTCOME).read_text())["exit"] for side in (one, other)]
    if codes[0] != codes[1]:
        yield f"exit codes {codes[0]} and {codes[1]}"
    files = [
        {str(path.relative_to(side)) for path in side.rglob("*") if path.is_file()} - {OUTCOME}
        for side in (one, other)
    ]
    yield from (f"{file} is in one record only" for file in sorted(files[0] ^ files[1]))
    for file in sorted(files[0] & files[1]):
        differ = COMPARED.get(Path(file).suffix.lower(), differ_by_text)
        for line in differ(one / file, other / file, given):
            yield f"{file}: {line}"


def differ_as_clouds(one, other, given):
    """Yield the differences between two LAS or LAZ files."""
    import laspy

    las = [laspy.read(path) for path in (one, other)]
    heads = [cloud.header for cloud in las]
    for name in ("version", "point_format", "point_count", "scales", "offsets", "global_encoding"):
        values = [plain(getattr(head, name)) for head in heads]
        if values[0] != values[1]:
            yield f"header {name} {values[0]} and {values[1]}"
    if heads[0].point_count != heads[1].point_count:
        return
    names = [set(cloud.point_format.dimension_names) for cloud in las]
    yield from (f"dimension {name} is in one record only" for name in sorted(names[0] ^ names[1]))
    for name in sorted((names[0] & names[1]) - {"X", "Y", "Z"} | {"x", "y", "z"}):
        step = dict(zip("xyz", heads[0].scales, strict=True)).get(name)
        if step is None:
            scales = las[0].point_format.dimension_by_name(name).scales
            step = None if scales is None else float(np.max(scales))
        values = [np.asarray(cloud[name]) for cloud in las]
        if line := differ_as_arrays(*values, given.metres, step):
            yield f"dimension {name}: {line}"
    records = [[*cloud.header.vlrs, *(cloud.evlrs or [])] for cloud in las]
    kinds = [[(record.user_id, record.record_id) for record in side] for side in records]
    if kinds[0] != kinds[1]:
        yield f"VLRs {kinds[0]} and {kinds[1]}"
        return
    for pair in zip(*records, strict=True):
        data = [record.record_data_bytes().rstrip(b"\0") for record in pair]
        if pair[0].user_id == "pcfix":
            for line in differ_as_values(*map(json.loads, data), given):
                yield f"VLR {pair[0].record_id} {line}"
        elif pair[0].user_id != "laszip encoded" and data[0] != data[1]:
            yield f"VLR {pair[0].user_id} {pair[0].record_id} differs"


def plain(value):
    return str(value.tolist() if isinstance(value, np.ndarray) else getattr(value, "value", value))


def differ_as_arrays(one, other, tolerance, step=None):
    """Return how two arrays differ by more than a tolerance, or nothing.

    `step` is the step of numbers that are stored as whole multiples of it: a change of d moves a
    share of d / step of them to the next multiple.
    """
    if one.shape != other.shape or one.dtype.kind != other.dtype.kind:
        return f"{one.dtype} {one.shape} and {other.dtype} {other.shape}"
    if one.dtype.kind != "f":
        count = int(np.count_nonzero(one != other))
        return f"{count:,} of {one.size:,} values differ" if count else ""
    with np.errstate(invalid="ignore"):
        difference = np.where((one == other) | (np.isnan(one) & np.isnan(other)), 0.0, one - other)
    difference = np.abs(np.where(np.isnan(difference), np.inf, difference))
    wrong = difference > tolerance
    if step is not None and step > tolerance:
        moved = (difference < 1.5 * step) & wrong
        if np.count_nonzero(moved) <= 3 + 2 * one.size * tolerance / step:
            wrong &= ~moved
    count = int(np.count_nonzero(wrong))
    return (
        f"{count:,} of {one.size:,} values differ, by at most {difference.max():.3g}"
        if count
        else ""
    )


def differ_as_rasters(one, other, given):
    """Yield the differences between two rasters."""
    import rasterio

    with rasterio.open(one) as left, rasterio.open(other) as right:
        profiles = [
            {key: str(value) for key, value in file.profile.items()} for file in (left, right)
        ]
        if profiles[0] != profiles[1]:
            yield f"profiles {profiles[0]} and {profiles[1]}"
            return
        for band in left.indexes:
            if line := differ_as_arrays(left.read(band), right.read(band), given.metres):
                yield f"band {band}: {line}"


def differ_as_layers(one, other, given):
    """Yield the differences between two GeoPackages."""
    import pyogrio

    names = [[str(row[0]) for row in pyogrio.list_layers(path)] for path in (one, other)]
    if names[0] != names[1]:
        yield f"layers {names[0]} and {names[1]}"
        return
    for name in names[0]:
        tables = [pyogrio.read_dataframe(path, layer=name) for path in (one, other)]
        if tables[0].shape != tables[1].shape:
            yield f"layer {name}: {tables[0].shape} and {tables[1].shape}"
            continue
        lines = [json.loads(table.to_json()) for table in tables]
        for line in differ_as_values(*lines, given):
            yield f"layer {name} {line}"


def differ_as_bundles(one, other, given):
    """Yield the differences between the arrays of two npz files."""
    with np.load(one) as left, np.load(other) as right:
        for name in sorted(set(left) ^ set(right)):
            yield f"{name} is in one record only"
        for name in sorted(set(left) & set(right)):
            if line := differ_as_arrays(left[name], right[name], given.metres):
                yield f"{name}: {line}"


def differ_as_json(one, other, given):
    yield from differ_as_values(*(json.loads(path.read_text()) for path in (one, other)), given)


def differ_as_values(one, other, given, key=""):
    """Yield the differences between two JSON values; sentences, dates and paths are skipped."""
    if isinstance(one, dict) and isinstance(other, dict):
        for name in sorted(one.keys() ^ other.keys()):
            yield f"{key}.{name} is in one record only"
        for name in sorted((one.keys() & other.keys()) - NOT_COMPARED):
            yield from differ_as_values(one[name], other[name], given, f"{key}.{name}")
    elif isinstance(one, list) and isinstance(other, list):
        if len(one) != len(other):
            yield f"{key} has {len(one)} and {len(other)} entries"
        else:
            for i, pair in enumerate(zip(one, other, strict=True)):
                yield from differ_as_values(*pair, given, f"{key}[{i}]")
    elif isinstance(one, str) and isinstance(other, str):
        is_word = re.fullmatch(r"[A-Za-z][\w:-]*", one) and re.fullmatch(r"[A-Za-z][\w:-]*", other)
        if is_word and one != other:
            yield f"{key} {one} and {other}"
    elif not is_close(one, other, given.relative):
        yield f"{key} {one!r} and {other!r}"


def is_close(one, other, relative):
    if one != one and other != other:
        return True  # both NaN
    if not all(isinstance(value, int | float) and value is not True for value in (one, other)):
        return one == other
    return abs(one - other) <= max(ZERO, relative * max(abs(one), abs(other))) or one == other


def differ_by_text(one, other, given):
    """Yield the differences between the numbers of two texts, or the bytes of other files."""
    data = [path.read_bytes() for path in (one, other)]
    if data[0] == data[1]:
        return
    try:
        texts = [NUMBER.findall(text.decode()) for text in data]
    except UnicodeDecodeError:
        yield f"{len(data[0]):,} and {len(data[1]):,} bytes differ"
        return
    if len(texts[0]) != len(texts[1]):
        yield f"{len(texts[0])} and {len(texts[1])} numbers"
        return
    pairs = [(float(a), float(b)) for a, b in zip(*texts, strict=True)]
    difference = [pair for pair in pairs if not is_close(*pair, given.relative)]
    if difference:
        yield f"{len(difference)} of {len(pairs)} numbers differ, the first {difference[0]}"


def differ_as_pages(one, other, given):
    """Yield the differences between the numbers of headings, tables and pictures of two pages."""
    for tag in ("<h2", "<table", "<img", "<svg", "<tr"):
        counts = [path.read_text().count(tag) for path in (one, other)]
        if counts[0] != counts[1]:
            yield f"{counts[0]} and {counts[1]} of {tag}>"


def pass_over(one, other, given):
    """Yield nothing: pictures are looked at, and records of the run hold times and paths."""
    return ()


COMPARED = {
    ".las": differ_as_clouds, ".laz": differ_as_clouds,
    ".tif": differ_as_rasters, ".tiff": differ_as_rasters,
    ".gpkg": differ_as_layers,
    ".json": differ_as_json, ".geojson": differ_as_json,
    ".html": differ_as_pages,
    ".npz": differ_as_bundles,
    ".png": pass_over,
}  # fmt: skip

if __name__ == "__main__":
    main()
