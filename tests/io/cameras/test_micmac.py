"""MicMac's orientation folders."""

import numpy as np
import pytest

import pcfix
from pcfix.lens.imaging import project, unproject
from tests.utils.camera_files import brown
from tests.utils.codes import refused

TURN = ((0.36, 0.48, -0.8), (-0.8, 0.6, 0.0), (0.48, 0.64, 0.6))
POSE = (
    "<KnownConv>eConvApero_DistM2C</KnownConv><Centre>10 20 30</Centre><ParamRotation><CodageMatr>"
    + "".join(f"<L{i + 1}>{x} {y} {z}</L{i + 1}>" for i, (x, y, z) in enumerate(TURN))
    + "</CodageMatr></ParamRotation>"
)
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


def read(tmp_path, text, name="Orientation-a.jpg.xml"):
    path = tmp_path / name
    path.write_text(text)
    return pcfix.read_cameras(path)


TERMS = "<CDist>1980 1520</CDist><CoeffDist>2e-8</CoeffDist><CoeffDist>-1e-15</CoeffDist>"
RADIAL = f"<ModRad>{TERMS}</ModRad>"
STANDARD = (
    "<ModPhgrStd><RadialePart><CDist>1980 1520</CDist><CoeffDist>2e-8</CoeffDist>"
    "<CoeffDist>-1e-15</CoeffDist></RadialePart><P1>3e-7</P1><P2>-2e-7</P2>{}</ModPhgrStd>"
)
RAYS = np.array([[0.1, 0.2, 1.0], [-0.4, 0.3, 1.0], [0.5, -0.4, 1.0], [0.0, 0.0, 1.0]])


def brown_place(x, y, p1=0.0, p2=0.0, b1=0.0, b2=0.0):
    dx, dy = x - 1980.0, y - 1520.0
    bx, by = brown(dx, dy, (2e-8, -1e-15), (p1, p2))
    return x + bx - dx + b1 * dx + b2 * dy, y + by - dy


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


@pytest.mark.parametrize("where", ["Ori-Out/AutoCal.xml", "Ori-Calib/AutoCal.xml"])
def test_calibration_file_is_beside_or_where_the_path_says(tmp_path, where):
    for path in (tmp_path / "Ori-Out", tmp_path / "Ori-Calib"):
        path.mkdir()
    inner = f"<CalibrationInternConique>{interior(RADIAL)}</CalibrationInternConique>"
    (tmp_path / where).write_text(f"<ExportAPERO>{inner}</ExportAPERO>")
    folder = tmp_path / "Ori-Out"
    text = orientation("<FileInterne>Ori-Calib/AutoCal.xml</FileInterne>")
    for name in ("b.tif", "a.tif"):
        (folder / f"Orientation-{name}.xml").write_text(text)
    (folder / "Residus.xml").write_text("<a/>")
    cameras = pcfix.read_cameras(folder)
    assert cameras.labels == ("a.tif", "b.tif")
    assert cameras.lenses[0] is cameras.lenses[1]
    assert cameras.lenses[0].sensor == "AutoCal"


# ---- MMVII ----

POSE_2 = """<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>
<Root><Type>"MMVII_Serialization"</Type><Version>"0.0.0"</Version><Data><CameraPose>
<NameImage>"IMGP4168.JPG"</NameImage>
<NameInternalCalib>"Calib-PerspCentral-Foc-28000_Cam-PENTAX_K5"</NameInternalCalib>
<Center>5.203315710339428 0.801558951120939 2.104233883945823</Center>
<RotMatrix>
<AxeI>-0.16360794707346 0.050533795937991 0.985230315775202</AxeI>
<AxeJ>0.115991824112041 0.992745533269003 -0.03165758856268</AxeJ>
<AxeK>-0.979682773347357 0.109099228423211 -0.168282565834643</AxeK>
</RotMatrix></CameraPose></Data></Root>"""
CALIBRATION_2 = """<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>
<Root><Type>"MMVII_Serialization"</Type><Data><InternalCalibration>
<Name>"Calib-PerspCentral-Foc-28000_Cam-PENTAX_K5"</Name>
<PixelFrame><NbPix>1728 1152</NbPix></PixelFrame><Projection>"Stenope"</Projection>
<PerfectProj><F>{f}</F><PP>{x} {y}</PP></PerfectProj>
<Distorsion>{terms}</Distorsion></InternalCalibration></Data></Root>"""
FILE_2 = "Calib-PerspCentral-Foc-28000_Cam-PENTAX_K5.xml"
# The calibration of the same image by version 1: pixels, radial about the principal point.
BY_V1 = {
    "f": 2112.04115765381403, "x": 856.865441648138244, "y": 577.614006671525772,
    "k": (-2.13187449928481487e-08, 1.7226374299904674e-15, 5.49746079672967297e-21,
          -2.41801731114306416e-27),
}  # fmt: skip
# Image places and points by which version 1 checks its file of that pose (its `Verif`).
SEEN_BY_V1 = [
    ((796.228448867797738, 622.67246246337902), (2.342012894, 1.18060072005993355, 1.5238954104)),
    ((1333.43151855468409, 435.223903656006939), (-0.8743145176, 1.1176173229, 2.44423536554699)),
    ((79.8580291278442189, 116.648677826356376), (0.7004565327, 0.1832672713, -0.4188742243257)),
    ((1700.28139114184114, 47.3248143208406162), (0.4589538174, 0.2551497878, 3.16255323043381)),
    ((1544.98360061627091, 738.844093322710933), (0.1693280845, 1.7953410696, 2.85824590322565)),
]


