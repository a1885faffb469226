"""MicMac's orientation folders."""

import itertools
import math
import shutil
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from pcfix.errors import InputError
from pcfix.io.cameras import micmac
from pcfix.io.cameras.formats import Source
from pcfix.lens.imaging import project, unproject
from tests.utils.reprojection import check_file, residuals_px
from tests.utils.shared import needs

LI3DS, li3ds = needs("cameras", "micmac", "li3ds")

TURN = ((0.36, 0.48, -0.8), (-0.8, 0.6, 0.0), (0.48, 0.64, 0.6))
POSE = (
    "<KnownConv>eConvApero_DistM2C</KnownConv><Centre>10 20 30</Centre><ParamRotation><CodageMatr>"
    + "".join(f"<L{i + 1}>{x} {y} {z}</L{i + 1}>" for i, (x, y, z) in enumerate(TURN))
    + "</CodageMatr></ParamRotation>"
)
NO_DISTORTION = "<ModNoDist><Inutile>0</Inutile></ModNoDist>"
F, PP = 3000.0, (2010.0, 1490.0)


def interior(*models, convention="eConvApero_DistM2C", more=""):
    distortions = "".join(f"<CalibDistortion>{model}</CalibDistortion>" for model in models)
    return (
        f"<KnownConv>{convention}</KnownConv><PP>{PP[0]} {PP[1]}</PP><F>{F}</F>"
        f"<SzIm>4000 3000</SzIm>{more}{distortions}"
    )


def orientation(inside, pose=POSE, more=""):
    return (
        '<?xml version="1.0" ?><ExportAPERO><OrientationConique>'
        f"{more}{inside}<Externe>{pose}</Externe></OrientationConique></ExportAPERO>"
    )


def embedded(*models, **options):
    return orientation(f"<Interne>{interior(*models, **options)}</Interne>")


def unified(name, params, states):
    values = "".join(f"<Params>{p}</Params>" for p in params)
    values += "".join(f"<Etats>{s}</Etats>" for s in states)
    return f"<ModUnif><TypeModele>{name}</TypeModele>{values}</ModUnif>"


def read(tmp_path, text, name="Orientation-a.jpg.xml"):
    path = tmp_path / name
    path.write_text(text)
    source = Source(path)
    assert micmac.recognises(source)
    return micmac.read(source)


def verified(name):
    """The built-in check of an orientation: how far its own points are from where we see them."""
    root = ElementTree.parse(LI3DS / name).getroot()
    cameras = micmac.read(Source(LI3DS / name))
    seen = np.array([[float(v) for v in e.text.split()] for e in root.iter("Im")])
    points = np.array([[float(v) for v in e.text.split()] for e in root.iter("Ter")])
    rays = (points - cameras.centres[0]) @ cameras.rotations[0].T
    return np.hypot(*(project(cameras.lenses[0], rays) - seen).T), cameras


@li3ds
def test_sample_is_reproduced_exactly():
    misses, cameras = verified("Orientation-00.xml")
    assert misses.max() < 1e-6
    assert cameras.notes == ()
    assert residuals_px(
        micmac.read(Source(LI3DS / "Orientation-00.xml")),
        [{**seen, "image": "00"} for seen in check_file(LI3DS)["observations"]],
    ) == pytest.approx(0.0, abs=1e-3)  # listed to 1/1000 px


@li3ds
def test_sample_with_a_polynomial_keeps_to_what_its_note_says():
    misses, cameras = verified("Orientation-1.xml")
    assert "Calib-1.xml" in cameras.notes[0]
    told = float(cameras.notes[0].split("up to ")[1].split()[0])
    assert 0.5 < misses.max() < told < 2.0


@li3ds
def test_polynomial_of_the_sample_comes_before_its_radial_model():
    root = ElementTree.parse(LI3DS / "Orientation-1.xml").getroot()
    seen = np.array([[float(v) for v in e.text.split()] for e in root.iter("Im")])
    points = np.array([[float(v) for v in e.text.split()] for e in root.iter("Ter")])
    cameras = micmac.read(Source(LI3DS / "Orientation-1.xml"))
    path = LI3DS / "Calib-1.xml"
    inner = ElementTree.parse(path).getroot().find("CalibrationInternConique")
    calibration = micmac.calibration.parse(path, inner)
    rays = (points - cameras.centres[0]) @ cameras.rotations[0].T
    ideal = calibration.focal * rays[:, :2] / rays[:, 2:] + calibration.principal
    assert calibration.move(ideal) == pytest.approx(seen, abs=1e-6)


