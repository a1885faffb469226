"""Water surfaces from the cloud alone against the truth: `python -m tests.benchmarks.auto_water`.

Ten random scenes, seeds 0 to 9, every one of them printed; another range as two arguments. The
shape of the ground, noise, colours, floating points, tilt and level are drawn at random; the
cloud is traced through the water and triangulated by `pcfix.simulate`. ``--pictures DIR`` draws
each.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from pcfix.errors import GeometryError
from pcfix.simulate.block import fly_block
from pcfix.simulate.settings import SceneSettings
from pcfix.simulate.tracing import piercing_points, project, triangulate
from pcfix.water.auto import find_water

N = 1.34
HEIGHT_M, DEEPEST_M = 80.0, 12.0
ORIGIN_M = np.array([410_200.0, 4_650_300.0, 0.0])
POINTS = 60_000
_AT_ONCE = 20_000
DRAW_CELL_M = 0.5


@dataclass(frozen=True, eq=False)
class AutoScene:
    """A cloud as SfM software places it, and the water surface that it was traced through."""

    xyz: np.ndarray
    rgb: np.ndarray | None
    centres: np.ndarray
    plane: tuple[float, float, float]
    words: str

    def surface(self, xy: np.ndarray) -> np.ndarray:
        """Return the true height (m) of the water at places (m, 2)."""
        a, b, c = self.plane
        return a + (xy - ORIGIN_M[:2]) @ np.array([b, c])


def random_scene(seed: int) -> AutoScene:
    """Draw a beach, a river or a lake with banks."""
    rng = np.random.default_rng(seed)
    kind = ("beach", "river", "lake")[rng.integers(3)]
    length, width = rng.uniform(70.0, 120.0), rng.uniform(50.0, 90.0)
    level = float(np.round(rng.uniform(-2.0, 300.0), 3))
    slope = float(np.exp(rng.uniform(np.log(0.02), np.log(0.2))))
    tilt = rng.uniform(0.001, 0.005) if kind == "river" else 0.0
    noise_px = rng.uniform(0.3, 0.8)
    coloured, floating, pit = rng.random() < 0.75, rng.random() < 0.4, rng.random() < 0.3
    xy = rng.uniform(0.0, 1.0, (POINTS, 2)) * [length, width]
    ground = _ground(kind, xy, (length, width), slope, pit, rng)
    see_m = rng.uniform(1.5, 8.0)
    kept = rng.random(POINTS) < 1.0 / (1.0 + np.exp(-(ground + see_m) / (0.1 * see_m)))
    truth = np.column_stack([xy, ground])[kept]
    kind_of_block = "oblique" if rng.random() < 0.3 else "nadir"
    flight = SceneSettings(flying_height_m=HEIGHT_M, block=kind_of_block)
    block = fly_block((length, width), flight, rng)
    rgb = _colours(truth, see_m, rng) if coloured else None
    cloud = _apparent(truth, block.cameras, noise_px, rng)
    blurred = np.maximum(-truth[:, 2], 0.0)
    cloud[:, 2] += rng.normal(0.0, 1.0, len(cloud)) * 0.02 * blurred
    if floating:
        share = rng.uniform(0.003, 0.02)
        afloat = (truth[:, 2] < 0.0) & (rng.random(len(truth)) < share)
        cloud[afloat, 2] = rng.normal(0.0, 0.03, afloat.sum())
    cloud[:, 2] += level + tilt * xy[kept, 0 if kind == "river" else 1]
    words = f"{kind}, slope {100 * slope:.0f} %, tilt {100 * tilt:.2f} %, {noise_px:.1f} px"
    words += f", sees {see_m:.1f} m" + ", colours" * coloured + ", floating" * floating
    return AutoScene(
        cloud + ORIGIN_M,
        rgb,
        block.cameras.centres + ORIGIN_M + [0.0, 0.0, level],
        (level, tilt, 0.0),
        words + ", pit" * pit,
    )


def _field(xy: np.ndarray, size: tuple[float, float], wave_m: float, rng) -> np.ndarray:
    """Return a random smooth field of mean 0 and standard deviation 1."""
    shape = tuple(int(side / DRAW_CELL_M) + 40 for side in size)
    smooth = gaussian_filter(rng.normal(size=shape), wave_m / DRAW_CELL_M / 4.0, mode="wrap")
    return map_coordinates(smooth / smooth.std(), xy.T / DRAW_CELL_M, order=1)


def _ground(kind, xy, size, slope, pit, rng) -> np.ndarray:
    """Return the height (m) above the water."""
    x, y = xy.T
    length, width = size
    bend = _field(np.column_stack([x if kind == "river" else y * 0.0, y]), size, 40.0, rng)
    if kind == "river":
        half = rng.uniform(0.15, 0.3) * width
        across = np.abs(y - width / 2.0 - 3.0 * np.sin(x / 25.0 + rng.uniform(0, 6))) - half
        bank, deep = rng.uniform(1.0, 3.0), rng.uniform(0.6, 2.5)
        z = across * slope
        z = np.where(across > 0, bank * np.tanh(z / bank), deep * np.tanh(z / deep))
    elif kind == "lake":
        shore = rng.uniform(0.3, 0.6) * length + 3.0 * bend
        z = (shore - x) * slope
        z += rng.uniform(0.2, 1.0) / (1.0 + np.exp((x - shore + rng.uniform(1.0, 6.0)) / 0.5))
    else:
        shore = rng.uniform(0.3, 0.6) * length + 4.0 * bend
        along = shore - x
        curve = rng.uniform(-0.3, 0.3) * slope / length
        z = along * slope + curve * along * np.abs(along)
        bar = rng.uniform(0.0, 0.3)
        z += bar * np.exp(-(((along + rng.uniform(8.0, 20.0)) / 4.0) ** 2))
    z += rng.uniform(0.02, 0.15) * _field(xy, size, 12.0, rng)
    z += rng.uniform(0.01, 0.05) * _field(xy, size, 3.0, rng)
    z += 0.4 * np.maximum(_field(xy, size, 6.0, rng) - 2.0, 0.0)
    if pit:
        from_pit = np.hypot(x - 0.15 * length, y - rng.uniform(0.3, 0.7) * width)
        z -= (rng.uniform(0.3, 0.8) + 0.15 * length * slope) * np.exp(-((from_pit / 4.0) ** 2))
    return z


def _colours(truth, see_m, rng) -> np.ndarray:
    """Return 16 bit colours: patchy sand or gravel, grass higher up, wet sand, water."""
    size = (float(np.ptp(truth[:, 0])) + 4.0, float(np.ptp(truth[:, 1])) + 4.0)
    xy, z = truth[:, :2] - truth[:, :2].min(axis=0), truth[:, 2]
    sand = np.array([0.42, 0.36, 0.27]) * rng.uniform(0.7, 1.2)
    light = 1.0 + 0.15 * _field(xy, size, 5.0, rng) + 0.15 * _field(xy, size, 1.5, rng)
    tint = 1.0 + 0.04 * np.column_stack([_field(xy, size, 8.0, rng) for _ in range(3)])
    albedo = sand * np.clip(light, 0.2, 2.0)[:, None] * tint
    grass_m = rng.uniform(0.6, 2.0) + 0.3 * _field(xy, size, 15.0, rng)
    green = rng.random() < 0.6
    albedo = np.where(((z > grass_m) & green)[:, None], [0.08, 0.14, 0.05] * tint, albedo)
    weed = (_field(xy, size, 10.0, rng) > 1.2) & (z < -0.5)
    albedo = np.where(weed[:, None], [0.07, 0.09, 0.05] * tint, albedo)
    wet_m = rng.uniform(0.0, 0.25) + 0.03 * _field(xy, size, 6.0, rng)
    albedo = np.where((z < wet_m)[:, None], albedo * rng.uniform(0.55, 0.85), albedo)
    depth = np.maximum(-z, 0.0)[:, None]
    peaty = rng.random() < 0.25
    k = np.array([0.35, 0.10, 0.06]) if not peaty else np.array([0.35, 0.45, 0.9])
    k = k + rng.uniform(0.1, 0.5) / see_m
    veil = np.array([0.02, 0.05, 0.06]) if not peaty else np.array([0.03, 0.02, 0.01])
    seen = albedo * np.exp(-2.0 * k * depth) + veil * (1.0 - np.exp(-2.0 * k * depth))
    seen = seen * rng.normal(1.0, 0.04, (len(truth), 1)) + rng.normal(0.0, 0.008, seen.shape)
    return np.clip(np.clip(seen, 0.0, 1.0) ** (1.0 / 2.2) * 65535.0, 0, 65535).astype(np.uint16)


def _apparent(truth, cameras, noise_px, rng) -> np.ndarray:
    """Return where software that knows nothing of water puts points; water is at z = 0."""
    parts = np.array_split(truth, max(1, len(truth) // _AT_ONCE))
    return np.vstack([_triangulated(part, cameras, noise_px, rng) for part in parts])


def _triangulated(truth, cameras, noise_px, rng) -> np.ndarray:
    optics, reach = SceneSettings().optics.lens, SceneSettings().optics.reach
    across = [truth[:, None, i] - cameras.centres[:, i] for i in (0, 1)]
    off_nadir = np.arccos(np.clip(-cameras.rotations[:, 2, 2], -1.0, 1.0))
    flattest = np.minimum(np.arctan(reach) + off_nadir, np.radians(80.0))
    near_m = 0.5 * (cameras.centres[:, 2] + DEEPEST_M) * np.tan(flattest)
    point, camera = np.nonzero(np.hypot(*across) < near_m)
    pierced = piercing_points(truth[point], cameras.centres[camera], 0.0, N)
    pixels, z = project(pierced, cameras, camera, optics)
    seen = (z > 0) & ((pixels >= 0) & (pixels < [optics.width, optics.height])).all(axis=1)
    seen &= np.bincount(point[seen], minlength=len(truth))[point] >= 3
    point, camera, pixels = point[seen], camera[seen], pixels[seen]
    pixels = pixels + rng.normal(0.0, noise_px, pixels.shape)
    count = np.bincount(point, minlength=len(truth))
    made = count > 0
    start = np.concatenate([[0], np.cumsum(count[made])])
    placed = truth.copy()
    placed[made] = triangulate(pixels, cameras, camera, start, optics, truth[made])
    return placed


def report(seed: int, pictures: Path | None) -> tuple[float, float] | None:
    """Print one scene; return error and standard error in metres, None of a refusal."""
    scene = random_scene(seed)
    clock = time.perf_counter()
    print(f"{seed}: {scene.words}")
    try:
        low = scene.xyz[:, 2] < scene.centres[:, 2].min()
        rgb = None if scene.rgb is None else scene.rgb[low]
        found = find_water(scene.xyz[low], rgb=rgb)
    except GeometryError as refusal:
        print(f"   level {scene.plane[0]:.3f} m: REFUSED. {refusal}")
        return None
    seconds = time.perf_counter() - clock
    truth = float(scene.surface(found.centre_xy[None])[0])
    error = found.level_m - truth
    shore = found.shoreline[:, :2] - found.centre_xy
    worst = found.level_m + shore @ found.tilt - scene.surface(found.shoreline[:, :2])
    print(
        f"   true {truth:.3f} m, found {found.level_m:.3f} m: error {100 * error:+.1f} cm, sigma"
        f" {100 * found.sigma_level_m:.1f} cm, ratio {error / found.sigma_level_m:+.1f}; tilt"
        f" {100 * np.hypot(*found.tilt):.2f} %, at worst {100 * np.abs(worst).max():.1f} cm along"
        f" the shore; confidence {found.confidence:.2f}; {seconds:.1f} s"
    )
    print(f"   {'; '.join(found.reasons)}")
    if pictures is not None:
        from pcfix.report.water import shoreline_figure

        shoreline_figure(found).savefig(pictures / f"auto_{seed}.png", dpi=110)
    return error, found.sigma_level_m


def main() -> None:
    """Print all scenes of a range of seeds, and what they come to."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("first", type=int, nargs="?", default=0)
    arguments.add_argument("last", type=int, nargs="?", default=9)
    arguments.add_argument("--pictures", type=Path)
    given = arguments.parse_args()
    results = [report(seed, given.pictures) for seed in range(given.first, given.last + 1)]
    found = np.array([result for result in results if result is not None]).reshape(-1, 2)
    print(f"{len(found)} found, {len(results) - len(found)} refused", end="")
    if len(found):
        error, ratio = found[:, 0], found[:, 0] / found[:, 1]
        print(
            f"; error RMS {100 * np.sqrt(np.mean(error**2)):.1f} cm, median"
            f" {100 * np.median(np.abs(error)):.1f}, largest {100 * np.abs(error).max():.1f};"
            f" error / sigma RMS {np.sqrt(np.mean(ratio**2)):.2f}"
        )


if __name__ == "__main__":
    main()
