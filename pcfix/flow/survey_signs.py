"""What surveys say of poses: control points, calibrations, reference clouds against the cloud."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pcfix.adjust.diagnosis import Sign, bed_sign, control_sign, focal_sign, land_sign
from pcfix.model import WaterDimension
from pcfix.water.surface import surface_above

if TYPE_CHECKING:
    from pcfix.compare.match import Reference
    from pcfix.flow.surfaces import CloudView
    from pcfix.model import (
        Cameras,
        FloatArray,
        GroundControl,
        IntArray,
        TiePoints,
        WaterSurface,
    )

LAND_M = 0.3
"""Above the water: what counts as land."""
NEAREST = 3
"""Points of a reference that give its height beside a point of the cloud."""
SAMPLE_POINTS = 50_000


@dataclass(frozen=True, eq=False)
class Evidence:
    """What is at hand.

    Attributes
    ----------
    cameras : Cameras
        In the cloud's CRS, with the GNSS positions to compare with.
    name : str
        Of their file, for messages.
    water : WaterSurface
    refractive_index : float
    ties : TiePoints or None
    view : CloudView or None
        Of the cloud, for points that stand for tie points, and heights about surveyed places.
    control : GroundControl or None
    calibrated : dict
        Focal length by width of the image, by the name of the sensor; "" is any.
    reference : Reference or None
    most_images : int
    """

    cameras: Cameras
    name: str
    water: WaterSurface
    refractive_index: float
    ties: TiePoints | None = None
    view: CloudView | None = None
    control: GroundControl | None = None
    calibrated: dict[str, float] | None = None
    reference: Reference | None = None
    in_passing: bool = False

    @property
    def has_rays(self) -> bool:
        """Whether straight and refracted rays can be computed."""
        cameras = self.cameras
        if cameras.rotations is None or cameras.lenses is None:
            return False
        pixels = all(lens.unit == "px" for lens in cameras.lenses)
        return pixels and not isinstance(self.water, WaterDimension)


def sample_of(view: CloudView, wanted: int) -> FloatArray:
    """Return about so many points of a cloud, evenly spread over it, shape (m, 3)."""
    every = max(1, view.points // wanted)
    return np.vstack([np.zeros((0, 3)), *(seen.xyz[::every] for seen in view.chunks())])


def focal_of(evidence: Evidence) -> Sign | None:
    """Compare each sensor with its calibration."""
    known = evidence.calibrated or {}
    lenses = evidence.cameras.lenses or ()
    by_sensor: dict[str, list[float]] = {}
    for lens in lenses:
        by_sensor.setdefault(lens.sensor, []).append(lens.focal / lens.width)
    pairs = [
        (float(np.mean(focal)), known.get(name, known.get("", np.nan)))
        for name, focal in by_sensor.items()
    ]
    pairs = [pair for pair in pairs if np.isfinite(pair[1])]
    if not pairs:
        return None
    centres = evidence.cameras.centres
    level = surface_above(evidence.water, centres).height_m if has_height(evidence) else np.nan
    height = float(np.nanmedian(centres[:, 2] - level)) if np.isfinite(level).any() else 0.0
    focal, calibrated = np.array(pairs).T
    return focal_sign(focal, calibrated, height)


def has_height(evidence: Evidence) -> bool:
    """Whether the water has a height anywhere, not only where the cloud has points."""
    return not isinstance(evidence.water, WaterDimension)


def _gsd_m(evidence: Evidence) -> float:
    """Return the size of a pixel at the water, roughly; zero where it cannot be known."""
    lenses, centres = evidence.cameras.lenses, evidence.cameras.centres
    if lenses is None or not has_height(evidence):
        return 0.0
    level = surface_above(evidence.water, centres).height_m
    above = centres[:, 2] - np.where(np.isfinite(level), level, np.nanmean(level))
    focal = np.array([lens.focal if lens.unit == "px" else np.inf for lens in lenses])
    return float(np.mean(above / focal))


def signs_of_control(evidence: Evidence, control: GroundControl) -> list[Sign]:
    """Compare control points on land with the cloud and in the images."""
    level = surface_above(evidence.water, control.xyz).height_m
    land = ~control.under_water & ~(control.xyz[:, 2] < level)
    gsd, signs = _gsd_m(evidence), []
    if evidence.view is not None:
        higher = cloud_heights(evidence.view, control.xyz[land], gsd) - control.xyz[land, 2]
        signs.append(land_sign(higher, gsd, "the control points"))
    if evidence.cameras.rotations is not None and evidence.cameras.lenses is not None:
        rows = np.flatnonzero(land[control.point])
        signs.append(_control_sign(evidence, control, rows, gsd))
    return signs


def _control_sign(evidence: Evidence, control: GroundControl, rows: IntArray, gsd_m: float) -> Sign:
    from pcfix.lens.imaging import project

    cameras, camera = evidence.cameras, control.camera[rows]
    away = control.xyz[control.point[rows]] - cameras.centres[camera]
    local = np.einsum("oij,oj->oi", np.asarray(cameras.rotations)[camera], away)
    lenses = cameras.lenses or ()
    at = [project(lenses[c], one[None])[0] for c, one in zip(camera, local, strict=True)]
    off = control.image_xy[rows] - np.array(at).reshape(-1, 2)
    return control_sign(off, control.sigma_px[rows], gsd_m)


def cloud_heights(view: CloudView, xyz: FloatArray, gsd_m: float) -> FloatArray:
    """Return the heights of a cloud about single places, shape (p,); NaN where it has none."""
    from pcfix.water.fit import heights_from_cloud, is_near

    radius = float(np.clip(10.0 * gsd_m, 0.2, 2.0))
    xy = np.ascontiguousarray(xyz[:, :2])
    if not len(xy):
        return np.zeros(0)
    near = [seen.xyz[is_near(xy, seen.xyz, radius)] for seen in view.chunks()]
    return heights_from_cloud(xy, np.vstack([np.zeros((0, 3)), *near]), radius).height_m


def signs_of_reference(evidence: Evidence, reference: Reference) -> list[Sign]:
    """Compare land and bed of the cloud with a survey of both."""
    if evidence.view is None or not has_height(evidence):
        return []
    gsd = _gsd_m(evidence)
    if reference.sparse:
        surveyed = reference.xyz
        cloud_z = cloud_heights(evidence.view, surveyed, gsd)
    else:
        cloud, surveyed = _beside(evidence.view, reference.xyz)
        cloud_z = cloud[:, 2]
    if not len(surveyed):
        return []
    level = surface_above(evidence.water, surveyed).height_m
    land, bed = surveyed[:, 2] > level + LAND_M, surveyed[:, 2] < level
    signs = []
    if land.any():
        higher = cloud_z[land] - surveyed[land, 2]
        signs.append(land_sign(higher, gsd, "the reference"))
    if bed.any():
        apparent, true = level - cloud_z, level - surveyed[:, 2]
        signs.append(bed_sign(apparent[bed], true[bed], evidence.refractive_index))
    return signs


def _beside(view: CloudView, reference: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return points of a cloud and the reference at their places."""
    from scipy.spatial import cKDTree

    cloud = sample_of(view, SAMPLE_POINTS)
    if len(reference) < NEAREST or not len(cloud):
        return cloud[:0], reference[:0]
    size = np.ptp(reference[:, :2], axis=0)
    spacing = float(np.sqrt(max(size.prod(), 1e-9) / len(reference)))
    found = cKDTree(reference[:, :2]).query(cloud[:, :2], k=NEAREST)
    distance, row = np.asarray(found[0]), np.asarray(found[1])
    near = distance[:, -1] < 3.0 * spacing
    z = reference[row[near], 2].mean(axis=1)
    return cloud[near], np.column_stack([cloud[near, :2], z])
