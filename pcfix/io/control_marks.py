"""Files of surveyed points and their marks in images, as rows: one mark a row.

A table has a header line and the columns

- name (or point, gcp, marker, ...), image, u, v: pixels from the upper left corner of the image;
- x, y, z (or easting, northing, height; longitude, latitude, height in degrees of WGS 84);
- where known sx, sy, sz, or one column sigma, in metres; su, sv, or one column sigma_px; role (or
  type): control, check, waterline (the point lies on the water) or on:NAME (on the plane of that
  name), these two with sigma_on, metres, and x, y, z only where they were surveyed: then they count
  as of a control point; under_water: yes or no; crs. A comment before the header may state the
  CRS too: ``# CRS: EPSG:32636``.

OpenDroneMap's ``gcp_list.txt`` has no header: its first line is a CRS (EPSG code, ``WGS84 UTM 36N``
or a PROJ string), the others are x, y, z, u, v, image and, where given, the name of the point.
Points without a name are told apart by their coordinates. Its pixels are taken to count from the
corner too; its documentation does not say.

A ``marker`` of a Metashape chunk (a project, or its *Export Markers*) has a label and a
``reference``: x, y, z in ``marker_reference`` (else in the ``reference`` of the chunk) and, where
stated, accuracies sxyz, or sxy, or sx, sy, sz; for the others the chunk's settings
``accuracy_markers`` (m) and ``accuracy_projections`` (px) hold. A reference that is unticked
(``enabled="false"``) makes a check point. The first frame has where the images show each marker, in
pixels from the upper left corner; a ``location`` that is not pinned was computed by Metashape and
is no measurement.

Reference: "Ground Control Points" in the manual of OpenDroneMap, https://docs.opendronemap.org/gcp.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras.checks import number as xml_number
from pcfix.io.cameras.checks import numbers
from pcfix.io.cameras.formats import Source
from pcfix.io.cameras.metashape import SPREADS, documents
from pcfix.io.cameras.metashape.documents import Chunk
from pcfix.io.cameras.odm import named_crs
from pcfix.io.cameras.table import centres, crs
from pcfix.io.cameras.table.columns import Columns, headers, is_header, read_columns
from pcfix.io.crs import is_local, parse_crs
from pcfix.io.tables import number, read_lines
from pcfix.io.transformations import LOCAL
from pcfix.model import BoolArray, FloatArray

SPELLINGS: dict[str, tuple[str, ...]] = {
    "point": (
        *("point", "name", "gcp", "gcp_name", "gcp_id", "gcp_label", "marker", "point_name"),
        *("point_id", "pointid", "id", "label"),
    ),
    "label": (
        *("image", "image_name", "imagename", "filename", "file_name", "file", "photo", "photoid"),
        *("photo_id", "photo_name", "photoname", "picture", "image_label", "sourcefile"),
    ),
    "u": ("u", "u_px", "im_x", "image_x", "image_u", "pixel_x", "pixelx"),
    "v": ("v", "v_px", "im_y", "image_y", "image_v", "pixel_y", "pixely"),
    "sigma_x": ("sx", "sigma_x", "accuracy_x", "sxy", "sigma", "sxyz", "accuracy"),
    "sigma_y": ("sy", "sigma_y", "accuracy_y", "sxy", "sigma", "sxyz", "accuracy"),
    "sigma_z": ("sz", "sigma_z", "accuracy_z", "sigma", "sxyz", "accuracy"),
    "sigma_u": ("su", "sigma_u", "sigma_px", "sigma_uv"),
    "sigma_v": ("sv", "sigma_v", "sigma_px", "sigma_uv"),
    "role": ("role", "type"),
    "sigma_on": ("sigma_on",),
    "under_water": ("under_water", "underwater", "submerged"),
    "crs": ("crs", "srs"),
}
"""What a column is, and its names; where several are there, the first counts."""
CHECK = ("check", "check_point", "checkpoint", "cp", "chk")
CONTROL = ("", "control", "control_point", "controlpoint", "gcp", "3d_gcp", "ground_control_point")
ON, WATERLINE = "on:", ("waterline", "water_line", "shoreline", "on:water")
YES, NO = ("yes", "y", "true", "1"), ("", "no", "n", "false", "0")
PIXELS = ("", "px", "pixel", "pixels", "pix")
_LEAST_ODM = 6


@dataclass(frozen=True, eq=False)
class Marks:
    """Marks of points in images, n of them, with what the file says of the point in each row.

    Standard deviations are NaN where none is stated; `where` is the place of each row in the file.
    """

    path: Path
    point: list[str]
    image: list[str]
    xyz: FloatArray  # (n, 3), in `crs`
    sigma_m: FloatArray  # (n, 3)
    uv: FloatArray  # (n, 2)
    sigma_px: FloatArray  # (n,)
    is_check: BoolArray
    under_water: BoolArray
    where: list[str]
    crs: str | None
    on: tuple[str, ...] = ()  # surface on which the point lies; all rows, or none where none does
    sigma_on: FloatArray = field(default_factory=lambda: np.zeros(0))

    def at(self, row: int) -> str:
        """Return file, place, point and image of a row, for messages."""
        return f"{self.path}: {self.where[row]}: point {self.point[row]}, image {self.image[row]}"


def read_marks(path: Path) -> Marks:
    """Read a table of marks, OpenDroneMap's ``gcp_list.txt``, or markers of Metashape.

    An `InputError` if it is none of these, or a field is not what it should be.
    """
    if documents.recognises(Source(path)):
        return _from_metashape(path)
    lines = read_lines(path)
    rows = _odm_rows(path, lines)
    if rows is None and not any(is_header(header.names) for header in headers(lines)):
        raise InputError(
            f"{path}: is neither a table of marks nor OpenDroneMap's gcp_list.txt; line 1 must name"
            " the columns name, x, y, z, image, u, v, or be a CRS above rows of x, y, z, u, v,"
            " image."
        )
    return _from_table(path) if rows is None else _from_odm(path, rows)


def _from_table(path: Path) -> Marks:
    columns = _with_roles(read_columns(path))
    system, doubt = crs(columns)
    if doubt:
        raise InputError(
            f"{path}: its CRS '{columns.crs}' is not one that PROJ knows; give an EPSG code."
        )
    sigma = columns.where_there(("sigma_x", "sigma_y", "sigma_z"))
    sigma_uv = columns.where_there(("sigma_u", "sigma_v"))
    sigma_on, on = columns.where_there(("sigma_on",))[:, 0], _surfaces(columns)
    roles = "control or check, waterline or on:NAME"
    is_check = _flags(columns, "role", CHECK, CONTROL, roles, on)
    every = np.column_stack([sigma, sigma_uv, sigma_on])
    for i in np.flatnonzero((every <= 0.0).any(axis=1))[:1]:
        value = every[i][every[i] <= 0.0][0]
        raise InputError(
            f"{columns.where(int(i))}: the standard deviation {value:g} must be positive."
        )
    names = _texts(columns, "point")
    if "" in names:
        line = columns.table.line[names.index("")]
        raise InputError(f"{path}: line {line}: the point has no name.")
    return Marks(
        path=path,
        point=names,
        image=columns.labels,
        xyz=_places(columns, on),
        sigma_m=sigma,
        uv=columns.of(("u", "v")),
        sigma_px=np.sqrt((sigma_uv**2).mean(axis=1)),
        is_check=is_check,
        under_water=_flags(columns, "under_water", YES, NO, "yes or no"),
        where=[f"line {line}" for line in columns.table.line],
        crs=system,
        on=on,
        sigma_on=sigma_on,
    )


def _surfaces(columns: Columns) -> tuple[str, ...]:
    """Return the surface on which the point of each row lies, by its role; empty where on none."""
    if "role" not in columns.place:
        return ("",) * len(columns.table.rows)
    found = []
    for text in _texts(columns, "role"):
        role = text.strip().lower().replace(" ", "_")
        is_on = role.startswith(ON) and role != ON
        found.append("water" if role in WATERLINE else role.removeprefix(ON) if is_on else "")
    return tuple(found)


def _places(columns: Columns, on: tuple[str, ...]) -> FloatArray:
    """Return the coordinates of each row; those of points on a surface may be missing."""
    if not any(on):
        return centres(columns, needed=True)
    xyz = centres(columns)
    bare = [i for i in np.flatnonzero(np.isnan(xyz).any(axis=1)) if not on[i]]
    if bare:
        raise InputError(
            f"{columns.where(int(bare[0]))}: the point has no x, y, z; only points with the role"
            " waterline or on:NAME may be without."
        )
    return xyz


def _with_roles(columns: Columns) -> Columns:
    """Return columns with the places that they have in a table of marks."""
    header = columns.table.header
    place = {role: i for role, i in columns.place.items() if role in _POSITION}
    for role, spellings in SPELLINGS.items():
        there = [header.index(name) for name in spellings if name in header]
        if there:
            place[role] = there[0]
    missing = [_PLAIN.get(role, role) for role in ("point", "label", "u", "v") if role not in place]
    if missing:
        raise InputError(
            f"{columns.path}: the header must name the columns name, x, y, z, image, u, v;"
            f" {', '.join(missing)} missing (it has: {', '.join(header)})."
        )
    for role in "uv":
        if columns.unit[place[role]] not in PIXELS:
            raise InputError(
                f"{columns.path}: column {header[place[role]]} is in"
                f" '{columns.unit[place[role]]}'; give pixels from the upper left corner."
            )
    found = replace(columns, place=place)
    return replace(found, crs=_one_crs(found)) if "crs" in place else found


_POSITION = ("x", "y", "z", "longitude", "latitude")
_PLAIN = {"point": "name", "label": "image"}


def _one_crs(columns: Columns) -> str | None:
    stated = {text for text in _texts(columns, "crs") if text}
    if len(stated) > 1:
        raise InputError(
            f"{columns.path}: states {len(stated)} CRS ({', '.join(sorted(stated)[:3])}); bring all"
            " points to one."
        )
    return stated.pop() if stated else columns.crs


def _texts(columns: Columns, role: str) -> list[str]:
    return [row[columns.place[role]] for row in columns.table.rows]


def _flags(
    columns: Columns, role: str, true: tuple[str, ...], false: tuple[str, ...], words: str,
    on: tuple[str, ...] = (),
) -> BoolArray:  # fmt: skip
    """Return whether each row says one thing or the other; the latter where nothing is said.

    And where it says `on` which surface the point lies.
    """
    if role not in columns.place:
        return np.zeros(len(columns.table.rows), bool)
    found = [text.strip().lower().replace(" ", "_") for text in _texts(columns, role)]
    for i, text in enumerate(found):
        if text not in true and text not in false and not (on and on[i]):
            raise InputError(
                f"{columns.where(i)}, column {columns.name(role)}: '{text}' is neither {words}."
            )
    return np.array([text in true for text in found])


def _odm_rows(path: Path, lines: list[str]) -> list[tuple[int, list[str]]] | None:
    """Return line number and fields of the rows of gcp_list.txt, None where it is none."""
    numbered = [(i, line.split()) for i, line in enumerate(lines, start=1) if line.strip()]
    rows = [(i, fields) for i, fields in numbered[1:] if not fields[0].startswith("#")]
    if not rows or len(rows[0][1]) < _LEAST_ODM - 1:
        return None
    first = [number(field) for field in rows[0][1][:5]]
    if np.isnan([value for i, value in enumerate(first) if i != 2]).any():  # z may be NaN
        return None
    for i, fields in rows:
        if len(fields) < _LEAST_ODM:
            raise InputError(
                f"{path}: line {i} has {len(fields)} fields; give x, y, z, u, v, image and the name"
                " of the point."
            )
    return rows


def _from_odm(path: Path, rows: list[tuple[int, list[str]]]) -> Marks:
    values = np.array([[number(field) for field in fields[:5]] for _, fields in rows])
    if not np.isfinite(values).all():
        i, k = np.argwhere(~np.isfinite(values))[0]
        what = ("x", "y", "z", "u", "v")[k]
        raise InputError(
            f"{path}: line {rows[i][0]}: {what} '{rows[i][1][k]}' is not a finite number."
        )
    places = [tuple(row) for row in values[:, :3].tolist()]
    by_place = {place: f"GCP {i + 1}" for i, place in enumerate(dict.fromkeys(places))}
    names = [
        fields[_LEAST_ODM] if len(fields) > _LEAST_ODM else by_place[place]
        for (_, fields), place in zip(rows, places, strict=True)
    ]
    no = np.zeros(len(rows), bool)
    return Marks(
        path=path,
        point=names,
        image=[fields[5] for _, fields in rows],
        xyz=values[:, :3],
        sigma_m=np.full((len(rows), 3), np.nan),
        uv=values[:, 3:],
        sigma_px=np.full(len(rows), np.nan),
        is_check=no,
        under_water=no,
        where=[f"line {i}" for i, _ in rows],
        crs=named_crs(path),
    )


def _from_metashape(path: Path) -> Marks:
    """Read the markers that have a surveyed place and were measured."""
    chunk = documents.open_chunk(path)
    surveyed = {
        marker.get("id") or "": marker
        for marker in chunk.element.iterfind("markers//marker")
        if all(_reference(marker).get(axis) for axis in "xyz")
    }
    marks = [mark for mark in _locations(chunk) if mark[0] in surveyed]
    if not marks:
        raise InputError(
            f"{path}: has no marker with surveyed coordinates that was measured in an image; give"
            " the project, or export the markers."
        )
    of = [surveyed[marker] for marker, _, _ in marks]
    references = [_reference(marker) for marker in of]
    cameras = chunk.element.iterfind("cameras//camera")
    image = {camera.get("id"): _label(camera) for camera in cameras}
    default = _setting(chunk, "accuracy_markers")
    return Marks(
        path=path,
        point=[_label(marker) for marker in of],
        image=[image.get(camera, f"camera {camera}") for _, camera, _ in marks],
        xyz=np.array([_xyz(path, marker) for marker in of]),
        sigma_m=np.array([_sigma(path, marker, default) for marker in of]),
        uv=np.array([uv for _, _, uv in marks]),
        sigma_px=np.full(len(marks), _setting(chunk, "accuracy_projections")),
        is_check=np.array([each.get("enabled") in ("false", "0") for each in references]),
        under_water=np.zeros(len(marks), bool),
        where=[f"marker {_label(marker)}" for marker in of],
        crs=_marker_crs(chunk),
    )


def _reference(marker: Element) -> Element:
    found = marker.find("reference")
    return marker if found is None else found


def _label(marker: Element) -> str:
    return marker.get("label") or f"number {marker.get('id')}"


def _locations(chunk: Chunk) -> list[tuple[str, str, tuple[float, float]]]:
    """Return marker, camera and place of every measured location of the first frame."""
    first = chunk.element.find("frames/frame")
    if first is None:
        return []
    frame = chunk.document.follow(first)
    found = []
    for marker in frame.root.iterfind("markers//marker"):
        name = marker.get("marker_id") or ""
        for mark in marker.iterfind("location"):
            if mark.get("pinned") == "false" or mark.get("valid") == "false":
                continue
            camera = mark.get("camera_id") or ""
            where = f"marker {name}, camera {camera}"
            u, v = (xml_number(frame.path, where, mark.get(axis)) for axis in "xy")
            found.append((name, camera, (u, v)))
    return found


def _xyz(path: Path, marker: Element) -> list[float]:
    where = f"marker {_label(marker)}, reference"
    return [xml_number(path, where, _reference(marker).get(axis)) for axis in "xyz"]


def _sigma(path: Path, marker: Element, default: float) -> FloatArray:
    """Return the stated standard deviations, from the widest statement to the narrowest."""
    sigma = np.full(3, default)
    for name, axes in SPREADS:
        if text := _reference(marker).get(name):
            count = 1 if len(text.split()) == 1 else len(axes)
            where = f"marker {_label(marker)}, {name}"
            sigma[list(axes)] = numbers(path, where, text, count)
    return np.where(sigma > 0.0, sigma, np.nan)


def _setting(chunk: Chunk, name: str) -> float:
    """Return a positive number of the chunk's settings, NaN where it is not there."""
    for entry in chunk.element.iterfind("settings/property"):
        if entry.get("name") == name:
            value = xml_number(chunk.path, f"setting {name}", entry.get("value"))
            return value if value > 0.0 else np.nan
    return np.nan


def _marker_crs(chunk: Chunk) -> str:
    own = (chunk.element.findtext("marker_reference") or "").strip()
    text = own or (chunk.element.findtext("reference") or "").strip() or LOCAL
    if text.lower() == LOCAL or is_local(parse_crs(text, str(chunk.path))):
        return LOCAL
    return text
