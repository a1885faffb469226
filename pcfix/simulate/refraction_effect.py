"""How far refraction puts a point wrong in a pair of vertical images, before any correction.

Remakes Figures 4 to 6 of Skarlatos & Agrafiotis (2018), "A Novel Iterative Water Refraction
Correction Algorithm for Use in Structure from Motion Photogrammetric Pipeline", JMSE 6(3) 77:
the error of the apparent depth over the model of two vertical images. Nothing here is shared
with the correction; that the two agree is for a test to say.

What the paper gives to check against is one pair of numbers: with the SwingletCAM from 100 m, 80 %
overlap and an apparent depth of 15 m, -8.23 m in the corners of the model and -5.15 m in its
centre. The reading that gives both (-8.232 m and -5.147 m):

- The flying height is above the water, where the footprint is that which is printed, 144 m x 108 m,
  pixels of 0.036 m. The lens and the 1.55 um printed make it 144.19 m x 108.14 m, which gives both
  numbers for no index; so the pixel is taken as 1.548 um, which rounds to that.
- The base is the free part of the short side at the water: 21.6 m. The model is the overlap of the
  two footprints there, and its apparent bed is level: x and y of a corner are 43.2 m and 72 m from
  the centre, and z is -15 m there.
- n = 1.3405. It is not printed but fitted to the two: they come out from 1.3404 to 1.3406. So that
  they agree says that one n explains both, not that it was the authors'.
- The true point is that of eqs 8 to 11: the least squares of eq 11 for two rays are the midpoint of
  the shortest line between them.
- The error is the apparent depth minus the true depth, so a minus says: too shallow.

How fast the iteration of Shan (1994), "Relief reconstruction using two-media photogrammetry", finds
the depth is reckoned as the same paper gives it (eqs 1 to 7): the true point A and its image do
not fit the collinearity equations, but the point on the vertical through A does that lies 1/s as
deep, where

    s = tan a / tan b = sqrt(n^2 + (n^2 - 1) tan^2 a),    tan a = R / (Z_o - Z / s),

a the angle in air, b that in water, R the distance in plan. Each image has its own s, so a pair
gives the 4 equations of eq 3 for X, Y, depth and two s; with s known they are linear. The iteration
starts with s = 1, the point that software makes that knows nothing of water, takes tan a from the
point found, and solves again, until tan a no longer changes. (Where that departs from the print:
`pcfix.refract.literature.shan`.)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pcfix.errors import SettingError
from pcfix.model import FloatArray
from pcfix.options.correct import ScienceOptions
from pcfix.options.shared import DEFAULT_REFRACTIVE_INDEX
from pcfix.simulate.tracing import piercing_points

NODES = 61
"""Nodes of a model along its flight and across it; odd, so that the centre is one."""
OVERLAP = 0.8
APPARENT_DEPTHS_M = tuple(float(depth) for depth in range(16))
PAPER_INDEX = 1.3405
"""Not printed: fitted to the two errors that are."""


@dataclass(frozen=True)
class AerialCamera:
    """A frame camera that looks straight down, the short side of its frame along the flight.

    Its columns are the pixels across the flight, its rows those along it.
    """

    name: str
    focal_mm: float
    columns: int
    rows: int
    pixel_um: float

    def __post_init__(self) -> None:
        """Check that the camera can take an image."""
        names = "focal length", "number of columns", "number of rows", "pixel size"
        values = self.focal_mm, self.columns, self.rows, self.pixel_um
        for what, value in zip(names, values, strict=True):
            if not (np.isfinite(value) and value > 0):
                raise SettingError(f"{what} {value:g} of the camera is not above 0.")

    def footprint_m(self, flying_height_m: float) -> tuple[float, float]:
        """Return the sides of an image on the water, along the flight and across it."""
        scale = flying_height_m * self.pixel_um * 1e-3 / self.focal_mm
        return self.rows * scale, self.columns * scale


SWINGLETCAM = AerialCamera("SwingletCAM", 4.3, 4000, 3000, 1.548)
ULTRACAM = AerialCamera("UltraCamX", 100.5, 14430, 9420, 7.2)
"""Of the paper's second camera only the 100.5 mm are printed; the frame is the UltraCamX's."""

FLYING_HEIGHTS_M: dict[AerialCamera, tuple[float, ...]] = {
    SWINGLETCAM: (100.0, 200.0),
    ULTRACAM: (1000.0, 3000.0),
}
OVERLAPS: dict[AerialCamera, tuple[float, ...]] = {SWINGLETCAM: (0.8,), ULTRACAM: (0.6, 0.8)}
"""Of Figures 5 and 6; heights above the water."""


@dataclass(frozen=True)
class StereoPair:
    """Two vertical images of one strip, level with each other; x runs along the flight.

    The origin lies on the water surface, midway between the two.
    """

    camera: AerialCamera
    flying_height_m: float
    overlap: float = OVERLAP

    def __post_init__(self) -> None:
        """Check that the two images overlap."""
        if not (np.isfinite(self.flying_height_m) and self.flying_height_m > 0.0):
            raise SettingError(f"flying height {self.flying_height_m:g} m is not above 0.")
        if not 0.0 < self.overlap < 1.0:
            raise SettingError(
                f"overlap {self.overlap:g} is not between 0 and 1; give a share, as 0.8."
            )

    @property
    def base_m(self) -> float:
        """Distance between the projection centres."""
        return (1.0 - self.overlap) * self.camera.footprint_m(self.flying_height_m)[0]

    @property
    def model_m(self) -> tuple[float, float]:
        """Sides of the overlap on the water, along the flight and across it."""
        along, across = self.camera.footprint_m(self.flying_height_m)
        return along - self.base_m, across

    @property
    def centres(self) -> FloatArray:
        """Projection centres, metres, shape (2, 3)."""
        half = self.base_m / 2.0
        return np.array([[-half, 0.0, self.flying_height_m], [half, 0.0, self.flying_height_m]])


@dataclass(frozen=True, eq=False)
class Effect:
    """The effect of refraction over one model.

    x_m, y_m : shape (nodes,), along the flight and across it, from the centre of the model.
    error_m : shape (nodes, nodes), apparent depth minus true depth; a row has one y.
    shift_m : shape (nodes, nodes), how far in plan the apparent point lies from the true one.
    """

    pair: StereoPair
    apparent_depth_m: float
    refractive_index: float
    x_m: FloatArray
    y_m: FloatArray
    error_m: FloatArray
    shift_m: FloatArray

    @property
    def centre_m(self) -> float:
        """The error in the centre of the model."""
        middle = len(self.x_m) // 2
        return float(self.error_m[middle, middle])

    @property
    def corner_m(self) -> float:
        """The error in a corner; all four are alike."""
        return float(self.error_m[0, 0])

    @property
    def mean_m(self) -> float:
        """The mean error of the nodes."""
        return float(self.error_m.mean())


def effect(
    pair: StereoPair,
    apparent_depth_m: float,
    refractive_index: float = DEFAULT_REFRACTIVE_INDEX,
    nodes: int = NODES,
) -> Effect:
    """Return the error of a level apparent bed over the whole model of a pair.

    Raises
    ------
    SettingError
        If the depth is not above 0 and finite, or the refractive index is outside its rule.
    """
    _check_depths((apparent_depth_m,))
    return _over_model(pair, apparent_depth_m, refractive_index, nodes)


def _check_depths(apparent_depths_m: tuple[float, ...]) -> None:
    """Refuse depths that are none, and the water's surface alone."""
    wrong = [depth for depth in apparent_depths_m if not 0.0 <= depth < np.inf]
    if wrong or not any(apparent_depths_m):
        raise SettingError(
            f"apparent depth {[*wrong, 0.0][0]:g} m is not finite and above 0: give metres under"
            " the water, and 0 only beside others."
        )


