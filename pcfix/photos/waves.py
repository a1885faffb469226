"""The water surface above a bed, from the displacement of the bed in the frames of a sequence.

Mulsow 2024, "strategies for wavy water", the complex method: a spatio-temporal model of the
surface.

*From displacement to slope.* A nadir ray s meets the surface where its normal is about
N = (-z_x, -z_y, 1). Snell's law in vector form (eq 10 of Skarlatos & Agrafiotis 2018) with r = 1/n
gives, to the first order, t = ((1 - r) z_x, (1 - r) z_y, -1): at the depth h the ray meets the bed

    h (1 - 1/n) grad z

from its place under calm water, a quarter of depth times slope. The exact form, for any angle of
view: n t - s is along the normal. For a pixel p of a frame, s follows from the camera, and the
piercing point A from s and the level. The median image shows at p + d what the frame shows at p,
and through calm water that is the place Q of the bed. So t = (Q - A) / |Q - A|, N is along s - n t,
and the slope is -N_xy / N_z. A needs the height of the water, which is zero at first and then that
of the first solution.

*From slopes to heights.* The surface is a sum of plane waves,

    z(x, t) = sum a cos(k.x - w t) + b sin(k.x - w t),    w^2 = g k tanh(k h),

which has no curl, needs no border condition, and ties the frames together by the dispersion
relation (no current, no surface tension, mean depth). The waves with most energy on the dispersion
shell of the spectrum are chosen, some at a time, and fitted by least squares to the slopes of all
frames, weighted by the texture of the bed, with a prior of the slopes' own variance.

The median over few frames keeps about the mean of each wave over them, and the slopes lack it. So
each wave is fitted less its mean over the frames.

Not observable are the mean level, waves longer than twice the image or shorter than three cells,
and, without land, the part of the waves that looks like a movement of the camera.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.errors import GeometryError, photo_library
from pcfix.grid.lattice import Lattice
from pcfix.model import BoolArray, FloatArray, IntArray
from pcfix.photos.calm import grey8
from pcfix.photos.mapping import Photo


class View(NamedTuple):
    """The first frame's camera, calm water, and the true bed."""

    photo: Photo
    level_m: float
    refractive_index: float
    # heights, shape (n,), at places in plan, shape (n, 2); NaN where unknown
    bed: Callable[[FloatArray], FloatArray]


class Nodes(NamedTuple):
    """The cells of the rasters."""

    lattice: Lattice
    xy: FloatArray  # (n, 2), world frame, their centres row by row from the north
    seen: BoolArray  # (n,), whether the first frame sees them

    @property
    def local(self) -> FloatArray:
        """The centres relative to their mean, for the phases of waves."""
        return self.xy - self.xy.mean(axis=0)


def on_level(view: View, pixels: FloatArray) -> FloatArray:
    """Return where the straight rays of pixels meet the level, shape (n, 3)."""
    ray = view.photo.rays(pixels)
    far = (view.level_m - view.photo.centre[2]) / ray[:, 2]
    return np.asarray(view.photo.centre + np.where(far > 0.0, far, np.nan)[:, None] * ray)


def bed_places(view: View, pixels: FloatArray) -> FloatArray:
    """Return where pixels see the bed through calm water, shape (n, 3), by eq 10 on a level."""
    start = on_level(view, pixels)
    ray = start - view.photo.centre
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    refracted_ray = ray / view.refractive_index
    refracted_ray[:, 2] = -np.sqrt(1.0 - (refracted_ray[:, :2] ** 2).sum(axis=1))
    place = start
    for _ in range(10):
        far = (view.bed(place[:, :2]) - start[:, 2]) / refracted_ray[:, 2]
        place = start + far[:, None] * refracted_ray
    return place


