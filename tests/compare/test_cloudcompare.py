"""The same distances as CloudCompare, side by side."""

import os
import re
import shutil
import subprocess

import numpy as np
import pytest

from pcfix.compare.nearest import cloud_to_cloud
from pcfix.compare.statistics import statistics_of

PROGRAM = shutil.which("CloudCompare")


@pytest.mark.skipif(PROGRAM is None, reason="CloudCompare is not installed")
def test_mean_and_sd_of_200_000_points_are_those_of_cloudcompare(tmp_path):
    rng = np.random.default_rng(31)
    clouds = {}
    for name, lift in (("compared", 0.04), ("reference", 0.0)):
        xy = rng.uniform(0.0, 60.0, (200_000, 2))
        z = -4.0 + np.sin(xy[:, 0] / 6.0) + lift + rng.normal(0.0, 0.02, len(xy))
        # CloudCompare holds coordinates in 32 bits: steps of 1/1024 m are exact in both
        clouds[name] = np.rint(np.column_stack([xy, z]) * 1024.0) / 1024.0
        np.savetxt(tmp_path / f"{name}.asc", clouds[name], fmt="%.10f")
    log = subprocess.run(
        [PROGRAM, "-SILENT", "-AUTO_SAVE", "OFF", "-O", "compared.asc", "-O", "reference.asc",
         "-C2C_DIST"],
        cwd=tmp_path, env={**os.environ, "QT_QPA_PLATFORM": "offscreen"},
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    said = re.search(
        r"Mean distance = ([\d.]+) / std deviation = ([\d.]+)", log.stdout + log.stderr
    )
    assert said, log.stdout + log.stderr
    ours = statistics_of(cloud_to_cloud(clouds["compared"], clouds["reference"]))
    assert f"{ours.mean_m:.6f}" == said[1]
    assert f"{ours.sd_m:.6f}" == said[2]
