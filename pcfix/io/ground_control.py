"""Ground control: surveyed points and their marks in images, one mark per row.

A table has a header line and the columns

- name (or point, gcp, marker, ...), image, u, v: pixels from the upper left corner of the image;
- x, y, z (or easting, northing, height; longitude, latitude, height in degrees of WGS 84);
- optionally sx, sy, sz, or one column sigma, in metres; su, sv, or one column sigma_px; role (or
  type): control, check, waterline (the point lies on the water) or on:NAME (on the plane of that
  name), these two with sigma_on in metres, and with x, y, z only if they were surveyed, which makes
  them control points as well; under_water: yes or no; crs. A comment before the header may state
  the CRS too: ``# CRS: EPSG:32636``.

OpenDroneMap's ``gcp_list.txt`` has no header: its first line is a CRS (EPSG code, ``WGS84 UTM 36N``
or a PROJ string), the others are x, y, z, u, v, image and optionally the name of the point. Points
without a name are distinguished by their coordinates. Its pixels are assumed to count from the
corner too; its documentation does not say.

A ``marker`` of a Metashape chunk (a project, or its *Export Markers*) has a label and a
``reference``: x, y, z in ``marker_reference`` (else in the ``reference`` of the chunk) and, if
stated, accuracies sxyz, or sxy, or sx, sy, sz; otherwise the chunk's settings ``accuracy_markers``
(m) and ``accuracy_projections`` (px) are used. A disabled reference (``enabled="false"``) makes a
check point. The first frame has the images of each marker, in pixels from the upper left corner; a
``location`` that is not pinned was computed by Metashape and is no measurement.

Reference: "Ground Control Points" in the manual of OpenDroneMap, https://docs.opendronemap.org/gcp.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from pcfix.errors import InputError, PcfixWarning
from pcfix.io.cameras.checks import number as xml_number
from pcfix.io.cameras.checks import numbers
from pcfix.io.cameras.formats import Source
from pcfix.io.cameras.metashape import SPREADS, documents
from pcfix.io.cameras.metashape.documents import Chunk
from pcfix.io.cameras.odm import named_crs
from pcfix.io.cameras.table import centres
from pcfix.io.cameras.table import crs as table_crs
from pcfix.io.cameras.table.columns import Columns, headers, is_header, read_columns
from pcfix.io.crs import is_local, is_topocentric, parse_crs
from pcfix.io.files import check_input
from pcfix.io.labels import match_labels, unnamed
from pcfix.io.tables import number, read_lines
from pcfix.io.transformations import LOCAL, way_to_cloud
from pcfix.model import BoolArray, Cameras, FloatArray, GroundControl, IntArray
from pcfix.options.declare import File

SIGMA_M, SIGMA_PX = 0.01, 0.5
"""Standard deviations if the file states none."""
FARTHEST_M = 50e3
"""Horizontal distance to the block that indicates another zone or swapped axes."""
_NAMED = 5

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
"""Names of the columns; the first one that exists is used."""
CHECK = ("check", "check_point", "checkpoint", "cp", "chk")
CONTROL = ("", "control", "control_point", "controlpoint", "gcp", "3d_gcp", "ground_control_point")
ON, WATERLINE = "on:", ("waterline", "water_line", "shoreline", "on:water")
YES, NO = ("yes", "y", "true", "1"), ("", "no", "n", "false", "0")
PIXELS = ("", "px", "pixel", "pixels", "pix")
_LEAST_ODM = 6
_POSITION = ("x", "y", "z", "longitude", "latitude")
_PLAIN = {"point": "name", "label": "image"}


@dataclass(frozen=True, eq=False)
class Marks:
    """Marks of points in images, n of them, with what each row says about its point.

    Standard deviations are NaN if none is stated; `where` is the place of each row in the file.
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
    on: tuple[str, ...]  # surface of the point of each row; empty for none
    sigma_on: FloatArray

    def error(self, code: str, row: int, words: str, **values: Any) -> InputError:
        """Return an error about a row: file, place, point, image and what is wrong."""
        point, image = self.point[row], self.image[row]
        return InputError(
            code,
            f"{self.path}: {self.where[row]}: point {point}, image {image}: {words}",
            path=self.path,
            point=point,
            image=image,
            **values,
        )