@li3ds
def test_folder_of_the_sample():
    cameras = micmac.read(Source(LI3DS))
    assert cameras.labels == ("00", "1")
    for i, truth in enumerate(check_file(LI3DS)["projection_centres"]):
        assert cameras.centres[i] == pytest.approx([truth[k] for k in "XYZ"], abs=1e-6)
        assert cameras.rotations[i][2] == pytest.approx(truth["view_dir"], abs=1e-6)
        assert -cameras.rotations[i][1] == pytest.approx(truth["up_dir_minus_cam_y"], abs=1e-6)
    assert cameras.crs is None


@li3ds
def test_fisheye_of_the_sample_is_replaced_within_what_its_note_says(tmp_path):
    name = "AutoCal_Foc-15000_Cam-Caml023_20161205a.xml"
    shutil.copy(LI3DS / name, tmp_path)
    cameras = read(tmp_path, orientation(f"<FileInterne>Ori-Calib/{name}</FileInterne>"))
    told = float(cameras.notes[0].split("up to ")[1].split()[0])
    root = ElementTree.parse(tmp_path / name).getroot()
    params = [float(e.text) for e in root.iter("Params")]
    state = float(root.find(".//Etats").text)
    focal, (px, py) = float(root.find(".//F").text), map(float, root.find(".//PP").text.split())
    misses = []
    for degrees, turn in itertools.product((1, 10, 25, 40, 50), range(0, 360, 15)):
        tangent = math.tan(math.radians(degrees))
        ray = np.array([tangent * math.cos(turn), tangent * math.sin(turn), 1.0])
        expected = fisheye_place(ray, focal, (px, py), params, state)
        if 0 < expected[0] < 2560 and 0 < expected[1] < 1920:
            misses.append(math.dist(project(cameras.lenses[0], ray[None])[0], expected))
    assert len(misses) > 80
    assert max(misses) < told + 0.05 < 2.0


def fisheye_place(ray, focal, principal, params, state):
    """Linear fisheye of the sample: radial terms, one pair of decentring, two affine ones."""
    x = (focal * ray[0] / ray[2] + principal[0] - params[0]) / state
    y = (focal * ray[1] / ray[2] + principal[1] - params[1]) / state
    r = math.hypot(x, y)
    x, y = x * math.atan(r) / r, y * math.atan(r) / r
    r2 = x * x + y * y
    bent = 1.0 + sum(k * r2 ** (i + 1) for i, k in enumerate(params[2:12]))
    p, q, l1, l2 = *params[12:14], *params[22:24]
    out_x = x * bent + p * (r2 + 2 * x * x) + q * 2 * x * y + l1 * x + l2 * y
    out_y = y * bent + q * (r2 + 2 * y * y) + p * 2 * x * y + l2 * x
    return params[0] + state * out_x, params[1] + state * out_y


def test_matrix_is_camera_to_world(tmp_path):
    cameras = read(tmp_path, embedded(NO_DISTORTION))
    seen = np.array([0.5, -0.25, 4.0])
    world = np.array(TURN) @ seen + [10.0, 20.0, 30.0]
    assert cameras.rotations[0] @ (world - cameras.centres[0]) == pytest.approx(seen)
    assert cameras.labels == ("a.jpg",)
    place = project(cameras.lenses[0], seen[None])[0]
    assert place == pytest.approx([PP[0] + F * 0.125, PP[1] - F * 0.0625])


TERMS = "<CDist>1980 1520</CDist><CoeffDist>2e-8</CoeffDist><CoeffDist>-1e-15</CoeffDist>"
RADIAL = f"<ModRad>{TERMS}</ModRad>"
STANDARD = (
    "<ModPhgrStd><RadialePart><CDist>1980 1520</CDist><CoeffDist>2e-8</CoeffDist>"
    "<CoeffDist>-1e-15</CoeffDist></RadialePart><P1>3e-7</P1><P2>-2e-7</P2>{}</ModPhgrStd>"
)
RAYS = np.array([[0.1, 0.2, 1.0], [-0.4, 0.3, 1.0], [0.5, -0.4, 1.0], [0.0, 0.0, 1.0]])