def nodes_of(view: View, cell_m: float | None) -> Nodes:
    """Return the cells over what the camera sees of the level."""
    lens = view.photo.lens
    u, v = np.linspace(0.0, lens.width, 20), np.linspace(0.0, lens.height, 20)
    edge = np.array([[a, b] for a in u for b in v if a in u[[0, -1]] or b in v[[0, -1]]])
    outline = on_level(view, edge)[:, :2]
    if not np.isfinite(outline).all():
        sentence = "Part of the image does not show the water. Check pose and level."
        raise GeometryError("cameras.pose", sentence, level=view.level_m)
    # more than about 2000 cells would give more short waves, and take more time
    cell = cell_m or float(np.sqrt(np.ptp(outline, axis=0).prod() / 2000))
    depth = float(np.nanmedian(view.level_m - view.bed(outline)))
    low, high = outline.min(axis=0), outline.max(axis=0)
    beyond = max(cell, 0.4 * depth)  # as waves need some room around the image
    columns, rows = (int(n) for n in np.ceil((high - low + 2.0 * beyond) / cell) + 1)
    west = int(np.floor((low[0] - beyond) / cell))
    north = int(np.ceil((high[1] + beyond) / cell))
    lattice = Lattice(cell, west, -north, columns, rows)
    xy = lattice.centres(lattice.window)
    pixel = view.photo.pixels(np.column_stack([xy, np.full(len(xy), view.level_m)]))
    inside = ((pixel > 0.0) & (pixel < [lens.width, lens.height])).all(axis=1)
    return Nodes(lattice, xy, np.asarray(inside))


def displacements(
    median: npt.NDArray[Any], view: View, nodes: Nodes, frames: Iterable[npt.NDArray[Any]]
) -> tuple[FloatArray, FloatArray]:
    """Return the displacement of the bed in f frames from the median image, at the nodes.

    Displacements, shape (f, n, 2), are in pixels. Their weights, shape (n,), are zero where the
    bed hardly moves, as on land.
    """
    cv2 = photo_library("cv2")
    calm = grey8(median)
    texture = cv2.cornerMinEigenVal(calm, 7).astype(np.float64)
    weight = texture / (texture + np.median(texture[texture > 0.0]) + 1e-30)
    weight = weight.astype(np.float32)
    level = np.full(len(nodes.xy), view.level_m)
    at = (view.photo.pixels(np.column_stack([nodes.xy, level])) - 0.5).astype(np.float32)
    # means over a cell, as seen in the middle of the raster
    centre = np.append(nodes.xy[len(nodes.xy) // 2], view.level_m)
    ends = centre + np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]]) * nodes.lattice.resolution_m
    side = int(np.hypot(*np.diff(view.photo.pixels(ends), axis=0)[0])) | 1
    base = cv2.blur(weight, (side, side))
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow.setFinestScale(0)  # waves are short, and patches of 8 px smooth enough
    shifts = []
    for frame in frames:
        moved = flow.calc(grey8(frame), calm, None)
        mean = cv2.blur(moved * weight[..., None], (side, side)) / (base[..., None] + 1e-9)
        shifts.append(cv2.remap(mean, at[:, :1], at[:, 1:], cv2.INTER_LINEAR)[:, 0])
    shift_px = np.stack(shifts).astype(np.float64)
    weight_at = cv2.remap(base, at[:, :1], at[:, 1:], cv2.INTER_LINEAR)[:, 0]
    weight_at = np.where(nodes.seen, weight_at, 0.0).astype(np.float64)
    known, size = weight_at > 0.0, np.sqrt((shift_px**2).sum(axis=2).mean(axis=0))
    if known.any():  # what moves much less than usual is land
        weight_at[size < 0.15 * np.median(size[known])] = 0.0
    return shift_px, weight_at


