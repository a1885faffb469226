"""A block of cameras, its angles by the definition of each kind, and its poses in other frames."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from pyproj import CRS, Proj, Transformer
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from pathlib import Path

Y_UP = np.diag([1.0, -1.0, -1.0])
"""Between camera axes x right, y down, z forward and x right, y up, z back."""
WGS84_A, WGS84_F = 6378137.0, 1.0 / 298.257223563


class Block(NamedTuple):
    """Cameras in a projected CRS, without distortion, the principal point in the middle.

    `centres` (k, 3) are in metres, `rotations` (k, 3, 3) go from the axes of the map to the
    camera's x right, y down, z forward. `labels` have a suffix and differ before it.
    """

    labels: tuple[str, ...]
    centres: np.ndarray
    rotations: np.ndarray
    focal_px: float
    width: int
    height: int
    epsg: int

    @property
    def origin(self) -> np.ndarray:
        """Whole metres amid the block."""
        return np.round(self.centres.mean(axis=0))

    @property
    def crs(self) -> CRS:
        return CRS.from_epsg(self.epsg)

    def poses(self) -> zip[tuple[str, np.ndarray, np.ndarray]]:
        return zip(self.labels, self.centres, self.rotations, strict=True)


class PoseFile(NamedTuple):
    """What was written, and the options without which it cannot be understood."""

    path: Path
    options: dict[str, Any]


def words(*numbers: Any, by: str = " ") -> str:
    return by.join(repr(float(x)) for part in numbers for x in np.ravel(part))


def to_world_y_up(rotations: np.ndarray) -> np.ndarray:
    """Return the turns of photogrammetric camera axes (x right, y up, z back) to the world."""
    return (Y_UP @ rotations).transpose(0, 2, 1)


def omega_phi_kappa(rotations: np.ndarray) -> np.ndarray:
    """Rx(omega) Ry(phi) Rz(kappa) turns photogrammetric axes to the world; degrees."""
    return Rotation.from_matrix(to_world_y_up(rotations)).as_euler("XYZ", degrees=True)


def yaw_pitch_roll(rotations: np.ndarray) -> np.ndarray:
    """Rz(-yaw) Rx(pitch) Ry(roll) does, all 0 for a view straight down with north on top."""
    angles = Rotation.from_matrix(to_world_y_up(rotations)).as_euler("ZXY", degrees=True)
    return angles * [-1.0, 1.0, 1.0]


def aircraft_angles(rotations: np.ndarray) -> np.ndarray:
    """Rz(yaw) Ry(pitch) Rx(roll) turns a body (forward, right, down) to north, east, down.

    The camera looks forward, and the right of its image is the body's.
    """
    swap = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # east, north, up
    body = rotations[:, [2, 0, 1], :].transpose(0, 2, 1)
    return Rotation.from_matrix(swap @ body).as_euler("ZYX", degrees=True)


def quaternions(block: Block) -> np.ndarray:
    """Return quaternions from the map to the camera, the scalar first."""
    return np.roll(Rotation.from_matrix(block.rotations).as_quat(), 1, axis=1)


def axes_at(lon_deg: Any, lat_deg: Any) -> np.ndarray:
    """Return east, north and up as rows in geocentric axes, (..., 3, 3)."""
    lon, lat = np.radians(lon_deg), np.radians(lat_deg)
    zero = np.zeros_like(lon)
    rows = [
        [-np.sin(lon), np.cos(lon), zero],
        [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
        [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def geocentric(lon_deg: Any, lat_deg: Any, height: Any, a: float, f: float) -> np.ndarray:
    lon, lat = np.radians(lon_deg), np.radians(lat_deg)
    e2 = f * (2.0 - f)
    n = a / np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
    across = (n + height) * np.cos(lat)
    z = (n * (1.0 - e2) + height) * np.sin(lat)
    return np.stack([across * np.cos(lon), across * np.sin(lon), z], axis=-1)


def convergence(block: Block, places: np.ndarray | None = None) -> np.ndarray:
    """Return the turns from east, north, up to the axes of the map at places, (n, 3, 3).

    Grid north is as many degrees east of north as the convergence says. North is that of the
    map's own datum. Places are the cameras' where none are given.
    """
    to_map = Proj(block.crs)
    x, y = (block.centres if places is None else places)[:, :2].T
    degrees = to_map.get_factors(*to_map(x, y, inverse=True)).meridian_convergence
    return Rotation.from_euler("z", np.array(degrees)[:, None], degrees=True).as_matrix()


def geocentric_poses(block: Block) -> tuple[np.ndarray, np.ndarray]:
    """Return centres and rotations in the geocentric axes of the map's own datum."""
    lon, lat = Proj(block.crs)(*block.centres[:, :2].T, inverse=True)
    a, inverse_f = block.crs.ellipsoid.semi_major_metre, block.crs.ellipsoid.inverse_flattening
    centres = geocentric(lon, lat, block.centres[:, 2], a, 1.0 / inverse_f)
    return centres, block.rotations @ convergence(block) @ axes_at(lon, lat)


class Topocentric(NamedTuple):
    """Poses in axes east, north, up of WGS 84 at a place; heights are those of the map."""

    lat: float
    lon: float
    height: float
    centres: np.ndarray
    rotations: np.ndarray


def to_degrees(block: Block, places: np.ndarray) -> np.ndarray:
    """Return longitude and latitude of WGS 84 of places on the map, (n, 2) or (2,)."""
    way = Transformer.from_crs(block.crs.to_2d(), "EPSG:4326", always_xy=True)
    return np.stack(way.transform(places[..., 0], places[..., 1]), axis=-1)


def topocentric_poses(block: Block) -> Topocentric:
    """Return poses about a place that is not at whole metres, which would be ODM's choice."""
    lon, lat = to_degrees(block, block.centres).T
    lon_0, lat_0 = to_degrees(block, block.origin + np.array([0.37, 0.21, 0.0]))
    centres = geocentric(lon, lat, block.centres[:, 2], WGS84_A, WGS84_F)
    origin, axes = geocentric(lon_0, lat_0, 0.0, WGS84_A, WGS84_F), axes_at(lon_0, lat_0)
    rotations = block.rotations @ convergence(block) @ axes_at(lon, lat) @ axes.T
    return Topocentric(float(lat_0), float(lon_0), 0.0, (centres - origin) @ axes.T, rotations)
