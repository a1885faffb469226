"""Agisoft Metashape and PhotoScan: exported cameras or markers, and projects.

Read are the XML of *Export Cameras* and *Export Markers*, projects of one file (.psz, a zip) and
projects with a folder (.psx, whose documents are zips in ``<name>.files``).

``camera/transform`` is a 4x4 matrix from the camera (x right, y down, z forward) to the chunk. The
``transform`` of the camera's component, or of the chunk, leads on to the world as s R X + t. With
a CRS in ``reference`` the world is geocentric, on the datum of that CRS, with ellipsoidal heights.
With ``LOCAL_CS``, or no transform, it is local. The image of a slave camera (``master_id``) has the
pose T_master [R, t], with the rotation and location of its sensor in the master's frame. EXIF
orientations are ignored: matrices and pixels are those of the image as stored.

The tie points of a frame are PLY files in one archive: ``points`` has x, y, z in the frame of the
component and the id of the track, ``projections`` of each camera x and y in pixels from the corner
of the image and the id of the track. The document of the frame has the markers, with a ``location``
x, y in each image; only the pinned ones were measured, Metashape computed the others. The GNSS
positions are the ``reference`` of each camera, in the CRS of the cameras or of the chunk.

Calibration. The formula is that of `pcfix.model.Lens`, with cx and cy from the centre of the image.
A fisheye is equidistant, and since version 2.3 can be equisolid. Files of PhotoScan up to 1.2 can
have fx and fy instead of f: there cx and cy count from the corner, and p1 and p2 change places.

References: "Agisoft Metashape User Manual, Professional Edition", appendix "Camera models";
"Metashape Python Reference", Chunk.transform, Sensor.location, CoordinateSystem.geoccs;
``save_estimated_reference.py`` in github.com/agisoft-llc/metashape-scripts.
"""

import re
import zipfile
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from pcfix.errors import bad_file
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import Source, damaged, number, numbers, read_xml, text_of, warn
from pcfix.io.crs import LOCAL, crs_text, is_local, parse_crs, unbound
from pcfix.io.ply import parse_header
from pcfix.model import Cameras, FloatArray, GnssPositions, IntArray, Lens, Projection, TiePoints

PARAMETERS = {
    *("f", "fx", "fy", "cx", "cy", "b1", "b2", "skew"),
    *("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4"),
}
# Kinds of sensors that a lens can describe: not spherical, cylindrical or RPC.
PROJECTIONS: dict[str, Projection] = {
    "frame": "perspective",
    "fisheye": "equidistant",
    "equidistant_fisheye": "equidistant",
    "equisolid_fisheye": "equisolid",
}
# Names of stated standard deviations and the axes that they are of.
SPREADS = {"sxyz": [0, 1, 2], "sxy": [0, 1], "sx": [0], "sy": [1], "sz": [2]}
INSIDE = r"project\.zip"
CONTENT = re.compile(  # a project, chunks or a chunk, after the declaration and comments
    r"\A\s*(<\?.*?\?>\s*|<!--.*?-->\s*)*"
    r"(<(document|collection)\b.*?(<chunks?\b|\bpath=)|<chunk\b.*?<sensors\b)",
    re.DOTALL,
)


def read(source: Source) -> Cameras:
    """Read the aligned images of a chunk: geocentric, or in a ``local`` frame."""
    chunk = open_chunk(source.path)
    images, unposed, is_placed = aligned_images(chunk)
    labels = tuple(image.label for image in images)
    in_world = np.array([image.place @ image.pose for image in images])
    turns, centres = in_world[:, :3, :3], in_world[:, :3, 3]
    scales = np.cbrt(np.linalg.det(turns))[:, None, None]
    rotations = np.ascontiguousarray((turns / scales).transpose(0, 2, 1))  # world to camera
    lens_of = {one: _lens(chunk.path, one) for one in dict.fromkeys(i.sensor for i in images)}
    lenses = tuple(lens_of[image.sensor] for image in images)
    text, crs, project_crs = text_of(chunk.root, "reference"), LOCAL, None
    if text and is_placed and not is_local(stated := parse_crs(text, str(chunk.path))):
        # the geocentric CRS on the same datum; of WGS 84 it has the code 4978
        axes = {"coordinate_system": type(stated)("EPSG:4978").to_json_dict()["coordinate_system"]}
        datum = unbound(stated.geodetic_crs or stated).to_json_dict()
        given = datum | axes | {"type": "GeodeticCRS", "id": None}
        crs = crs_text(type(stated).from_json_dict({k: v for k, v in given.items() if v}))
        project_crs = crs if stated.is_geocentric else text
    gnss = _gnss_positions(chunk, images)
    return Cameras(
        labels, centres, rotations, lenses, crs, project_crs=project_crs, gnss=gnss, unposed=unposed
    )