def brown_place(x, y, p1=0.0, p2=0.0, b1=0.0, b2=0.0):
    dx, dy = x - 1980.0, y - 1520.0
    r2 = dx * dx + dy * dy
    bent = 2e-8 * r2 - 1e-15 * r2 * r2
    return (
        x + dx * bent + p1 * (r2 + 2 * dx * dx) + 2 * p2 * dx * dy + b1 * dx + b2 * dy,
        y + dy * bent + p2 * (r2 + 2 * dy * dy) + 2 * p1 * dx * dy,
    )


@pytest.mark.parametrize(
    ("model", "terms", "tolerance"),
    [
        (RADIAL, {}, 1e-8),
        (STANDARD.format(""), {"p1": 3e-7, "p2": -2e-7}, 1e-8),
        (
            STANDARD.format("<b1>2e-4</b1><b2>-1e-4</b2>"),
            {"p1": 3e-7, "p2": -2e-7, "b1": 2e-4, "b2": -1e-4},
            0.05,
        ),
    ],
)
def test_distortion_is_added_to_the_ideal_position(tmp_path, model, terms, tolerance):
    cameras = read(tmp_path, embedded(model))
    assert cameras.notes == ()
    for ray in RAYS:
        x, y = PP[0] + F * ray[0], PP[1] + F * ray[1]
        place = project(cameras.lenses[0], ray[None])[0]
        assert place == pytest.approx(brown_place(x, y, **terms), abs=tolerance)


@pytest.mark.parametrize("model", [RADIAL, STANDARD.format("")])
def test_distortion_from_observed_to_ideal(tmp_path, model):
    cameras = read(tmp_path, embedded(model, convention="eConvApero_DistC2M"))
    terms = {} if model == RADIAL else {"p1": 3e-7, "p2": -2e-7}
    for u, v in [(100, 200), (2010, 1490), (3900, 2800)]:
        x, y = brown_place(u, v, **terms)
        ray = unproject(cameras.lenses[0], np.array([[u, v]], dtype=float))[0]
        assert ray[:2] / ray[2] == pytest.approx([(x - PP[0]) / F, (y - PP[1]) / F], abs=1e-9)


@pytest.mark.parametrize("name", ["eModele_DRad_PPaEqPPs", "eModele_Fraser_PPaEqPPs"])
def test_unified_names_of_the_radial_and_standard_models(tmp_path, name):
    tail = (3e-7, -2e-7, 0, 0) if "Fraser" in name else ()
    cameras = read(tmp_path, embedded(unified(name, [2e-8, -1e-15, 0, 0, 0, *tail], [])))
    ray = np.array([-0.4, 0.3, 1.0])
    dx, dy = F * ray[:2]
    r2 = dx * dx + dy * dy
    p1, p2 = tail[:2] or (0.0, 0.0)
    bent = 1 + 2e-8 * r2 - 1e-15 * r2 * r2
    expected = (
        PP[0] + dx * bent + p1 * (r2 + 2 * dx * dx) + 2 * p2 * dx * dy,
        PP[1] + dy * bent + p2 * (r2 + 2 * dy * dy) + 2 * p1 * dx * dy,
    )
    assert project(cameras.lenses[0], ray[None])[0] == pytest.approx(expected, abs=1e-8)


def second_degree(x, y, p):
    return (
        (1 + p[0]) * x + p[1] * y - 2 * p[2] * x * x + p[3] * x * y + p[4] * y * y,
        (1 - p[0]) * y + p[1] * x + p[2] * x * y - 2 * p[3] * y * y + p[5] * x * x,
    )


def degree_three(x, y, p, _):
    out_x, out_y = second_degree(x, y, p)
    cubic = [x**3, x * x * y, x * y * y, y**3]
    return (
        out_x + sum(c * t for c, t in zip(p[6:10], cubic, strict=True)),
        out_y + sum(c * t for c, t in zip(p[10:14], cubic, strict=True)),
    )


