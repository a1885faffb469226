"""View lists: the cameras that contributed to each point."""

import operator
import struct
from dataclasses import replace
from functools import reduce
from pathlib import Path

import laspy
import numpy as np
import pytest

import pcfix
from pcfix.errors import InputError
from pcfix.io.views import ViewMatch, read_views, track_views
from pcfix.model import Cameras, Lens, TiePoints, Views
from tests.utils.codes import refused
from tests.utils.shared import needs

RENDERED, rendered = needs("rendered_a")

K = 8
NAMES = tuple(f"img_{i}.JPG" for i in range(K))


@pytest.fixture
def cameras():
    """Return eight nadir cameras in a row, 40 m apart and 100 m up, each 80 m wide."""
    lens = Lens(1000.0, 800.0, 600.0, 400.0, 300.0)
    centres = np.column_stack([40.0 * np.arange(K), np.zeros(K), np.full(K, 100.0)])
    down = np.diag([1.0, -1.0, -1.0])
    return Cameras(NAMES, centres, np.tile(down, (K, 1, 1)), (lens,) * K)


@pytest.fixture
def scene():
    return points_in_sight(400)


def points_in_sight(count):
    """Return points and, for each, the cameras that see it."""
    xyz = np.random.default_rng(5).uniform([0, -25, -1], [280, 25, 1], (count, 3)).astype("f4")
    away = np.abs(xyz[:, :1] - 40.0 * np.arange(K))
    return xyz.astype(float), [np.flatnonzero(row < 0.4 * 99).tolist() for row in away]


def write_vis(path, lists):
    path.write_bytes(
        struct.pack("<Q", len(lists))
        + b"".join(struct.pack(f"<I{len(one)}I", len(one), *one) for one in lists)
    )
    return path


def write_ply(path, xyz, lists=None, weights=None, order="<", count="uint8", position="float"):
    """Write a PLY file point by point, with a second element before the vertices."""
    names = {"<": "binary_little_endian", ">": "binary_big_endian"}
    head = [
        *("ply", f"format {names[order]} 1.0", "comment by a test", "element camera 2"),
        *("property double focal", f"element vertex {len(xyz)}"),
        *(f"property {position} {axis}" for axis in "xyz"),
        "property uchar red",
    ]
    head += [] if lists is None else [f"property list {count} uint32 view_indices"]
    head += ["property short label"]
    head += [] if weights is None else [f"property list {count} float32 view_weights"]
    letter = {"uint8": "B", "ushort": "H", "uint32": "I"}
    body = b""

    def put(code, *values):
        nonlocal body
        body += struct.pack(f"{order}{len(values)}{code}", *values)

    put("d", 1.0, 2.0)
    for i, point in enumerate(xyz.tolist()):
        put(position[0], *point)
        put("B", 7)
        if lists is not None:
            put(letter[count], len(lists[i]))
            put("I", *lists[i])
        put("h", -3)
        if weights is not None:
            put(letter[count], len(weights[i]))
            put("f", *weights[i])
    path.write_bytes("\n".join([*head, "end_header", ""]).encode() + body)
    return path


def given(match, xyz, chunk=150):
    """Return the cameras of each point of a cloud in chunks, their weights, and the counts."""
    match = match.with_image_order(xyz[:chunk])
    found = [match.views_of(xyz[i : i + chunk], i) for i in range(0, len(xyz), chunk)]
    parts, report = [views for views, _ in found], reduce(operator.add, [one for _, one in found])
    weights = None if parts[0].weight is None else np.concatenate([one.weight for one in parts])
    rows = [row.tolist() for one in parts for row in np.split(one.camera, one.start[1:-1])]
    return rows, weights, report


def match_of(path, cameras, points=None, **more):
    return ViewMatch(read_views(path, cameras, **more), cameras, points=points)


def codes(report):
    return [note.code for note in report.notes()]


def write_model(folder, images):
    """Write images.bin (id, name) without points."""
    folder.mkdir(exist_ok=True)
    data = struct.pack("<Q", len(images))
    for number, name in images:
        data += struct.pack("<I7dI", number, 1, 0, 0, 0, 0, 0, 0, 1)
        data += name.encode() + b"\0" + struct.pack("<Q2dq", 1, 3.0, 4.0, -1)
    (folder / "images.bin").write_bytes(data)


# --- real lists ----------------------------------------------------------------------------


