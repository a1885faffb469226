"""Files that are known but not read: each is refused by its name, with a way round."""

import json
import zipfile

import pytest

import pcfix
from pcfix import InputError
from pcfix.io.cameras import table, unsupported
from pcfix.io.cameras.formats import Source

PATB = "1 153.2\n 456010.1 5432010.2 90.3\n 0 1 0\n -1 0 0\n 0 0 1\n"
SFM = {"version": ["1", "2", "0"], "featuresFolders": [], "views": [{"viewId": "1"}]}
NERF = {"fl_x": 3000.0, "frames": [{"file_path": "a.jpg", "transform_matrix": []}]}

FILES = {
    "a.jpg": (b"\xff\xd8\xff\xe0\0\x10JFIF", "an image"),
    "a.tif": (b"II*\0\x08\0\0\0", "an image"),
    "a.las": (b"LASF\0\0", "a point cloud (LAS, LAZ)"),
    "a.ply": (b"ply\nformat ascii 1.0\n", "a point cloud or mesh (PLY)"),
    "a.gpkg": (b"SQLite format 3\0", "GeoPackage"),
    "a.shp": (b"\0\0\x27\x0a\0\0", "shapefile"),
    "a.gz": (b"\x1f\x8b\x08", "gzip"),
    "a.mvs": (b"MVSI\x07\0\0\0", "OpenMVS"),
    "a.p4d": (b'<?xml version="1.0"?>\n<!DOCTYPE Pix4D>\n<pix4uav>', "1_initial/params"),
    "a.psx": (b'<document version="1.2.0" path="{projectname}.files/project.zip"/>', "Metashape"),
    "a.rcproj": (b"<RealityCaptureProject>", "Internal/External camera parameters"),
    "a.kml": (b'<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2">', "KML"),
    "a.jxl": (b'<?xml version="1.0"?><JOBFile jobName="a">', "Trimble"),
    "a.prj": (b"$PROJECT 15.0.0\n  $ANGULAR_UNITS : deg\n$END\n", "Inpho"),
    "b.prj": (b"# cut\n$PHOTO\n  $PHOTO_NUM : 12\n", "Inpho"),
    "a.sup": (b"IMAGE_FILE a.tif\nSENSOR_TYPE FRAME\n", "SOCET SET"),
    "itera.dat": (b"ORIA  12 1 456010.1 5432010.2 90.3 0.1 0.2 0.3\n", "BINGO"),
    "a.ori": (PATB.encode(), "PATB"),
    "a.sfm": (json.dumps(SFM).encode(), "AliceVision"),
    "sfm_data.json": (b'{\n "sfm_data_version": "0.3",\n "views": []}', "OpenMVG"),
    "transforms.json": (json.dumps(NERF).encode(), "nerfstudio"),
    "gcp_list.txt": (b"EPSG:32632\n500 5000 10 120 80 a.jpg\n", "ground control points"),
    "sensor.csv": (b"focal,sensor_x,sensor_y\n8.8,13.2,8.8\n", "--sensor"),
    "AutoCal_Foc-8800.xml": (
        b"<ExportAPERO><CalibrationInternConique><F>3</F></CalibrationInternConique></ExportAPERO>",
        "Orientation-*.xml",
    ),
    "cameras.json": (b'{"v2 dji": {"projection_type": "brown"}}', "reconstruction.json"),
    "bare.csv": (b"a.jpg,456010,5432010,90\nb.jpg,456060,5432010,90\n", "label,x,y,z"),
    "bare.txt": (b"456010 5432010 90\n456060 5432010 90\n", "label,x,y,z"),
}


@pytest.mark.parametrize("name", FILES)
def test_files_are_refused_by_name(tmp_path, name):
    data, expected = FILES[name]
    (tmp_path / name).write_bytes(data)
    source = Source(tmp_path / name)
    assert not table.recognises(source)
    assert unsupported.recognises(source)
    with pytest.raises(InputError) as refusal:
        unsupported.read(source)
    assert expected in str(refusal.value)
    assert name in str(refusal.value)
    assert str(refusal.value).endswith(".")


PIX4D = "calibrated_camera_parameters.txt of the same export"
PARTS = {
    "a_calibrated_images_position.txt": "a.jpg,456010.1,5432010.2,90.3\n",
    "a_pmatrix.txt": "a.jpg 1 2 3 4 5 6 7 8 9 10 11 12\n",
    "a_offset.xyz": "456000.000 5432000.000 90.000\n",
    "a_pix4d_calibrated_internal_camera_parameters.cam": "F 8.8\nPx 6.6\nPy 4.4\n",
    "a_calibrated_external_camera_parameters_error.txt": (
        "imageName X Y Z Omega Phi Kappa\na.jpg 0.01 0.01 0.02 0.001 0.001 0.001\n"
    ),
}


@pytest.mark.parametrize("name", PARTS)
@pytest.mark.parametrize("what", ["file", "folder"])
def test_a_part_of_an_export_names_the_file_that_is_wanted(tmp_path, name, what):
    """Standard errors have the very header of a table of poses."""
    (tmp_path / name).write_text(PARTS[name])
    with pytest.raises(InputError, match="Pix4D") as refusal:
        pcfix.read_cameras(tmp_path / name if what == "file" else tmp_path)
    assert name in str(refusal.value)
    assert PIX4D in str(refusal.value)


@pytest.mark.parametrize("beside", ["a.jpg", "offset.xyz"])
def test_a_folder_with_a_camera_file_names_that_and_its_software(tmp_path, beside):
    (tmp_path / "poses.csv").write_text("label,x,y,z\na.jpg,1,2,3\n")
    (tmp_path / beside).write_text("1 2 3\n")
    with pytest.raises(InputError, match=r"holds poses.csv \(CSV table\); give .*poses.csv itself"):
        pcfix.read_cameras(tmp_path)


def test_a_zip(tmp_path):
    with zipfile.ZipFile(tmp_path / "all.zip", "w") as archive:
        archive.writestr("cameras.csv", "label,x,y,z\n")
    with pytest.raises(InputError, match=r"all.zip: is an archive \(ZIP\).*unpack it"):
        unsupported.read(Source(tmp_path / "all.zip"))


@pytest.mark.parametrize(
    ("inside", "expected"),
    [
        ("DJI_0001.JPG", "a folder of images"),
        ("sfm_data.bin", "OpenMVG"),
        ("cameras.sfm", "AliceVision"),
        ("transforms.json", "nerfstudio"),
        ("1_initial", "1_initial/params"),
        ("AutoCal_Foc-8800.xml", "Orientation-"),
        ("cameras.json", "reconstruction.json"),
    ],
)
def test_folders_are_refused_by_what_is_in_them(tmp_path, inside, expected):
    (tmp_path / inside).touch()
    (tmp_path / "readme.txt").touch()
    assert unsupported.recognises(Source(tmp_path))
    with pytest.raises(InputError, match=expected):
        unsupported.read(Source(tmp_path))


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\0\1\2\3",
        b"some words\nand more words\n",
        b"a.jpg,456010\n",
        b"<?xml version='1.0'?><other/>",
        b'{"something": "else"}',
    ],
)
def test_what_is_not_known_is_not_claimed(tmp_path, data):
    (tmp_path / "what").write_bytes(data)
    assert not unsupported.recognises(Source(tmp_path / "what"))


def test_an_empty_folder_is_not_claimed(tmp_path):
    assert not unsupported.recognises(Source(tmp_path))
