"""Test whether cameras, cloud and water belong together, with evidence independent of each.

A correction looks plausible with almost any cameras and any level. These tests use a sample of the
cloud; what cannot be tested is listed as not checked. None of it changes a result.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from pcfix.errors import InputError, PcfixWarning
from pcfix.flow.surfaces import Points
from pcfix.io.cameras.georeference import adjusted_minus_gnss
from pcfix.io.tides import read_altitudes
from pcfix.lens.frames import cameras_in_sight
from pcfix.lens.imaging import straight_images
from pcfix.model import Cameras, FloatArray, TiePoints
from pcfix.options.declare import File
from pcfix.sums import SAME, Sums
from pcfix.water.auto import LEAST_POINTS, find_elsewhere

SAMPLE_POINTS, IN_FRAMES = 30_000, 4_000
"""Points of the sample, and those of it that are tested in the frames; evenly spread."""
FAR_M = 50_000.0
"""No block is as wide; blocks may be many times as wide as one tile of their cloud."""
MOST_UNSEEN = 0.01
"""Share of a cloud that may lie in fewer than two frames: noise, and the borders of lenses."""
LEAST_STEPS, STEADY, MOST_TURN_DEG = 10, 0.9, 45.0
"""Steps along flight lines, the consistency of their angle to the images, and its maximum."""
STEEP_COSINE = 0.9
"""Of the tilt of images whose top has a clear direction in plan, about 25 degrees."""
MOST_RESIDUAL, MOST_HEIGHT = 0.01, 0.02
"""Of tie points in the images (of the frame), and from the cloud (of the flying height)."""
TIES = 3_000
SHIFTS, SHIFTED_POINTS = (0.1, 0.2, 0.4, 0.8), 500
"""Of the flying height, and the points that are tested with shifted cameras."""
MOST_PER_PIXEL, AROUND = 10.0, 8
"""Points of a cloud for each pixel of an image; matchers make one at most, or a few."""


class Result(NamedTuple):
    """The result of one test: what fits, what does not, or what could not be tested."""

    fit: str = ""
    doubt: PcfixWarning | None = None
    unchecked: str = ""


class Plausible(NamedTuple):
    """The results of the tests."""

    fits: tuple[str, ...] = ()  # tests that were passed
    doubts: tuple[PcfixWarning, ...] = ()  # tests that were not
    unchecked: tuple[str, ...] = ()  # what could not be tested

    def __str__(self) -> str:
        """Return a line that claims no more than was tested."""
        found = "cameras and cloud fit" if self.fits else "nothing was tested"
        found = "cameras and cloud may not fit, see the warnings" if self.doubts else found
        found += f"; tested: {', '.join(self.fits)}" if self.fits else ""
        return found + (f"; not checked: {', '.join(self.unchecked)}" if self.unchecked else "")

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        lists = {n: list(map(str, getattr(self, n))) for n in ("fits", "doubts", "unchecked")}
        return {"words": str(self), **lists}


@dataclass(frozen=True)
class CloudSample(Sums):
    """Points of a cloud, evenly spread over its order, with the water above them."""

    parts: tuple[FloatArray, ...] = ()  # (n, 3) each
    water: tuple[FloatArray, ...] = ()  # (n,)
    rgb: tuple[FloatArray, ...] = ()  # (n, 3), if the cloud has colours
    every: float = field(default=1.0, metadata=SAME)  # points of the cloud for each of the sample

    @classmethod
    def of(cls, points: Points, water_m: FloatArray, row: int, count: int) -> CloudSample:
        """Return the sample of a chunk that begins at a row of a cloud of `count` points."""
        step = max(1, count // SAMPLE_POINTS)
        rows = np.arange(-row % step, len(points.xyz), step)
        rgb = () if points.rgb is None else (points.rgb[rows],)
        return cls((points.xyz[rows],), (water_m[rows],), rgb, float(step))

    @property
    def water_m(self) -> float | None:
        """The median height of the water."""
        water = np.concatenate([np.zeros(0), *self.water])
        water = water[np.isfinite(water)]
        return float(np.median(water)) if len(water) else None

    @property
    def xyz(self) -> FloatArray:
        """The points, shape (n, 3)."""
        return np.vstack([np.zeros((0, 3)), *self.parts])

    def level_doubts(self) -> tuple[PcfixWarning, ...]:
        """Return warnings if the shoreline in the cloud is at another height than the water."""
        xyz, water = self.xyz, np.concatenate([np.zeros(0), *self.water])
        known = np.isfinite(water)
        if known.sum() < LEAST_POINTS:
            return ()
        rgb = np.vstack(self.rgb)[known] if self.rgb else None
        found, tilted = find_elsewhere(xyz[known], water[known], rgb)
        doubts = []
        if found is not None:
            off, level = found.level_m, float(np.median(water[known])) + found.level_m
            sentence = (
                f"The cloud's shoreline is {abs(off):.2f} m {'above' if off > 0.0 else 'below'} the"
                f" given water, at about {level:.2f} m (standard error {found.sigma_level_m:.2f} m:"
                f" {'; '.join(found.reasons)}). Check the level and its vertical datum, or try"
                " --water auto."
            )
            code = "water.shoreline_level"
            doubts.append(PcfixWarning(code, sentence, off_m=off, level_m=level))
        if tilted is not None:
            sentence = (
                f"The cloud's shoreline rises to the {tilted.to} against the given water by"
                f" {100.0 * tilted.slope:.2g} %, from {tilted.low_m:+.2f} to {tilted.high_m:+.2f}"
                " m. The water flows or one of the two is tilted; measure shoreline points on"
                " all sides and give them as --water."
            )
            code = "water.shoreline_tilt"
            doubts.append(PcfixWarning(code, sentence, to=tilted.to, slope=tilted.slope))
        return tuple(doubts)


def plausible(
    cameras: Cameras,
    cloud: FloatArray,
    ties: TiePoints | None = None,
    level_doubts: tuple[PcfixWarning, ...] = (),
    *,
    file: File = "",
    water_m: float | None = None,
    listed: bool = False,
    every: float = 1.0,
) -> Plausible:
    """Test cameras and cloud against each other.

    Cameras and tie points are in the cloud's frame; `cloud` are some of its points, shape (n, 3),
    metres, evenly spread, each of which stands for `every` of them. `level_doubts` are those of
    `CloudSample`, `file` is that of the cameras, and `water_m` the median height of the water.
    `listed` says whether the listed images were found to hold their points.
    """
    if not len(cameras) or not len(cloud):
        return Plausible((), level_doubts)
    xyz = np.ascontiguousarray(cloud[:: 1 + len(cloud) // IN_FRAMES])
    flown = flying_heights(cameras, file, water_m) if file else Result()
    heights = _heights(cameras, cloud, ties)
    if heights.unchecked and any(flown):
        heights = Result()
    results = [
        *(test(cameras, xyz) for test in (_far, _frames, _directions)),
        Result("listed points visible in their images" if listed and cameras.lenses else ""),
        *(positions(cameras, str(file)), heights, flown, _spacing(cameras, cloud, every)),
    ]
    fits, doubts, unchecked = (tuple(filter(None, found)) for found in zip(*results, strict=True))
    return Plausible(fits, (*level_doubts, *doubts), unchecked)


def _doubt(code: str, sentence: str, **values: Any) -> Result:
    return Result(doubt=PcfixWarning(code, sentence, **values))


def _far(cameras: Cameras, xyz: FloatArray) -> Result:
    """Look for cameras far from the cloud."""
    low, high, place = xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0), cameras.centres[:, :2]
    apart = np.hypot(*np.maximum(np.maximum(low - place, place - high), 0.0).T)
    far = np.flatnonzero(apart > FAR_M)
    if not len(far):
        return Result()
    last = far[np.argmax(apart[far])]
    return _doubt(
        "cameras.far",
        f"{len(far)} of {len(cameras)} cameras are more than {FAR_M / 1000.0:g} km from the cloud,"
        f" {cameras.labels[last]} {apart[last] / 1000.0:,.0f} km. Check their coordinate system,"
        " or remove them.",
        count=len(far),
        image=cameras.labels[last],
    )


def _frames(cameras: Cameras, xyz: FloatArray) -> Result:
    """Test whether each point is in two frames or more, as its reconstruction needs two."""
    if cameras.lenses is None or cameras.rotations is None:
        return Result(unchecked="frames (the cameras have no lenses or no angles)")
    # A wrong CRS, datum, unit or convention of angles moves frames off the points.
    unseen = float(np.mean(cameras_in_sight(xyz, cameras) < 2))
    if unseen <= MOST_UNSEEN:
        seen = f"{100.0 * (1.0 - unseen):.4g} % of the points in two frames or more"
        shift_m = _detectable_shift_m(cameras, xyz)
        if shift_m is None:
            beyond = "a shift in plan (the frames reach far beyond the cloud)"
            return Result(seen, unchecked=beyond)
        return Result(f"{seen} (a shift in plan of {shift_m:.0f} m would show)")
    return _doubt(
        "cameras.no_overlap",
        f"{100.0 * unseen:.1f} % of the points are in fewer than two frames. Check coordinates,"
        " heights, angles and interior orientation of the cameras, and whether some are missing.",
        share=unseen,
    )


def _detectable_shift_m(cameras: Cameras, xyz: FloatArray) -> float | None:
    """Return the smallest shift in plan that the test of frames detects in all directions."""
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
    """Return the size of a pixel on the ground, None if the lenses do not state it."""
    lenses = cameras.lenses or ()
    if not lenses or any(one.unit == "mm" for one in lenses):
        return None
    return _above(cameras, xyz) / float(np.median([one.focal_px for one in lenses]))


def _spacing(cameras: Cameras, cloud: FloatArray, every: float) -> Result:
    """Compare the spacing of the points with the size of the pixels."""
    pixel = _pixel_m(cameras, cloud)
    if pixel is None or len(cloud) <= AROUND:
        return Result()
    places = cloud[:, :2]
    reach = np.asarray(cKDTree(places).query(places[:: 1 + len(places) // TIES], k=AROUND + 1)[0])
    area = np.pi * float(np.median(reach[:, -1])) ** 2 / (AROUND * every)
    per_pixel = pixel**2 / area if area > 0.0 else 0.0
    if per_pixel <= MOST_PER_PIXEL:
        return Result()
    return _doubt(
        "cameras.too_high",
        f"The cloud has {per_pixel:.0f} points for each pixel of {100.0 * pixel:.3g} cm on the"
        " ground, more than a matcher makes. Check that the cameras belong to it, and that their"
        " heights are in metres.",
        points_per_pixel=per_pixel,
    )


def _directions(cameras: Cameras, xyz: FloatArray) -> Result:
    """Compare the yaw of near-nadir images with the direction of the flight lines."""
    no_lines = Result(unchecked="yaw (no flight lines with it)")
    if cameras.rotations is None:
        return no_lines
    # steps between near-nadir images that follow each other
    step = np.diff(cameras.centres[:, :2], axis=0)
    length = np.hypot(*step.T)
    steep = cameras.rotations[:, 2, 2] < -STEEP_COSINE
    usual = 2.0 * np.median(length) if len(length) else 0.0
    rows = np.flatnonzero((length > 0.0) & (length < usual) & steep[:-1] & steep[1:])
    if len(rows) < LEAST_STEPS:
        return no_lines
    top = -cameras.rotations[rows, 1]  # direction of the upper edge of the image, in the world
    heading, yaw = np.arctan2(*step[rows].T), np.arctan2(top[:, 0], top[:, 1])
    turn = _common(heading - yaw)
    if turn is None:
        return Result(unchecked="yaw (it does not follow the flight lines)")
    if abs(turn) <= MOST_TURN_DEG:
        return Result("yaw along the flight lines")
    read = _common(heading - np.degrees(yaw))
    if read is not None and abs(read) <= MOST_TURN_DEG and np.ptp(yaw) <= 2.0 * np.pi:
        return _doubt(
            "cameras.radians",
            f"The images are turned by {abs(turn):.0f} degrees against the flight lines, unless"
            " their angles are in radians. Give the angles in degrees.",
            turn_deg=turn,
        )
    if abs(turn) < 180.0 - MOST_TURN_DEG:  # as cameras are mounted in aircraft
        return Result(unchecked="yaw (the images lie across the flight lines)")
    return _doubt(
        "cameras.yaw",
        f"The images are turned by {abs(turn):.0f} degrees against the flight lines. Check the"
        " convention of the angles, unless the camera was mounted like that.",
        turn_deg=turn,
    )


def _common(turn: FloatArray) -> float | None:
    """Return the mean of angles (rad) in degrees; None if they differ too much."""
    mean = np.mean(np.exp(1j * turn))
    return float(np.degrees(np.angle(mean))) if abs(mean) >= STEADY else None


def _heights(cameras: Cameras, cloud: FloatArray, ties: TiePoints | None) -> Result:
    """Compare tie points with their image coordinates, and with the heights of the cloud."""
    if ties is None or cameras.lenses is None or cameras.rotations is None:
        pixel = _pixel_m(cameras, cloud)
        sized = "" if pixel is None else f", {100.0 * pixel:.3g} cm a pixel"
        by_them = f"cameras {_above(cameras, cloud):.0f} m above the cloud{sized}"
        return Result(unchecked=f"heights (no tie points; {by_them})")
    found = _worst_residual(cameras, ties)
    if found is None:
        return Result(unchecked="heights (no tie points in the frames)")
    residual, image = found
    if residual > MOST_RESIDUAL:
        return _doubt(
            "cameras.residuals",
            f"Tie points have residuals of {100.0 * residual:.0f} % of the frame's width in image"
            f" {image} (median). Poses, lens and points of the camera file do not belong together;"
            " export them again.",
            share=residual,
            image=image,
        )
    placed = ties.xyz[np.isfinite(ties.xyz).all(axis=1)]
    placed = placed[:: 1 + len(placed) // TIES]
    tree = cKDTree(cloud[:, :2])
    apart, row = (np.asarray(one) for one in tree.query(placed[:, :2]))
    among = np.asarray(tree.query(cloud[:: 1 + len(cloud) // TIES, :2], k=2)[0])
    near = apart <= 2.0 * np.median(among[:, 1])
    if near.sum() < LEAST_STEPS:
        return Result(unchecked="heights (no tie points on the cloud)")
    off = float(np.median((placed[:, 2] - cloud[row, 2])[near]))
    if abs(off) > MOST_HEIGHT * _above(cameras, cloud):
        return _doubt(
            "cameras.height",
            f"The tie points are {abs(off):.1f} m {'above' if off > 0.0 else 'below'} the cloud"
            f" (median of {int(near.sum()):,}). Check the offset, the vertical datum and the unit"
            " of the heights.",
            off_m=off,
        )
    return Result(f"tie points match their images, {abs(off):.2f} m from the cloud's heights")


def _worst_residual(cameras: Cameras, ties: TiePoints) -> tuple[float, str] | None:
    """Return the largest median residual of an image, relative to its width, and its name.

    The median of the block would hide a third of the images, such as all obliques.
    """
    point = np.repeat(np.arange(len(ties.xyz)), np.diff(ties.views.start))
    rows = np.flatnonzero(np.isfinite(ties.xyz[point]).all(axis=1))
    rows = rows[:: 1 + len(rows) // (5 * TIES)]
    if not len(rows):
        return None
    camera = ties.views.camera[rows]
    width = np.array([lens.width for lens in cameras.lenses or ()])[camera]
    image_xy = straight_images(ties.xyz[point[rows]], camera, cameras)
    residual = np.hypot(*(image_xy - ties.image_xy[rows]).T) / width
    residual = np.where(np.isfinite(residual), residual, np.inf)
    counts = np.bincount(camera)
    images = np.flatnonzero(counts >= min(LEAST_STEPS, counts.max()))
    medians = [float(np.median(residual[camera == i])) for i in images]
    return max(zip(medians, (cameras.labels[i] for i in images), strict=True))


# Cameras against what was recorded in flight: GNSS positions, heights above take-off

MOST_APART_M = 15.0
"""In plan, from positions of the GNSS, in the median; without corrections these are 5 m off."""
TAKE_OFF_M, MOST_SHARE = (-15.0, 25.0), 0.1
"""How high above the water drones take off, and the share of their height that barometers err."""


def positions(cameras: Cameras, name: str) -> Result:
    """Compare the places of cameras with those that their GNSS recorded."""
    if cameras.gnss is None:
        return Result()
    try:
        found = adjusted_minus_gnss(cameras, name)[0][:, :2]
    except InputError:
        return Result()
    apart = np.hypot(*found[np.isfinite(found).all(axis=1)].T)
    if not len(apart):
        return Result()
    middle = float(np.median(apart))
    if middle <= MOST_APART_M:
        return Result(f"positions {middle:.1f} m in plan from their GNSS")
    return _doubt(
        "cameras.gnss",
        f"The cameras are {middle:.4g} m in plan from their GNSS positions (median of"
        f" {len(apart)}). Check their CRS and offset.",
        off_m=middle,
    )


def flying_heights(cameras: Cameras, file: File, water_m: float | None) -> Result:
    """Compare the heights of cameras above the water with those recorded above take-off."""
    recorded = read_altitudes(file, cameras.labels)
    rows = np.flatnonzero(np.isfinite(recorded))
    if not len(rows) or water_m is None:
        return Result()
    above = float(np.median(cameras.centres[rows, 2])) - water_m
    flown = float(np.median(recorded[rows]))
    off, (low, high) = above - flown, TAKE_OFF_M
    least = MOST_SHARE * abs(flown)
    where = f"{abs(off):.0f} m {'above' if off > 0.0 else 'below'} the water"
    if low - least <= off <= high + least:
        return Result(f"heights as recorded in flight, from a take-off {where}")
    return _doubt(
        "cameras.flying_height",
        f"The cameras are {above:.0f} m above the water, and recorded {flown:.0f} m above their"
        f" take-off (median of {len(rows)}), which would be {where}. If it was not, check the"
        " vertical datum and the unit of cameras and water.",
        above_water_m=above,
        above_take_off_m=flown,
    )
