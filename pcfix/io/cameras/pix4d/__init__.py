"""Pix4D: the ``params`` folder of a project, one of its files, or the project file itself.

Two tables give the exterior orientation. ``calibrated_camera_parameters.txt`` has for each image
its name and size, the matrix K, the distortion, the projection centre less the offset of
``offset.xyz``, and the rotation world to camera (x right, y down, z forward); pixels start at the
corner of the image, and the tangential coefficients are in OpenCV's order. A fisheye lens has
instead of K and the distortion an affine matrix and a polynomial of 2 theta / pi.
``calibrated_external_camera_parameters.txt`` has absolute centres and omega, phi, kappa of axes
x right, y up, z back: R = diag(1, -1, -1) (Rx(omega) Ry(phi) Rz(kappa))^T. The two agree to
1e-6 m where the offset is right; as an offset can be wrong, the absolute table is believed.

``pix4d_calibrated_internal_camera_parameters.cam`` has the interior orientation in millimetres,
``wkt.prj`` the CRS, and the project file (.p4d) the GNSS positions.
Image measurements are in ``tp_bingo.txt`` (mm from the image centre, y up, the size of the sensor
beside each name) and ``tp_pix4d.txt`` (pixels). ``calibrated_images_position.txt`` and
``pmatrix.txt`` repeat what the tables say.

References: Pix4D, "What does the Output Params Folder contain?" (support.pix4d.com, article
202977149), "How are the Internal and External Camera Parameters defined?" (article 202559089).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path, PurePath, PureWindowsPath
from typing import NamedTuple, TypeAlias
from xml.etree.ElementTree import Element

import numpy as np

from pcfix.errors import PcfixWarning, bad_file
from pcfix.io.cameras import checks, tracks
from pcfix.io.cameras.checks import damaged, number, read_xml
from pcfix.io.cameras.formats import Source
from pcfix.io.cameras.pix4d import tables
from pcfix.io.cameras.pix4d.tables import read_text
from pcfix.model import Cameras, FloatArray, GnssPositions, Lens, TiePoints

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
HEADERS = (
    ["filename", "imagewidth", "imageheight"],
    ["imagename", "x", "y", "z", "omega", "phi", "kappa"],
    ["imagename", "longitude", "latitude", "altitude", "omega", "phi", "kappa"],
)
Files: TypeAlias = dict[str, Path]
"""The files of a project that are there, by the names in `NAMES`, and ``project``."""


def recognises(source: Source) -> bool:
    """Whether a file begins like one of the tables or a project, or a folder holds a table."""
    if source.path.is_dir():
        return any(_prefixes(folder) for folder in _folders(source.path))
    return _is_project(source) or _columns(source) in HEADERS


def read(source: Source) -> Cameras:
    """Read poses and lenses, in the CRS of the project."""
    files = _find(source)
    if not files.keys() & {"parameters", "external"}:
        remedy = f"Give the params folder of the project; {GEOGRAPHIC} alone does not suffice"
        raise checks.missing(source.path.with_name(PARAMETERS), remedy)
    calibrations = tables.read_calibrations(files["calibration"]) if "calibration" in files else []
    if "parameters" in files:
        images = tables.read_parameters(files["parameters"])
        poses = _poses(files, images)
        used = [images[row] for row in poses.rows]
        lenses = tables.lenses_of_images(used, calibrations)
    else:
        poses, lenses = _external_only(files, calibrations)
    labels, posed = tuple(poses.labels), set(poses.labels)
    gnss, others = _priors(files["project"], labels) if "project" in files else (None, ())
    wkt = read_text(files["wkt"]).strip() if "wkt" in files else ""
    return Cameras(
        labels=labels,
        centres=poses.centres,
        rotations=poses.rotations,
        lenses=lenses,
        crs=checks.crs(files["wkt"], wkt) if wkt else None,
        notes=(*poses.notes, *checks.repeated(source.path, labels)),
        gnss=gnss,
        unposed=tuple(dict.fromkeys(n for n in (*poses.unposed, *others) if n not in posed)),
        source="Pix4D",
    )


def _columns(source: Source) -> list[str]:
    """Return the words of the first line of a file, lower case."""
    return source.text.lstrip().partition("\n")[0].lower().split()


def _is_project(source: Source) -> bool:
    """Whether a file is a Pix4D project (.p4d)."""
    return b"<pix4uav" in source.head


def _find(source: Source) -> Files:
    """Return the files of the project that a folder holds, or that a file belongs to."""
    path = source.path
    if _is_project(source):
        files = _in_folders(path.with_suffix(""))
        return {**files, "project": path} if files else files
    if path.is_dir():
        return _in_folders(path)
    files = _named(path.parent, _prefix(path.name, PARAMETERS, EXTERNAL, GEOGRAPHIC) or "")
    columns = _columns(source)
    if columns[:1] == ["filename"]:
        files["parameters"] = path
    elif columns[1:2] == ["x"]:
        files["external"] = path
    return files


def _in_folders(root: Path) -> Files:
    for folder in _folders(root):
        prefixes = _prefixes(folder)
        if len(prefixes) > 1:
            sentence = (
                f"holds the tables of several projects ({', '.join(sorted(prefixes))}). Give one of"
                " the files instead."
            )
            raise bad_file(folder, "cameras.several_projects", sentence, projects=len(prefixes))
        if prefixes:
            return _named(folder, prefixes.pop())
    return {}


def _prefixes(folder: Path) -> set[str]:
    """Return the names of the projects that have a table of poses in a folder."""
    found = (_prefix(path.name, PARAMETERS, EXTERNAL) for path in folder.iterdir())
    return {prefix for prefix in found if prefix is not None}


def _folders(root: Path) -> Iterator[Path]:
    """Yield the folders in which a project may have its tables."""
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


AGREE_M = 0.01
AGREE_DEG = 0.001


class Poses(NamedTuple):
    """The posed images: labels, centres, rotations, and their rows in the camera parameters."""

    labels: list[str]
    centres: FloatArray
    rotations: FloatArray
    rows: list[int]
    unposed: list[str]
    notes: tuple[PcfixWarning, ...]


def _external_only(
    files: Files, calibrations: list[tables.Calibration]
) -> tuple[Poses, tuple[Lens, ...] | None]:
    """Return the poses of the absolute table, with a lens where all images must share it."""
    labels, centres, rotations = tables.read_external(files["external"])
    lens = tables.lens_of_calibration(calibrations[0]) if len(calibrations) == 1 else None
    note = checks.without_lens(files["external"], f"there is no {PARAMETERS} beside it")
    poses = Poses(labels, centres, rotations, [], [], () if lens else (note,))
    return poses, None if lens is None else (lens,) * len(labels)


def _poses(files: Files, images: list[tables.Image]) -> Poses:
    """Return the poses of the two tables; the absolute one is believed."""
    labels = [image.label for image in images]
    turns = np.array([image.fields["rotation"] for image in images])
    rotations = checks.rotations(files["parameters"], labels, turns)
    centres, notes = _absolute(files, images)
    names: list[str] = []
    if "external" in files:
        names, there, turned = tables.read_external(files["external"])
        row_of = _matched(labels, rotations, names, turned)
        both = [i for i, row in enumerate(row_of) if row is not None]
        rows = [row for row in row_of if row is not None]
        notes = _compared(
            files["external"], centres[both], rotations[both], there[rows], turned[rows]
        )
        if notes:
            centres = np.full_like(centres, np.nan)
        centres[both], rotations[both] = there[rows], turned[rows]
    known = np.isfinite(centres).all(axis=1)
    kept = np.flatnonzero(known).tolist()
    unposed = [labels[i] for i in np.flatnonzero(~known)] + sorted(set(names) - set(labels))
    posed = [labels[i] for i in kept]
    return Poses(posed, centres[known], rotations[known], kept, unposed, notes)


def _absolute(
    files: Files, images: list[tables.Image]
) -> tuple[FloatArray, tuple[PcfixWarning, ...]]:
    """Return the centres with the offset added; NaN where several offsets name no such image."""
    local = np.array([image.fields["centre"] for image in images])
    if "offset" not in files and "external" in files:
        return np.full_like(local, np.nan), ()
    if "offset" not in files:
        sentence = (
            f"{files['parameters']}: its positions lack an offset, and there is no offset.xyz"
            " beside it. Give the offset with --cameras-offset."
        )
        return local, (PcfixWarning("cameras.no_offset", sentence, path=files["parameters"]),)
    offsets = tables.read_offsets(files["offset"])
    if len({values.tobytes() for _, values in offsets}) == 1:
        return local + offsets[0][1], ()
    added = np.full_like(local, np.nan)
    for i, image in enumerate(images):
        fitting = [values for label, values in offsets if label and image.label.startswith(label)]
        if fitting:
            added[i] = local[i] + fitting[0]
    return added, ()


def _matched(
    labels: list[str], rotations: FloatArray, names: list[str], turned: FloatArray
) -> list[int | None]:
    """Return the row of each label among the names; of equal names the one turned most alike."""
    rows: dict[str, list[int]] = defaultdict(list)
    for row, name in enumerate(names):
        rows[name].append(row)
    matched: list[int | None] = []
    for label, rotation in zip(labels, rotations, strict=True):
        left = rows[label]
        unlike = np.linalg.norm(turned[left] - rotation, axis=(1, 2))
        matched.append(left.pop(int(np.argmin(unlike))) if left else None)
    return matched


def _compared(
    path: Path, local: FloatArray, rotations: FloatArray, centres: FloatArray, turned: FloatArray
) -> tuple[PcfixWarning, ...]:
    """Return a note when the two tables disagree; the first may lack its offset."""
    if len(centres) == 0:
        raise damaged(path, f"names none of the images of {PARAMETERS} beside it")
    distances = np.linalg.norm(local - centres, axis=1)
    apart = float(distances[np.isfinite(distances)].max(initial=0.0))
    sines = np.linalg.norm(rotations - turned, axis=(1, 2)) / np.sqrt(8.0)
    turn = float(np.degrees(2.0 * np.arcsin(np.clip(sines, 0.0, 1.0))).max())
    if apart <= AGREE_M and turn <= AGREE_DEG:
        return ()
    sentence = (
        f"{path}: its poses differ by up to {apart:.2f} m and {turn:.3f} degrees from those of"
        f" {PARAMETERS} with offset.xyz. The absolute ones are used; images that only the other"
        " table has are left out."
    )
    return (PcfixWarning("cameras.tables_differ", sentence, metres=apart, degrees=turn),)


WGS84 = "EPSG:4326"
Prior: TypeAlias = tuple[str, FloatArray, FloatArray]
"""The element that has the position of an image, that, and its standard deviations, metres."""


def _priors(path: Path, labels: tuple[str, ...]) -> tuple[GnssPositions | None, tuple[str, ...]]:
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


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read ``tp_bingo.txt``, or ``tp_pix4d.txt`` where there is no other."""
    files = _find(source)
    path = files.get("bingo") or files.get("ties")
    if path is None:
        raise tracks.no_tie_points(source.path, "no tp_bingo.txt or tp_pix4d.txt is beside it")
    if cameras.lenses is None:
        raise tracks.no_tie_points(path, "the cameras have no lenses, which it needs")
    with checks.reading(path):
        return _observations(files, path, cameras, cameras.lenses)


