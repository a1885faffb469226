"""What ``pcfix cameras`` says of a block of cameras: the figures, in words and as a picture."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.adjust.diagnosis import Diagnosis
from pcfix.adjust.evidence import export_of
from pcfix.lens.frames import footprint
from pcfix.model import Cameras, FloatArray
from pcfix.report.page import AFTER, WATER, draw_cloud, label_plan, label_side, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


MOST_FOOTPRINTS = 400


@dataclass(frozen=True)
class Sensor:
    """The images of one interior orientation, or of several alike; None where the file is silent.

    `focal` is the least and `focal_most` the greatest of its `lenses`, which have so many `frames`;
    `folded` is the share of the frame beyond the fold of the distortion. A `nominal` one was not
    calibrated, though others of the block were.
    """

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
    lenses: int = 1
    focal_most: float | None = None
    frames: int = 1
    folded: float = 0.0
    nominal: bool = False


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
    tested : str
        What they were tested with, and what not.
    """

    cloud: str
    points_sampled: int
    seen_by: dict[str, float]
    distance_m: float
    below_ground: int
    verdict: str
    tested: str = "not checked"

    @property
    def fits(self) -> bool:
        """Whether nothing looks wrong."""
        return not self.verdict


@dataclass(frozen=True, eq=False)
class CamerasReport:
    """What ``pcfix cameras`` says.

    Attributes
    ----------
    path : str
    cameras : Cameras
        In the cloud's CRS, where there is a cloud.
    crs_read : str or None
        Of the file.
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
    remedy : tuple of 2 str
        The command that mends them, and why it has what was not given.
    """

    path: str
    cameras: Cameras
    crs_read: str | None
    sensors: tuple[Sensor, ...]
    height_above_water_m: tuple[float, float, float] | None
    tilt_deg: tuple[float, float] | None
    gnss: GnssResiduals | None
    fit: Fit | None
    sample_xyz: FloatArray
    level_m: float | None
    problem: str = ""
    diagnosis: Diagnosis | None = None
    remedy: tuple[str, str] = ("", "")

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        cameras, fit = self.cameras, self.fit
        return {
            "path": self.path,
            "source": cameras.source,
            "images_posed": len(cameras),
            "images_unposed": list(cameras.unposed),
            "crs_read": self.crs_read,
            "crs": cameras.crs,
            "sensors": [asdict(sensor) for sensor in self.sensors],
            "height_above_water_m": self.height_above_water_m,
            "tilt_deg": self.tilt_deg,
            "problem": self.problem,
            "gnss": self.gnss and asdict(self.gnss),
            "fit": fit and {**asdict(fit), "fits": fit.fits},
            "refraction": self.diagnosis and self.diagnosis.as_dict(),
            "notes": [str(note) for note in cameras.notes],
        }


def cameras_text(report: CamerasReport) -> str:
    """Return what a person wants to know of a camera file."""
    r, cameras = report, report.cameras
    unposed = len(cameras.unposed)
    names = ", ".join(cameras.unposed[:5]) + (", ..." if unposed > 5 else "")
    lines = [
        f"{r.path}: {cameras.source or 'cameras'}",
        f"images       {len(cameras):,} with a pose"
        + (f", {unposed:,} without: {names}" if unposed else ""),
        *(_sensor(sensor) for sensor in r.sensors),
    ]
    if not r.sensors:
        lines.append("sensor       none: frames are not known")
    if cameras.rotations is None:
        lines.append("angles       none: every camera counts as seeing every point")
    lines.append(f"CRS          {_short(r.crs_read) or 'the file states none'}")
    if cameras.crs != r.crs_read:
        lines.append(f"  now        {_short(cameras.crs) or 'the cloud states none'}")
    if r.problem:
        lines.append(f"  problem    {r.problem}")
    else:
        z = cameras.centres[:, 2]
        lines.append(f"heights      {z.min():.2f} to {z.max():.2f} m, mean {z.mean():.2f} m")
    if r.height_above_water_m is not None:
        low, mean, high = r.height_above_water_m
        lines.append(f"over water   {low:.1f} to {high:.1f} m, mean {mean:.1f} m")
    if r.tilt_deg is not None:
        median, largest = r.tilt_deg
        lines.append(f"tilt         median {median:.1f}, largest {largest:.1f} degrees")
    if r.gnss is not None:
        lines += _gnss(r.gnss)
    lines += [f"note         {note}" for note in cameras.notes]
    return "\n".join([*lines, *_fit(r), *_refraction(r)])


