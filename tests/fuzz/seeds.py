"""Small files that the readers read, written anew each time or from the shared data."""

from __future__ import annotations

import io
import json
import shutil
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import rasterio
import shapely
from PIL import Image
from pyogrio import raw
from scipy.spatial.transform import Rotation

from pcfix.io.cameras.colmap import BY_NAME, place_text
from pcfix.io.cameras.colmap import FILE as FILE_OF_PLACE
from pcfix.io.members import FILE, write_members
from pcfix.model import Cameras, Lens
from tests.io import test_views as views
from tests.io.cameras import test_blocksexchange as blocksexchange
from tests.io.cameras import test_colmap as colmap
from tests.io.cameras import test_metashape as metashape
from tests.io.cameras import test_nvm as nvm
from tests.io.cameras import test_opensfm as opensfm
from tests.io.cameras import test_opf as opf_test
from tests.io.cameras import test_pix4d as pix4d
from tests.utils.clouds import random_cloud, write_cloud
from tests.utils.copc import write_copc
from tests.utils.pose_files import WRITERS
from tests.utils.pose_files import opf as opf_files
from tests.utils.pose_files.block import Block, PoseFile
from tests.utils.shared import SHARED

LENS = Lens(1500.0, 1600.0, 1200.0, 800.0, 600.0)
DOWN = np.diag([1.0, -1.0, -1.0])
TURNS = DOWN @ Rotation.from_euler("xyz", [[9, 3, 40 * i] for i in range(4)], True).as_matrix()
LARGEST_BYTES = 200_000
"""Of files that somebody made; larger ones are mutated in vain, mostly."""


Seed: TypeAlias = "Callable[[Path], Path | PoseFile]"
"""Writes files into a folder, and returns what is given to the reader of them."""


def block(k: int = 4) -> Block:
    rng = np.random.default_rng(3)
    places = np.array([500_000.0, 5_200_000.0, 80.0]) + rng.uniform(0.0, 40.0, (k, 3))
    labels = tuple(f"IMG_{i:04d}.jpg" for i in range(k))
    return Block(labels, places, TURNS[:k], 1500.0, 1600, 1200, 32632)


def cameras() -> Cameras:
    """Return the cameras of `block`, for readers that need some."""
    made = block()
    return Cameras(made.labels, made.centres, made.rotations, (LENS,) * 4, "EPSG:32632")


def views_cameras() -> Cameras:
    lens = Lens(1000.0, 800.0, 600.0, 400.0, 300.0)
    centres = np.column_stack([40.0 * np.arange(8), np.zeros(8), np.full(8, 100.0)])
    return Cameras(views.NAMES, centres, np.tile(DOWN, (8, 1, 1)), (lens,) * 8)


def of(name: str) -> Seed:
    """Return the files that `tests.utils.pose_files` writes."""
    return lambda folder: WRITERS[name](folder, block())


def text(name: str, content: Any) -> Seed:
    def write(folder: Path) -> Path:
        made = content if isinstance(content, str | bytes) else json.dumps(content, indent=1)
        (folder / name).write_bytes(made.encode() if isinstance(made, str) else made)
        return folder / name

    return write


def shared(*parts: str, give: str = "") -> dict[str, Seed]:
    """Return small files of the shared data, where these are."""
    source = SHARED.joinpath("data", *parts)
    if not source.exists():
        return {}
    top = source if source.is_dir() else source.parent
    each = [source] if source.is_file() else sorted(source.rglob("*"))
    small = [
        one for one in each
        if one.is_file() and one.stat().st_size < LARGEST_BYTES
        and one.name not in ("check.json", "SOURCE.txt", "README.md")
    ]  # fmt: skip

    def write(folder: Path) -> Path:
        for one in small:
            place = folder / "given" / one.relative_to(top)
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(one, place)
        return folder / "given" / (source.name if source.is_file() else give)

    return {"shared " + "/".join(parts): write}


def opf_with_tracks(folder: Path) -> Path:
    made = block()
    rng = np.random.default_rng(1)
    xyz = made.centres.mean(axis=0) - [0.0, 0.0, 60.0] + rng.uniform(-6.0, 6.0, (10, 3))
    point, camera = np.repeat(np.arange(10), 2), np.tile([0, 1], 10)
    return opf_files.opf(
        folder, made, None, (xyz, point, camera, rng.uniform(0, 1000, (20, 2)))
    ).path


