"""Test whether cameras, cloud and water belong together, with evidence independent of each.

A correction looks plausible with almost any cameras and any level. These tests use a sample of the
cloud: each point needs two frames, tie points must match images and cloud, and the shoreline in the
cloud must be at the water; images point along the flight lines, and cameras are where GNSS and
barometer recorded them. What cannot be tested is listed. None of it changes a result.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from scipy.spatial import cKDTree

from pcfix.errors import InputError, PcfixWarning
from pcfix.flow.surfaces import Points
from pcfix.io.cameras.georeference import adjusted_minus_gnss, frame_of, is_tied
from pcfix.io.crs import heights_of
from pcfix.io.photographs import read_altitudes
from pcfix.lens.imaging import count_visible_cameras, straight_images
from pcfix.model import Cameras, FloatArray, TiePoints
from pcfix.options.declare import File
from pcfix.sums import Sums
from pcfix.water.auto import LEAST_POINTS, find_elsewhere

# Points of the sample, and those of it that are tested in the frames; evenly spread.
SAMPLE_POINTS, IN_FRAMES = 30_000, 4_000
MOST_UNSEEN = 0.01  # share of a cloud that may be in fewer than two frames: noise, lens borders
# Largest residual of tie points, as a share of the frame's width, and their largest distance from
# the heights of the cloud, as a share of the flying height; medians.
MOST_RESIDUAL, MOST_HEIGHT = 0.01, 0.02
LEAST_TIES, TIES = 10, 3_000  # tie points that are compared, in an image or with the cloud
# Steps along flight lines, the consistency of their angle to the images, and its maximum.
LEAST_STEPS, STEADY, MOST_TURN_DEG = 10, 0.9, 45.0
# Cosine of the largest tilt, about 25 degrees, at which the upper edge of an image has a clear
# direction in plan.
STEEP_COSINE = 0.9
MOST_OFF_M = 15.0  # largest median distance from GNSS positions, in plan or height; often 5 m
# How high above the water drones take off, and the share of their height that barometers err.
TAKE_OFF_M, MOST_SHARE = (-15.0, 25.0), 0.1

MARGIN_M = 100.0  # distance from the cloud beyond half its sides at which a block may belong to it
ABSURD_HEIGHTS = 3.0  # largest height of cameras above the cloud, in widths of the cloud


class Passed(str):
    """A test that was passed, in words."""


class Unchecked(str):
    """What could not be tested, and why."""


Finding: TypeAlias = Passed | Unchecked | PcfixWarning  # result of a test; a warning if it failed


class Plausible(NamedTuple):
    """The results of all tests."""

    fits: list[Passed]
    problems: list[PcfixWarning]
    unchecked: list[Unchecked]

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return {name: list(map(str, found)) for name, found in self._asdict().items()}


@dataclass(frozen=True)
class CloudSample(Sums):
    """Points of a cloud, evenly spread over its order, with the water above them."""

    parts: tuple[FloatArray, ...] = ()  # (n, 7) each: x, y, z, height of the water, colours

    @classmethod
    def of(cls, points: Points, water_m: FloatArray, row: int, count: int) -> "CloudSample":
        """Return the sample of a chunk that begins at a row of a cloud of `count` points."""
        step = max(1, count // SAMPLE_POINTS)
        rows = slice(-row % step, None, step)
        xyz = points.xyz[rows]
        rgb = np.zeros_like(xyz) if points.rgb is None else points.rgb[rows]
        return cls((np.column_stack([xyz, water_m[rows], rgb]),))

    @property
    def rows(self) -> FloatArray:
        """All rows, shape (n, 7)."""
        return np.vstack([np.zeros((0, 7)), *self.parts])

    @property
    def water_m(self) -> float | None:
        """The median height of the water, metres."""
        known = self.rows[np.isfinite(self.rows[:, 3]), 3]
        return float(np.median(known)) if len(known) else None

    def level_notes(self) -> list[PcfixWarning]:
        """Return a warning if the shoreline in the cloud is at another height than the water."""
        known = self.rows[np.isfinite(self.rows[:, 3])]
        if len(known) < LEAST_POINTS:
            return []
        found = find_elsewhere(known[:, :3], known[:, 3], known[:, 4:])
        if found is None:
            return []
        off, level = found.level_m, float(np.median(known[:, 3])) + found.level_m
        sentence = (
            f"The cloud's shoreline is {abs(off):.2f} m {'above' if off > 0.0 else 'below'} the"
            f" given water, at about {level:.2f} m (standard error {found.sigma_level_m:.2f} m:"
            f" {'; '.join(found.reasons)}). Check the level and its vertical datum, or try"
            " --water auto."
        )
        return [PcfixWarning("water.shoreline_level", sentence, off_m=off, level_m=level)]


def plausible(
    cameras: Cameras,
    cloud: FloatArray,
    ties: TiePoints | None = None,
    *,
    file: File = "",
    water_m: float | None = None,
    listed: bool = False,
) -> Plausible:
    """Test cameras and cloud against each other.

    Cameras and tie points are in the cloud's frame; `cloud` are some of its points, shape (n, 3),
    metres, evenly spread. `file` is that of the cameras, `water_m` the median height of the water,
    and `listed` says whether the listed images were found to hold their points.
    """
    found: list[Finding | None] = []
    if len(cameras) and len(cloud):
        flown, heights = _flown(cameras, file, water_m), _ties(cameras, cloud, ties)
        found += [
            _frames(cameras, np.ascontiguousarray(cloud[:: 1 + len(cloud) // IN_FRAMES])),
            _directions(cameras),
            Passed("listed points visible in their images") if listed and cameras.lenses else None,
            _positions(cameras, str(file)),
            None if flown and isinstance(heights, Unchecked) else heights,
            flown,
        ]
    return Plausible(
        [one for one in found if isinstance(one, Passed)],
        [one for one in found if isinstance(one, PcfixWarning)],
        [one for one in found if isinstance(one, Unchecked)],
    )


def _frames(cameras: Cameras, xyz: FloatArray) -> Finding:
    """Test whether each point is in two frames or more, as its reconstruction needs two.

    A wrong CRS, datum, unit or convention of angles moves frames off the points.
    """
    if cameras.lenses is None or cameras.rotations is None:
        return Unchecked("frames (the cameras have no lenses or no angles)")
    unseen = float(np.mean(count_visible_cameras(xyz, cameras) < 2))
    if unseen > MOST_UNSEEN:
        sentence = (
            f"{100.0 * unseen:.1f} % of the points are in fewer than two frames. Check coordinates,"
            " heights, angles and interior orientation of the cameras, and whether some are"
            " missing."
        )
        return PcfixWarning("cameras.no_overlap", sentence, share=unseen)
    return Passed(f"{100.0 * (1.0 - unseen):.4g} % of the points in two frames or more")


def _ties(cameras: Cameras, cloud: FloatArray, ties: TiePoints | None) -> Finding:
    """Compare tie points with their image coordinates, and with the heights of the cloud."""
    above = float(abs(np.median(cameras.centres[:, 2]) - np.median(cloud[:, 2])))
    if ties is None or cameras.lenses is None or cameras.rotations is None:
        return Unchecked(f"heights (no tie points; cameras {above:.0f} m above the cloud)")
    found = _worst_residual(cameras, ties)
    if found is None:
        return Unchecked("heights (no tie points in the frames)")
    residual, image = found
    if residual > MOST_RESIDUAL:
        sentence = (
            f"Tie points have residuals of {100.0 * residual:.0f} % of the frame's width in image"
            f" {image} (median). Poses, lens and points of the camera file do not belong together;"
            " export them again."
        )
        return PcfixWarning("cameras.residuals", sentence, share=residual, image=image)
    placed = ties.xyz[np.isfinite(ties.xyz).all(axis=1)]
    placed = placed[:: 1 + len(placed) // TIES]
    tree = cKDTree(cloud[:, :2])
    distance, row = (np.asarray(one) for one in tree.query(placed[:, :2]))
    among = np.asarray(tree.query(cloud[:: 1 + len(cloud) // TIES, :2], k=2)[0])
    near = distance <= 2.0 * np.median(among[:, 1])
    if near.sum() < LEAST_TIES:
        return Unchecked("heights (no tie points on the cloud)")
    off = float(np.median((placed[:, 2] - cloud[row, 2])[near]))
    if abs(off) > MOST_HEIGHT * above:
        sentence = (
            f"The tie points are {abs(off):.1f} m {'above' if off > 0.0 else 'below'} the cloud"
            f" (median of {int(near.sum()):,}). Check the offset, the vertical datum and the unit"
            " of the heights."
        )
        return PcfixWarning("cameras.height", sentence, off_m=off)
    return Passed(f"tie points match their images, {abs(off):.2f} m from the cloud's heights")


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
    images = np.flatnonzero(counts >= min(LEAST_TIES, counts.max()))
    medians = [float(np.median(residual[camera == i])) for i in images]
    return max(zip(medians, (cameras.labels[i] for i in images), strict=True))


def _directions(cameras: Cameras) -> Finding:
    """Compare the yaw of near-nadir images with the direction of the flight lines."""
    # steps between near-nadir images that follow each other
    step = np.diff(cameras.centres[:, :2], axis=0)
    length, rows = np.hypot(*step.T), np.zeros(0, np.int64)
    if cameras.rotations is not None and len(length):
        steep = cameras.rotations[:, 2, 2] < -STEEP_COSINE
        usual = 2.0 * np.median(length)
        rows = np.flatnonzero((length > 0.0) & (length < usual) & steep[:-1] & steep[1:])
    if cameras.rotations is None or len(rows) < LEAST_STEPS:
        return Unchecked("yaw (the images are not in flight lines)")
    top = -cameras.rotations[rows, 1]  # direction of the upper edge, world frame
    heading, yaw = np.arctan2(*step[rows].T), np.arctan2(top[:, 0], top[:, 1])
    # The angles as they are, and as if radians had been taken for degrees: the mean of unit vectors
    # has the direction of the usual turn, and the length 1 if all images are turned alike.
    means = [np.mean(np.exp(1j * (heading - angle))) for angle in (yaw, np.degrees(yaw))]
    turns = [abs(float(np.degrees(np.angle(mean)))) for mean in means]
    is_steady = [bool(abs(mean) >= STEADY) for mean in means]
    if not is_steady[0]:
        return Unchecked("yaw (the images are not in flight lines)")
    if turns[0] <= MOST_TURN_DEG:
        return Passed("yaw along the flight lines")
    are_radians = is_steady[1] and turns[1] <= MOST_TURN_DEG
    if turns[0] < 180.0 - MOST_TURN_DEG and not are_radians:  # as cameras are mounted in aircraft
        return Unchecked("yaw (the images are across the flight lines)")
    sentence = (
        f"The images are turned by {turns[0]:.0f} degrees against the flight lines. Check the"
        " convention and the unit of the angles, unless the camera was mounted like that."
    )
    return PcfixWarning("cameras.yaw", sentence, turn_deg=turns[0])


def _positions(cameras: Cameras, name: str) -> Finding | None:
    """Compare the places of cameras with those that their GNSS recorded."""
    if cameras.gnss is None:
        return Unchecked("a shift in plan (no GNSS positions)")
    try:
        found = adjusted_minus_gnss(cameras, name)[0]
        has_datum = is_tied(cameras.crs, name) and (
            heights_of(frame_of(cameras.crs or "", name).crs) == "gravity"
        )
    except InputError:
        return None
    off_m = np.hypot(*found[np.isfinite(found[:, :2]).all(axis=1), :2].T)
    if not len(off_m):
        return None
    middle = float(np.median(off_m))
    # GNSS heights are above the geoid as stated only where cameras and GNSS have a vertical datum
    up_m = found[np.isfinite(found[:, 2]), 2] if has_datum else np.zeros(0)
    above_m = float(np.median(up_m)) if len(up_m) else 0.0
    if middle <= MOST_OFF_M < abs(above_m):
        sentence = (
            f"The cameras are {abs(above_m):.1f} m {'above' if above_m > 0.0 else 'below'} their"
            " GNSS positions. Check the heights of --cameras-crs, or install the grid of the geoid."
        )
        return PcfixWarning("cameras.heights_differ", sentence, off_m=above_m)
    if middle <= MOST_OFF_M:
        return Passed(f"positions {middle:.1f} m in plan from their GNSS")
    sentence = (
        f"The cameras are {middle:.4g} m in plan from their GNSS positions (median of"
        f" {len(off_m)}). Check their CRS and offset."
    )
    return PcfixWarning("cameras.gnss", sentence, off_m=middle)


def _flown(cameras: Cameras, file: File, water_m: float | None) -> Finding | None:
    """Compare the heights of cameras above the water with those recorded above take-off.

    A wrong vertical datum or unit moves all cameras, which no other test sees without tie points.
    """
    if not file or water_m is None:
        return None
    recorded = read_altitudes(file, cameras.labels)
    rows = np.flatnonzero(np.isfinite(recorded))
    if not len(rows):
        return None
    above = float(np.median(cameras.centres[rows, 2])) - water_m
    flown = float(np.median(recorded[rows]))
    off, (low, high), least = above - flown, TAKE_OFF_M, MOST_SHARE * abs(flown)
    where = f"{abs(off):.0f} m {'above' if off > 0.0 else 'below'} the water"
    if low - least <= off <= high + least:
        return Passed(f"heights as recorded in flight, from a take-off {where}")
    sentence = (
        f"The cameras are {above:.0f} m above the water, and recorded {flown:.0f} m above their"
        f" take-off (median of {len(rows)}), which would be {where}. If it was not, check the"
        " vertical datum and the unit of cameras and water."
    )
    return PcfixWarning(
        "cameras.flying_height", sentence, above_water_m=above, above_take_off_m=flown
    )


def likely_mistake(centres: FloatArray, low: FloatArray, high: FloatArray) -> str | None:
    """Return how a block does not match its cloud; None if it does.

    The projection centres, shape (k, 3), are assumed to be in the cloud's CRS; `low` and `high`,
    shape (3,), are the corners of the cloud, metres.
    """
    size, middle = (high - low)[:2], np.median(centres, axis=0)
    x, y = (low + high)[:2] / 2.0 - middle[:2]
    if (np.abs([x, y]) > size + MARGIN_M).any():
        away = float(np.hypot(x, y))
        far = f"{away / 1000.0:,.1f} km" if away >= 1e4 else f"{away:.0f} m"
        advice = "check the CRS, the unit and the order of x and y of both, or give an offset of"
        advice += f" {x:.0f}, {y:.0f} m by --cameras-offset"
        return f"The cameras are {far} from the cloud in plan; {advice}."
    width = max(size.max(), MARGIN_M)
    if low[2] <= middle[2] <= high[2] + ABSURD_HEIGHTS * width:
        return None
    what = f"{middle[2] - high[2]:.0f} m above the cloud, which is {width:.0f} m wide"
    if middle[2] < low[2]:
        what = f"{low[2] - middle[2]:.0f} m below the lowest point of the cloud"
    why = "check the unit and the vertical datum of both, or see --cameras-offset"
    return f"The cameras are {what}: {why}."
