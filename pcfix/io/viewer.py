"""open3d's viewer: on the screen, and off it in a process of its own.

That process draws what `Scene3d.save` wrote; where the machine has no way to draw, some versions of
open3d end it rather than raise.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pcfix.errors import SettingError
from pcfix.libraries import load_open3d
from pcfix.model import FloatArray, IntArray

WATER_COLOUR = (0.29, 0.64, 0.78, 0.25)
CAMERA_COLOUR = (0.04, 0.37, 0.54)
BACKGROUND = (1.0, 1.0, 1.0, 1.0)
VIEW_DEG = 45.0
FROM = np.array([-0.45, -0.8, 0.5]) / np.linalg.norm([-0.45, -0.8, 0.5])
"""Where one looks from: the south-west, from above."""


@dataclass(frozen=True, eq=False)
class Scene3d:
    """What is drawn, metres from `origin` of the scene; colours 0 to 1.

    Attributes
    ----------
    names : list of str
    xyz, rgb : list of array, shape (n, 3)
        Of each cloud.
    lines : array, shape (m, 2, 3)
        The frusta of cameras.
    water : array, shape (v, 3)
    triangles : array of int, shape (t, 3)
        Of the water.
    """

    names: list[str]
    xyz: list[FloatArray]
    rgb: list[FloatArray]
    lines: FloatArray
    water: FloatArray
    triangles: IntArray

    @property
    def radius_m(self) -> float:
        """How far from the origin anything reaches."""
        corners = [*self.xyz, self.lines.reshape(-1, 3), self.water]
        return max(float(np.linalg.norm(one, axis=1).max()) for one in corners if len(one))

    def save(self, path: Path) -> None:
        """Write it for the other process."""
        clouds: dict[str, Any] = {f"xyz{i}": one for i, one in enumerate(self.xyz)}
        clouds |= {f"rgb{i}": one for i, one in enumerate(self.rgb)}
        clouds |= {"lines": self.lines, "water": self.water, "triangles": self.triangles}
        np.savez(path, **clouds, names=np.array(self.names))

    @classmethod
    def load(cls, path: Path) -> Scene3d:
        """Read what `save` wrote."""
        with np.load(path) as held:
            count = range(len(held["names"]))
            xyz, rgb = ([held[f"{what}{i}"] for i in count] for what in ("xyz", "rgb"))
            names: list[str] = held["names"].tolist()
            return cls(names, xyz, rgb, held["lines"], held["water"], held["triangles"])


def show(scene: Scene3d, title: str) -> None:
    """Open the viewer, with a switch for each cloud; returns when it is closed.

    A `SettingError` if there is no screen.
    """
    on_x = sys.platform.startswith("linux")
    if on_x and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise SettingError("there is no screen to open a viewer on; give --image FILE.png.")
    o3d = load_open3d()
    things = [_named(o3d, *cloud) for cloud in zip(scene.names, scene.xyz, scene.rgb, strict=True)]
    o3d.visualization.draw(
        [*things, *_surroundings(o3d, scene)], title=title, show_ui=True, bg_color=BACKGROUND
    )


def render(scene: Scene3d, width: int, height: int) -> tuple[list[FloatArray], str]:
    """Draw each cloud with cameras and water, without a screen.

    Returns
    -------
    list of array of uint8, shape (height, width, 3)
        None where it cannot be done.
    str
        Why not.
    """
    with tempfile.TemporaryDirectory() as folder:
        given, drawn = Path(folder) / "scene.npz", Path(folder) / "images.npy"
        scene.save(given)
        words = [sys.executable, "-m", __name__, str(given), str(drawn), str(width), str(height)]
        environment = os.environ | {"OPEN3D_CPU_RENDERING": "true"}
        done = subprocess.run(words, capture_output=True, text=True, env=environment, check=False)
        if done.returncode == 0 and drawn.exists():
            return list(np.load(drawn)), ""
    last = [line for line in done.stderr.splitlines() if line.strip()][-1:]
    return [], (last or [f"exit code {done.returncode}"])[0].rpartition("Error: ")[2].rstrip("!.")


def _draw(given: Path, drawn: Path, width: int, height: int) -> None:
    o3d, scene = load_open3d(), Scene3d.load(given)
    renderer = o3d.visualization.rendering.OffscreenRenderer(width, height)
    view = renderer.scene
    view.set_background(BACKGROUND)
    view.view.set_post_processing(False)
    for one in _surroundings(o3d, scene):
        view.add_geometry(one["name"], one["geometry"], one["material"])
    reach = scene.radius_m / np.tan(np.radians(VIEW_DEG / 2.0))
    eye, up = (FROM * reach).astype(np.float32), np.array([0.0, 0.0, 1.0], np.float32)
    images = []
    for cloud in zip(scene.names, scene.xyz, scene.rgb, strict=True):
        one = _named(o3d, *cloud)
        view.add_geometry("cloud", one["geometry"], one["material"])
        renderer.setup_camera(VIEW_DEG, np.zeros(3, np.float32), eye, up)  # goes by what is there
        images.append(np.array(renderer.render_to_image()))
        view.remove_geometry("cloud")
    np.save(drawn, np.array(images))


def _named(o3d: Any, name: str, xyz: FloatArray, rgb: FloatArray) -> dict[str, Any]:
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz))
    cloud.colors = o3d.utility.Vector3dVector(rgb)
    material = o3d.visualization.rendering.MaterialRecord()
    material.shader, material.point_size = "defaultUnlit", 2.5
    return {"name": name, "geometry": cloud, "material": material}


def _surroundings(o3d: Any, scene: Scene3d) -> list[dict[str, Any]]:
    """Return cameras and water as open3d has them, where there are some."""
    found, record = [], o3d.visualization.rendering.MaterialRecord
    if len(scene.lines):
        ends = o3d.utility.Vector3dVector(scene.lines.reshape(-1, 3))
        pairs = o3d.utility.Vector2iVector(np.arange(2 * len(scene.lines)).reshape(-1, 2))
        lines = o3d.geometry.LineSet(ends, pairs)
        lines.paint_uniform_color(CAMERA_COLOUR)
        material = record()
        material.shader, material.line_width = "unlitLine", 1.0
        found.append({"name": "cameras", "geometry": lines, "material": material})
    if len(scene.triangles):
        mesh = o3d.geometry.TriangleMesh(
            o3d.utility.Vector3dVector(scene.water), o3d.utility.Vector3iVector(scene.triangles)
        )
        mesh.compute_vertex_normals()  # without them, and with other shaders, open3d 0.20 crashes
        material = record()
        material.shader, material.base_color = "defaultLitTransparency", WATER_COLOUR
        found.append({"name": "water", "geometry": mesh, "material": material})
    return found


if __name__ == "__main__":
    _draw(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