def radial_four(x, y, p, _):
    out_x, out_y = second_degree(x, y, p)
    dx, dy = x - p[6], y - p[7]
    r2 = dx * dx + dy * dy
    bent = p[8] * r2 + p[9] * r2**2 + p[10] * r2**3
    return out_x + dx * bent, out_y + dy * bent


SMALL = [1e-4, -2e-4, 1e-5, 2e-5, 3e-4, -2e-4]


@pytest.mark.parametrize(
    ("name", "params", "formula"),
    [
        ("eModelePolyDeg2", SMALL, lambda x, y, p, _: second_degree(x, y, p)),
        (
            "eModelePolyDeg3",
            [*SMALL, 0.02, 1e-5, 0.02, 2e-5, 1e-5, 0.02, -1e-5, 0.02],
            degree_three,
        ),
        ("eModeleRadFour7x2", [*SMALL, 1e-5, -2e-5, 0.05, -0.02, 0.01], radial_four),
    ],
)
def test_unified_models_are_met_by_the_nearest_lens(tmp_path, name, params, formula):
    cameras = read(tmp_path, embedded(unified(name, params, [F, *PP])))
    assert cameras.notes == ()
    for ray in RAYS:
        x, y = formula(ray[0], ray[1], params, F)
        expected = (PP[0] + F * x, PP[1] + F * y)
        assert project(cameras.lenses[0], ray[None])[0] == pytest.approx(expected, abs=0.5)


def moved(model, place):
    element = ElementTree.fromstring(f"<I>{interior(model)}</I>")
    return micmac.calibration.parse(Path("file.xml"), element).move(np.array([place], dtype=float))[
        0
    ]


def test_ebner(tmp_path):
    p = [1e-4, 2e-4, 1e-8, 2e-8, 3e-8, 4e-8, 1e-11, 2e-11, 3e-11, 4e-11, 1e-15, 2e-15]
    x, y, b = 2500.0, 800.0, 1000.0
    x2, y2 = x * x - b * b * 2 / 3, y * y - b * b * 2 / 3
    out_x = (1 + p[0]) * x + p[1] * y - 2 * p[2] * x2 + p[3] * x * y + p[4] * y2
    out_x += p[6] * x * y2 + p[8] * y * x2 + p[10] * x2 * y2
    out_y = (1 - p[0]) * y + p[1] * x + p[2] * x * y - 2 * p[3] * y2 + p[5] * x2
    out_y += p[7] * y * x2 + p[9] * x * y2 + p[11] * x2 * y2
    assert moved(unified("eModeleEbner", p, [b]), (x, y)) == pytest.approx((out_x, out_y))


def test_brown_of_fourteen_terms(tmp_path):
    p = [1e-4, 2e-4, 1e-8, 2e-8, 3e-12, 4e-12, 1e-15, 2e-8, 3e-8, 4e-12, 1e-12, 2e-15, 1e-12, 1e-9]
    x, y = 2500.0, 800.0
    both = p[12] * x * x * y * y / F + p[13] * (x * x + y * y)
    out_x = (1 + p[0]) * x + p[1] * y + p[2] * x * y + p[3] * y * y + p[4] * x * x * y
    out_x += p[5] * x * y * y + p[6] * x * x * y * y + x * both
    out_y = y + p[7] * x * y + p[8] * x * x + p[9] * x * x * y + p[10] * x * y * y
    out_y += p[11] * x * x * y * y + y * both
    assert moved(unified("eModeleDCBrown", p, [F]), (x, y)) == pytest.approx((out_x, out_y))


