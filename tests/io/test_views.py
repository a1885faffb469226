"""View lists: which cameras made each point."""

import shutil
import struct
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest

import pcfix
from pcfix.errors import InputError
from pcfix.io.views import ViewMatch, read_views, track_views
from pcfix.model import Cameras, Lens, TiePoints, Views
from tests.utils.shared import needs

RENDERED, rendered = needs("rendered_a")
FREE, free = needs("rendered_a_free")

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
def scene(cameras):
    """Return 400 points and, for each, the cameras that see it."""
    xyz = np.random.default_rng(5).uniform([0, -25, -1], [280, 25, 1], (400, 3)).astype("f4")
    away = np.abs(xyz[:, :1] - cameras.centres[:, 0])
    return xyz.astype(float), [np.flatnonzero(row < 0.4 * 99).tolist() for row in away]


def write_vis(path, lists):
    path.write_bytes(
        struct.pack("<Q", len(lists))
        + b"".join(struct.pack(f"<I{len(one)}I", len(one), *one) for one in lists)
    )
    return path


def write_ply(path, xyz, lists=None, weights=None, order="<", count="uint8", position="float"):
    """Write a PLY file point by point, with a second element before the vertices."""
    names = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}
    head = [
        *("ply", f"format {names[order]} 1.0", "comment by a test", "element camera 2"),
        *("property double focal", f"element vertex {len(xyz)}"),
        *(f"property {position} {axis}" for axis in "xyz"),
        "property uchar red",
    ]
    head += [] if lists is None else [f"property list {count} uint32 view_indices"]
    head += ["property short label"]
    head += [] if weights is None else [f"property list {count} float32 view_weights"]
    letter = {"uint8": "B", "ushort": "H", "uint32": "I", "float": "f", "double": "d"}
    text, body = [], b""

    def put(code, *values):
        nonlocal body
        text.append(" ".join(map(repr, values)))
        body += struct.pack(f"{order or '<'}{len(values)}{code}", *values)

    put("d", 1.0, 2.0)
    for i, point in enumerate(xyz.tolist()):
        put(letter[position], *point)
        put("B", 7)
        if lists is not None:
            put(letter[count], len(lists[i]))
            put("I", *lists[i])
        put("h", -3)
        if weights is not None:
            put(letter[count], len(weights[i]))
            put("f", *weights[i])
    head = "\n".join([*head, "end_header", ""]).encode()
    path.write_bytes(head + (body if order else ("\n".join(text) + "\n").encode()))
    return path


def rows_of(views):
    return [views.camera[a:b].tolist() for a, b in zip(views.start, views.start[1:], strict=False)]


def given(match, xyz, chunk=150):
    """Return the cameras of each point of a cloud that comes in chunks, and their weights."""
    parts = [match.for_chunk(xyz[i : i + chunk], i) for i in range(0, len(xyz), chunk)]
    weights = None
    if parts[0].weight is not None:
        weights = np.concatenate([p.weight for p in parts])
    return [row for p in parts for row in rows_of(p)], weights


def write_model(folder, images, frames=None):
    """Write images.bin (id, name) without points, and frames.bin of (frame, image ids)."""
    folder.mkdir(exist_ok=True)
    data = struct.pack("<Q", len(images))
    for number, name in images:
        data += struct.pack("<I7dI", number, 1, 0, 0, 0, 0, 0, 0, 1)
        data += name.encode() + b"\0" + struct.pack("<Q2dq", 1, 3.0, 4.0, -1)
    (folder / "images.bin").write_bytes(data)
    if frames is not None:
        data = struct.pack("<Q", len(frames))
        for number, ids in frames:
            data += struct.pack("<II7dI", number, 1, 1, 0, 0, 0, 0, 0, 0, len(ids))
            data += b"".join(struct.pack("<iIQ", 0, k, i) for k, i in enumerate(ids))
        (folder / "frames.bin").write_bytes(data)


# --- real lists ----------------------------------------------------------------------------


def cloud(folder):
    las = laspy.read(folder / "cloud.las")
    return np.column_stack([las.x, las.y, las.z])


def offset(folder):
    return np.loadtxt(folder / "offset.txt", comments="#")


