"""``pcfix photos`` over files: names, metadata, bits of land, bad input."""

import json
import time
from threading import Lock

import numpy as np
import pytest

pytest.importorskip("cv2", reason="photographs need the extra 'photos'")

import jpeglib
from PIL import Image

import pcfix
from pcfix.io.photographs import read_photograph
from tests.photos.test_mapping import GSD_M, LEVEL_M, photo, relief
from tests.utils.nightly import mostly_nightly
from tests.utils.program import run_pcfix
from tests.utils.rasters import write_raster
from tests.utils.renderer import Texture, rendered

CORNER = np.array([500_000.0, 4_000_000.0, 0.0])


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """Return a folder: images, a camera table, a sensor, and a DSM of the true bed."""
    folder = tmp_path_factory.mktemp("photos")
    (folder / "images").mkdir()
    rows = ["label,x,y,z,yaw,pitch,roll"]
    for number, x in enumerate((-8.0, 8.0)):
        grey, _ = rendered(photo(x), relief(), Texture(5 * GSD_M, 1.5), LEVEL_M)
        colour = np.dstack([grey, grey[:, ::-1], 255 - grey])
        exif = Image.Exif()
        exif[0x010F] = "pcfix"  # maker
        Image.fromarray(colour).save(
            folder / "images" / f"IMG_{number}.JPG", quality=92, exif=exif, dpi=(72, 72)
        )
        place = CORNER + photo(x).centre
        rows.append(f"IMG_{number},{place[0]},{place[1]},{place[2]},35,4,3")
    (folder / "cameras.csv").write_text("\n".join(rows) + "\n")
    mm = 6e-3  # of a pixel
    (folder / "sensor.csv").write_text(
        "focal,sensor_x,sensor_y\n" + f"{600 * mm},{480 * mm},{360 * mm}\n"
    )
    place = CORNER[0] - 45.0, CORNER[1] + 45.0, 0.2
    write_raster(folder / "bed.tif", relief().height_m, *place, crs="EPSG:32633", nodata=-9999.0)
    return folder


def words(project, *more, out="out"):
    return [
        "photos", str(project / "images"), str(project / out), "--cameras",
        str(project / "cameras.csv"), "--dsm", str(project / "bed.tif"), "--water", str(LEVEL_M),
        *more,
    ]  # fmt: skip


def test_command(project):
    done = run_pcfix(*words(project, "--summary", str(project / "said.json")))
    assert done.returncode == 0, done.stderr
    assert done.warned == []
    found = json.loads((project / "said.json").read_text())
    assert found["images"] == 2
    assert 5.0 < found["largest_shift_px"] < 60.0
    for number in range(2):
        name = f"IMG_{number}.JPG"
        old, new = (Image.open(project / at / name) for at in ("images", "out"))
        assert old.size == new.size
        assert new.getexif()[0x010F] == "pcfix"
        assert new.info["dpi"] == old.info["dpi"]
        assert new.quantization == old.quantization
        changed = (np.asarray(old) != np.asarray(new)).any(axis=2).mean()
        assert changed > 0.6  # two thirds and all of them are over water


def test_one_jpeg_at_a_time(project, monkeypatch):
    """In two threads jpeglib loses the EXIF data of one image in a thousand."""
    busy, read = Lock(), jpeglib.read_dct

    def read_alone(path):
        assert busy.acquire(blocking=False)
        time.sleep(0.05)  # seconds, in which the other thread comes here
        found = read(path)
        busy.release()
        return found

    monkeypatch.setattr(jpeglib, "read_dct", read_alone)
    pcfix.map_photos(
        project / "images", project / "alone", cameras=project / "cameras.csv",
        dsm=project / "bed.tif", water=LEVEL_M, jobs=2,
    )  # fmt: skip


def test_land_unchanged(project):
    if not (project / "out").exists():
        run_pcfix(*words(project))
    _, place = rendered(photo(-8.0), relief(), Texture(1.0, 2.0))
    land = place[..., 2] > LEVEL_M + 0.3
    # 8 x 8 of luminance, 16 x 16 of colour, and one pixel more by which decoders smooth colour
    import cv2

    inland = cv2.erode(land.astype(np.uint8), np.ones((49, 49))) > 0
    assert inland.mean() > 0.05
    before, after = (read_photograph(project / at / "IMG_0.JPG") for at in ("images", "out"))
    assert (before == after)[inland].all()


def test_existing(project):
    assert run_pcfix(*words(project, out="again")).returncode == 0
    assert run_pcfix(*words(project, out="again")).code == "output.exists"
    assert run_pcfix(*words(project, "--overwrite", out="again")).returncode == 0


@pytest.mark.parametrize(
    ("suffix", "dtype"),
    mostly_nightly([("tif", np.uint16), ("png", np.uint16), ("tif", np.uint8)], ("tif", np.uint16)),
)
def test_formats(project, tmp_path, suffix, dtype):
    import cv2
    import tifffile

    folder = tmp_path / "images"
    folder.mkdir()
    grey, _ = rendered(photo(-8.0), relief(), Texture(5 * GSD_M, 1.5), LEVEL_M)
    scale = 257 if dtype == np.uint16 else 1
    bands = np.dstack([grey] * (5 if suffix == "tif" else 3)).astype(dtype) * dtype(scale)
    path = folder / f"IMG_0.{suffix}"
    if suffix == "tif":
        tags = [(271, 2, 6, "maker", True)]
        how = {"photometric": "minisblack", "planarconfig": "contig", "extratags": tags}
        tifffile.imwrite(path, bands, **how)
    else:
        cv2.imwrite(str(path), bands)
    pcfix.map_photos(
        folder, tmp_path / "out", cameras=project / "cameras.csv", dsm=project / "bed.tif",
        water=LEVEL_M,
    )  # fmt: skip
    before, after = read_photograph(path), read_photograph(tmp_path / "out" / path.name)
    assert after.shape == before.shape
    assert after.dtype == dtype
    same = (before == after).all(axis=2)
    assert 0.05 < same.mean() < 0.8
    assert (after[..., 0] == after[..., 2]).all()
    if suffix == "tif":
        with tifffile.TiffFile(tmp_path / "out" / path.name) as file:
            assert file.pages[0].tags["Make"].value == "maker"
