"""The report of ``pcfix cameras`` on a block of cameras: its data, its summary, and a picture."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.adjust.diagnosis import Diagnosis, export_of
from pcfix.lens.frames import footprint
from pcfix.model import Cameras, FloatArray
from pcfix.report.page import AFTER, WATER, draw_cloud, label_plan, label_side, new_figure
from pcfix.report.text import aligned

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_FOOTPRINTS = 400
SHORT_CRS, SHOWN_NAMES = 60, 5


@dataclass(frozen=True)
class Sensor:
    """The images of one interior orientation, or of several alike; None where not stated."""

    name: str
    images: int
    width: float
    height: float
    focal: float  # the shortest of them
    unit: str
    focal_mm: float | None
    pixel_size_um: float | None
    projection: str
    distorted: bool
    gsd_m: float | None
    lenses: int = 1  # that differ
    focal_most: float | None = None
    frames: int = 1  # sizes that differ
    folded: float = 0.0  # share of the frame beyond the fold of the distortion
    nominal: bool = False  # not calibrated, though others of the block are


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
    """How well cameras and cloud match."""

    cloud: str
    points_sampled: int
    seen_by: dict[str, float]  # share of the points that 0, 1, 2, 3 or more frames hold
    distance_m: float  # in plan, between the boxes around block and cloud
    below_ground: int  # cameras lower than the cloud's highest point within their reach in plan
    verdict: str  # what is likely wrong; empty where they match
    tested: str = "not checked"  # what was tested, and what was not

    @property
    def fits(self) -> bool:
        """Whether nothing looks wrong."""
        return not self.verdict


@dataclass(frozen=True, eq=False)
class CamerasReport:
    """The report of ``pcfix cameras``."""

    path: str
    cameras: Cameras  # in the cloud's CRS, where there is a cloud
    crs_read: str | None  # of the file
    sensors: tuple[Sensor, ...]
    height_above_water_m: tuple[float, float, float] | None  # least, mean, largest
    tilt_deg: tuple[float, float] | None  # of the optical axes from nadir: median, largest
    gnss: GnssResiduals | None
    fit: Fit | None
    sample_xyz: FloatArray  # points of the cloud, shape (m, 3), for a picture
    level_m: float | None  # mean height of the water
    problem: str = ""  # why the cameras are not in a map and have no heights
    diagnosis: Diagnosis | None = None  # whether the poses have absorbed the refraction
    remedy: tuple[str, str] = ("", "")  # the command that corrects the poses, and a remark

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


def cameras_text(r: CamerasReport) -> str:
    """Return the summary of a camera file."""
    cameras, missing = r.cameras, r.cameras.unposed
    images = f"{len(cameras):,} with a pose"
    if missing:
        more = ", ..." if len(missing) > SHOWN_NAMES else ""
        images += f", {len(missing):,} without: {', '.join(missing[:SHOWN_NAMES])}{more}"
    rows = [("Images", images), *(row for one in r.sensors for row in sensor_rows(one))]
    if not r.sensors:
        rows.append(("Sensor", "none: the frames are not known"))
    if cameras.rotations is None:
        rows.append(("Angles", "none: every camera counts as visible from every point"))
    rows.append(("CRS", _short(r.crs_read) or "not stated"))
    if cameras.crs != r.crs_read:
        rows.append(("CRS of cloud", _short(cameras.crs) or "not stated"))
    if r.problem:
        rows.append(("Problem", r.problem))
    else:
        z = cameras.centres[:, 2]
        rows.append(("Heights", f"{z.min():.2f} to {z.max():.2f} m, mean {z.mean():.2f} m"))
    if r.height_above_water_m is not None:
        low, mean, high = r.height_above_water_m
        rows.append(("Above water", f"{low:.1f} to {high:.1f} m, mean {mean:.1f} m"))
    if r.tilt_deg is not None:
        rows.append(("Tilt", "median {:.1f} deg, largest {:.1f} deg".format(*r.tilt_deg)))
    if (g := r.gnss) is not None:
        means, deviations = (
            ", ".join("-" if v is None else f"{v:{sign}.3f}" for v in values)
            for values, sign in ((g.mean_m, "+"), (g.sd_m, ""))
        )
        words = (
            f"{g.images:,} images; adjusted minus GNSS east, north, up: mean {means} m, sd"
            f" {deviations} m;"
            f" largest {g.largest_m:.3f} m ({g.largest_image})"
        )
        rows += [("GNSS", words)] if g.images else []
        rows += [("" if g.images else "GNSS", g.reason)] if g.reason or not g.images else []
    if (fit := r.fit) is not None:
        seen = ", ".join(f"{name}: {100.0 * part:.1f} %" for name, part in fit.seen_by.items())
        rows += [
            ("Cloud", f"{fit.cloud} ({fit.points_sampled:,} points sampled)"),
            ("Visible", f"share of points by number of cameras: {seen}"),
        ]
        if fit.distance_m > 0.0:
            rows.append(("Distance", f"{fit.distance_m:,.1f} m in plan between block and cloud"))
        if fit.below_ground:
            rows.append(("Below ground", f"{fit.below_ground} cameras"))
        rows.append(("Check", fit.verdict or fit.tested))
    if (found := r.diagnosis) is not None:
        says = {True: "absorbed", False: "not absorbed", None: "open"}
        if found.absorbed:
            verdict = found.sentence(*r.remedy)
        elif found.absorbed is False and found.decided_by is not None:
            verdict = f"the poses have not absorbed the refraction, by {found.decided_by.name}"
        else:
            verdict = f"not known; give control points (--gcps), or {export_of(cameras)}"
        rows.append(("Refraction", verdict))
        rows += [("", f"{s.name}: {says[s.speaks]}. {s.words}") for s in found.signs]
    return aligned(f"{r.path}: {cameras.source or 'cameras'}", rows, cameras.notes)


def sensor_rows(s: Sensor) -> list[tuple[str, str]]:
    """Return frame, focal length and pixel size of a sensor, and what is wrong with its lens."""
    low, high = f"{s.focal:.6g}", f"{s.focal_most or s.focal:.6g}"
    size = f"{s.width:g} x {s.height:g} {s.unit}"
    parts = [
        f"{s.images:,} images" + (f" with {s.lenses:,} different lenses" if s.lenses > 1 else ""),
        f"{s.frames} sizes as {size}" if s.frames > 1 else size,
        f"focal length {low if low == high else f'{low} to {high}'} {s.unit}",
    ]
    if s.pixel_size_um is not None and s.focal_mm is not None:
        parts[-1] += "" if s.lenses > 1 else f" = {s.focal_mm:.3f} mm"
        parts.append(f"pixel {s.pixel_size_um:.2f} um")
    parts += [s.projection, *(["distorted"] if s.distorted else [])]
    parts += [] if s.gsd_m is None else [f"GSD {100.0 * s.gsd_m:.2f} cm at the water"]
    rows = [("Sensor", f"{s.name or 'unnamed'}: {', '.join(parts)}")]
    if s.folded:
        rows.append(("", f"the distortion folds within the frame: {100.0 * s.folded:.2g} % of it is"
                     " not used; check the radial coefficients"))  # fmt: skip
    if s.nominal:
        rows.append(("", "not calibrated, unlike the others; its images likely had no tie points,"
                     " so do not trust their poses"))  # fmt: skip
    return rows


def _short(crs: str | None) -> str:
    """Return the name of a CRS, whose text may be pages long."""
    if crs is None or len(crs) < SHORT_CRS:
        return crs or ""
    return crs.split('"')[1] if '"' in crs else crs[:SHORT_CRS] + " ..."


def draw_footprints(plan: Axes, cameras: Cameras, level_m: float, **look: Any) -> bool:
    """Draw footprints on a level, of at most `MOST_FOOTPRINTS` images; return whether any exist."""
    is_drawn = False
    for row in range(0, len(cameras), max(1, len(cameras) // MOST_FOOTPRINTS)):
        border = footprint(cameras, row, level_m)
        if len(border) and np.isfinite(border).all():
            plan.plot(*np.vstack([border, border[:1]]).T, color=WATER, **look)
            is_drawn = True
    return is_drawn


def block_figure(report: CamerasReport) -> Figure:
    """Draw the block in plan, with the footprints of its frames, and from the south."""
    cameras, xyz = report.cameras, report.sample_xyz
    figure, (plan, side) = new_figure(8.0, 8.5, nrows=2, height_ratios=[5, 2])
    level = report.level_m  # of the footprints: the water, or else the middle of the cloud
    if level is None:
        level = float(np.median(xyz[:, 2])) if len(xyz) else np.nan
    shown = draw_cloud(figure, plan, xyz, report.level_m, label="cloud")
    if len(shown):
        side.plot(shown[:, 0], shown[:, 2], ".", color="0.6", markersize=1, label="cloud")
    has_footprints = draw_footprints(plan, cameras, level, linewidth=0.6, alpha=0.6)
    plan.plot(*cameras.centres[:, :2].T, "^", color=AFTER, markersize=4, label="cameras")
    if has_footprints:
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
