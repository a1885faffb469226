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
from pcfix.io.crs import LOCAL, is_local, is_topocentric, parse_crs, way_to_cloud
from pcfix.io.files import check_input
from pcfix.io.labels import match_labels, unnamed
from pcfix.io.tables import Table, number, read_lines, read_table
from pcfix.model import Cameras, FloatArray, GroundControl, IntArray
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


class Mark(NamedTuple):
    """A mark of a point in an image, and what its row states about the point; NaN for nothing."""

    where: str  # in the file
    point: str
    image: str
    uv: FloatArray
    xyz: FloatArray  # in the CRS of the file
    sigma_m: FloatArray = np.full(3, np.nan)
    sigma_px: float = np.nan
    is_check: bool = False
    under_water: bool = False
    on: str = ""  # surface on which the point lies
    sigma_on: float = np.nan


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
    source = check_input(path)
    marks, stated_crs = read_marks(source)
    camera, notes = _cameras_of(source, marks, cameras)
    first: dict[str, Mark] = {}
    for mark in marks:
        one = first.setdefault(mark.point, mark)
        mine, its = (np.hstack([m.xyz, m.sigma_m, m.is_check, m.under_water]) for m in (mark, one))
        if mark.on != one.on or not np.array_equal(mine, its, equal_nan=True):
            words = f"this point is described differently at {one.where}. Use other names."
            raise _wrong(source, "gcps.contradiction", mark, words)
    _check_images(source, marks, cameras, camera)
    posed = np.flatnonzero(camera >= 0)
    seen = {marks[i].point for i in posed}
    points = [mark for name, mark in first.items() if name in seen]
    row_of = {mark.point: i for i, mark in enumerate(points)}
    xyz, way_notes = _to_cameras(source, points, cameras, crs or stated_crs)
    unseen = [name for name in first if name not in seen]
    if unseen:
        words = f"{source}: no image with a pose shows {_few(unseen)}; skipped."
        notes.append(PcfixWarning("gcps.unseen", words, path=source, points=unseen))
    for note in (*notes, *way_notes):
        warnings.warn(note, PcfixWarning, stacklevel=2)
    on = tuple(mark.on for mark in points) if any(mark.on for mark in marks) else ()
    sigma_on = _or_else([mark.sigma_on for mark in points], SIGMA_M)
    sigma_m = _or_else([mark.sigma_m for mark in points], SIGMA_M)
    return GroundControl(
        names=tuple(row_of),
        xyz=xyz,
        sigma_m=np.where(np.isnan(xyz), np.inf, sigma_m),
        is_check=np.array([mark.is_check for mark in points]),
        under_water=np.array([mark.under_water for mark in points]),
        point=np.array([row_of[marks[i].point] for i in posed]),
        camera=camera[posed],
        image_xy=np.array([marks[i].uv for i in posed]),
        sigma_px=_or_else([marks[i].sigma_px for i in posed], SIGMA_PX),
        crs=cameras.crs,
        on=on,
        on_sigma_m=sigma_on if on else np.zeros(0),
    )


def _or_else(values: Sequence[Any], default: float) -> FloatArray:
    return np.where(np.isnan(values), default, values)


def _few(names: list[str]) -> str:
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more


def _wrong(path: Path, code: str, mark: Mark, words: str, **values: Any) -> InputError:
    """Return an error about a mark: file, place, point, image and what is wrong."""
    sentence = f"{mark.where}: point {mark.point}, image {mark.image}: {words}"
    return bad_file(path, code, sentence, point=mark.point, image=mark.image, **values)


def _cameras_of(
    path: Path, marks: list[Mark], cameras: Cameras
) -> tuple[IntArray, list[PcfixWarning]]:
    """Return the camera of each mark, -1 for images without a pose, and a warning about these."""
    names = list(dict.fromkeys(mark.image for mark in marks))
    row, ambiguous = match_labels(names, cameras.labels)
    of_name = dict(zip(names, row.tolist(), strict=True))
    camera = np.array([of_name[mark.image] for mark in marks])
    lost = [name for name in names if of_name[name] < 0]
    others = {*ambiguous, *unnamed(lost, cameras.unposed)}
    unknown = [name for name in lost if name in others]
    if unknown:
        mark = next(mark for mark in marks if mark.image == unknown[0])
        if mark.image in ambiguous:
            words = "the name fits several images of the model. Use names with their folders."
            raise _wrong(path, "images.ambiguous", mark, words)
        words = f"{_few(unknown)} are not among the {len(cameras)} images of the model"
        words += f" (first {cameras.labels[0]}). Give the points of this block."
        raise _wrong(path, "gcps.unknown_image", mark, words, images=unknown)
    if (camera < 0).all():
        raise bad_file(path, "gcps.no_pose", "none of its images has a pose. Align them first.")
    if not lost:
        return camera, []
    words = f"{path}: {(camera < 0).sum()} of {len(camera)} marks are in images without a pose"
    words += f" ({_few(lost)}) and were skipped."
    return camera, [PcfixWarning("gcps.unposed", words, path=path, images=lost)]