@rendered
def test_vis_of_a_real_cloud_goes_by_row_and_every_listed_camera_sees_its_point():
    cameras, xyz = pcfix.read_cameras(RENDERED / "cameras.csv"), cloud(RENDERED)
    match = ViewMatch(read_views(RENDERED / "dense.vis", cameras), cameras, points=len(xyz))
    lists, weights = given(match, xyz, 100_000)
    report = match.report
    assert (report.by_row, report.unmatched, report.share_seen) == (250_000, 0, 1.0)
    assert min(map(len, lists)) == 3 and max(map(len, lists)) == 13  # at least 3 depth maps
    assert lists[0] == [11, 12, 13, 22, 29] and weights is None
    assert report.cameras_per_point == pytest.approx(1352598 / 250_000)


@rendered
def test_both_kinds_of_list_of_a_real_cloud_say_the_same():
    cameras, xyz = pcfix.read_cameras(RENDERED / "cameras.csv"), cloud(RENDERED)
    vis = ViewMatch(read_views(RENDERED / "dense.vis", cameras), cameras, points=len(xyz))
    expected, _ = given(vis, xyz, 250_000)
    views = read_views(
        RENDERED / "dense.ply", cameras, to_cloud=lambda points: points + offset(RENDERED)
    )
    match = ViewMatch(views, cameras, step_m=0.001)
    found, weights = given(match, xyz, 100_000)
    assert found[::3] == expected[::3]  # it holds every third row
    strangers = sum(len(row) > 0 for i, row in enumerate(found) if i % 3)
    assert strangers < 1e-3 * len(xyz)  # points that chance brought within the tolerance
    assert match.report.by_row == 1
    assert match.report.unmatched / len(xyz) == pytest.approx(2 / 3, abs=1e-3)
    assert match.report.distance_m(0.95) < 0.001  # mm in the LAS
    assert match.report.tolerance_m == pytest.approx(0.011, abs=0.001)
    assert len(weights) == match.report.entries and weights.min() > 0
    assert any("166,6" in text for text in match.report.warnings())


@rendered
def test_local_list_without_its_offset_is_refused():
    cameras = pcfix.read_cameras(RENDERED / "cameras.csv")
    with pytest.raises(InputError, match=r"dense.ply: only 0 % .*--cameras-offset"):
        read_views(RENDERED / "dense.ply", cameras)


@rendered
def test_cameras_in_another_order_are_refused_unless_a_model_tells_it(tmp_path):
    given_cameras = pcfix.read_cameras(RENDERED / "cameras.csv")
    turned = np.roll(np.arange(len(given_cameras)), 1)
    cameras = Cameras(
        tuple(given_cameras.labels[i] for i in turned),
        given_cameras.centres[turned],
        given_cameras.rotations[turned],
        tuple(given_cameras.lenses[i] for i in turned),
    )
    xyz = cloud(RENDERED)
    match = ViewMatch(read_views(RENDERED / "dense.vis", cameras), cameras, points=len(xyz))
    with pytest.raises(InputError, match=r"dense.vis: only 7\d % of the listed cameras"):
        match.for_chunk(xyz, 0)
    write_model(tmp_path, list(enumerate(given_cameras.labels)))
    views = read_views(shutil.copy(RENDERED / "dense.vis", tmp_path), cameras)
    assert given(ViewMatch(views, cameras, points=len(xyz)), xyz, 250_000)[0][0] == [
        *(12, 13, 14, 23, 30)
    ]


@free
def test_image_numbers_follow_the_file_of_a_real_model_not_its_ids():
    cameras, xyz = pcfix.read_cameras(RENDERED / "cameras.csv"), cloud(FREE)
    match = ViewMatch(read_views(FREE / "dense.vis", cameras), cameras, points=len(xyz))
    given(match, xyz, 100_000)
    assert match.report.image_order.startswith("the images of")
    assert match.report.share_seen > 0.999  # by id it is 0.38


# --- small lists by the definition -----------------------------------------------------------


@pytest.mark.parametrize("order", ["<", ">", ""])
@pytest.mark.parametrize("count", ["uint8", "ushort", "uint32"])
def test_ply_of_every_layout(tmp_path, cameras, scene, order, count):
    xyz, lists = scene
    weights = [[0.25 * (k + 1) for k in one] for one in lists]
    path = write_ply(tmp_path / "d.ply", xyz, lists, weights, order, count)
    match = ViewMatch(read_views(path, cameras), cameras)
    found, found_weights = given(match, xyz)
    assert found == lists
    assert found_weights.tolist() == [w for one in weights for w in one]
    assert (match.report.by_row, match.report.share_seen) == (400, 1.0)


