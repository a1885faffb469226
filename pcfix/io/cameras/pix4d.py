"""Pix4D: the folder of a project, its ``params`` folder, or one of the tables of poses.

Two tables give the exterior orientation. ``calibrated_camera_parameters.txt`` has for each image
its name and size, the matrix K, the distortion, the projection centre minus the offset of
``offset.xyz``, and the rotation world to camera (x right, y down, z forward); pixels start at the
corner of the image, and the tangential coefficients are in OpenCV's order. A fisheye lens has
instead of K and the distortion an affine matrix and a polynomial of 2 theta / pi.
``calibrated_external_camera_parameters.txt`` has absolute centres and omega, phi, kappa of axes
x right, y up, z back: R = diag(1, -1, -1) (Rx(omega) Ry(phi) Rz(kappa))^T. Poses are read from
this table if it is there, because an offset can be wrong. Images of the same name are matched by
the most similar rotation.

``wkt.prj`` has the CRS, ``tp_bingo.txt`` the image measurements (mm from the image centre, y up,
the size of the sensor after each name), and ``measured_estimated_gcps_position.txt`` the adjusted
control points. Other files of the folder repeat these.

References: Pix4D, "What does the Output Params Folder contain?" (support.pix4d.com, article
202977149), "How are the Internal and External Camera Parameters defined?" (article 202559089).
"""

import re
from collections import defaultdict
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import numpy as np

from pcfix.errors import bad_file
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import Source, damaged, lens_by_name, numbers
from pcfix.io.tables import read_lines
from pcfix.lens.rotations import from_omega_phi_kappa
from pcfix.model import Cameras, FloatArray, Lens, TiePoints

# Names of the files of a project, after its own name.
NAMES = {
    "parameters": "calibrated_camera_parameters.txt",
    "external": "calibrated_external_camera_parameters.txt",
    "offset": "offset.xyz",
    "wkt": "wkt.prj",
    "bingo": "tp_bingo.txt",
    "gcps": "measured_estimated_gcps_position.txt",
}
TABLE = re.compile(r"(.*_|)calibrated_(?:external_)?camera_parameters(_wgs84)?\.txt")
HEADER = re.compile(
    r"(?i)\s*(filename imagewidth imageheight|imagename (x y z|longitude latitude altitude)"
    r" omega phi kappa)\s*?$",
    re.MULTILINE,
)
# Words in the header of the camera parameters, and the names of the numbers in `checks`.
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


def recognises(source: Source) -> bool:
    """Whether a file begins like one of the tables, or a folder has a table."""
    if source.path.is_dir():
        return bool(_tables_in(source.path))
    return HEADER.match(source.text) is not None


def read(source: Source) -> Cameras:
    """Read poses and lenses, in the CRS of the project."""
    files = _find(source)
    images = read_parameters(files["parameters"]) if "parameters" in files else []
    names, posed = [image.label for image in images], [*range(len(images))]
    turns = np.array([image.rotation for image in images])
    turns = checks.rotations(files.get("parameters", source.path), names, turns)
    if "external" in files:
        path = files["external"]
        listed = [line.rsplit(None, 6) for line in read_lines(path)[1:] if line.strip()]
        labels = [row[0].strip() for row in listed]
        texts = [(f"image {row[0]}", " ".join(row[1:])) for row in listed]
        poses = np.array([numbers(path, where, text, 6) for where, text in texts]).reshape(-1, 6)
        centres, rotations = poses[:, :3], from_omega_phi_kappa(*poses[:, 3:].T)
        if images:
            # of several images of a name, those with the most similar rotations belong together
            rows_of = defaultdict[str, list[int]](list)
            for row, label in enumerate(labels):
                rows_of[label].append(row)
            rows = []
            for name, turn in zip(names, turns, strict=True):
                off = np.linalg.norm(rotations[rows_of[name]] - turn, axis=(1, 2))
                rows.append(rows_of[name].pop(int(np.argmin(off))) if len(off) else -1)
            posed = [i for i in posed if rows[i] >= 0]
            if not posed:
                raise damaged(path, f"names none of the images of {NAMES['parameters']}")
            centres, rotations = (each[rows][posed] for each in (centres, rotations))
    else:
        labels, rotations = names, turns
        centres = np.array([image.centre for image in images]).reshape(-1, 3)
        if (where := files.get("offset")) is None:
            sentence = "there is no offset.xyz next to it. Give the offset by --cameras-offset."
            checks.warn(files["parameters"], "cameras.no_offset", sentence)
        else:  # the file repeats the offset for each group of images
            lines = [line.replace(",", " ").split() for line in read_lines(where)]
            offsets = {" ".join(words[-3:]) for words in lines if words}
            if len(offsets) != 1:
                raise damaged(where, "it should have one offset x y z")
            centres = centres + numbers(where, "the offset", offsets.pop(), 3)
    every = dict.fromkeys([*names, *labels])
    labels = [names[i] for i in posed] or labels
    unposed = tuple(name for name in every if name not in set(labels))
    lenses = tuple(images[i].lens for i in posed if images[i].lens is not None)
    known = lenses if len(lenses) == len(labels) else None
    wkt = " ".join(read_lines(files["wkt"])).strip() if "wkt" in files else ""
    crs = checks.crs(files["wkt"], wkt) if wkt else None
    return Cameras(tuple(labels), centres, rotations, known, crs, unposed=unposed)


