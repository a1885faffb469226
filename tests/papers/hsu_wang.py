"""The experiment of Hsu & Wang, simulated: a bowl in a box of water under a hand-held camera.

Their section 2: a box of 20 x 30 x 40 cm, in it a bowl of sand 15 cm wide and 3 cm high, a Nikon
D200 with a lens of 60 mm (3872 x 2592 pixels of 6.1 um, points measured to 0.2 px), 24 nearly nadir
images, a surface model every 0.5 mm, 16 depths measured with a probe. Not given, and chosen here:
the camera 1 m above the water, six by four images, tilts of a degree, the rim of the bowl 1 mm
under water, and a probe good for 0.1 mm.

Methods: I is `butler` (their eq 1), II `murase` (eqs 2 to 4), III the line D = a + b d by least
squares on the probe's depths, pcfix `correct_points` with the cameras of each point. The error
(eq 5) is the height of each point minus that of the bed at its place in plan.

Their printed table (8.3 mm uncorrected at 10-15 mm of depth, 5.9 mm at 25-30 mm) cannot come from
refraction alone: a bed of apparent depth d is d (n - 1), a third of d, too high, which grows with
depth, from 3 to 7 mm. A shift between the two surface models or another water level would explain
it.
"""

from typing import NamedTuple

import numpy as np
from scipy.stats import linregress

import pcfix
from pcfix.lens.rotations import from_yaw_pitch_roll
from pcfix.model import Lens, Views
from pcfix.simulate.scene import starts
from pcfix.simulate.tracing import project, triangulate
from tests.utils.bed_rays import piercing_points

WIDTH_M, HEIGHT_M, RIM_DEPTH_M, LEVEL_M, CAMERA_HEIGHT_M = 0.15, 0.03, 0.001, 0.2, 1.0
LENS = Lens(60.0 / 6.1e-3, 3872, 2592, 1936.0, 1296.0)
GSD_M = CAMERA_HEIGHT_M / LENS.focal
METHODS = {"uncorrected": "", "I": "butler", "II": "murase", "III": "", "pcfix": "auto"}
EDGES_M = np.arange(0.010, 0.031, 0.005)
BIN_NAMES = ("10-15", "15-20", "20-25", "25-30", "overall")


class Bowl(NamedTuple):
    """Apparent and true points row by row, all submerged, with the cameras of each."""

    apparent_xyz: np.ndarray
    true_xyz: np.ndarray
    cameras: pcfix.Cameras
    views: Views
    refractive_index: float


def simulate_bowl(spacing_m=5e-4, *, refractive_index=1.34, image_noise_px=0.2, seed=1):
    """Trace the bowl through the water into the images, and triangulate with straight rays."""
    rng = np.random.default_rng(seed)
    side = np.arange(-WIDTH_M / 2.0, WIDTH_M / 2.0, spacing_m) + spacing_m / 2.0
    plan = np.array([axis.ravel() for axis in np.meshgrid(side, side)]).T
    plan = plan[np.hypot(*plan.T) < WIDTH_M / 2.0]
    bed = np.column_stack([plan, bed_height_m(plan)])
    places = np.meshgrid(np.linspace(-0.1, 0.1, 6), np.linspace(-0.045, 0.045, 4))
    centres = np.column_stack([*map(np.ravel, places), np.full(24, LEVEL_M + CAMERA_HEIGHT_M)])
    rotations = from_yaw_pitch_roll(*rng.normal(0.0, 1.0, (24, 3)).T)
    labels = tuple(f"D{i + 1:02d}" for i in range(24))
    cameras = pcfix.Cameras(labels, centres, rotations, (LENS,) * 24)
    point, camera = (pairs.ravel() for pairs in np.indices((len(bed), 24)))
    surface = piercing_points(bed[point], centres[camera], LEVEL_M, refractive_index)
    pixels, _ = project(surface, cameras, camera, LENS)
    inside = ((pixels >= 0.0) & (pixels < [LENS.width, LENS.height])).all(axis=1)
    point, camera, pixels = point[inside], camera[inside], pixels[inside]
    pixels = pixels + rng.normal(0.0, image_noise_px, pixels.shape)
    start = starts(np.bincount(point, minlength=len(bed)))
    apparent = triangulate(pixels, cameras, camera, start, LENS, bed)
    return Bowl(apparent, bed, cameras, Views(start, camera), refractive_index)


def bed_height_m(xy):
    """Return the height of the bowl: a paraboloid, lowest in the middle."""
    share = (xy**2).sum(axis=1) / (WIDTH_M / 2.0) ** 2
    return LEVEL_M - RIM_DEPTH_M - HEIGHT_M * (1.0 - share)


class DepthBins(NamedTuple):
    """RMSE and mean error by bins of true depth, a column for each method; the last row is all."""

    points: np.ndarray
    rmse_m: np.ndarray
    mean_m: np.ndarray


def bowl_bins(bowl):
    """Correct the bowl by every method, and return the errors by depth."""
    clouds = {"uncorrected": bowl.apparent_xyz, "III": bowl.apparent_xyz.copy()}
    depth, true = (LEVEL_M - xyz[:, 2] for xyz in (bowl.apparent_xyz, bowl.true_xyz))
    line = probe_line(depth, true)
    clouds["III"][:, 2] = LEVEL_M - line.intercept - line.slope * depth
    for name, method in METHODS.items():
        if method:
            clouds[name] = pcfix.correct_points(
                bowl.apparent_xyz, bowl.cameras, LEVEL_M, index=bowl.refractive_index,
                views=bowl.views, method=method,
            ).xyz  # fmt: skip
    errors = [clouds[name][:, 2] - bed_height_m(clouds[name][:, :2]) for name in METHODS]
    errors, which = np.column_stack(errors), np.digitize(true, EDGES_M) - 1
    groups = [errors[which == i] for i in range(len(EDGES_M) - 1)] + [errors]
    return DepthBins(
        np.array([len(group) for group in groups]),
        np.array([np.sqrt((group**2).mean(axis=0)) for group in groups]),
        np.array([group.mean(axis=0) for group in groups]),
    )


def probe_line(apparent_m, true_m, seed=1):
    """Return the line of true on apparent depth from the probe's 16 places, even in depth."""
    noise = np.random.default_rng(seed).normal(0.0, 1e-4, 16)
    places = np.argsort(true_m)[np.linspace(0, len(true_m) - 1, 16).astype(int)]
    return linregress(apparent_m[places], true_m[places] + noise)


def rows_of(bins):
    """Return RMSE and mean error of each bin and method as rows, millimetres."""
    return [
        {"depth_mm": name, "points": int(points)}
        | {f"rmse_{m}_mm": round(1e3 * v, 3) for m, v in zip(METHODS, rmse, strict=True)}
        | {f"mean_{m}_mm": round(1e3 * v, 3) for m, v in zip(METHODS, mean, strict=True)}
        for name, points, rmse, mean in zip(BIN_NAMES, *bins, strict=True)
    ]
