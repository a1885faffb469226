"""Tables and figures of two papers: refraction in a stereo pair, and Hsu & Wang's bowl.

    python -m tests.papers.refraction_effect OUT_DIR [--heights 100 200]

Figures 4 to 6 of Skarlatos & Agrafiotis (2018), "A Novel Iterative Water Refraction Correction
Algorithm for Use in Structure from Motion Photogrammetric Pipeline", JMSE 6(3) 77: the error of the
apparent depth over the model of two vertical images, by the method `snell`.

The paper gives one pair of numbers: SwingletCAM from 100 m, 80 % overlap, apparent depth 15 m:
-8.23 m in the corners of the model and -5.15 m in its centre. This reading gives both (-8.232,
-5.147): the flying height is above the water, where the printed footprint is 144 m x 108 m with
pixels of 0.036 m, so that the pixel of 1.55 um is one of 1.548 um; the base is the free part of the
short side at the water; n = 1.3405 is not printed but fitted to the two numbers.

Shan's iteration (1994) follows eqs 1 to 7 of the same paper: the collinearity equations hold for
the point on the vertical through the true point that lies 1/s as deep, with

    s = tan a / tan b = sqrt(n^2 + (n^2 - 1) tan^2 a),    tan a = R / (Z_o - Z / s).
"""

import argparse
import csv
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

import pcfix
from pcfix.report.page import AFTER, BEFORE, WATER, new_figure, png_of
from tests.papers import hsu_wang
from tests.utils.bed_rays import piercing_points

DEPTHS_M = tuple(float(depth) for depth in range(16))
PAPER_INDEX = 1.3405


class AerialCamera(NamedTuple):
    """A nadir frame camera; its rows are the pixels along the flight, the short side."""

    name: str
    focal_mm: float
    columns: int
    rows: int
    pixel_um: float

    def footprint_m(self, flying_height_m):
        """Return the sides of an image on the water, along the flight and across it."""
        scale = flying_height_m * self.pixel_um * 1e-3 / self.focal_mm
        return self.rows * scale, self.columns * scale


SWINGLETCAM = AerialCamera("SwingletCAM", 4.3, 4000, 3000, 1.548)
# Of the paper's second camera only the 100.5 mm are printed; the frame is the UltraCamX's.
ULTRACAM = AerialCamera("UltraCamX", 100.5, 14430, 9420, 7.2)
# Flying heights and overlaps of Figures 5 and 6.
FLIGHTS = {SWINGLETCAM: ((100.0, 200.0), (0.8,)), ULTRACAM: ((1000.0, 3000.0), (0.6, 0.8))}


class StereoPair(NamedTuple):
    """Two nadir images of one strip; x is along the flight, 0 on the water between them."""

    camera: AerialCamera
    flying_height_m: float
    overlap: float = 0.8

    @property
    def base_m(self):
        return (1.0 - self.overlap) * self.camera.footprint_m(self.flying_height_m)[0]

    @property
    def model_m(self):
        """Sides of the overlap on the water, along the flight and across it."""
        along, across = self.camera.footprint_m(self.flying_height_m)
        return along - self.base_m, across

    @property
    def centres(self):
        half = self.base_m / 2.0
        return np.array([[-half, 0.0, self.flying_height_m], [half, 0.0, self.flying_height_m]])