# ---- documents ----


class Document(NamedTuple):
    """An element, and the file or archive that contains it."""

    root: Element
    path: Path

    def path_to(self, element: Element) -> Path | None:
        """Return the archive that an element refers to; None if it has no path."""
        relative = element.get("path")
        return None if relative is None else self.path.parent / relative.replace("\\", "/")

    def follow(self, element: Element) -> "Document":
        """Return the document that an element refers to by its path, or the element itself."""
        path = self.path_to(element)
        return Document(element, self.path) if path is None else Document(read_xml(path), path)

    @property
    def frame(self) -> "Document | None":
        """The first frame of a chunk, which has the images of every marker and the tie points."""
        first = self.root.find("frames/frame")
        return None if first is None else self.follow(first)

    def properties(self, name: str) -> dict[str, str]:
        """Return the names and values of the properties in an element of a chunk."""
        found = self.root.iterfind(f"{name}/property")
        return {one.get("name") or "": one.get("value") or "" for one in found}


def open_chunk(path: Path) -> Document:
    """Return the active chunk, or the first that has aligned images if that one has none."""
    named = path / "project.zip" if path.is_dir() else path
    top = Document(read_xml(named), named)
    if top.root.tag == "document" and (inside := top.root.get("path")):  # .psx: in its folder
        named = path.parent / inside.replace("{projectname}", path.stem)
        top = Document(read_xml(named), named)
    if top.root.tag == "chunk":
        return top
    parent = top.root.find("chunks")
    active = None if parent is None else parent.get("active_id")
    listed = top.root.findall("chunk") or top.root.findall("chunks/chunk")
    listed.sort(key=lambda chunk: chunk.get("id") != active)
    found = [top.follow(chunk) for chunk in listed]
    posed = [one for one in found if one.root.find("cameras//camera/transform") is not None]
    if not found:
        raise checks.no_pose(path)
    names = [name_of(one.root) for one in posed]
    if len(names) > 1:
        sentence = f"several chunks have aligned images; the active one, {names[0]}, is read."
        warn(path, "cameras.several_chunks", sentence, chunk=names[0], others=names[1:])
    return (posed or found)[0]


# ---- images ----


class Image(NamedTuple):
    """An aligned image: its `pose` in the frame of the chunk, and the `place` of that in the world.

    Both are 4x4 matrices, from the camera and to the world.
    """

    id: str
    label: str
    element: Element
    sensor: Element
    component: str | None
    pose: FloatArray
    place: FloatArray


