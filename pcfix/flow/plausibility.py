"""Test whether cameras, cloud and water belong together, with evidence independent of each.

A correction looks plausible with almost any cameras and any level. Three tests use a sample of the
cloud: each point needs two frames, tie points must match images and cloud, and the shoreline in the
cloud must be at the water. What cannot be tested is listed. None of it changes a result.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from pcfix.errors import PcfixWarning
from pcfix.flow.surfaces import Points
from pcfix.lens.frames import cameras_in_sight
from pcfix.lens.imaging import straight_images
from pcfix.model import Cameras, FloatArray, TiePoints
from pcfix.sums import Sums
from pcfix.water.auto import LEAST_POINTS, find_elsewhere

SAMPLE_POINTS, IN_FRAMES = 30_000, 4_000
"""Points of the sample, and those of it that are tested in the frames; evenly spread."""
MOST_UNSEEN = 0.01
"""Share of a cloud that may lie in fewer than two frames: noise, and the borders of lenses."""
MOST_RESIDUAL, MOST_HEIGHT = 0.01, 0.02
"""Of tie points in the images (of the frame), and from the cloud (of the flying height)."""
LEAST_TIES, TIES = 10, 3_000
"""The fewest tie points that are compared, in an image or with the cloud, and the most."""


class Plausible(NamedTuple):
    """The results of one or more tests."""

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

    @property
    def rows(self) -> FloatArray:
        """All rows, shape (n, 7)."""
        return np.vstack([np.zeros((0, 7)), *self.parts])

    def level_doubts(self) -> tuple[PcfixWarning, ...]:
        """Return warnings if the shoreline in the cloud is at another height than the water."""
        known = self.rows[np.isfinite(self.rows[:, 3])]
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
    listed: bool = False,
) -> Plausible:
    """Test cameras and cloud against each other.

    Cameras and tie points are in the cloud's frame; `cloud` are some of its points, shape (n, 3),
    metres, evenly spread. `level_doubts` are those of `CloudSample`, and `listed` says whether the
    listed images were found to hold their points.
    """
    level = Plausible(doubts=level_doubts)
    if not len(cameras) or not len(cloud):
        return level
    in_list = Plausible(fits=("listed points visible in their images",))
    tests = (
        level,
        _frames(cameras, np.ascontiguousarray(cloud[:: 1 + len(cloud) // IN_FRAMES])),
        in_list if listed and cameras.lenses else Plausible(),
        _ties(cameras, cloud, ties),
    )
    return Plausible(
        tuple(one for test in tests for one in test.fits),
        tuple(one for test in tests for one in test.doubts),
        tuple(one for test in tests for one in test.unchecked),
    )


def _frames(cameras: Cameras, xyz: FloatArray) -> Plausible:
    """Test whether each point is in two frames or more, as its reconstruction needs two.

    A wrong CRS, datum, unit or convention of angles moves frames off the points.
    """
    if cameras.lenses is None or cameras.rotations is None:
        return Plausible(unchecked=("frames (the cameras have no lenses or no angles)",))
    unseen = float(np.mean(cameras_in_sight(xyz, cameras) < 2))
    if unseen > MOST_UNSEEN:
        sentence = (
            f"{100.0 * unseen:.1f} % of the points are in fewer than two frames. Check coordinates,"
            " heights, angles and interior orientation of the cameras, and whether some are"
            " missing."
        )
        return Plausible(doubts=(PcfixWarning("cameras.no_overlap", sentence, share=unseen),))
    fits = f"{100.0 * (1.0 - unseen):.4g} % of the points in two frames or more"
    return Plausible(fits=(fits,), unchecked=("a shift in plan",))


def _ties(cameras: Cameras, cloud: FloatArray, ties: TiePoints | None) -> Plausible:
    """Compare tie points with their image coordinates, and with the heights of the cloud."""
    above = float(abs(np.median(cameras.centres[:, 2]) - np.median(cloud[:, 2])))
    if ties is None or cameras.lenses is None or cameras.rotations is None:
        words = f"heights (no tie points; cameras {above:.0f} m above the cloud)"
        return Plausible(unchecked=(words,))
    found = _worst_residual(cameras, ties)
    if found is None:
        return Plausible(unchecked=("heights (no tie points in the frames)",))
    residual, image = found
    if residual > MOST_RESIDUAL:
        sentence = (
            f"Tie points have residuals of {100.0 * residual:.0f} % of the frame's width in image"
            f" {image} (median). Poses, lens and points of the camera file do not belong together;"
            " export them again."
        )
        doubt = PcfixWarning("cameras.residuals", sentence, share=residual, image=image)
        return Plausible(doubts=(doubt,))
    placed = ties.xyz[np.isfinite(ties.xyz).all(axis=1)]
    placed = placed[:: 1 + len(placed) // TIES]
    tree = cKDTree(cloud[:, :2])
    apart, row = (np.asarray(one) for one in tree.query(placed[:, :2]))
    among = np.asarray(tree.query(cloud[:: 1 + len(cloud) // TIES, :2], k=2)[0])
    near = apart <= 2.0 * np.median(among[:, 1])
    if near.sum() < LEAST_TIES:
        return Plausible(unchecked=("heights (no tie points on the cloud)",))
    off = float(np.median((placed[:, 2] - cloud[row, 2])[near]))
    if abs(off) > MOST_HEIGHT * above:
        sentence = (
            f"The tie points are {abs(off):.1f} m {'above' if off > 0.0 else 'below'} the cloud"
            f" (median of {int(near.sum()):,}). Check the offset, the vertical datum and the unit"
            " of the heights."
        )
        return Plausible(doubts=(PcfixWarning("cameras.height", sentence, off_m=off),))
    fits = f"tie points match their images, {abs(off):.2f} m from the cloud's heights"
    return Plausible(fits=(fits,))


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