def opensfm_with_tracks(folder: Path) -> Path:
    lines = ["OPENSFM_TRACKS_VERSION_v1"]
    lines += [f"{i}.jpg\t{j}\t{j}\t0.{j}\t-0.125\t0.01\t2\t1\t2" for i in "ab" for j in range(5)]
    (folder / "tracks.csv").write_text("\n".join(lines) + "\n")
    points = {str(j): {"coordinates": [j, 2, 3]} for j in range(5)}
    gps = {"gps_position": [1.0, 2.0, 3.0], "gps_dop": 5.0, "capture_time": 1.5e9}
    shots = dict.fromkeys(("a.jpg", "b.jpg"), opensfm.SHOT | gps)
    return opensfm.write(folder, opensfm.scene(shots=shots, points=points))


def pix4d_params(folder: Path) -> Path:
    label = "a b.jpg"
    return pix4d.params(
        folder,
        parameters=pix4d.HEADER + pix4d.block(label, (10.5, 20.25, 30.0)),
        offset="500000.000 4000000.000 100.000\n",
        external=pix4d.external((label, 500_010.5, 4_000_020.25, 130.0, 0, 0, 0)),
        wkt=pix4d.utm_wkt(),
        bingo=f"{label} 1\n1 10.5 -20.5\n2 3.25 4\n-99\n",
        ties="1 0 10.5 20.5 1.5\n",
        gcps="g1 500000 4000000 10 500000.1 4000000.1 10.1\n",
    )


def odm_images(folder: Path) -> Path:
    place = {"latitude": 46.9, "longitude": 9.0, "altitude": 90.0, "utc_time": 1e12}
    rest = place | {"gps_xy_stddev": 2.0, "gps_z_stddev": 3.0}
    return text("images.json", [{"filename": one} | rest for one in block().labels])(folder)


def odm_project(folder: Path) -> Path:
    odm_images(folder)
    return WRITERS["ODM up to 2020"](folder, block()).path


def blocks_exchange(folder: Path) -> Path:
    made = blocksexchange
    orientation = (
        "<CameraOrientation>XRightYDown</CameraOrientation><Distortion><K1>-0.1</K1><K2>0.01</K2>"
        "<K3>0</K3><P1>0.001</P1><P2>0</P2></Distortion>"
    )
    inside = made.simple(
        made.photo(1, made.matrix()), made.photo(2), head=made.GROUP + orientation,
        tail=f"<TiePoints>{made.TIE}</TiePoints>",
    )  # fmt: skip
    return made.write(folder, inside)


def bundle_file(folder: Path) -> Path:
    return nvm.write_bundle(folder, nvm.bundle()[0])


def nvm_file(folder: Path) -> Path:
    return nvm.write(
        folder, nvm.model(nvm.camera_line("a.jpg"), points=nvm.point_lines(nvm.measured())[:8])
    )


def packed(inside: Callable[[Path], Path], name: str, entry: str) -> Callable[[Path], Path]:
    """Return what writes a file into an archive."""

    def write(folder: Path) -> Path:
        content = inside(folder)
        with zipfile.ZipFile(folder / name, "w") as archive:
            archive.write(content, entry)
        content.unlink()
        return folder / name

    return write


def metashape_chunk(folder: Path) -> Path:
    """Write a chunk with every kind of sensor, GNSS positions, a slave and two components."""
    made = metashape
    frame = "<f>100</f><cx>1</cx><cy>2</cy><k1>0.1</k1><p1>0.01</p1><b1>1</b1>"
    old = "<fx>101</fx><fy>100</fy><cx>33</cx><cy>16</cy><skew>0.25</skew><k1>0.1</k1>"
    sheet = "".join(
        f'<property name="{name}" value="{value}"/>'
        for name, value in (("pixel_width", 0.01), ("pixel_height", 0.01), ("focal_length", 8))
    )
    slave = made.calibration() + f"<rotation>{made.QUARTER}</rotation><location>1 0 0</location>"
    kinds = ("fisheye", "equisolid_fisheye", "spherical")
    sensors = [made.sensor(made.calibration(frame)), made.sensor(made.calibration(old), 1)]
    sensors += [made.sensor(sheet, 2), made.sensor(slave, 3, 'type="frame" master_id="0"')]
    sensors += [
        made.sensor(made.calibration("<f>20</f><k1>0.1</k1>", kind), i, f'type="{kind}"')
        for i, kind in enumerate(kinds, start=4)
    ]
    place = made.reference('x="-0.6" y="39" z="101" sxyz="3" enabled="true"')
    images = [made.camera(0, place)] + [
        made.camera(i, attributes=f'sensor_id="{i}" component_id="0"') for i in (1, 2, 4, 5, 6)
    ]
    images.append(made.camera(3, "", 'sensor_id="3" master_id="0"'))
    rest = made.components(made.transform(), made.transform("0 0 0", scale="10")) + made.MARKERS
    rest += f"<reference>{made.UTM30}</reference><camera_reference>{made.WGS84}</camera_reference>"
    rest += '<settings><property name="accuracy_cameras" value="10"/></settings>'
    return made.write(folder, made.chunk("".join(sensors), "".join(images), rest))


