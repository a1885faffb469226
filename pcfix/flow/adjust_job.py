"""One adjustment: its inputs read and checked, and by which observations it goes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from pcfix.adjust.block import Unknowns
from pcfix.adjust.control_fit import check_control, check_marks
from pcfix.adjust.gather import (
    FIRST_SIGMA_PX,
    Datum,
    block_of,
    check_surface,
    no_datum,
    restricted,
    some_cameras,
    ties_of_cloud,
    usable_ties,
    well_seen,
    with_places,
)
from pcfix.adjust.mend import Candidate, mend
from pcfix.adjust.rounds import Rounds, adjust_ties, check_datum, default_lens
from pcfix.adjust.separability import strong_correlations, undetermined
from pcfix.adjust.state import CODES
from pcfix.errors import GeometryError, InputError, SettingError
from pcfix.flow.inputs import mask_of
from pcfix.io.cameras.table.sensor import read_sensor
from pcfix.io.crs import is_topocentric
from pcfix.io.files import check_input
from pcfix.io.gnss_positions import gnss_in_frame_of, read_gnss
from pcfix.io.ground_control import read_ground_control
from pcfix.io.views import ViewMatch
from pcfix.model import GroundControl, Views
from pcfix.refract.choice import views_in_frame
from pcfix.water.index import index_of
from pcfix.water.surface import surface_above

if TYPE_CHECKING:
    from collections.abc import Callable
    from os import PathLike

    from pcfix.adjust.block import Block
    from pcfix.adjust.result import Adjusted
    from pcfix.adjust.solve import LogRow
    from pcfix.flow.inputs import Inputs
    from pcfix.flow.surfaces import CloudView
    from pcfix.model import BoolArray, Cameras, FloatArray, IntArray, TiePoints

    AnyPath = str | PathLike[str]

Ties = Literal["auto", "measured", "cloud"]
WATER_UNKNOWNS = ("level", "tilt", "index")
CLOUD_POINTS = 6000
"""Points of the cloud that stand for tie points."""

LEAST_TIES = 100
LEAST_GNSS_SIGMA_M = 0.02
FAR_OFF_M = 1.0
"""Mean distance of GNSS positions from the projection centres that no adjustment leaves, where it
is also `FAR_OFF_SIGMAS` standard deviations: another datum."""

FAR_OFF_SIGMAS = 10.0
SMALL_WATER = 10
"""Tie points on one side of the surface, at least, so that both sides count as observed."""


@dataclass(frozen=True)
class AdjustSettings:
    """How a block is adjusted.

    Attributes
    ----------
    refractive_index : float or str
        See `pcfix.correct_file`.
    free : tuple of {"level", "tilt", "index"}
        What of the water moves freely.
    level_sigma_m, tilt_sigma_deg, index_sigma : float or None
        Standard deviations of what moves about its given value.
    lens_unknowns : tuple of str or None
        Lens parameters that move; None: those that the block determines, or none where a
        calibration is given.
    poses : {"free", "fixed", "similarity"}
    fixed_images : tuple of str
    free_network : bool
        See `pcfix.adjust.block.Unknowns`.
    ties : {"auto", "measured", "cloud"}
        Which observations count: the tie points of the model, or points of the cloud.
    gnss_sigma_m : float or None
        Of GNSS positions whose source states none; None: from how they fit.
    sigma_px : float or None
        Of measured tie points; None: from their residuals.
    outliers : bool
    """

    refractive_index: float | str = 1.34
    free: tuple[str, ...] = ()
    level_sigma_m: float | None = None
    tilt_sigma_deg: float | None = None
    index_sigma: float | None = None
    lens_unknowns: tuple[str, ...] | None = None
    poses: Literal["free", "fixed", "similarity"] = "free"
    fixed_images: tuple[str, ...] = ()
    free_network: bool = False
    ties: Ties = "auto"
    gnss_sigma_m: float | None = None
    sigma_px: float | None = None
    outliers: bool = True

    def __post_init__(self) -> None:
        """Check the values."""
        for name in self.free:
            if name not in WATER_UNKNOWNS:
                raise SettingError(f"free '{name}' must be among {', '.join(WATER_UNKNOWNS)}.")
        for name in self.lens_unknowns or ():
            if name not in CODES:
                raise SettingError(
                    f"lens parameter '{name}' must be among {', '.join(CODES)}, or none."
                )
        given = (
            self.level_sigma_m, self.tilt_sigma_deg, self.index_sigma, self.gnss_sigma_m,
            self.sigma_px,
        )  # fmt: skip
        for value in given:
            if value is not None and not 0.0 < value < np.inf:
                raise SettingError(f"the standard deviation {value:g} must be positive.")

    def unknowns(self, lens: tuple[str, ...]) -> Unknowns:
        """Return what moves, with these lens parameters."""
        tilt = (
            None if self.tilt_sigma_deg is None else float(np.tan(np.radians(self.tilt_sigma_deg)))
        )
        sigma = {"level": self.level_sigma_m, "tilt": tilt, "index": self.index_sigma}
        water = {
            name: (np.inf if value is None else value) if name in self.free or value else 0.0
            for name, value in sigma.items()
        }
        return Unknowns(
            poses=self.poses,
            fixed_images=self.fixed_images,
            lens=lens,
            level_sigma_m=water["level"],
            tilt_sigma=water["tilt"],
            index_sigma=water["index"],
            free_network=self.free_network,
        )


class Survey(NamedTuple):
    """What was measured besides the images; see `pcfix.adjust_cameras`."""

    gcps: AnyPath | GroundControl | None = None
    gnss: AnyPath | None = None
    lens: AnyPath | None = None
    gcps_crs: str | None = None
    gnss_crs: str | None = None


class AdjustJob:
    """The inputs of one adjustment, read."""

    def __init__(
        self,
        inputs: Inputs,
        how: AdjustSettings,
        view: CloudView | None,
        survey: Survey,
    ) -> None:
        """Read the inputs.

        Raises
        ------
        PcfixError
            If one cannot be read, or does not fit.
        """
        self.inputs, self.how, self.view = inputs, how, view
        self.name = str(inputs.cameras) if isinstance(inputs.cameras, str | Path) else "cameras"
        read = inputs.read()
        self.crs = crs = _own_crs(read) if view is None else view.crs
        self.old, self.list = inputs.block(crs, read)
        if self.old.rotations is None or self.old.lenses is None:
            raise InputError(
                f"{self.name}: an adjustment needs angles and a lens of every image; give the"
                " project or model of the software, or --sensor."
            )
        self.water = None if inputs.water is None else inputs.surface(view).surface
        check_surface(self.water)
        self._check_images()
        self.n = index_of(how.refractive_index)[0]
        self.notes: list[str] = []
        self.no_gnss = ""
        self.gnss = self._datum(survey.gnss, survey.gnss_crs)
        self.control_name = "gcps" if isinstance(survey.gcps, GroundControl) else str(survey.gcps)
        self.control = self._control(survey.gcps, survey.gcps_crs)
        self.calibrated = None if survey.lens is None else read_sensor(check_input(survey.lens))
        self.start = self._start()
        self.mask = None
        if inputs.water_mask is not None:
            low, high = self.old.centres.min(axis=0), self.old.centres.max(axis=0)
            if view is not None:
                low, high = view.low, view.high
            self.mask = mask_of(inputs.water_mask, crs or self.old.crs, low[:2], high[:2])

    def _check_images(self) -> None:
        """Check that the images named are there, and that the cameras are above the water."""
        missing = [name for name in self.how.fixed_images if name not in self.old.labels]
        if missing:
            raise SettingError(
                f"fixed image {missing[0]} is not in the model, which has {len(self.old)} images,"
                f" the first {self.old.labels[0]}."
            )
        if self.water is None:
            return
        level = surface_above(self.water, self.old.centres).height_m
        wet = np.flatnonzero(level > self.old.centres[:, 2])
        if len(wet):
            i = int(wet[0])
            raise GeometryError(
                f"{self.name}: {len(wet)} of {len(self.old)} cameras are under the water, the"
                f" first {self.old.labels[i]} at {self.old.centres[i, 2]:.2f} m; check the water"
                " level, its CRS and that of the cameras; for images taken under water give --port."
            )

    def _control(
        self, gcps: AnyPath | GroundControl | None, crs: str | None
    ) -> GroundControl | None:
        if gcps is None:
            return None
        if not isinstance(gcps, GroundControl):
            gcps = read_ground_control(gcps, self.old, crs=crs)
        if self.water is not None:
            is_placed = bool(np.isfinite(self.gnss.xyz).any())
            check_marks(gcps, self.old, self.control_name, is_placed=is_placed)
        return gcps

    def _datum(self, path: AnyPath | None, crs: str | None) -> Datum:
        """Return GNSS positions in the block's frame, with standard deviations."""
        cameras = self.old if path is None else read_gnss(path, self.old, crs=crs)
        if cameras.gnss is None:
            return no_datum(len(cameras))
        name = self.name if path is None else str(path)
        try:
            found = gnss_in_frame_of(cameras, name)
        except (InputError, GeometryError, SettingError) as error:
            if path is not None:
                raise
            self.notes.append(f"{error} The GNSS positions are left out.")
            return no_datum(len(cameras))
        if found.reason:
            self.no_gnss = found.reason
            self.notes.append(found.reason)
        known = np.isfinite(found.xyz)
        if not known.any():
            return no_datum(len(cameras))
        sigma = np.where(known, found.sigma_m, np.inf)
        silent = known & ~np.isfinite(found.sigma_m)
        off = np.where(known, self.old.centres - found.xyz, np.nan)
        if silent.any():
            sigma[silent] = self._sigma_from(off)
        _check_datum_offset(off, sigma, name)
        return Datum(found.xyz, sigma)

    def _sigma_from(self, off: FloatArray) -> float:
        if self.how.gnss_sigma_m is not None:
            return self.how.gnss_sigma_m
        rest = off - np.nanmedian(off, axis=0)
        sigma = max(1.4826 * float(np.nanmedian(np.abs(rest))), LEAST_GNSS_SIGMA_M)
        self.notes.append(
            f"the GNSS positions come without standard deviations; {sigma:.2f} m is taken, as they"
            " lie about the projection centres; --gnss-sigma says it yourself."
        )
        return sigma

    def _start(self) -> Cameras:
        """Return the cameras with the calibration that was given."""
        if self.calibrated is None:
            return self.old
        for old in set(self.old.lenses or ()):
            one = self.calibrated
            if (old.width, old.height, old.unit) != (one.width, one.height, one.unit):
                raise InputError(
                    f"the calibration is of images of {one.width:g} x {one.height:g} {one.unit},"
                    f" the model has {old.width:g} x {old.height:g} {old.unit}; give that of these"
                    " images."
                )
        return replace(self.old, lenses=(self.calibrated,) * len(self.old))

    def adjusted(self, progress: Callable[[LogRow], None] | None) -> Adjusted:
        """Adjust by tie points where there are enough, else by the cloud."""
        ties = None if self.how.ties == "cloud" else self._tie_points()
        if ties is not None and len(ties.xyz) >= LEAST_TIES:
            found = self._by_ties(ties, progress)
        elif self.how.ties == "measured":
            count = 0 if ties is None else len(ties.xyz)
            raise InputError(
                f"{self.name}: has {count} usable tie points, {LEAST_TIES} are needed: {_EXPORTS}"
            )
        elif self.view is None:
            raise InputError(
                f"{self.name}: has no tie points, and there is no cloud: give --cloud with the"
                f" cloud that these cameras made, or a model with tie points: {_EXPORTS}"
            )
        else:
            found = self._by_cloud(progress)
        if self.control is not None:
            check_control(found, self.control_name)
        return replace(found, notes=[*self.notes, *found.notes])

    def _tie_points(self) -> TiePoints | None:
        found = self.inputs.tie_points(self.crs, placed=False)
        return None if found is None else usable_ties(with_places(found, self.old), self.old)

    @property
    def _level_sigma_m(self) -> float:
        return self.how.unknowns(()).level_sigma_m

    def _allowed(self, xyz: FloatArray) -> BoolArray | None:
        return None if self.mask is None else self.mask.inside(xyz[:, 0], xyz[:, 1])

    def _by_ties(self, ties: TiePoints, progress: Callable[[LogRow], None] | None) -> Adjusted:
        how = self.how
        block = block_of(
            self.start, ties, how.sigma_px or FIRST_SIGMA_PX, self.water, self.n, self.gnss,
            self.control, self._allowed(ties.xyz), self.inputs.port, self._level_sigma_m,
        )  # fmt: skip
        lens = how.lens_unknowns
        if lens is None:
            lens = () if self.calibrated is not None else default_lens(self.start.lenses or ())
        unknowns = how.unknowns(lens)
        check_datum(block, unknowns, self.no_gnss)
        self._check_wet(block.xyz[: len(ties.xyz)])
        block = restricted(block, self._kept(block))
        rounds = Rounds(how.sigma_px, how.outliers, how.lens_unknowns is None)
        found = adjust_ties(block, unknowns, rounds, progress)
        self._check_dry(found)
        if found.precision is None:
            return found
        more = [*undetermined(found.precision, unknowns), *strong_correlations(found.precision)]
        return replace(found, notes=[*found.notes, *more])

    def _check_wet(self, xyz: FloatArray) -> None:
        """Check that there is water over some points."""
        if self.water is None:
            return
        below = int((surface_above(self.water, xyz).height_m > xyz[:, 2]).sum())
        if below < SMALL_WATER:
            raise GeometryError(
                f"only {below} of {len(xyz):,} points lie below the water, so there is no"
                " refraction to adjust: check the water level against the model's heights, or use"
                " an ordinary bundle adjustment."
            )

    def _check_dry(self, found: Adjusted) -> None:
        """Check that land tells what of the water moved; an absorbed block may have sunk it."""
        if self.water is None:
            return
        seen = np.zeros(len(found.xyz), np.bool_)
        seen[found.block.owner[found.used]] = True
        above = int((seen & ~found.is_wet).sum())
        if above >= SMALL_WATER:
            return
        said = f"only {above} of {int(seen.sum()):,} points lie above the water"
        if any(found.unknowns.water_sigma):
            raise GeometryError(
                f"{said}: level, tilt and index cannot be told from the height of the block then;"
                " leave the water fixed."
            )
        self.notes.append(
            f"{said}: nothing but GNSS and control points ties the heights of the bed."
        )

    def _kept(self, block: Block) -> IntArray:
        """Return rows of the images that can be adjusted, and say which cannot."""
        kept = well_seen(block)
        if len(kept) < 2:
            raise GeometryError(
                f"{self.name}: {len(kept)} of {len(block.cameras)} images have observations enough"
                " for a pose; two at least are needed."
            )
        if len(kept) < len(block.cameras):
            lost = sorted(set(range(len(block.cameras))) - set(kept.tolist()))
            self.notes.append(
                f"{len(lost)} of {len(block.cameras)} images have too few observations for a pose"
                f" and are left out; the first is {block.cameras.labels[lost[0]]}."
            )
        return kept

    def _by_cloud(self, progress: Callable[[LogRow], None] | None) -> Adjusted:
        xyz, listed = self._sample()
        candidates = []
        guesses = {"all images in frame": views_in_frame(xyz, self.old)}
        if listed is not None:
            guesses["the images of the view list"] = listed
        for name, views in guesses.items():
            ties = ties_of_cloud(xyz, views, self.old)
            if len(ties.xyz) < LEAST_TIES:
                continue
            block = block_of(
                self.start, ties, FIRST_SIGMA_PX, self.water, self.n, self.gnss, self.control,
                self._allowed(ties.xyz), self.inputs.port, self._level_sigma_m,
            )  # fmt: skip
            check_datum(block, self.how.unknowns(()), self.no_gnss)
            apparent = ties.xyz
            if self.control is not None:
                apparent = np.vstack([apparent, self.control.xyz])
            kept = well_seen(block) if len(guesses) > 1 else self._kept(block)
            if len(kept) < 2:
                continue
            old = some_cameras(self.old, kept)
            candidates.append(Candidate(name, restricted(block, kept), old, apparent))
        if not candidates:
            raise GeometryError(
                f"{self.name}: the images do not see the cloud; check the poses with 'pcfix cameras"
                " --cloud'."
            )
        self._check_wet(candidates[0].block.xyz)
        if self.how.lens_unknowns is not None:
            sets: tuple[tuple[str, ...], ...] = (self.how.lens_unknowns,)
        elif self.calibrated is not None:
            sets = ((),)
        else:
            sets = tuple(
                dict.fromkeys([("f",), ("f", "cx", "cy"), default_lens(self.old.lenses or ())])
            )
        found = mend(candidates, self.how.unknowns(sets[0]), sets, progress)
        self._check_dry(found)
        return found

    def _sample(self) -> tuple[FloatArray, Views | None]:
        """Return points evenly drawn from the cloud, and their lists where there is one."""
        view = self.view
        if view is None:
            raise InputError("a cloud is needed.")
        rows = np.sort(
            np.random.default_rng(0).choice(
                view.points, min(CLOUD_POINTS, view.points), replace=False
            )
        )
        match = None
        if self.list is not None:
            match = ViewMatch(self.list, self.old, points=view.points)
        xyz, parts, first = [], [], 0
        for seen in view.chunks():
            mine = rows[(rows >= first) & (rows < first + len(seen.xyz))] - first
            xyz.append(seen.xyz[mine])
            if match is not None:
                parts.append(match.for_chunk(seen.xyz, first).take(mine))
            first += len(seen.xyz)
        if match is None:
            return np.vstack(xyz), None
        counts = np.concatenate([np.diff(part.start) for part in parts])
        start = np.concatenate([[0], np.cumsum(counts)])
        return np.vstack(xyz), Views(start, np.concatenate([part.camera for part in parts]))


