"""The files of one Pix4D project, its positions by GNSS and its image measurements."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path, PurePath, PureWindowsPath
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import number, read_xml
from pcfix.io.cameras.formats import Source
from pcfix.io.cameras.tracks import tie_points as gathered
from pcfix.model import Cameras, FloatArray, GnssPositions, IntArray, Lens, TiePoints

PARAMETERS = "calibrated_camera_parameters.txt"
EXTERNAL = "calibrated_external_camera_parameters.txt"
GEOGRAPHIC = "calibrated_external_camera_parameters_wgs84.txt"
CALIBRATION = "pix4d_calibrated_internal_camera_parameters.cam"


@dataclass(frozen=True)
class Files:
    """What there is of a project; None where there is no such file."""

    parameters: Path | None
    external: Path | None
    calibration: Path | None
    offset: Path | None
    wkt: Path | None
    bingo: Path | None
    ties: Path | None
    gcps: Path | None
    project: Path | None


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
        return any(
            _prefix(path.name, PARAMETERS, EXTERNAL) is not None
            for folder in _folders(root)
            for path in folder.iterdir()
        )
    except OSError:
        return False


def find(source: Source) -> Files | None:
    """Return the files of the project that a folder holds, or that a file belongs to."""
    path = source.path
    if is_project(source):
        return _in_folders(path.with_suffix(""), path)
    if path.is_dir():
        return _in_folders(path, None)
    return _of_file(source)


def _of_file(source: Source) -> Files:
    """Return a table and what lies beside it under the same project name."""
    path = source.path
    prefix = _prefix(path.name, PARAMETERS, EXTERNAL, GEOGRAPHIC) or ""
    files = _named(path.parent, prefix)
    columns = first_line(source.text).lower().split()
    if columns[:1] == ["filename"]:
        return replace(files, parameters=path)
    if columns[1:2] == ["x"]:
        return replace(files, external=path)
    return files


def _in_folders(root: Path, project: Path | None) -> Files | None:
    for folder in _folders(root):
        prefixes = {
            prefix
            for path in folder.iterdir()
            if (prefix := _prefix(path.name, PARAMETERS, EXTERNAL)) is not None
        }
        if len(prefixes) > 1:
            raise InputError(
                f"{folder}: holds the tables of several projects"
                f" ({', '.join(sorted(prefixes))}); give one of the files instead."
            )
        if prefixes:
            files = _named(folder, prefixes.pop())
            return files if project is None else replace(files, project=project)
    return None


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
    def existing(name: str) -> Path | None:
        path = folder / (prefix + name)
        return path if path.is_file() else None

    return Files(
        parameters=existing(PARAMETERS),
        external=existing(EXTERNAL),
        calibration=existing(CALIBRATION),
        offset=existing("offset.xyz"),
        wkt=existing("wkt.prj"),
        bingo=existing("tp_bingo.txt"),
        ties=existing("tp_pix4d.txt"),
        gcps=existing("measured_estimated_gcps_position.txt"),
        project=_project(folder, prefix.rstrip("_")),
    )


def _project(params: Path, name: str) -> Path | None:
    """Return the project file, which lies beside the folder of the project or in it."""
    root = params.resolve().parent.parent
    for path in (root.parent / f"{root.name}.p4d", root / f"{name}.p4d"):
        if path.is_file():
            return path
    return None


WGS84 = "EPSG:4326"


class Prior(NamedTuple):
    """What the project says of one image; `kind` is the element that has the position."""

    kind: str
    xyz: FloatArray
    sigma_m: FloatArray


def read_project(
    path: Path, labels: tuple[str, ...]
) -> tuple[GnssPositions | None, tuple[str, ...]]:
    """Read the initial positions of images, and the names of enabled images without a pose."""
    root = read_xml(path)
    priors: dict[str, list[Prior | None]] = defaultdict(list)
    for image in root.iter("image"):
        if image.get("path") and image.get("enabled", "true").lower() != "false":
            name = PureWindowsPath(image.get("path", "")).name
            priors[name].append(_prior(path, name, image))
    found = [priors[label].pop(0) if priors.get(label) else None for label in labels]
    others = tuple(name for name, rest in priors.items() for _ in rest)
    return _positions(path, root, found), others


def _prior(path: Path, name: str, image: Element) -> Prior | None:
    """Return the position: `xyz` in the CRS of the images, or `gps` in WGS 84."""
    for kind, axes in (("xyz", ("x", "y", "z")), ("gps", ("lng", "lat", "alt"))):
        position = image.find(kind)
        if position is not None:
            where = f"image {name}, {kind}"
            xyz = np.array([number(path, where, position.get(axis)) for axis in axes])
            plan, height = (_tolerance(path, name, image, axis) for axis in ("XY", "Z"))
            return Prior(kind, xyz, np.array([plan, plan, height]))
    return None


def _tolerance(path: Path, name: str, image: Element, axis: str) -> float:
    element = image.find(f"tolerance{axis}")
    if element is None:
        return np.nan
    return number(path, f"image {name}, tolerance{axis}", element.get("value"))


def _positions(path: Path, root: Element, found: list[Prior | None]) -> GnssPositions | None:
    """Return one row per camera; positions of the kind that the first image has."""
    kinds = [prior.kind for prior in found if prior is not None]
    if not kinds:
        return None
    xyz, sigma_m = np.full((len(found), 3), np.nan), np.full((len(found), 3), np.nan)
    for i, prior in enumerate(found):
        if prior is not None and prior.kind == kinds[0]:
            xyz[i], sigma_m[i] = prior.xyz, prior.sigma_m
    crs = WGS84 if kinds[0] == "gps" else _crs_of_images(path, root)
    return GnssPositions(xyz, sigma_m, crs)


def _crs_of_images(path: Path, root: Element) -> str | None:
    for element in root.iter():
        if isinstance(element.tag, str) and element.tag.lower() in ("wktimage", "wktimages"):
            text = element.get("value") or element.text or ""
            return checks.crs(path, text) if text.strip() else None
    return None


class Measured(NamedTuple):
    """Lines of measurements: names of points, cameras (-1: not posed), x and y as text."""

    points: list[str]
    cameras: list[int]
    xy: list[list[str]]
    sensor_mm: list[tuple[str, str]]
    last_line: list[int]


def read_observations(source: Source, cameras: Cameras) -> TiePoints:
    """Read ``tp_bingo.txt``, or ``tp_pix4d.txt`` where there is no other."""
    files = find(source)
    path = None if files is None else files.bingo or files.ties
    if files is None or path is None:
        raise InputError(
            f"{source.path}: has no tp_bingo.txt or tp_pix4d.txt beside it, and so no tie points."
        )
    if cameras.lenses is None:
        raise InputError(f"{path}: its measurements need the lenses, which the cameras lack.")
    measured = _measured(path, _rows(cameras))
    camera = np.array(measured.cameras, dtype=np.int64)
    xy = _finite(path, measured.xy).reshape(-1, 2)
    if path == files.bingo:
        xy = _from_centre_mm(path, xy, measured, camera, cameras.lenses)
    posed = camera >= 0
    names, point = np.unique(np.array(measured.points)[posed], return_inverse=True)
    if len(names) == 0:
        raise InputError(f"{path}: measures nothing in the images that are posed.")
    known = {} if files.gcps is None else _estimated(files.gcps)
    unknown = np.full(3, np.nan)
    xyz = np.array([known.get(name.partition("_")[2], unknown) for name in names.tolist()])
    return gathered(xyz, point, camera[posed], xy[posed])


def _rows(cameras: Cameras) -> dict[str, int]:
    """Return the row of each image by its name, with and without extension."""
    rows = {PurePath(label).stem: i for i, label in reversed(list(enumerate(cameras.labels)))}
    rows.update({label: i for i, label in reversed(list(enumerate(cameras.labels)))})
    return rows


def _measured(path: Path, rows: dict[str, int]) -> Measured:
    """Read the lines: an image (and the size of its sensor), its points, and -99."""
    found = Measured([], [], [], [], [])
    camera, inside = -1, False
    for line in read_text(path).splitlines():
        words = line.split()
        if not words or words[0] == "-99":
            inside = False
        elif not inside:
            camera, inside = _image(line, rows), True
            found.sensor_mm.append(_sensor(words[-1]))
            found.last_line.append(len(found.points))
        elif len(words) in (3, 4):
            found.points.append(words[0])
            found.cameras.append(camera)
            found.xy.append(words[1:3])
        else:
            raise InputError(
                f"{path}: '{line.strip()[:60]}' is not a point and its x and y; the file is"
                " damaged, export it again."
            )
    return found


def _image(line: str, rows: dict[str, int]) -> int:
    """Return the row of the image that a line names, with or without a sensor after it."""
    text = line.strip()
    return rows.get(text, rows.get(text.rpartition(" ")[0].strip(), -1))


def _sensor(word: str) -> tuple[str, str]:
    """Return width and height out of a word like H_23.52_15.68."""
    parts = word.split("_")
    return (parts[-2], parts[-1]) if len(parts) >= 3 else ("nan", "nan")


def _finite(path: Path, words: list[list[str]] | list[tuple[str, str]]) -> FloatArray:
    try:
        return np.array(words, dtype=float)
    except ValueError as error:
        raise InputError(f"{path}: {error}; the file is damaged, export it again.") from error


def _from_centre_mm(
    path: Path, xy: FloatArray, measured: Measured, camera: IntArray, lenses: tuple[Lens, ...]
) -> FloatArray:
    """Turn mm from the image centre, y up, into the unit of the lens from the upper left."""
    lengths = np.diff([*measured.last_line, len(xy)])
    sensor = np.repeat(_finite(path, measured.sensor_mm).reshape(-1, 2), lengths, axis=0)
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
