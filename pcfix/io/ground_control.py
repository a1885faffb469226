"""Ground control: surveyed points and their marks in images; and GNSS positions of the images.

A table of marks, one per row, has a header line and the columns

- name (or point, gcp, marker, ...), image, u, v: pixels from the upper left corner of the image;
- x, y, z (or easting, northing, height; longitude, latitude, height in degrees of WGS 84);
- optionally sx, sy, sz, or one column sigma, in metres; su, sv, or one column sigma_px; role (or
  type): control, check, waterline (the point lies on the water) or on:NAME (on the plane of that
  name), these two with sigma_on in metres, and with x, y, z only if they were surveyed, which makes
  them control points as well; under_water: yes or no. A comment before the header may state the
  CRS: ``# CRS: EPSG:32636``.

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

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pcfix.errors import InputError, bad_file, warn
from pcfix.io.cameras import metashape, read_cameras
from pcfix.io.cameras import table as camera_tables
from pcfix.io.cameras.checks import Source, recognises
from pcfix.io.cameras.checks import number as xml_number
from pcfix.io.cameras.georeference import adjusted_minus_gnss, is_tied
from pcfix.io.cameras.odm import named_crs
from pcfix.io.cameras.table import AXES, centres, gnss_positions, has_header, open_table
from pcfix.io.cameras.table import SPELLINGS as POSITIONS
from pcfix.io.cameras.table import crs as table_crs
from pcfix.io.crs import LOCAL, METRES, is_local, is_topocentric, parse_crs, to_cloud_crs
from pcfix.io.files import check_input
from pcfix.io.tables import Table, match_labels, number, places, read_lines, read_table, unnamed
from pcfix.model import Cameras, FloatArray, GnssPositions, GroundControl, IntArray
from pcfix.options.declare import File

SIGMA_M, SIGMA_PX = 0.01, 0.5  # standard deviations if the file states none
FARTHEST_M = 50e3  # horizontal distance to the block that indicates another zone or swapped axes

# Names of the columns; the first one that exists is used.
SPELLINGS: dict[str, tuple[str, ...]] = {
    **{role: POSITIONS[role] for role in ("x", "y", "z", "longitude", "latitude")},
    "point": ("point", "name", "gcp", "gcp_name", "marker", "point_name", "id", "label"),
    "label": ("image", "image_name", "imagename", "filename", "file_name", "file", "photo"),
    "u": ("u", "u_px", "im_x", "image_x", "pixel_x"),
    "v": ("v", "v_px", "im_y", "image_y", "pixel_y"),
    "sigma_x": ("sx", "sigma_x", "accuracy_x", "sxy", "sigma", "sxyz", "accuracy"),
    "sigma_y": ("sy", "sigma_y", "accuracy_y", "sxy", "sigma", "sxyz", "accuracy"),
    "sigma_z": ("sz", "sigma_z", "accuracy_z", "sigma", "sxyz", "accuracy"),
    "sigma_u": ("su", "sigma_u", "sigma_px"),
    "sigma_v": ("sv", "sigma_v", "sigma_px"),
    "role": ("role", "type"),
    "sigma_on": ("sigma_on",),
    "under_water": ("under_water", "underwater", "submerged"),
}
CHECK = ("check", "check_point", "checkpoint", "cp", "chk")
CONTROL = ("", "control", "control_point", "controlpoint", "gcp", "3d_gcp", "ground_control_point")
ON, WATERLINE = "on:", ("waterline", "water_line", "shoreline", "on:water")
YES, NO = ("yes", "y", "true", "1"), ("", "no", "n", "false", "0")
ODM = ("x", "y", "z", "u", "v", "label", "point")  # fields of ODM's list, the last one optional


def read_ground_control(path: File, cameras: Cameras, *, crs: str | None = None) -> GroundControl:
    """Read surveyed points and their marks in images, in the CRS of the cameras.

    The file is one of those at the top of this module; images may be named with or without folder
    and extension. The cameras have lenses in pixels. `crs` replaces that of the points in the file;
    ``local`` uses the numbers unchanged. Stated standard deviations along x and y are used without
    the rotation between the two CRS; missing ones are `SIGMA_M` and `SIGMA_PX`. Warns of marks in
    images without a pose, which are skipped, and of an assumed CRS.
    """
    table = _read(check_input(path))
    names, roles, wet = table.column("point"), _words(table, "role"), _words(table, "under_water")
    surfaces = ["on:water" if text in WATERLINE else text for text in roles]
    on = [text.removeprefix(ON) if text.startswith(ON) else "" for text in surfaces]
    xyz = centres(table)
    roles_of_sigma = ("sigma_x", "sigma_y", "sigma_z", "sigma_u", "sigma_v", "sigma_on")
    sigma = table.where_there(roles_of_sigma)
    is_check = np.array([role in CHECK for role in roles])
    under_water = np.array([word in YES for word in wet])
    # what all marks of a point must state alike
    described = np.column_stack([xyz, sigma[:, :3], is_check, under_water])
    row_of: dict[str, int] = {}
    for row, name in enumerate(names):
        first = row_of.setdefault(name, row)
        if not name:
            raise table.error(row, "gcps.no_name", "the point has no name.")
        if not (on[row] or roles[row] in CHECK + CONTROL):
            words = f"the role '{roles[row]}' is not control, check, waterline or on:NAME."
            raise _error(table, row, "table.choice", words, value=roles[row])
        if wet[row] not in YES + NO:
            words = f"under water is '{wet[row]}', not yes or no."
            raise _error(table, row, "table.choice", words, value=wet[row])
        if (sigma[row] <= 0.0).any():
            raise _error(table, row, "gcps.sigma", "standard deviations must be positive.")
        if np.isnan(xyz[row]).any() and not on[row]:
            words = "it has no x, y, z. Only those with role waterline or on:NAME need none."
            raise _error(table, row, "gcps.no_coordinates", words)
        same = np.array_equal(described[row], described[first], equal_nan=True)
        if not same or on[row] != on[first]:
            words = f"it is described differently in line {table.line[first]}. Use other names."
            raise _error(table, row, "gcps.contradiction", words)
    camera = _cameras_of(table, cameras)
    posed = np.flatnonzero(camera >= 0)
    own = np.array([row_of[name] for name in names])
    rows = np.unique(own[posed])  # the first mark of each point that is used
    source = crs or table_crs(table)[0] or table.crs  # an unknown one is refused there
    moved = _to_cameras(table, xyz[rows], rows, cameras, source)
    has_surfaces = any(on)
    sigma_px = np.sqrt((sigma[posed, 3:5] ** 2).mean(axis=1))
    sigma = np.nan_to_num(sigma[rows], nan=SIGMA_M)
    return GroundControl(
        names=tuple(names[i] for i in rows),
        xyz=moved,
        sigma_m=np.where(np.isnan(moved), np.inf, sigma[:, :3]),
        is_check=is_check[rows],
        under_water=under_water[rows],
        point=np.searchsorted(rows, own[posed]),
        camera=camera[posed],
        image_xy=table.of(("u", "v"))[posed],
        sigma_px=np.nan_to_num(sigma_px, nan=SIGMA_PX),
        crs=cameras.crs,
        on=tuple(on[i] for i in rows) if has_surfaces else (),
        on_sigma_m=sigma[:, 5] if has_surfaces else np.zeros(0),
    )


def _words(table: Table, role: str) -> list[str]:
    """Return the words of a column in lower case, empty without such a column."""
    texts = table.column(role) if table.has(role) else [""] * len(table.rows)
    return [text.lower().replace(" ", "_") for text in texts]


def _error(table: Table, row: int, code: str, words: str, **values: Any) -> InputError:
    """Return an error about a mark: file, line, image, point and what is wrong."""
    point = table.column("point")[row]
    return table.error(row, code, f"point {point}: {words}", point=point, **values)


def _cameras_of(table: Table, cameras: Cameras) -> IntArray:
    """Return the camera of each mark, -1 for images without a pose, and warn of these.

    Refuse marks in unknown images or outside their image, and two marks of a point in an image.
    """
    images, points, uv = table.labels, table.column("point"), table.of(("u", "v"))
    names = list(dict.fromkeys(images))
    found, ambiguous = match_labels(names, cameras.labels)
    camera = found[[names.index(name) for name in images]]
    lost = [name for name, row in zip(names, found, strict=True) if row < 0]
    if ambiguous:
        words = "the name fits several images of the model. Use names with their folders."
        raise table.error(images.index(ambiguous[0]), "images.ambiguous", words, image=ambiguous[0])
    unknown = list(unnamed(lost, cameras.unposed))
    if unknown:
        words = f"{', '.join(unknown[:5])} (of {len(unknown)}) are not among the {len(cameras)}"
        words += f" images of the model (first {cameras.labels[0]}). Give the points of this block."
        row = images.index(unknown[0])
        raise _error(table, row, "gcps.unknown_image", words, images=unknown)
    if len(lost) == len(names):
        raise bad_file(table.path, "gcps.no_pose", "none of its images has a pose. Align them.")
    if cameras.lenses is None or any(lens.unit != "px" for lens in cameras.lenses):
        sentence = "marks in images need cameras with lenses in pixels. Give --sensor."
        raise bad_file(table.path, "cameras.no_lens", sentence)
    first: dict[tuple[str, int], int] = {}
    for row in np.flatnonzero(camera >= 0).tolist():
        lens, (u, v) = cameras.lenses[camera[row]], uv[row].tolist()
        before = first.setdefault((points[row], int(camera[row])), row)
        if before != row:
            words = f"it has a mark in this image in line {table.line[before]}. Remove one."
            raise _error(table, row, "gcps.twice", words)
        if not (0.0 <= u <= lens.width and 0.0 <= v <= lens.height):
            words = f"{u:g}, {v:g} is outside the image of {lens.width:g} x {lens.height:g} pixels."
            words += " Count pixels from its upper left corner, to the right and down."
            raise _error(table, row, "gcps.outside", words, uv=[u, v])
    if lost:
        words = f"{(camera < 0).sum()} of {len(camera)} marks are in images without a pose, such as"
        words += f" {lost[0]}, and were skipped."
        warn(table.path, "gcps.unposed", words, path=table.path, images=lost)
    return camera


def _to_cameras(
    table: Table, xyz: FloatArray, rows: IntArray, cameras: Cameras, source: str | None
) -> FloatArray:
    """Return points in the CRS of the cameras; refuse points far from the block."""
    target = cameras.crs
    moved = to_cloud_crs(source, target, xyz, str(table.path), heights=True)(xyz)
    lost = ~np.isfinite(moved).all(axis=1) & np.isfinite(xyz).all(axis=1)
    if lost.any():
        i = int(np.argmax(lost))
        place = ", ".join(f"{value:.10g}" for value in xyz[i])
        words = f"{place} is outside the cloud's CRS. Check that of the points."
        raise _error(table, rows[i], "crs.outside", words)
    if target is None or target.strip().lower() == LOCAL:
        return moved
    # points that no image of the block can show
    middle = np.median(cameras.centres[:, :2], axis=0)
    reach_m = FARTHEST_M + np.hypot(*(cameras.centres[:, :2] - middle).T).max()
    away_m = np.hypot(*(moved[:, :2] - middle).T)
    if (away_m > reach_m).any():
        i = int(np.argmax(away_m))
        words = f"it is {away_m[i] / 1e3:,.0f} km from the block. Check the CRS of the points, and"
        raise _error(table, rows[i], "gcps.far", f"{words} the order of x and y.")
    return moved


# Formats


def _read(path: Path) -> Table:
    """Return the marks of a file as a table."""
    if recognises(metashape, Source(path)):
        return _metashape_table(path)
    lines = read_lines(path)
    numbered = [(i, line.split()) for i, line in enumerate(lines, start=1) if line.strip()]
    rows = [(i, fields) for i, fields in numbered[1:] if not fields[0].startswith("#")]
    first = [number(field) for field in rows[0][1][:5]] if rows else []
    if len(first) == 5 and not np.isnan([*first[:2], *first[3:]]).any():  # z may be NaN
        # ODM's list; points without a name are named by their coordinates
        named: dict[tuple[float, ...], str] = {}
        texts = []
        for i, fields in rows:
            if len(fields) < len(ODM) - 1:
                sentence = f"line {i} has {len(fields)} fields. Give x, y, z, u, v, image."
                raise bad_file(path, "gcps.fields", sentence, line=i)
            name = named.setdefault(tuple(map(number, fields[:3])), f"GCP {len(named) + 1}")
            texts.append([*fields, name][: len(ODM)])
        place = {role: i for i, role in enumerate(ODM)}
        return Table(path, [*ODM], texts, [i for i, _ in rows], place, crs=named_crs(path))
    if has_header(lines):
        kinds = [("point", *three, "label", "u", "v") for three in AXES]
        return read_table(path, *kinds, spellings=SPELLINGS)
    sentence = "is neither a table of marks nor OpenDroneMap's gcp_list.txt. Line 1 must name"
    sentence += " the columns name, x, y, z, image, u, v, or be a CRS."
    raise bad_file(path, "gcps.format", sentence)


def _metashape_table(path: Path) -> Table:
    """Return the markers that have surveyed coordinates, where they were measured in the images."""
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
            role = "check" if stated.get("enabled") in ("false", "0") else ""
            row = [label, *map(repr, place), *map(_positive, sigma.tolist()), role]
            surveyed[marker.get("id") or ""] = row
    rows = [
        [*surveyed[marker], names.get(camera, f"camera {camera}"), *map(repr, uv.tolist())]
        + 2 * [_positive(pixels)]
        for marker, camera, uv in (metashape.measured_marks(chunk.frame) if chunk.frame else ())
        if marker in surveyed
    ]
    if not rows:
        sentence = "has no marker with surveyed coordinates and a mark in an image. Export them."
        raise bad_file(path, "gcps.none", sentence)
    own = (chunk.root.findtext("marker_reference") or "").strip()
    crs = own or (chunk.root.findtext("reference") or "").strip() or LOCAL
    roles = ["point", "x", "y", "z", "sigma_x", "sigma_y", "sigma_z", "role"]
    roles += ["label", "u", "v", "sigma_u", "sigma_v"]
    columns, lines = {role: i for i, role in enumerate(roles)}, [*range(1, len(rows) + 1)]
    crs = LOCAL if is_local(parse_crs(crs, str(chunk.path))) else crs
    return Table(path, roles, rows, lines, columns, crs=crs)


def _positive(sigma: float) -> str:
    """Return a standard deviation as text, empty if it is not known."""
    return repr(sigma) if sigma > 0.0 else ""


# GNSS positions


def read_gnss(path: File, cameras: Cameras, *, crs: str | None = None) -> Cameras:
    """Return cameras with `gnss`: the GNSS positions of their images, in their own CRS.

    They are NaN for images without a position, and standard deviations for positions without one.
    Warns of images without a position.

    The file is a table with the columns image (label, name, ...), x, y, z or longitude, latitude,
    height and optionally sx, sy, sz (or sigma, or Metashape's accuracies) in metres; Metashape's
    reference table, a list by exiftool, or ODM's ``geo.txt``; or any camera file or folder with
    such positions (see `pcfix.read_cameras`), such as projects of Metashape and ODM. Images may be
    named with or without folder and extension. `crs` replaces that in the file; if none is stated,
    it is that of the cameras.
    """
    source = Path(path) if Path(path).is_dir() else check_input(path)
    if crs is not None:
        parse_crs(crs, str(source))
    without_names = {".mrk": "a list of DJI's exposure times", ".pos": "a solution of RTKLIB"}
    if (kind := without_names.get(source.suffix.lower())) is not None:
        sentence = f"is {kind}, which names no images. Make a table with the columns image,"
        sentence += " longitude, latitude, height from it."
        raise bad_file(source, "gnss.no_names", sentence)
    if source.is_dir() or not camera_tables.recognises(Source(source)):
        read = read_cameras(source)
        names, listed = list(read.labels), read.gnss
    else:
        columns = open_table(source)
        # names of standard deviations that are not ambiguous in a list of positions
        sigmas = {role: SPELLINGS[role] for role in ("sigma_x", "sigma_y", "sigma_z")}
        place = places(columns.header, sigmas) | dict(columns.place)
        names, listed = columns.labels, gnss_positions(replace(columns, place=place))
    if listed is None:
        sentence = "has no measured positions. Give a table with the columns image, x, y, z."
        raise bad_file(source, "gnss.none", sentence)
    row_of: dict[str, int] = {}
    for i, name in enumerate(names):
        first = row_of.setdefault(name, i)
        if (listed.sigma_m[i] <= 0.0).any():
            sentence = f"image {name}: standard deviations must be positive, or empty if unknown."
            raise bad_file(source, "gnss.sigma", sentence, image=name)
        if not np.array_equal(listed.xyz[i], listed.xyz[first], equal_nan=True):
            sentence = f"image {name} has two positions. Give one for every image."
            raise bad_file(source, "gnss.two_positions", sentence, image=name)
    row, ambiguous = match_labels(list(row_of), cameras.labels)
    for name in ambiguous:
        sentence = f"image {name} could be several of the model. Use names with their folders."
        raise bad_file(source, "images.ambiguous", sentence, image=name)
    there = row >= 0
    rows = np.array(list(row_of.values()))[there]
    xyz, sigma = np.full((2, len(cameras), 3), np.nan)
    xyz[row[there]], sigma[row[there]] = listed.xyz[rows], listed.sigma_m[rows]
    known = int(np.isfinite(xyz).all(axis=1).sum())
    if not known:
        sentence = f"no position belongs to an image such as {cameras.labels[0]}. Give those of"
        raise bad_file(source, "gnss.no_image", f"{sentence} this block.")
    cameras = replace(cameras, gnss=GnssPositions(xyz, sigma, crs or listed.crs))
    if is_tied(cameras.crs, str(source)):
        enu_m = adjusted_minus_gnss(cameras, str(source))[0][:, :2]
        both = enu_m[np.isfinite(enu_m).all(axis=1)]
        away_m = float(np.median(np.hypot(*both.T))) if len(both) else 0.0
        if away_m > FARTHEST_M:
            sentence = f"its positions are {away_m / 1e3:,.0f} km from the block. Check their CRS."
            raise bad_file(source, "gnss.far", sentence, away_m=away_m)
    if known < len(cameras):
        sentence = f"{known} of {len(cameras)} images have a GNSS position."
        warn(source, "gnss.images_without", sentence, path=source, images=known)
    return cameras


def gnss_in_frame_of(cameras: Cameras, name: str = "cameras") -> tuple[GnssPositions, str]:
    """Return the GNSS positions of the file `name` in the frame of the cameras, without a CRS.

    Return also why heights or all positions are missing, empty if they are not. The cameras are in
    a projected CRS in metres, or in the frame of their `gnss`. Positions are NaN for cameras
    without one, and heights that cannot be compared. Standard deviations east and north are used
    along x and y, without the meridian convergence.
    """
    unknown = np.full((len(cameras), 3), np.nan)
    nothing = GnssPositions(unknown, unknown, None)
    if cameras.gnss is None:
        return nothing, f"{name}: has no GNSS positions."
    crs, is_frame = cameras.crs or "", True  # whether the differences are of coordinates in it
    if is_topocentric(crs):
        is_frame = cameras.gnss.crs in (None, crs)
    elif is_tied(cameras.crs, name):
        found = parse_crs(crs, name)
        is_frame = found.is_projected and {a.unit_name for a in found.axis_info}.issubset(METRES)
    if not is_frame:
        return nothing, f"{name}: {crs} is no map in metres, so the GNSS cannot be compared."
    enu_m, reason = adjusted_minus_gnss(cameras, name)
    xyz = cameras.centres - enu_m
    sigma = np.where(np.isnan(xyz), np.nan, cameras.gnss.sigma_m)
    return GnssPositions(xyz, sigma, None), reason