_EXPORTS = (
    "COLMAP's model with points3D, OpenSfM's reconstruction with tracks.csv, a Metashape project"
    " (.psx, .psz) or its BlocksExchange export with tie points, Pix4D's params folder with"
    " its tp_ file, or Bundler's .out have them."
)


def _own_crs(cameras: Cameras) -> str | None:
    """Return the CRS in which a model without a cloud is adjusted: its own, where it is one."""
    own = cameras.crs
    return None if own is None or is_topocentric(own) else own


def _check_datum_offset(off: FloatArray, sigma: FloatArray, name: str) -> None:
    """Refuse GNSS positions that lie off as a whole: another datum or CRS."""
    mean = np.nan_to_num(np.nanmean(off, axis=0)) if np.isfinite(off).any() else np.zeros(3)
    typical = np.median(sigma[np.isfinite(sigma)]) if np.isfinite(sigma).any() else 0.0
    if np.abs(mean).max() > max(FAR_OFF_M, FAR_OFF_SIGMAS * float(typical)):
        x, y, z = (-mean).tolist()
        raise GeometryError(
            f"{name}: the GNSS positions lie {x:.2f}, {y:.2f}, {z:.2f} m (x, y, z) from the"
            " projection centres on average, which is another datum or CRS (heights above the"
            " ellipsoid?): name it with --gnss-crs, bring them into one, or align the model to them"
            " first."
        )