def slopes_of(view: View, xy: FloatArray, height_m: FloatArray, shift_px: FloatArray) -> FloatArray:
    """Return the slopes of the surface that displace the bed, by Snell's law in vector form.

    `xy`, (n, 2), and `height_m`, (n,), are piercing points, world frame; `shift_px`, (n, 2), leads
    from the pixel of a frame to the pixel of the median that shows the same. Returns dz/dx and
    dz/dy, shape (n, 2); NaN where the bed is unknown or not under water.
    """
    pierced = np.column_stack([xy, height_m])
    seen = pierced - view.photo.centre
    seen /= np.linalg.norm(seen, axis=1)[:, None]
    wet = bed_places(view, view.photo.pixels(pierced) + shift_px) - pierced
    wet[~(wet[:, 2] < 0.0)] = np.nan
    wet /= np.linalg.norm(wet, axis=1)[:, None]
    normal = seen - view.refractive_index * wet
    return np.asarray(-normal[:, :2] / normal[:, 2:])


class Waves(NamedTuple):
    """Plane waves and their precision.

    Amplitudes are those of the slope (k times that of the height), cosines then sines.
    """

    number: FloatArray  # (m, 2), wave numbers k, rad/m
    frequency: FloatArray  # (m,), w, rad/s
    slope: FloatArray  # (2 m,), amplitudes
    covariance: FloatArray  # (2 m, 2 m), of these
    left_over_m: float  # heights, rms, that correspond to the residual slopes
    explained: float  # share of the energy of the slopes

    def at(self, nodes: Nodes, time_s: float) -> tuple[FloatArray, FloatArray]:
        """Return heights above the level and their standard errors, each of shape (n,)."""
        angle = nodes.local @ self.number.T - self.frequency * time_s
        size = np.hypot(*self.number.T)
        basis = np.hstack([np.cos(angle) / size, np.sin(angle) / size])
        variance = ((basis @ self.covariance) * basis).sum(axis=1)
        return basis @ self.slope, np.sqrt(np.maximum(variance, 0.0) + self.left_over_m**2)


def fit_waves(
    nodes: Nodes, slope: FloatArray, weight: FloatArray, time_s: FloatArray, depth_m: float
) -> Waves:
    """Fit plane waves to slopes, (f, n, 2), with weights, (f, n), at the times of f frames."""
    shell, chosen, residual = _Shell(nodes, weight, time_s, depth_m), np.empty(0, np.int64), slope
    found, covariance = np.empty(0), np.empty((0, 0))
    left = float((weight[..., None] * slope**2).sum())
    total = max(left, 1e-30)
    for _ in range(6):
        # the 40 with most energy that are not chosen, well above that of white noise
        energy = shell.energy(residual)
        energy[chosen] = 0.0
        more = np.argsort(-energy, kind="stable")[:40]
        more = more[energy[more] > 8.0 * shell.white(residual)]
        if not len(more):
            break
        chosen = np.concatenate([chosen, more])
        found, covariance, residual = shell.solved(slope, chosen)
        before, left = left, float((weight[..., None] * residual**2).sum())
        if before - left < 0.003 * total:
            break  # hardly more is explained
    # residuals that are not white make the covariance larger
    energy = np.delete(shell.energy(residual), chosen)
    redness = max(1.0, float(energy.mean()) / max(shell.white(residual), 1e-30))
    return Waves(
        shell.number[chosen], shell.frequency[chosen], found, covariance * redness,
        shell.height_rms(residual), 1.0 - left / total,
    )  # fmt: skip