def test_ply_of_doubles_without_weights(tmp_path, cameras, scene):
    xyz, lists = scene
    path = write_ply(tmp_path / "d.ply", xyz + 1e-9, lists, position="double")
    views = read_views(path, cameras)
    assert views.raw.xyz.tolist() == (xyz + 1e-9).tolist()
    assert given(ViewMatch(views, cameras), xyz)[1] is None


def test_vis_without_positions(tmp_path, cameras, scene):
    xyz, lists = scene
    lists[7] = []
    path = write_vis(tmp_path / "fused.ply.vis", lists)
    match = ViewMatch(read_views(path, cameras), cameras, points=400)
    assert given(match, xyz)[0] == lists
    assert match.report.by_row == 400 and match.report.tolerance_m is None
    assert match.report.without_camera == 1


@pytest.mark.parametrize("name", ["fused.ply.vis", "fused.ply"])
def test_vis_takes_positions_from_the_ply_beside_it(tmp_path, cameras, scene, name):
    xyz, lists = scene
    write_vis(tmp_path / "fused.ply.vis", lists)
    write_ply(tmp_path / "fused.ply", xyz)
    some = np.random.default_rng(1).permutation(400)[:250]
    match = ViewMatch(read_views(tmp_path / name, cameras), cameras)
    assert given(match, xyz[some])[0] == [lists[i] for i in some]
    assert match.report.by_position + match.report.by_row == 250
    assert match.report.by_position > 240 and match.report.unmatched == 0


def test_ply_of_another_count_beside_a_vis_is_not_used(tmp_path, cameras, scene):
    xyz, lists = scene
    path = write_vis(tmp_path / "fused.ply.vis", lists)
    write_ply(tmp_path / "fused.ply", xyz[:-1])
    match = ViewMatch(read_views(path, cameras), cameras, points=400)
    assert "fused.ply: has 399 points and fused.ply.vis has 400" in match.report.warnings()[0]


def test_thinned_shuffled_and_rounded_cloud_gets_its_own_lists(tmp_path, cameras, scene):
    xyz, lists = scene
    path = write_ply(tmp_path / "d.ply", xyz, lists)
    some = np.random.default_rng(2).permutation(400)[:300]
    match = ViewMatch(read_views(path, cameras), cameras, step_m=0.01)
    assert given(match, xyz[some].round(2))[0] == [lists[i] for i in some]
    assert match.report.unmatched == 0
    assert 0.001 < match.report.distance_m(0.5) < match.report.distance_m(0.95) < 0.009
    assert match.report.as_dict()["distance_95_m"] == match.report.distance_m(0.95)
    match.report.check()


def test_points_farther_than_the_tolerance_have_no_cameras(tmp_path, cameras, scene):
    xyz, lists = scene
    views = read_views(write_ply(tmp_path / "d.ply", xyz, lists), cameras)
    moved = xyz + np.array([0, 0, 0.3])
    strict = ViewMatch(views, cameras)
    loose = ViewMatch(replace(views, default_spacings=0.3001 / views.spacing_m), cameras)
    assert strict.report.tolerance_m < 0.3
    assert given(strict, moved)[0] == [[]] * 400 and strict.report.unmatched == 400
    with pytest.raises(InputError, match=r"none of the cloud's 400 points .*--cameras-offset"):
        strict.report.check()
    assert sum(a == b for a, b in zip(given(loose, moved)[0], lists, strict=True)) > 390
    assert loose.report.distance_m(0.5) == pytest.approx(0.3, abs=0.001)


def test_rows_that_agree_are_taken_though_others_are_missing(tmp_path, cameras, scene):
    xyz, lists = scene
    views = read_views(write_ply(tmp_path / "d.ply", xyz, lists), cameras)
    match = ViewMatch(views, cameras)
    keep = np.delete(np.arange(400), 200)
    assert given(match, xyz[keep])[0] == [lists[i] for i in keep]
    assert (match.report.by_row, match.report.by_position) == (200, 199)


def test_list_in_another_frame_is_carried_over(tmp_path, cameras, scene):
    xyz, lists = scene
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    shift = np.array([5e5, 4e6, 10.0])
    path = write_ply(tmp_path / "d.ply", xyz, lists)
    moved = Cameras(
        cameras.labels, cameras.centres @ turn.T + shift, cameras.rotations @ turn.T, cameras.lenses
    )
    views = read_views(path, moved, to_cloud=lambda p: p @ turn.T + shift)
    assert given(ViewMatch(views, moved, step_m=0.001), (xyz @ turn.T + shift).round(3))[0] == lists
    with pytest.raises(InputError, match=r"d.ply: only 0 %"):
        read_views(path, moved)


