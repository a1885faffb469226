"""Every reader of files that people give, and small files for it, which are damaged."""

import io
import json
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import rasterio
import shapely
from PIL import Image
from pyogrio import raw

import pcfix
from pcfix.io.cameras import read_tie_points
from pcfix.io.cameras.colmap import FILE as FILE_OF_PLACE
from pcfix.io.cameras.colmap import write_colmap
from pcfix.io.clouds import open_cloud, read_cloud
from pcfix.io.files import ENSEMBLE, find_members, write_members
from pcfix.io.ground_control import read_gnss, read_ground_control
from pcfix.io.photographs import read_image_times, read_photograph, size_of
from pcfix.io.tables import read_check_depths
from pcfix.io.vectors import read_shoreline, read_water_polygons
from pcfix.io.views import ViewMatch, read_views
from pcfix.io.water import read_tide
from pcfix.model import Cameras, Lens
from tests.flow.test_pose_errors import members_of
from tests.io import test_ground_control as control
from tests.io import test_vectors as vectors
from tests.io import test_views as views
from tests.io import test_water as water
from tests.io.cameras import test_blocksexchange as blocksexchange
from tests.io.cameras import test_colmap as colmap
from tests.io.cameras import test_metashape as metashape
from tests.io.cameras import test_micmac as micmac
from tests.io.cameras import test_nvm as nvm
from tests.io.cameras import test_odm as odm
from tests.io.cameras import test_opensfm as opensfm
from tests.io.cameras import test_pix4d as pix4d
from tests.io.cameras import test_realitycapture as realitycapture
from tests.io.cameras import test_table as table
from tests.io.cameras import test_unsupported as unsupported
from tests.io.cameras.test_writing import COLMAP_LENSES
from tests.utils import opf_files
from tests.utils.blocks import small_block
from tests.utils.clouds import random_cloud, write_cloud
from tests.utils.copc import write_copc

# Writes files into a folder, and returns what is given to the reader of them.
Seed: TypeAlias = "Callable[[Path], Path]"

LABELS = tuple(f"IMG_{i:04d}.jpg" for i in range(4))
PLACES = np.random.default_rng(3).uniform(
    [5e5, 5.2e6, 80.0], [500_040.0, 5_200_040.0, 120.0], (4, 3)
)
DOWN = np.diag([1.0, -1.0, -1.0])


def cameras(labels: tuple[str, ...] = LABELS, places: np.ndarray = PLACES) -> Cameras:
    """Return nadir cameras, for readers that need some."""
    lens = Lens(1000.0, 1600.0, 1200.0, 800.0, 600.0)
    turns = np.tile(DOWN, (len(labels), 1, 1))
    return Cameras(labels, places, turns, (lens,) * len(labels), "EPSG:32632")


def views_cameras() -> Cameras:
    return cameras(views.NAMES, np.column_stack([40.0 * np.arange(8), [0.0] * 8, [100.0] * 8]))


# Files


def text(name: str, content: Any) -> Seed:
    def write(folder: Path) -> Path:
        made = content if isinstance(content, str | bytes) else json.dumps(content, indent=1)
        (folder / name).write_bytes(made.encode() if isinstance(made, str) else made)
        return folder / name

    return write


def packed(inside: Seed, name: str, entry: str) -> Seed:
    """Return what writes a file into an archive."""

    def write(folder: Path) -> Path:
        content = inside(folder)
        with zipfile.ZipFile(folder / name, "w") as archive:
            archive.write(content, entry)
        content.unlink()
        return folder / name

    return write


def metashape_chunk(folder: Path) -> Path:
    """Write sensors of several kinds, GNSS positions, a slave and two components."""
    made = metashape
    old = "<fx>101</fx><fy>100</fy><cx>33</cx><cy>16</cy><skew>0.25</skew><k1>0.1</k1>"
    slave = made.calibration() + f"<rotation>{made.QUARTER}</rotation><location>1 0 0</location>"
    fish = made.calibration("<f>20</f><k1>0.1</k1>", "fisheye")
    sensors = made.sensor() + made.sensor(made.calibration(old), 1)
    sensors += made.sensor(slave, 2, 'type="frame" master_id="0"')
    sensors += made.sensor(fish, 3, 'type="fisheye"')
    images = made.camera(0, made.reference('x="-0.6" y="39" z="101" sxyz="3" enabled="true"'))
    images += made.camera(1, attributes='sensor_id="1" component_id="0"')
    images += made.camera(2, "", 'sensor_id="2" master_id="0"')
    images += made.camera(3, attributes='sensor_id="3" component_id="0"')
    rest = made.components(made.transform(), made.transform("0 0 0", scale="10")) + made.MARKERS
    rest += f"<reference>{made.UTM30}</reference><camera_reference>{made.WGS84}</camera_reference>"
    rest += '<settings><property name="accuracy_cameras" value="10"/></settings>'
    return made.write(folder, made.chunk(sensors, images, rest))


