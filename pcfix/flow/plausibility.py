"""Test whether cameras, cloud and water belong together, with evidence independent of each.

A correction looks plausible with almost any cameras and any level. These tests use a sample of the
cloud; what cannot be tested is listed as not checked. None of it changes a result.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, Literal, NamedTuple, TypeAlias

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
MOST_PER_PIXEL, AROUND = 10.0, 8
"""Points of a cloud for each pixel of an image; matchers make one at most, or a few."""
MOST_APART_M = 15.0
"""In plan, from positions of the GNSS, in the median; without corrections these are 5 m off."""
TAKE_OFF_M, MOST_SHARE = (-15.0, 25.0), 0.1
"""How high above the water drones take off, and the share of their height that barometers err."""

Finding: TypeAlias = tuple[Literal["fits", "doubts", "unchecked"], str | PcfixWarning]
"""What one test found out: what fits, what does not, or what could not be tested."""


class Plausible(NamedTuple):
    """The results of the tests."""

    fits: tuple[str, ...] = ()  # tests that were passed
    doubts: tuple[PcfixWarning, ...] = ()  # tests that were not
    unchecked: tuple[str, ...] = ()  # what could not be tested

    def __str__(self) -> str:
        """Return a line that claims no more than was tested."""
        found = "cameras and cloud match" if self.fits else "nothing was tested"
        found = "cameras and cloud may not match, see the warnings" if self.doubts else found
        found += f"; tested: {', '.join(self.fits)}" if self.fits else ""
        return found + (f"; not checked: {', '.join(self.unchecked)}" if self.unchecked else "")

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        lists = {"fits": self.fits, "problems": self.doubts, "unchecked": self.unchecked}
        return {"words": str(self), **{name: list(map(str, one)) for name, one in lists.items()}}


@dataclass(frozen=True)
class CloudSample(Sums):
    """Points of a cloud, evenly spread over its order, with the water above them."""

    parts: tuple[FloatArray, ...] = ()  # (n, 7) each: x, y, z, height of the water, colours
    every: float = field(default=1.0, metadata=SAME)  # points of the cloud for each of the sample

    @classmethod
    def of(cls, points: Points, water_m: FloatArray, row: int, count: int) -> CloudSample:
        """Return the sample of a chunk that begins at a row of a cloud of `count` points."""
        step = max(1, count // SAMPLE_POINTS)
        rows = slice(-row % step, None, step)
        xyz = points.xyz[rows]
        rgb = np.zeros_like(xyz) if points.rgb is None else points.rgb[rows]
        return cls((np.column_stack([xyz, water_m[rows], rgb]),), float(step))

    def _known(self) -> FloatArray:
        """Return the rows with a water surface above them."""
        rows = np.vstack([np.zeros((0, 7)), *self.parts])
        return np.asarray(rows[np.isfinite(rows[:, 3])])

    @property
    def water_m(self) -> float | None:
        """The median height of the water."""
        known = self._known()
        return float(np.median(known[:, 3])) if len(known) else None

    @property
    def xyz(self) -> FloatArray:
        """The points, shape (n, 3)."""
        return np.vstack([np.zeros((0, 7)), *self.parts])[:, :3]

    def level_doubts(self) -> tuple[PcfixWarning, ...]:
        """Return warnings if the shoreline in the cloud is at another height than the water."""
        known = self._known()
        if len(known) < LEAST_POINTS:
            return ()
        water = known[:, 3]
        found = find_elsewhere(known[:, :3], water, known[:, 4:])
        if found is None:
            return ()
        off, level = found.level_m, float(np.median(water)) + found.level_m
        sentence = (
            f"The cloud's shoreline is {abs(off):.2f} m {'above' if off > 0.0 else 'below'} the"
            f" given water, at about {level:.2f} m (standard error {found.sigma_level_m:.2f} m:"
            f" {'; '.join(found.reasons)}). Check the level and its vertical datum, or try"
            " --water auto."
        )
        return (PcfixWarning("water.shoreline_level", sentence, off_m=off, level_m=level),)


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
    found: dict[str, list[Any]] = {"fits": [], "doubts": [*level_doubts], "unchecked": []}
    flown = list(_flying_heights(cameras, file, water_m)) if file else []
    for kind, what in chain(
        *(test(cameras, xyz) for test in (_far, _frames, _directions)),
        [("fits", "listed points visible in their images")] if listed and cameras.lenses else [],
        _positions(cameras, str(file)),
        (one for one in _heights(cameras, cloud, ties) if one[0] != "unchecked" or not flown),
        flown,
        _spacing(cameras, cloud, every),
    ):
        found[kind].append(what)
    return Plausible(*map(tuple, found.values()))


def _doubt(code: str, sentence: str, **values: Any) -> Finding:
    return "doubts", PcfixWarning(code, sentence, **values)


def _far(cameras: Cameras, xyz: FloatArray) -> Iterator[Finding]:
    """Look for cameras far from the cloud."""
    low, high, place = xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0), cameras.centres[:, :2]
    apart = np.hypot(*np.maximum(np.maximum(low - place, place - high), 0.0).T)
    count, last = int((apart > FAR_M).sum()), int(np.argmax(apart))
    if count:
        yield _doubt(
            "cameras.far",
            f"{count} of {len(cameras)} cameras are more than {FAR_M / 1000.0:g} km from the cloud,"
            f" {cameras.labels[last]} {apart[last] / 1000.0:,.0f} km. Check their coordinate"
            " system, or remove them.",
            count=count, image=cameras.labels[last],
        )  # fmt: skip


def _frames(cameras: Cameras, xyz: FloatArray) -> Iterator[Finding]:
    """Test whether each point is in two frames or more, as its reconstruction needs two.

    A wrong CRS, datum, unit or convention of angles moves frames off the points.
    """
    if cameras.lenses is None or cameras.rotations is None:
        yield "unchecked", "frames (the cameras have no lenses or no angles)"
        return
    unseen = float(np.mean(cameras_in_sight(xyz, cameras) < 2))
    if unseen > MOST_UNSEEN:
        yield _doubt(
            "cameras.no_overlap",
            f"{100.0 * unseen:.1f} % of the points are in fewer than two frames. Check coordinates,"
            " heights, angles and interior orientation of the cameras, and whether some are"
            " missing.",
            share=unseen,
        )
        return
    yield "fits", f"{100.0 * (1.0 - unseen):.4g} % of the points in two frames or more"
    if cameras.gnss is None:
        yield "unchecked", "a shift in plan (no GNSS positions)"


def _above(cameras: Cameras, xyz: FloatArray) -> float:
    """Return the flying height above the cloud, metres."""
    return float(abs(np.median(cameras.centres[:, 2]) - np.median(xyz[:, 2])))


def _spacing(cameras: Cameras, cloud: FloatArray, every: float) -> Iterator[Finding]:
    """Compare the spacing of the points with the size of the pixels."""
    lenses, places = cameras.lenses or (), cloud[:, :2]
    if not lenses or any(one.unit == "mm" for one in lenses) or len(cloud) <= AROUND:
        return
    pixel = _above(cameras, cloud) / float(np.median([one.focal_px for one in lenses]))
    reach = np.asarray(cKDTree(places).query(places[:: 1 + len(places) // TIES], k=AROUND + 1)[0])
    area = np.pi * float(np.median(reach[:, -1])) ** 2 / (AROUND * every)
    per_pixel = pixel**2 / area if area > 0.0 else 0.0
    if per_pixel > MOST_PER_PIXEL:
        yield _doubt(
            "cameras.too_high",
            f"The cloud has {per_pixel:.0f} points for each pixel of {100.0 * pixel:.3g} cm on the"
            " ground, more than a matcher makes. Check that the cameras belong to it, and that"
            " their heights are in metres.",
            points_per_pixel=per_pixel,
        )


def _directions(cameras: Cameras, xyz: FloatArray) -> Iterator[Finding]:
    """Compare the yaw of near-nadir images with the direction of the flight lines."""
    # steps between near-nadir images that follow each other
    step = np.diff(cameras.centres[:, :2], axis=0)
    length, turn, read = np.hypot(*step.T), None, None
    if cameras.rotations is not None and len(length):
        steep = cameras.rotations[:, 2, 2] < -STEEP_COSINE
        usual = 2.0 * np.median(length)
        rows = np.flatnonzero((length > 0.0) & (length < usual) & steep[:-1] & steep[1:])
        if len(rows) >= LEAST_STEPS:
            top = -cameras.rotations[rows, 1]  # direction of the upper edge, world frame
            heading, yaw = np.arctan2(*step[rows].T), np.arctan2(top[:, 0], top[:, 1])
            turn, read = _common(heading - yaw), _common(heading - np.degrees(yaw))
    if turn is None:
        yield "unchecked", "yaw (no flight lines with it)"
    elif abs(turn) <= MOST_TURN_DEG:
        yield "fits", "yaw along the flight lines"
    elif read is not None and abs(read) <= MOST_TURN_DEG:
        yield _doubt(
            "cameras.radians",
            f"The images are turned by {abs(turn):.0f} degrees against the flight lines, unless"
            " their angles are in radians. Give the angles in degrees.",
            turn_deg=turn,
        )
    elif abs(turn) < 180.0 - MOST_TURN_DEG:  # as cameras are mounted in aircraft
        yield "unchecked", "yaw (the images are across the flight lines)"
    else:
        yield _doubt(
            "cameras.yaw",
            f"The images are turned by {abs(turn):.0f} degrees against the flight lines. Check the"
            " convention of the angles, unless the camera was mounted like that.",
            turn_deg=turn,
        )


def _common(turn: FloatArray) -> float | None:
    """Return the mean of angles (rad) in degrees; None if they differ too much."""
    mean = np.mean(np.exp(1j * turn))
    return float(np.degrees(np.angle(mean))) if abs(mean) >= STEADY else None


def _heights(cameras: Cameras, cloud: FloatArray, ties: TiePoints | None) -> Iterator[Finding]:
    """Compare tie points with their image coordinates, and with the heights of the cloud."""
    if ties is None or cameras.lenses is None or cameras.rotations is None:
        above = _above(cameras, cloud)
        yield "unchecked", f"heights (no tie points; cameras {above:.0f} m above the cloud)"
        return
    found = _worst_residual(cameras, ties)
    if found is None:
        yield "unchecked", "heights (no tie points in the frames)"
        return
    residual, image = found
    if residual > MOST_RESIDUAL:
        yield _doubt(
            "cameras.residuals",
            f"Tie points have residuals of {100.0 * residual:.0f} % of the frame's width in image"
            f" {image} (median). Poses, lens and points of the camera file do not belong together;"
            " export them again.",
            share=residual, image=image,
        )  # fmt: skip
        return
    placed = ties.xyz[np.isfinite(ties.xyz).all(axis=1)]
    placed = placed[:: 1 + len(placed) // TIES]
    tree = cKDTree(cloud[:, :2])
    apart, row = (np.asarray(one) for one in tree.query(placed[:, :2]))
    among = np.asarray(tree.query(cloud[:: 1 + len(cloud) // TIES, :2], k=2)[0])
    near = apart <= 2.0 * np.median(among[:, 1])
    if near.sum() < LEAST_STEPS:
        yield "unchecked", "heights (no tie points on the cloud)"
        return
    off = float(np.median((placed[:, 2] - cloud[row, 2])[near]))
    if abs(off) > MOST_HEIGHT * _above(cameras, cloud):
        yield _doubt(
            "cameras.height",
            f"The tie points are {abs(off):.1f} m {'above' if off > 0.0 else 'below'} the cloud"
            f" (median of {int(near.sum()):,}). Check the offset, the vertical datum and the unit"
            " of the heights.",
            off_m=off,
        )
        return
    yield "fits", f"tie points match their images, {abs(off):.2f} m from the cloud's heights"


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


def _positions(cameras: Cameras, name: str) -> Iterator[Finding]:
    """Compare the places of cameras with those that their GNSS recorded."""
    try:
        found = np.zeros((0, 2))
        if cameras.gnss is not None:
            found = adjusted_minus_gnss(cameras, name)[0][:, :2]
    except InputError:
        return
    apart = np.hypot(*found[np.isfinite(found).all(axis=1)].T)
    middle = float(np.median(apart)) if len(apart) else 0.0
    if middle > MOST_APART_M:
        yield _doubt(
            "cameras.gnss",
            f"The cameras are {middle:.4g} m in plan from their GNSS positions (median of"
            f" {len(apart)}). Check their CRS and offset.",
            off_m=middle,
        )
    elif len(apart):
        yield "fits", f"positions {middle:.1f} m in plan from their GNSS"


def _flying_heights(cameras: Cameras, file: File, water_m: float | None) -> Iterator[Finding]:
    """Compare the heights of cameras above the water with those recorded above take-off."""
    recorded = read_altitudes(file, cameras.labels)
    rows = np.flatnonzero(np.isfinite(recorded))
    if not len(rows) or water_m is None:
        return
    above = float(np.median(cameras.centres[rows, 2])) - water_m
    flown = float(np.median(recorded[rows]))
    off, (low, high), least = above - flown, TAKE_OFF_M, MOST_SHARE * abs(flown)
    where = f"{abs(off):.0f} m {'above' if off > 0.0 else 'below'} the water"
    if low - least <= off <= high + least:
        yield "fits", f"heights as recorded in flight, from a take-off {where}"
        return
    yield _doubt(
        "cameras.flying_height",
        f"The cameras are {above:.0f} m above the water, and recorded {flown:.0f} m above their"
        f" take-off (median of {len(rows)}), which would be {where}. If it was not, check the"
        " vertical datum and the unit of cameras and water.",
        above_water_m=above, above_take_off_m=flown,
    )  # fmt: skip
