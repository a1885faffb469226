"""Nothing asks the network, whatever it is; of a process of its own, as what hears it stays."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import laspy

SCENE = Path(__file__).parents[2] / "samples" / "scene"
ASKED = """
import socket, sys

asked = []

def hear(event, given):
    if event in ("socket.getaddrinfo", "socket.gethostbyname", "socket.sendto"):
        asked.append((event, given))
    if event == "socket.connect" and given[0].family != socket.AF_UNIX:
        asked.append((event, given))

sys.addaudithook(hear)
from pcfix.cli import main

try:
    main(sys.argv[1:])
except SystemExit as end:
    assert not end.code, end
import pyproj

assert not pyproj.network.is_network_enabled()
assert asked == [], asked
"""
HEARD = ASKED.partition("from pcfix.cli")[0] + "socket.getaddrinfo('localhost', 80); assert asked"


def test_it_would_be_heard():
    subprocess.run([sys.executable, "-c", HEARD], check=True)


def test_a_whole_run_asks_nobody(tmp_path):
    for name in ("cloud.laz", "lidar.laz"):
        las = laspy.read(SCENE / name)
        las.points = las.points[::8].copy()
        las.write(tmp_path / name)
    words = ["run", tmp_path / "cloud.laz", tmp_path / "out", "--cameras", SCENE / "cameras.csv"]
    more = ["--water", "0.37", "--reference", tmp_path / "lidar.laz", "--quiet"]
    command = [sys.executable, "-c", ASKED, *map(str, [*words, *more])]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "report.html").is_file()