def pix4d_params(folder: Path) -> Path:
    label = "a b.jpg"
    return pix4d.params(
        folder,
        parameters=pix4d.HEADER + pix4d.block(label, (10.5, 20.25, 30.0)),
        offset="500000.000 4000000.000 100.000\n",
        external=pix4d.external((label, 500_010.5, 4_000_020.25, 130.0, 0, 0, 0)),
        wkt=pix4d.WKT,
        bingo="a b H_12_8\n1 10.5 -20.5\n2 3.25 4\n-99\n",
        gcps="g1 500000 4000000 10 500000.1 4000000.1 10.1\n",
    )


def opf_tracks(folder: Path) -> Path:
    rng = np.random.default_rng(1)
    xyz = PLACES.mean(axis=0) - [0.0, 0.0, 60.0] + rng.uniform(-6.0, 6.0, (10, 3))
    point, camera = np.repeat(np.arange(10), 2), np.tile([0, 1], 10)
    return opf_files.opf(folder, cameras(), None, (xyz, point, camera, rng.uniform(0, 9, (20, 2))))


def odm_project(folder: Path) -> Path:
    place = odm.transformation(odm.LON, odm.LAT)
    files = {"transformation": place, "coords": "WGS84 UTM 32N\n680000 5210000\n"}
    images = [{"filename": f"{i}.jpg"} | IMAGE for i in range(4)]
    block = odm.reconstruction(odm.PLACES, gnss=odm.PLACES)
    return odm.project(folder, reconstruction=block, images=images, **files)


def odm_shots(folder: Path) -> Path:
    shots = odm.geojson(odm.PLACES, {0: (odm.LON, odm.LAT, 100)})
    return odm.project(folder, shots=shots, cameras={"one": odm.CAMERA})


IMAGE = {"latitude": 46.9, "longitude": 9.0, "altitude": 90.0, "utc_time": 1e12}
IMAGE |= {"gps_xy_stddev": 2.0, "gps_z_stddev": 3.0}


def opensfm_tracks(folder: Path) -> Path:
    lines = ["OPENSFM_TRACKS_VERSION_v1"]
    lines += [f"{i}.jpg\t{j}\t{j}\t0.{j}\t-0.125\t0.01\t2\t1\t2" for i in "ab" for j in range(5)]
    (folder / "tracks.csv").write_text("\n".join(lines) + "\n")
    points = {str(j): {"coordinates": [j, 2, 3]} for j in range(5)}
    gps = {"gps_position": [1.0, 2.0, 3.0], "gps_dop": 5.0, "capture_time": 1.5e9}
    shots = dict.fromkeys(("a.jpg", "b.jpg"), opensfm.SHOT | gps)
    return opensfm.write(folder, opensfm.scene(shots=shots, points=points))


def colmap_lenses(folder: Path) -> Path:
    """Write a camera of every kind that COLMAP has."""
    write_colmap(
        folder / "lenses", small_block(tuple(COLMAP_LENSES.values()), k=len(COLMAP_LENSES))
    )
    return folder / "lenses"


def colmap_text(folder: Path) -> Path:
    made = colmap.folder(folder / "sparse")
    place = {"crs": "EPSG:32636", "offset_m": [1.0, 2.0, 3.0], "written_by": "pcfix"}
    (made / FILE_OF_PLACE).write_text(json.dumps(place))
    return made


def nvm_file(folder: Path) -> Path:
    points = nvm.point_lines(nvm.measured())[:8]
    return nvm.write(folder, nvm.model(nvm.camera_line("a.jpg"), points=points))


BLOCKS_EXCHANGE = blocksexchange.simple(
    blocksexchange.photo(1),
    blocksexchange.photo(2),
    head=blocksexchange.GROUP + blocksexchange.BROWN,
    tail=f"<TiePoints>{blocksexchange.TIE}</TiePoints>",
)
LOCAL_FRAME = BLOCKS_EXCHANGE.replace("EPSG:32632", "ENU:47.5,8.25")
OPK = "# Cameras (1)\n# PhotoID, X, Y, Z, Omega, Phi, Kappa\na.jpg\t1\t2\t3\t1\t2\t30\n"


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