def _check_images(path: Path, marks: list[Mark], cameras: Cameras, camera: IntArray) -> None:
    """Refuse marks outside their image, and two marks of a point in an image."""
    if cameras.lenses is None:
        sentence = "marks in images need cameras with lenses. Give --sensor."
        raise bad_file(path, "cameras.no_lens", sentence)
    first: dict[tuple[str, int], Mark] = {}
    for row in np.flatnonzero(camera >= 0).tolist():
        mark, lens = marks[row], cameras.lenses[camera[row]]
        before = first.setdefault((mark.point, int(camera[row])), mark)
        if before is not mark:
            words = f"the point has a mark in this image at {before.where}. Remove one."
            raise _wrong(path, "gcps.twice", mark, words)
        if lens.unit != "px":
            words = "the lens is in mm. Give a sensor with focal_px, width_px, height_px."
            raise _wrong(path, "gcps.lens_unit", mark, words)
        u, v = mark.uv.tolist()
        if not (0.0 <= u <= lens.width and 0.0 <= v <= lens.height):
            words = f"{u:g}, {v:g} is outside the image of {lens.width:g} x {lens.height:g} pixels."
            words += " Count pixels from its upper left corner, to the right and down."
            raise _wrong(path, "gcps.outside", mark, words, uv=[u, v])


def _to_cameras(
    path: Path, points: list[Mark], cameras: Cameras, source: str | None
) -> tuple[FloatArray, Sequence[Any]]:
    """Return the points in the CRS of the cameras, and notes; refuse points far from the block."""
    name, target, xyz = str(path), cameras.crs, np.array([mark.xyz for mark in points])
    if target is not None and target.strip().lower() == LOCAL:
        if source is not None and source.strip().lower() != LOCAL:
            sentence = f"is in {source}, the cameras are in a local frame. Transform the cameras."
            raise bad_file(path, "crs.local", sentence, crs=source)
        return xyz, ()
    if target is not None and is_topocentric(target):
        sentence = f"the cameras are in {target}. Transform them to the cloud's CRS first."
        raise bad_file(path, "crs.topocentric", sentence, crs=target)
    forward, notes = way_to_cloud(source, target, xyz, name, heights=True)
    moved = xyz if forward is None else forward(xyz)
    lost = ~np.isfinite(moved).all(axis=1) & np.isfinite(xyz).all(axis=1)
    if lost.any():
        mark = points[int(np.argmax(lost))]
        place = ", ".join(f"{value:.10g}" for value in mark.xyz)
        words = f"{place} is outside the cloud's CRS. Check that of the points."
        raise _wrong(path, "crs.outside", mark, words)
    if target is None:
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
        raise _wrong(path, "gcps.far", points[i], words, swapped=swapped)
    return moved, notes


# Formats


def read_marks(path: Path) -> tuple[list[Mark], str | None]:
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