class _Shell:
    """The possible waves, whose frequencies follow from the dispersion relation."""

    def __init__(
        self, nodes: Nodes, weight: FloatArray, time_s: FloatArray, depth_m: float
    ) -> None:
        self._local, self._weight, self._time_s = nodes.local, weight, time_s
        cell_m, self._height = nodes.lattice.resolution_m, nodes.lattice.height
        # padded to twice the size, so that waves twice as long as the raster have a number
        rows, columns = 2 * nodes.lattice.height, 2 * nodes.lattice.width
        x = 2.0 * np.pi * np.fft.fftfreq(columns, cell_m)
        y = -2.0 * np.pi * np.fft.fftfreq(rows, cell_m)  # rows go south
        every = np.stack(np.meshgrid(x, y), axis=2).reshape(-1, 2)
        size = np.hypot(*every.T)
        least, most = (2.0 * np.pi / (cells * cell_m) for cells in (max(rows, columns), 3.0))
        may = (size >= least) & (size <= most)
        self._rows, self._shape = np.flatnonzero(may), (rows, columns)
        self.number, self._size = every[may], size[may]
        self.frequency = np.sqrt(9.81 * self._size * np.tanh(self._size * depth_m))

    def _transformed(self, slope: FloatArray, weight: FloatArray) -> npt.NDArray[np.complex128]:
        """Return the slopes of f frames along each wave number, as Fourier coefficients, (f, m)."""
        planes = (slope * weight[..., None]).transpose(0, 2, 1)
        planes = planes.reshape(len(slope), 2, self._height, -1)
        spectrum = np.fft.fft2(planes, s=self._shape).reshape(len(slope), 2, -1)[..., self._rows]
        return np.asarray((self.number.T * spectrum).sum(axis=1) / self._size)

    def energy(self, slope: FloatArray) -> FloatArray:
        """Return the energy of slopes, shape (f, n, 2), at each wave number."""
        # turned back by each frame's phase, so that a wave of the right frequency adds up
        turn = np.exp(1j * self._time_s[:, None] * self.frequency)
        return np.abs((self._transformed(slope, self._weight) * turn).sum(axis=0)) ** 2

    def white(self, slope: FloatArray) -> float:
        """Return the energy at each wave number if the slopes were white noise."""
        return float(((self._weight[..., None] * slope) ** 2).sum()) / 2.0

    def height_rms(self, residual: FloatArray) -> float:
        """Integrate residual slopes to heights, rms, by the method of Frankot & Chellappa."""
        known = (self._weight > 0.0).astype(np.float64)
        squares = np.abs(self._transformed(residual, known) / self._size) ** 2
        cells = np.prod(self._shape) * max(float(known.sum()), 1.0)
        return float(np.sqrt(squares.sum() / cells))

    def _bases(self, rows: IntArray, chosen: IntArray) -> Iterator[FloatArray]:
        """Yield the slopes along unit waves, cosines then sines, at some nodes of each frame.

        The mean over the frames is subtracted, as the median image keeps it.
        """
        place = np.exp(1j * (self._local[rows] @ self.number[chosen].T))
        turn = np.exp(-1j * self._time_s[:, None] * self.frequency[chosen])
        turn -= turn.mean(axis=0)
        for one in turn:
            wave = place * one
            yield np.hstack([-wave.imag, wave.real])

    def solved(
        self, slope: FloatArray, chosen: IntArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Fit waves to the slopes of all frames by least squares, with a prior of their variance.

        Returns the amplitudes of the slope, their covariance, and the residuals.
        """
        # slopes lie along the wave number: a wave of unit slope has its two components `along`
        along = np.tile(self.number[chosen] / self._size[chosen, None], (2, 1))
        gram, right = np.zeros((len(along), len(along))), np.zeros(len(along))
        used = np.flatnonzero((self._weight > 0.0).any(axis=0))
        for basis, one, weight in zip(self._bases(used, chosen), slope, self._weight, strict=True):
            weighted = basis * weight[used, None]
            gram += basis.T @ weighted
            right += ((weighted.T @ one[used]) * along).sum(axis=1)
        gram *= along @ along.T
        count = max(float(self._weight.sum()), 1e-30)
        prior = float((self._weight[..., None] * slope**2).sum()) / count
        residual, noise = slope.copy(), 0.1 * prior
        for _ in range(2):  # first with a guess of the noise, then with that of the residuals
            covariance = np.linalg.inv(gram + (noise / prior) * np.eye(len(along)))
            found = covariance @ right
            for basis, left, one in zip(self._bases(used, chosen), residual, slope, strict=True):
                left[used] = one[used] - basis @ (found[:, None] * along)
            noise = float((self._weight[..., None] * residual**2).sum()) / (2.0 * count)
        return found, np.asarray(covariance * noise, np.float64), residual