def read_ground_control(path: File, cameras: Cameras, *, crs: str | None = None) -> GroundControl:
    """Read surveyed points and their marks in images, in the CRS of the cameras.

    Stated standard deviations along x and y are used without the rotation between the two CRS;
    missing ones are `SIGMA_M` and `SIGMA_PX`. Warns of marks in images without a pose, which are
    skipped, and of an assumed CRS.

    Parameters
    ----------
    path : path
        A table with the columns name, x, y, z, image, u, v, OpenDroneMap's ``gcp_list.txt``, or
        Metashape's markers (XML, .psx, .psz); see the top of this file. Images may be named with or
        without folder and extension.
    cameras : Cameras
        In the cloud's CRS, with lenses in pixels.
    crs : str, optional
        Of the points, instead of that in the file; ``local`` uses the numbers unchanged.
    """
    marks = read_marks(check_input(path))
    camera, notes = _cameras_of(marks, cameras)
    kept = np.flatnonzero(camera >= 0)
    names = list(dict.fromkeys(marks.point))
    number_of = {name: i for i, name in enumerate(names)}
    point = np.array([number_of[name] for name in marks.point])
    first = np.unique(point, return_index=True)[1]
    _check_agreement(marks, first[point])
    _check_images(marks, cameras, point, camera)
    used = np.unique(point[kept])
    first = first[used]
    on = tuple(marks.on[i] for i in first) if any(marks.on) else ()
    xyz, way_notes = _to_cameras(marks, cameras, crs, first)
    _check_near(marks, cameras, xyz, first)
    unseen = [one for i, one in enumerate(names) if i not in used]
    if unseen:
        words = f"{marks.path}: no image with a pose shows {_few(unseen)}; skipped."
        notes.append(PcfixWarning("gcps.unseen", words, path=marks.path, points=unseen))
    for note in (*notes, *way_notes):
        warnings.warn(note, PcfixWarning, stacklevel=2)
    return GroundControl(
        names=tuple(names[i] for i in used),
        xyz=xyz,
        sigma_m=np.where(np.isnan(xyz), np.inf, _or_else(marks.sigma_m[first], SIGMA_M)),
        is_check=marks.is_check[first],
        under_water=marks.under_water[first],
        point=np.searchsorted(used, point[kept]),
        camera=camera[kept],
        image_xy=marks.uv[kept],
        sigma_px=_or_else(marks.sigma_px[kept], SIGMA_PX),
        crs=cameras.crs,
        on=on,
        on_sigma_m=_or_else(marks.sigma_on[first], SIGMA_M) if on else np.zeros(0),
    )


def _or_else(values: FloatArray, default: float) -> FloatArray:
    return np.where(np.isnan(values), default, values)


def _few(names: list[str]) -> str:
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more


def _cameras_of(marks: Marks, cameras: Cameras) -> tuple[IntArray, list[PcfixWarning]]:
    """Return the camera of each mark, -1 for images without a pose, and a warning about these."""
    names = list(dict.fromkeys(marks.image))
    matched = match_labels(names, cameras.labels)
    of_name = dict(zip(names, matched.row.tolist(), strict=True))
    camera = np.array([of_name[name] for name in marks.image])
    lost = [name for name in names if of_name[name] < 0]
    others = {*matched.ambiguous, *unnamed(lost, cameras.unposed)}
    unknown = [name for name in lost if name in others]
    if unknown:
        row, many = marks.image.index(unknown[0]), f"{len(cameras)} images of the model"
        many += f" (first {cameras.labels[0]})"
        if unknown[0] in matched.ambiguous:
            words = f"the name could be several of the {many}. Use its names, with their folders."
            raise marks.error("images.ambiguous", row, words)
        count = sum(image in unknown for image in marks.image)
        words = f"{_few(unknown)} ({count} of {len(marks.image)} marks) are not among the {many}."
        words += " Give the points of this block, or remove these rows."
        raise marks.error("gcps.unknown_image", row, words, images=unknown)
    if (camera < 0).all():
        raise InputError(
            "gcps.no_pose",
            f"{marks.path}: none of its images has a pose. Align them first.",
            path=marks.path,
        )
    if not lost:
        return camera, []
    words = (
        f"{marks.path}: {(camera < 0).sum()} of {len(camera)} marks are in images without a pose"
        f" ({_few(lost)}) and were skipped."
    )
    return camera, [PcfixWarning("gcps.unposed", words, path=marks.path, images=lost)]