def markers(folder: Path) -> Path:
    """Write marks of one point as Metashape exports them."""
    named = "".join(metashape.camera(i, label=f"{one}.jpg") for i, one in enumerate("ab"))
    seen = "".join(f'<location camera_id="{i}" pinned="true" x="9.5" y="7"/>' for i in (0, 1))
    place = '<reference x="500010" y="4000010" z="2.5" sxyz="0.02" enabled="true"/>'
    rest = (
        f'<markers><marker id="0" label="G1">{place}</marker></markers><frames><frame id="0">'
        f'<markers><marker marker_id="0">{seen}</marker></markers></frame></frames>'
    )
    return metashape.write(folder, metashape.chunk(cameras=named, rest=rest))


def colmap_text_folder(folder: Path) -> Path:
    made = colmap.folder(folder / "sparse")
    (made / FILE_OF_PLACE).write_text(place_text(np.array([1.0, 2.0, 3.0]), "EPSG:32636"))
    return made


def camera_lines() -> list[list[object]]:
    """Return a camera of every model of COLMAP, its numbers in the order of the file."""
    numbers = {"f": 500, "fx": 500, "fy": 510, "cx": 410, "cy": 290}
    return [
        [i + 1, model, 800, 600, *(numbers.get(name, 0.01) for name in names.split())]
        for i, (model, (names, projection, _)) in enumerate(BY_NAME.items())
        if projection
    ]


def colmap_lenses(folder: Path) -> Path:
    lines = camera_lines()
    images = "".join(f"{i} 1 0 0 0 {i} 0 0 {i} {i}.jpg\n\n" for i, *_ in lines)
    return colmap.folder(folder, "\n".join(" ".join(map(str, one)) for one in lines), images)


def colmap_binary_lenses(folder: Path) -> Path:
    lines = camera_lines()
    cameras, images = (struct.pack("<Q", len(lines)) for _ in range(2))
    for number, _, width, height, *values in lines:
        layout = f"<IiQQ{len(values)}d"
        cameras += struct.pack(layout, number, number - 1, width, height, *values)
        images += struct.pack("<I7dI", number, 1, 0, 0, 0, number, 0, 0, number)
        images += f"{number}.jpg".encode() + b"\0" + struct.pack("<Q", 0)
    (folder / "cameras.bin").write_bytes(cameras)
    (folder / "images.bin").write_bytes(images)
    return folder


def opensfm_lenses(folder: Path) -> Path:
    more = dict.fromkeys(
        ["k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s0", "s1", "s2", "s3"], 0.01
    )
    kinds = "perspective simple_radial radial brown fisheye fisheye_opencv fisheye62 fisheye624"
    cameras = {
        kind: opensfm.CAMERA | opensfm.AFFINE | more | {"projection_type": kind, "transition": 0.3}
        for kind in (*kinds.split(), "dual", "spherical")
    }
    shots = {f"{kind}.jpg": opensfm.SHOT | {"camera": kind} for kind in cameras}
    return opensfm.write(folder, opensfm.scene(cameras=cameras, shots=shots))


def opf_fisheye(folder: Path) -> Path:
    path = opf_with_tracks(folder)
    lens = opf_test.LENSES["fisheye"] | {"principal_point_px": [800.0, 600.0]}
    opf_test.change(folder, "calibrated-cameras.json", sensors=[{"id": 7, "internals": lens}])
    return path


def copc(folder: Path) -> Path:
    return write_copc(folder / "cloud.copc.laz", random_cloud(7, count=300, plain=True))


def vis(folder: Path) -> Path:
    xyz, lists = list_scene()
    views.write_model(folder / "sparse", [(i + 1, name) for i, name in enumerate(views.NAMES)])
    views.write_ply(folder / "fused.ply", xyz)
    return views.write_vis(folder / "fused.ply.vis", lists)


def openmvs(order: str, weights: bool = True) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        xyz, lists = list_scene()
        shares = [[0.5] * len(one) for one in lists]
        return views.write_ply(folder / "dense.ply", xyz, lists, shares if weights else None, order)

    return write


def list_scene() -> tuple[Any, Any]:
    xyz = np.random.default_rng(5).uniform([0, -25, -1], [280, 25, 1], (40, 3)).astype("f4")
    away = np.abs(xyz[:, :1] - views_cameras().centres[:, 0])
    return xyz, [np.flatnonzero(row < 0.4 * 99).tolist() for row in away]


