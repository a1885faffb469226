"""RealityCapture's XMP files."""

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from pcfix.lens.imaging import project
from tests.utils.camera_files import brown, notes, read
from tests.utils.codes import refused
from tests.utils.shared import needs

SAMPLE, sample = needs("cameras", "realitycapture", "xmp_one_image")

TURN = Rotation.from_euler("XYZ", (178.0, 3.0, 40.0), degrees=True).as_matrix().T
FIELDS = {
    "Rotation": " ".join(repr(float(x)) for x in TURN.ravel()),
    "Position": "10 20 30",
    "Coordinates": "absolute",
    "FocalLength35mm": "27",
    "Skew": "0",
    "AspectRatio": "1",
    "PrincipalPointU": "0.01",
    "PrincipalPointV": "-0.02",
    "DistortionModel": "brown4t2",
    "DistortionCoeficients": "0.1 -0.2 0.3 -0.4 0.01 0.02",
}
SIZE = (600, 400)


def xmp(fields, elements=("Rotation", "Position")):
    attributes = " ".join(f'xcr:{k}="{v}"' for k, v in fields.items() if k not in elements)
    inside = "".join(f"<xcr:{k}>{v}</xcr:{k}>" for k, v in fields.items() if k in elements)
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description'
        f' xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" {attributes}>{inside}'
        "</rdf:Description></rdf:RDF></x:xmpmeta>"
    )


def write(tmp_path, name="a", image=".jpg", elements=("Rotation", "Position"), **changes):
    fields = {key: value for key, value in {**FIELDS, **changes}.items() if value is not None}
    path = tmp_path / f"{name}.xmp"
    path.write_text(xmp(fields, elements))
    if image:
        Image.new("L", SIZE).save(tmp_path / (name + image))
    return path


def seen(path, direction=(0.2, -0.1, 1.0)):
    return project(read(path).lenses[0], np.array([direction]))[0]


@sample
def test_samples_give_rotations_without_lenses():
    cameras = read(SAMPLE)
    assert cameras.labels == ("camera_center", "camera_other")
    assert cameras.centres[1] == pytest.approx([-1.71824608, 5.38387013, 1.39163329])
    assert cameras.rotations[0] == pytest.approx(np.eye(3))
    assert cameras.rotations[1][2] == pytest.approx([0.34449907, -0.48551712, 0.80348834])
    assert cameras.lenses is None
    assert cameras.crs is None
    assert notes(cameras) == []


@pytest.mark.parametrize(
    ("model", "k", "t"),
    [
        ("perspective", (), (0, 0)),
        ("brown3", (0.1, -0.2, 0.3), (0, 0)),
        ("brown4", (0.1, -0.2, 0.3, -0.4), (0, 0)),
        ("brown3t2", (0.1, -0.2, 0.3), (0.01, 0.02)),
        ("brown4t2", (0.1, -0.2, 0.3, -0.4), (0.01, 0.02)),
    ],
)
def test_models(tmp_path, model, k, t):
    path = write(tmp_path, DistortionModel=model, AspectRatio="1.1", Skew="0.05")
    x, y = brown(0.2, -0.1, k, t)
    expected = (306 + 450 * x + 30 * y, 188 + 495 * y)
    assert seen(path) == pytest.approx(expected)


def test_scale_is_the_larger_side_of_a_portrait(tmp_path):
    path = write(tmp_path, image=None, DistortionModel="perspective")
    Image.new("L", (400, 600)).save(tmp_path / "a.png")
    assert seen(path) == pytest.approx((206 + 450 * 0.2, 288 - 450 * 0.1))


def test_division(tmp_path):
    # undistorting the place that is seen must give the place that the calibration alone gives
    k = -0.3
    path = write(tmp_path, DistortionModel="division", DistortionCoeficients=f"{k} 0 0 0 0 0")
    place = (seen(path) - (300, 200)) / 600
    ideal = place / (1 + k * place @ place)
    expected = (0.75 * 0.2 + 0.01, 0.75 * -0.1 - 0.02)
    assert ideal == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("beside", [True, False])
def test_sensor_gives_the_shape(tmp_path, beside):
    path = write(tmp_path, image=None, DistortionModel="perspective")
    sensor = tmp_path / ("sensor.csv" if beside else "other.csv")
    sensor.write_text("focal,sensor_x,sensor_y\n8.8,12,8\n")
    lens = read(path, None if beside else sensor).lenses[0]
    uv = project(lens, np.array([[0.2, -0.1, 1.0]]))[0]
    assert uv * 50 == pytest.approx((306 + 450 * 0.2, 188 - 450 * 0.1))


def test_folder(tmp_path):
    write(tmp_path, "b", image=".TIF")
    write(tmp_path, "a", Position="1 2 3")
    write(tmp_path, "lost", Rotation=None, Position=None)
    write(tmp_path, "_common", image=None, Rotation=None, Position=None)
    (tmp_path / "other.xmp").write_text('<x:xmpmeta xmlns:x="adobe:ns:meta/"/>')
    cameras = read(tmp_path)
    assert cameras.labels == ("a.jpg", "b.TIF")
    assert cameras.centres.tolist() == [[1, 2, 3], [10, 20, 30]]
    assert cameras.unposed == ("lost.jpg",)
    assert cameras.rotations[0] == pytest.approx(TURN)


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"Position": "1 2"}, "cameras.damaged"),
        ({"DistortionModel": "rationalP2D1"}, "cameras.unsupported"),
        ({"Rotation": None}, "cameras.no_pose"),
    ],
)
def test_refused(tmp_path, changes, code):
    path = write(tmp_path, **changes)
    with refused(code, path=path):
        read(path)