def _check_agreement(marks: Marks, same: IntArray) -> None:
    """Refuse rows that say different things about one point; `same` is the first row of each."""
    for what, values in (
        ("coordinates", marks.xyz),
        ("standard deviations", marks.sigma_m),
        ("roles", marks.is_check[:, None]),
        ("entries under water", marks.under_water[:, None]),
        ("surfaces", np.array(marks.on)[:, None]),
    ):
        both_nan = (values != values) & (values[same] != values[same])
        other = ~((values == values[same]) | both_nan).all(axis=1)
        if other.any():
            row = int(np.argmax(other))
            words = (
                f"the {what} of this point differ from those at {marks.where[same[row]]}. Give"
                " every point its own name."
            )
            raise marks.error("gcps.contradiction", row, words, what=what)


def _check_images(marks: Marks, cameras: Cameras, point: IntArray, camera: IntArray) -> None:
    """Refuse marks outside their image, and two marks of a point in an image."""
    if cameras.lenses is None:
        raise InputError(
            "cameras.no_lens",
            f"{marks.path}: marks in images need cameras with lenses. Give --sensor.",
            path=marks.path,
        )
    first: dict[tuple[int, int], int] = {}
    for row in np.flatnonzero(camera >= 0).tolist():
        before = first.setdefault((int(point[row]), int(camera[row])), row)
        if before != row:
            words = f"the point has a mark in this image at {marks.where[before]}. Remove one."
            raise marks.error("gcps.twice", row, words)
        lens, (u, v) = cameras.lenses[camera[row]], marks.uv[row]
        if lens.unit != "px":
            words = "the lens is in mm. Give a sensor with focal_px, width_px, height_px."
            raise marks.error("gcps.lens_unit", row, words)
        if not (0.0 <= u <= lens.width and 0.0 <= v <= lens.height):
            words = (
                f"the mark at {u:g}, {v:g} is outside the image of {lens.width:g} x"
                f" {lens.height:g} pixels. They count from its upper left corner, x to the right,"
                " y down."
            )
            raise marks.error("gcps.outside", row, words, uv=[float(u), float(v)])


def _to_cameras(
    marks: Marks, cameras: Cameras, crs: str | None, rows: IntArray
) -> tuple[FloatArray, Sequence[Any]]:
    """Return the points of some rows in the CRS of the cameras."""
    name, source, target = str(marks.path), crs or marks.crs, cameras.crs
    xyz = marks.xyz[rows]
    if target is not None and target.strip().lower() == LOCAL:
        if source is not None and source.strip().lower() != LOCAL:
            words = (
                f"{name}: is in {source}, the cameras are in a local frame. Transform the cameras,"
                " or give the CRS of the points as 'local' to use their numbers unchanged."
            )
            raise InputError("crs.local", words, path=marks.path, crs=source)
        return xyz, ()
    if target is not None and is_topocentric(target):
        words = (
            f"{name}: the cameras have axes east, north, up ({target}). Transform them to the"
            " cloud's CRS first."
        )
        raise InputError("crs.topocentric", words, path=marks.path, crs=target)
    forward, notes = way_to_cloud(source, target, xyz, name, heights=True)
    if forward is None:
        return xyz, notes
    moved = forward(xyz)
    lost = ~np.isfinite(moved).all(axis=1) & np.isfinite(xyz).all(axis=1)
    if lost.any():
        row = int(rows[np.argmax(lost)])
        x, y, z = marks.xyz[row]
        words = f"{x:.10g}, {y:.10g}, {z:.6g} is outside the cloud's CRS. Check that of the points."
        raise marks.error("crs.outside", row, words)
    return moved, notes