def aligned_images(chunk: Document) -> tuple[list[Image], tuple[str, ...], bool]:
    """Return the images of a chunk that are read, the other names, and whether it has a transform.

    The others are not aligned, disabled (they took no part in the dense cloud), not of a central
    projection, or in a component without a transform. Keyframes of animations are no images.
    """
    path, element = chunk.path, chunk.root
    places, is_placed = _places(path, element)
    sensors = {sensor.get("id"): sensor for sensor in element.iterfind("sensors/sensor")}
    photos = {
        camera.get("id") or f"#{i}": camera
        for i, camera in enumerate(element.iterfind("cameras//camera"))
        if camera.get("type", "regular") == "regular"
    }
    own = dict[str, FloatArray]()  # poses in the chunk
    for name, camera in photos.items():
        if text := text_of(camera, "transform"):
            where = f"image {name_of(camera)}, transform"
            own[name] = numbers(path, where, text, 16).reshape(4, 4)
    images, others, unused = list[Image](), list[str](), 0
    for name, camera in photos.items():
        label, master = name_of(camera), camera.get("master_id") or ""
        home = camera.get("component_id") or photos.get(master, camera).get("component_id")
        place = places.get(home, places[None])
        sensor, pose = sensors.get(camera.get("sensor_id")), own.get(name)
        if pose is None and master in own and sensor is not None:  # its sensor is on the master
            where, turn = f"sensor {name_of(sensor)}", text_of(sensor, "rotation")
            on_master = np.eye(4)
            on_master[:3, 3] = numbers(path, where, text_of(sensor, "location") or "0 0 0", 3)
            if turn:
                on_master[:3, :3] = numbers(path, where, turn, 9).reshape(3, 3)
            pose = own[master] @ on_master
        if pose is None:
            others.append(label)
        elif sensor is None:
            raise damaged(path, f"sensor {camera.get('sensor_id')} is missing")
        elif place is None or camera.get("enabled") == "false" or _kind(sensor) not in PROJECTIONS:
            others.append(label)
            unused += 1
        else:
            images.append(Image(name, label, camera, sensor, home, pose, place))
    why = "disabled, not from a frame or fisheye sensor, or in a component without transform"
    if not images:
        raise checks.no_pose(path, f"no image is aligned, or all are {why}")
    if unused:
        warn(path, "cameras.left_out", f"{unused} aligned images are skipped: {why}.")
    return images, tuple(others), is_placed


def _places(path: Path, chunk: Element) -> tuple[dict[str | None, FloatArray | None], bool]:
    """Return the matrix of each component to the world, or None, and whether any has one.

    The key None is for images in no component. Every component has its own frame and its own
    transform; the active one can have that of the chunk. If none has a transform, the world is the
    frame of the chunk.
    """
    framed = {None: chunk} | {one.get("id"): one for one in chunk.iterfind("components/component")}
    places = {name: _similarity(path, one.find("transform")) for name, one in framed.items()}
    has_place = any(place is not None for place in places.values())
    if not has_place:
        places[None] = np.eye(4)
    parent = chunk.find("components")
    active = None if parent is None else parent.get("active_id")
    if places.get(active) is None:
        places[active] = places[None]
    return places, has_place


def _similarity(path: Path, element: Element | None) -> FloatArray | None:
    """Return the 4x4 matrix of a transform that is one matrix, or has up to three parts."""
    if element is None:
        return None
    where, matrix = "transform of the chunk", np.eye(4)
    scale, rotation, translation = map(element.findtext, ("scale", "rotation", "translation"))
    if (element.text or "").strip():
        matrix = numbers(path, where, element.text, 16).reshape(4, 4)
    elif scale is rotation is translation is None:
        return None
    if rotation is not None:
        matrix[:3, :3] = numbers(path, where, rotation, 9).reshape(3, 3)
    if translation is not None:
        matrix[:3, 3] = numbers(path, where, translation, 3)
    # a matrix contains the scale, unless this has an element of its own
    inside = np.cbrt(np.linalg.det(matrix[:3, :3])) if scale is None else 1.0
    size = inside if scale is None else number(path, where, scale)
    if not size > 0.0:
        raise damaged(path, f"{where}: the scale {size:g} is not positive")
    matrix[:3, :3] = size * checks.rotations(path, [where], matrix[:3, :3] / inside)[0]
    return matrix


# ---- lenses ----


def read_calibration(path: Path) -> Lens:
    """Read a calibration that Metashape saved on its own (root element ``calibration``), pixels."""
    root = read_xml(path)
    kind = text_of(root, "projection") or "frame"
    if root.tag != "calibration" or kind not in PROJECTIONS:
        sentence = f"is not a calibration of Metashape of type {', '.join(PROJECTIONS)}."
        raise bad_file(path, "cameras.no_calibration", sentence, tag=root.tag, model=kind)
    size = [number(path, side, root.findtext(side)) for side in ("width", "height")]
    return _calibrated(path, path.stem, kind, root, size)


def name_of(element: Element) -> str:
    """Return the label of an image, sensor or marker, or its number."""
    return element.get("label") or f"number {element.get('id')}"


