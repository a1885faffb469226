"""Whether cameras, cloud and water belong together, by what of each does not come from the other.

A correction is plausible with almost any cameras and any level: these are the tests that tell, on
some points of the cloud, and what nothing tells of is named as not checked. None of it changes a
result.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from pcfix.errors import PcfixWarning
from pcfix.flow.recorded import Result, flying_heights, positions
from pcfix.flow.surfaces import Points
from pcfix.lens.frames import cameras_in_sight
from pcfix.lens.imaging import project
from pcfix.model import BoolArray, Cameras, FloatArray, TiePoints
from pcfix.options.declare import File
from pcfix.sums import Sums
from pcfix.water.search import Tilted

SAMPLE_POINTS, IN_FRAMES = 30_000, 4_000
"""Points that are looked at for a shoreline, and in the frames; evenly spread over the cloud."""
FAR_M = 50_000.0
"""No block is as wide; blocks may be many times as wide as one tile of their cloud."""
MOST_UNSEEN = 0.01
"""Share of a cloud that may lie in fewer than two frames: noise, and the borders of lenses."""
LEAST_STEPS, STEADY, MOST_TURN_DEG = 10, 0.9, 45.0
"""From image to image along flight lines; how much alike they must turn against the images."""
STEEP_COSINE = 0.9
"""Of the tilt of images that have a direction of their own in plan, about 25 degrees."""
MOST_MISS, MOST_HEIGHT = 0.01, 0.02
"""Tie points lie so near their image places (of the frame), and the cloud (of the flying height).
"""
TIES = 3_000
IN_LISTED_FRAMES = "listed points in the frames of their images"
SHIFTS, SHIFTED_POINTS = (0.1, 0.2, 0.4, 0.8), 500
"""Of the flying height, and the points of which it is asked whether they would be missed."""
MOST_PER_PIXEL, AROUND = 10.0, 8
"""Points that a cloud has for each pixel of an image; matchers make one at most, or a few."""


class Plausible(NamedTuple):
    """What was tested.

    fits : tests that cameras and cloud passed, in words; doubts : a sentence on each that they, or
    the water, did not; unchecked : what nothing tells of; noted : whether the cloud itself, by its
    steps, said besides that they may not fit.
    """

    fits: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    unchecked: tuple[str, ...] = ()
    noted: bool = False

    def warn(self) -> None:
        """Warn of every doubt."""
        for doubt in self.doubts:
            warnings.warn(doubt, PcfixWarning, stacklevel=3)

    def __str__(self) -> str:
        """Return a line that claims no more than was tested."""
        if self.doubts or self.noted:
            found = "in doubt, see the warnings" if self.doubts else "in doubt, see the notes"
        else:
            found = "cameras and cloud fit" if self.fits else "nothing was tested"
        tested = f"; tested: {', '.join(self.fits)}" if self.fits else ""
        return (
            found
            + tested
            + (f"; not checked: {', '.join(self.unchecked)}" if self.unchecked else "")
        )

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        lists = {name: list(getattr(self, name)) for name in ("fits", "doubts", "unchecked")}
        return {"words": str(self), **lists}


class CloudSample(Sums):
    """Points of a cloud, taken chunk by chunk from a row on, the same for any size of chunks."""

    added = ("_xyz", "_water", "_rgb")

    def __init__(self, points: int, first_row: int = 0) -> None:
        self._step, self._done = max(1, points // SAMPLE_POINTS), first_row
        self._xyz: list[FloatArray] = []
        self._water: list[FloatArray] = []
        self._rgb: list[FloatArray] = []

    def add(self, points: Points, water_m: FloatArray) -> None:
        """Add a chunk, and the water above each of its points."""
        rows = np.arange(-self._done % self._step, len(points.xyz), self._step)
        self._done += len(points.xyz)
        self._xyz.append(points.xyz[rows])
        self._water.append(water_m[rows])
        if points.colours is not None:
            self._rgb.append(np.column_stack([colour[rows] for colour in points.colours]))

    @property
    def every(self) -> float:
        """Of how many points of the cloud there is one here."""
        return float(self._step)

    @property
    def water_m(self) -> float | None:
        """The height of the water, in the median."""
        water = np.concatenate([np.zeros(0), *self._water])
        water = water[np.isfinite(water)]
        return float(np.median(water)) if len(water) else None

    @property
    def xyz(self) -> FloatArray:
        """The points, shape (n, 3)."""
        return np.vstack(self._xyz) if self._xyz else np.zeros((0, 3))

    def level_doubts(self) -> tuple[str, ...]:
        """Return a sentence where the cloud shows its shoreline at another height."""
        from pcfix.water.auto import LEAST_POINTS, find_elsewhere

        xyz, water = self.xyz, np.concatenate([np.zeros(0), *self._water])
        known = np.isfinite(water)
        if known.sum() < LEAST_POINTS:
            return ()
        rgb = np.vstack(self._rgb)[known] if self._rgb else None
        found, tilted = find_elsewhere(xyz[known], water[known], rgb)
        uneven = () if tilted is None else (_tilt_doubt(tilted),)
        if found is None:
            return uneven
        off, level = found.level_m, float(np.median(water[known])) + found.level_m
        side = "above" if off > 0.0 else "below"
        return (
            f"The cloud shows its shoreline {abs(off):.2f} m {side} the water"
            f" surface that was given, at about {level:.2f} m (standard error"
            f" {found.sigma_level_m:.2f} m: {'; '.join(found.reasons)}): check the water's height"
            " and its vertical datum, or see what --water auto finds.",
            *uneven,
        )


def _tilt_doubt(tilted: Tilted) -> str:
    return (
        f"The waterline of the cloud rises to the {tilted.to} against the water surface that was"
        f" given, by {100.0 * tilted.slope:.2g} %, from {tilted.low_m:+.2f} to"
        f" {tilted.high_m:+.2f} m of it: the water flows there, or one of the two is tilted;"
        " measure points on the waterline round the block, and give these as --water."
    )


class Flight(NamedTuple):
    """What is known of cameras besides.

    file : where they came from; water_m : the height of the water, in the median; listed : whether
    the images that a list names were found to hold their points, else it is refused; every : of how
    many points of the cloud there is one.
    """

    file: File = ""
    water_m: float | None = None
    listed: bool = False
    every: float = 1.0


def plausible(
    cameras: Cameras,
    cloud: FloatArray,
    ties: TiePoints | None = None,
    level_doubts: tuple[str, ...] = (),
    flight: Flight | None = None,
) -> Plausible:
    """Test cameras and cloud against each other.

    Parameters
    ----------
    cameras : Cameras
        In the cloud's frame, as the tie points.
    cloud : array, shape (n, 3)
        Points, metres, evenly spread over it.
    ties : TiePoints, optional
        Of these cameras.
    level_doubts : tuple of str
        See `CloudSample.level_doubts`.
    flight : Flight, optional
        What else is known of them.
    """
    if not len(cameras) or not len(cloud):
        return Plausible((), level_doubts)
    known = flight or Flight()
    xyz = np.ascontiguousarray(cloud[:: 1 + len(cloud) // IN_FRAMES])
    flown = flying_heights(cameras, known.file, known.water_m) if known.file else Result()
    heights = _heights(cameras, cloud, ties)
    if heights.unchecked and any(flown):
        heights = Result()
    results = [
        *(test(cameras, xyz) for test in (_far, _frames, _directions)),
        Result(IN_LISTED_FRAMES if known.listed and cameras.lenses else ""),
        *(positions(cameras, str(known.file)), heights, flown, _spacing(cameras, cloud, known)),
    ]
    fits, doubts, unchecked = (tuple(filter(None, words)) for words in zip(*results, strict=True))
    return Plausible(fits, (*level_doubts, *doubts), unchecked)


def _far(cameras: Cameras, xyz: FloatArray) -> Result:
    """Look for cameras of another place."""
    low, high, place = xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0), cameras.centres[:, :2]
    apart = np.hypot(*np.maximum(np.maximum(low - place, place - high), 0.0).T)
    far = np.flatnonzero(apart > FAR_M)
    if not len(far):
        return Result()
    last = far[np.argmax(apart[far])]
    return Result(
        doubt=f"{len(far)} of {len(cameras)} cameras stand more than {FAR_M / 1000.0:g} km from the"
        f" cloud, {cameras.labels[last]} {apart[last] / 1000.0:,.0f} km: they are of another place"
        " or coordinate system; mend them or take them out, as the others may be wrong too."
    )


def _frames(cameras: Cameras, xyz: FloatArray) -> Result:
    """Look whether two images or more hold each point, as two made it."""
    if cameras.lenses is None or cameras.rotations is None:
        return Result(unchecked="frames (the cameras have no lenses or no angles)")
    unseen = float(np.mean(cameras_in_sight(xyz, cameras) < 2))
    if unseen <= MOST_UNSEEN:
        seen = f"{100.0 * (1.0 - unseen):.4g} % of the points in two frames or more"
        shift_m = _shown_from_m(cameras, xyz)
        if shift_m is None:
            beyond = "a shift in plan (the frames reach far beyond the cloud)"
            return Result(seen, unchecked=beyond)
        return Result(f"{seen} (a shift in plan of {shift_m:.0f} m would show)")
    return Result(
        doubt=f"{100.0 * unseen:.1f} % of the points lie in fewer than two frames, although two"
        " images made each: the cameras may be shifted, turned or too low against the cloud, or"
        " some are missing; check their coordinates, heights, angles and interior orientation."
    )


def _shown_from_m(cameras: Cameras, xyz: FloatArray) -> float | None:
    """Return from which shift in plan on, whichever way, the test of frames would speak, if any."""
    some = np.ascontiguousarray(xyz[:: 1 + len(xyz) // SHIFTED_POINTS])
    above = _above(cameras, xyz)
    for share in SHIFTS:
        steps = share * above * np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)])
        moved = (replace(cameras, centres=cameras.centres + step) for step in steps)
        if all(np.mean(cameras_in_sight(some, one) < 2) > MOST_UNSEEN for one in moved):
            return share * above
    return None


def _above(cameras: Cameras, xyz: FloatArray) -> float:
    """Return the flying height above the cloud, metres."""
    return float(abs(np.median(cameras.centres[:, 2]) - np.median(xyz[:, 2])))


def _pixel_m(cameras: Cameras, xyz: FloatArray) -> float | None:
    """Return the size of a pixel on the ground, where lenses tell that of one in the image."""
    lenses = cameras.lenses or ()
    if not lenses or any(one.unit == "mm" and one.pixel_size_mm is None for one in lenses):
        return None
    return _above(cameras, xyz) / float(np.median([one.focal_px for one in lenses]))


def _spacing(cameras: Cameras, cloud: FloatArray, flight: Flight) -> Result:
    """Compare how close points lie with the pixels from which they came."""
    pixel = _pixel_m(cameras, cloud)
    if pixel is None or len(cloud) <= AROUND:
        return Result()
    from scipy.spatial import cKDTree  # not quick to load

    places = cloud[:, :2]
    reach = np.asarray(cKDTree(places).query(places[:: 1 + len(places) // TIES], k=AROUND + 1)[0])
    area = np.pi * float(np.median(reach[:, -1])) ** 2 / (AROUND * flight.every)
    per_pixel = pixel**2 / area if area > 0.0 else 0.0
    if per_pixel <= MOST_PER_PIXEL:
        return Result()
    return Result(
        doubt=f"The cloud has {per_pixel:.0f} points for each pixel of {100.0 * pixel:.3g} cm on"
        f" the ground, which images from {_above(cameras, cloud):.0f} m cannot give: the cameras"
        " are too high, in feet, or of another flight."
    )


def _directions(cameras: Cameras, xyz: FloatArray) -> Result:
    """Compare the yaw of steep images with the flight lines, where images follow each other."""
    found = None if cameras.rotations is None else _steps(cameras, cameras.rotations)
    if found is None:
        return Result(unchecked="yaw (no flight lines with it)")
    heading, yaw = found
    turn = _common(heading - yaw)
    if turn is None:
        return Result(unchecked="yaw (it does not follow the flight lines)")
    if abs(turn) <= MOST_TURN_DEG:
        return Result("yaw along the flight lines")
    read = _common(heading - np.degrees(yaw))
    if read is not None and abs(read) <= MOST_TURN_DEG and np.ptp(yaw) <= 2.0 * np.pi:
        return Result(
            doubt=f"The tops of the images point {abs(turn):.0f} degrees off the flight lines, on"
            " all of them, but along them if the angles are read as radians: give them in degrees."
        )
    if abs(turn) < 180.0 - MOST_TURN_DEG:  # as cameras are mounted in aircraft
        return Result(unchecked="yaw (the images lie across the flight lines)")
    return Result(
        doubt=f"The tops of the images point {abs(turn):.0f} degrees away from the flight lines, on"
        " all of them: the camera was mounted so, or the yaw counts from another direction; check"
        " the convention of the angles."
    )


def _steps(cameras: Cameras, rotations: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return the headings of steps between steep images in a row, and the yaw of these, rad."""
    step = np.diff(cameras.centres[:, :2], axis=0)
    length = np.hypot(*step.T)
    steep = rotations[:, 2, 2] < -STEEP_COSINE
    usual = 2.0 * np.median(length) if len(length) else 0.0
    rows = np.flatnonzero((length > 0.0) & (length < usual) & steep[:-1] & steep[1:])
    if len(rows) < LEAST_STEPS:
        return None
    top = -rotations[rows, 1]
    return np.arctan2(*step[rows].T), np.arctan2(top[:, 0], top[:, 1])


