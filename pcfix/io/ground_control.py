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
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcfix.errors import InputError, PcfixWarning, bad_file
from pcfix.io.cameras import metashape
from pcfix.io.cameras.checks import Source, recognises
from pcfix.io.cameras.checks import number as xml_number
from pcfix.io.cameras.odm import named_crs
from pcfix.io.cameras.table import AXES, centres, has_header
from pcfix.io.cameras.table import SPELLINGS as POSITIONS
from pcfix.io.cameras.table import crs as table_crs
from pcfix.io.crs import LOCAL, is_local, parse_crs, way_to_cloud
from pcfix.io.files import check_input
from pcfix.io.labels import match_labels, unnamed
from pcfix.io.tables import Table, number, read_lines, read_table
from pcfix.model import BoolArray, Cameras, FloatArray, GroundControl, IntArray
from pcfix.options.declare import File

SIGMA_M, SIGMA_PX = 0.01, 0.5
"""Standard deviations if the file states none."""
FARTHEST_M = 50e3
"""Horizontal distance to the block that indicates another zone or swapped axes."""
_NAMED = 5

SPELLINGS: dict[str, tuple[str, ...]] = {
    **{role: POSITIONS[role] for role in ("x", "y", "z", "longitude", "latitude")},
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
ODM = ("x", "y", "z", "u", "v", "label", "point")
"""Fields of ODM's list, the last one optional."""


class Marks(NamedTuple):
    """The m marks of a file, and what it states of the point of each; NaN for nothing."""

    path: Path
    where: list[str]  # in the file
    point: list[str]
    image: list[str]
    uv: FloatArray  # (m, 2), pixels
    xyz: FloatArray  # (m, 3), in `crs`
    sigma_m: FloatArray  # (m, 3)
    sigma_px: FloatArray  # (m,)
    is_check: BoolArray
    under_water: BoolArray
    on: list[str]  # surfaces on which the points lie
    sigma_on: FloatArray  # (m,)
    crs: str | None

    def error(self, row: int, code: str, words: str, **values: Any) -> InputError:
        """Return an error about a mark: file, place, point, image and what is wrong."""
        point, image = self.point[row], self.image[row]
        sentence = f"{self.where[row]}: point {point}, image {image}: {words}"
        return bad_file(self.path, code, sentence, point=point, image=image, **values)


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
    row_of: dict[str, int] = {}
    first = np.array([row_of.setdefault(name, i) for i, name in enumerate(marks.point)])
    stated = np.column_stack([marks.xyz, marks.sigma_m, marks.is_check, marks.under_water])
    for i, one in enumerate(first.tolist()):
        same = np.array_equal(stated[i], stated[one], equal_nan=True)
        if not same or marks.on[i] != marks.on[one]:
            words = f"this point is described differently at {marks.where[one]}. Use other names."
            raise marks.error(i, "gcps.contradiction", words)
    posed = np.flatnonzero(camera >= 0)
    rows = np.unique(first[posed])  # the first mark of each point that is used
    unseen = [name for name, row in row_of.items() if row not in rows]
    if unseen:
        words = f"{path}: no image with a pose shows {_few(unseen)}; skipped."
        notes.append(PcfixWarning("gcps.unseen", words, path=marks.path, points=unseen))
    xyz, more = _to_cameras(marks, rows, cameras, crs or marks.crs)
    for note in (*notes, *more):
        warnings.warn(note, PcfixWarning, stacklevel=2)
    sigma_m, sigma_on, sigma_px = (
        np.where(np.isnan(values), default, values)
        for values, default in (
            (marks.sigma_m[rows], SIGMA_M),
            (marks.sigma_on[rows], SIGMA_M),
            (marks.sigma_px[posed], SIGMA_PX),
        )
    )
    has_surfaces = any(marks.on)
    return GroundControl(
        names=tuple(marks.point[i] for i in rows),
        xyz=xyz,
        sigma_m=np.where(np.isnan(xyz), np.inf, sigma_m),
        is_check=marks.is_check[rows],
        under_water=marks.under_water[rows],
        point=np.searchsorted(rows, first[posed]),
        camera=camera[posed],
        image_xy=marks.uv[posed],
        sigma_px=sigma_px,
        crs=cameras.crs,
        on=tuple(marks.on[i] for i in rows) if has_surfaces else (),
        on_sigma_m=sigma_on if has_surfaces else np.zeros(0),
    )


def _few(names: list[str]) -> str:
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more


def _cameras_of(marks: Marks, cameras: Cameras) -> tuple[IntArray, list[PcfixWarning]]:
    """Return the camera of each mark, -1 for images without a pose, and a warning about these.

    Refuse marks in unknown images or outside their image, and two marks of a point in an image.
    """
    names = list(dict.fromkeys(marks.image))
    found, ambiguous = match_labels(names, cameras.labels)
    camera = found[[names.index(name) for name in marks.image]]
    lost = [name for name, row in zip(names, found, strict=True) if row < 0]
    if ambiguous:
        words = "the name fits several images of the model. Use names with their folders."
        raise marks.error(marks.image.index(ambiguous[0]), "images.ambiguous", words)
    unknown = list(unnamed(lost, cameras.unposed))
    if unknown:
        words = f"{_few(unknown)} are not among the {len(cameras)} images of the model"
        words += f" (first {cameras.labels[0]}). Give the points of this block."
        row = marks.image.index(unknown[0])
        raise marks.error(row, "gcps.unknown_image", words, images=unknown)
    if len(lost) == len(names):
        raise bad_file(marks.path, "gcps.no_pose", "none of its images has a pose. Align them.")
    if cameras.lenses is None:
        sentence = "marks in images need cameras with lenses. Give --sensor."
        raise bad_file(marks.path, "cameras.no_lens", sentence)
    first: dict[tuple[str, int], int] = {}
    for row in np.flatnonzero(camera >= 0).tolist():
        lens, (u, v) = cameras.lenses[camera[row]], marks.uv[row].tolist()
        before = first.setdefault((marks.point[row], int(camera[row])), row)
        if before != row:
            words = f"the point has a mark in this image at {marks.where[before]}. Remove one."
            raise marks.error(row, "gcps.twice", words)
        if lens.unit != "px":
            words = "the lens is in mm. Give a sensor with focal_px, width_px, height_px."
            raise marks.error(row, "gcps.lens_unit", words)
        if not (0.0 <= u <= lens.width and 0.0 <= v <= lens.height):
            words = f"{u:g}, {v:g} is outside the image of {lens.width:g} x {lens.height:g} pixels."
            words += " Count pixels from its upper left corner, to the right and down."
            raise marks.error(row, "gcps.outside", words, uv=[u, v])
    if not lost:
        return camera, []
    words = f"{marks.path}: {(camera < 0).sum()} of {len(camera)} marks are in images without a"
    words += f" pose ({_few(lost)}) and were skipped."
    return camera, [PcfixWarning("gcps.unposed", words, path=marks.path, images=lost)]


def _to_cameras(
    marks: Marks, rows: IntArray, cameras: Cameras, source: str | None
) -> tuple[FloatArray, tuple[PcfixWarning, ...]]:
    """Return points in the CRS of the cameras, and notes; refuse points far from the block."""
    xyz, target = marks.xyz[rows], cameras.crs
    forward, notes = way_to_cloud(source, target, xyz, str(marks.path), heights=True)
    moved = xyz if forward is None else forward(xyz)
    lost = ~np.isfinite(moved).all(axis=1) & np.isfinite(xyz).all(axis=1)
    if lost.any():
        i = int(np.argmax(lost))
        place = ", ".join(f"{value:.10g}" for value in xyz[i])
        words = f"{place} is outside the cloud's CRS. Check that of the points."
        raise marks.error(rows[i], "crs.outside", words)
    if target is None or target.strip().lower() == LOCAL:
        return moved, notes
    # points that no image of the block can show
    middle = np.median(cameras.centres[:, :2], axis=0)
    reach_m = FARTHEST_M + np.hypot(*(cameras.centres[:, :2] - middle).T).max()
    apart_m = np.hypot(*(moved[:, :2] - middle).T)
    if (apart_m > reach_m).any():
        i = int(np.argmax(apart_m))
        swapped = bool(np.hypot(*(moved[i, 1::-1] - middle)) <= reach_m)
        hint = "Swap x and y." if swapped else "Check the CRS of the points."
        words = f"the point is {apart_m[i] / 1e3:,.0f} km from the block. {hint}"
        raise marks.error(rows[i], "gcps.far", words, swapped=swapped)
    return moved, notes


# Formats


def read_marks(path: Path) -> Marks:
    """Read the marks of a file, and the CRS that it states."""
    if recognises(metashape, Source(path)):
        return _from_metashape(path)
    lines = read_lines(path)
    numbered = [(i, line.split()) for i, line in enumerate(lines, start=1) if line.strip()]
    rows = [(i, fields) for i, fields in numbered[1:] if not fields[0].startswith("#")]
    first = [number(field) for field in rows[0][1][:5]] if rows else []
    if len(first) == 5 and not np.isnan([*first[:2], *first[3:]]).any():  # z may be NaN
        return _from_table(_odm_table(path, rows))
    if not has_header(lines):
        sentence = "is neither a table of marks nor OpenDroneMap's gcp_list.txt. Line 1 must name"
        sentence += " the columns name, x, y, z, image, u, v, or be a CRS."
        raise bad_file(path, "gcps.format", sentence)
    kinds = [("point", *three, "label", "u", "v") for three in AXES]
    return _from_table(read_table(path, *kinds, spellings=SPELLINGS))


def _from_table(columns: Table) -> Marks:
    path = columns.path
    stated = sorted({*columns.column("crs")} - {""}) if columns.has("crs") else []
    if len(stated) > 1:
        sentence = f"has points in several CRS ({', '.join(stated[:3])}). Transform all to one."
        raise bad_file(path, "gcps.several_crs", sentence, crs=stated)
    columns = replace(columns, crs=stated[0] if stated else columns.crs)
    system, unknown = table_crs(columns)
    if unknown:
        sentence = f"PROJ does not know its CRS '{columns.crs}'. Give an EPSG code."
        raise bad_file(path, "crs.unknown", sentence, crs=columns.crs)
    roles, wet = (
        [text.lower().replace(" ", "_") for text in columns.column(role)]
        if columns.has(role)
        else [""] * len(columns.rows)
        for role in ("role", "under_water")
    )
    surfaces = ["on:water" if text in WATERLINE else text for text in roles]
    on = [text.removeprefix(ON) if text.startswith(ON) else "" for text in surfaces]
    for row, (role, is_wet) in enumerate(zip(roles, wet, strict=True)):
        if not (on[row] or role in CHECK + CONTROL):
            sentence = f"the role '{role}' is not control, check, waterline or on:NAME."
            raise columns.error(row, "table.choice", sentence, value=role)
        if is_wet not in YES + NO:
            sentence = f"under water is '{is_wet}', not yes or no."
            raise columns.error(row, "table.choice", sentence, value=is_wet)
    sigmas = ("sigma_x", "sigma_y", "sigma_z", "sigma_u", "sigma_v", "sigma_on")
    sigma = columns.where_there(sigmas)
    for i, k in np.argwhere(sigma <= 0.0)[:1].tolist():
        words = f"the standard deviation {sigma[i, k]:g} must be positive."
        raise columns.error(i, "gcps.sigma", words, value=float(sigma[i, k]))
    names, xyz = columns.column("point"), centres(columns, needed=not any(on))
    if "" in names:
        raise columns.error(names.index(""), "gcps.no_name", "the point has no name.")
    for i in np.flatnonzero(np.isnan(xyz).any(axis=1)):
        if not on[i]:
            words = "the point has no x, y, z. Only those with role waterline or on:NAME need none."
            raise columns.error(int(i), "gcps.no_coordinates", words)
    return Marks(
        path=path,
        where=[f"line {line}" for line in columns.line],
        point=names,
        image=columns.labels,
        uv=columns.of(("u", "v")),
        xyz=xyz,
        sigma_m=sigma[:, :3],
        sigma_px=np.sqrt((sigma[:, 3:5] ** 2).mean(axis=1)),
        is_check=np.array([role in CHECK for role in roles]),
        under_water=np.array([one in YES for one in wet]),
        on=on,
        sigma_on=sigma[:, 5],
        crs=system,
    )


def _odm_table(path: Path, rows: list[tuple[int, list[str]]]) -> Table:
    """Return ODM's list as a table; points without a name are named by their coordinates."""
    places: dict[tuple[float, ...], str] = {}
    texts = []
    for i, fields in rows:
        if len(fields) < len(ODM) - 1:
            sentence = f"line {i} has {len(fields)} fields. Give x, y, z, u, v, image."
            raise bad_file(path, "gcps.fields", sentence, line=i)
        name = places.setdefault(tuple(map(number, fields[:3])), f"GCP {len(places) + 1}")
        texts.append([*fields, name][: len(ODM)])
    place = {role: i for i, role in enumerate(ODM)}
    lines = [i for i, _ in rows]
    return Table(path, [*ODM], texts, lines, place, [""] * len(ODM), crs=named_crs(path))


def _from_metashape(path: Path) -> Marks:
    """Read the markers that have surveyed coordinates, where they were measured in the images."""
    chunk = metashape.open_chunk(path)
    settings = chunk.properties("settings")
    names = {c.get("id"): metashape.name_of(c) for c in chunk.root.iterfind("cameras//camera")}
    default, pixels = (
        xml_number(path, f"setting {name}", settings.get(name, "0"))
        for name in ("accuracy_markers", "accuracy_projections")
    )
    surveyed = {}
    for marker in chunk.root.iterfind("markers//marker"):
        found, label = marker.find("reference"), metashape.name_of(marker)
        stated = (marker if found is None else found).attrib
        if all(stated.get(axis) for axis in "xyz"):
            where = f"marker {label}, reference"
            place = [xml_number(path, where, stated[axis]) for axis in "xyz"]
            sigma = metashape.spreads(path, where, stated, np.full(3, default))
            is_disabled = stated.get("enabled") in ("false", "0")
            surveyed[marker.get("id") or ""] = label, place, sigma, is_disabled
    marks = [] if chunk.frame is None else metashape.measured_marks(chunk.frame)
    marks = [mark for mark in marks if mark[0] in surveyed]
    if not marks:
        sentence = "has no marker with surveyed coordinates and a mark in an image. Export them."
        raise bad_file(path, "gcps.none", sentence)
    labels, xyz, sigmas, is_check = zip(*(surveyed[mark[0]] for mark in marks), strict=True)
    own = (chunk.root.findtext("marker_reference") or "").strip()
    crs = own or (chunk.root.findtext("reference") or "").strip() or LOCAL
    count, sigma_m = len(marks), np.array(sigmas)
    return Marks(
        path=path,
        where=[f"marker {label}" for label in labels],
        point=list(labels),
        image=[names.get(camera, f"camera {camera}") for _, camera, _ in marks],
        uv=np.array([uv for *_, uv in marks]),
        xyz=np.array(xyz),
        sigma_m=np.where(sigma_m > 0.0, sigma_m, np.nan),
        sigma_px=np.full(count, pixels if pixels > 0.0 else np.nan),
        is_check=np.array(is_check),
        under_water=np.zeros(count, np.bool_),
        on=[""] * count,
        sigma_on=np.full(count, np.nan),
        crs=LOCAL if is_local(parse_crs(crs, str(chunk.path))) else crs,
    )