def _calibration(sensor: Element) -> Element | None:
    """Return the last adjusted calibration, else the last one."""
    found = sensor.findall("calibration[@class='adjusted']") or sensor.findall("calibration")
    return found[-1] if found else None


def _kind(sensor: Element) -> str:
    """Return the type of a sensor, which may be none of `PROJECTIONS`."""
    found = _calibration(sensor)
    return (found is not None and found.get("type")) or sensor.get("type") or "frame"


def _lens(path: Path, sensor: Element) -> Lens:
    """Return the adjusted calibration, else the initial one."""
    label, found = name_of(sensor), _calibration(sensor)
    resolution = None if found is None else found.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    if resolution is None or found is None:
        raise damaged(path, f"sensor {label} has no calibration or no size")
    sides = (resolution.get(side) for side in ("width", "height"))
    size = [number(path, f"sensor {label}, resolution", side) for side in sides]
    if found.findtext("corrections/coeffs"):
        sentence = f"the additional corrections of sensor {label} are ignored."
        warn(path, "cameras.corrections", sentence, sensor=label)
    return _calibrated(path, label, _kind(sensor), found, size)


def _calibrated(
    path: Path, sensor: str, kind: str, calibration: Element, size: list[float]
) -> Lens:
    """Return the lens of a calibration of a known kind, for an image of a size in pixels."""
    given = defaultdict[str, float](float)
    for entry in calibration:
        if entry.tag in PARAMETERS:
            given[entry.tag] = number(path, f"sensor {sensor}, {entry.tag}", entry.text)
    if "f" in given:
        given |= {"fx": given["f"] + given["b1"], "skew": given["b2"]}
        given |= {"dx": given.pop("cx", 0.0), "dy": given.pop("cy", 0.0)}
    else:  # PhotoScan's
        given |= {"fy": given.get("fy", given["fx"]), "p1": given["p2"], "p2": given["p1"]}
    return checks.lens_by_name(given, *size, projection=PROJECTIONS[kind], sensor=sensor)


# ---- what was measured ----


def _gnss_positions(chunk: Document, images: list[Image]) -> GnssPositions | None:
    """Return the reference positions of images.

    Positions that the user unticked are skipped, unless all are, as is usual when only control
    points determine the block.
    """
    path, given = chunk.path, [image.element.find("reference") for image in images]
    stated = {i: one.attrib for i, one in enumerate(given) if one is not None}
    ticked = {i: of for i, of in stated.items() if of.get("enabled") != "false"}
    settings = chunk.properties("settings")
    names = {"sxyz": "accuracy_cameras", "sxy": "accuracy_cameras_xy", "sz": "accuracy_cameras_z"}
    of_all = {name: settings.get(one, "") for name, one in names.items()}
    start = spreads(path, "settings of the chunk", of_all, np.full(3, np.nan))
    places = {}
    for i, of in (ticked or stated).items():
        where = f"image {images[i].label}, reference"
        xyz = [number(path, where, of[axis]) if axis in of else np.nan for axis in "xyz"]
        sigma = spreads(path, where, of, start)
        places[i] = xyz, np.where(np.isfinite(xyz) & (sigma > 0.0), sigma, np.nan)
    # the CRS of the cameras may differ from that of the chunk
    own = text_of(chunk.root, "camera_reference")
    crs = own or text_of(chunk.root, "reference") or "LOCAL"
    found = checks.measured(range(len(images)), places, crs)
    if found is None:
        return None
    if is_local(parsed := parse_crs(crs, str(path))):
        return replace(found, crs=LOCAL)
    largest = np.nanmax(np.abs(found.xyz[:, :2]), axis=0)
    if own or parsed.is_geographic or (largest > [180.0, 90.0]).any():
        return found
    sentence = "the camera positions are degrees in a CRS in metres; WGS 84 is assumed."
    warn(path, "cameras.gnss_in_degrees", sentence)
    return replace(found, crs="EPSG:4979")


def spreads(path: Path, where: str, stated: dict[str, str], start: FloatArray) -> FloatArray:
    """Return `start` with the stated standard deviations: one number for all axes, or for each."""
    sigma = start.copy()
    for name, axes in SPREADS.items():
        if text := stated.get(name):
            count = 1 if len(text.split()) == 1 else len(axes)
            sigma[axes] = numbers(path, f"{where}, {name}", text, count)
    return sigma


