"""The effect of refraction in a pair of vertical images, before any correction.

Remakes Figures 4 to 6 of Skarlatos & Agrafiotis (2018), "A Novel Iterative Water Refraction
Correction Algorithm for Use in Structure from Motion Photogrammetric Pipeline", JMSE 6(3) 77: the
error of the apparent depth over the model of two vertical images. Nothing is shared with the
correction; a test compares the two.

The paper gives one pair of numbers: SwingletCAM from 100 m, 80 % overlap, apparent depth 15 m:
-8.23 m in the corners of the model and -5.15 m in its centre. This reading gives both (-8.232,
-5.147):

- The flying height is above the water, where the printed footprint is 144 m x 108 m with pixels of
  0.036 m. The printed 1.55 um would give 144.19 m x 108.14 m, which fits both numbers for no index;
  so the pixel is 1.548 um, which rounds to that.
- The base is the free part of the short side at the water, 21.6 m. The model is the overlap of the
  footprints there, and its apparent bed is level.
- n = 1.3405, which is not printed but fitted; both numbers come out from 1.3404 to 1.3406.
- The true point is that of eqs 8 to 11: for two rays, the midpoint of the shortest line between
  them.
- The error is the apparent minus the true depth; negative means too shallow.

Shan's iteration (1994), "Relief reconstruction using two-media photogrammetry", follows eqs 1 to 7
of the same paper: the collinearity equations hold for the point on the vertical through the true
point that lies 1/s as deep, where

    s = tan a / tan b = sqrt(n^2 + (n^2 - 1) tan^2 a),    tan a = R / (Z_o - Z / s),

with a the angle in air, b in water, R the distance in plan. Each image has its own s, so a pair
gives the 4 equations of eq 3 for X, Y, depth and two s; with s known they are linear. It starts
with s = 1 and repeats until tan a no longer changes. (`pcfix.refract.literature` notes a misprint.)
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
"""Nodes of a model along the flight and across; odd, so that the centre is one."""
OVERLAP = 0.8
APPARENT_DEPTHS_M = tuple(float(depth) for depth in range(16))
PAPER_INDEX = 1.3405
"""Not printed: fitted to the two errors that are."""
TOLERANCE, _MOST_ITERATIONS = 1e-9, 50
"""Of tan a, between two of Shan's iterations, and their number."""


def _check_positive(what: str, value: float) -> None:
    if not (np.isfinite(value) and value > 0):
        raise SettingError("option.range", f"{what} {value:g} is not above 0.", value=value)


@dataclass(frozen=True)
class AerialCamera:
    """A nadir frame camera; its rows are the pixels along the flight, the short side."""

    name: str
    focal_mm: float
    columns: int
    rows: int
    pixel_um: float

    def __post_init__(self) -> None:
        """Check that the camera can take an image."""
        for what in ("focal_mm", "columns", "rows", "pixel_um"):
            _check_positive(f"The camera's {what}", getattr(self, what))

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
    """Two nadir images of one strip; x is along the flight, 0 on the water between them."""

    camera: AerialCamera
    flying_height_m: float
    overlap: float = OVERLAP

    def __post_init__(self) -> None:
        """Check that the two images overlap."""
        _check_positive("Flying height", self.flying_height_m)
        if not 0.0 < self.overlap < 1.0:
            raise SettingError(
                "option.range",
                f"Overlap {self.overlap:g} is not between 0 and 1. Give a share, such as 0.8.",
                value=self.overlap,
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

    `x_m` and `y_m` are the nodes along the flight and across; `error_m`, apparent minus true depth,
    and `shift_m`, the distance in plan, have a row for each y.
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
    """Return the error of a level apparent bed over the whole model of a pair."""
    if not 0.0 <= apparent_depth_m < np.inf:
        raise SettingError(
            "option.range",
            f"Apparent depth {apparent_depth_m:g} m is negative or infinite.",
            value=apparent_depth_m,
        )
    ScienceOptions(index=refractive_index)
    along, across = pair.model_m
    x = np.linspace(-along / 2.0, along / 2.0, nodes | 1)
    y = np.linspace(-across / 2.0, across / 2.0, nodes | 1)
    plan = np.stack(np.meshgrid(x, y), axis=-1)
    apparent = np.dstack([plan, np.full(plan.shape[:2], -apparent_depth_m)])
    true = true_points(apparent, pair.centres, refractive_index)
    error = apparent_depth_m + true[..., 2]
    shift = np.hypot(*np.moveaxis(true[..., :2] - plan, -1, 0))
    return Effect(pair, apparent_depth_m, refractive_index, x, y, error, shift)


def effects(
    pairs: list[StereoPair],
    apparent_depths_m: tuple[float, ...],
    refractive_index: float = DEFAULT_REFRACTIVE_INDEX,
) -> list[Effect]:
    """Return the effect for every pair and apparent depth, of which one must be above 0."""
    if not any(apparent_depths_m):
        raise SettingError("option.range", "Give an apparent depth above 0.", value=0.0)
    return [effect(pair, depth, refractive_index) for pair in pairs for depth in apparent_depths_m]


def true_points(apparent: FloatArray, centres: FloatArray, refractive_index: float) -> FloatArray:
    """Return the true points of apparent ones, shape (..., 3), metres, z negative.

    The straight rays to the apparent point are refracted at the water, z = 0; the true point is the
    midpoint of the shortest line between the two in the water.
    """
    (first, a), (second, b) = (_in_water(apparent, c, refractive_index) for c in centres)
    gap = second - first
    cosine, along_a, along_b = ((u * v).sum(axis=-1) for u, v in ((a, b), (gap, a), (gap, b)))
    sine2 = 1.0 - cosine**2
    on_first = first + a * ((along_a - cosine * along_b) / sine2)[..., None]
    on_second = second + b * ((cosine * along_a - along_b) / sine2)[..., None]
    return np.asarray((on_first + on_second) / 2.0)


def _in_water(apparent: FloatArray, centre: FloatArray, n: float) -> tuple[FloatArray, FloatArray]:
    """Return the piercing point of a ray and its unit direction in the water.

    At a level surface the horizontal part of the direction shrinks by n (Snell's law).
    """
    sight = apparent - centre
    surface = centre + sight * (centre[2] / -sight[..., 2])[..., None]
    down = sight / np.linalg.norm(sight, axis=-1, keepdims=True) / n
    down[..., 2] = -np.sqrt(1.0 - down[..., 0] ** 2 - down[..., 1] ** 2)
    return surface, down


class Iteration(NamedTuple):
    """Residuals of the depth, estimate minus truth, over the model after one iteration.

    `max_m` is the largest, with its sign; `change` is the largest change of tan a since the
    iteration before, NaN for the first two.
    """

    number: int
    mean_m: float
    max_m: float
    change: float


def shan_iterations(
    pair: StereoPair,
    true_depth_m: float,
    refractive_index: float = DEFAULT_REFRACTIVE_INDEX,
    nodes: int = 21,
) -> list[Iteration]:
    """Return the residuals of every iteration over a level bed of known depth.

    The images are traced through the water without noise, from `nodes` squared places.
    """
    share = (np.arange(nodes) - (nodes - 1) / 2.0) / max(nodes - 1, 1)
    x, y = (side.ravel() for side in np.meshgrid(*(side * share for side in pair.model_m)))
    bed = np.column_stack([x, y, np.full(len(x), -true_depth_m)])
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
