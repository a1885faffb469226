"""The experiment of Hsu & Wang, simulated: a bowl in a box of water under a hand-held camera.

Their section 2: a box of 20 x 30 x 40 cm, in it a bowl of sand 15 cm wide and 3 cm high, a Nikon
D200 with a lens of 60 mm (3872 x 2592 pixels of 6.1 um, points measured to 0.2 px), 24 nearly nadir
images, a surface model every 0.5 mm, 16 depths measured with a probe. Not given, and chosen here:
the camera 1 m above the water, six by four images, tilts of a degree, the rim of the bowl 1 mm
under water, and a probe good for 0.1 mm.

=========== ===================================================================================
uncorrected the apparent cloud
I           `pcfix.refract.literature.butler`, their eq 1: the mean over a point's images
II          `pcfix.refract.literature.murase`, their eqs 2 to 4: the X-parallax of its stereo pairs
III         D = a + b d, fitted by least squares to the probe's depths
pcfix       `pcfix.correct_points` with the cameras of each point
=========== ===================================================================================

The error is that of the surface model (eq 5): the height of each point minus that of the bed at its
place in plan.

Their printed table (8.3 mm uncorrected at 10-15 mm of depth, 5.9 mm at 25-30 mm) cannot come from
refraction alone: a bed of apparent depth d is d (n - 1), a third of d, too high, which grows with
depth, from 3 to 7 mm. A shift between the two surface models or another water level would explain
it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pcfix.errors import SettingError
from pcfix.lens.rotations import from_yaw_pitch_roll
from pcfix.model import Cameras, FloatArray, IntArray, Lens, Views
from pcfix.options.correct import ScienceOptions
from pcfix.options.shared import DEFAULT_REFRACTIVE_INDEX
from pcfix.simulate.sight import starts_of
from pcfix.simulate.tracing import piercing_points, project, triangulate

BOWL_WIDTH_M, BOWL_HEIGHT_M, RIM_DEPTH_M, SPACING_M = 0.15, 0.03, 0.001, 5e-4
WATER_LEVEL_M, CAMERA_HEIGHT_M, TILT_SD_DEG = 0.2, 1.0, 1.0
COLUMNS_X_M, ROWS_Y_M = np.linspace(-0.1, 0.1, 6), np.linspace(-0.045, 0.045, 4)
LENS = Lens(60.0 / 6.1e-3, 3872, 2592, 1936.0, 1296.0)
IMAGE_NOISE_PX = 0.2
GSD_M = CAMERA_HEIGHT_M / LENS.focal
PROBES, PROBE_SD_M = 16, 1e-4

METHODS = {"uncorrected": "", "I": "butler", "II": "murase", "III": "", "pcfix": "auto"}
"""The columns of the table, and by which method of pcfix."""
EDGES_M = np.arange(0.010, 0.031, 0.005)


@dataclass(frozen=True, eq=False)
class Bowl:
    """The bowl: apparent and true points row by row, all submerged, with the cameras of each."""

    apparent_xyz: FloatArray
    true_xyz: FloatArray
    cameras: Cameras
    views: Views
    refractive_index: float


def simulate_bowl(
    spacing_m: float = SPACING_M,
    *,
    refractive_index: float = DEFAULT_REFRACTIVE_INDEX,
    image_noise_px: float = IMAGE_NOISE_PX,
    seed: int = 1,
) -> Bowl:
    """Make the bowl and the cloud of its surface.

    Every point is traced through the water into every image that shows it, gets noise there, and
    is triangulated with straight rays.
    """
    ScienceOptions(index=refractive_index)
    if not 0.0 < spacing_m < BOWL_WIDTH_M / 4.0:
        raise SettingError(
            "option.range",
            f"Spacing {spacing_m:g} m is not between 0 and a quarter of the bowl.",
            value=spacing_m,
        )
    if image_noise_px < 0.0:
        raise SettingError(
            "option.range", f"Image noise {image_noise_px:g} px is negative.", value=image_noise_px
        )
    rng = np.random.default_rng(seed)
    side = np.arange(-BOWL_WIDTH_M / 2.0, BOWL_WIDTH_M / 2.0, spacing_m) + spacing_m / 2.0
    plan = np.array([axis.ravel() for axis in np.meshgrid(side, side)]).T
    plan = plan[np.hypot(*plan.T) < BOWL_WIDTH_M / 2.0]
    bed, cameras = np.column_stack([plan, bed_height_m(plan)]), _cameras(rng)
    point, camera = (pairs.ravel() for pairs in np.indices((len(bed), len(cameras))))
    surface = piercing_points(bed[point], cameras.centres[camera], WATER_LEVEL_M, refractive_index)
    pixels, _ = project(surface, cameras, camera, LENS)
    inside = ((pixels >= 0.0) & (pixels < [LENS.width, LENS.height])).all(axis=1)
    point, camera, pixels = point[inside], camera[inside], pixels[inside]
    pixels = pixels + rng.normal(0.0, image_noise_px, pixels.shape)
    start = starts_of(point, len(bed))
    apparent = triangulate(pixels, cameras, camera, start, LENS, bed)
    return Bowl(apparent, bed, cameras, Views(start, camera), refractive_index)


def bed_height_m(xy: FloatArray) -> FloatArray:
    """Return the height of the bowl at places, shape (n, 2): a paraboloid, lowest in the middle."""
    share = (xy**2).sum(axis=1) / (BOWL_WIDTH_M / 2.0) ** 2
    return np.asarray(WATER_LEVEL_M - RIM_DEPTH_M - BOWL_HEIGHT_M * (1.0 - share))


def _cameras(rng: np.random.Generator) -> Cameras:
    """Return the 24 images; the whole bowl is in nearly all of them."""
    x, y = (side.ravel() for side in np.meshgrid(COLUMNS_X_M, ROWS_Y_M))
    centres = np.column_stack([x, y, np.full(len(x), WATER_LEVEL_M + CAMERA_HEIGHT_M)])
    tilt = rng.normal(0.0, TILT_SD_DEG, (len(x), 3))
    labels = tuple(f"D{i + 1:02d}" for i in range(len(x)))
    return Cameras(labels, centres, from_yaw_pitch_roll(*tilt.T), (LENS,) * len(x))


@dataclass(frozen=True, eq=False)
class DepthBins:
    """The errors of the methods by bins of true depth (`EDGES_M`); the last row is for all points.

    RMSE and mean have a column for each of `METHODS`; `offset_m`, `slope` and `r2` are the line of
    method III.
    """

    points: IntArray
    rmse_m: FloatArray
    mean_m: FloatArray
    offset_m: float
    slope: float
    r2: float


def depth_bins(bowl: Bowl, corrected: dict[str, FloatArray], seed: int = 1) -> DepthBins:
    """Return the errors of every method by depth.

    `corrected` has the clouds by the methods of pcfix in `METHODS`; `seed` is for the probe.
    """
    apparent, true_m = bowl.apparent_xyz, WATER_LEVEL_M - bowl.true_xyz[:, 2]
    offset, slope, r2 = probe_line(WATER_LEVEL_M - apparent[:, 2], true_m, seed)
    by_line = apparent.copy()
    by_line[:, 2] = WATER_LEVEL_M - offset - slope * (WATER_LEVEL_M - apparent[:, 2])
    clouds = {"uncorrected": apparent, "III": by_line} | corrected
    errors = np.array(
        [clouds[name][:, 2] - bed_height_m(clouds[name][:, :2]) for name in METHODS]
    ).T
    which = np.digitize(true_m, EDGES_M) - 1
    groups = [errors[which == i] for i in range(len(EDGES_M) - 1)] + [errors]
    return DepthBins(
        points=np.array([len(group) for group in groups]),
        rmse_m=np.array([np.sqrt((group**2).mean(axis=0)) for group in groups]),
        mean_m=np.array([group.mean(axis=0) for group in groups]),
        offset_m=offset,
        slope=slope,
        r2=r2,
    )


def probe_line(
    apparent_m: FloatArray, true_m: FloatArray, seed: int = 1
) -> tuple[float, float, float]:
    """Return offset, slope and r2 of true on apparent depth, from the probe's 16 places."""
    from scipy.stats import linregress

    rng = np.random.default_rng(seed)
    # evenly through the depths, so that the line is held at both ends
    places = np.argsort(true_m)[np.linspace(0, len(true_m) - 1, PROBES).astype(int)]
    line = linregress(apparent_m[places], true_m[places] + rng.normal(0.0, PROBE_SD_M, PROBES))
    return float(line.intercept), float(line.slope), float(line.rvalue**2)