def vis(folder: Path) -> Path:
    xyz, lists = views.points_in_sight(40)
    views.write_model(folder / "sparse", [(i + 1, name) for i, name in enumerate(views.NAMES)])
    views.write_ply(folder / "fused.ply", xyz)
    return views.write_vis(folder / "fused.ply.vis", lists)


def openmvs(order: str, weights: bool = True) -> Seed:
    def write(folder: Path) -> Path:
        xyz, lists = views.points_in_sight(40)
        shares = [[0.5] * len(one) for one in lists]
        return views.write_ply(folder / "dense.ply", xyz, lists, shares if weights else None, order)

    return write


SQUARE = [[0, 0, 1], [9, 0, 1.5], [9, 9, 1], [0, 9, 1]]
PLANE = water.ply(SQUARE, [[0, 1, 2], [0, 2, 3]])


def raster(folder: Path) -> Path:
    heights = np.linspace(1.0, 2.0, 80).reshape(8, 10)
    place = rasterio.Affine(1.0, 0.0, 500_000.0, 0.0, -1.0, 5_200_000.0)
    return water.write(folder / "water.tif", heights, place, "EPSG:32632", nodata=None)


def vector(name: str) -> Seed:
    def write(folder: Path) -> Path:
        ring = np.array([[0, 0, 1], [50, 0, 1.1], [50, 50, 1], [0, 50, 1.2]])
        ring[:, :2] += 5e5, 5.2e6
        wkb = np.array([shapely.to_wkb(shapely.polygons(ring))], object)
        raw.write(folder / name, wkb, [], [], geometry_type="Polygon Z", crs="EPSG:32632")
        return folder / name

    return write


def members(folder: Path) -> Path:
    (folder / "cameras.csv").write_text("label,x,y,z\n")
    write_members(folder, members_of(cameras(), 0.1))
    return folder / ENSEMBLE


def picture(name: str) -> Seed:
    def write(folder: Path) -> Path:
        held = io.BytesIO()
        exif = Image.Exif()
        exif[0x010F] = "maker"
        exif.get_ifd(0x8769)[0x9003] = "2026:05:01 10:00:00"
        form = {"jpg": "JPEG", "png": "PNG", "tif": "TIFF"}[name[-3:]]
        Image.new("RGB", (60, 40), (10, 200, 30)).save(held, form, exif=exif)
        (folder / name).write_bytes(held.getvalue())
        return folder / name

    return write


def pictures(folder: Path) -> Path:
    """Write a picture of each image, whose EXIF data says when it was taken."""
    for label in LABELS:
        picture(label)(folder)
    return folder


def cloud(name: str, form: int) -> Seed:
    return lambda folder: write_cloud(folder / name, form, count=60)


def copc(folder: Path) -> Path:
    return write_copc(folder / "cloud.copc.laz", random_cloud(7, count=300, plain=True))


ROWS = [f"{name},{x},{y},{z}" for name, (x, y, z) in zip(LABELS, PLACES.tolist(), strict=True)]
GNSS = "label,x,y,z,sx,sy,sz\n" + "".join(f"{row},0.1,0.1,0.2\n" for row in ROWS)
GEO = "EPSG:32632\n" + "\n".join(ROWS).replace(",", " ")
TIMES = "label,time\n" + "".join(f"{one},2026-05-01T10:00:00Z\n" for one in LABELS)
TIDE = "time,level_m\n2026-05-01T10:00:00Z,1.0\n2026-05-01T11:00:00Z,1.4\n"
DEPTHS = "x,y,depth_m\n500000,5200000,1.5\n500001,5200000,0.25\n"
LINE = "x,y,z\n500000,5200000,1.1\n500010,5200003,1.2\n500020,5200001,1.15\n500030,5200009,1\n"
RING = [[500000, 5200000, 1], [500050, 5200000, 1], [500050, 5200050, 1.5], [500000, 5200000, 1]]
SHAPE = {
    "type": "FeatureCollection",
    "crs": {"type": "name", "properties": {"name": "EPSG:32632"}},
    "features": [vectors.feature({"type": "Polygon", "coordinates": [RING]})],
}
ODM_MARKS = (
    "EPSG:32636\n500010 4000010 2.5 100 200 a.jpg G1\n500030 4000020 -1.75 0.5 1199 b.jpg G2\n"
)


# Readers


class Reader(NamedTuple):
    """What yields the results of a file, and the seeds."""

    read: Callable[[Path], Iterator[Any]]
    seeds: dict[str, Seed]


def read_block(path: Path) -> Iterator[Any]:
    found = pcfix.read_cameras(path)
    yield found
    yield read_tie_points(path, found)


def read_lists(path: Path) -> Iterator[Any]:
    found = read_views(path, views_cameras())
    count = len(found)
    yield ViewMatch(found, views_cameras(), points=count).views_of(np.zeros((count, 3)), 0)[0]


