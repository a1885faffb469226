"""OPF, the Open Photogrammetry Format of PIX4Dmatic and PIX4Dcatch: a project and its parts.

The project (``.opf``, JSON) names files by item and format. The item `calibration` has the
calibrated cameras and the tracks; `input_cameras` frames and GNSS positions; `camera_list` the
names of the images; `scene_reference_frame` the CRS.

Poses are in the processing CRS, which is right-handed: coordinates of the project's CRS times
`scale`, with x and y exchanged if that is left-handed (`swap_xy`), plus `shift`. So its axes are
east, north, up. A CRS without heights has ellipsoidal ones, in the unit of its plan. Omega, phi,
kappa: Rx Ry Rz turns image axes x right, y up, z back to the processing CRS.

Pixels start at the corner of the image; T1 and T2 are in OpenCV's order. A fisheye has an affine
matrix [c d; e f] and a polynomial of 2 theta / pi, as in `pcfix.io.cameras.pix4d`.

Tracks are a glTF model with its buffers next to it: positions in the axes of each node, whose
matrix leads to y up (so processing x, y, z are its x, -z, y), and of each point the first of its
matches in 40 bits and their count in 24.

Reference: Pix4D, "Open Photogrammetry Format Specification" 1.0, https://pix4d.github.io/opf-spec.
"""

from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np

from pcfix.errors import bad_file
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import AffineFrame, Source, lens_by_name, load_json, triple
from pcfix.io.crs import crs_text, parse_crs, plan_unit
from pcfix.lens.rotations import from_omega_phi_kappa
from pcfix.model import Cameras, GnssPositions, Lens, TiePoints

FORMAT = "application/opf-{}+json"
CONTENT = '"application/opf-|"orientation_deg"'
INSIDE = r".*\.opf"
# The parameters of each type of sensor, by names of `checks`.
INTERNALS = {
    "perspective": {
        **{"principal_point_px": "cx cy", "focal_length_px": "f"},
        **{"radial_distortion": "k1 k2 k3", "tangential_distortion": "p2 p1"},
    },
    "fisheye": {"principal_point_px": "cx cy", "affine": "fx skew b3 fy"},
}
Part = dict[str, Any]  # an object of a JSON file


def read(source: Source) -> Cameras:
    """Read calibrated poses and lenses, in the CRS of the project."""
    project = _open_project(source.path)
    path, calibrated = project.part("calibration", "calibrated-cameras")
    _, given = project.part("input_cameras", "input-cameras")
    frame, names = _frame_of(project), dict[int, str]()
    for listed in project.files("camera_list", FORMAT.format("camera-list")):
        for camera in load_json(listed)["cameras"] if listed.is_file() else []:
            name = camera["uri"].replace("\\", "/").rpartition("/")[2]
            names[camera["id"]] = unquote(name.removesuffix("#page=0"))  # others keep their page
    shots = {shot["id"]: shot for shot in calibrated["cameras"]}
    if not shots:
        raise checks.no_pose(path)
    labels = tuple(names.get(i, f"camera {i}") for i in shots)
    xyz = np.array([triple(shot["position"]) for shot in shots.values()])
    angles = np.array([triple(shot["orientation_deg"]) for shot in shots.values()])
    sensors = {sensor["id"]: sensor for sensor in given["sensors"]}
    lenses = {one["id"]: _lens(path, one, sensors[one["id"]]) for one in calibrated["sensors"]}
    captures = given.get("captures", [])
    captured = [shot["id"] for capture in captures for shot in capture.get("cameras", [])]
    return Cameras(
        labels=labels,
        centres=frame.points(xyz),
        rotations=from_omega_phi_kappa(*angles.T),
        lenses=tuple(lenses[shot["sensor_id"]] for shot in shots.values()),
        crs=frame.crs,
        project_crs=frame.project_crs,
        gnss=_gnss(path, captures, list(shots)),
        unposed=tuple(names.get(i, f"camera {i}") for i in captured if i not in shots),
    )


