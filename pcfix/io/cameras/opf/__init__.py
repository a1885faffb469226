"""OPF, the Open Photogrammetry Format of PIX4Dmatic and PIX4Dcatch: a project and its parts.

The project (``.opf``, JSON) names files by item and format. Of the item `calibration` come the
calibrated cameras and the tracks; `input_cameras` has frames, pixel sizes and what the GNSS said;
`camera_list` the names of the images; `scene_reference_frame` the CRS.

Poses are in the processing CRS, which is right-handed and isometric: coordinates of the project's
CRS times `scale`, with x and y exchanged where that is left-handed (`swap_xy`), plus `shift`. So
its axes are east, north, up, as `Cameras` has them of a CRS with northing before easting too. A CRS
without heights has ellipsoidal ones, in the unit of its plan. Omega, phi, kappa: Rx Ry Rz turns
image axes x right, y up, z back to the processing CRS.

Pixels start at the corner of the image; T1 and T2 are in OpenCV's order. A fisheye has an affine
matrix [c d; e f] and a polynomial of 2 theta / pi, as in `pcfix.io.cameras.pix4d`.

Tracks are a glTF model with its buffers beside it: positions in the axes of each node, whose matrix
leads to y up (so processing x, y, z are its x, -z, y), and for each point 40 bits that say where
its matches begin and 24 how many they are.

Reference: Pix4D, "Open Photogrammetry Format Specification" 1.0, https://pix4d.github.io/opf-spec.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import json_number, mapping, vector
from pcfix.io.cameras.formats import Source
from pcfix.io.cameras.opf.project import (
    Part,
    frame_of,
    id_of,
    image_names,
    objects,
    open_project,
    text_of,
    with_heights,
)
from pcfix.io.cameras.opf.tracks import tie_points
from pcfix.io.crs import parse_crs, plan_unit
from pcfix.lens.rotations import from_omega_phi_kappa
from pcfix.model import Cameras, FloatArray, GnssPositions, Lens

__all__ = ["read", "recognises", "tie_points"]


def recognises(source: Source) -> bool:
    """Whether a file is a project or calibrated cameras, or a folder holds a project."""
    if source.path.is_dir():
        return any(name.endswith(".opf") for name in source.names)
    return '"application/opf-' in source.text or (
        '"orientation_deg"' in source.text and '"sensor_id"' in source.text
    )


def read(source: Source) -> Cameras:
    """Read calibrated poses and lenses, in the CRS of the project."""
    project = open_project(source.path)
    path, calibrated = project.part("calibration", "calibrated-cameras")
    inputs, given = project.part("input_cameras", "input-cameras", needed=False)
    frame, names = frame_of(project), image_names(project)
    shots = {id_of(path, shot): shot for shot in objects(path, calibrated, "cameras")}
    labels = tuple(names.get(i, f"camera {i}") for i in shots)
    xyz, angles = np.empty((2, len(shots), 3))
    for row, (label, shot) in enumerate(zip(labels, shots.values(), strict=True)):
        xyz[row] = vector(path, f"image {label}, position", shot.get("position"), 3)
        angles[row] = vector(path, f"image {label}, orientation", shot.get("orientation_deg"), 3)
    lenses, notes = _lenses(path, calibrated, inputs, given)
    captured = [
        id_of(inputs, shot)
        for capture in objects(inputs, given, "captures")
        for shot in objects(inputs, capture, "cameras")
    ]
    if any(shot.get("rolling_shutter") for shot in shots.values()):
        notes += (
            f"{path}: its rolling shutter is left out; each image has one pose, though the camera"
            " flew on while the rows were read out.",
        )
    return Cameras(
        labels=labels,
        centres=frame.enter(xyz),
        rotations=from_omega_phi_kappa(*angles.T) if len(shots) else None,
        lenses=lenses,
        crs=frame.crs,
        project_crs=frame.project_crs,
        notes=(*frame.notes, *notes, *checks.repeated(path, labels)),
        gnss=_gnss(inputs, given, list(shots)),
        unposed=tuple(names.get(i, f"camera {i}") for i in captured if i not in shots),
        source=" ".join(["OPF", *project.generator]),
    )


def _lenses(
    path: Path, calibrated: Part, inputs: Path, given: Part
) -> tuple[tuple[Lens, ...] | None, tuple[str, ...]]:
    """Return the lens of each image, or None and a note where one has no frame."""
    sensors = {id_of(inputs, sensor): sensor for sensor in objects(inputs, given, "sensors")}
    known: dict[int, Lens] = {}
    for sensor in objects(path, calibrated, "sensors"):
        size = sensors.get(id_of(path, sensor), {})
        if "image_size_px" in size:
            known[id_of(path, sensor)] = _lens(path, sensor, inputs, size)
    used = [id_of(path, shot, "sensor_id") for shot in objects(path, calibrated, "cameras")]
    lost = next((i for i in used if i not in known), None)
    if lost is None:
        return tuple(known[i] for i in used) or None, ()
    note = (
        f"{path}: sensor {lost} is not in the calibrated and the input cameras, which has its"
        " frame; frames are taken as boundless."
    )
    return None, (note,)


def _lens(path: Path, sensor: Part, inputs: Path, given: Part) -> Lens:
    """Return the calibrated lens of a sensor, with the frame of the input cameras."""
    name = str(given.get("name") or f"sensor {sensor['id']}")
    size = vector(inputs, f"sensor {name}, image_size_px", given["image_size_px"], 2)
    width, height = size.tolist()
    pixel_um = json_number(inputs, f"sensor {name}, pixel_size_um", given.get("pixel_size_um", 0))
    inner = mapping(path, f"sensor {name}, internals", sensor.get("internals"))

    def numbers(key: str, count: int) -> tuple[float, ...]:
        return tuple(vector(path, f"sensor {name}, {key}", inner.get(key), count).tolist())

    x, y = numbers("principal_point_px", 2)
    if inner.get("type") == "perspective":
        focal = json_number(path, f"sensor {name}, focal length", inner.get("focal_length_px"))
        t1, t2 = numbers("tangential_distortion", 2)
        radial = numbers("radial_distortion", 3)
        lens = Lens(focal, width, height, x, y, radial=radial, tangential=(t2, t1))
    elif inner.get("type") == "fisheye":
        c, d, e, f = numbers("affine", 4)
        powers = inner.get("polynomial")
        shape = numbers("polynomial", max(len(powers), 2) if isinstance(powers, list) else 4)
        lens = Lens(f, width, height, x, y, c - f, d, e, projection="polynomial", shape=shape)
    else:
        raise InputError(
            f"{path}: sensor {name}: the type {inner.get('type')!r:.40} is no camera with one image"
            " plane; leave its images out and calibrate again."
        )
    pixel_mm = pixel_um / 1000.0 if pixel_um > 0.0 else None
    return checks.lens(path, name, replace(lens, sensor=name, pixel_size_mm=pixel_mm))


def _gnss(path: Path, given: Part, ids: list[int]) -> GnssPositions | None:
    """Return where captures were taken, at their reference cameras, in the CRS of the first."""
    found: dict[int, tuple[str, FloatArray, FloatArray]] = {}
    for capture in objects(path, given, "captures"):
        if capture.get("geolocation") and capture.get("reference_camera_id") in ids:
            where = f"capture {capture.get('id')}"
            place = mapping(path, where, capture["geolocation"])
            named = text_of(path, mapping(path, f"{where}, crs", place.get("crs")), "definition")
            found[ids.index(capture["reference_camera_id"])] = (
                named,
                vector(path, f"{where}, coordinates", place.get("coordinates"), 3),
                vector(path, f"{where}, sigmas", place.get("sigmas"), 3),
            )
    if not found:
        return None
    text = next(iter(found.values()))[0]
    if checks.crs(path, text) == "local":
        return None
    crs = parse_crs(text, str(path))
    order = [1, 0, 2] if crs.axis_info[0].direction.lower() == "north" else [0, 1, 2]
    said, up_m = with_heights(text, str(path))
    unit_m = 1.0 if crs.is_geographic else plan_unit(crs)[1]
    xyz, sigma_m = np.full((2, len(ids), 3), np.nan)
    for row, (other, position, spread) in found.items():
        if other == text:
            xyz[row] = position[order] * [1.0, 1.0, up_m]
            sigma_m[row] = spread[order] * unit_m
    return GnssPositions(xyz, sigma_m, said)