def test_positions_rounded_more_coarsely_than_their_spacing_are_told(tmp_path, cameras, scene):
    north = np.array([0.0, 4e6, 0])
    moved = Cameras(cameras.labels, cameras.centres + north, cameras.rotations, cameras.lenses)
    dense = scene[0] * [0.1, 0.01, 1]
    path = write_ply(tmp_path / "d.ply", dense + north, [[0]] * 400)
    match = ViewMatch(read_views(path, moved), moved)
    assert "neighbour's list" in match.report.warnings()[0]


# --- what the numbers mean -------------------------------------------------------------------


@pytest.mark.parametrize("by", ["file", "id", "frame"])
def test_order_of_images_is_found_among_those_of_the_model(tmp_path, cameras, scene, by):
    xyz, lists = scene
    ids = [40, 10, 30, 20, 80, 70, 60, 50]  # in the file; image i of NAMES has ids[i]
    frames = [(2, [10, 80]), (1, [60, 20]), (3, [30, 50]), (4, [40, 70])]
    write_model(tmp_path / "sparse", list(zip(ids, NAMES, strict=True)), frames)
    order = {"file": ids, "id": sorted(ids), "frame": [60, 20, 10, 80, 30, 50, 40, 70]}[by]
    number = {ids.index(image): k for k, image in enumerate(order)}
    listed = [[number[c] for c in one] for one in lists]
    views = read_views(write_ply(tmp_path / "d.ply", xyz, listed), cameras)
    assert given(ViewMatch(views, cameras), xyz)[0] == lists
    path = write_vis(tmp_path / "fused.ply.vis", listed)
    assert given(ViewMatch(read_views(path, cameras), cameras, points=400), xyz)[0] == lists


def test_order_of_a_text_model_with_empty_lines_and_other_folders(tmp_path, cameras, scene):
    xyz, lists = scene
    text = "# IMAGE_ID, ...\n"
    for i in reversed(range(K)):
        text += f"{i + 1} 1 0 0 0 0 0 0 1 undistorted/img_{i}.tif\n" + "\n" * (i % 2)
        text += "" if i % 2 else "1.0 2.0 -1\n"
    (tmp_path / "images.txt").write_text(text)
    listed = [[K - 1 - c for c in one] for one in lists]
    views = read_views(write_ply(tmp_path / "d.ply", xyz, listed), cameras)
    assert given(ViewMatch(views, cameras), xyz)[0] == lists
    assert views.orders[0].what.startswith("the images of")


def test_images_without_a_pose_are_left_out_and_counted(tmp_path, cameras, scene):
    xyz, lists = scene
    names = [*NAMES[:3], "lost.JPG", *NAMES[3:]]
    listed = [[c + (c > 2) for c in one] + [3] for one in lists]
    path = write_vis(tmp_path / "fused.ply.vis", listed)
    write_model(tmp_path, list(enumerate(names)))
    match = ViewMatch(read_views(path, cameras), cameras, points=400)
    assert given(match, xyz)[0] == lists
    assert match.report.unposed_entries == 400 and match.report.unposed == ("lost.JPG",)
    assert "400 entries name images without a pose, among them lost.JPG" in "".join(
        match.report.warnings()
    )


def test_cameras_that_look_elsewhere_are_counted(tmp_path, cameras, scene):
    """The last two of the row are 200 m and more from the first points, their frames 80 m wide."""
    xyz, lists = scene
    first = xyz[:, 0] < 20.0
    listed = [[*one, 6, 7] if near and i % 9 == 0 else one
              for i, (one, near) in enumerate(zip(lists, first, strict=True))]  # fmt: skip
    views = read_views(write_ply(tmp_path / "d.ply", xyz, listed), cameras)
    match = ViewMatch(views, cameras)
    assert given(match, xyz)[0] == listed
    points = int(np.count_nonzero(first[::9]))
    assert (match.report.beside_entries, match.report.beside_points) == (2 * points, points)
    assert f"{2 * points:,} entries, of {points:,} points, name" in match.report.warnings()[-1]