def _check_near(marks: Marks, cameras: Cameras, xyz: FloatArray, rows: IntArray) -> None:
    """Refuse points that no image of a block with a CRS can show."""
    if cameras.crs is None or cameras.crs.strip().lower() == LOCAL:
        return
    middle = np.median(cameras.centres[:, :2], axis=0)
    reach_m = FARTHEST_M + np.hypot(*(cameras.centres[:, :2] - middle).T).max()
    apart_m = np.hypot(*(xyz[:, :2] - middle).T)
    if (apart_m > reach_m).any():
        i = int(np.argmax(apart_m))
        swapped = bool(np.hypot(*(xyz[i, 1::-1] - middle)) <= reach_m)
        hint = "Swap x and y." if swapped else "Check the CRS of the points."
        words = f"the point is {apart_m[i] / 1e3:,.0f} km from the block. {hint}"
        raise marks.error("gcps.far", int(rows[i]), words, swapped=swapped)


# Formats


def read_marks(path: Path) -> Marks:
    """Read a table of marks, OpenDroneMap's ``gcp_list.txt``, or markers of Metashape."""
    if documents.recognises(Source(path)):
        return _from_metashape(path)
    lines = read_lines(path)
    rows = _odm_rows(path, lines)
    if rows is not None:
        return _from_odm(path, rows)
    if not any(is_header(header.names) for header in headers(lines)):
        words = (
            f"{path}: is neither a table of marks nor OpenDroneMap's gcp_list.txt. Line 1 must name"
            " the columns name, x, y, z, image, u, v, or be a CRS above rows of x, y, z, u, v,"
            " image."
        )
        raise InputError("gcps.format", words, path=path)
    return _from_table(path)


def _from_table(path: Path) -> Marks:
    columns = _with_roles(read_columns(path))
    system, doubt = table_crs(columns)
    if doubt:
        raise InputError(
            "crs.unknown",
            f"{path}: PROJ does not know its CRS '{columns.crs}'. Give an EPSG code.",
            path=path,
            crs=columns.crs,
        )
    sigma = columns.where_there(("sigma_x", "sigma_y", "sigma_z"))
    sigma_uv = columns.where_there(("sigma_u", "sigma_v"))
    sigma_on = columns.where_there(("sigma_on",))[:, 0]
    on = []
    for text in _texts(columns, "role"):
        is_on = text.startswith(ON) and text != ON
        on.append("water" if text in WATERLINE else text.removeprefix(ON) if is_on else "")
    is_check = _flags(columns, "role", CHECK, CONTROL, "control, check, waterline or on:NAME", on)
    every = np.column_stack([sigma, sigma_uv, sigma_on])
    for i in np.flatnonzero((every <= 0.0).any(axis=1))[:1]:
        value = float(every[i][every[i] <= 0.0][0])
        raise InputError(
            "gcps.sigma",
            f"{columns.where(int(i))}: the standard deviation {value:g} must be positive.",
            path=path,
            value=value,
        )
    names = [row[columns.place["point"]] for row in columns.table.rows]
    if "" in names:
        line = columns.table.line[names.index("")]
        raise InputError(
            "gcps.no_name", f"{path}: line {line}: the point has no name.", path=path, line=line
        )
    xyz = centres(columns, needed=not any(on))
    bare = [i for i in np.flatnonzero(np.isnan(xyz).any(axis=1)) if not on[i]]
    if bare:
        words = (
            f"{columns.where(int(bare[0]))}: the point has no x, y, z, which only points with the"
            " role waterline or on:NAME may omit."
        )
        raise InputError("gcps.no_coordinates", words, path=path)
    return Marks(
        path=path,
        point=names,
        image=columns.labels,
        xyz=xyz,
        sigma_m=sigma,
        uv=columns.of(("u", "v")),
        sigma_px=np.sqrt((sigma_uv**2).mean(axis=1)),
        is_check=is_check,
        under_water=_flags(columns, "under_water", YES, NO, "yes or no"),
        where=[f"line {line}" for line in columns.table.line],
        crs=system,
        on=tuple(on),
        sigma_on=sigma_on,
    )