def _over_model(pair: StereoPair, apparent_depth_m: float, index: float, nodes: int) -> Effect:
    ScienceOptions(index=index)
    along, across = pair.model_m
    x = np.linspace(-along / 2.0, along / 2.0, nodes | 1)
    y = np.linspace(-across / 2.0, across / 2.0, nodes | 1)
    plan = np.stack(np.meshgrid(x, y), axis=-1)
    apparent = np.dstack([plan, np.full(plan.shape[:2], -apparent_depth_m)])
    true = true_points(apparent, pair.centres, index)
    return Effect(
        pair=pair,
        apparent_depth_m=apparent_depth_m,
        refractive_index=index,
        x_m=x,
        y_m=y,
        error_m=apparent_depth_m + true[..., 2],
        shift_m=np.hypot(*np.moveaxis(true[..., :2] - plan, -1, 0)),
    )


def true_points(apparent: FloatArray, centres: FloatArray, refractive_index: float) -> FloatArray:
    """Return the true points of apparent ones that two images gave.

    The lines of sight to the apparent point are broken at the water, z = 0; the true point is the
    midpoint of the shortest line between the two in the water. Shape (..., 3), metres, z negative.
    """
    (first, a), (second, b) = (_in_water(apparent, c, refractive_index) for c in centres)
    gap = second - first
    cosine, along_a, along_b = ((u * v).sum(axis=-1) for u, v in ((a, b), (gap, a), (gap, b)))
    sine2 = 1.0 - cosine**2
    on_first = first + a * ((along_a - cosine * along_b) / sine2)[..., None]
    on_second = second + b * ((cosine * along_a - along_b) / sine2)[..., None]
    return np.asarray((on_first + on_second) / 2.0)