@pytest.mark.parametrize(
    ("name", "radius"),
    [
        ("eModele_FishEye_10_5_5", lambda t: t),
        ("eModele_EquiSolid_FishEye_10_5_5", lambda t: 2 * math.sin(t / 2)),
        ("eModele_Stereographik_FishEye_10_5_5", lambda t: 2 * math.tan(t / 2)),
    ],
)
@pytest.mark.parametrize("state", [900.0, 1000.0])
def test_fisheyes(tmp_path, name, radius, state):
    text = embedded(unified(name, [*PP, 0.01, -0.005], [state])).replace(f"<F>{F}", "<F>1000")
    lens = read(tmp_path, text).lenses[0]
    for degrees in (0.5, 20, 40, 55):
        inside = math.atan(1000.0 / state * math.tan(math.radians(degrees)))
        r = radius(inside)
        r = state * r * (1 + 0.01 * r * r - 0.005 * r**4)
        ray = [0.8 * math.sin(math.radians(degrees)), 0.6 * math.sin(math.radians(degrees))]
        place = project(lens, np.array([[*ray, math.cos(math.radians(degrees))]]))[0]
        assert place == pytest.approx([PP[0] + 0.8 * r, PP[1] + 0.6 * r], abs=0.1)


def test_polynomial_degrees_of_the_fisheye():
    """Terms above the second degree skip what radial and decentring terms span already."""
    params = [0.0] * 50
    params[24:31] = [1, 2, 3, 4, 5, 6, 7]  # y of x^3; x, y of x^2 y; x y^2; y^3
    params[31:39] = [11, 12, 13, 14, 15, 16, 17, 18]
    params[39:50] = [21, 22, 23, 24, 25, 26, 27, 28, 29, 30, 31]
    x, y = 0.03, -0.02
    r = math.hypot(x, y)
    place = (np.array([x, y]) * math.tan(r) / r)[None]
    found = micmac.distortion.fisheye(place, params, [1.0], "linear")[0]
    more_x = 2 * x * x * y + 4 * x * y * y + 6 * y**3
    more_y = 1 * x**3 + 3 * x * x * y + 5 * x * y * y + 7 * y**3
    more_x += 12 * x**3 * y + 14 * x * x * y * y + 16 * x * y**3 + 18 * y**4
    more_y += 11 * x**4 + 13 * x**3 * y + 15 * x * x * y * y + 17 * x * y**3
    more_x += 22 * x**4 * y + 24 * x**3 * y**2 + 26 * x**2 * y**3 + 28 * x * y**4 + 30 * y**5
    more_y += 21 * x**5 + 23 * x**4 * y + 25 * x**3 * y**2 + 27 * x**2 * y**3 + 29 * x * y**4
    more_y += 31 * y**5
    assert found == pytest.approx([x + more_x, y + more_y])


def test_scaled_image(tmp_path):
    affine = "<OrIntImaM2C><I00>5 7</I00><V10>0.5 0.01</V10><V01>0.02 0.25</V01></OrIntImaM2C>"
    text = orientation(f"<Interne>{interior(RADIAL)}</Interne>", more=affine)
    lens = read(tmp_path, text).lenses[0]
    for ray in RAYS:
        u, v = brown_place(PP[0] + F * ray[0], PP[1] + F * ray[1])
        expected = (5 + 0.5 * u + 0.02 * v, 7 + 0.01 * u + 0.25 * v)
        assert project(lens, ray[None])[0] == pytest.approx(expected, abs=1e-8)
    assert (lens.width, lens.height) == pytest.approx((2060, 790))


def calibration_file(path):
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"<ExportAPERO><CalibrationInternConique>{interior(RADIAL)}"
                    "</CalibrationInternConique></ExportAPERO>")  # fmt: skip


@pytest.mark.parametrize("where", ["Ori-Out/AutoCal.xml", "Ori-Calib/AutoCal.xml"])
def test_calibration_file_is_beside_or_where_the_path_says(tmp_path, where):
    calibration_file(tmp_path / where)
    folder = tmp_path / "Ori-Out"
    folder.mkdir(exist_ok=True)
    text = orientation("<FileInterne>Ori-Calib/AutoCal.xml</FileInterne>")
    for name in ("b.tif", "a.tif"):
        (folder / f"Orientation-{name}.xml").write_text(text)
    (folder / "Residus.xml").write_text("<a/>")
    assert micmac.recognises(Source(folder))
    cameras = micmac.read(Source(folder))
    assert cameras.labels == ("a.tif", "b.tif")
    assert cameras.lenses[0] is cameras.lenses[1]
    assert cameras.lenses[0].sensor == "AutoCal"


