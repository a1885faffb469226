"""Sequences through waves, against the same bed through calm water."""

import numpy as np
import pytest

pytest.importorskip("cv2", reason="photographs need the extra 'photos'")

import cv2

import pcfix
from pcfix.flow.photos import map_photos
from pcfix.io.photographs import read_frames
from pcfix.io.water import read_water_raster
from pcfix.model import Lens
from pcfix.photos.calm import corners_in, register, warped
from pcfix.photos.mapping import Photo
from pcfix.photos.waves import View, bed_places, slopes_of
from pcfix.water.surface import surface_above
from tests.utils.codes import refused
from tests.utils.rasters import write_raster
from tests.utils.renderer import Relief, Texture, rendered
from tests.utils.waves import Sea, bed_seen, frame

LENS = Lens(270.0, 240, 180, 120.0, 90.0)
PHOTO = Photo("f00", np.array([100.0, 50.0, 10.0]), np.diag([1.0, -1.0, -1.0]), LENS)
PLANE = (-2.0 - 0.03 * 100.0, 0.03, 0.0)
TEXTURE = Texture(0.15, 2.0)
INTERVAL_S = 0.2


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder of 16 frames of waves of 2 degrees rms, and the image of calm water."""
    place = tmp_path_factory.mktemp("frames")
    sea = Sea(2.0)
    for number in range(12):
        image, _ = frame(PHOTO, sea, INTERVAL_S * number, PLANE, TEXTURE)
        cv2.imwrite(str(place / f"f{number:02d}.png"), image)
    return place


@pytest.fixture(scope="module")
def calm():
    return frame(PHOTO, Sea(0.0), 0.0, PLANE, TEXTURE)[0]


def poses(path):
    path.write_text("label,x,y,z,yaw,pitch,roll\nf00,100,50,10,0,0,0\n", "utf-8")
    path.with_name("sensor.csv").write_text("focal,sensor_x,sensor_y\n27,24,18\n", "utf-8")
    return path


def off_px(one, other):
    pair = np.ascontiguousarray(one), np.ascontiguousarray(other)
    flow = cv2.DISOpticalFlow_create(1).calc(*pair, None)[12:-12, 12:-12]
    return float(np.sqrt((flow**2).sum(axis=2).mean()))


def test_slopes():
    """Where a pixel sees the bed through waves, told exactly, says how steep the water is."""
    rng = np.random.default_rng(5)
    sea = Sea(5.0)
    pixel = rng.uniform(10.0, 170.0, (500, 2))
    view = View(PHOTO, 0.0, 1.34, lambda xy: PLANE[0] + PLANE[1] * xy[:, 0])
    rays = np.column_stack([(pixel - [120.0, 90.0]) / 270.0, np.ones(500)]) @ PHOTO.rotation
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    place = bed_seen(rays, PHOTO.centre, sea, 1.0, PLANE)
    shift = np.zeros((500, 2))
    for _ in range(20):  # to the pixel that sees it through calm water
        there = bed_places(view, pixel + shift)
        shift += (place - there)[:, :2] * [1.0, -1.0] * 270.0 / 11.5
    height = np.zeros(500)
    for _ in range(6):
        xy = PHOTO.centre[:2] + ((height - 10.0) / rays[:, 2])[:, None] * rays[:, :2]
        height, slope = sea.at(xy, 1.0)
    found = slopes_of(view, xy, height, shift)
    assert found == pytest.approx(slope, abs=1e-6)  # the simulator steps to the surface


def test_registration():
    """Half of the image is land; the other half is displaced by 2 px rms, other in each frame."""
    rng = np.random.default_rng(2)
    noise = cv2.GaussianBlur(rng.uniform(0.0, 255.0, (300, 400)).astype(np.float32), (0, 0), 2.0)
    image = cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    shots, homographies = [], []
    for number in range(8):
        turn = 0.01 * number
        homography = np.array(
            [[1.0, -turn, 3.0 * number], [turn, 1.0, -2.0 * number], [1e-5, 0.0, 1.0]]
        )
        moved = cv2.GaussianBlur(rng.normal(0.0, 150.0, (300, 400, 2)), (0, 0), 20.0)
        moved[:, :200] = 0.0
        here = np.stack(np.meshgrid(np.arange(400), np.arange(300)), axis=2)
        wavy = cv2.remap(image, (here + moved).astype(np.float32), None, cv2.INTER_LINEAR)
        shot = warped(wavy[..., None], np.linalg.inv(homography) if number else np.eye(3))
        shots.append(shot)
        homographies.append(homography if number else np.eye(3))
    found = register(np.stack(list(corners_in(shots))))[0]
    corners = np.array([[30.0, 30.0, 1.0], [170.0, 30.0, 1.0], [30.0, 270.0, 1.0], [170.0, 270, 1]])
    for homography, truth in zip(found, homographies, strict=True):
        one, other = corners @ homography.T, corners @ truth.T
        away = one[:, :2] / one[:, 2:] - other[:, :2] / other[:, 2:]
        assert np.abs(away).max() < 0.1  # px


def test_calm(tmp_path, folder, calm):
    found = pcfix.calm_frames(folder, tmp_path / "calm.png", still=True)
    median = cv2.imread(str(tmp_path / "calm.png"), 0)
    before = np.mean([off_px(cv2.imread(str(p), 0), calm) for p in sorted(folder.iterdir())])
    assert off_px(median, calm) < 0.45 * before
    assert found.frames == 12
    assert found.moved_px == 0.0
    assert (tmp_path / "calm_spread.tif").exists()


def test_video(tmp_path, folder):
    """A lossless video gives the same image as its frames in a folder."""
    frames = [cv2.imread(str(path)) for path in sorted(folder.iterdir())]
    film = tmp_path / "film.avi"
    size = frames[0].shape[1::-1]
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter_fourcc(*"FFV1"), 10.0, size)
    for one in frames:
        one[..., 0] //= 2  # colours in another order would show
        writer.write(one)
    writer.release()
    colours = tmp_path / "frames"
    colours.mkdir()
    for number, one in enumerate(frames[::2]):
        cv2.imwrite(str(colours / f"{number}.png"), one)
    found = pcfix.calm_frames(film, tmp_path / "film.png", every=2)
    pcfix.calm_frames(colours, tmp_path / "calm.png")
    assert found.frames == 6
    median = cv2.imread(str(tmp_path / "film.png"))
    assert (median == cv2.imread(str(tmp_path / "calm.png"))).all()
    assert read_frames(film, 2).interval_s == pytest.approx(0.2)


def test_water(tmp_path, folder, calm):
    """Heights and slopes against those of the sea that the frames were made with."""
    found = pcfix.calm_frames(
        folder, tmp_path / "calm.png", still=True, surface=True, depth=2.0, interval=INTERVAL_S,
        resolution=0.3, cameras=poses(tmp_path / "cameras.csv"),
    )  # fmt: skip
    sea = Sea(2.0)
    x, y = np.meshgrid(np.arange(97.0, 103.0, 0.4), np.arange(48.0, 52.0, 0.4))
    xy = np.column_stack([x.ravel(), y.ravel()])
    off, size, inside = [], [], []
    for number in (0, 7, 11):
        water = read_water_raster(tmp_path / "calm_water" / f"f{number:02d}.tif")
        sigma = read_water_raster(tmp_path / "calm_water" / "sigma" / f"f{number:02d}.tif")
        above = surface_above(water, np.column_stack([xy, np.zeros(len(xy))]))
        error = surface_above(sigma, np.column_stack([xy, np.zeros(len(xy))])).height_m
        height, slope = sea.at(xy, INTERVAL_S * number)
        off.append(above.slope - slope)
        size.append(slope)
        inside.append(np.abs(above.height_m - height) < 1.96 * error)
    assert np.std(off) < 0.5 * np.std(size)
    assert np.mean(inside) > 0.6
    assert found.water.explained > 0.8
    shown = [mapped(tmp_path, folder, with_own) for with_own in (False, True)]
    dry, _ = rendered(PHOTO, bed(), TEXTURE)
    inner = np.s_[24:-24, 30:-30]  # what lies outside was not photographed through the water
    flat, own = (off_px(image[inner], dry[inner]) for image in shown)
    assert own < 0.5 * flat


def bed():
    x = 85.0 + 0.25 * (np.arange(120) + 0.5)
    return Relief(np.tile(PLANE[0] + PLANE[1] * x, (120, 1)), 85.0, 65.0, 0.25)


def mapped(place, folder, with_own):
    """Return a frame as if there were no water, by flat water or by its own."""
    one = place / "one"
    one.mkdir(exist_ok=True)
    (one / "f07.png").write_bytes((folder / "f07.png").read_bytes())
    (place / "poses.csv").write_text(poses(place / "cameras.csv").read_text().replace("f00", "f07"))
    write_raster(place / "bed.tif", *bed())
    map_photos(
        one, place / f"dry_{with_own}", cameras=place / "poses.csv", water="0",
        dsm=place / "bed.tif", water_per_image=place / "calm_water" if with_own else None,
    )  # fmt: skip
    return cv2.imread(str(place / f"dry_{with_own}" / "f07.png"), 0)


def test_bad_frames(tmp_path, folder, calm):
    mixed = tmp_path / "mixed"
    mixed.mkdir()
    for number in range(3):
        cv2.imwrite(str(mixed / f"{number}.png"), calm if number < 2 else calm[:90])
    with refused("photos.size"):
        pcfix.calm_frames(mixed, tmp_path / "calm.png")
    rng = np.random.default_rng(1)
    cv2.imwrite(str(mixed / "2.png"), rng.integers(0, 255, calm.shape).astype(np.uint8))
    with refused("frames.no_overlap", frames=["2"]):
        pcfix.calm_frames(mixed, tmp_path / "calm.png")
    (tmp_path / "film.mp4").write_bytes(b"no film")
    with refused("video.unreadable"):
        pcfix.calm_frames(tmp_path / "film.mp4", tmp_path / "calm.png")
    with refused("output.suffix"):
        pcfix.calm_frames(folder, tmp_path / "calm.jpg")
    with refused("option.missing"):
        pcfix.calm_frames(folder, tmp_path / "calm.png", surface=True, depth=2.0, gsd=0.02)
    assert not list(tmp_path.glob("calm*"))
