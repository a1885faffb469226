"""Pix4D: the ``params`` folder of a project, one of its files, or the project file itself.

Two tables give the exterior orientation. ``calibrated_camera_parameters.txt`` has for each image
its name and size, the matrix K, the distortion, the projection centre less the offset of
``offset.xyz``, and the rotation world to camera (x right, y down, z forward); pixels start at the
corner of the image, and the tangential coefficients are in OpenCV's order. A fisheye lens has
instead of K and the distortion an affine matrix and a polynomial of 2 theta / pi.
``calibrated_external_camera_parameters.txt`` has absolute centres and omega, phi, kappa of axes
x right, y up, z back: R = diag(1, -1, -1) (Rx(omega) Ry(phi) Rz(kappa))^T. Where that table is
there the poses are taken from it, as an offset can be wrong. Of equal names those with the most
similar rotations belong together.

``pix4d_calibrated_internal_camera_parameters.cam`` has the interior orientation in millimetres,
``wkt.prj`` the CRS, and the project file (.p4d) the GNSS positions.
Image measurements are in ``tp_bingo.txt`` (mm from the image centre, y up, the size of the sensor
after each name) and ``tp_pix4d.txt`` (pixels). ``calibrated_images_position.txt`` and
``pmatrix.txt`` repeat the tables.

References: Pix4D, "What does the Output Params Folder contain?" (support.pix4d.com, article
202977149), "How are the Internal and External Camera Parameters defined?" (article 202559089).
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path, PurePath, PureWindowsPath
from typing import NamedTuple

import numpy as np

from pcfix.errors import PcfixWarning, bad_file
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import Source, damaged, note, number, numbers, read_xml
from pcfix.io.cameras.lenses import lens_by_name
from pcfix.io.tables import read_lines
from pcfix.lens.rotations import from_omega_phi_kappa
from pcfix.model import Cameras, FloatArray, GnssPositions, Lens, TiePoints

PARAMETERS = "calibrated_camera_parameters.txt"
NAMES = {
    "parameters": PARAMETERS,
    "external": "calibrated_external_camera_parameters.txt",
    "calibration": "pix4d_calibrated_internal_camera_parameters.cam",
    "offset": "offset.xyz",
    "wkt": "wkt.prj",
    "bingo": "tp_bingo.txt",
    "ties": "tp_pix4d.txt",
    "gcps": "measured_estimated_gcps_position.txt",
}
"""How a project calls its files, after its own name."""
TABLE = re.compile(r"(.*_|)calibrated_(?:external_)?camera_parameters(_wgs84)?\.txt")
HEADERS = (
    ["filename", "imagewidth", "imageheight"],
    ["imagename", "x", "y", "z", "omega", "phi", "kappa"],
    ["imagename", "longitude", "latitude", "altitude", "omega", "phi", "kappa"],
)
FOLDERS = ("", "params/", "1_initial/params/", "*/params/", "*/1_initial/params/")
"""Where a project may have its files, seen from its folder."""
FIELDS = {
    "camera matrix": "fx skew cx b3 fy cy - - -",
    "radial": "k1 k2 k3",
    "tangential": "p2 p1",
    "affine": "fx skew b3 fy",
    "polynomial": "polynomial",
    "principal": "cx cy",
    "position": "centre",
    "rotation": "rotation",
}
"""What the header of the camera parameters names, and the names of the numbers in `lenses`."""
SHAPE = re.compile(r"^(.*?)\s*\[\s*(\d{1,2})\s*x\s*(\d{1,2})\s*\]\s*$")
SENSOR = re.compile(r"sensor width of\s*([-+.\deE]+)\s*x\s*([-+.\deE]+)")
CALIBRATION = re.compile(r"(?im)^pix4d camera calibration file.*$")
PRIORS = {"xyz": ("x", "y", "z"), "gps": ("lng", "lat", "alt")}
"""Elements with the initial position of an image, and their attributes."""


def recognises(source: Source) -> bool:
    """Whether a file begins like one of the tables or a project, or a folder holds a table."""
    if source.path.is_dir():
        return bool(_tables_in(source.path))
    return b"<pix4uav" in source.head or _columns(source) in HEADERS


def read(source: Source) -> Cameras:
    """Read poses and lenses, in the CRS of the project."""
    files = _find(source)
    calibrations = read_calibrations(files["calibration"]) if "calibration" in files else []
    calibration = calibrations[0] if len(calibrations) == 1 else {}
    notes: tuple[PcfixWarning, ...] = ()
    labels, centres, rotations = list[str](), np.empty((0, 3)), np.empty((0, 3, 3))
    if "external" in files:
        labels, centres, rotations = read_external(files["external"])
    elif "parameters" not in files:
        sentence = f"{PARAMETERS} is missing. Give the params folder of the project."
        raise bad_file(source.path, "cameras.missing_file", sentence)
    given, own = labels, [_lens({}, calibration)] * len(labels)
    if path := files.get("parameters"):
        images = read_parameters(path)
        names = [image.label for image in images]
        matrices = np.array([image.fields["rotation"] for image in images]).reshape(-1, 3, 3)
        turns, posed = checks.rotations(path, names, matrices), [*range(len(images))]
        if "external" in files:
            rows, given = _rows(names, labels, (turns, rotations)), [*names, *labels]
            posed = [i for i in posed if rows[i] >= 0]
            if not posed:
                raise damaged(files["external"], f"names none of the images of {PARAMETERS}")
            centres, rotations = (each[rows][posed] for each in (centres, rotations))
        else:
            centres, rotations = np.array([image.fields["centre"] for image in images]), turns
            if beside := files.get("offset"):  # one line, or the same for each group of images
                lines = [line.replace(",", " ").split() for line in read_lines(beside)]
                offsets = {" ".join(words[-3:]) for words in lines if words}
                if len(offsets) != 1:
                    raise damaged(beside, "it should have one offset x y z")
                centres += numbers(beside, "the offset", offsets.pop(), 3)
            else:
                sentence = "there is no offset.xyz next to it. Give the offset by --cameras-offset."
                notes = (note(path, "cameras.no_offset", sentence),)
        labels = [names[i] for i in posed]
        own = [_lens(images[i].fields, calibration, images[i].size) for i in posed]
    lenses = tuple(lens for lens in own if lens is not None)
    gnss, enabled = _priors(files["project"], labels) if "project" in files else (None, [])
    wkt = " ".join(read_lines(files["wkt"])).strip() if "wkt" in files else ""
    return Cameras(
        labels=tuple(labels),
        centres=centres,
        rotations=rotations,
        lenses=lenses if len(lenses) == len(labels) else None,
        crs=checks.crs(files["wkt"], wkt) if wkt else None,
        notes=(*notes, *checks.repeated(source.path, labels)),
        gnss=gnss,
        unposed=tuple(n for n in dict.fromkeys([*given, *enabled]) if n not in set(labels)),
        source="Pix4D",
    )


def _columns(source: Source) -> list[str]:
    """Return the words of the first line of a file, lower case."""
    return source.text.lstrip().partition("\n")[0].lower().split()


def _find(source: Source) -> dict[str, Path]:
    """Return the files of the project that are there, by the names in `NAMES`, and ``project``.

    The project's name precedes that of the files; its file is next to its folder or in it.
    """
    path, columns = source.path, _columns(source)
    is_project, found = b"<pix4uav" in source.head, TABLE.fullmatch(path.name)
    tables = [(path.parent, found[1] if found else "")]
    if is_project or path.is_dir():
        tables = _tables_in(path.with_suffix("") if is_project else path)
    if not tables:
        return {}
    folder, prefix = tables[0]
    prefixes = {one for where, one in tables if where == folder}
    if len(prefixes) > 1:
        sentence = f"holds several projects ({', '.join(sorted(prefixes))}). Give one file."
        raise bad_file(folder, "cameras.several_projects", sentence, projects=len(prefixes))
    root = folder.resolve().parent.parent
    files = {kind: folder / (prefix + name) for kind, name in NAMES.items()}
    inside = root / f"{prefix.rstrip('_')}.p4d"
    files["project"] = inside if inside.is_file() else root.parent / f"{root.name}.p4d"
    if is_project:
        files["project"] = path
    elif columns[:1] == ["filename"]:
        files["parameters"] = path
    elif columns[1:2] == ["x"]:
        files["external"] = path
    return {kind: file for kind, file in files.items() if file.is_file()}


def _tables_in(root: Path) -> list[tuple[Path, str]]:
    """Return folders with tables of poses, and the name of the project before that of each."""
    return [
        (file.parent, found[1])
        for inside in FOLDERS
        for file in sorted(root.glob(f"{inside}*.txt"))
        if (found := TABLE.fullmatch(file.name)) and not found[2]
    ]


def _rows(
    labels: Sequence[str], names: Sequence[str], turns: tuple[FloatArray, FloatArray] | None = None
) -> list[int]:
    """Return the row of each label among names, each once, -1 where there is none left of it.

    Of equal names it is the first, or that with the most similar rotation of `turns`.
    """
    left: dict[str, list[int]] = defaultdict(list)
    for row, name in enumerate(names):
        left[name].append(row)
    found = []
    for i, label in enumerate(labels):
        rows, nearest = left[label], 0
        if turns and len(rows) > 1:
            differences = turns[1][rows] - turns[0][i]
            nearest = int(np.argmin(np.linalg.norm(differences, axis=(1, 2))))
        found.append(rows.pop(nearest) if rows else -1)
    return found


def _priors(path: Path, labels: list[str]) -> tuple[GnssPositions | None, list[str]]:
    """Read the initial positions of images, and the names of all that are enabled.

    The positions are those of the kind that the first image has: in WGS 84, or in a CRS.
    """
    root = read_xml(path)
    images = [
        image
        for image in root.iter("image")
        if image.get("path") and image.get("enabled", "true").lower() != "false"
    ]
    names = [PureWindowsPath(image.get("path", "")).name for image in images]
    of_label = {i: images[row] for i, row in enumerate(_rows(labels, names)) if row >= 0}
    kinds = [kind for image in of_label.values() for kind in PRIORS if image.find(kind) is not None]
    places = {}
    for i, image in of_label.items():
        position, where = image.find(kinds[0]) if kinds else None, f"image {labels[i]}, "
        if position is not None:
            stated = [image.find(f"tolerance{axes}") for axes in ("XY", "XY", "Z")]
            sigma = [
                np.nan if e is None else number(path, where + e.tag, e.get("value")) for e in stated
            ]
            axes = PRIORS[kinds[0]]
            places[i] = [number(path, where + axis, position.get(axis)) for axis in axes], sigma
    crs: str | None = "EPSG:4326"
    if kinds and kinds[0] == "xyz":
        found = [e for e in root.iter() if str(e.tag).lower() in ("wktimage", "wktimages")]
        text = (found[0].get("value") or found[0].text or "").strip() if found else ""
        crs = checks.crs(path, text) if text else None
    return checks.measured(range(len(labels)), places, crs), names


def read_external(path: Path) -> tuple[list[str], FloatArray, FloatArray]:
    """Read the absolute table: labels, centres (k, 3) and rotations (k, 3, 3)."""
    rows = [line.rsplit(None, 6) for line in read_lines(path)[1:] if line.strip()]
    if not rows:
        raise damaged(path, "has a header but no images")
    values = np.array([numbers(path, f"image {row[0]}", " ".join(row[1:]), 6) for row in rows])
    return [row[0].strip() for row in rows], values[:, :3], from_omega_phi_kappa(*values[:, 3:].T)


class Image(NamedTuple):
    """One image of the camera parameters; `fields` has its numbers by the names in `FIELDS`."""

    label: str
    size: tuple[float, float]
    fields: dict[str, FloatArray]


def read_parameters(path: Path) -> list[Image]:
    """Read the camera parameters; their layout is what the header names with sizes."""
    lines = [line for line in read_lines(path) if line.strip()]
    layout, row = [], 1
    for i, line in enumerate(lines[:20], start=1):
        if shape := SHAPE.match(line):
            words = shape[1].lower()
            name = next((name for word, name in FIELDS.items() if word in words), "")
            layout.append((name, int(shape[2]) * int(shape[3])))
        if shape or line.strip().lower().startswith("camera model"):
            row = i
    if not {("centre", 3), ("rotation", 9)} <= set(layout):
        raise damaged(path, "its header has no 'camera position t [3x1]' or 'rotation R [3x3]'")
    ends = np.cumsum([count for _, count in layout])
    images = []
    while row < len(lines):
        label, *size = lines[row].rsplit(None, 2)
        where, words_of = f"image {label}", list[str]()
        row += 1
        while len(words_of) < ends[-1] and row < len(lines):
            words_of += lines[row].split()
            row += 1
        width, height = numbers(path, where, " ".join(size), 2).tolist()
        parts = np.split(numbers(path, where, " ".join(words_of), ends[-1]), ends[:-1])
        fields = {name: part for (name, _), part in zip(layout, parts, strict=True) if name}
        images.append(Image(label.strip(), (width, height), fields))
    if not images:
        raise damaged(path, "has a header but no images")
    return images


def read_calibrations(path: Path) -> list[dict[str, float]]:
    """Read the cameras of a ``pix4d_..._internal_camera_parameters.cam``.

    They are the first number of each line by its name, and `width`, `height` of the sensor, mm.
    """
    cameras: list[dict[str, float]] = []
    for text in CALIBRATION.split("\n".join(read_lines(path)))[1:]:
        size, rows = SENSOR.search(text), [line.split() for line in text.splitlines()]
        sides = " ".join(size.groups()) if size else "0 0"
        given = dict(zip(("width", "height"), numbers(path, "sensor", sides, 2), strict=True))
        for name, *values in filter(None, rows):
            if values and not name.startswith("#"):
                given[name.lower()] = number(path, f"camera {len(cameras)}, {name}", values[0])
        cameras.append(given)
    return cameras


def _lens(
    fields: dict[str, FloatArray], calibration: dict[str, float],
    size_px: tuple[float, float] | None = None,
) -> Lens | None:  # fmt: skip
    """Return the lens of an image, in pixels, or else that of the calibration of all images.

    The latter is in mm where the size of the image is not known. None where neither suffices: a
    fisheye needs the size, as its matrix is in pixels and its principal point in mm.
    """
    given: dict[str, float] = {}
    for names, values in fields.items():
        given |= zip(names.split(), values.tolist(), strict=False)
    if "fx" in given and size_px:
        if "polynomial" in fields:
            return fisheye(given, fields["polynomial"].tolist(), *size_px)
        return lens_by_name(given, *size_px)
    value = defaultdict(float, calibration)
    size_mm, is_fisheye = (value["width"], value["height"]), "c" in calibration
    is_known = {"px", "py", "f"} <= calibration.keys() and min(size_mm) > 0.0
    if not is_known or (is_fisheye and not size_px):
        return None
    scale = size_px[0] / size_mm[0] if size_px else 1.0
    given = {"cx": value["px"] * scale, "cy": value["py"] * scale}
    if is_fisheye:
        given |= {"fx": value["c"], "skew": value["d"], "b3": value["e"], "fy": value["f"]}
        shape = [value["p0"], calibration.get("p1", 1.0), value["p2"], value["p3"], value["p4"]]
        return fisheye(given, shape, *(size_px or size_mm))
    given |= {"f": value["f"] * scale, "p1": value["t2"], "p2": value["t1"]}
    given |= {k: value[k] for k in ("k1", "k2", "k3")}
    return lens_by_name(given, *(size_px or size_mm), unit="px" if size_px else "mm")


def fisheye(given: dict[str, float], shape: Sequence[float], *frame: float) -> Lens:
    """Return the lens (u, v) = (cx, cy) + [c d; e f] rho, rho a polynomial of 2 theta / pi.

    The matrix is given as fx, skew, b3, fy.
    """
    return lens_by_name(given, *frame, projection="polynomial", shape=tuple(shape))


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read ``tp_bingo.txt``, or ``tp_pix4d.txt`` where there is no other.

    Lines are an image (and the size of its sensor, as in H_23.52_15.68), its points, and -99.
    """
    files = _find(source)
    path = files.get("bingo") or files.get("ties")
    if path is None:
        raise checks.no_tie_points(source.path, "no tp_bingo.txt or tp_pix4d.txt is next to it")
    if cameras.lenses is None:
        raise checks.no_tie_points(path, "it needs lenses, and the cameras have none")
    labels = list(enumerate(cameras.labels))[::-1]  # of equal names the first counts
    row_of = {PurePath(label).stem: i for i, label in labels} | {label: i for i, label in labels}
    names, rows, measured = list[str](), list[int](), list[list[str]]()
    with checks.reading(path):
        image: int | None = None
        for line in read_lines(path):
            words = line.split()
            if not words or words[0] == "-99":
                image = None
            elif image is None:
                text, size = line.strip(), words[-1].split("_")
                image = row_of.get(text, row_of.get(text.rpartition(" ")[0].strip(), -1))
                sides = size[-2:] if len(size) >= 3 else ["nan", "nan"]
            elif len(words) not in (3, 4):
                raise damaged(path, f"'{line.strip()[:60]}' is not a point and its x and y")
            elif image >= 0:
                names.append(words[0])
                rows.append(image)
                measured.append([*words[1:3], *sides])
        if not rows:
            raise checks.no_tie_points(path, "it measures nothing in the images that are posed")
        xy, sensor = np.split(np.array(measured, np.float64), 2, axis=1)
        if path == files.get("bingo"):
            if not (sensor > 0.0).all():
                raise damaged(path, "the line of an image lacks its sensor size H_width_height")
            frame = np.array([(lens.width, lens.height) for lens in cameras.lenses])[rows]
            # from mm from the image centre, y up, to the unit of the lens from the upper left
            xy = frame / 2.0 + xy * np.array([1.0, -1.0]) * frame / sensor
        points, point = np.unique(names, return_inverse=True)
        known = {}  # where the adjustment placed the control points
        if "gcps" in files:
            lines = [line.split(",") for line in read_lines(files["gcps"])[1:]]
            known = {row[0].strip(): checks.triple(row[4:7]) for row in lines if len(row) > 1}
        unknown = np.full(3, np.nan)
        xyz = np.array([known.get(name.partition("_")[2], unknown) for name in points.tolist()])
        return checks.tie_points(checks.Seen(xyz, point, np.array(rows), xy))