@pytest.mark.parametrize("name", ["AutoCal.xml", "../../AutoCal.xml", "/etc/passwd", ""])
def test_calibration_file_that_is_missing_or_outside(tmp_path, name):
    folder = tmp_path / "work" / "Ori-Out"
    folder.mkdir(parents=True)
    path = folder / "Orientation-a.tif.xml"
    path.write_text(orientation(f"<FileInterne>{name}</FileInterne>"))
    with pytest.raises(InputError, match=r"Orientation-a.tif.xml: image a.tif: its calibration"):
        micmac.read(Source(path))


MATRIX = POSE[POSE.index("<ParamRotation>") :]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (embedded(NO_DISTORTION)[:-30], "damaged or cut off"),
        ("<ExportAPERO><OrientationConique/></ExportAPERO>", "has no Externe"),
        (
            orientation(f"<Interne>{interior()}</Interne>", pose=MATRIX),
            "image a.jpg, Centre: has 0 numbers",
        ),
        (
            embedded().replace("<L2>-0.8", "<L2>0.8"),
            "image a.jpg: the rotation matrix is not ortho",
        ),
        (
            embedded().replace("<L2>-0.8 0.6", "<L2>0.8 -0.6"),
            "image a.jpg: the rotation matrix mirr",
        ),
        (embedded().replace("<L2>-0.8", "<L2>x"), "image a.jpg, L2: 'x' is not a number"),
        (embedded().replace("CodageMatr", "CodageAngulaire"), "image a.jpg: its rotation is not a"),
        (
            orientation("", pose=POSE.replace("eConvApero_DistM2C", "eConvAngErdas")),
            "image a.jpg: its rotation is not a matrix .*eConvAngErdas",
        ),
        (embedded(convention="eConvOriLib"), "the convention eConvOriLib"),
        (
            orientation("<TypeProj>eProjOrthographique</TypeProj>"),
            "image a.jpg: the projection eProjOrthographique",
        ),
        (embedded().replace(f"<F>{F}", "<F>0"), "focal length F is 0"),
        (embedded().replace("<SzIm>4000", "<SzIm>0"), "frame 0 x 3000 must be positive"),
        (embedded().replace("<SzIm>4000 3000</SzIm>", ""), "SzIm: has 0 numbers"),
        (embedded(RADIAL, RADIAL, convention="eConvApero_DistC2M"), "several distortions"),
        (embedded("<ModGridDef/>"), "the distortion model ModGridDef is not read"),
        (embedded(unified("eModeleNew", [], [])), "'eModeleNew' is none that pcfix knows"),
        (embedded(unified("eModelePolyDeg2", [1e-3] * 8, [F, *PP])), "has 8 Params instead of 6"),
        (embedded(unified("eModelePolyDeg2", [1e-3] * 6, [F])), "needs 3 Etats"),
        (
            embedded(unified("eModelePolyDeg2", [9e9] * 6, [F, *PP])),
            "nearly nothing into the frame",
        ),
        (embedded(RADIAL.replace("2e-8", "1e308")), "not finite"),
        (
            embedded()
            .replace(f"<F>{F}", "<F>1e300")
            .replace("</SzIm>", f"</SzIm><CalibDistortion>{RADIAL}</CalibDistortion>"),
            "not finite",
        ),
        (
            orientation(
                f"<Interne>{interior()}</Interne>",
                more="<OrIntImaM2C><I00>0 0</I00><V10>0 1</V10><V01>-1 0</V01></OrIntImaM2C>",
            ),
            "camera of image a.jpg: focal length",
        ),
    ],
)
def test_damaged_files_are_named(tmp_path, text, words):
    path = tmp_path / "Orientation-a.jpg.xml"
    path.write_text(text)
    with pytest.raises(InputError, match=words) as error:
        micmac.read(Source(path))
    assert "Orientation-a.jpg.xml" in str(error.value)


@pytest.mark.parametrize("text", ["", "<chunk/>", "label,x,y,z", "\x00<Orient"])
def test_other_files_are_not_recognised(tmp_path, text):
    path = tmp_path / "Orientation-1.xml.txt"
    path.write_text(text)
    assert not micmac.recognises(Source(path))
    assert not micmac.recognises(Source(tmp_path))
