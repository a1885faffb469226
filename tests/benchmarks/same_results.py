"""Whether two versions of the code give the same results, to the bit.

Runs the command lines of same_results_commands.py, each in a folder of its own, and records what
a user can see of each: exit code, output, and every file, part by part (dimensions of a cloud,
bands of a raster, keys of a summary). Times, paths and versions are left out.

    python tests/benchmarks/same_results.py record OUT.json [--tree DIR] [--only NAME,...] [--pdal]
    python tests/benchmarks/same_results.py compare A.json B.json [--common]

The data is found through PCFIX_SHARED. `--only` takes patterns, as river.*; the earlier commands
whose files they read are run too, and what OUT.json has of others stays in it. Of a tree that has
not run yet the kernels are compiled first, which takes several minutes more.
"""

from __future__ import annotations

import argparse
import datetime
import difflib
import fnmatch
import hashlib
import json
import os
import re
import shlex
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from same_results_commands import pdal_table, table, write_inputs

ROOT = Path(__file__).parents[2]
SHARED = Path(os.environ.get("PCFIX_SHARED", ROOT.parent / "shared")).absolute() / "data"
# the last two are of files: those that hold times and paths are now and then a byte longer
LEFT_OUT = {"seconds", "points_per_s", "pcfix", "made_by", "changed_ns", "bytes"}
TODAY = datetime.datetime.now(datetime.UTC).date().isoformat()
NORMALISED = [
    (rf"{TODAY}([T ][\d:.]+(Z|[+-]\d\d:\d\d)?)?", "DATE"),
    (r"\d[\d.,]* (M )?points/s", "SPEED points/s"),
    (r"\b\d[\d.,]* s\b", "TIME s"),
    (r"(?s)Traceback \(most recent.*?(?=pcfix\.errors\.)", "TRACEBACK "),  # as PDAL prints it
    (r"pcfix \d+\.\d+\.\d+\w*", "pcfix VERSION"),
]
MANY = 200
"""A list or object with more values than that is recorded as a whole."""


def main():
    words = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    doors = words.add_subparsers(dest="door", required=True)
    door = doors.add_parser("record")
    door.add_argument("out", type=Path)
    door.add_argument("--tree", type=Path, default=ROOT)
    door.add_argument("--only", default="*", help="names or patterns, with commas between")
    door.add_argument("--pdal", action="store_true", help="the commands that need pdal")
    door.add_argument("--scratch", type=Path, help="folder to keep, which must not exist")
    door = doors.add_parser("compare")
    door.add_argument("one", type=Path)
    door.add_argument("other", type=Path)
    door.add_argument("--common", action="store_true", help="leave out what only one of them has")
    given = words.parse_args()
    if given.door == "record":
        record(given)
    else:
        sys.exit(compare(given.one, given.other, given.common))


def record(given):
    commands = pdal_table() if given.pdal else table()
    if given.pdal and not Path(sys.executable).with_name("pdal").exists():
        raise SystemExit("no program pdal beside this Python")
    with tempfile.TemporaryDirectory() as temporary:
        scratch = given.scratch or Path(temporary) / "scratch"
        scratch.mkdir()
        write_inputs(scratch / "inputs", SHARED, ROOT / "samples")
        places = Places(given.tree.resolve(), scratch.resolve())
        found = (
            json.loads(given.out.read_text()) if given.only != "*" and given.out.exists() else {}
        )
        for name in wanted(commands, given.only):
            started, before = time.perf_counter(), os.times()
            found[name] = outcome(name, commands[name], places)
            taken, after = time.perf_counter() - started, os.times()
            busy = after.children_user + after.children_system
            busy -= before.children_user + before.children_system
            print(
                f"{name:<40} exit{found[name]['exit']:<4} {taken:6.1f} s, processor {busy:6.1f} s",
                flush=True,
            )
            given.out.write_text(json.dumps(found, indent=1))


def wanted(commands, only):
    """Return the names asked for and, before them, those whose files they read."""
    patterns = only.split(",")
    names = [n for n in commands if any(fnmatch.fnmatch(n, p) for p in patterns)]
    for name in names:  # grows
        names += [n for n in re.findall(r"{([\w.-]+)/", commands[name]) if n in commands]
    return [name for name in commands if name in names]