def _sensor(s: Sensor) -> str:
    kind = s.projection + (", distorted" if s.distorted else "")
    low, high = f"{s.focal:.6g}", f"{s.focal_most or s.focal:.6g}"
    focal = f"{low} {s.unit}" if low == high else f"{low} to {high} {s.unit}"
    size = f"{s.width:g} x {s.height:g} {s.unit}"
    if s.frames > 1:
        size = f"{s.frames} sizes as {size}"
    size += f", focal length {focal}"
    if s.pixel_size_um is not None and s.focal_mm is not None:
        mm = "" if s.lenses > 1 else f" = {s.focal_mm:.3f} mm"
        size += f"{mm}, pixel {s.pixel_size_um:.2f} um"
    gsd = "" if s.gsd_m is None else f", GSD {100.0 * s.gsd_m:.2f} cm at the water"
    lenses = f" with {s.lenses:,} lenses that differ" if s.lenses > 1 else ""
    line = f"sensor       {s.name or 'unnamed'}: {s.images:,} images{lenses}, {size}, {kind}{gsd}"
    if s.folded:
        line += (
            f"\n  note       its distortion folds within the frame: {100.0 * s.folded:.2g} % of it"
            " has no direction, and points there count as not seen; see its radial coefficients"
        )
    if s.nominal:
        line += (
            "\n  note       not calibrated, unlike the others: no distortion, the principal point"
            " in the middle; its images likely had no tie points, so do not trust their poses"
        )
    return line


def _short(crs: str | None) -> str:
    """Return the name of a CRS, whose text may be pages long."""
    if crs is None or len(crs) < 60:
        return crs or ""
    return crs.split('"')[1] if '"' in crs else crs[:60] + " ..."


def _gnss(g: GnssResiduals) -> list[str]:
    if g.images == 0:
        return [f"GNSS         {g.reason}"]

    def three(values: tuple[float | None, ...]) -> str:
        return ", ".join("-" if v is None else f"{v:+.3f}" for v in values)

    lines = [
        f"GNSS         {g.images:,} images; adjusted minus GNSS east, north, up: mean"
        f" {three(g.mean_m)} m, sd {three(g.sd_m).replace('+', '')} m; largest {g.largest_m:.3f} m"
        f" ({g.largest_image})"
    ]
    return [*lines, f"  note       {g.reason}"] if g.reason else lines


def _fit(report: CamerasReport) -> list[str]:
    fit = report.fit
    if fit is None:
        return []
    seen = ", ".join(f"{name}: {100.0 * part:.1f} %" for name, part in fit.seen_by.items())
    lines = ["", f"{fit.cloud} ({fit.points_sampled:,} points looked at)", f"seen by      {seen}"]
    if fit.distance_m > 0.0:
        lines.append(f"apart        {fit.distance_m:,.1f} m in plan between block and cloud")
    if fit.below_ground:
        lines.append(f"below ground {fit.below_ground} cameras")
    return [*lines, f"fit          {fit.verdict or fit.tested}"]


def _refraction(report: CamerasReport) -> list[str]:
    """Say what each sign tells of absorbed refraction, and what they come to."""
    found = report.diagnosis
    if found is None:
        return []
    says = {True: "absorbed", False: "not absorbed", None: "open"}
    lines = ["", "Have the poses absorbed the refraction?"]
    lines += [f"{sign.name:<14} {says[sign.speaks] + ':':<13} {sign.words}" for sign in found.signs]
    if found.absorbed:
        return [*lines, f"{'verdict':<14} {found.sentence(*report.remedy)}"]
    if found.absorbed is False and found.decided_by is not None:
        return [*lines, f"{'verdict':<14} no, by {found.decided_by.name}"]
    needs = f"control points (--gcps) or a reference would tell, else {export_of(report.cameras)}"
    return [*lines, f"{'verdict':<14} not known; {needs}"]


def block_figure(report: CamerasReport) -> Figure:
    """Draw the block in plan, with the footprints of its frames, and from the south."""
    cameras, xyz = report.cameras, report.sample_xyz
    figure, (plan, side) = new_figure(8.0, 8.5, nrows=2, height_ratios=[5, 2])
    level = report.level_m  # where to draw footprints: at the water, else amid the cloud
    if level is None:
        level = float(np.median(xyz[:, 2])) if len(xyz) else np.nan
    shown = draw_cloud(figure, plan, xyz, report.level_m, label="cloud")
    if len(shown):
        side.plot(shown[:, 0], shown[:, 2], ".", color="0.6", markersize=1, label="cloud")
    rows = range(0, len(cameras), max(1, len(cameras) // MOST_FOOTPRINTS))
    borders = [footprint(cameras, row, level) for row in rows]
    borders = [border for border in borders if len(border) and np.isfinite(border).all()]
    for border in borders:
        plan.plot(*np.vstack([border, border[:1]]).T, color=WATER, linewidth=0.6, alpha=0.6)
    plan.plot(*cameras.centres[:, :2].T, "^", color=AFTER, markersize=4, label="cameras")
    if borders:
        plan.plot([], [], color=WATER, label=f"footprints at {level:.1f} m")
    side.plot(cameras.centres[:, 0], cameras.centres[:, 2], "^", color=AFTER, markersize=4)
    if report.level_m is not None:
        side.axhline(report.level_m, color=WATER, label="water")
    label_plan(plan, 20.0)
    label_side(side)
    side.tick_params(axis="x", labelrotation=20)
    plan.legend(loc="upper right")
    if side.get_legend_handles_labels()[0]:
        side.legend(loc="best")
    return figure
