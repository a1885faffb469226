"""Test whether cameras, cloud and water belong together, with evidence independent of each.

A correction looks plausible with almost any cameras and any level. These tests use a sample of the
cloud; what cannot be tested is listed as not checked. None of it changes a result.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
from scipy.spatial import cKDTree

from pcfix.errors import InputError, PcfixWarning
from pcfix.flow.surfaces import Points
from pcfix.io.cameras.georeference import adjusted_minus_gnss
from pcfix.lens.frames import cameras_in_sight
from pcfix.lens.imaging import straight_images
from pcfix.model import Cameras, FloatArray, TiePoints
from pcfix.options.declare import File
from pcfix.sums import Sums
from pcfix.water.auto import LEAST_POINTS, find_elsewhere

SAMPLE_POINTS, IN_FRAMES = 30_000, 4_000
"""Points of the sample, and those of it that are tested in the frames; evenly spread."""
MOST_UNSEEN = 0.01
"""Share of a cloud that may lie in fewer than two frames: noise, and the borders of lenses."""
LEAST_STEPS, STEADY, MOST_TURN_DEG = 10, 0.9, 45.0
"""Steps along flight lines, the consistency of their angle to the images, and its maximum."""
STEEP_COSINE = 0.9
"""Of the tilt of images whose top has a clear direction in plan, about 25 degrees."""
MOST_RESIDUAL, MOST_HEIGHT = 0.01, 0.02
"""Of tie points in the images (of the frame), and from the cloud (of the flying height)."""
TIES = 3_000
MOST_APART_M = 15.0
"""In plan, from positions of the GNSS, in the median; without corrections these are 5 m off."""

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

    @classmethod
    def of(cls, points: Points, water_m: FloatArray, row: int, count: int) -> CloudSample:
        """Return the sample of a chunk that begins at a row of a cloud of `count` points."""
        step = max(1, count // SAMPLE_POINTS)
        rows = slice(-row % step, None, step)
        xyz = points.xyz[rows]
        rgb = np.zeros_like(xyz) if points.rgb is None else points.rgb[rows]
        return cls((np.column_stack([xyz, water_m[rows], rgb]),))

    def _known(self) -> FloatArray:
        """Return the rows with a water surface above them."""
        rows = np.vstack([np.zeros((0, 7)), *self.parts])
        return np.asarray(rows[np.isfinite(rows[:, 3])])

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
    listed: bool = False,
) -> Plausible:
    """Test cameras and cloud against each other.

    Cameras and tie points are in the cloud's frame; `cloud` are some of its points, shape (n, 3),
    metres, evenly spread. `level_doubts` are those of `CloudSample`, and `file` is that of the
    cameras. `listed` says whether the listed images were found to hold their points.
    """
    if not len(cameras) or not len(cloud):
        return Plausible((), level_doubts)
    xyz = np.ascontiguousarray(cloud[:: 1 + len(cloud) // IN_FRAMES])
    found: dict[str, list[Any]] = {"fits": [], "doubts": [*level_doubts], "unchecked": []}
    for kind, what in chain(
        _frames(cameras, xyz),
        _directions(cameras),
        [("fits", "listed points visible in their images")] if listed and cameras.lenses else [],
        _positions(cameras, str(file)),
        _heights(cameras, cloud, ties),
    ):
        found[kind].append(what)
    return Plausible(*map(tuple, found.values()))


def _doubt(code: str, sentence: str, **values: Any) -> Finding:
    return "doubts", PcfixWarning(code, sentence, **values)


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


def _directions(cameras: Cameras) -> Iterator[Finding]:
    """Compare the yaw of near-nadir images with the direction of the flight lines."""
    # steps between near-nadir images that follow each other
    step = np.diff(cameras.centres[:, :2], axis=0)
    length, turn = np.hypot(*step.T), None
    if cameras.rotations is not None and len(length):
        steep = cameras.rotations[:, 2, 2] < -STEEP_COSINE
        usual = 2.0 * np.median(length)
        rows = np.flatnonzero((length > 0.0) & (length < usual) & steep[:-1] & steep[1:])
        if len(rows) >= LEAST_STEPS:
            top = -cameras.rotations[rows, 1]  # direction of the upper edge, world frame
            heading, yaw = np.arctan2(*step[rows].T), np.arctan2(top[:, 0], top[:, 1])
            turn = _common(heading - yaw)
    if turn is None:
        yield "unchecked", "yaw (no flight lines with it)"
    elif abs(turn) <= MOST_TURN_DEG:
        yield "fits", "yaw along the flight lines"
    elif abs(turn) < 180.0 - MOST_TURN_DEG:  # as cameras are mounted in aircraft
        yield "unchecked", "yaw (the images are across the flight lines)"
    else:
        yield _doubt(
            "cameras.yaw",
            f"The images are turned by {abs(turn):.0f} degrees against the flight lines. Check the"
            " convention and the unit of the angles, unless the camera was mounted like that.",
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
