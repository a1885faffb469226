"""A block that absorbed refraction, adjusted from files and through every door."""

import json

import laspy
import numpy as np
import pytest

import pcfix
from pcfix.flow.adjust import adjust_cameras, correct_words
from pcfix.flow.demo import colmap_vis
from pcfix.lens.imaging import straight_images
from pcfix.model import Views
from pcfix.options.correct import AdjustOptions
from pcfix.refract.choice import views_in_frame
from tests.utils.adjust_files import IMAGE_PX, write_block
from tests.utils.codes import refused
from tests.utils.program import run_pcfix

pytestmark = [
    pytest.mark.filterwarnings("default::pcfix.errors.PcfixWarning"),
    pytest.mark.usefixtures("one_thread"),
]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return write_block(tmp_path_factory.mktemp("block"))


@pytest.fixture(scope="module")
def written(files):
    """An adjustment by tie points and control, in a folder."""
    out = files.folder / "adjusted"
    found = adjust(files, out=out, gcps=files.folder / "gcps.csv", cloud=files.folder / "cloud.las")
    return out, found


def adjust(files, model="model", out=None, *, gnss="gnss.csv", **more):
    more.setdefault("water", files.water)
    positions = None if gnss is None else files.folder / gnss
    return adjust_cameras(files.folder / model, out, gnss=positions, **more)


def centre_rms_m(files, cameras):
    off = cameras.centres - files.scene.true_cameras.centres
    return float(np.sqrt((off * off).mean()))


def home(files, new, **more):
    """Return the rms errors of the heights of the corrected cloud, bed and land."""
    out = files.folder / "home.las"
    pcfix.correct_file(
        files.folder / "cloud.las", out, cameras=new, adjusted_from=files.folder / "model",
        overwrite=True,
        **{"water": files.water, "method": "snell", "max_angle": None, **more},
    )  # fmt: skip
    z, truth = np.array(laspy.read(out).z), files.truth[:, 2]
    wet = truth < files.water
    return [float(np.sqrt(np.mean((z - truth)[rows] ** 2))) for rows in (wet, ~wet)]


def test_tie_points(files, written):
    out, found = written
    assert found.source == "tie points"
    # m: 3 cm of GNSS positions over 15 images, and what tie points leave of it
    assert centre_rms_m(files, found.cameras) < 0.02
    assert found.sigma0 == pytest.approx(1.0, abs=0.1)
    r = found.residual_px[found.used & found.is_wet[found.block.owner]]
    assert np.sqrt(np.nanmean(r**2)) == pytest.approx(IMAGE_PX, rel=0.1)
    # m: half a GSD of 19 mm is 0.3 px and base over height
    bed, land = home(files, out / "colmap")
    assert bed < 0.02
    assert land < 0.015


def test_cloud(files):
    found = adjust(
        files, "bare", cloud=files.folder / "cloud.las", gcps=files.folder / "gcps.csv",
        lens_unknowns=("f",),
    )  # fmt: skip
    assert found.source == "cloud"
    # m: 1200 points stand for the 400 of the old adjustment, which held noise of their own
    assert centre_rms_m(files, found.cameras) < 0.04
    assert "adjust.by_cloud" in [note.code for note in found.notes]
    # rms of 45 normalised errors, neighbours alike; SigmaZ takes them from the members
    off = (
        found.cameras.centres - files.scene.true_cameras.centres
    ) / found.precision.centre_sigma_m
    assert 0.3 < np.sqrt((off**2).mean()) < 2.0
    assert len(found.precision.members) > 0
    bed, land = home(files, found.cameras)
    assert bed < 0.03
    assert land < 0.02


def test_cloud_with_views(files):
    """A view list counts only where it fits GNSS and control points better than all in frame."""
    cloud = files.folder / "cloud.las"
    given = {"cloud": cloud, "gcps": files.folder / "gcps.csv", "lens_unknowns": ("f",)}
    alone = adjust(files, "bare", **given)
    xyz = np.array(laspy.read(cloud).xyz)
    # the first two images of each point, which the original adjustment did not see alone
    seen = views_in_frame(xyz, alone.block.cameras)
    first_two = seen.camera[seen.start[:-1, None] + np.arange(2)].ravel()
    listed = files.folder / "two.ply.vis"
    listed.write_bytes(colmap_vis(Views(2 * np.arange(len(xyz) + 1), first_two)))
    found = adjust(files, "bare", views=listed, **given)
    assert found.cameras.centres == pytest.approx(alone.cameras.centres, abs=1e-9)  # m
    assert len(found.block.camera) == len(alone.block.camera)


def test_level_and_index(files):
    found = adjust(
        files, water=files.water + 0.25, index=1.33, free=("level", "index"),
        gcps=files.folder / "gcps.csv", lens=files.folder / "lens.csv",
    )  # fmt: skip
    sigma = {name: row.sigma for name, row in found.precision.shared.items()}
    level, n = found.water.a, found.refractive_index
    assert abs(level - files.water) < 3.0 * sigma["level"]
    assert abs(n - files.scene.refractive_index) < 3.0 * sigma["index"]
    doubted = {n.values["unknown"] for n in found.notes if n.code == "adjust.undetermined"}
    for name, limit in (("level", 0.02), ("index", 0.005)):
        assert (name in doubted) == (sigma[name] > limit)


