"""A small scene for commands that fail or are stopped."""

import shutil

import laspy
import pytest

from tests.utils.shared import SCENE


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A folder with an eighth of the points of the sample, and its cameras."""
    folder = tmp_path_factory.mktemp("inputs")
    for name in ("cloud.laz", "lidar.laz"):
        cloud = laspy.read(SCENE / name)
        cloud.points = cloud.points[::8].copy()
        cloud.write(folder / name)
    for name in ("cameras.csv", "sensor.csv"):
        shutil.copy(SCENE / name, folder)
    return folder