def _observations(
    files: Files, path: Path, cameras: Cameras, lenses: tuple[Lens, ...]
) -> TiePoints:
    labels = list(enumerate(cameras.labels))[::-1]  # of equal names the first counts
    stems = {PurePath(label).stem: i for i, label in labels}
    measured = _measured(path, stems | {label: i for i, label in labels})
    camera = np.array([row for _, row, *_ in measured], dtype=np.int64)
    posed = camera >= 0
    if not posed.any():
        raise tracks.no_tie_points(path, "it measures nothing in the images that are posed")
    xy = np.array([row[2:4] for row in measured], dtype=float)
    if path == files.get("bingo"):
        sensor = np.array([row[4:] for row in measured], dtype=float)
        if not (sensor[posed] > 0.0).all():
            raise damaged(path, "the line of an image lacks its sensor size H_width_height")
        frame = np.array([(lens.width, lens.height) for lens in lenses])[camera]
        # from mm from the image centre, y up, to the unit of the lens from the upper left
        xy = frame / 2.0 + xy * np.array([1.0, -1.0]) * frame / sensor
    points = np.array([name for name, *_ in measured])
    names, point = np.unique(points[posed], return_inverse=True)
    known = {}  # where the adjustment placed the control points
    if "gcps" in files:
        lines = [line.split(",") for line in read_text(files["gcps"]).splitlines()[1:]]
        known = {row[0].strip(): checks.triple(row[4:7]) for row in lines if len(row) > 1}
    unknown = np.full(3, np.nan)
    xyz = np.array([known.get(name.partition("_")[2], unknown) for name in names.tolist()])
    return tracks.tie_points(tracks.Seen(xyz, point, camera[posed], xy[posed]))


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
            raise damaged(path, f"'{line.strip()[:60]}' is not a point and its x and y")
    return found