def version_2(folder, terms="", f=F, x=PP[0], y=PP[1], pose=POSE_2):
    (folder / FILE_2).write_text(CALIBRATION_2.format(f=f, x=x, y=y, terms=terms))
    path = folder / "Ori-PerspCentral-IMGP4168.JPG.xml"
    path.write_text(pose)
    return path


def test_version_2_sees_points_where_version_1_did(tmp_path):
    """The pose is a file of MMVII's own tests, converted from one of version 1."""
    f = BY_V1["f"]
    terms = "".join(f"<K{i}>{k * f ** (2 * i)!r}</K{i}>" for i, k in enumerate(BY_V1["k"], start=1))
    numbers = {name: BY_V1[name] for name in ("f", "x", "y")}
    path = version_2(tmp_path, f"<Radial>{terms}</Radial>", **numbers)
    for given in (path, tmp_path):
        cameras = pcfix.read_cameras(given)
    for place, point in SEEN_BY_V1:
        ray = cameras.rotations[0] @ (np.array(point) - cameras.centres[0])
        assert project(cameras.lenses[0], ray[None])[0] == pytest.approx(place, abs=1e-4)
    assert cameras.labels == ("IMGP4168.JPG",)
    assert (cameras.lenses[0].width, cameras.lenses[0].height) == (1728.0, 1152.0)


def test_version_2_distorts_the_ideal_place(tmp_path):
    """By the formulas that its files write beside the coefficients."""
    k1, k2, p1, p2, b1, b2 = -0.1, 0.11, 1e-3, -2e-3, 1e-7, 2e-7
    terms = (
        f"<Radial><K1>{k1}</K1><K2>{k2}</K2></Radial><Decentric><p1>{p1}</p1><p2>{p2}</p2>"
        f"</Decentric><Polynomial><b1>{b1}</b1><b2>{b2}</b2></Polynomial>"
    )
    lens = pcfix.read_cameras(version_2(tmp_path, terms, f=2112.0, x=857.0, y=577.0)).lenses[0]
    x, y = 0.3, -0.2
    u, v = brown(x, y, (k1, k2), (p1, p2))
    u += b1 * x + b2 * y
    expected = 857.0 + 2112.0 * u, 577.0 + 2112.0 * v
    assert project(lens, np.array([[x, y, 1.0]]))[0] == pytest.approx(expected, abs=1e-5)


SCANNED = "<OrIntImaM2C><I00>9 9</I00><V10>0 1</V10><V01>1 0</V01></OrIntImaM2C>"


@pytest.mark.parametrize(
    ("text", "code"),
    [
        (embedded().replace("CodageMatr", "CodageAngulaire"), "cameras.unsupported"),
        (embedded(convention="eConvOriLib"), "cameras.unsupported"),
        (embedded("<ModGridDef/>"), "cameras.unsupported"),
        (
            embedded(STANDARD.format("<b1>2e-2</b1>"), convention="eConvApero_DistC2M"),
            "cameras.unsupported",
        ),
        (orientation(f"<Interne>{interior()}</Interne>", more=SCANNED), "cameras.unsupported"),
        (orientation("<FileInterne>AutoCal.xml</FileInterne>"), "cameras.missing_file"),
    ],
)
def test_refused(tmp_path, text, code):
    with refused(code):
        read(tmp_path, text)
