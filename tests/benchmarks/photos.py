"""Photographs without water: against a rendering without water, and how fast, for the README.

python -m tests.benchmarks.photos [--images 1 16 30] [--speed]

The block is rendered_a of PCFIX_SHARED, its bed its truth; its texture is our own, so that the same
ground can be rendered with and without water. ``--speed`` enlarges the photographs to 12 Mpx.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

import pcfix
from pcfix.errors import PcfixWarning
from pcfix.flow.photos import block_of
from pcfix.io.photographs import photographs_in, read_photograph
from pcfix.options.photos import PhotosOptions
from pcfix.photos.mapping import exact, resample
from pcfix.running import threads
from tests.utils.renderer import Relief, Texture, rendered
from tests.utils.shared import SHARED

BLOCK = SHARED / "data" / "rendered_a"
OFFSET, LEVEL = "319900,3842700,0", 0.37
SPEED_IMAGES, ENLARGED = 36, 2.5
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


def speed():
    """Print the rate of the mapping alone on one core, and a folder's time and memory on all."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "large"
        folder.mkdir()
        paths = photographs_in(BLOCK / "images")
        for number in range(SPEED_IMAGES):
            image = read_photograph(paths[number % len(paths)])
            large = cv2.resize(image, None, fx=ENLARGED, fy=ENLARGED, interpolation=cv2.INTER_CUBIC)
            name = folder / f"{number:03d}_{paths[number % len(paths)].name}"
            cv2.imwrite(str(name), large[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
        rows = (BLOCK / "cameras.csv").read_text().splitlines()
        head, poses = rows[0], {Path(row.split(",")[0]).stem: row for row in rows[1:]}
        names = [path.name for path in photographs_in(folder)]
        lines = [head] + [
            ",".join([name, *poses[name[4:].rsplit(".", 1)[0]].split(",")[1:]]) for name in names
        ]
        (Path(scratch) / "poses.csv").write_text("\n".join(lines) + "\n")
        shutil.copy(BLOCK / "sensor.csv", Path(scratch) / "sensor.csv")
        given = ["--cameras", str(Path(scratch) / "poses.csv"), "--water", str(LEVEL)]
        given += ["--dsm", str(BLOCK / "truth_dsm.tif")]
        alone(folder, Path(scratch))
        started = time.perf_counter()
        command = [sys.executable, "-m", "pcfix", "photos", str(folder), f"{scratch}/out", *given]
        subprocess.run(command, check=True)
        seconds = time.perf_counter() - started
        most = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e6
        print(f"{len(names)} x 12 Mpx: {seconds:.0f} s, {most:.2f} GB")


def alone(folder, scratch):
    """Print megapixels a second of mapping and resampling on one core, and of `remap` alone."""
    paths = photographs_in(BLOCK / "images")
    block = block_of(options(BLOCK / "truth_dsm.tif"), paths, scratch)
    cv2.setNumThreads(1)
    mapped = plain = pixels = 0.0
    with threads(1):
        exact(block.photos[0], block.scene, 64)  # compiles
        for number in range(0, len(paths), 4):
            lens = block.photos[number].lens
            scaled = ("focal", "width", "height", "principal_x", "principal_y")
            lens = replace(lens, **{one: getattr(lens, one) * ENLARGED for one in scaled})
            photo = block.photos[number]._replace(lens=lens)
            image = read_photograph(photographs_in(folder)[number])
            started = time.perf_counter()
            shifts = exact(photo, block.scene, 8)
            resample(image, shifts)
            mapped += time.perf_counter() - started
            rows, columns = image.shape[:2]
            u, v = np.meshgrid(np.arange(columns, dtype=np.float32), np.arange(rows) + 0.5)
            started = time.perf_counter()
            cv2.remap(image, u, v.astype(np.float32), cv2.INTER_CUBIC)
            plain += time.perf_counter() - started
            pixels += 1e-6 * rows * columns
    print(f"mapping {pixels / mapped:.1f} Mpx/s on one core; remap alone {pixels / plain:.1f}")


if __name__ == "__main__":
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--images", type=int, nargs="*", default=[1, 16, 30])
    words.add_argument("--speed", action="store_true")
    asked = words.parse_args()
    warnings.simplefilter("ignore", PcfixWarning)
    with tempfile.TemporaryDirectory() as place:
        if asked.images:
            cloud = Path(place) / "corrected.laz"
            pcfix.correct_file(
                BLOCK / "cloud.las", cloud, cameras=BLOCK / "colmap", cameras_offset=OFFSET,
                water=str(LEVEL), views=BLOCK / "dense.vis",
            )  # fmt: skip
            against_rendering(asked.images, cloud)
        if asked.speed:
            speed()