@rendered
def test_real_vis_and_ply():
    """Both kinds of list hold the same; the PLY has every third row and a local frame."""
    cameras, xyz = (
        pcfix.read_cameras(RENDERED / "cameras.csv"),
        laspy.read(RENDERED / "cloud.las").xyz,
    )
    vis = match_of(RENDERED / "dense.vis", cameras, len(xyz))
    expected, weights, report = given(vis, xyz, 100_000)
    assert (report.by_row, report.unmatched, report.share_seen) == (250_000, 0, 1.0)
    assert min(map(len, expected)) == 3 and max(map(len, expected)) == 13  # at least 3 depth maps
    assert expected[0] == [11, 12, 13, 22, 29] and weights is None
    assert report.entries == 1352598

    offset = np.loadtxt(RENDERED / "offset.txt", comments="#")
    views = read_views(RENDERED / "dense.ply", cameras, to_cloud=lambda points: points + offset)
    ply = ViewMatch(views, cameras, step_m=0.001)
    found, weights, report = given(ply, xyz, 100_000)
    assert found[::3] == expected[::3]
    strangers = sum(len(row) > 0 for i, row in enumerate(found) if i % 3)
    assert strangers < 1e-3 * len(xyz)  # points that chance brought within the tolerance
    assert report.by_row == 1
    assert report.unmatched / len(xyz) == pytest.approx(2 / 3, abs=1e-3)
    assert report.tolerance_m == pytest.approx(0.011, abs=0.001)
    assert len(weights) == report.entries and weights.min() > 0
    assert codes(report) == ["views.unmatched"]
    with refused("views.other_images", path=RENDERED / "dense.ply", share=0.0):
        read_views(RENDERED / "dense.ply", cameras)


# --- small lists by the definition -----------------------------------------------------------


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("count", ["uint8", "ushort", "uint32"])
def test_ply_layouts(tmp_path, cameras, scene, order, count, monkeypatch):
    monkeypatch.setattr("pcfix.io.ply._ROWS_AT_ONCE", 150)
    xyz, lists = scene
    weights = [[0.25 * (k + 1) for k in one] for one in lists]
    match = match_of(write_ply(tmp_path / "d.ply", xyz, lists, weights, order, count), cameras)
    found, found_weights, report = given(match, xyz)
    assert found == lists
    assert found_weights.tolist() == [w for one in weights for w in one]
    assert (report.by_row, report.share_seen) == (400, 1.0)


def test_vis_without_positions(tmp_path, cameras, scene):
    xyz, lists = scene
    lists[7] = []
    path = write_vis(tmp_path / "fused.ply.vis", lists)
    match = match_of(path, cameras, 400)
    found, _, report = given(match, xyz)
    assert found == lists
    assert report.by_row == 400 and report.tolerance_m is None
    assert codes(report) == []
    for points in (399, None):
        with refused("views.other_points", listed=400, points=points):
            match_of(path, cameras, points)
    write_ply(tmp_path / "fused.ply", xyz[:399])  # of another cloud
    assert given(match_of(path, cameras, 400), xyz)[0] == lists


@pytest.mark.parametrize("name", ["fused.ply.vis", "fused.ply"])
def test_vis_with_positions(tmp_path, cameras, scene, name):
    xyz, lists = scene
    write_vis(tmp_path / "fused.ply.vis", lists)
    write_ply(tmp_path / "fused.ply", xyz)
    some = np.random.default_rng(1).permutation(400)[:250]
    match = ViewMatch(read_views(tmp_path / name, cameras), cameras, step_m=0.01)
    found, _, report = given(match, xyz[some].round(2))
    assert found == [lists[i] for i in some]
    assert report.by_position + report.by_row == 250
    assert report.by_position > 240 and report.unmatched == 0


def test_tolerance(tmp_path, cameras, scene):
    xyz, lists = scene
    views = read_views(write_ply(tmp_path / "d.ply", xyz, lists), cameras)
    moved = xyz + np.array([0, 0, 0.3])
    strict = ViewMatch(views, cameras)
    loose = ViewMatch(replace(views, tolerance_spacings=0.3001 / views.spacing_m), cameras)
    assert strict.tolerance_m < 0.3
    found, _, report = given(strict, moved)
    assert found == [[]] * 400 and report.unmatched == 400
    with refused("views.no_match", points=400, listed=400):
        report.notes()
    found, _, report = given(loose, moved)
    assert sum(a == b for a, b in zip(found, lists, strict=True)) > 390


def test_a_row_is_missing(tmp_path, cameras, scene):
    xyz, lists = scene
    match = match_of(write_ply(tmp_path / "d.ply", xyz, lists), cameras)
    keep = np.delete(np.arange(400), 200)
    found, _, report = given(match, xyz[keep])
    assert found == [lists[i] for i in keep]
    assert (report.by_row, report.by_position) == (200, 199)


# --- the order of the images -------------------------------------------------------------------


@pytest.mark.parametrize("by", ["file", "id"])
def test_orders_of_a_model(tmp_path, cameras, scene, by):
    xyz, lists = scene
    ids = [40, 10, 30, 20, 80, 70, 60, 50]  # in the file; image i of NAMES has ids[i]
    write_model(tmp_path / "sparse", list(zip(ids, NAMES, strict=True)))
    order = {"file": ids, "id": sorted(ids)}[by]
    number = {ids.index(image): k for k, image in enumerate(order)}
    listed = [[number[c] for c in one] for one in lists]
    assert given(match_of(write_ply(tmp_path / "d.ply", xyz, listed), cameras), xyz)[0] == lists
    path = write_vis(tmp_path / "fused.ply.vis", listed)
    assert given(match_of(path, cameras, 400), xyz)[0] == lists