def read_lines(path: Path) -> Iterator[Any]:
    shore = read_shoreline(path, "EPSG:32632")
    yield shore.xyz[:, :2], shore.counts
    yield read_water_polygons(path, "EPSG:32632")


def read_picture(path: Path) -> Iterator[Any]:
    yield size_of(path)
    yield read_photograph(path)


def read_points(path: Path) -> Iterator[Any]:
    yield read_cloud(path)
    with open_cloud(path, 1) as source:
        yield sum(len(points) for points in source.chunks())


def read_members(path: Path) -> Iterator[Any]:
    found = find_members(path.parent / "cameras.csv")
    yield None if found is None else found[1]


def one(read: Callable[[Path], Any], **seeds: Seed) -> Reader:
    """Return a reader of one result."""

    def reader(path: Path) -> Iterator[Any]:
        yield read(path)

    return Reader(reader, seeds)


def block(**seeds: Seed) -> Reader:
    return Reader(read_block, seeds)


def times(path: Path) -> Any:
    return read_tide(path) if path.name == "tide.csv" else read_image_times(path, LABELS)


READERS: dict[str, Reader] = {
    "metashape": block(
        project=metashape.tie_project, chunk=metashape_chunk,
        packed=packed(metashape_chunk, "a.psz", "doc.xml"),
    ),
    "pix4d": block(params=pix4d_params),
    "opf": block(tracks=opf_tracks),
    "odm": block(project=odm_project, shots=odm_shots),
    "opensfm": block(tracks=opensfm_tracks),
    "colmap text": block(model=colmap_text),
    "colmap binary": block(
        model=lambda folder: colmap.binary_folder(folder / "sparse"),
        lenses=colmap_lenses,
    ),
    "micmac": block(
        one=text("Orientation-a.jpg.xml", micmac.embedded(micmac.RADIAL)), two=micmac.version_2
    ),
    "bundler": block(points=lambda folder: nvm.write_bundle(folder, nvm.bundle())),
    "nvm": block(points=nvm_file),
    "blocksexchange": block(
        ties=text("block.xml", BLOCKS_EXCHANGE), local=text("block.xml", LOCAL_FRAME),
        packed=packed(text("block.xml", BLOCKS_EXCHANGE), "block.xmlz", "block.xml"),
    ),
    "realitycapture": block(one=lambda folder: realitycapture.write(folder).parent),
    "table": block(
        reference=lambda folder: table.write(folder, table.METASHAPE_TABLE),
        opk=lambda folder: table.write(folder, OPK),
        lens=lambda folder: table.write(folder, table.RC + "a,4,1,6,1,5,-2,18" + ",0.01" * 8),
    ),
    "unsupported": block(
        **{name: text(name, data) for name, (data, _) in unsupported.FILES.items()}
    ),
    "views": Reader(read_lists, {
        "colmap": vis, "openmvs": openmvs("<"), "big": openmvs(">", False),
    }),
    "mesh": one(
        lambda path: pcfix.read_water(path, "EPSG:32632"),
        obj=text("water.obj", water.OBJ), ply=text("water.ply", PLANE),
    ),
    "raster": one(
        lambda path: pcfix.read_water(path, "EPSG:32632"), tif=raster
    ),
    "vectors": Reader(read_lines, {
        "csv": text("shore.csv", LINE), "geojson": text("water.geojson", SHAPE),
        "gpkg": vector("water.gpkg"), "shp": vector("water.shp"),
    }),
    "control": one(
        lambda path: read_ground_control(path, control.block(), crs="EPSG:32636"),
        table=text("gcps.csv", "\n".join([control.HEAD, *control.ROWS])),
        odm=text("gcp_list.txt", ODM_MARKS), markers=markers,
    ),
    "gnss": one(
        lambda path: read_gnss(path, cameras()),
        table=text("gnss.csv", GNSS), geo=text("geo.txt", GEO)
    ),
    "tides": one(
        times, pictures=pictures, tide=text("tide.csv", TIDE), times=text("times.csv", TIMES)
    ),
    "depths": one(read_check_depths, table=text("depths.csv", DEPTHS)),
    "members": Reader(read_members, {"npz": members}),
    "pictures": Reader(
        read_picture, {end: picture(f"a.{end}") for end in ("jpg", "png", "tif")}
    ),
    "las": Reader(read_points, {
        "1.4": cloud("cloud.las", 7), "1.2": cloud("cloud.las", 3), "copc": copc,
        "laz": cloud("cloud.laz", 6),
    }),
}  # fmt: skip