def _in_water(apparent: FloatArray, centre: FloatArray, n: float) -> tuple[FloatArray, FloatArray]:
    """Return where a line of sight meets the water and its unit direction below it.

    At a level surface the horizontal part of the direction shrinks by n: that is Snell's law.
    """
    sight = apparent - centre
    surface = centre + sight * (centre[2] / -sight[..., 2])[..., None]
    down = sight / np.linalg.norm(sight, axis=-1, keepdims=True) / n
    down[..., 2] = -np.sqrt(1.0 - down[..., 0] ** 2 - down[..., 1] ** 2)
    return surface, down


def effects(
    pairs: list[StereoPair],
    apparent_depths_m: tuple[float, ...],
    refractive_index: float = DEFAULT_REFRACTIVE_INDEX,
) -> list[Effect]:
    """Return the effect of every pair and apparent depth; 0 among several is the water's surface.

    Raises
    ------
    SettingError
        As `effect`.
    """
    _check_depths(apparent_depths_m)
    return [
        _over_model(pair, depth, refractive_index, NODES)
        for pair in pairs
        for depth in apparent_depths_m
    ]


TOLERANCE = 1e-9
"""Of tan a, between two iterations."""
_MOST_ITERATIONS = 50


class Iteration(NamedTuple):
    """Residuals of the depth, estimate minus truth, over the model after one iteration."""

    number: int
    mean_m: float
    max_m: float
    """The largest, with its sign."""
    change: float
    """The largest change of tan a since the iteration before; NaN for the first two."""


def shan_iterations(
    pair: StereoPair,
    true_depth_m: float,
    refractive_index: float = DEFAULT_REFRACTIVE_INDEX,
    nodes: int = 21,
) -> list[Iteration]:
    """Return the residuals of every iteration over a level bed of known depth.

    The images have no noise and are traced through the water from the true bed, `nodes` along
    the model and as many across it.
    """
    bed = _bed(pair.model_m, true_depth_m, nodes)
    slopes = np.stack([_slopes(bed, c, refractive_index) for c in pair.centres], axis=1)
    s, tangent, table = np.ones(slopes.shape[:2]), None, []
    for number in range(_MOST_ITERATIONS):
        point = _intersected(slopes, s, pair.centres)
        following = _tangents(point, s, pair.centres)
        change = np.nan if tangent is None else float(np.abs(following - tangent).max())
        residual = point[:, 2] - true_depth_m
        worst = residual[np.abs(residual).argmax()]
        table.append(Iteration(number, float(residual.mean()), float(worst), change))
        if change < TOLERANCE:
            break
        tangent = following
        s = np.sqrt(refractive_index**2 + (refractive_index**2 - 1.0) * tangent**2)
    return table


def _bed(model_m: tuple[float, float], depth_m: float, nodes: int) -> FloatArray:
    """Return the nodes of a level bed, shape (nodes squared, 3); a single one is in the centre."""
    share = (np.arange(nodes) - (nodes - 1) / 2.0) / max(nodes - 1, 1)
    x, y = (side.ravel() for side in np.meshgrid(model_m[0] * share, model_m[1] * share))
    return np.column_stack([x, y, np.full(len(x), -depth_m)])


def _slopes(bed: FloatArray, centre: FloatArray, n: float) -> FloatArray:
    """Return what an image measures: metres in x and y per metre down, shape (m, 2)."""
    surface = piercing_points(bed, np.broadcast_to(centre, bed.shape), 0.0, n)
    return np.asarray((surface - centre)[:, :2] / centre[2])


def _intersected(slopes: FloatArray, s: FloatArray, centres: FloatArray) -> FloatArray:
    """Solve X - u D / s = X_s + u H and its like in y for X, Y and depth D, shape (m, 3)."""
    system = np.zeros((len(slopes), 4, 3))
    right = np.empty((len(slopes), 4))
    for image, centre in enumerate(centres):
        for axis in range(2):
            row, u = 2 * image + axis, slopes[:, image, axis]
            system[:, row, axis] = 1.0
            system[:, row, 2] = -u / s[:, image]
            right[:, row] = centre[axis] + u * centre[2]
    turned = system.transpose(0, 2, 1)
    return np.asarray(np.linalg.solve(turned @ system, turned @ right[:, :, None])[:, :, 0])


def _tangents(point: FloatArray, s: FloatArray, centres: FloatArray) -> FloatArray:
    """Return tan a of each image, shape (m, 2)."""
    away = np.hypot(
        point[:, None, 0] - centres[None, :, 0], point[:, None, 1] - centres[None, :, 1]
    )
    return np.asarray(away / (centres[None, :, 2] + point[:, None, 2] / s))