PLANE = (
    "ply\nformat ascii 1.0\nelement vertex 4\nproperty double x\nproperty double y\nproperty double"
    " z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n0 0 1\n9 0 1.5\n"
    "9 9 1\n0 9 1\n3 0 1 2\n3 0 2 3\n"
)


def raster(folder: Path) -> Path:
    heights = np.linspace(1.0, 2.0, 80).reshape(8, 10)
    transform = rasterio.transform.from_origin(500_000.0, 5_200_000.0, 1.0, 1.0)
    profile = {"driver": "GTiff", "width": 10, "height": 8, "count": 1, "dtype": "float64"}
    with rasterio.open(
        folder / "water.tif", "w", crs="EPSG:32632", transform=transform, **profile
    ) as target:
        target.write(heights, 1)
    return folder / "water.tif"


def turned_raster(folder: Path) -> Path:
    """Write the rows from south to north, which GeoTIFF has a matrix for."""
    with rasterio.open(raster(folder)) as source:
        heights, profile = source.read(), source.profile
    profile["transform"] = rasterio.Affine(1.0, 0.0, 500_000.0, 0.0, 1.0, 5_200_000.0)
    with rasterio.open(folder / "water.tif", "w", **profile) as target:
        target.write(heights)
    return folder / "water.tif"


def vector(name: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        ring = np.array([[0, 0, 1], [50, 0, 1.1], [50, 50, 1], [0, 50, 1.2]])
        ring[:, :2] += 5e5, 5.2e6
        wkb = np.array([shapely.to_wkb(shapely.polygons(ring))], object)
        raw.write(
            folder / name, wkb, [], [], geometry_type="Polygon Z", crs="EPSG:32632", layer=None
        )
        return folder / name

    return write


def members(folder: Path) -> Path:
    from tests.flow.test_pose_errors import members_of

    (folder / "cameras.csv").write_text("label,x,y,z\n")
    write_members(folder, members_of(cameras(), 0.1))
    return folder / FILE


def picture(name: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        held = io.BytesIO()
        exif = Image.Exif()
        exif[0x010F] = "maker"
        exif.get_ifd(0x8769)[0x9003] = "2026:05:01 10:00:00"
        Image.new("RGB", (60, 40), (10, 200, 30)).save(
            held, {"jpg": "JPEG", "png": "PNG", "tif": "TIFF"}[name[-3:]], exif=exif
        )
        (folder / name).write_bytes(held.getvalue())
        return folder / name

    return write


def pictures(folder: Path) -> Path:
    """Write a picture of each image, whose EXIF data says when it was taken."""
    for label in block().labels:
        picture(label)(folder)
    return folder


def cloud(name: str, form: int) -> Callable[[Path], Path]:
    return lambda folder: write_cloud(folder / name, form, count=60)


def regression(folder: Path) -> Path:
    from pcfix.io.regressions import write_regression
    from pcfix.refract.regression import fit_depths

    rng = np.random.default_rng(4)
    x = rng.uniform(0.2, 5.0, 20)
    line = fit_depths(x, 0.05 + 1.4 * x + rng.normal(0, 0.1, 20))
    write_regression(folder / "line.json", line, overwrite=False)
    return folder / "line.json"


GNSS = "label,x,y,z,sx,sy,sz\n" + "".join(
    f"{label},{x},{y},{z},0.1,0.1,0.2\n"
    for label, (x, y, z) in zip(block().labels, block().centres.tolist(), strict=True)
)
GEO = "EPSG:32632\n" + "\n".join(
    f"{label} {x} {y} {z}"
    for label, (x, y, z) in zip(block().labels, block().centres.tolist(), strict=True)
)
TIMES = "label,time\n" + "".join(
    f"{one},2026-05-01T10:0{i}:00Z\n" for i, one in enumerate(block().labels)
)
LINE = "x,y,z\n500000,5200000,1.1\n500010,5200003,1.2\n500020,5200001,1.15\n500030,5200009,1\n"
SHAPE = {"type": "FeatureCollection", "crs": {"type": "name", "properties": {"name": "EPSG:32632"}},
         "features": [{"type": "Feature", "properties": {}, "geometry": {"type": "Polygon",
         "coordinates": [[[500000, 5200000, 1], [500050, 5200000, 1], [500050, 5200050, 1.5],
                          [500000, 5200000, 1]]]}}]}  # fmt: skip
TIDE = "time,level_m\n2026-05-01T10:00:00Z,1.0\n2026-05-01T11:00:00Z,1.4\n"
DEPTHS = "x,y,depth_m\n500000,5200000,1.5\n500001,5200000,0.25\n"
