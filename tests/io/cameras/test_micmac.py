"""MicMac's orientation folders."""

import shutil
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
@pytest.mark.parametrize(
    ("name", "calibration", "model"),
    [
        ("Orientation-1.xml", "Calib-1.xml", "ModRad after eModelePolyDeg4"),
        ("", "Calib-1.xml", "ModRad after eModelePolyDeg4"),
        ("TestOri-2.xml", "TestOri-2.xml", "eModelePolyDeg2"),
    ],
)
def test_samples_with_other_formulas_are_refused(name, calibration, model):
    with pytest.raises(InputError, match="mm3d ConvertCalib") as error:
        micmac.read(Source(LI3DS / name))
    assert f"{calibration}: the calibration has the distortion {model}," in str(error.value)


@li3ds
def test_fisheye_of_the_sample_is_refused(tmp_path):
    name = "AutoCal_Foc-15000_Cam-Caml023_20161205a.xml"
    shutil.copy(LI3DS / name, tmp_path)
    with pytest.raises(InputError, match=r"Caml023.*eModele_FishEye_10_5_5.*ConvertCalib"):
        read(tmp_path, orientation(f"<FileInterne>Ori-Calib/{name}</FileInterne>"))


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


@pytest.mark.parametrize(
    "name",
    [
        *("eModelePolyDeg2", "eModeleRadFour7x2", "eModeleEbner", "eModeleDCBrown", "eModeleNew"),
        *("eModele_FishEye_10_5_5", "eModele_EquiSolid_FishEye_10_5_5"),
    ],
)
def test_unified_models_that_no_lens_holds_are_refused(tmp_path, name):
    with pytest.raises(InputError, match=f"the distortion {name}, which .*mm3d ConvertCalib"):
        read(tmp_path, embedded(unified(name, [1e-4] * 6, [F, *PP])))


def test_no_distortion_by_its_unified_name(tmp_path):
    lens = read(tmp_path, embedded(unified("eModelePolyDeg0", [], []), RADIAL)).lenses[0]
    assert lens == read(tmp_path, embedded(RADIAL)).lenses[0]


@pytest.mark.parametrize(
    ("affinity", "convention"),
    [("<b1>2e-2</b1><b2>0</b2>", "eConvApero_DistM2C"), ("<b1>1e-5</b1>", "eConvApero_DistC2M")],
)
def test_an_affinity_that_a_lens_does_not_hold_is_refused(tmp_path, affinity, convention):
    with pytest.raises(InputError, match=r"ModPhgrStd with an affinity .*ConvertCalib"):
        read(tmp_path, embedded(STANDARD.format(affinity), convention=convention))


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
        (embedded(RADIAL, RADIAL), "ModRad after ModRad, which pcfix does not model"),
        (embedded("<ModGridDef/>"), "the distortion ModGridDef, which .*mm3d ConvertCalib"),
        (embedded(unified("eModele_DRad_PPaEqPPs", [1e-9] * 10, [])), "10 Params instead of 9"),
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
