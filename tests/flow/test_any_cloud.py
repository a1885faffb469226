"""Whatever the cloud, the cameras, the water and the options: what a correction may never do."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

import pcfix
from pcfix.refract.stereo_pairs import CLOSE_M
from tests.utils.any_scene import ENCODINGS, Scene, scenes
from tests.utils.clouds import fields, read_raw, xyz_of
from tests.utils.codes import warned

pytestmark = pytest.mark.filterwarnings("ignore::pcfix.errors.PcfixWarning")

FORMATS = st.integers(0, 10)
WITH_RAYS = ("snell", "consistent", "shan", "butler", "murase", "dietrich")
# Methods that take each point by itself, when every ray counts.
OF_A_POINT = ("snell", "shan", "butler", "murase", "dietrich", "factor")
NANOMETRE = 1e-9


@st.composite
def options(draw, scene: Scene) -> dict[str, object]:
    """Draw what the cameras of a scene allow."""
    methods = ["auto", *WITH_RAYS, "factor"]
    if scene.cameras.rotations is None:
        methods.remove("consistent")
    method = draw(st.sampled_from(methods))
    found: dict[str, object] = {
        "method": method,
        "deep": True,
        "index": draw(st.floats(1.0, 1.5)),
        "dimensions": draw(st.sampled_from(["all", "minimal", "none"])),
        "respect_classes": draw(st.sampled_from([(), (2,), (0, 2, 40, 41)])),
        "connected": draw(st.booleans()),
    }
    if method != "factor":
        found |= {
            "max_angle": draw(st.sampled_from(["auto", None, 20.0])),
            "occlusion": draw(st.sampled_from(["auto", "off"])),
        }
    return found


def of_a_point(method: str) -> dict[str, object]:
    """Return the options by which a method takes each point by itself, with every ray.

    What hides a point is asked of a grid along the axes, so that it hangs on the frame.
    """
    every = {"max_angle": None, "camera_set": "all"}
    given = {"method": method, "deep": True, "occlusion": "off"}
    return given | ({} if method == "factor" else every)


def correct(scene: Scene, source: Path, target: Path, **given: object) -> pcfix.Summary | None:
    """Correct a file; None when it is refused for a reason that a cloud at random may give."""
    before = source.read_bytes()
    try:
        return pcfix.correct_file(
            source, target, cameras=scene.cameras, water=scene.water, jobs=1, **given
        )
    except pcfix.GeometryError:
        assert not target.exists()
        return None
    finally:
        assert source.read_bytes() == before


@given(data=st.data(), scene=scenes(on_surface=True), point_format=FORMATS, plain=st.booleans())
def test_rest_unchanged(data, scene, point_format, plain):
    given = data.draw(options(scene))
    encoding = data.draw(st.sampled_from(ENCODINGS))
    with tempfile.TemporaryDirectory() as folder:
        suffix = data.draw(st.sampled_from([".las", ".laz"]))
        source, target, back = (Path(folder, name + suffix) for name in ("in", "out", "back"))
        scene.write(source, point_format, plain=plain, scales=encoding[0], offsets=encoding[1])
        summary = correct(scene, source, target, **given)
        assume(summary is not None)
        before, after = read_raw(source), read_raw(target)
        if given["dimensions"] == "all":
            pcfix.restore_file(target, back)
            restored = read_raw(back)
            np.testing.assert_array_equal(restored.points, before.points)
            assert restored.header[:90] == before.header[:90] or before.version < (1, 4)
            assert restored.records == before.records or restored.foreign() == before.foreign()
    old, new = fields(before), fields(after)
    classes = given["respect_classes"]
    below = (scene.height_m(xyz_of(before)) < 0.0) & ~np.isin(old["class"], classes)
    assert summary.points == len(before.points)
    assert summary.submerged <= below.sum()
    assert given["connected"] or summary.submerged == below.sum()
    assert summary.corrected + sum(summary.uncorrected.values()) == summary.submerged
    assert len(after.points) == len(before.points)
    size = old["extra"].shape[1]
    for name in old.keys() - {"X", "Y", "Z", "class", "angle", "extra", "withheld"}:
        np.testing.assert_array_equal(new[name], old[name], name)
    np.testing.assert_array_equal(new["extra"][:, :size], old["extra"])
    moved = np.any([new[a] != old[a] for a in "XYZ"], axis=0)
    touched = moved | (new["class"] != old["class"]) | (new["withheld"] != old["withheld"])
    assert not touched[~below].any()
    assert (new["class"][moved] == 40).all()
    assert (new["withheld"] >= old["withheld"]).all()
    wet_now = new["class"] == 40
    assert (moved & below).sum() <= summary.corrected <= (wet_now & below).sum()
    assert (new["Z"] <= old["Z"]).all()
    assert (scene.height_m(xyz_of(after))[moved] < 0.0).all()
    assert (before.scales, before.offsets) == (after.scales, after.offsets)
    assert after.foreign()[: len(before.foreign())] == before.foreign()
    assert after.extended == before.extended
    assert after.extra_bytes().startswith(before.extra_bytes())
    assert after.header[4:6] == before.header[4:6]
    assert after.header[8:24] == before.header[8:24]
    assert after.header[26:58] == before.header[26:58]


@given(data=st.data(), scene=scenes(), n=st.floats(1.0, 1.4), more=st.floats(0.001, 0.1))
def test_larger_index_deeper(data, scene, n, more):
    method = data.draw(st.sampled_from(OF_A_POINT))
    given = of_a_point(method)
    one, two = (
        pcfix.correct_points(scene.xyz, scene.cameras, scene.water, index=index, **given)
        for index in (n, n + more)
    )
    assert np.isfinite(one.xyz).all() and np.isfinite(two.xyz).all()
    np.testing.assert_array_equal(one.outcome, two.outcome)
    assert (two.xyz[two.corrected, 2] < one.xyz[one.corrected, 2]).all()
    if method != "factor":
        assert np.isfinite(one.sigma_z_m).all() and (one.sigma_z_m >= 0.0).all()
    assert (one.xyz[:, 2] <= scene.xyz[:, 2] + NANOMETRE).all()


@st.composite
def listed(draw, scene: Scene) -> pcfix.Views:
    """Draw a list of two cameras or more for each point."""
    kinds = ["tracks", "depth-maps", "pairs"] if scene.cameras.rotations is not None else ["tracks"]
    kind = draw(st.sampled_from(kinds))
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    k = len(scene.cameras)
    rows = [rng.permutation(k)[:count] for count in rng.integers(2, k + 1, len(scene.xyz))]
    start = np.cumsum([0, *map(len, rows)])
    return pcfix.Views(start, np.concatenate(rows), None, kind)


@given(data=st.data(), scene=scenes())
def test_listed_elsewhere(data, scene):
    """Two cameras are turned to the sky, and named for some points by the way."""
    assume(scene.cameras.rotations is not None and len(scene.cameras) > 3)
    method, kind = data.draw(st.sampled_from(("snell", "consistent"))), "tracks"
    rotations = scene.cameras.rotations.copy()
    rotations[:2] = np.eye(3)
    cameras, n = replace(scene.cameras, rotations=rotations), len(scene.xyz)
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    right = [2 + rng.permutation(len(cameras) - 2)[: rng.integers(0, 3)] for _ in range(n)]
    wrong = [np.arange(rng.integers(not len(one), 3)) for one in right]
    both = [np.concatenate(pair) for pair in zip(wrong, right, strict=True)]
    apart = sum(map(len, wrong))
    given_views, only = (
        pcfix.Views(np.cumsum([0, *map(len, rows)]), np.concatenate(rows), None, kind)
        for rows in (both, right)
    )
    rows_used = [i for i in range(n) if len(right[i])]
    assume(rows_used and apart)
    given = of_a_point(method)
    with warned("views.outside"):
        found = pcfix.correct_points(scene.xyz, cameras, scene.water, views=given_views, **given)
    expected = pcfix.correct_points(
        scene.xyz[rows_used], cameras, scene.water, views=only.take(np.array(rows_used)), **given
    )
    np.testing.assert_array_equal(found.xyz[rows_used], expected.xyz)
    np.testing.assert_array_equal(found.ray_count[rows_used], expected.ray_count)
    without = np.setdiff1d(np.flatnonzero(found.submerged), rows_used)
    assert (found.outcome[without] == pcfix.Outcome.NO_CAMERA).all()


@given(data=st.data(), scene=scenes(), turn=st.floats(0.0, 6.3))
def test_frame_and_order(data, scene, turn):
    framed = scene.cameras.rotations is not None
    method = data.draw(st.sampled_from((*OF_A_POINT, "consistent") if framed else OF_A_POINT))
    given = of_a_point(method)
    assume((np.abs(scene.height_m(scene.xyz)) > 1e-6).all())
    shift = data.draw(st.sampled_from([(0.0, 0.0, 0.0), (512e3, 5.4e6, 431.7)]))
    cameras = data.draw(st.permutations(range(len(scene.cameras))))
    points = data.draw(st.permutations(range(len(scene.xyz))))
    views = data.draw(listed(scene)) if method != "factor" and data.draw(st.booleans()) else None
    renumbered, bound_m = views, 1e-6
    if views is not None and method == "consistent" and views.kind == "pairs":
        turn = round(turn / (np.pi / 2.0)) * np.pi / 2.0  # their median is along the axes
        bound_m = 6.0 * CLOSE_M  # each is off by up to three; the search begins at the point before
    if views is not None:
        taken = views.take(np.array(points))
        renumbered = replace(taken, camera=np.argsort(cameras)[taken.camera])
    other = scene.moved(turn, shift).reordered(cameras, points)
    here = pcfix.correct_points(scene.xyz, scene.cameras, scene.water, views=views, **given)
    there = pcfix.correct_points(other.xyz, other.cameras, other.water, views=renumbered, **given)
    np.testing.assert_array_equal(there.outcome, here.outcome[points])
    np.testing.assert_array_equal(there.ray_count, here.ray_count[points])
    expected = Scene(here.xyz, scene.cameras, scene.plane).moved(turn, shift).xyz[points]
    np.testing.assert_allclose(there.xyz, expected, rtol=0, atol=bound_m)
    # their squares are what is left of sums of squares of 100 m, of rays that are nearly parallel
    miss2, expected2 = there.ray_miss_m**2, here.ray_miss_m[points] ** 2
    np.testing.assert_allclose(miss2, expected2, rtol=0, atol=1e-7)