def write_waterline(files, path, count=12):
    """Write the control points, and marks of points on the water, which have no coordinates."""
    cameras, rng = files.scene.true_cameras, np.random.default_rng(8)
    middle = cameras.centres[:, :2].mean(axis=0)
    rows = (files.folder / "gcps.csv").read_text().splitlines()
    each = np.arange(len(cameras))
    for i in range(count):
        xyz = np.array([*(middle + rng.uniform(-15.0, 15.0, 2)), files.water])
        image_xy = straight_images(np.tile(xyz, (len(cameras), 1)), each, cameras)
        image_xy += rng.normal(0.0, IMAGE_PX, image_xy.shape)
        lens = cameras.lenses[0]
        for label, (u, v) in zip(cameras.labels, image_xy, strict=True):
            if 0.0 < u < lens.width and 0.0 < v < lens.height:
                rows.append(f"W{i},,,,{label},{u:.3f},{v:.3f},waterline,no")
    path.write_text("\n".join(rows) + "\n")


def test_shape_and_waterline(files, tmp_path):
    write_waterline(files, tmp_path / "marks.csv")
    found = adjust(
        files, out=tmp_path / "out", water=files.water + 0.25, free=("level", "tilt", "shape"),
        gcps=tmp_path / "marks.csv", lens=files.folder / "lens.csv",
    )  # fmt: skip
    as_written = json.loads((tmp_path / "out" / "adjustment.json").read_text())
    assert {row["name"] for row in as_written["control"]["points"]} == {
        row.name for row in found.control if row.role == "control"
    }
    for where in ("land", "water"):
        fit = as_written["residuals"][where]
        assert np.hypot(*fit["rms_xy_px"]) == pytest.approx(np.sqrt(2.0) * fit["rms_px"])
    words = correct_words(found, "model", tmp_path / "out", AdjustOptions(water=files.water))
    assert f"--water {tmp_path / 'out' / 'water.tif'}" in words
    bed, _ = home(files, tmp_path / "out" / "colmap", water=tmp_path / "out" / "water.tif")
    assert bed < 0.02
    level = as_written["shared"]["level"]
    assert abs(level["after"] - files.water) < 3.5 * level["sigma"] < 0.04


@pytest.mark.parametrize(("role", "more", "code"), [
    ("on:floor", {}, "gcps.few_on_plane"),
    ("waterline", {"parallel": ("water", "deck")}, "adjust.parallel"),
    ("in the water", {}, "table.choice"),
])  # fmt: skip
def test_wrong_marks_on_surfaces(files, tmp_path, role, more, code):
    write_waterline(files, tmp_path / "marks.csv", 2)
    text = (tmp_path / "marks.csv").read_text().replace("waterline", role)
    (tmp_path / "marks.csv").write_text(text)
    with refused(code):
        adjust(files, gcps=tmp_path / "marks.csv", **more)


def test_written(files, written):
    out, found = written
    names = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()}
    wanted = {"colmap/images.bin", "cameras.csv", "sensor.csv", "adjustment.json", "report.html"}
    assert wanted <= names
    for name in ("colmap", "cameras.csv"):
        read = pcfix.read_cameras(out / name)
        order = [read.labels.index(label) for label in found.cameras.labels]
        # the table has 0.1 mm and nine digits of a quaternion
        turns = [c @ c[0].T for c in (read.rotations[order], found.cameras.rotations)]
        np.testing.assert_allclose(*turns, atol=1e-7)
        assert read.lenses[0].focal == pytest.approx(found.cameras.lenses[0].focal, abs=1e-4)
        np.testing.assert_allclose(read.centres[order], found.cameras.centres, atol=1e-3)
    as_written = json.loads((out / "adjustment.json").read_text("utf-8"))
    assert as_written["sigma0"] == pytest.approx(found.sigma0)
    assert all(
        as_written["residuals"][key]["rms_before_px"] > 2.0 * IMAGE_PX for key in ("land", "water")
    )
    page = (out / "report.html").read_text("utf-8")
    assert "<html" in page
    assert "Refractive bundle adjustment" in page


@pytest.mark.usefixtures("undrawn")
def test_doors_agree(files, written, tmp_path):
    out, _ = written
    folder = files.folder
    words = [
        "adjust", folder / "model", tmp_path / "cli", "--water", repr(files.water),
        "--gnss", folder / "gnss.csv", "--gcps", folder / "gcps.csv",
        "--cloud", folder / "cloud.las", "--jobs", "1",
    ]  # fmt: skip
    done = run_pcfix(*words)
    assert done.returncode == 0, done.stderr
    for name in ("colmap/images.bin", "colmap/points3D.bin", "cameras.csv", "adjustment.json"):
        assert (tmp_path / "cli" / name).read_bytes() == (out / name).read_bytes(), name
    assert "Next step:\n  pcfix correct" in done.stdout
    assert "sigma0" in done.stdout


@pytest.mark.usefixtures("undrawn")
def test_output_folder(files, tmp_path):
    quick = {"poses": "fixed", "lens_unknowns": ("f",)}
    out = tmp_path / "out"
    adjust(files, out=out, **quick)
    before = (out / "adjustment.json").read_bytes()
    with refused("output.exists"):
        adjust(files, out=out, **quick)
    assert (out / "adjustment.json").read_bytes() == before
    adjust(files, out=out, overwrite=True, **quick)
    other = tmp_path / "other"
    other.mkdir()
    (other / "mine.txt").write_text("keep")
    for wrong, code in (
        (other, "output.exists"),
        (other / "mine.txt", "output.exists"),
        (tmp_path / "no" / "folder", "output.no_folder"),
        (files.folder / "model", "output.is_input"),
    ):
        with refused(code, path=wrong):
            adjust(files, out=wrong, overwrite=True, **quick)
    assert (other / "mine.txt").read_text() == "keep"