class Effect(NamedTuple):
    """Apparent minus true depth over the model of a pair, a row for each y."""

    pair: StereoPair
    depth_m: float
    x_m: np.ndarray
    y_m: np.ndarray
    error_m: np.ndarray
    shift_m: np.ndarray

    @property
    def centre_m(self):
        return float(self.error_m[len(self.y_m) // 2, len(self.x_m) // 2])

    @property
    def corner_m(self):
        return float(self.error_m[0, 0])


def effect(pair, depth_m, index=1.34, nodes=61):
    """Return the error of a level apparent bed over the whole model; `nodes` is odd."""
    x, y = (np.linspace(-side / 2.0, side / 2.0, nodes) for side in pair.model_m)
    plan = np.stack(np.meshgrid(x, y), axis=-1)
    apparent = np.dstack([plan, np.full(plan.shape[:2], -depth_m)])
    cameras = pcfix.Cameras(("left", "right"), pair.centres)
    options = {"index": index, "method": "snell", "max_angle": None, "deep": True}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pcfix.PcfixWarning)
        true = pcfix.correct_points(apparent.reshape(-1, 3), cameras, 0.0, **options).xyz
    true = true.reshape(apparent.shape)
    shift = np.linalg.norm(true[..., :2] - plan, axis=-1)
    return Effect(pair, depth_m, x, y, depth_m + true[..., 2], shift)


class Iteration(NamedTuple):
    """Residuals of the depth over the model: mean, largest with its sign, change of tan a."""

    number: int
    mean_m: float
    max_m: float
    change: float


def shan_iterations(pair, true_depth_m, n=1.34, nodes=21):
    """Return the residuals of each of Shan's iterations over a level bed, from exact images."""
    share = (np.arange(nodes) - (nodes - 1) / 2.0) / max(nodes - 1, 1)
    x, y = (side.ravel() for side in np.meshgrid(*(side * share for side in pair.model_m)))
    bed = np.column_stack([x, y, np.full(len(x), -true_depth_m)])
    images = [
        ((piercing_points(bed, np.tile(c, (len(bed), 1)), 0.0, n) - c) / c[2])[:, :2]
        for c in pair.centres
    ]
    s, tangent, table = np.ones((len(bed), 2)), np.full((len(bed), 2), np.nan), []
    while len(table) < 50:
        # eq 3: X - u D / s = X_s + u H and its like in y, for X, Y and depth D
        system, right = np.zeros((len(bed), 4, 3)), np.empty((len(bed), 4))
        for row in range(4):
            image, axis = divmod(row, 2)
            u = images[image][:, axis]
            system[:, row, axis], system[:, row, 2] = 1.0, -u / s[:, image]
            right[:, row] = pair.centres[image, axis] + u * pair.flying_height_m
        turned = system.transpose(0, 2, 1)
        point = np.linalg.solve(turned @ system, turned @ right[:, :, None])[:, :, 0]
        away = np.linalg.norm(point[:, None, :2] - pair.centres[:, :2], axis=2)
        before, tangent = tangent, away / (pair.flying_height_m + point[:, 2:] / s)
        change = float(np.abs(tangent - before).max())
        residual = point[:, 2] - true_depth_m
        worst = residual[np.abs(residual).argmax()]
        table.append(Iteration(len(table), float(residual.mean()), float(worst), change))
        if change < 1e-9:
            break
        s = np.sqrt(n**2 + (n**2 - 1.0) * tangent**2)
    return table


def effect_rows(effects, index):
    """Return a row per pair and depth; factors are true over apparent depth."""
    return [
        {
            "camera": one.pair.camera.name, "focal_mm": one.pair.camera.focal_mm,
            "flying_height_m": one.pair.flying_height_m, "overlap": one.pair.overlap,
            "base_m": round(one.pair.base_m, 4), "refractive_index": index,
            "apparent_depth_m": one.depth_m, "error_centre_m": _rounded(one.centre_m),
            "error_corner_m": _rounded(one.corner_m), "error_mean_m": _rounded(one.error_m.mean()),
            "true_depth_centre_m": _rounded(one.depth_m - one.centre_m),
            "true_depth_corner_m": _rounded(one.depth_m - one.corner_m),
            "factor_centre": _rounded(1.0 - one.centre_m / one.depth_m) if one.depth_m else "",
            "factor_corner": _rounded(1.0 - one.corner_m / one.depth_m) if one.depth_m else "",
            "largest_shift_xy_m": _rounded(one.shift_m.max()),
        }
        for one in effects
    ]  # fmt: skip


def _rounded(value):
    return round(float(value), 5) + 0.0


def shan_rows(pair, table):
    return [
        {
            "camera": pair.camera.name, "flying_height_m": pair.flying_height_m,
            "overlap": pair.overlap, "iteration": one.number,
            "mean_residual_m": float(f"{one.mean_m:.4g}"),
            "max_residual_m": float(f"{one.max_m:.4g}"),
            "change_tan_a": "" if np.isnan(one.change) else float(f"{one.change:.4g}"),
        }
        for one in table
    ]  # fmt: skip


def surfaces_figure(effects, *, beds):
    """Draw the error at every depth (Figs 5, 6), or with `beds` both beds at one (Fig 4)."""
    pairs = list(dict.fromkeys(one.pair for one in effects))
    figure, panels = new_figure(
        1.6 + 4.2 * len(pairs), 5.0, ncols=len(pairs), squeeze=False,
        subplot_kw={"projection": "3d"},
    )  # fmt: skip
    for axes, pair in zip(panels[0], pairs, strict=True):
        for one in effects:
            drawn = [(one.error_m, WATER)]
            if beds:
                drawn = [(one.error_m, BEFORE), (np.full_like(one.error_m, -one.depth_m), WATER),
                         (one.error_m - one.depth_m, AFTER)]  # fmt: skip
            for z, colour in drawn if one.pair == pair else ():
                axes.plot_surface(*np.meshgrid(one.x_m, one.y_m), z, color=colour, shade=False)
        axes.set(title=f"{pair.flying_height_m:g} m, overlap {pair.overlap:.0%}")
        axes.set(xlabel="Along (m)", ylabel="Across (m)", zlabel="Height (m)")
    figure.suptitle(pairs[0].camera.name + (": difference, apparent, true bed" if beds else ""))
    return png_of(figure)


def write_all(folder, heights=None, bowl=None):
    """Write the tables and figures of both papers, and return the effects."""
    pairs = [
        StereoPair(camera, height, overlap)
        for camera, (usual, overlaps) in FLIGHTS.items()
        for overlap in overlaps
        for height in heights or usual
    ]
    effects = [effect(pair, depth, PAPER_INDEX) for pair in pairs for depth in DEPTHS_M]
    deepest = DEPTHS_M[-1]
    bins = hsu_wang.bowl_bins(bowl or hsu_wang.simulate_bowl())
    shan = [
        row
        for pair in pairs
        for row in shan_rows(pair, shan_iterations(pair, deepest, PAPER_INDEX))
    ]
    tables = {
        "refraction_effect": effect_rows(effects, PAPER_INDEX), "shan_iterations": shan,
        "bowl_depth_bins": hsu_wang.rows_of(bins),
    }  # fmt: skip
    folder.mkdir(exist_ok=True)
    for name, rows in tables.items():
        with (folder / f"{name}.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    for camera in FLIGHTS:
        own = [one for one in effects if one.pair.camera == camera]
        stem = f"refraction_effect_{camera.name.lower()}"
        deep = [one for one in own if one.depth_m == deepest]
        (folder / f"{stem}_bed.png").write_bytes(surfaces_figure(deep, beds=True))
        (folder / f"{stem}_stack.png").write_bytes(surfaces_figure(own, beds=False))
    return effects


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--heights", type=float, nargs="*", help="flying heights, metres")
    given = parser.parse_args()
    for one in write_all(given.folder, given.heights):
        if one.depth_m == DEPTHS_M[-1]:
            print(
                f"{one.pair.camera.name:<12} {one.pair.flying_height_m:g} m,"
                f" {one.pair.overlap:.0%}: apparent minus true depth {one.centre_m:.3f} m,"
                f" {one.corner_m:.3f} m in the corners"
            )