def measured_marks(frame: Document) -> Iterator[tuple[str, str, FloatArray]]:
    """Yield marker, camera and image coordinates, without those that Metashape computed."""
    for marker in frame.root.iterfind("markers//marker"):
        for mark in marker.iterfind("location"):
            if "false" not in (mark.get("pinned"), mark.get("valid")):
                name, camera = marker.get("marker_id") or "", mark.get("camera_id") or ""
                where = f"marker {name}, camera {camera}"
                uv = [number(frame.path, where, mark.get(axis)) for axis in "xy"]
                yield name, camera, np.array(uv)


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read the tie points of a project, then the markers with their measurements.

    A marker has no position (NaN), as the file has only its surveyed coordinates.
    """
    chunk = open_chunk(source.path)
    images, frame, found = aligned_images(chunk)[0], chunk.frame, list[checks.Observations]()
    if frame is not None:
        row_of = {image.id: i for i, image in enumerate(images)}
        marks = [mark for mark in measured_marks(frame) if mark[1] in row_of]
        names = {name: i for i, name in enumerate(dict.fromkeys(name for name, _, _ in marks))}
        point = np.array([names[name] for name, _, _ in marks], np.int64)
        camera = np.array([row_of[one] for _, one, _ in marks], np.int64)
        uv = np.array([uv for _, _, uv in marks]).reshape(-1, 2)
        markers = checks.Observations(np.full((len(names), 3), np.nan), point, camera, uv)
        found = [*_tie_points(frame, images), markers]
    if not any(len(part.point) for part in found):
        why = "only a project (.psx with its folder) or markers have any"
        raise checks.no_tie_points(chunk.path, why)
    return checks.tie_points(*found)


def _tie_points(frame: Document, images: list[Image]) -> Iterator[checks.Observations]:
    """Yield the points of every component that has a place; their archive may be missing."""
    clouds = (*frame.root.iterfind("point_cloud"), *frame.root.iterfind("tie_points"))
    there = [one for one in clouds if (path := frame.path_to(one)) is None or path.is_file()]
    found = (one for one in map(frame.follow, there) if one.root.find("projections") is not None)
    if (document := next(found, None)) is None:
        return
    listed = document.root.iterfind("projections")
    files = {entry.get("camera_id") or "": entry.get("path") or "" for entry in listed}
    with checks.reading(document.path), zipfile.ZipFile(document.path) as archive:
        for points in document.root.iterfind("points"):
            component = points.get("component_id")
            inside = [component in (one.component, None) or one.component is None for one in images]
            rows = [i for i, image in enumerate(images) if inside[i] and image.id in files]
            if not rows:
                continue
            xyz, tracks = _vertices(archive, points.get("path"), "xyz")
            place = images[rows[0]].place
            marks = [_vertices(archive, files[images[row].id], "xy") for row in rows]
            point = checks.rows_of(np.concatenate([of_track for _, of_track in marks]), tracks)
            camera = np.repeat(rows, [len(uv) for uv, _ in marks])
            uv = np.concatenate([uv for uv, _ in marks])
            yield checks.Observations(xyz @ place[:3, :3].T + place[:3, 3], point, camera, uv)


def _vertices(archive: zipfile.ZipFile, name: str | None, axes: str) -> tuple[FloatArray, IntArray]:
    """Return the coordinates and tracks (id) of a binary PLY in an archive."""
    where, data = f"{archive.filename}: {name}", archive.read(name or "")
    header = parse_header(where, data)
    kinds = {own: header.order + item for own, (item, _) in header.properties.items()}
    if not header.has(*header.properties, *axes, "id"):
        raise damaged(where, f"it is not a binary PLY of vertices with {', '.join(axes)}, id")
    with checks.reading(where):
        rows = np.frombuffer(data, np.dtype([*kinds.items()]), header.records, header.first)
        columns = np.column_stack([rows[axis] for axis in axes]).astype(np.float64)
    return columns, rows["id"].astype(np.int64)