def test_damaged_model_beside_the_list_is_passed_over(tmp_path, cameras, scene):
    xyz, lists = scene
    (tmp_path / "sparse").mkdir()
    (tmp_path / "sparse/images.bin").write_bytes(struct.pack("<QI", 10**15, 1))
    (tmp_path / "images.txt").write_text("one two\n")
    views = read_views(write_ply(tmp_path / "d.ply", xyz, lists), cameras)
    assert views.orders[0].what == "the cameras as given"


def test_cameras_without_frames_leave_the_order_unproven(tmp_path, cameras, scene):
    xyz, lists = scene
    bare = Cameras(cameras.labels, cameras.centres)
    match = ViewMatch(read_views(write_ply(tmp_path / "d.ply", xyz, lists), bare), bare)
    assert given(match, xyz)[0] == lists
    assert match.report.share_seen is None and "have no frames" in match.report.warnings()[0]


# --- tie points ------------------------------------------------------------------------------


def tie_points(xyz, lists):
    start = np.concatenate([[0], np.cumsum([len(one) for one in lists])])
    camera = np.array([c for one in lists for c in one])
    return TiePoints(xyz, Views(start, camera), np.zeros((len(camera), 2)))


def test_nearest_track_is_taken(cameras, scene):
    xyz, lists = scene
    sparse = xyz.copy()
    sparse[5] = np.nan
    again = [[*reversed(one), one[0]] for one in lists]  # out of order, one image twice
    views = track_views(Path("m"), tie_points(sparse, again), cameras)
    match = ViewMatch(views, cameras)
    near = np.delete(xyz, 5, axis=0) + np.array([0, 0, 0.02])
    assert given(match, near)[0] == lists[:5] + lists[6:]
    assert len(views) == 399 and match.report.tolerance_m == 2 * views.spacing_m


def test_tracks_need_positions(cameras, scene):
    xyz, lists = scene
    with pytest.raises(InputError, match="m: has no tie points with positions"):
        track_views(Path("m"), tie_points(xyz * np.nan, lists), cameras)


# --- what is refused -------------------------------------------------------------------------


def test_counts_that_differ_without_positions(tmp_path, cameras, scene):
    views = read_views(write_vis(tmp_path / "fused.ply.vis", scene[1]), cameras)
    with pytest.raises(InputError, match=r"lists of 400 points, the cloud has 399, .* PLY file"):
        ViewMatch(views, cameras, points=399)
    with pytest.raises(InputError, match="unknown number"):
        ViewMatch(views, cameras)


def test_image_beyond_the_cameras(tmp_path, cameras, scene):
    scene[1][9] = [1, K]
    path = write_vis(tmp_path / "fused.ply.vis", scene[1])
    with pytest.raises(
        InputError, match=r"vis: names image number 8 .* there are 8 in the cameras"
    ):
        read_views(path, cameras)


def test_names_of_another_block(tmp_path, cameras, scene):
    path = write_vis(tmp_path / "fused.ply.vis", [*scene[1][1:], [1, K]])
    write_model(tmp_path, [(i, f"DSC_{i}") for i in range(K + 1)])
    with pytest.raises(InputError, match=r"none of the images .* DSC_0 and img_0.JPG"):
        read_views(path, cameras)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "0 bytes"),
        (b"label,x,y,z\na,1,2,3\n", "is not a whole COLMAP view list"),
        (struct.pack("<Q", 2**60) + b"\0" * 8, "would hold 1,152,921,504,606,846,976 points"),
        (struct.pack("<Q3I", 2, 1, 0, 5), "the list of point 1 of 2 does not end"),
        (struct.pack("<Q2I", 2, 2**32 - 1, 0), "the list of point 0 of 2 does not end"),
        (struct.pack("<Q3I", 1, 1, 0, 7), "4 bytes follow the lists of 1 points"),
        (struct.pack("<Q2I", 1, 1, 2**32 - 1), "names image 4294967295"),
        (b"LASF" + b"\0" * 300, "is a LAS file"),
        (b"MVSI" + b"\0" * 300, "is an OpenMVS scene"),
        (b"ply\nformat ascii 1.0\n", "not a PLY file with a whole header"),
        (b"ply\nformat ascii 1.0\nelement face 1\nend_header\n", "has no vertices"),
        (b"ply\nformat odd 1.0\nelement vertex 1\nend_header\n", "header is damaged"),
        (b"ply\nelement vertex 1\nend_header\n", "no format"),
        (b"ply\nformat ascii 1.0\nelement vertex -1\nend_header\n", "header is damaged"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list float int view_indices\n"
         b"end_header\n", "counted in float"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int view_indices\n"
         b"end_header\n1 0\n", "no points with x, y and z"),
    ],
)  # fmt: skip
def test_what_is_not_a_view_list(tmp_path, cameras, data, says):
    path = tmp_path / "list.vis"
    path.write_bytes(data)
    with pytest.raises(InputError, match=says):
        read_views(path, cameras)