def _common(turn: FloatArray) -> float | None:
    """Return the mean of angles (rad) that are alike, degrees; None where they are not."""
    mean = np.mean(np.exp(1j * turn))
    return float(np.degrees(np.angle(mean))) if abs(mean) >= STEADY else None


def _heights(cameras: Cameras, cloud: FloatArray, ties: TiePoints | None) -> Result:
    """Compare tie points with their image places, and with the heights of the cloud."""
    if ties is None or cameras.lenses is None or cameras.rotations is None:
        pixel = _pixel_m(cameras, cloud)
        sized = "" if pixel is None else f", {100.0 * pixel:.3g} cm a pixel"
        by_them = f"by them {_above(cameras, cloud):.0f} m above the cloud{sized}"
        return Result(unchecked=f"heights (no tie points; {by_them})")
    miss = _median_miss(cameras, ties)
    if miss is None:
        return Result(unchecked="heights (no tie points in the frames)")
    if miss > MOST_MISS:
        return Result(
            doubt=f"Tie points lie {100.0 * miss:.0f} % of the frame's width from their image"
            " places: poses, lens and points of the camera file do not belong together; export"
            " them again."
        )
    from scipy.spatial import cKDTree  # not quick to load

    placed = ties.xyz[np.isfinite(ties.xyz).all(axis=1)]
    placed = placed[:: 1 + len(placed) // TIES]
    tree = cKDTree(cloud[:, :2])
    apart, row = (np.asarray(one) for one in tree.query(placed[:, :2]))
    among = np.asarray(tree.query(cloud[:: 1 + len(cloud) // TIES, :2], k=2)[0])
    near = apart <= 2.0 * np.median(among[:, 1])
    if near.sum() < LEAST_STEPS:
        return Result(unchecked="heights (no tie points on the cloud)")
    off = float(np.median((placed[:, 2] - cloud[row, 2])[near]))
    above = float(np.median(cameras.centres[:, 2]) - np.median(cloud[:, 2]))
    if abs(off) > MOST_HEIGHT * abs(above):
        return Result(
            doubt=f"The tie points of the cameras lie {abs(off):.1f} m"
            f" {'above' if off > 0.0 else 'below'} the cloud (median of {int(near.sum()):,}): the"
            " block is shifted, or the heights of cameras and cloud count from different places, or"
            " are in feet and metres."
        )
    return Result(f"tie points in their image places and {abs(off):.2f} m from the cloud's heights")


def _median_miss(cameras: Cameras, ties: TiePoints) -> float | None:
    """Return how far tie points are imaged from their places, of the frame's width."""
    point = np.repeat(np.arange(len(ties.xyz)), np.diff(ties.views.start))
    rows = np.flatnonzero(np.isfinite(ties.xyz[point]).all(axis=1))
    rows = rows[:: 1 + len(rows) // (5 * TIES)]
    camera, misses = ties.views.camera[rows], list[FloatArray]()
    order = np.argsort(camera, kind="stable")
    first = np.searchsorted(camera[order], np.arange(len(cameras) + 1))
    for k, (start, end) in enumerate(pairwise(first)):
        if start < end and cameras.lenses is not None and cameras.rotations is not None:
            some, lens = rows[order[start:end]], cameras.lenses[k]
            rays = (ties.xyz[point[some]] - cameras.centres[k]) @ cameras.rotations[k].T
            apart = np.hypot(*(project(lens, rays) - ties.image_xy[some]).T) / lens.width
            front: BoolArray = np.asarray(rays[:, 2] > 0.0)
            misses.append(np.where(front & np.isfinite(apart), apart, np.inf))
    return float(np.median(np.concatenate(misses))) if misses else None