def test_text_model(tmp_path, cameras, scene):
    xyz, lists = scene
    text = "# IMAGE_ID, ...\n"
    for i in reversed(range(K)):
        text += f"{i + 1} 1 0 0 0 0 0 0 1 undistorted/img_{i}.tif\n" + "\n" * (i % 2)
        text += "" if i % 2 else "1.0 2.0 -1\n"
    (tmp_path / "images.txt").write_text(text)
    listed = [[K - 1 - c for c in one] for one in lists]
    views = read_views(write_ply(tmp_path / "d.ply", xyz, listed), cameras)
    assert given(ViewMatch(views, cameras), xyz)[0] == lists


def test_images_without_a_pose(tmp_path, cameras, scene):
    xyz, lists = scene
    names = [*NAMES[:3], "lost.JPG", *NAMES[3:]]
    listed = [[c + (c > 2) for c in one] + [3] for one in lists]
    path = write_vis(tmp_path / "fused.ply.vis", listed)
    write_model(tmp_path, list(enumerate(names)))
    match = match_of(path, cameras, 400)
    found, _, report = given(match, xyz)
    assert found == lists
    assert report.unposed_entries == 400
    assert codes(report) == ["views.unposed"]


def test_damaged_model(tmp_path, cameras, scene):
    xyz, lists = scene
    (tmp_path / "sparse").mkdir()
    (tmp_path / "sparse/images.bin").write_bytes(struct.pack("<QI", 10**15, 1))
    (tmp_path / "images.txt").write_text("one two\n")
    views = read_views(write_ply(tmp_path / "d.ply", xyz, lists), cameras)
    assert views.orders[0].tolist() == list(range(K))


# --- tie points ------------------------------------------------------------------------------


def test_nearest_track(cameras, scene):
    xyz, lists = scene
    sparse = xyz.copy()
    sparse[5] = np.nan
    again = [[*reversed(one), one[0]] for one in lists]  # out of order, one image twice
    start = np.concatenate([[0], np.cumsum([len(one) for one in again])])
    tracks = Views(start, np.concatenate(again))
    ties = TiePoints(sparse, tracks, np.zeros((len(tracks.camera), 2)))
    views = track_views(Path("m"), ties, cameras)
    match = ViewMatch(views, cameras)
    near = np.delete(xyz, 5, axis=0) + np.array([0, 0, 0.02])
    found, _, report = given(match, near)
    assert found == lists[:5] + lists[6:]
    assert len(views) == 399 and report.tolerance_m == 2 * views.spacing_m


# --- errors ------------------------------------------------------------------------------------


def test_images_that_do_not_exist(tmp_path, cameras, scene):
    path = write_vis(tmp_path / "fused.ply.vis", [*scene[1][1:], [1, K]])
    with refused("views.image_number", path=path, value=K):
        read_views(path, cameras)
    write_model(tmp_path, [(i, f"DSC_{i}") for i in range(K + 1)])
    with refused("views.other_block", path=path):
        read_views(path, cameras)


START = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
LISTED = b"property list uchar int view_indices\n"
HEAD = (
    START.replace(b"vertex 1", b"vertex 2") + b"property float x\nproperty float y\n"
    b"property float z\n" + LISTED + b"property list uchar float view_weights\nend_header\n"
)


def vertex(x, image, *weights):
    return struct.pack(f"<3fBiB{len(weights)}f", 0, 0, x, 1, image, len(weights), *weights)


COMPLETE = HEAD + vertex(0, 0, 0.5)
BAD = [
    (b"", "views.damaged"),
    (struct.pack("<Q", 2**60) + b"\0" * 8, "views.damaged"),  # too many points
    (struct.pack("<Q3I", 2, 1, 0, 5), "views.damaged"),  # the second list does not end
    (struct.pack("<Q3I", 1, 1, 0, 7), "views.damaged"),  # bytes after the lists
    (struct.pack("<Q2I", 1, 1, 2**32 - 1), "views.image_number"),
    (b"LASF" + b"\0" * 300, "views.damaged"),
    (START.replace(b"vertex", b"face") + b"end_header\n", "ply.element_missing"),
    (START.replace(b"binary_", b"odd_") + b"end_header\n", "ply.header"),
    (START.replace(b"binary_little_endian", b"ascii") + b"end_header\n", "ply.text"),
    (START.replace(b"vertex 1", b"vertex -1") + b"end_header\n", "ply.header"),
    (START + LISTED.replace(b"uchar", b"float") + b"end_header\n", "ply.header"),
    (START + LISTED + b"end_header\n\1\0\0\0\0", "views.no_positions"),
    (START + b"property float x\nend_header\n\0\0\0\0", "views.no_lists"),
    (COMPLETE, "ply.cut_short"),
    (COMPLETE + vertex(1, 1, 0.5)[:-1], "ply.cut_short"),
    (COMPLETE + vertex(1, -1, 0.5), "views.image_number"),
    (COMPLETE + vertex(np.nan, 1, 0.5), "views.not_finite"),
    (COMPLETE + vertex(1, 1, 0.5, 0.5), "views.weights"),
]


@pytest.mark.parametrize(("data", "code"), BAD)
def test_bad_files(tmp_path, cameras, data, code):
    path = tmp_path / "list.vis"
    path.write_bytes(data)
    with refused(code, InputError, path=path):
        read_views(path, cameras)