HEAD = (
    "ply\nformat ascii 1.0\nelement vertex 2\n"
    "property float x\nproperty float y\nproperty float z\n"
    "property list uchar int view_indices\nproperty list uchar float view_weights\nend_header\n"
)


@pytest.mark.parametrize(
    ("body", "says"),
    [
        ("0 0 0 1 0 1 0.5\n1 0 0 1 -1 1 0.5\n", "names an image -1"),
        ("0 0 0 1 0.5 1 0.5\n1 0 0 1 1 1 0.5\n", "not whole"),
        ("0 0 0 1 0 1 0.5\n1 0 0 9 1 1 0.5\n", "number 1 is not whole"),
        ("0 0 0 1 0 1 0.5\n1 0 0 -9 1 1 0.5\n", "number 1 is not whole"),
        ("0 0 0 1 0 1 0.5\n", "number 1 is not whole|number 2 is not whole"),
        ("0 0 0 1 0 1 0.5\n1 0 0 1 zero 1 0.5\n", "not all of it is numbers"),
        ("0 0 0 1 0 1 0.5\n1 0 nan 1 1 1 0.5\n", "vertex 1 has no finite position"),
        ("0 0 0 1 0 1 0.5\n1 0 0 1 1 2 0.5 0.5\n", "vertex 1 has not as many view_weights"),
        ("0 0 0 1 0 1 0.5\n1 0 0 1 1 1 -0.5\n", "a weight is negative"),
        ("0 0 0 1 0 1 0.5\n1 0 0 1 1e30 1 0.5\n", r"names an image 1e\+30"),
    ],
)
def test_damaged_text(tmp_path, cameras, body, says):
    path = tmp_path / "d.ply"
    path.write_text(HEAD + body)
    with pytest.raises(InputError, match=f"d.ply: .*{says}"):
        read_views(path, cameras)


def test_ply_that_other_software_saved_again(tmp_path, cameras, scene):
    path = write_ply(tmp_path / "d.ply", scene[0])
    with pytest.raises(InputError, match=r"no view_indices \(they have: x, y, z, red, label\)"):
        read_views(path, cameras)


@pytest.mark.parametrize("order", ["<", ">", ""])
def test_no_truncation_or_flipped_byte_escapes(tmp_path, cameras, scene, order):
    xyz, lists = scene[0][:6], scene[1][:6]
    whole = write_ply(tmp_path / "d.ply", xyz, lists, [[1.0] * len(x) for x in lists], order)
    damaged(whole, cameras)


def test_no_truncated_or_flipped_vis_escapes(tmp_path, cameras, scene):
    damaged(write_vis(tmp_path / "d.vis", scene[1][:6]), cameras)


def damaged(path, cameras):
    """Read every shorter file and many with a changed byte; whatever is wrong is an InputError."""
    data = path.read_bytes()
    body = data.find(b"end_header") + 11 if data.startswith(b"ply") else 0
    rng = np.random.default_rng(3)
    for end in range(body, len(data) - 3):  # a text may lose the last digits unnoticed
        path.write_bytes(data[:end])
        with pytest.raises(InputError, match=path.name):
            read_views(path, cameras)
    for _ in range(300):
        changed = bytearray(data)
        changed[rng.integers(len(data))] = rng.integers(256)
        path.write_bytes(changed)
        try:
            read_views(path, cameras)
        except InputError as error:
            assert path.name in str(error)


def test_weights_go_along_with_their_points():
    views = Views(np.array([0, 2, 2, 3]), np.array([4, 5, 6]), np.array([1, 2, 3], np.float32))
    taken = views.take(np.array([2, 0]))
    assert rows_of(taken) == [[6], [4, 5]] and taken.weight.tolist() == [3.0, 1.0, 2.0]
    assert Views(views.start, views.camera).take(np.array([0])).weight is None