class Places:
    """The folders of a recording: what placeholders mean, and what is left out of texts."""

    def __init__(self, tree, scratch):
        self.tree, self.scratch = tree, scratch
        self._of = {"shared": SHARED, "samples": ROOT / "samples", "tree": tree}

    def filled(self, line):
        def path(match):
            return str(self._of.get(match[1], self.scratch / match[1]))

        return re.sub(r"{([\w./-]+)}", path, line)

    def normalised(self, text):
        """Return a text without folders, times and versions."""
        for place, name in ((self.scratch, "SCRATCH"), (SHARED, "SHARED"), (self.tree, "TREE")):
            text = text.replace(str(place), name)
        text = text.replace(str(ROOT), "TREE").replace(sys.executable, "PYTHON")
        for pattern, word in NORMALISED:
            text = re.sub(pattern, word, text)
        # the frames that typer draws are filled up to the length of the paths in them
        rows = [re.sub(r"[ ─]+", " ", r) if set("│─") & set(r) else r for r in text.split("\n")]
        return "\n".join(rows)


def outcome(name, line, places):
    """Run a command line in its folder, and return all that can be seen of it."""
    folder = places.scratch / name
    folder.mkdir()
    programs = Path(sys.executable).parent
    seen = {"exit": "", "stdout": "", "stderr": "", "files": {}}
    environment = {
        **os.environ, "PYTHONPATH": str(places.tree), "COLUMNS": "200", "NO_COLOR": "1",
        "MPLBACKEND": "agg", "PATH": f"{programs}{os.pathsep}{os.environ['PATH']}",
    }  # fmt: skip
    for part in line.split(" && "):
        words = shlex.split(places.filled(part))
        if words[0] == "python":
            words[0] = sys.executable
        elif words[0] == "pdal":
            words[0] = str(programs / "pdal")
        else:
            words = [sys.executable, "-m", "pcfix", *words]
        done = subprocess.run(
            words, cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
        seen["exit"] += f" {done.returncode}"
        seen["stdout"] += places.normalised(done.stdout)
        seen["stderr"] += places.normalised(done.stderr)
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            seen["files"][str(path.relative_to(folder))] = parts_of(path, places)
    return seen


def parts_of(path, places):
    """Return a value for each part of a file."""
    suffix = path.suffix.lower()
    if suffix in (".las", ".laz"):
        return cloud_parts(path, places)
    if suffix in (".tif", ".tiff"):
        return raster_parts(path)
    if suffix == ".png":
        return {"exists": "yes"}
    data = path.read_bytes()
    try:
        text = places.normalised(data.decode())
    except UnicodeDecodeError:
        return {"bytes": digest(data)}
    if suffix in (".json", ".geojson"):
        return flat(json.loads(text))
    if suffix == ".html":
        return page_parts(text)
    return {"text": text if len(text) < 3000 else f"{text.count(chr(10))} lines {digest(text)}"}


def cloud_parts(path, places):
    import laspy

    las = laspy.read(path)
    header, array = las.header, las.points.array
    names = (
        "version point_format point_count scales offsets mins maxs system_identifier"
        " generating_software file_source_id number_of_points_by_return"
    )
    values = {name: getattr(header, name) for name in names.split()}
    parts = {
        f"header {name}": str(value.tolist() if isinstance(value, np.ndarray) else value)
        for name, value in values.items()
    }
    parts = {key: places.normalised(value) for key, value in parts.items()}
    parts["header encoding"] = str(header.global_encoding.value)
    for name in las.point_format.dimension_names:
        values = array[name] if name in array.dtype.names else np.asarray(las[name])
        parts[f"dimension {name}"] = f"{values.dtype} {digest(np.ascontiguousarray(values))}"
    for number, (user, kind, description, data) in enumerate(variable_records(path)):
        key = f"record {number} {user} {kind}"
        parts[f"{key} description"] = places.normalised(description)
        if user == "pcfix":
            values = flat(json.loads(places.normalised(data.rstrip(b"\0").decode())))
            parts.update({f"{key} {name}": value for name, value in values.items()})
        else:
            parts[key] = digest(data)
    return parts


def variable_records(path):
    """Return user, record id, description and content of the VLRs and EVLRs of a LAS file."""
    data = path.read_bytes()
    size, _, count = struct.unpack_from("<HII", data, 94)
    blocks = [(size, count, "<2x16sHH32s")]
    if data[25] >= 4:
        blocks.append((*struct.unpack_from("<QI", data, 235), "<2x16sHQ32s"))
    found = []
    for at, how_many, layout in blocks:
        for _ in range(how_many):
            user, kind, length, description = struct.unpack_from(layout, data, at)
            at += struct.calcsize(layout)
            words = [w.split(b"\0")[0].decode("latin-1") for w in (user, description)]
            found.append((words[0], kind, words[1], data[at : at + length]))
            at += length
    return found


def raster_parts(path):
    import rasterio

    with rasterio.open(path) as source:
        parts = {key: str(value) for key, value in source.profile.items()}
        parts["tags"] = str(source.tags())
        for band, description in enumerate(source.descriptions, 1):
            parts[f"band {band} name"] = f"{description} {source.tags(band)}"
            parts[f"band {band}"] = digest(source.read(band))
    return parts


def flat(value, key=""):
    """Return the leaves of a JSON document by their keys."""
    inner = value.items() if isinstance(value, dict) else enumerate(value)
    if len(value) > MANY:
        return {key: f"{len(value)} values {digest(json.dumps(value))}"}
    leaves = {}
    for name, child in inner:
        here = f"{key}[{name}]" if isinstance(value, list) else f"{key}.{name}".lstrip(".")
        if name in LEFT_OUT and not isinstance(child, dict):
            leaves[here] = "left out"
        elif isinstance(child, dict | list) and child:
            leaves.update(flat(child, here))
        elif name == "identity":  # of the file before; day and year of its creation come last
            leaves[here] = repr(child[:-4])
        else:
            leaves[here] = repr(child)
    return leaves


def page_parts(text):
    """Return the sections of a page, without its images."""
    text = re.sub(r"base64,[A-Za-z0-9+/=\s]+", "base64,IMAGE", text)
    sections = re.split(r"(?=<h[12][ >])", text)
    found = {}
    for number, section in enumerate(sections):
        title = re.sub(r"<[^>]+>", "", section.split("</h")[0])[:40].strip() if number else "head"
        found[f"section {number} {title}"] = digest(section)
    return found


def digest(data):
    return hashlib.sha256(data.encode() if isinstance(data, str) else data).hexdigest()[:24]


def compare(one, other, common=False):
    """Print every difference, and return whether there are any."""
    before, after = (json.loads(path.read_text()) for path in (one, other))
    both = [name for name in before if name in after]
    count = 0
    for name in both:
        sides = [leaves_of(side[name]) for side in (before, after)]
        for key in sorted(sides[0].keys() | sides[1].keys()):
            values = [side.get(key, "(absent)") for side in sides]
            if values[0] != values[1]:
                count += 1
                print(f"{name}: {key}\n{difference(*values)}")
    print(f"{count} differences in {len(both)} commands")
    apart = 0
    for path, side in () if common else ((one, before), (other, after)):
        missing = [name for name in side if name not in both]
        apart += len(missing)
        if missing:
            print(f"{len(missing)} commands are only in {path}: {' '.join(missing)}")
    return int(count + apart > 0)


def leaves_of(seen):
    leaves = {key: seen[key] for key in ("exit", "stdout", "stderr")}
    for file, parts in seen["files"].items():
        leaves[file] = "is there"
        leaves.update({f"{file}: {part}": value for part, value in parts.items()})
    return leaves


def difference(one, other):
    rows = difflib.unified_diff(one.split("\n"), other.split("\n"), lineterm="", n=0)
    return "\n".join(f"    {row}" for row in rows if row[:2] not in ("--", "++", "@@"))


if __name__ == "__main__":
    main()
