"""What a camera file says, and whether it fits a cloud."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import InputError, SettingError
from pcfix.flow.inputs import Inputs
from pcfix.flow.points import CHUNK_POINTS
from pcfix.flow.surfaces import view_of
from pcfix.io.cameras.georeference import adjusted_minus_gnss
from pcfix.io.cameras.mistakes import likely_mistake
from pcfix.io.files import check_input, check_output, write_bytes
from pcfix.io.las.source import LasSource, coordinates, metric_crs
from pcfix.lens.frames import cameras_in_sight
from pcfix.model import WaterDimension
from pcfix.options import DEFAULT_REFRACTIVE_INDEX
from pcfix.water.surface import surface_above

if TYPE_CHECKING:
    from os import PathLike

    from pcfix.adjust.diagnosis import Diagnosis
    from pcfix.flow.surfaces import CloudView
    from pcfix.model import Cameras, FloatArray, Lens, WaterSurface

    AnyPath = str | PathLike[str]

SAMPLE_POINTS = 50_000
"""Points of the cloud that are looked for in the frames, evenly spread over the file."""


LEAST_SEEN_TWICE = 0.9
"""Share of a cloud that two frames or more should hold, as two made each point."""


@dataclass(frozen=True)
class Sensor:
    """The images of one interior orientation; None where the file does not say."""

    name: str
    images: int
    width: float
    height: float
    focal: float
    unit: str
    focal_mm: float | None
    pixel_size_um: float | None
    projection: str
    distorted: bool
    gsd_m: float | None


@dataclass(frozen=True)
class GnssResiduals:
    """Adjusted centres minus positions of the GNSS, metres east, north, up."""

    images: int
    mean_m: tuple[float | None, ...]
    sd_m: tuple[float | None, ...]
    largest_m: float
    largest_image: str
    reason: str


@dataclass(frozen=True)
class Fit:
    """How cameras and cloud lie to each other.

    Attributes
    ----------
    seen_by : dict
        Share of the cloud's points that 0, 1, 2, 3 or more cameras have in their frame.
    distance_m : float
        In plan, between the boxes around block and cloud.
    below_ground : int
        Cameras lower than the cloud's highest point within their reach in plan.
    verdict : str
        What is likely wrong; empty where they fit.
    """

    cloud: str
    points_sampled: int
    seen_by: dict[str, float]
    distance_m: float
    below_ground: int
    verdict: str

    @property
    def fits(self) -> bool:
        """Whether nothing looks wrong."""
        return not self.verdict


@dataclass(frozen=True, eq=False)
class CamerasReport:
    """What ``pcfix cameras`` says.

    Attributes
    ----------
    path, source : str
    cameras : Cameras
        In the cloud's CRS, where there is a cloud.
    crs_read, crs : str or None
        Of the file, and of `cameras`.
    sensors : tuple of Sensor
    height_above_water_m : tuple of 3 float, or None
        Least, mean, most; above the water where it is known, else None.
    tilt_deg : tuple of 2 float, or None
        Median and largest angle of the optical axes from nadir.
    gnss : GnssResiduals or None
    fit : Fit or None
    sample_xyz : array, shape (m, 3)
        Points of the cloud, for a picture; none without a cloud.
    level_m : float or None
        Mean height of the water.
    problem : str
        Why `cameras` are not in a map and so have no heights; empty where they are.
    diagnosis : Diagnosis or None
        Whether the poses have absorbed the refraction; None without a cloud or water.
    remedy : str
        The command that mends them.
    """

    path: str
    source: str
    cameras: Cameras
    crs_read: str | None
    crs: str | None
    sensors: tuple[Sensor, ...]
    height_above_water_m: tuple[float, float, float] | None
    tilt_deg: tuple[float, float] | None
    gnss: GnssResiduals | None
    fit: Fit | None
    sample_xyz: FloatArray
    level_m: float | None
    problem: str = ""
    diagnosis: Diagnosis | None = None
    remedy: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        fit = None if self.fit is None else {**asdict(self.fit), "fits": self.fit.fits}
        return {
            "path": self.path,
            "source": self.source,
            "images_posed": len(self.cameras),
            "images_unposed": list(self.cameras.unposed),
            "crs_read": self.crs_read,
            "crs": self.crs,
            "sensors": [asdict(sensor) for sensor in self.sensors],
            "height_above_water_m": self.height_above_water_m,
            "tilt_deg": self.tilt_deg,
            "problem": self.problem,
            "gnss": None if self.gnss is None else asdict(self.gnss),
            "fit": fit,
            "refraction": None if self.diagnosis is None else self.diagnosis.as_dict(),
            "notes": list(self.cameras.notes),
        }


def check_cameras(
    path: AnyPath,
    cloud: AnyPath | None = None,
    *,
    water: AnyPath | float | None = None,
    gnss: AnyPath | None = None,
    gcps: AnyPath | None = None,
    lens: AnyPath | None = None,
    reference: AnyPath | None = None,
    refractive_index: float = DEFAULT_REFRACTIVE_INDEX,
    plot: AnyPath | None = None,
    overwrite: bool = False,
    **words: Any,
) -> CamerasReport:
    """Read cameras and say what they are, and whether they fit a cloud; ``pcfix cameras``.

    Parameters
    ----------
    path : path
        See `pcfix.read_cameras`.
    cloud : path, optional
        LAS or LAZ that was made from these images.
    water : float, str or path, optional
        See `pcfix.read_water`; for the height above the water and the GSD there, and, with a
        cloud, whether the poses have absorbed the refraction; see `pcfix.adjust.diagnosis`.
    gnss : path, optional
        See `pcfix.io.gnss_positions.read_gnss`; instead of what the camera file has.
    gcps : path, optional
        See `pcfix.io.ground_control.read_ground_control`.
    lens : path, optional
        The calibration of the camera: one of Metashape's, or a table as of `sensor`. Default: the
        one that a file of Metashape says to have begun with.
    reference : path, optional
        A survey of land or bed: see `pcfix.io.clouds.read_reference`.
    refractive_index : float
        Of the water, relative to air.
    plot : path, optional
        PNG of the block in plan and from the side.
    overwrite : bool
        Replace a picture that exists.
    **words
        ``sensor``, ``angles``, ``cameras_crs``, ``cameras_offset_m``; see `pcfix.correct_file`.

    Returns
    -------
    CamerasReport

    Raises
    ------
    PcfixError
        If a file cannot be read, or the two CRS cannot be reconciled.
    """
    evidence = (gnss, gcps, lens, reference)
    if plot is not None:
        given = [p for p in (path, cloud, *evidence) if p is not None]
        check_output(plot, overwrite=overwrite, inputs=given)
    _check_enough(cloud, water, gcps, lens, reference)
    inputs = Inputs(path, 0.0 if water is None else water, **words)
    read = inputs.read()
    crs, xyz, heights = None, np.zeros((0, 3)), None
    view = None if cloud is None else view_of(check_input(cloud))
    surface = None if water is None else inputs.surface(view).surface
    if cloud is not None:
        with LasSource(check_input(cloud)) as source:
            crs = metric_crs(source)
            dimension = surface.name if isinstance(surface, WaterDimension) else None
            xyz, heights = _sample(source, dimension)
        cameras, problem = inputs.block(crs, read)[0], ""
    else:
        cameras, problem = _without_cloud(inputs, read)
    if gnss is not None:
        from pcfix.io.gnss_positions import read_gnss

        cameras = read_gnss(gnss, cameras)
    diagnosis, remedy = None, ""
    if view is not None and surface is not None:
        diagnosis = _diagnosis(
            inputs, cameras, view, surface, refractive_index, gcps, lens, reference
        )
        from pcfix.flow.diagnosis import command_of

        remedy = command_of(inputs, view.name, gnss=gnss, gcps=gcps, lens=lens)
    level = None
    if surface is not None and not (isinstance(surface, WaterDimension) and heights is None):
        at = cameras.centres if heights is None else xyz
        known = surface_above(surface, at, heights).height_m
        level = float(np.nanmean(known)) if np.isfinite(known).any() else None
    above = None if level is None else cameras.centres[:, 2] - level
    report = CamerasReport(
        str(path), cameras.source, cameras,
        read.crs, cameras.crs, _sensors(cameras, above),
        None if above is None else (float(above.min()), float(above.mean()), float(above.max())),
        None if problem else _tilt_deg(cameras), _gnss(cameras, str(path)),
        None if cloud is None else _fit(cameras, str(cloud), xyz, crs), xyz, level, problem,
        diagnosis, remedy,
    )  # fmt: skip
    if plot is not None:
        from pcfix.report.cameras import block_figure
        from pcfix.report.figures import png_of

        write_bytes(plot, png_of(block_figure(report)), overwrite=overwrite)
    return report


def _check_enough(
    cloud: AnyPath | None, water: AnyPath | float | None,
    gcps: AnyPath | None, lens: AnyPath | None, reference: AnyPath | None,
) -> None:  # fmt: skip
    """Refuse evidence on the refraction without the cloud and the water that it is about."""
    for name, value in (("gcps", gcps), ("lens", lens), ("reference", reference)):
        if value is not None and (cloud is None or water is None):
            raise SettingError(
                f"{name} {value}: tells whether the poses have absorbed the refraction; give cloud"
                " and water too."
            )


def _diagnosis(
    inputs: Inputs, cameras: Cameras, view: CloudView, water: WaterSurface,
    refractive_index: float, gcps: AnyPath | None, lens: AnyPath | None,
    reference: AnyPath | None,
) -> Diagnosis:  # fmt: skip
    """Look for all signs that the poses have absorbed the refraction."""
    from pcfix.adjust.evidence import Evidence
    from pcfix.flow.diagnosis import diagnose, focal_length_of, given_focal_lengths, ties_of
    from pcfix.io.clouds import check_same_crs, read_reference
    from pcfix.io.ground_control import read_ground_control

    path = str(inputs.cameras)
    survey = None if reference is None else read_reference(reference)
    if survey is not None:
        crs = None if isinstance(view.crs, str) else view.crs
        check_same_crs(view.name, crs, survey.name, survey.crs)
    control = None if gcps is None else read_ground_control(gcps, cameras)
    focal = given_focal_lengths(path) if lens is None else focal_length_of(lens)
    ties = ties_of(inputs, view.crs)
    return diagnose(
        Evidence(
            cameras, path, water, refractive_index,
            ties=ties, view=view, control=control, calibrated=focal, reference=survey,
        )
    )  # fmt: skip


def _without_cloud(inputs: Inputs, read: Cameras) -> tuple[Cameras, str]:
    """Return the cameras where their software delivers clouds, or as read and why not there."""
    try:
        return inputs.block(None, read)[0], ""
    except InputError as error:
        return read, str(error)


def _sample(source: LasSource, dimension: str | None) -> tuple[FloatArray, FloatArray | None]:
    """Return points evenly spread over the file, and their water heights where asked for."""
    every = max(1, len(source) // SAMPLE_POINTS)
    parts, heights = [], []
    for points in source.chunks(CHUNK_POINTS):
        parts.append(coordinates(points)[::every])
        if dimension is not None:
            heights.append(source.dimension(points, dimension)[::every])
    return np.vstack(parts), np.concatenate(heights) if heights else None


def _sensors(cameras: Cameras, above_m: FloatArray | None) -> tuple[Sensor, ...]:
    if cameras.lenses is None:
        return ()
    groups: dict[Lens, list[int]] = {}
    for row, lens in enumerate(cameras.lenses):
        groups.setdefault(lens, []).append(row)
    if len(groups) > 0.5 * len(cameras):  # each image has a calibration of its own
        groups = _by_frame(groups)
    return tuple(_sensor(lens, rows, above_m) for lens, rows in groups.items())


def _by_frame(groups: dict[Lens, list[int]]) -> dict[Lens, list[int]]:
    """Put together lenses of one sensor and frame, under the first of them."""
    first: dict[tuple[Any, ...], Lens] = {}
    merged: dict[Lens, list[int]] = {}
    for lens, rows in groups.items():
        leader = first.setdefault((lens.sensor, lens.width, lens.height, lens.projection), lens)
        merged.setdefault(leader, []).extend(rows)
    return merged


def _sensor(lens: Lens, rows: list[int], above_m: FloatArray | None) -> Sensor:
    pixel = lens.pixel_size_mm
    focal_px = lens.focal if lens.unit == "px" else None if pixel is None else lens.focal / pixel
    distorted = any((*lens.radial, *lens.denominator, *lens.tangential, *lens.thin_prism))
    return Sensor(
        name=lens.sensor,
        images=len(rows),
        width=lens.width,
        height=lens.height,
        focal=lens.focal,
        unit=lens.unit,
        focal_mm=lens.focal if lens.unit == "mm" else None if pixel is None else lens.focal * pixel,
        pixel_size_um=None if pixel is None else 1000.0 * pixel,
        projection=lens.projection,
        distorted=distorted,
        gsd_m=None
        if above_m is None or focal_px is None
        else float(np.mean(above_m[rows])) / focal_px,
    )


def _tilt_deg(cameras: Cameras) -> tuple[float, float] | None:
    if cameras.rotations is None:
        return None
    tilt = np.degrees(np.arccos(np.clip(-cameras.rotations[:, 2, 2], -1.0, 1.0)))
    return float(np.median(tilt)), float(tilt.max())


def _gnss(cameras: Cameras, name: str) -> GnssResiduals | None:
    if cameras.gnss is None:
        return None
    found = adjusted_minus_gnss(cameras, name)
    rows = np.flatnonzero(np.isfinite(found.enu_m[:, 0]))
    if len(rows) == 0:
        return GnssResiduals(0, (None,) * 3, (None,) * 3, 0.0, "", found.reason)
    enu = found.enu_m[rows]
    length = np.sqrt(np.nansum(enu * enu, axis=1))
    worst = int(np.argmax(length))

    def plain(values: FloatArray) -> tuple[float | None, ...]:
        return tuple(float(v) if np.isfinite(v) else None for v in values)

    return GnssResiduals(
        len(rows), plain(enu.mean(axis=0)), plain(enu.std(axis=0)), float(length[worst]),
        cameras.labels[rows[worst]], found.reason,
    )  # fmt: skip


def _fit(cameras: Cameras, cloud: str, xyz: FloatArray, crs: Any) -> Fit:
    seen = cameras_in_sight(xyz, cameras)
    shares = {str(k): float(np.mean(seen == k)) for k in (0, 1, 2)}
    shares["3 or more"] = float(np.mean(seen >= 3))
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    block_low, block_high = cameras.centres.min(axis=0), cameras.centres.max(axis=0)
    apart = np.maximum(np.maximum(low - block_high, block_low - high), 0.0)[:2]
    below = _below_ground(cameras.centres, xyz)
    verdict = likely_mistake(cameras.centres, low, high, crs) or ""
    if not verdict and below:
        verdict = (
            f"{below} of {len(cameras)} cameras stand below the ground: heights of cameras and"
            " cloud have different datums, or the axes are swapped."
        )
    twice = float(np.mean(seen >= 2))
    if not verdict and twice < LEAST_SEEN_TWICE:
        verdict = (
            f"only {100 * twice:.0f} % of the points lie in the frames of two"
            " cameras or more, although the block is over the cloud: check the convention of the"
            " angles and the interior orientation."
        )
    return Fit(cloud, len(xyz), shares, float(np.hypot(*apart)), below, verdict)


def _below_ground(centres: FloatArray, xyz: FloatArray) -> int:
    """Count cameras that are lower than the nearest point of the cloud in plan."""
    from scipy.spatial import cKDTree

    reach = float(np.hypot(*np.ptp(xyz[:, :2], axis=0))) * 0.1 + 1.0
    distance, row = cKDTree(xyz[:, :2]).query(centres[:, :2])
    return int(np.count_nonzero((distance < reach) & (centres[:, 2] <= xyz[row, 2])))