# ---- files ----


def _find(source: Source) -> dict[str, Path]:
    """Return the files of the project that exist, by the names in `NAMES`.

    The project's name precedes that of the files.
    """
    path, begin = source.path, source.text.lstrip().lower()
    found = TABLE.fullmatch(path.name)
    tables = _tables_in(path) if path.is_dir() else [(path.parent, found[1] if found else "")]
    folder, prefix = tables[0]
    prefixes = {one for where, one in tables if where == folder}
    if len(prefixes) > 1:
        sentence = f"has several projects ({', '.join(sorted(prefixes))}). Give one file."
        raise bad_file(folder, "cameras.several_projects", sentence, projects=len(prefixes))
    files = {kind: folder / (prefix + name) for kind, name in NAMES.items()}
    if begin.startswith("filename"):
        files["parameters"] = path
    elif begin.startswith("imagename x"):
        files["external"] = path
    return {kind: file for kind, file in files.items() if file.is_file()}


def _tables_in(root: Path) -> list[tuple[Path, str]]:
    """Return folders with tables of poses, and the name of the project before that of each."""
    return [
        (file.parent, found[1])
        for inside in ("", "params/", "1_initial/params/", "*/params/", "*/1_initial/params/")
        for file in sorted(root.glob(f"{inside}*.txt"))
        if (found := TABLE.fullmatch(file.name)) and not found[2]
    ]


# ---- tables ----


class Image(NamedTuple):
    """An image of the camera parameters; the rotation is world to camera, shape (9,)."""

    label: str
    centre: FloatArray
    rotation: FloatArray
    lens: Lens | None


def read_parameters(path: Path) -> list[Image]:
    """Read the camera parameters, whose header names their fields with sizes."""
    lines = [line for line in read_lines(path) if line.strip()]
    layout, row = [], 1
    for i, line in enumerate(lines[:20], start=1):
        if shape := re.match(r"(.*?)\s*\[\s*(\d{1,2})\s*x\s*(\d{1,2})\s*\]\s*$", line):
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
        given, more = dict[str, float](), dict[str, Any]()
        for names, values in fields.items():
            given |= zip(names.split(), values.tolist(), strict=False)
        if "polynomial" in fields:
            more = {"projection": "polynomial", "shape": tuple(fields["polynomial"].tolist())}
        lens = lens_by_name(given, width, height, **more) if "fx" in given else None
        images.append(Image(label.strip(), fields["centre"], fields["rotation"], lens))
    return images


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read ``tp_bingo.txt``.

    Lines are an image and the size of its sensor, as in H_23.52_15.68, its points, and -99.
    """
    files = _find(source)
    path = files.get("bingo")
    if path is None:
        raise checks.no_tie_points(source.path, "no tp_bingo.txt is next to it")
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
                text, size = line.strip(), words[-1].split("_")[-2:]
                image = row_of.get(text, row_of.get(text.rpartition(" ")[0].strip(), -1))
            elif len(words) not in (3, 4):
                raise damaged(path, f"'{line.strip()[:60]}' is not a point and its x and y")
            elif image >= 0:
                names.append(words[0])
                rows.append(image)
                measured.append([*words[1:3], *size])
        if not rows:
            raise checks.no_tie_points(path, "it measures nothing in the images that are posed")
        xy_mm, sensor_mm = np.split(np.array(measured, np.float64), 2, axis=1)
        if not (sensor_mm > 0.0).all():
            raise damaged(path, "the line of an image lacks its sensor size H_width_height")
        frame = np.array([(lens.width, lens.height) for lens in cameras.lenses])[rows]
        # from mm from the image centre, y up, to the unit of the lens from the upper left
        uv = frame / 2.0 + xy_mm * np.array([1.0, -1.0]) * frame / sensor_mm
        points, point = np.unique(names, return_inverse=True)
        known = {}  # adjusted coordinates of the control points
        if "gcps" in files:
            lines = [line.split(",") for line in read_lines(files["gcps"])[1:]]
            known = {row[0].strip(): checks.triple(row[4:7]) for row in lines if len(row) > 1}
        unknown = np.full(3, np.nan)
        xyz = np.array([known.get(name.partition("_")[2], unknown) for name in points.tolist()])
        return checks.tie_points(checks.Observations(xyz, point, np.array(rows), uv))