def _from_table(columns: Table) -> tuple[list[Mark], str | None]:
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
    roles, wet = (_texts(columns, role) for role in ("role", "under_water"))
    surfaces = ["on:water" if text in WATERLINE else text for text in roles]
    on = [text.removeprefix(ON) if text.startswith(ON) else "" for text in surfaces]
    is_role = [text in CHECK + CONTROL or on[i] != "" for i, text in enumerate(roles)]
    for role, texts, known, words in (
        ("role", roles, is_role, "control, check, waterline or on:NAME"),
        ("under_water", wet, [text in YES + NO for text in wet], "yes or no"),
    ):
        if not all(known):
            row = known.index(False)
            sentence = f"column {columns.name(role)}: '{texts[row]}' is not {words}."
            raise columns.error(row, "table.choice", sentence, value=texts[row])
    is_check, under_water = ([t in CHECK for t in roles], [t in YES for t in wet])
    sigma_m = columns.where_there(("sigma_x", "sigma_y", "sigma_z"))
    sigma_uv = columns.where_there(("sigma_u", "sigma_v"))
    sigma_on = columns.where_there(("sigma_on",))[:, 0]
    every = np.column_stack([sigma_m, sigma_uv, sigma_on])
    for i, k in np.argwhere(every <= 0.0)[:1]:
        words = f"the standard deviation {every[i, k]:g} must be positive."
        raise columns.error(int(i), "gcps.sigma", words, value=float(every[i, k]))
    names = columns.column("point")
    if "" in names:
        line = columns.line[names.index("")]
        raise bad_file(path, "gcps.no_name", f"line {line}: the point has no name.", line=line)
    xyz, uv = centres(columns, needed=not any(on)), columns.of(("u", "v"))
    for i in np.flatnonzero(np.isnan(xyz).any(axis=1)):
        if not on[i]:
            words = "the point has no x, y, z. Only those with role waterline or on:NAME need none."
            raise columns.error(int(i), "gcps.no_coordinates", words)
    where = [f"line {line}" for line in columns.line]
    sigma_px = np.sqrt((sigma_uv**2).mean(axis=1)).tolist()
    rows = zip(
        *(where, names, columns.labels, uv, xyz, sigma_m, sigma_px, is_check, under_water),
        *(on, sigma_on),
        strict=True,
    )
    return [Mark(*row) for row in rows], system


def _texts(columns: Table, role: str) -> list[str]:
    """Return the entries of a column in lower case; empty ones if it does not exist."""
    if not columns.has(role):
        return [""] * len(columns.rows)
    return [text.strip().lower().replace(" ", "_") for text in columns.column(role)]


def _odm_table(path: Path, rows: list[tuple[int, list[str]]]) -> Table:
    """Return ODM's list as a table; points without a name are named by their coordinates."""
    for i, fields in rows:
        if len(fields) < len(ODM) - 1:
            sentence = f"line {i} has {len(fields)} fields. Give x, y, z, u, v, image."
            raise bad_file(path, "gcps.fields", sentence, line=i)
    places = dict.fromkeys(tuple(map(number, fields[:3])) for _, fields in rows)
    names = {place: f"GCP {i}" for i, place in enumerate(places, start=1)}
    texts = [[*fields, names[tuple(map(number, fields[:3]))]][: len(ODM)] for _, fields in rows]
    place = {role: i for i, role in enumerate(ODM)}
    lines = [i for i, _ in rows]
    return Table(path, [*ODM], texts, lines, place, [""] * len(ODM), crs=named_crs(path))


def _from_metashape(path: Path) -> tuple[list[Mark], str | None]:
    """Read the markers that have surveyed coordinates, where they were measured in the images."""
    chunk = metashape.open_chunk(path)
    frame, settings = chunk.frame, chunk.properties("settings")
    names = {c.get("id"): metashape.name_of(c) for c in chunk.root.iterfind("cameras//camera")}
    default, pixels = (
        xml_number(path, f"setting {name}", settings.get(name, "0"))
        for name in ("accuracy_markers", "accuracy_projections")
    )
    surveyed: dict[str, Mark] = {}
    for marker in chunk.root.iterfind("markers//marker"):
        found, label = marker.find("reference"), metashape.name_of(marker)
        stated = (marker if found is None else found).attrib
        if all(stated.get(axis) for axis in "xyz"):
            where = f"marker {label}, reference"
            xyz = np.array([xml_number(path, where, stated[axis]) for axis in "xyz"])
            sigma = metashape.spreads(path, where, stated, np.full(3, default))
            surveyed[marker.get("id") or ""] = Mark(
                f"marker {label}", label, "", np.full(2, np.nan), xyz,
                np.where(sigma > 0.0, sigma, np.nan), pixels if pixels > 0.0 else np.nan,
                stated.get("enabled") in ("false", "0"),
            )  # fmt: skip
    marks = []
    for name, camera, uv in [] if frame is None else metashape.measured_marks(frame):
        if name in surveyed:
            image = names.get(camera, f"camera {camera}")
            marks.append(surveyed[name]._replace(image=image, uv=uv))
    if not marks:
        sentence = "has no marker with surveyed coordinates and a mark in an image. Export them."
        raise bad_file(path, "gcps.none", sentence)
    own = (chunk.root.findtext("marker_reference") or "").strip()
    crs = own or (chunk.root.findtext("reference") or "").strip() or LOCAL
    if crs.lower() == LOCAL or is_local(parse_crs(crs, str(chunk.path))):
        crs = LOCAL
    return marks, crs
