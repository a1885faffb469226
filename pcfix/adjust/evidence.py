"""What signs of absorbed refraction are looked for in: tie points, GNSS, surveys and the cloud.

The signs themselves are in `pcfix.adjust.diagnosis`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from pcfix.adjust.block import plain_block
from pcfix.adjust.diagnosis import (
    Diagnosis,
    Sign,
    bed_sign,
    control_sign,
    diagnosis_of,
    focal_sign,
    gnss_is_suspicious,
    gnss_sign,
    land_sign,
    sized,
    tie_point_sign,
)
from pcfix.adjust.gather import Datum, deeper, no_datum, straight_images, taken
from pcfix.errors import GeometryError
from pcfix.model import Cameras, FloatArray, GroundControl, TiePoints, WaterDimension, WaterSurface
from pcfix.water.fit import heights_from_cloud, is_near
from pcfix.water.surface import is_submerged, surface_above

if TYPE_CHECKING:
    from pcfix.adjust.mend import Mended

TIE_POINTS, LEAST_TIE_VIEWS = 3000, 3
CLOUD_POINTS, POINTS_PER_IMAGE = 1500, 10
LEAST_COORDINATES = 24
"""Of GNSS positions, that a statement takes."""
MOST_IMAGES, QUICK_IMAGES = 600, 200
"""Of which the pattern of absorbed refraction is computed, and in passing, where nobody asked; the
cost grows with their cube."""
LAND_M = 0.3
"""Above the water: what counts as land."""


NEAREST = 3
"""Points of a reference that give its height beside a point of the cloud."""


SAMPLE_POINTS = 50_000


class Cloud(Protocol):
    """A cloud that is read chunk by chunk; each has `xyz`, shape (n, 3)."""

    @property
    def points(self) -> int:
        """How many there are."""

    @property
    def chunks(self) -> Callable[[], Iterator[Any]]:
        """Reads them from the start."""


class Reference(Protocol):
    """A survey of land and bed: single points, or so many that they make a surface."""

    @property
    def xyz(self) -> FloatArray:
        """Shape (m, 3), in the cloud's CRS."""

    @property
    def sparse(self) -> bool:
        """Whether they are single points."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """What is at hand.

    Attributes
    ----------
    cameras : Cameras
        In the cloud's CRS, with the GNSS positions to compare with.
    name : str
        Of their file, for messages.
    view : Cloud or None
        Of the cloud, for points that stand for tie points, and heights about surveyed places.
    calibrated : dict
        Focal length by width of the image, by the name of the sensor; "" is any.
    gnss : Datum or None
        Positions of the GNSS in the frame of the cameras, NaN where there is none.
    neighbours : Sign or None
        What the points of the cloud say of each other; see `pcfix.adjust.diagnosis`.
    in_passing : bool
        Whether nobody asked, so that it must not take long.
    """

    cameras: Cameras
    name: str
    water: WaterSurface
    refractive_index: float
    ties: TiePoints | None = None
    view: Cloud | None = None
    control: GroundControl | None = None
    calibrated: dict[str, float] | None = None
    reference: Reference | None = None
    gnss: Datum | None = None
    neighbours: Sign | None = None
    in_passing: bool = False

    @property
    def has_height(self) -> bool:
        """Whether the water has a height anywhere, not only where the cloud has points."""
        return not isinstance(self.water, WaterDimension)

    @property
    def has_rays(self) -> bool:
        """Whether straight and refracted rays can be computed."""
        cameras = self.cameras
        if cameras.rotations is None or cameras.lenses is None:
            return False
        return self.has_height and all(lens.unit == "px" for lens in cameras.lenses)


EXPORTS = {
    "metashape": "give the project (.psx) or its BlocksExchange export with tie points",
    "photoscan": "give the project (.psz) or its BlocksExchange export with tie points",
    "pix4d": "give the params folder with its tp_ file",
    "opendronemap": "give the project's opensfm folder with tracks.csv",
    "opensfm": "keep tracks.csv beside the reconstruction",
    "colmap": "keep points3D beside the images",
    "blocksexchange": "export it with tie points",
    "bundler": "export the .out file with its points",
}
"""What a user has to give for tie points, by a word in the source of the cameras."""


def export_of(cameras: Cameras) -> str:
    """Return what a user has to give so that poses can be checked."""
    source = cameras.source.lower()
    other = "give a model with tie points (COLMAP's, Bundler's .out)"
    found = next((words for name, words in EXPORTS.items() if name in source), other)
    return f"{found}, or try 'pcfix cameras --gnss'"


def diagnosed(evidence: Evidence) -> Diagnosis:
    """Look for every sign that the evidence allows.

    Raises
    ------
    PcfixError
        If the cloud cannot be read.
    """
    signs = [] if evidence.neighbours is None else [evidence.neighbours]
    if evidence.has_rays:
        signs += _signs_of_rays(evidence)
    if evidence.calibrated and (found := focal_of(evidence)) is not None:
        signs.append(found)
    if evidence.control is not None:
        signs += signs_of_control(evidence, evidence.control)
    if evidence.reference is not None:
        signs += signs_of_reference(evidence, evidence.reference)
    return diagnosis_of(signs)


def _signs_of_rays(evidence: Evidence) -> list[Sign]:
    """Look at tie points, and at the GNSS."""
    cameras, gnss = evidence.cameras, evidence.gnss or no_datum(len(evidence.cameras))
    ties, apparent = (None, None) if evidence.ties is None else _sign_of_ties(evidence)
    off = cameras.centres - gnss.xyz
    known = int(np.isfinite(off).sum()) >= LEAST_COORDINATES
    bent = ties is not None and bool(ties.speaks)
    suspicious = gnss_is_suspicious(cameras.centres, off, gnss.sigma_m)
    signs = [] if ties is None else [ties]
    if not (bent or suspicious or (known and not evidence.in_passing)):
        return [*signs, _without_pattern(off, ", without a pattern")] if known else signs
    try:
        mended = _mended(evidence, apparent)
    except GeometryError as error:
        why = f"; what made their pattern is open ({error})"
        return [*signs, _without_pattern(off, why)] if known else signs
    signs = [sized(sign, mended) for sign in signs]
    if known:
        signs.append(gnss_sign(cameras.centres, off, gnss.sigma_m, mended))
    return signs


def _without_pattern(off_m: FloatArray, words: str) -> Sign:
    rms = float(np.sqrt(np.nanmean(off_m**2)))
    return Sign("GNSS", f"centres minus GNSS are {rms:.3f} m rms{words}", {"rms_m": rms}, None)


def _sign_of_ties(evidence: Evidence) -> tuple[Sign | None, FloatArray | None]:
    """Intersect some tie points straight and refracted; return where straight rays meet, too."""
    ties, n = evidence.ties, evidence.refractive_index
    if ties is None:
        return None, None
    counts = np.diff(ties.views.start)
    rows = np.flatnonzero((counts >= LEAST_TIE_VIEWS) & np.isfinite(ties.xyz).all(axis=1))
    if not len(rows):
        return None, None
    from pcfix.adjust.problem import intersect_fixed  # not quick to load

    block = plain_block(
        evidence.cameras, taken(ties, rows[:: max(1, len(rows) // TIE_POINTS)]), None, n
    )
    straight = intersect_fixed(block)
    above = surface_above(evidence.water, straight.xyz)
    wet = is_submerged(straight.xyz[:, 2], above)
    begin = deeper(straight.xyz, above.height_m, wet, n)
    refracted = intersect_fixed(replace(block, xyz=begin, wet=wet, water=evidence.water))
    sign = tie_point_sign(straight, refracted, above.height_m - straight.xyz[:, 2])
    return sign, straight.xyz[np.isfinite(straight.squares)]


def _mended(evidence: Evidence, apparent: FloatArray | None) -> Mended:
    """Return the poses as an adjustment with water would have them.

    Raises
    ------
    GeometryError
        If the block is too large, or its points do not determine them.
    """
    count, most = len(evidence.cameras), QUICK_IMAGES if evidence.in_passing else MOST_IMAGES
    if count > most:
        raise GeometryError(f"{count} images are more than {most}")
    wanted = max(CLOUD_POINTS, POINTS_PER_IMAGE * count)
    if apparent is None:
        if evidence.view is None:
            raise GeometryError("there is no cloud")
        apparent = sample_of(evidence.view, wanted)
    from pcfix.adjust.mend import mended  # not quick to load

    some = apparent[:: max(1, len(apparent) // wanted)]
    return mended(some, evidence.cameras, evidence.water, evidence.refractive_index)


def sample_of(view: Cloud, wanted: int) -> FloatArray:
    """Return about so many points of a cloud, evenly spread over it, shape (m, 3)."""
    every = max(1, view.points // wanted)
    return np.vstack([np.zeros((0, 3)), *(seen.xyz[::every] for seen in view.chunks())])


def focal_of(evidence: Evidence) -> Sign | None:
    """Compare each sensor with its calibration."""
    known = evidence.calibrated or {}
    by_sensor: dict[str, list[float]] = {}
    for lens in evidence.cameras.lenses or ():
        by_sensor.setdefault(lens.sensor, []).append(lens.focal / lens.width)
    pairs = [
        (float(np.mean(focal)), known.get(name, known.get("", np.nan)))
        for name, focal in by_sensor.items()
    ]
    pairs = [pair for pair in pairs if np.isfinite(pair[1])]
    if not pairs:
        return None
    centres = evidence.cameras.centres
    level = surface_above(evidence.water, centres).height_m if evidence.has_height else np.nan
    height = float(np.nanmedian(centres[:, 2] - level)) if np.isfinite(level).any() else 0.0
    focal, calibrated = np.array(pairs).T
    return focal_sign(focal, calibrated, height)


def _gsd_m(evidence: Evidence) -> float:
    """Return the size of a pixel at the water, roughly; zero where it cannot be known."""
    lenses, centres = evidence.cameras.lenses, evidence.cameras.centres
    if lenses is None or not evidence.has_height:
        return 0.0
    level = surface_above(evidence.water, centres).height_m
    above = centres[:, 2] - np.where(np.isfinite(level), level, np.nanmean(level))
    focal = [lens.focal if lens.unit == "px" else np.inf for lens in lenses]
    return float(np.mean(above / focal))


def signs_of_control(evidence: Evidence, control: GroundControl) -> list[Sign]:
    """Compare control points on land with the cloud and in the images."""
    level = surface_above(evidence.water, control.xyz).height_m
    land = ~control.under_water & ~(control.xyz[:, 2] < level)
    gsd, cameras, signs = _gsd_m(evidence), evidence.cameras, []
    if evidence.view is not None:
        higher = cloud_heights(evidence.view, control.xyz[land], gsd) - control.xyz[land, 2]
        signs.append(land_sign(higher, gsd, "the control points"))
    if cameras.rotations is not None and cameras.lenses is not None:
        rows = np.flatnonzero(land[control.point])
        at = straight_images(control.xyz[control.point[rows]], control.camera[rows], cameras)
        signs.append(control_sign(control.image_xy[rows] - at, control.sigma_px[rows], gsd))
    return signs


def cloud_heights(view: Cloud, xyz: FloatArray, gsd_m: float) -> FloatArray:
    """Return the heights of a cloud about single places, shape (p,); NaN where it has none."""
    radius = float(np.clip(10.0 * gsd_m, 0.2, 2.0))
    xy = np.ascontiguousarray(xyz[:, :2])
    if not len(xy):
        return np.zeros(0)
    near = [seen.xyz[is_near(xy, seen.xyz, radius)] for seen in view.chunks()]
    return heights_from_cloud(xy, np.vstack([np.zeros((0, 3)), *near]), radius)


def signs_of_reference(evidence: Evidence, reference: Reference) -> list[Sign]:
    """Compare land and bed of the cloud with a survey of both."""
    if evidence.view is None or not evidence.has_height:
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


def _beside(view: Cloud, reference: FloatArray) -> tuple[FloatArray, FloatArray]:
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
