"""Photographs without water against a rendering without water.

python -m tests.benchmarks.photos [--images 1 16 30]

The block is rendered_a of PCFIX_SHARED, its bed its truth; its texture is our own, so that the same
ground can be rendered with and without water.
"""

import argparse
import tempfile
import warnings
from pathlib import Path

import cv2
import numpy as np

import pcfix
from pcfix.errors import PcfixWarning
from pcfix.flow.photos import block_of
from pcfix.io.photographs import photographs_in
from pcfix.options.steps import PhotosOptions
from pcfix.photos.mapping import exact, resample
from tests.utils.renderer import Relief, Texture, rendered
from tests.utils.shared import SHARED

BLOCK = SHARED / "data" / "rendered_a"
OFFSET, LEVEL = "319900,3842700,0", 0.37
COUNT = "{:<26}{:>7}{:>9}{:>9}{:>9}{:>9}"


def options(dsm, **more):
    return PhotosOptions(
        cameras=BLOCK / "colmap", cameras_offset=OFFSET, water=str(LEVEL), dsm=dsm, **more
    )


def seen(photo, relief, texture, *level):
    """Return what a camera sees; coordinates from the block's corner, so that singles will do."""
    here = photo._replace(centre=photo.centre - [*relief[0], 0.0])
    return rendered(here, relief[1], texture, *level)


def against_rendering(numbers, corrected):
    """Print how far mapped images lie from those rendered without water."""
    print(COUNT.format("DSM", "image", "bed rms", "bed 95 %", "land rms", "lost %"))
    with tempfile.TemporaryDirectory() as scratch:
        paths = photographs_in(BLOCK / "images")
        blocks = [
            ("truth", block_of(options(BLOCK / "truth_dsm.tif"), paths, Path(scratch))),
            ("pcfix's own", block_of(options(corrected, resolution=0.1), paths, Path(scratch))),
        ]
    true = blocks[0][1].scene.ground
    corner = np.array([true.left_m, true.top_m])
    relief = corner, Relief(true.height_m, 0.0, 0.0, true.cell_m)
    texture = Texture(0.25, 4.0)
    for number in numbers:
        photo = blocks[0][1].photos[number]
        wet, wet_place = seen(photo, relief, texture, LEVEL)
        dry, place = seen(photo, relief, texture)
        for name, block in blocks:
            shifts = exact(photo, block.scene, block.step_px)
            image = resample(wet[..., None], shifts)[0][..., 0]
            found = resample(wet_place[..., :2].astype(np.float32), shifts)[0]
            known = np.abs(found).min(axis=2) > 0.0
            off = np.hypot(*np.moveaxis(found - place[..., :2], 2, 0)) / block.gsd_m
            flow = np.hypot(*np.moveaxis(cv2.DISOpticalFlow_create(2).calc(image, dry, None), 2, 0))
            inner = np.zeros(known.shape, bool)
            inner[20:-20, 20:-20] = True
            bed = inner & known & (place[..., 2] < LEVEL - 0.2)
            land = inner & known & (place[..., 2] > LEVEL)
            for how, far in (("rays", off), ("registered", flow)):
                print(
                    COUNT.format(
                        f"{name}, {how}",
                        photo.label[:7],
                        *(f"{f(far[m]):.3f}" if m.any() else "-" for f, m in (
                            (_rms, bed), (lambda a: np.quantile(a, 0.95), bed), (_rms, land)
                        )),
                        f"{100 * (1 - known[inner].mean()):.2f}",
                    ),
                    flush=True,
                )  # fmt: skip
            if name == "truth":
                picture = np.hstack([wet, image, dry])
                cv2.imwrite(f"mapped_{number}.png", picture)


def _rms(far):
    return np.sqrt(np.mean(far**2))


if __name__ == "__main__":
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--images", type=int, nargs="*", default=[1, 16, 30])
    asked = words.parse_args()
    warnings.simplefilter("ignore", PcfixWarning)
    with tempfile.TemporaryDirectory() as place:
        cloud = Path(place) / "corrected.laz"
        pcfix.correct_file(
            BLOCK / "cloud.las", cloud, cameras=BLOCK / "colmap", cameras_offset=OFFSET,
            water=str(LEVEL), views=BLOCK / "dense.vis",
        )  # fmt: skip
        against_rendering(asked.images, cloud)