def _with_roles(columns: Columns) -> Columns:
    """Return columns with the places that they have in a table of marks."""
    header, path = columns.table.header, columns.path
    place = {role: i for role, i in columns.place.items() if role in _POSITION}
    for role, spellings in SPELLINGS.items():
        there = [header.index(name) for name in spellings if name in header]
        if there:
            place[role] = there[0]
    missing = [_PLAIN.get(role, role) for role in ("point", "label", "u", "v") if role not in place]
    if missing:
        words = (
            f"{path}: the columns {', '.join(missing)} are missing (header: {', '.join(header)})."
            " Give name, x, y, z, image, u, v."
        )
        raise InputError("table.column_missing", words, path=path, columns=missing)
    for role in "uv":
        unit = columns.unit[place[role]]
        if unit not in PIXELS:
            words = (
                f"{path}: column {header[place[role]]} is in '{unit}'. Give pixels from the upper"
                " left corner."
            )
            raise InputError("table.unit", words, path=path, unit=unit)
    found = replace(columns, place=place)
    if "crs" not in place:
        return found
    stated = sorted({row[place["crs"]] for row in columns.table.rows} - {""})
    if len(stated) > 1:
        words = (
            f"{path}: has points in {len(stated)} CRS ({', '.join(stated[:3])}). Transform all to"
            " one."
        )
        raise InputError("gcps.several_crs", words, path=path, crs=stated)
    return replace(found, crs=stated[0] if stated else columns.crs)


def _texts(columns: Columns, role: str) -> list[str]:
    """Return the entries of a column in lower case; empty ones if it does not exist."""
    if role not in columns.place:
        return [""] * len(columns.table.rows)
    rows = columns.table.rows
    return [row[columns.place[role]].strip().lower().replace(" ", "_") for row in rows]


def _flags(
    columns: Columns, role: str, true: tuple[str, ...], false: tuple[str, ...], words: str,
    others: Sequence[str] = (),
) -> BoolArray:  # fmt: skip
    """Return which rows have an entry of `true`; refuse those that have neither, nor `others`."""
    found = _texts(columns, role)
    for i, text in enumerate(found):
        if text not in true and text not in false and not (others and others[i]):
            raise InputError(
                "table.choice",
                f"{columns.where(i)}, column {columns.name(role)}: '{text}' is not {words}.",
                path=columns.path,
                value=text,
            )
    return np.array([text in true for text in found])


def _odm_rows(path: Path, lines: list[str]) -> list[tuple[int, list[str]]] | None:
    """Return line number and fields of the rows of gcp_list.txt, None for other files."""
    numbered = [(i, line.split()) for i, line in enumerate(lines, start=1) if line.strip()]
    rows = [(i, fields) for i, fields in numbered[1:] if not fields[0].startswith("#")]
    if not rows or len(rows[0][1]) < _LEAST_ODM - 1:
        return None
    first = [number(field) for field in rows[0][1][:5]]
    if np.isnan([value for i, value in enumerate(first) if i != 2]).any():  # z may be NaN
        return None
    for i, fields in rows:
        if len(fields) < _LEAST_ODM:
            words = (
                f"{path}: line {i} has {len(fields)} fields. Give x, y, z, u, v, image and"
                " optionally the name of the point."
            )
            raise InputError("gcps.fields", words, path=path, line=i)
    return rows