class Project(NamedTuple):
    """The list of items of a project."""

    path: Path
    items: list[Part]

    def files(self, kind: str, form: str) -> list[Path]:
        """Return the files of a format that items of a kind have."""
        return [
            self.path.parent / unquote(resource["uri"])
            for item in self.items
            if item.get("type") == kind
            for resource in item.get("resources", [])
            if resource.get("format") == form
        ]

    def part(self, kind: str, form: str) -> tuple[Path, Part]:
        """Return the one file of a format and its contents."""
        found = self.files(kind, FORMAT.format(form))
        if len(found) != 1:
            raise checks.damaged(self.path, f"{len(found)} files of {form} instead of one")
        return found[0], load_json(found[0])


def _open_project(path: Path) -> Project:
    """Read the project at a path, in a folder, or that a part belongs to."""
    content = {} if path.is_dir() else load_json(path)
    if content.get("format") != FORMAT.format("project"):
        folders = [path] if path.is_dir() else [*path.resolve().parents][:2]
        found = [one for folder in folders for one in sorted(folder.glob("*.opf"))]
        if len(found) != 1:
            sentence = f"belongs to one of {len(found)} OPF projects. Give the project file (.opf)."
            raise bad_file(path, "cameras.several_projects", sentence, projects=len(found))
        path, content = found[0], load_json(found[0])
    return Project(path, content["items"])


def _frame_of(project: Project) -> AffineFrame:
    """Return the frame of the processing: east, north, up."""
    kind, form = "scene_reference_frame", "scene-reference-frame"
    if not project.files(kind, FORMAT.format(form)):  # the frame of the processing is arbitrary
        return AffineFrame(np.eye(3), np.zeros(3), "local")
    path, scene = project.part(kind, form)
    canonical = scene["base_to_canonical"]
    shift, scale = triple(canonical["shift"]), triple(canonical["scale"])
    if canonical.get("swap_xy"):
        scale = scale[[1, 0, 2]]  # positions are east, north already, scales in the CRS's order
    stated = checks.crs(path, scene["crs"]["definition"])
    crs, unit = (stated, 1.0) if stated == "local" else _with_heights(stated, str(path))
    size = [1.0, 1.0, unit] / scale
    return AffineFrame(np.diag(size), -shift * size, crs, None if crs == stated else stated)


def _with_heights(text: str, name: str) -> tuple[str, float]:
    """Return a CRS, ellipsoidal heights in metres added if need be, and metres in what was one."""
    crs = parse_crs(text, name)
    if len(crs.axis_info) != 2:
        return text, 1.0
    return crs_text(crs.to_3d()), 1.0 if crs.is_geographic else plan_unit(crs)[1]


def _lens(path: Path, sensor: Part, given: Part) -> Lens:
    """Return the calibrated lens of a sensor, with the frame of the input cameras."""
    frame, inner = map(float, given["image_size_px"]), sensor["internals"]
    name = str(given.get("name") or f"sensor {sensor['id']}")
    if (kind := str(inner.get("type"))) not in INTERNALS:
        remedy = "Remove its images and calibrate again"
        raise checks.unsupported(path, f"the type {kind:.40} of sensor {name}", remedy, sensor=name)
    values, more = dict[str, float](), dict[str, Any](sensor=name)
    for field, names in INTERNALS[kind].items():
        values |= zip(names.split(), np.ravel(inner[field]).astype(float).tolist(), strict=True)
    if kind == "fisheye":
        more |= {"projection": "polynomial", "shape": tuple(map(float, inner["polynomial"]))}
    return lens_by_name(values, *frame, **more)


