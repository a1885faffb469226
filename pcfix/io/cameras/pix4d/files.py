"""The files of one Pix4D project, its positions by GNSS and its image measurements."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePath, PureWindowsPath
from typing import TypeAlias
from xml.etree.ElementTree import Element

import numpy as np

from pcfix.errors import InputError, NoTiePointsError
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import number, read_xml
from pcfix.io.cameras.formats import Source
from pcfix.io.cameras.tracks import tie_points as gathered
from pcfix.model import Cameras, FloatArray, GnssPositions, IntArray, Lens, TiePoints

PARAMETERS = "calibrated_camera_parameters.txt"
EXTERNAL = "calibrated_external_camera_parameters.txt"
GEOGRAPHIC = "calibrated_external_camera_parameters_wgs84.txt"


NAMES = {
    "parameters": PARAMETERS,
    "external": EXTERNAL,
    "calibration": "pix4d_calibrated_internal_camera_parameters.cam",
    "offset": "offset.xyz",
    "wkt": "wkt.prj",
    "bingo": "tp_bingo.txt",
    "ties": "tp_pix4d.txt",
    "gcps": "measured_estimated_gcps_position.txt",
}
"""How a project calls its files, after its own name."""
Files: TypeAlias = dict[str, Path]
"""What there is of a project, by the names in `NAMES`, and ``project``."""


def first_line(text: str) -> str:
    """Return the first line of a text."""
    return text.lstrip().partition("\n")[0]


def is_project(source: Source) -> bool:
    """Whether a file is a Pix4D project (.p4d)."""
    return b"<pix4uav" in source.head


def read_text(path: Path) -> str:
    """Return the text of a file; bytes that are not UTF-8 can only be in names."""
    data = path.read_bytes()
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def holds_tables(root: Path) -> bool:
    """Whether a folder, or one in which a project keeps its tables, holds one."""
    try:
        return any(_prefixes(folder) for folder in _folders(root))
    except OSError:
        return False


def find(source: Source) -> Files:
    """Return the files of the project that a folder holds, or that a file belongs to."""
    path = source.path
    if is_project(source):
        files = _in_folders(path.with_suffix(""))
        return {**files, "project": path} if files else files
    if path.is_dir():
        return _in_folders(path)
    files = _named(path.parent, _prefix(path.name, PARAMETERS, EXTERNAL, GEOGRAPHIC) or "")
    columns = first_line(source.text).lower().split()
    if columns[:1] == ["filename"]:
        files["parameters"] = path
    elif columns[1:2] == ["x"]:
        files["external"] = path
    return files


def _in_folders(root: Path) -> Files:
    for folder in _folders(root):
        prefixes = _prefixes(folder)
        if len(prefixes) > 1:
            raise InputError(
                f"{folder}: holds the tables of several projects"
                f" ({', '.join(sorted(prefixes))}); give one of the files instead."
            )
        if prefixes:
            return _named(folder, prefixes.pop())
    return {}


def _prefixes(folder: Path) -> set[str]:
    """Return the names of the projects that have a table of poses in a folder."""
    found = (_prefix(path.name, PARAMETERS, EXTERNAL) for path in folder.iterdir())
    return {prefix for prefix in found if prefix is not None}


def _folders(root: Path) -> Iterator[Path]:
    """Give the folders in which a project may have its tables."""
    if root.is_dir():
        yield root
        for pattern in ("params", "1_initial/params", "*/params", "*/1_initial/params"):
            yield from sorted(path for path in root.glob(pattern) if path.is_dir())


def _prefix(name: str, *endings: str) -> str | None:
    """Return what precedes one of the endings in a name, the name of the project."""
    for ending in endings:
        if name == ending:
            return ""
        if name.endswith("_" + ending):
            return name.removesuffix(ending)
    return None


def _named(folder: Path, prefix: str) -> Files:
    """Return the files of one prefix; the project lies beside or in the folder of the project."""
    root = folder.resolve().parent.parent
    files = {kind: folder / (prefix + name) for kind, name in NAMES.items()}
    for project in (root / f"{prefix.rstrip('_')}.p4d", root.parent / f"{root.name}.p4d"):
        if project.is_file():
            files["project"] = project
    return {kind: path for kind, path in files.items() if path.is_file()}


WGS84 = "EPSG:4326"


def read_project(
    path: Path, labels: tuple[str, ...]
) -> tuple[GnssPositions | None, tuple[str, ...]]:
    """Read the initial positions of images, and the names of enabled images without a pose.

    The positions are those of the kind that the first image has: in WGS 84, or in a CRS.
    """
    root = read_xml(path)
    priors: dict[str, list[Prior | None]] = defaultdict(list)
    for image in root.iter("image"):
        if image.get("path") and image.get("enabled", "true").lower() != "false":
            name = PureWindowsPath(image.get("path", "")).name
            priors[name].append(_prior(path, name, image))
    found = [priors[label].pop(0) if priors.get(label) else None for label in labels]
    others = tuple(name for name, rest in priors.items() for _ in rest)
    kind = next((prior[0] for prior in found if prior is not None), None)
    if kind is None:
        return None, others
    xyz, sigma_m = np.full((2, len(found), 3), np.nan)
    for i, prior in enumerate(found):
        if prior is not None and prior[0] == kind:
            _, xyz[i], sigma_m[i] = prior
    if kind == "gps":
        return GnssPositions(xyz, sigma_m, WGS84), others
    tags = ((str(element.tag).lower(), element) for element in root.iter())
    wkt = next((element for tag, element in tags if tag in ("wktimage", "wktimages")), None)
    text = "" if wkt is None else wkt.get("value") or wkt.text or ""
    crs = checks.crs(path, text) if text.strip() else None
    return GnssPositions(xyz, sigma_m, crs), others


Prior: TypeAlias = tuple[str, FloatArray, FloatArray]
"""The element that has the position of an image, that, and its standard deviations, metres."""


def _prior(path: Path, name: str, image: Element) -> Prior | None:
    """Return the position: `xyz` in the CRS of the images, or `gps` in WGS 84."""
    for kind, axes in (("xyz", ("x", "y", "z")), ("gps", ("lng", "lat", "alt"))):
        position = image.find(kind)
        if position is not None:
            where = f"image {name}, {kind}"
            xyz = np.array([number(path, where, position.get(axis)) for axis in axes])
            sigma_m = np.full(3, np.nan)
            for tag, rows in (("toleranceXY", slice(2)), ("toleranceZ", slice(2, 3))):
                if (element := image.find(tag)) is not None:
                    sigma_m[rows] = number(path, f"image {name}, {tag}", element.get("value"))
            return kind, xyz, sigma_m
    return None


def read_observations(source: Source, cameras: Cameras) -> TiePoints:
    """Read ``tp_bingo.txt``, or ``tp_pix4d.txt`` where there is no other."""
    files = find(source)
    path = files.get("bingo") or files.get("ties")
    if path is None:
        raise NoTiePointsError(
            f"{source.path}: has no tp_bingo.txt or tp_pix4d.txt beside it, and so no tie points."
        )
    if cameras.lenses is None:
        raise InputError(f"{path}: its measurements need the lenses, which the cameras lack.")
    labels = list(enumerate(cameras.labels))[::-1]  # of equal names the first counts
    stems = {PurePath(label).stem: i for i, label in labels}
    measured = _measured(path, stems | {label: i for i, label in labels})
    camera = np.array([row for _, row, *_ in measured], dtype=np.int64)
    posed = camera >= 0
    if not posed.any():
        raise InputError(f"{path}: measures nothing in the images that are posed.")
    xy = _finite(path, [row[2:4] for row in measured])
    if path == files.get("bingo"):
        sensor = _finite(path, [row[4:] for row in measured])
        xy = _from_centre_mm(path, xy, sensor, camera, cameras.lenses)
    points = np.array([name for name, *_ in measured])
    names, point = np.unique(points[posed], return_inverse=True)
    known = _estimated(files["gcps"]) if "gcps" in files else {}
    unknown = np.full(3, np.nan)
    xyz = np.array([known.get(name.partition("_")[2], unknown) for name in names.tolist()])
    return gathered(xyz, point, camera[posed], xy[posed])


def _measured(path: Path, rows: dict[str, int]) -> list[tuple[str, int, str, str, str, str]]:
    """Read the lines: an image (and the size of its sensor), its points, and -99.

    Out come rows of the name of the point, the camera (-1: not posed), x and y, and the width and
    height of the sensor, as in H_23.52_15.68 after the name of the image.
    """
    found = []
    image: tuple[int, str, str] | None = None
    for line in read_text(path).splitlines():
        words = line.split()
        if not words or words[0] == "-99":
            image = None
        elif image is None:
            text, size = line.strip(), words[-1].split("_")
            width, height = size[-2:] if len(size) >= 3 else ("nan", "nan")
            image = (rows.get(text, rows.get(text.rpartition(" ")[0].strip(), -1)), width, height)
        elif len(words) in (3, 4):
            camera, width, height = image
            found.append((words[0], camera, words[1], words[2], width, height))
        else:
            raise InputError(
                f"{path}: '{line.strip()[:60]}' is not a point and its x and y; the file is"
                " damaged, export it again."
            )
    return found


def _finite(path: Path, rows: Sequence[Sequence[str]]) -> FloatArray:
    try:
        return np.array(rows, dtype=float)
    except ValueError as error:
        raise InputError(f"{path}: {error}; the file is damaged, export it again.") from error


def _from_centre_mm(
    path: Path, xy: FloatArray, sensor: FloatArray, camera: IntArray, lenses: tuple[Lens, ...]
) -> FloatArray:
    """Turn mm from the image centre, y up, into the unit of the lens from the upper left."""
    frame = np.array([(lens.width, lens.height) for lens in lenses])[camera]
    if not (sensor[camera >= 0] > 0.0).all():
        raise InputError(f"{path}: the line of an image lacks its sensor size H_width_height.")
    return np.asarray(frame / 2.0 + xy * np.array([1.0, -1.0]) * frame / sensor)


def _estimated(path: Path) -> dict[str, FloatArray]:
    """Read where the adjustment placed the control points, by their labels."""
    lines = [line.split(",") for line in read_text(path).splitlines()[1:] if line.strip()]
    if any(len(fields) < 7 for fields in lines):
        raise InputError(f"{path}: a line has fewer than 7 fields; the file is damaged.")
    return {fields[0].strip(): _finite(path, [fields[4:7]])[0] for fields in lines}
