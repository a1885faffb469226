"""A user's mistake with an adjustment gives one line, exit code 1, and nothing left behind."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from pcfix.io.cameras.colmap import write_colmap
from tests.test_bad_input import listing
from tests.utils.adjust_files import EPSG, write_block, write_gcps, write_gnss
from tests.utils.program import run_pcfix

pytestmark = pytest.mark.filterwarnings("default::pcfix.errors.PcfixWarning")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return write_block(tmp_path_factory.mktemp("block"), points=900)


@pytest.fixture(scope="module")
def drowned(tmp_path_factory):
    """A block over a flat bed: nothing of it is land."""
    return write_block(tmp_path_factory.mktemp("drowned"), points=900, bed="flat")


@pytest.fixture
def refuse(files, tmp_path):
    """Return a function that changes a copy of the files, and sees ``pcfix adjust`` refuse it."""
    folder = shutil.copytree(files.folder, tmp_path / "block")

    def call(code, *words, model="model", gnss=True, water=None, change=None):
        if change is not None:
            change(folder, files)
        before = listing(folder)
        words = [*words, "--water", repr(files.water if water is None else water), "--jobs", "1"]
        words += ["--gnss", "gnss.csv"] if gnss else []
        done = run_pcfix("adjust", model, "out", *words, folder=folder)
        lines = [one for one in done.stderr.splitlines() if not one.startswith("pcfix: warning:")]
        assert (done.returncode, len(lines), done.stdout) == (1, 1, ""), done.stderr
        assert done.code == code, done.stderr
        assert listing(folder) == before
        return done.error

    return call


CLOUD = ("--cloud", "cloud.las")
GCPS = ("--gcps", "gcps.csv")


@pytest.mark.parametrize(
    ("code", "words", "given"),
    [
        ("cameras.no_ties", (), {"model": "bare"}),
        ("adjust.no_datum", (), {"gnss": False}),
        ("adjust.no_datum", CLOUD, {"model": "bare", "gnss": False}),
        ("adjust.cloud_needs_datum", (*CLOUD, "--datum", "free"), {"model": "bare", "gnss": False}),
        ("adjust.cloud_needs_water", (*CLOUD, "--free", "level"), {"model": "bare"}),
        ("water.below_points", (), {"water": -40.0}),
        ("water.below_points", CLOUD, {"model": "bare", "water": -40.0}),
        ("cameras.under_water", (), {"water": 500.0}),
        ("option.choice", ("--free", "distance"), {}),
        ("option.choice", ("--lens-unknowns", "f,q9"), {}),
        ("adjust.parallel", ("--parallel", "water,floor"), {}),
    ],
)
def test_words(refuse, code, words, given):
    refuse(code, *words, **given)


def replaced(folder, file, old, new):
    (folder / file).write_text((folder / file).read_text().replace(old, new))


def written_control(folder, files, xyz, **more):
    control = replace(files.scene.control, xyz=xyz)
    write_gcps(folder / "gcps.csv", replace(files.scene, control=control), **more)


def next_zone(xyz):
    x, y = Transformer.from_crs(32633, 32632).transform(*xyz.T[:2])
    return np.column_stack([x, y, xyz[:, 2]])


def higher(xyz):
    return xyz + np.array([0.0, 0.0, 30.0])


OTHER_LENS = "focal_px,width_px,height_px\n1000,4000,3000\n"
CHANGED = {
    "under water": (
        "gcps.under_water", GCPS, lambda d, f: write_gcps(d / "gcps.csv", f.scene, wet=False),
    ),
    "control points in the next zone": (
        "gcps.far", GCPS, lambda d, f: written_control(d, f, next_zone(f.scene.control.xyz)),
    ),
    "control points of another height datum": (
        "gcps.offset", GCPS, lambda d, f: written_control(d, f, higher(f.scene.control.xyz)),
    ),
    "unknown image": (
        "gcps.unknown_image", GCPS,
        lambda d, f: replaced(d, "gcps.csv", f.scene.cameras.labels[4], "DJI_9999.JPG"),
    ),
    "GNSS of another block": (
        "gnss.no_image", (), lambda d, _: replaced(d, "gnss.csv", "IMG", "DJI"),
    ),
    "calibration of other images": (
        "sensor.size", ("--lens", "lens.csv"), lambda d, _: (d / "lens.csv").write_text(OTHER_LENS),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CHANGED)
def test_changed_file(refuse, name):
    code, words, change = CHANGED[name]
    refuse(code, *words, change=change)


@pytest.mark.parametrize("gnss", [True, False])
@pytest.mark.parametrize("model", ["model", "bare"])
def test_swapped_names(refuse, files, gnss, model):
    """Coordinates of one control point with the marks of another."""
    control = files.scene.control
    rows = np.flatnonzero(~control.is_check)[:2]
    order = np.arange(len(control.names))
    order[rows] = rows[::-1]
    error = refuse(
        "gcps.gross_error", *GCPS, *CLOUD, model=model, gnss=gnss,
        change=lambda d, f: written_control(d, f, control.xyz[order]),
    )  # fmt: skip
    assert error.values["point"] in [control.names[i] for i in rows]


def test_waterline_with_cloud(refuse):
    refuse(
        "adjust.cloud_has_conditions", *CLOUD, *GCPS, model="bare",
        change=lambda d, _: replaced(d, "gcps.csv", ",control", ",waterline"),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("code", "moved"),
    [("gnss.offset", higher), ("gnss.far", next_zone)],
    ids=["another height datum", "next zone"],
)
def test_gnss(refuse, code, moved):
    def change(folder, files):
        gnss, labels = files.scene.cameras.gnss, files.scene.cameras.labels
        write_gnss(folder / "gnss.csv", labels, moved(gnss.xyz), gnss.sigma_m)

    error = refuse(code, change=change)
    if code == "gnss.offset":
        assert error.values["offset_m"][2] == pytest.approx(30.0, abs=0.5)


@pytest.mark.parametrize("model", ["wild", "upside down"])
def test_start_poses(refuse, model):
    def change(folder, files):
        data, rng = files.data, np.random.default_rng(5)
        turn = Rotation.random(len(data.cameras), rng=rng).as_matrix()
        if model == "upside down":
            turn = np.broadcast_to(np.eye(3), turn.shape)
        wild = replace(
            data.cameras, rotations=np.ascontiguousarray(turn), crs=EPSG,
            centres=data.cameras.centres + rng.normal(0.0, 0.2, data.cameras.centres.shape),
        )  # fmt: skip
        shutil.rmtree(folder / "model")
        write_colmap(folder / "model", wild, data.ties)

    refuse("adjust.behind", change=change)


def test_all_under_water(refuse, drowned):
    def change(folder, _):
        for name in ("gnss.csv", "cloud.las"):
            shutil.copy(drowned.folder / name, folder / name)
        shutil.rmtree(folder / "model")
        shutil.copytree(drowned.folder / "model", folder / "model")

    refuse("water.no_land", "--free", "level", water=drowned.water, change=change)