def _gnss(path: Path, captures: list[Part], ids: list[int]) -> GnssPositions | None:
    """Return the positions of captures, at their reference cameras, in the CRS of the first."""
    found = {
        capture["reference_camera_id"]: capture["geolocation"]
        for capture in captures
        if capture.get("geolocation") and capture.get("reference_camera_id") in ids
    }
    text = next((place["crs"]["definition"] for place in found.values()), "local")
    if checks.crs(path, text) == "local":
        return None
    stated, up_m = _with_heights(text, str(path))
    crs = parse_crs(stated, str(path))
    order = [1, 0, 2] if crs.axis_info[0].direction.lower() == "north" else [0, 1, 2]
    unit_m = 1.0 if crs.is_geographic else plan_unit(crs)[1]
    places = {
        i: (triple(p["coordinates"])[order] * [1.0, 1.0, up_m], triple(p["sigmas"])[order] * unit_m)
        for i, p in found.items()
        if p["crs"]["definition"] == text
    }
    return checks.measured(ids, places, stated)


COMPONENTS = {"5121": "u1", "5123": "<u2", "5125": "<u4", "5126": "<f4"}


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read the tracks of the calibration: the points and matches of the nodes of its models."""
    project = _open_project(source.path)
    _, calibrated = project.part("calibration", "calibrated-cameras")
    row_of = {shot["id"]: i for i, shot in enumerate(calibrated["cameras"])}
    frame, found = _frame_of(project), list[checks.Observations]()
    for path in project.files("calibration", "model/gltf+json"):
        with checks.reading(path):
            model = load_json(path)
            for node in model.get("nodes", []):
                matrix = np.array(node.get("matrix", np.eye(4).ravel()), float).reshape(4, 4).T
                for primitive in model["meshes"][node["mesh"]]["primitives"]:
                    extensions = primitive.get("extensions", {})
                    matches = extensions.get("OPF_mesh_primitive_matches", {})
                    if "pixelCoordinates" in matches.get("imagePoints", {}):
                        place = primitive["attributes"]["POSITION"]
                        seen = _matches(path, model, place, matches, row_of)
                        x, y, z = (seen.xyz @ matrix[:3, :3].T + matrix[:3, 3]).T
                        xyz = frame.points(np.column_stack([x, -z, y]))  # the model has y up
                        found.append(seen._replace(xyz=xyz))
    if not found:
        raise checks.no_tie_points(project.path, "its calibration has no tracks")
    return checks.tie_points(*found)


def _matches(
    path: Path, model: Part, place: int, matches: Part, row_of: dict[int, int]
) -> checks.Observations:
    """Return the points of a primitive, in the axes of its node, and their observations."""
    xyz = _accessor(path, model, place, 3).astype(np.float64)
    uv = _accessor(path, model, matches["imagePoints"]["pixelCoordinates"], 2).astype(np.float64)
    ranges = _accessor(path, model, matches["pointIndexRanges"], 2)
    packed = ranges.astype("<u4").view("<u8")[:, 0]
    first = (packed & np.uint64(2**40 - 1)).astype(np.int64)
    count = (packed >> np.uint64(40)).astype(np.int64)
    index = _accessor(path, model, matches["cameraIds"], 1)[:, 0].astype(np.int64)
    rows = np.array([row_of.get(i, -1) for i in matches["cameraUids"]], np.int64)
    if (first + count > len(index)).any() or len(count) > len(xyz):
        raise checks.damaged(path, "its points have more matches than there are")
    point = np.repeat(np.arange(len(count)), count)
    # the first match of the point, and 0, 1, ... within it
    at = np.arange(len(point)) + np.repeat(first - (np.cumsum(count) - count), count)
    return checks.Observations(xyz, point, rows[index[at]], uv[at])


def _accessor(path: Path, model: Part, index: int, width: int) -> Any:
    """Return the rows of an accessor, from the file of its buffer."""
    accessor = model["accessors"][index]
    view = model["bufferViews"][accessor["bufferView"]]
    where = path.parent / unquote(model["buffers"][view["buffer"]]["uri"])
    with checks.reading(where):
        kind, count = COMPONENTS[str(accessor["componentType"])], accessor["count"]
        start = view.get("byteOffset", 0)
        values = np.frombuffer(where.read_bytes(), kind, count * width, start)
        return values.reshape(count, width)