def _from_odm(path: Path, rows: list[tuple[int, list[str]]]) -> Marks:
    values = np.array([[number(field) for field in fields[:5]] for _, fields in rows])
    if not np.isfinite(values).all():
        i, k = np.argwhere(~np.isfinite(values))[0]
        raise InputError(
            "table.number",
            f"{path}: line {rows[i][0]}: {'xyzuv'[k]} '{rows[i][1][k]}' is not a finite number.",
            path=path,
            line=rows[i][0],
            value=rows[i][1][k],
        )
    places = [tuple(row) for row in values[:, :3].tolist()]
    by_place = {place: f"GCP {i + 1}" for i, place in enumerate(dict.fromkeys(places))}
    names = [
        fields[_LEAST_ODM] if len(fields) > _LEAST_ODM else by_place[place]
        for (_, fields), place in zip(rows, places, strict=True)
    ]
    n = len(rows)
    return Marks(
        path=path,
        point=names,
        image=[fields[5] for _, fields in rows],
        xyz=values[:, :3],
        sigma_m=np.full((n, 3), np.nan),
        uv=values[:, 3:],
        sigma_px=np.full(n, np.nan),
        is_check=np.zeros(n, bool),
        under_water=np.zeros(n, bool),
        where=[f"line {i}" for i, _ in rows],
        crs=named_crs(path),
        on=("",) * n,
        sigma_on=np.full(n, np.nan),
    )


def _from_metashape(path: Path) -> Marks:
    """Read the markers that have surveyed coordinates and marks."""
    chunk = documents.open_chunk(path)
    surveyed = {
        marker.get("id") or "": marker
        for marker in chunk.element.iterfind("markers//marker")
        if all(_reference(marker).get(axis) for axis in "xyz")
    }
    marks = [mark for mark in _locations(chunk) if mark[0] in surveyed]
    if not marks:
        words = (
            f"{path}: has no marker with surveyed coordinates and a mark in an image. Give the"
            " project, or export the markers."
        )
        raise InputError("gcps.none", words, path=path)
    of = [surveyed[marker] for marker, _, _ in marks]
    references = [_reference(marker) for marker in of]
    cameras = chunk.element.iterfind("cameras//camera")
    image = {camera.get("id"): _label(camera) for camera in cameras}
    default, n = _setting(chunk, "accuracy_markers"), len(marks)
    own = (chunk.element.findtext("marker_reference") or "").strip()
    crs = own or (chunk.element.findtext("reference") or "").strip() or LOCAL
    if crs.lower() == LOCAL or is_local(parse_crs(crs, str(chunk.path))):
        crs = LOCAL
    return Marks(
        path=path,
        point=[_label(marker) for marker in of],
        image=[image.get(camera, f"camera {camera}") for _, camera, _ in marks],
        xyz=np.array([
            [xml_number(path, f"marker {_label(marker)}, reference", reference.get(axis))
             for axis in "xyz"]
            for marker, reference in zip(of, references, strict=True)
        ]),
        sigma_m=np.array([_sigma(path, marker, default) for marker in of]),
        uv=np.array([uv for _, _, uv in marks]),
        sigma_px=np.full(n, _setting(chunk, "accuracy_projections")),
        is_check=np.array([each.get("enabled") in ("false", "0") for each in references]),
        under_water=np.zeros(n, bool),
        where=[f"marker {_label(marker)}" for marker in of],
        crs=crs,
        on=("",) * n,
        sigma_on=np.full(n, np.nan),
    )  # fmt: skip


def _reference(marker: Element) -> Element:
    found = marker.find("reference")
    return marker if found is None else found


def _label(marker: Element) -> str:
    return marker.get("label") or f"number {marker.get('id')}"


def _locations(chunk: Chunk) -> list[tuple[str, str, tuple[float, float]]]:
    """Return marker, camera and image coordinates of every measured location of the first frame."""
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


def _sigma(path: Path, marker: Element, default: float) -> FloatArray:
    """Return the stated standard deviations; the most specific statement counts."""
    sigma = np.full(3, default)
    for name, axes in SPREADS:
        if text := _reference(marker).get(name):
            count = 1 if len(text.split()) == 1 else len(axes)
            where = f"marker {_label(marker)}, {name}"
            sigma[list(axes)] = numbers(path, where, text, count)
    return np.where(sigma > 0.0, sigma, np.nan)


def _setting(chunk: Chunk, name: str) -> float:
    """Return a positive number of the chunk's settings, NaN if there is none."""
    for entry in chunk.element.iterfind("settings/property"):
        if entry.get("name") == name:
            value = xml_number(chunk.path, f"setting {name}", entry.get("value"))
            return value if value > 0.0 else np.nan
    return np.nan
